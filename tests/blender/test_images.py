"""Tiled images, sequences, movies, and how images are interpolated: as Cycles does, and what fails has a name."""

from __future__ import annotations

import itertools
import struct
import zlib
from pathlib import Path

import bpy
import numpy as np
import parity
import pytest
from scenes import mesh_object, new_world, part
from test_materials import add, emitting, look_down, material

RNG = np.random.default_rng(3)


def save(path: Path, height: int, width: int, colours=None, alpha: bool = False) -> Path:
    """A picture of random colours, or of one, as 8-bit sRGB or float by the name's ending."""
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = RNG.random((height, width, 3)) if colours is None else colours
    if alpha:
        pixels[..., 3] = RNG.random((height, width))
    image = bpy.data.images.new("made", width, height, alpha=True, float_buffer=path.suffix == ".exr")
    image.pixels.foreach_set(pixels.ravel())
    image.filepath_raw, image.file_format = str(path), "OPEN_EXR" if path.suffix == ".exr" else "PNG"
    image.save()
    bpy.data.images.remove(image)
    return path


def tiled(folder: Path, sizes: dict[int, tuple[int, int]], ending: str = "png", extra: tuple[int, ...] = ()):
    """A tiled image of files of `sizes` (height, width); tiles `extra` have no file."""
    for number, (height, width) in sizes.items():
        y, x = np.mgrid[0:height, 0:width].reshape(2, height, width, 1) / (height, width)[0]
        waves = 0.5 + 0.5 * np.sin(RNG.uniform(4, 15, 3) * x + RNG.uniform(4, 15, 3) * y)
        save(folder / f"tile.{number}.{ending}", height, width, waves)
    image = bpy.data.images.load(str(folder / f"tile.{min(sizes)}.{ending}"))
    image.source, image.filepath = "TILED", str(folder / f"tile.<UDIM>.{ending}")
    known = {tile.number for tile in image.tiles}
    for number in sorted({*sizes, *extra} - known):
        image.tiles.new(number)
    return image


def shown(image, cells=((0, 0),), **settings) -> bpy.types.Node:
    """A square per cell of the UV plane that shines with an image, placed as it lies in that plane."""
    tree, _ = material()
    user = settings.pop("user", {})
    node = add(tree, "TexImage", image=image, **settings).node
    for name, value in user.items():
        setattr(node.image_user, name, value)
    emitting(tree, node.outputs["Color"])
    for u, v in cells:
        corners = [(u, v, 0), (u + 1, v, 0), (u + 1, v + 1, 0), (u, v + 1, 0)]
        obj = mesh_object(f"Cell {u} {v}", corners, [(0, 1, 2, 3)])
        obj.data.uv_layers.new().uv.foreach_set("vector", np.float32([c[:2] for c in corners]).ravel())
        obj.data.materials.append(bpy.data.materials["Material"])
    return node


def compared(scene, metres: float, middle: tuple[float, float], size: int = 64) -> tuple[float, float]:
    """PSNR in dB of the scene from above, and without the pixels at the borders of tiles."""
    new_world(scene)[1].inputs["Strength"].default_value = 0
    parity.set_up(scene, size, samples=64, bounces=0, subpixels=16)
    look_down(scene, size, size, metres, *middle)
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    assert np.ptp(theirs[..., :3]) > 0.1
    along = (np.arange(size) + 0.5) / size * metres - metres / 2
    inside = [np.abs(a - np.rint(a)) > 1.5 * metres / size for a in (middle[1] - along, middle[0] + along)]
    within = inside[0][:, None] & inside[1] & (theirs[..., 3] > 0.999).all(axis=0)
    return parity.psnr(ours, theirs), parity.psnr(ours, theirs, within)


CELLS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0))
SIZES = {1001: (256, 256), 1002: (512, 256), 1011: (128, 128)}


def cases(*choices: list, fast: set[tuple]) -> list:
    """All combinations of choices; those not in `fast` are slow tests, and judged once."""
    marks = [pytest.mark.slow, pytest.mark.judged]
    return [pytest.param(*each, marks=[] if each in fast else marks) for each in itertools.product(*choices)]


