"""Materials and textures: a slow and plain model of the lookup, limits, faults, and no needless copies."""

from __future__ import annotations

import itertools
import weakref

import numpy as np
import pytest

from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import UsageError
from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.render.scene.textures import MaterialTable

RNG = np.random.default_rng(7)
BYTES = RNG.integers(0, 256, (5, 7, 4), dtype=np.uint8)
FLOATS = (3 * RNG.random((3, 2, 4))).astype(np.float32)
EXTENSIONS = ("repeat", "extend", "clip", "mirror")
INTERPOLATIONS = ("linear", "closest")


def at(texture: Texture | None, images: list[Image], uv, slot: str = "emission_texture", **constants) -> np.ndarray:
    """(n, 8) results of a material with one texture."""
    constants = {"base_colour": (1, 1, 1), "roughness": 1, "metallic": 1, "emission": (1, 1, 1)} | constants
    table = MaterialTable([Material("m", **constants, **{slot: texture})], images)
    uv = np.atleast_2d(np.asarray(uv, np.float32))
    return table.lookup(np.zeros(len(uv), int), uv)


def texel(pixels: np.ndarray, column: int, row: int, extension: str) -> np.ndarray:
    """A texel counted from the bottom left, wherever it is."""
    place = []
    for i, n in ((pixels.shape[0] - 1 - row, pixels.shape[0]), (column, pixels.shape[1])):
        if extension == "clip" and not 0 <= i < n:
            return np.zeros(4)
        if extension == "mirror":
            i = min(i % (2 * n), 2 * n - 1 - i % (2 * n))
        place.append(i % n if extension == "repeat" else min(max(i, 0), n - 1))
    return pixels[tuple(place)].astype(float)


def model(image: Image, u: float, v: float, interpolation: str, extension: str) -> np.ndarray:
    """RGBA at (u, v), one texel after the other."""
    x, y = u * image.pixels.shape[1], v * image.pixels.shape[0]
    if interpolation == "closest":
        value = texel(image.pixels, int(np.floor(x)), int(np.floor(y)), extension)
    else:
        i, j = int(np.floor(x - 0.5)), int(np.floor(y - 0.5))
        a, b = x - 0.5 - i, y - 0.5 - j
        weights = {(0, 0): (1 - a) * (1 - b), (1, 0): a * (1 - b), (0, 1): (1 - a) * b, (1, 1): a * b}
        value = sum(w * texel(image.pixels, i + di, j + dj, extension) for (di, dj), w in weights.items())
    if image.pixels.dtype == np.uint8:
        value = value / 255
    if image.encoding == "srgb":
        value[:3] = srgb_to_linear(value[:3])
    return value


@pytest.mark.parametrize("pixels", [BYTES, FLOATS, BYTES[:1, :1], BYTES[:1, :2]], ids=["bytes", "floats", "1x1", "2x1"])
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_lookup_is_the_plain_model(pixels, extension):
    uv = RNG.uniform(-2.2, 3.1, (60, 2)).astype(np.float32)
    encodings = ("linear", "srgb") if pixels.dtype == np.uint8 else ("linear",)
    for encoding, interpolation in itertools.product(encodings, INTERPOLATIONS):
        image = Image("i", pixels, encoding)
        texture = Texture("i", interpolation=interpolation, extension=extension)
        expected = [model(image, u, v, interpolation, extension)[:3] for u, v in uv.astype(float)]
        np.testing.assert_allclose(at(texture, [image], uv)[:, 5:], expected, atol=2e-5)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_channels_that_say_nothing_may_be_missing(channels, encoding):
    """Grey and opaque bytes, the last texel of a page included: bit for bit as with all four channels."""
    pixels = RNG.integers(0, 256, (64, 64, channels), dtype=np.uint8)
    fewer = Image("i", pixels, encoding)
    whole = Image("i", fewer.rgba, encoding)
    assert whole.pixels.shape == (64, 64, 4)
    uv = np.concatenate([RNG.uniform(-1.2, 2.1, (400, 2)), [[1 - 1e-4, 1e-4], [1e-4, 1 - 1e-4]]]).astype(np.float32)
    for interpolation, extension, channel in itertools.product(INTERPOLATIONS, EXTENSIONS, ("rgb", "a", "luminance")):
        texture = Texture("i", channel, interpolation=interpolation, extension=extension)
        np.testing.assert_array_equal(at(texture, [fewer], uv), at(texture, [whole], uv))
    tables = [
        MaterialTable([Material("m", emission=(1, 1, 1), emission_texture=Texture("i"))], [i]) for i in (fewer, whole)
    ]
    np.testing.assert_allclose(tables[0].mean_emission(0), tables[1].mean_emission(0), rtol=1e-12)


