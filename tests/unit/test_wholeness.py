"""Pictures that were cut off, as a full disk does."""

from __future__ import annotations

import io
import tracemalloc
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from drgs_blender.core.file_integrity import is_whole

COMPRESSIONS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")


def exr(path: Path, compression: str, parts: int = 1, kind: object = OpenEXR.scanlineimage) -> bytes:
    """A picture of 70 lines of noise in as many layers."""
    rng = np.random.default_rng(1)
    header = {"type": kind, "compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    if kind == OpenEXR.tiledimage:
        header["tiles"] = OpenEXR.TileDescription()
    made = [
        OpenEXR.Part(dict(header), {c: rng.random((70, 20), np.float32) for c in "ABGR"}, f"layer {k}")
        for k in range(parts)
    ]
    with OpenEXR.File(made) as file:
        file.write(str(path))
    return path.read_bytes()


def other(kind: str) -> bytes:
    """A picture of noise."""
    data = io.BytesIO()
    Image.fromarray(np.random.default_rng(2).integers(0, 256, (40, 50, 3), np.uint8)).save(data, kind)
    return data.getvalue()


def assert_complete(path: Path, whole: bytes) -> None:
    """It is whole as it is, and not without any number of its last bytes."""
    path.write_bytes(whole)
    assert is_whole(path)
    for length in {*range(0, len(whole), max(1, len(whole) // 300)), *range(len(whole) - 40, len(whole))}:
        path.write_bytes(whole[:length])
        assert not is_whole(path), length


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_exr_with_any_compression(tmp_path: Path, compression: str) -> None:
    assert_complete(tmp_path / "a.exr", exr(tmp_path / "a.exr", compression))


def test_exr_of_several_layers(tmp_path: Path) -> None:
    assert_complete(tmp_path / "a.exr", exr(tmp_path / "a.exr", "ZIP", 3))


@pytest.mark.parametrize("parts", [1, 2])
def test_exr_of_tiles(tmp_path: Path, parts: int) -> None:
    assert_complete(tmp_path / "a.exr", exr(tmp_path / "a.exr", "ZIP", parts, OpenEXR.tiledimage))


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WebP", "TIFF"])
@pytest.mark.parametrize("more", [b"\n", bytes(64) + b"more", b"\xff\xd9\xff\xda", b"\xff\xda\xff"], ids=range(4))
def test_more_behind_the_end(tmp_path: Path, kind: str, more: bytes) -> None:
    """Cameras and editors put thumbnails, films and padding there."""
    (tmp_path / "a").write_bytes(other(kind) + more)
    assert is_whole(tmp_path / "a")


@pytest.mark.parametrize("progressive", [False, True])
def test_jpeg_with_a_thumbnail_before_its_picture(tmp_path: Path, progressive: bool) -> None:
    """Which has an end of its own; scans of more than a block follow."""
    thumbnail, data = other("JPEG"), io.BytesIO()
    pixels = np.random.default_rng(3).integers(0, 256, (300, 400, 3), np.uint8)
    Image.fromarray(pixels).save(data, "JPEG", quality=95, progressive=progressive, exif=b"Exif\0\0" + thumbnail)
    assert thumbnail in data.getvalue()
    assert_complete(tmp_path / "a", data.getvalue())


def test_only_what_says_where_the_rest_lies_is_read(tmp_path: Path) -> None:
    pixels = np.random.default_rng(4).integers(0, 256, (1500, 1500, 3), np.uint8)
    for kind in ("TIFF", "PNG", "WebP", "JPEG"):
        options = {"lossless": True, "method": 0} if kind == "WebP" else {"compress_level": 1} if kind == "PNG" else {}
        Image.fromarray(pixels).save(large := io.BytesIO(), kind, **options)
        (tmp_path / kind).write_bytes(large.getvalue() + (bytes(1 << 23) if kind == "JPEG" else b""))
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": pixels[..., 0].astype(np.float32)}) as file:
        file.write(str(tmp_path / "EXR"))
    for path in tmp_path.iterdir():
        tracemalloc.start()
        try:
            assert is_whole(path)
            assert tracemalloc.get_traced_memory()[1] < min(path.stat().st_size // 2, 3 << 20), path.name
        finally:
            tracemalloc.stop()


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_exr_whose_table_was_never_written(tmp_path: Path, compression: str) -> None:
    """The writer goes back to it when all else is there, or never, as Blender 5.2 where it packs an image."""
    whole = exr(tmp_path / "a.exr", compression)
    lines = {"ZIP": 16, "PXR24": 16, "PIZ": 32, "B44": 32, "B44A": 32, "DWAA": 32, "DWAB": 256}.get(compression, 1)
    size = 8 * -(-70 // lines)
    first = next(k for k in range(len(whole)) if int.from_bytes(whole[k : k + 8], "little") == k + size)
    assert_complete(tmp_path / "a.exr", whole[:first] + bytes(size) + whole[first + size :])


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WebP", "TIFF"])
def test_other_formats(tmp_path: Path, kind: str) -> None:
    assert_complete(tmp_path / "a", other(kind))
