"""Pictures that were cut off, as a full disk does."""

from __future__ import annotations

import io
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


def test_jpeg_with_more_behind_its_end(tmp_path: Path) -> None:
    """Cameras and editors put thumbnails and padding there."""
    (tmp_path / "a").write_bytes(other("JPEG") + bytes(64) + b"more")
    assert is_whole(tmp_path / "a")


def test_exr_whose_table_was_never_written(tmp_path: Path) -> None:
    """The writer goes back to it when all else is there."""
    whole = exr(tmp_path / "a.exr", "NO")
    first = next(k for k in range(len(whole)) if int.from_bytes(whole[k : k + 8], "little") == k + 8 * 70)
    (tmp_path / "a.exr").write_bytes(whole[:first] + bytes(8 * 70) + whole[first + 8 * 70 :])
    assert not is_whole(tmp_path / "a.exr")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WebP", "TIFF"])
def test_other_formats(tmp_path: Path, kind: str) -> None:
    assert_complete(tmp_path / "a", other(kind))