def test_v_is_upwards_and_texel_centres_are_exact():
    h, w = BYTES.shape[:2]
    column, row = np.meshgrid(np.arange(w), np.arange(h))
    uv = np.stack([(column + 0.5) / w, 1 - (row + 0.5) / h], axis=-1).reshape(-1, 2)
    for interpolation in INTERPOLATIONS:
        found = at(Texture("i", interpolation=interpolation), [Image("i", BYTES, "srgb")], uv)[:, 5:]
        np.testing.assert_allclose(found.reshape(h, w, 3), srgb_to_linear(BYTES[..., :3] / 255), atol=3e-6)


def test_bytes_are_decoded_between_the_codes_too():
    """The table is interpolated; the curve is hit to a thousandth of a code everywhere."""
    ramp = np.repeat(np.array([0, 255], np.uint8), 4).reshape(1, 2, 4)
    u = np.linspace(0.25, 0.75, 4001)
    found = at(Texture("i", extension="extend"), [Image("i", ramp, "srgb")], np.stack([u, 0 * u], 1))[:, 5]
    np.testing.assert_allclose(found, srgb_to_linear(2 * u - 0.5), atol=1e-5)
    assert (np.diff(found) > 0).all()


def test_floats_with_a_curve_are_decoded_before_they_are_blended():
    pixels = np.zeros((1, 2, 4), np.float32)
    pixels[0, 1] = 1.5, 1.0, 0.5, 0.5
    image = [Image("i", pixels, "srgb")]
    middle = srgb_to_linear(pixels[0, 1, :3]) / 2
    np.testing.assert_allclose(at(Texture("i"), image, (0.5, 0.5))[0, 5:], middle, rtol=1e-6)
    np.testing.assert_allclose(at(Texture("i", "a"), image, (0.75, 0.5))[0, 5:], 0.5)


@pytest.mark.parametrize("channel", ["r", "g", "b", "a", "luminance", "rgb"])
@pytest.mark.parametrize("slot, column", [("roughness_texture", 3), ("metallic_texture", 4)])
def test_numbers_take_their_channel(channel, slot, column):
    image = Image("i", BYTES, "srgb")
    u, v = 0.31, 0.64
    rgba = model(image, np.float32(u), np.float32(v), "linear", "repeat")
    expected = rgba["rgba".index(channel)] if channel in "rgba" else rgba[:3] @ (0.2126, 0.7152, 0.0722)
    expected = rgba[:3] @ (0.2126, 0.7152, 0.0722) if channel == "rgb" else expected
    found = at(Texture("i", channel), [image], (u, v), slot, roughness=0.5, metallic=0.5)[0]
    assert found[column] == pytest.approx(0.5 * expected, abs=1e-5)
    others = np.delete(found, column)
    np.testing.assert_array_equal(others, np.delete([1, 1, 1, 0.5, 0.5, 1, 1, 1], column).astype(np.float32))


def test_colours_of_one_channel_are_grey():
    found = at(Texture("i", "g"), [Image("i", BYTES)], (0.1, 0.2), "base_colour_texture", base_colour=(1, 0.5, 0))[0]
    green = model(Image("i", BYTES), np.float32(0.1), np.float32(0.2), "linear", "repeat")[1]
    np.testing.assert_allclose(found[:3], (green, green / 2, 0), atol=1e-6)


def test_transform_is_a_matrix_of_coordinates():
    matrix = np.array([[1.5, -0.7, 0.3], [0.4, 2.0, -1.1]])
    uv = RNG.uniform(-1, 1, (50, 2)).astype(np.float32)
    moved = uv @ matrix[:, :2].T + matrix[:, 2]
    image = [Image("i", FLOATS)]
    found = at(Texture("i", transform=matrix), image, uv)
    np.testing.assert_allclose(found, at(Texture("i"), image, moved), atol=2e-5)


