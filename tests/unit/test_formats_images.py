"""Pictures of 16 bits and of floats: read to the last bit, whoever wrote them; damaged and hostile ones are refused."""

from __future__ import annotations

import base64
import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile

from drgs_blender.core.color import linear_to_srgb, srgb_to_linear, to_unit
from drgs_blender.core.errors import AssetError
from drgs_blender.core.mip_pyramid import Pyramid
from drgs_blender.formats.files import Image
from drgs_blender.formats.images import decode_image, image_size, load_image
from drgs_blender.formats.registry import read_environment_file
from drgs_blender.reconstruct.readers.layout import decode_mask, turned_by_exif

RNG = np.random.default_rng(5)
DEEP = RNG.integers(0, 65536, (9, 14, 4), np.uint16)
FLOATS = (RNG.random((9, 14, 4)) * 7).astype(np.float32)


def png16(pixels: np.ndarray, extra: bytes = b"", filters: bool = True) -> bytes:
    """A 16-bit PNG, by the book; every filter type in turn."""
    height, width, channels = pixels.shape
    rows = np.zeros((height + 1, width * channels * 2), np.int64)
    rows[1:] = np.frombuffer(pixels.astype(">u2").tobytes(), np.uint8).reshape(height, -1)
    left = np.pad(rows, ((0, 0), (2 * channels, 0)))[:, : rows.shape[1]]
    above, corner = np.roll(rows, 1, axis=0), np.roll(left, 1, axis=0)
    guess = left + above - corner
    near = [np.abs(guess - of) for of in (left, above, corner)]
    first, second = (near[0] <= near[1]) & (near[0] <= near[2]), near[1] <= near[2]
    paeth = np.where(first, left, np.where(second, above, corner))
    kinds = (0 * rows, left, above, (left + above) // 2, paeth)
    body = b""
    for y in range(1, height + 1):
        kind = (y - 1) % 5 if filters else 0
        body += bytes([kind]) + ((rows[y] - kinds[kind][y]) % 256).astype(np.uint8).tobytes()

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    colour = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    head = struct.pack(">2I5B", width, height, 16, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + chunk(b"IDAT", zlib.compress(body)) + chunk(b"IEND", b"")
    )


def tiff(pixels: np.ndarray, **options: object) -> bytes:
    data = io.BytesIO()
    tifffile.imwrite(data, pixels, **{"photometric": "rgb", **options})
    return data.getvalue()


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_16_bit_png_is_read_to_the_last_bit(channels: int) -> None:
    wanted = {1: DEEP[..., [0, 0, 0]], 2: DEEP[..., [0, 0, 0, 1]]}.get(channels, DEEP[..., :channels])
    found = decode_image(png16(DEEP[..., :channels]), "it")
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, wanted)


def test_the_colour_of_a_16_bit_png_that_is_not_there_is_clear() -> None:
    data = struct.pack(">3H", *DEEP[2, 3, :3].tolist())
    chunk = struct.pack(">I", 6) + b"tRNS" + data + struct.pack(">I", zlib.crc32(b"tRNS" + data))
    found = decode_image(png16(DEEP[..., :3], chunk), "it")
    clear = np.zeros((9, 14), bool)
    clear[2, 3] = True
    np.testing.assert_array_equal(found[..., 3] == 0, clear)
    np.testing.assert_array_equal(found[..., :3], DEEP[..., :3])


STORED = [
    {},
    {"byteorder": ">"},
    {"bigtiff": True},
    {"compression": "zlib"},
    {"compression": "zlib", "predictor": True},
    {"tile": (16, 16), "compression": "zlib"},
    {"rowsperstrip": 2},
]


@pytest.mark.parametrize("options", STORED, ids=str)
def test_16_bit_tiff_is_read_to_the_last_bit(options: dict) -> None:
    np.testing.assert_array_equal(decode_image(tiff(DEEP[..., :3], **options), "it"), DEEP[..., :3])
    np.testing.assert_array_equal(decode_image(tiff(DEEP, extrasamples=["unassalpha"], **options), "it"), DEEP)
    assert decode_image(tiff(DEEP[..., 0], **options | {"photometric": "minisblack"}), "it")[3, 4, 1] == DEEP[3, 4, 0]