@pytest.mark.parametrize(
    ("ending", "packed", "interpolation"),
    cases(
        ["png", "exr"], [False, True], ["Linear", "Closest"],
        fast={("png", True, "Linear"), ("exr", False, "Closest")},
    ),
)  # fmt: skip
def test_all_tiles_are_shown(scene, export, tmp_path, ending, packed, interpolation):
    """Tiles of several resolutions, places without a tile (magenta), files and packed ones, bytes and floats."""
    image = tiled(tmp_path, SIZES, ending)
    if packed:
        image.pack()
        for number in SIZES:
            (tmp_path / f"tile.{number}.{ending}").unlink()
    shown(image, CELLS, interpolation=interpolation)
    _, warnings = export()
    assert not warnings
    assert [i for i in bpy.data.images if i.source == "TILED"] == [image], "no copy is left behind"
    whole, within = compared(scene, 3.2, (1.5, 1.0))
    print(f"{ending} {packed} {interpolation}: {whole:.1f} dB, {within:.1f} dB")
    assert within > 50
    # A texel of the ring is wider than what Cycles blends: at magenta, that is seen most.
    assert whole > 35


def test_a_tile_that_is_not_there_is_named_and_magenta(scene, export, tmp_path):
    image = tiled(tmp_path, {1001: (8, 8), 1002: (8, 8)}, extra=(1012, 1101))
    (tmp_path / "tile.1002.png").write_bytes(b"no picture")
    shown(image, ((0, 0), (1, 0)))
    frame, warnings = export()
    (warning,) = set(warnings)
    assert image.name in warning and "tile 1002, 1012, 1101 cannot be read" in warning
    (picture,) = frame.images
    assert picture.pixels.shape == (11 * 8 + 4, 2 * 8 + 4, 4)
    texture = frame.meshes[0].materials[0].emission_texture
    place = texture.transform @ (1.5, 0.5, 1)
    x, y = int(place[0] * picture.pixels.shape[1]), int((1 - place[1]) * picture.pixels.shape[0])
    assert (picture.pixels[y, x] == (255, 0, 255, 255)).all()


def test_tiles_too_large_together_are_reduced_and_named(scene, export, tmp_path, monkeypatch):
    monkeypatch.setattr(part("addon.export.image_grid"), "BUDGET", 4 * 2 * 32 * 32)
    image = tiled(tmp_path, {1001: (64, 64), 1002: (64, 64)})
    shown(image, ((0, 0), (1, 0)))
    frame, warnings = export()
    (warning,) = set(warnings)
    assert image.name in warning and "reduced 2 times" in warning
    assert frame.images[0].pixels.shape == (36, 68, 4)


@pytest.mark.parametrize(
    ("extension", "interpolation"),
    cases(
        ["REPEAT", "EXTEND", "CLIP", "MIRROR"], ["Linear", "Closest", "Cubic", "Smart"],
        fast={("REPEAT", "Linear"), ("EXTEND", "Smart"), ("CLIP", "Cubic"), ("MIRROR", "Closest")},
    ),
)  # fmt: skip
def test_interpolation_and_extension(scene, export, tmp_path, extension, interpolation):
    image = bpy.data.images.load(str(save(tmp_path / "image.png", 7, 5)))
    cells = [(u, v) for u in (-1, 0, 1) for v in (-1, 0, 1)]
    shown(image, cells, interpolation=interpolation, extension=extension)
    _, warnings = export()
    assert not warnings
    found, _ = compared(scene, 2.9, (0.5, 0.5))
    print(f"{interpolation} {extension}: {found:.1f} dB")
    assert found > (45 if interpolation != "Closest" else 40), "borders of texels are sampled"


@pytest.fixture
def sequence(tmp_path):
    """A sequence of frames 3 to 6, of which each is brighter."""
    for frame in range(3, 7):
        save(tmp_path / f"take2_{frame:04d}.png", 4, 4, frame / 8)
    image = bpy.data.images.load(str(tmp_path / "take2_0004.png"))
    image.source = "SEQUENCE"
    return image