def test_constants_alone():
    given = Material("m", (0.1, 0.2, 0.3), 0.4, 0.5, (6, 1e9, 8))
    table = MaterialTable([Material("other"), given], [])
    expected = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 6, 1e9, 8], np.float32)
    np.testing.assert_array_equal(table.lookup([1], [[0.3, np.nan]])[0], expected)
    assert table.warnings == []


def test_constants_out_of_range_are_named():
    materials = [Material("m", (-1, 2, np.nan), 3, -np.inf, (-5, np.nan, np.inf)), Material("fine")]
    table = MaterialTable(materials, [])
    found = table.lookup([0], [[0, 0]])[0]
    np.testing.assert_array_equal(found[:7], (0, 2, 0, 1, 0, 0, 0))
    assert np.isfinite(found[7]) and found[7] > 1e9
    for word in ("base colour", "roughness", "metallic", "emission"):
        assert sum(w.startswith(f"m: {word}") for w in table.warnings) == 1
    assert len(table.warnings) == 4


def test_bright_and_negative_textures_stay_in_range():
    pixels = np.full((1, 3, 4), 1e38, np.float32)
    pixels[0, 1] = -4
    pixels[0, 2] = 7
    uv = [[1 / 6, 0], [1 / 2, 0], [5 / 6, 0]]
    for slot, column, expected in (
        ("base_colour_texture", 0, (1000, 0, 7)),
        ("roughness_texture", 3, (1, 0, 1)),
        ("metallic_texture", 4, (1, 0, 1)),
    ):
        found = at(Texture("i", interpolation="closest"), [Image("i", pixels)], uv, slot)[:, column]
        np.testing.assert_array_equal(found, expected)
    found = at(Texture("i", interpolation="closest"), [Image("i", pixels)], uv, emission=(1e9, 1, 2))[:, 5:]
    assert np.isfinite(found).all() and (found[0] >= 1e15 * 0.99).all()
    np.testing.assert_array_equal(found[1:], [[0, 0, 0], [7e9, 7, 14]])


def test_wild_coordinates_are_finite():
    wild = [1e6, -1e6, 1e20, -1e20, 3e38, -3e38, np.inf, -np.inf, np.nan, 1, 0, -1e-9, -0.0, 2, 1e-45]
    uv = np.array(list(itertools.product(wild, wild)), np.float32)
    for extension, interpolation in itertools.product(EXTENSIONS, INTERPOLATIONS):
        texture = Texture("i", interpolation=interpolation, extension=extension)
        found = at(texture, [Image("i", BYTES)], uv)[:, 5:]
        assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1 + 1e-6
        assert (found[~np.isfinite(uv).all(axis=1)] == 0).all()
    # The same place, a million images away.
    np.testing.assert_array_equal(
        at(Texture("i"), [Image("i", BYTES)], (1e6 + 0.25, -1e6 + 0.5)),
        at(Texture("i"), [Image("i", BYTES)], (0.25, 0.5)),
    )


def test_missing_and_unusable_images_are_magenta_and_named():
    images = [
        Image("empty", np.zeros((0, 4, 4), np.uint8)),
        Image("grey", np.zeros((4, 4), np.uint8)),
        Image("words", np.full((2, 2, 4), "x")),
    ]
    for name in ("gone", "empty", "grey", "words"):
        table = MaterialTable([Material("m", (1, 1, 1), base_colour_texture=Texture(name))], images)
        np.testing.assert_array_equal(table.lookup([0], [[0.4, 0.4]])[0, :3], (1, 0, 1))
        assert len(table.warnings) == 1 and repr(name) in table.warnings[0]
    assert MaterialTable([Material("m")], images).warnings == []


@pytest.mark.parametrize("dtype", [np.uint16, np.float64, np.float16, ">f4"])
def test_other_types_are_converted_and_named(dtype):
    scale = 65535 if dtype == np.uint16 else 1
    pixels = (BYTES / 255 * scale).round(0 if scale > 1 else 9).astype(dtype)
    table = MaterialTable([Material("m", emission=(1, 1, 1), emission_texture=Texture("i"))], [Image("i", pixels)])
    expected = at(Texture("i"), [Image("i", BYTES)], (0.3, 0.3))[0, 5:]
    np.testing.assert_allclose(table.lookup([0], [[0.3, 0.3]])[0, 5:], expected, atol=1e-3)
    assert len(table.warnings) == 1 and "read as float32" in table.warnings[0]


