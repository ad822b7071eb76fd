"""Camera raw files: linear colours with all their bits, upright, with EXIF; what cannot be developed is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from drgs_blender.capture import pictures
from drgs_blender.capture.camera_raw import decode_raw, read_raw_metadata
from drgs_blender.core.errors import AssetError

pytest.importorskip("rawpy", reason="camera raw files need rawpy")


def write_dng(path: Path, linear: np.ndarray, orientation: int = 1) -> None:
    """An uncompressed DNG, RGGB, of (h, w, 3) linear Rec.709 values by a camera of these primaries."""
    values = np.asarray(np.clip(linear, 0, 1) * 16383 + 0.5, np.uint16)
    cells = np.array([[0, 1], [1, 2]])
    mosaic = np.empty(values.shape[:2], np.uint16)
    for y in range(2):
        for x in range(2):
            mosaic[y::2, x::2] = values[y::2, x::2, cells[y, x]]
    to_xyz = [(0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041)]
    matrix = [n for x in np.linalg.inv(to_xyz).ravel() for n in (round(x * 10000), 10000)]
    tags = [
        (274, "H", 1, orientation), (271, "s", 0, "Maker"), (272, "s", 0, "Model"),
        (33421, "H", 2, (2, 2)), (33422, "B", 4, bytes(cells.ravel().tolist())),
        (50706, "B", 4, bytes((1, 4, 0, 0))), (50707, "B", 4, bytes((1, 1, 0, 0))), (50708, "s", 0, "Maker Model"),
        (50714, "H", 1, 0), (50717, "H", 1, 16383), (50721, "2i", 9, matrix), (50728, "2I", 3, (1, 1) * 3),
        (50778, "H", 1, 21),
    ]  # fmt: skip
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=[(*tag, True) for tag in tags])


@pytest.fixture
def linear():
    """Grey, a dark and a bright colour, and a corner that clips."""
    values = np.full((64, 96, 3), 0.18, np.float32)
    values[:, 32:64], values[:, 64:] = (0.002, 0.004, 0.001), (0.6, 0.3, 0.05)
    values[:8, :8] = 1
    return values


def test_colours_are_linear_and_finer_than_eight_bits(tmp_path, linear):
    write_dng(tmp_path / "a.dng", linear)
    found = decode_raw(tmp_path / "a.dng")
    assert found.shape == linear.shape and found.dtype == np.float32
    for column in (16, 48, 80):  # away from edges, over which the mosaic is interpolated
        np.testing.assert_allclose(found[40, column], linear[40, column], atol=2e-4)
    assert found[2, 2].min() > 0.999


def test_what_learning_reads_is_the_same(tmp_path, linear):
    """Through the capture's own file the colours come out as they were."""
    write_dng(tmp_path / "a.dng", linear)
    (picture,) = pictures.find_pictures(tmp_path)
    written = pictures.write_picture(picture, tmp_path)
    stored, _ = pictures.load_picture(written)
    assert stored.dtype == np.uint16
    shown = pictures.linear_to_srgb(linear[40])
    for column in (16, 48, 80):
        np.testing.assert_allclose(stored[40, column] / 65535, shown[column], atol=1e-3)


def test_turned_pictures_are_upright_once(tmp_path, linear):
    write_dng(tmp_path / "a.dng", linear, orientation=6)
    (picture,) = pictures.find_pictures(tmp_path)
    assert picture.size == (64, 96) and picture.exif.orientation == 1
    assert pictures.decode(picture).shape == (96, 64, 3)


def test_their_camera_is_known(tmp_path, linear):
    write_dng(tmp_path / "a.dng", linear)
    assert read_raw_metadata(tmp_path / "a.dng", (96, 64)).camera == "Maker Model"


def test_what_cannot_be_developed_is_named(tmp_path, linear, caplog):
    broken = tmp_path / "broken.nef"
    broken.write_bytes(b"II*\0" + b"x" * 400)
    with pytest.raises(AssetError, match=r"broken\.nef: cannot be developed \([^b]"):
        decode_raw(broken)
    assert read_raw_metadata(broken, (1, 1)).camera == ""
    for k in range(3):
        write_dng(tmp_path / f"{k}.dng", linear)
    assert [picture.name for picture in pictures.find_pictures(tmp_path)] == ["0", "1", "2"]
    assert "broken.nef" in caplog.text