@pytest.mark.parametrize(
    "user",
    [
        {"frame_duration": 3, "frame_start": 1, "frame_offset": 2},
        {"frame_duration": 3, "frame_start": 1, "frame_offset": 2, "use_cyclic": True},
        {"frame_duration": 4, "frame_start": 2, "frame_offset": 2, "use_auto_refresh": False},
        {"frame_duration": 1, "frame_start": 1, "frame_offset": 4},
    ],
)
def test_the_picture_of_a_sequence_is_that_of_the_frame(scene, sequence, user):
    shown(sequence, user={"use_auto_refresh": True, **user})
    new_world(scene)[1].inputs["Strength"].default_value = 0
    parity.set_up(scene, 8, samples=1, bounces=0, subpixels=1)
    look_down(scene, 8, 8, 0.9, 0.5, 0.5)
    seen = []
    for frame in (2, 3, 5, 9):
        scene.frame_set(frame)
        ours, theirs = (parity.pictures(scene, e, (1,))[0, ..., :3] for e in ("DRGS", "CYCLES"))
        np.testing.assert_allclose(ours, theirs, atol=2e-3)
        seen.append(float(ours.mean()))
    assert len(set(seen)) > 1 or user["frame_duration"] == 1


def test_a_missing_frame_is_named_and_magenta(scene, export, sequence):
    shown(sequence, user={"frame_duration": 9, "frame_offset": 0, "frame_start": 1, "use_auto_refresh": True})
    scene.frame_set(8)
    frame, warnings = export()
    assert any("frame 8" in w and "take2_0008.png" in w for w in warnings)
    assert frame.meshes[0].materials[0].emission == (1, 0, 1)


def test_a_viewport_shows_another_frame_after_its_change(scene, sequence):
    """The cache of exports keeps materials, but not those with a picture of another frame."""
    shown(sequence, user={"frame_duration": 9, "frame_offset": 0, "frame_start": 1})
    cache, found = part("addon.export.export_cache").ExportCache(), []
    for frame in (3, 3, 4):
        scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        made = part("addon.export.frame").export_frame(graph, str, print, cache=cache)
        found.append(made.images[0])
    assert found[0] is found[1] and (found[2].pixels > found[1].pixels)[..., 0].all()


def test_the_picture_of_a_movie_is_that_of_the_frame(scene, tmp_path):
    movie = movie_of(scene, tmp_path)
    if movie is None:
        pytest.skip("this Blender writes no movies")
    image = bpy.data.images.load(str(movie))
    assert image.source == "MOVIE"
    shown(image, user={"frame_duration": 4, "frame_start": 1, "frame_offset": 0, "use_auto_refresh": True})
    new_world(scene)[1].inputs["Strength"].default_value = 0
    parity.set_up(scene, 8, samples=1, bounces=0, subpixels=1)
    look_down(scene, 8, 8, 0.9, 0.5, 0.5)
    seen = []
    for frame in (1, 3, 4, 7):
        scene.frame_set(frame)
        ours, theirs = (parity.pictures(scene, e, (1,))[0, ..., :3] for e in ("DRGS", "CYCLES"))
        np.testing.assert_allclose(ours, theirs, atol=4e-3)
        seen.append(round(float(ours.mean()), 2))
    assert seen[0] < seen[1] < seen[2] == seen[3]


def movie_of(scene, folder: Path) -> Path | None:
    """A movie of four frames, each brighter, written by Blender."""
    background = new_world(scene)[1]
    render = scene.render
    old = render.engine, render.filepath, render.image_settings.file_format
    for frame in range(1, 5):
        background.inputs["Strength"].default_value = frame / 6
        background.inputs["Strength"].keyframe_insert("default_value", frame=frame)
    try:
        if hasattr(render.image_settings, "media_type"):
            render.image_settings.media_type = "VIDEO"
        render.image_settings.file_format = "FFMPEG"
    except TypeError:
        return None
    render.ffmpeg.format, render.ffmpeg.codec, render.ffmpeg.constant_rate_factor = "AVI", "FFV1", "LOSSLESS"
    render.engine, render.filepath = "CYCLES", str(folder / "movie.avi")
    render.resolution_x = render.resolution_y = 32
    render.use_file_extension, scene.cycles.samples, scene.cycles.use_denoising = False, 1, False
    scene.frame_start, scene.frame_end = 1, 4
    bpy.ops.render.render(animation=True)
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "IMAGE"
    render.engine, render.filepath, render.image_settings.file_format = old
    scene.world.node_tree.animation_data_clear()
    found = sorted(folder.glob("movie*"))
    return found[0] if found else None