def test_texels_that_are_no_numbers_are_black():
    pixels = FLOATS.copy()
    pixels[0, 0, 0], pixels[1, 1, 1], pixels[2, 0, 2] = np.nan, np.inf, -np.inf
    table = MaterialTable([Material("m", emission=(1, 1, 1), emission_texture=Texture("i"))], [Image("i", pixels)])
    assert "3 values" in table.warnings[0]
    healed = np.where(np.isfinite(pixels), pixels, 0)
    uv = RNG.random((40, 2))
    np.testing.assert_array_equal(
        table.lookup(np.zeros(40, int), uv)[:, 5:], at(Texture("i"), [Image("i", healed)], uv)[:, 5:]
    )
    assert np.isnan(pixels[0, 0, 0])


def test_unknown_words_are_refused():
    for change in ({"channel": "h"}, {"interpolation": "smart"}, {"extension": "stretch"}):
        with pytest.raises(UsageError, match=next(iter(change.values()))):
            MaterialTable([Material("m", roughness_texture=Texture("i", **change))], [])
    with pytest.raises(UsageError, match="adobe"):
        MaterialTable([Material("m", roughness_texture=Texture("i"))], [Image("i", BYTES, "adobe")])


def test_bad_transform_is_ignored_and_named():
    for matrix in (np.full((2, 3), np.nan), np.eye(3)):
        texture = Texture("i", transform=matrix)
        table = MaterialTable([Material("m", emission=(1, 1, 1), emission_texture=texture)], [Image("i", BYTES)])
        assert "transform" in table.warnings[0]
        np.testing.assert_array_equal(
            table.lookup([0], [[0.2, 0.9]])[0, 5:], at(Texture("i"), [Image("i", BYTES)], (0.2, 0.9))[0, 5:]
        )


def test_pixels_are_not_copied_and_survive_their_owner():
    pixels = [BYTES.copy(), FLOATS.copy()]
    materials = [Material("m", base_colour_texture=Texture(n)) for n in "ab"]
    table = MaterialTable(materials, [Image("a", pixels[0], "srgb"), Image("b", pixels[1])])
    assert [row[0] for row in table.arrays[4]] == [p.__array_interface__["data"][0] for p in pixels]
    before = table.lookup([0, 1], [[0.2, 0.2]] * 2)
    del pixels
    for _ in range(100):
        np.full((5, 7, 4), 9, np.uint8)
    np.testing.assert_array_equal(table.lookup([0, 1], [[0.2, 0.2]] * 2), before)


def test_frozen_pixels_are_read_once():
    wide = RNG.random((4, 4, 4))
    wide.flags.writeable = False
    materials = [Material("m", base_colour_texture=Texture("i"))]
    first = MaterialTable(materials, [Image("i", wide)])
    second = MaterialTable(materials, [Image("i", wide)], first)
    assert second.arrays[4][0, 0] == first.arrays[4][0, 0]
    assert second.warnings == first.warnings != []
    # Another encoding, other pixels, or pixels that may have changed are read again.
    for image in (Image("i", wide, "srgb"), Image("i", wide.copy())):
        assert MaterialTable(materials, [image], second).arrays[4][0, 0] != first.arrays[4][0, 0]


def test_old_pixels_are_let_go():
    pixels = RNG.integers(0, 256, (4, 4, 4), dtype=np.uint8)
    gone = weakref.ref(pixels)
    materials = [Material("m", base_colour_texture=Texture("i"))]
    table = MaterialTable(materials, [Image("i", pixels)])
    del pixels
    assert gone() is not None
    table = MaterialTable(materials, [Image("i", BYTES), Image("unused", BYTES), Image("i", BYTES)], table)
    assert gone() is None
    assert "same name" in table.warnings[0]


def test_unaligned_and_strided_pixels():
    padded = np.zeros(BYTES.size + 1, np.uint8)
    padded[1:] = BYTES.ravel()
    expected = at(Texture("i"), [Image("i", BYTES)], (0.6, 0.1))
    for pixels in (padded[1:].reshape(BYTES.shape), np.flip(np.flip(BYTES, 0).copy(), 0), np.asfortranarray(BYTES)):
        np.testing.assert_array_equal(at(Texture("i"), [Image("i", pixels)], (0.6, 0.1)), expected)
