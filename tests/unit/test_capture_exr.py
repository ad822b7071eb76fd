"""Captures of EXR pictures: alpha is the mask as in PNG, and what is changed of the pixels is told once."""

from __future__ import annotations

from pathlib import Path

import captures
import numpy as np
from PIL import Image

from drgs_blender.core.color import srgb_to_linear
from drgs_blender.formats.exr import write_exr_picture
from drgs_blender.reconstruct.readers import read_capture


def scene_of(folder: Path) -> Path:
    """Eight PNGs with cameras, every third column half covered; the folder of the pictures."""
    captures.write_nerf(captures.make(folder, 8))
    for file in (folder / "train").glob("*.png"):
        pixels = np.array(Image.open(file))
        pixels[:, ::3, 3] //= 2
        Image.fromarray(pixels).save(file)
    return folder / "train"


def as_exr(pictures: Path, change=lambda k, pixels: pixels) -> None:
    """PNGs to EXR files with associated alpha, in place."""
    for k, file in enumerate(sorted(pictures.glob("*.png"))):
        pixels = np.asarray(Image.open(file), np.float32) / 255
        linear = np.dstack([srgb_to_linear(pixels[..., :3]) * pixels[..., 3:], pixels[..., 3]])
        write_exr_picture(file.with_suffix(".exr"), change(k, linear.astype(np.float32)))
        file.unlink()


def test_alpha_is_the_mask_and_colours_are_laid_on_white(tmp_path, caplog):
    pictures = scene_of(tmp_path)
    before = read_capture(tmp_path)
    as_exr(pictures)
    after = read_capture(tmp_path)
    for png, exr in zip(before.views, after.views, strict=True):
        assert ((exr.mask > 0.4) & (exr.mask < 0.6)).any() and (exr.mask == 1).any()
        np.testing.assert_allclose(exr.mask, png.mask, atol=1e-5)
        np.testing.assert_allclose(exr.colour, png.colour, atol=1e-4)
    assert after.background == before.background == (1.0, 1.0, 1.0)
    assert "as stored" not in caplog.text


def test_what_is_changed_of_the_pixels_is_told_once(tmp_path, caplog):
    pictures = scene_of(tmp_path)

    def broken(k: int, pixels: np.ndarray) -> np.ndarray:
        pixels[0, : min(k, 2), :3] = np.nan
        return pixels

    as_exr(pictures, broken)
    read_capture(tmp_path)
    told = [text for record in caplog.records if "as stored" in (text := record.getMessage())]
    assert len(told) == 1 and "of 7 pictures" in told[0] and "as of r_1.exr: 3 values that are NaN" in told[0]