#: 4 x 4 pixels of 16-bit RGB with LZW and a predictor, written by tifffile and imagecodecs.
LZW = zlib.decompress(
    base64.b85decode(
        "c-r&y)MDUZU|`^5U|?inU<9&QfS3`9&BVyezzn3f0WmX>4H9PsVm2t735W%u>MsDXC{!GzM-"
        "0gvaVXmeh@}`=!R$RiEDdEJ0b&`bUJ%wmV%s9w1p)$K2$O|j5NH58u0Uyr04v)e#ef+pdIBO+Qpb4|pIAwYw|4Qee@>2gC^o_Mc;"
        "}H>jaQaTIOVuO002LO7(o"
    )
)


def test_16_bit_tiff_with_lzw_as_photo_editors_write_it_is_read_to_the_last_bit() -> None:
    np.testing.assert_array_equal(decode_image(LZW, "it"), np.arange(48, dtype=np.uint16).reshape(4, 4, 3) * 1111)


def test_planes_of_colour_and_alpha_that_was_multiplied_in() -> None:
    for options in STORED:
        planes = tiff(np.moveaxis(DEEP[..., :3], 2, 0), planarconfig="separate", **options)
        np.testing.assert_array_equal(decode_image(planes, "it"), DEEP[..., :3])
    half = np.dstack([DEEP[..., :3] // 2, np.full((9, 14), 32768, np.uint16)])
    found = decode_image(tiff(half, extrasamples=["assocalpha"]), "it").astype(int)
    assert np.abs(found[..., :3] - DEEP[..., :3]).max() <= 2 and (found[..., 3] == 32768).all()


@pytest.mark.parametrize("options", [o for o in STORED if not o.get("predictor")], ids=str)
@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_floats_are_read_as_they_are(options: dict, kind: type) -> None:
    wanted = FLOATS.astype(kind)
    found = decode_image(tiff(wanted[..., :3], **options), "it")
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, wanted[..., :3].astype(np.float32))
    grey = decode_image(tiff(wanted[..., 0], **options | {"photometric": "minisblack"}), "it")
    np.testing.assert_array_equal(grey, np.repeat(wanted[..., :1].astype(np.float32), 3, axis=2))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_floats_and_integers_are_turned_alike(orientation: int) -> None:
    bits = [tiff(p[..., :3], extratags=[(274, "H", 1, orientation, True)]) for p in (DEEP, DEEP.astype(np.float32))]
    np.testing.assert_array_equal(decode_image(bits[0], "it"), decode_image(bits[1], "it"))


def test_8_bits_stay_8_bits() -> None:
    eight = (DEEP >> 8).astype(np.uint8)
    assert (decode_image(tiff(eight[..., :3], compression="zlib"), "it") == eight[..., :3]).all()


def test_values_that_are_no_numbers_are_black_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    bad = FLOATS[..., :3].copy()
    bad[0, 0], bad[1, 1, 1] = np.nan, np.inf
    found = decode_image(tiff(bad), "sky.tif")
    assert not found[0, 0].any() and found[1, 1, 1] == 0 and found[2, 2, 2] == FLOATS[2, 2, 2]
    assert "sky.tif: 4 values that are NaN or infinite set to 0" in caplog.text
    assert decode_image(tiff(np.full((2, 2, 3), 1e300)), "it").max() == 0  # beyond 32 bits


def test_floats_are_light_and_integers_what_a_screen_shows(tmp_path: Path) -> None:
    sky = FLOATS[:8, :, :3].repeat(2, axis=1)[:, :16]
    (tmp_path / "sky.tif").write_bytes(tiff(sky))
    found = read_environment_file(tmp_path / "sky.tif")
    np.testing.assert_array_equal(found.environment.radiance, sky)
    deep = DEEP[:8, :, :3].repeat(2, axis=1)[:, :16]
    (tmp_path / "sky16.tif").write_bytes(tiff(deep))
    found = read_environment_file(tmp_path / "sky16.tif")
    np.testing.assert_array_equal(found.environment.radiance, srgb_to_linear(to_unit(deep)))
    assert "display-referred" in found.notes[0]
    texture = Pyramid(Image(load_image(tmp_path / "sky.tif"), srgb=True)).levels[0]
    np.testing.assert_array_equal(texture, sky)


def test_photographs_and_masks_of_floats(tmp_path: Path) -> None:
    from drgs_blender.reconstruct.readers.photograph_loading import _shown

    (tmp_path / "a.tif").write_bytes(tiff(FLOATS, extrasamples=["unassalpha"]))
    assert image_size(tmp_path / "a.tif") == (14, 9) and not turned_by_exif(tmp_path / "a.tif")
    shown = _shown(load_image(tmp_path / "a.tif"))
    np.testing.assert_array_equal(shown[..., :3], linear_to_srgb(np.clip(FLOATS[..., :3], 0, 1)))
    np.testing.assert_array_equal(decode_mask(tmp_path / "a.tif"), np.clip(FLOATS[..., 3], 0, 1))


HOSTILE = {
    "integers of 32 bits": (tiff(np.ones((2, 2, 3), np.uint32)), "uint32, which are no colours"),
    "signed": (tiff(np.ones((2, 2, 3), np.int16)), "int16, which are no colours"),
    "complex": (tiff(np.ones((2, 2), np.complex64), photometric="minisblack"), "complex64, which are no colours"),
    "cut off": (tiff(FLOATS[..., :3])[:-40], "is no TIFF that can be read"),
    "header alone": (tiff(FLOATS[..., :3])[:8], "is no TIFF that can be read"),
    "no TIFF": (b"II*\0" + bytes(40), "is no"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_damaged_or_of_another_kind_is_refused_by_name(name: str) -> None:
    data, problem = HOSTILE[name]
    with pytest.raises(AssetError, match=f"^a.tif: .*{problem}"):
        decode_image(data, "a.tif")


def test_large_pictures_are_refused_by_our_limit_alone(tmp_path: Path) -> None:
    """Pillow has a limit of its own, below that of 16384 x 16384, and other words."""
    head = png16(np.zeros((1, 1, 3), np.uint16))

    def sized(side: int) -> bytes:
        chunk = b"IHDR" + struct.pack(">2I", side, side) + head[24:29]
        return head[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + head[33:]

    (tmp_path / "a.png").write_bytes(sized(16384))
    assert image_size(tmp_path / "a.png") == (16384, 16384)
    with pytest.raises(AssetError, match=r"^a.png: is 30000 x 30000 pixels. Use a smaller image"):
        decode_image(sized(30000), "a.png")


def test_sizes_are_not_believed() -> None:
    data = bytearray(tiff(np.ones((4, 4, 3), np.float32)))
    with pytest.raises(AssetError, match="is 4 x 4 pixels"):
        decode_image(bytes(data), "it", limit=15)
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        places = [file.pages.first.tags[tag].valueoffset for tag in (256, 257)]
    for place in places:
        struct.pack_into("<H", data, place, 9999)
    with pytest.raises(AssetError, match="declares 9999 x 9999 pixels, more than it holds"):
        decode_image(bytes(data), "it")


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_the_largest_texture_has_16k_a_side(tmp_path: Path) -> None:
    data = bytearray(png16(np.zeros((1, 1, 3), np.uint16)))

    def of_size(width: int, height: int) -> bytes:
        struct.pack_into(">2I", data, 16, width, height)
        struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
        return bytes(data)

    path = tmp_path / "large.png"
    path.write_bytes(of_size(16384, 16384))
    assert image_size(path) == (16384, 16384)
    with pytest.raises(AssetError, match="16385 x 16384 pixels"):
        decode_image(of_size(16385, 16384), "it")


def test_what_unpacks_to_more_than_its_pixels_is_refused() -> None:
    data = tiff(np.ones((64, 64, 3), np.float32), compression="zlib", rowsperstrip=64)
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages.first
        bomb = zlib.compress(bytes(1 << 20))
        tags = {name: page.tags[name].valueoffset for name in ("StripOffsets", "StripByteCounts")}
    changed = bytearray(data + bomb)
    struct.pack_into("<I", changed, tags["StripOffsets"], len(data))
    struct.pack_into("<H", changed, tags["StripByteCounts"], len(bomb))
    with pytest.raises(AssetError, match="unpacks to more than its pixels"):
        decode_image(bytes(changed), "it")


def test_what_needs_a_further_package_says_which(monkeypatch: pytest.MonkeyPatch) -> None:
    data = bytearray(tiff(np.ones((4, 4, 3), np.float32)))
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        struct.pack_into("<H", data, file.pages.first.tags[259].valueoffset, 34887)  # LERC
    with pytest.raises(AssetError, match="pip install imagecodecs"):
        decode_image(bytes(data), "it")