def test_a_movie_that_cannot_be_read_is_named(scene, export, tmp_path):
    (tmp_path / "broken.avi").write_bytes(b"RIFF no movie")
    image = bpy.data.images.new("Broken", 4, 4)
    image.source, image.filepath = "MOVIE", str(tmp_path / "broken.avi")
    shown(image, user={"frame_duration": 4})
    frame, warnings = export()
    assert any('"Broken"' in w and "broken.avi" in w for w in warnings)
    assert frame.meshes[0].materials[0].emission == (1, 0, 1)


def test_16_bits_with_alpha_are_multiplied_as_they_are_stored(scene, export, tmp_path):
    """As Cycles does with those of 8 bits."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    stored = np.random.default_rng(1).integers(1, 65536, (5, 4, 4))
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in stored)
    head = struct.pack(">IIBBBBB", 4, 5, 16, 6, 0, 0, 0)
    path = tmp_path / "deep.png"
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )
    shown(bpy.data.images.load(str(path)))
    (sent,) = export()[0].images
    alpha = stored[..., 3:] / 65535
    expected = part("drgs_blender.core.color").srgb_to_linear(stored[..., :3] / 65535 * alpha)
    np.testing.assert_allclose(sent.pixels[..., :3], expected, atol=2e-3)
    np.testing.assert_allclose(sent.pixels[..., 3:], alpha, atol=1e-4)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("alpha_mode", ["STRAIGHT", "NONE"])
def test_channels_that_say_nothing_are_not_sent(scene, export, channels, alpha_mode):
    """Of grey and of opaque bytes, and of those whose alpha is ignored; what is sent stands for the same pixels."""
    rng = np.random.default_rng(channels)
    given = np.ones((300, 8, 4), np.float32)
    given[..., :channels] = rng.integers(0, 256, (300, 8, channels)) / 255
    if channels == 1:
        given[..., :3] = given[..., :1]
    image = bpy.data.images.new("Picture", 8, 300, alpha=True)
    image.alpha_mode = alpha_mode
    image.colorspace_settings.name = "Non-Color"
    image.pixels.foreach_set(given.ravel())
    shown(image)
    (sent,) = export()[0].images
    if alpha_mode == "NONE":
        given[..., 3] = 1
    assert sent.pixels.shape[2] == (3 if channels == 4 and alpha_mode == "NONE" else channels)
    np.testing.assert_array_equal(sent.rgba[::-1], np.rint(255 * given))


def test_reading_a_file_leaves_nothing_of_it_in_blender(scene, export, tmp_path):
    """What an export reads of a file is given back, and known without being read again; painted pixels stay."""
    path = save(tmp_path / "a.png", 512, 600)
    image = bpy.data.images.load(str(path))
    shown(image)
    assert not image.has_data
    first = export()[0].images[0]
    assert not image.has_data
    again = export()[0].images[0]
    assert not image.has_data and again.pixels is first.pixels
    reopened = bpy.data.images.load(str(path))
    pixels = np.array(reopened.pixels[:], np.float32).reshape(512, 600, 4)[::-1]
    np.testing.assert_array_equal(first.rgba, np.rint(255 * pixels))
    painted = image.pixels[0] + 0.25 if image.pixels[0] < 0.5 else image.pixels[0] - 0.25
    image.pixels[0] = painted
    assert export()[0].images[0].pixels[-1, 0, 0] == round(255 * image.pixels[0]) and image.has_data
