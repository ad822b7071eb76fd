"""True pictures under another light are laid on white once, however a capture says where the object is."""

from __future__ import annotations

from pathlib import Path

import capture_cases
import numpy as np
import pytest
from PIL import Image

from drgs_blender.evaluate.compare import score_relit
from drgs_blender.evaluate.truth import read_relit
from drgs_blender.formats.exr import write_exr_picture
from drgs_blender.reconstruct.capture.capture import WHITE, Capture, View


def written(capture: Capture, folder: Path, behind: np.ndarray | None) -> None:
    """A capture with alpha, or with mask files and something `behind` the object."""
    if behind is None:
        capture_cases.write(capture, folder)
        return
    frames = []
    for view in capture.views:
        pixels = view.colour + (1 - view.mask[..., None]) * behind
        for name, values in ((view.name, pixels), (f"{view.name}-mask", view.mask)):
            Image.fromarray((values.clip(0, 1) * 255 + 0.5).astype(np.uint8)).save(folder / f"{name}.png")
        frames.append({"file_path": f"{view.name}.png", "mask_path": f"{view.name}-mask.png"})
    capture_cases.write_cameras(capture, folder, frames)


def backdrop(kind: str) -> np.ndarray | None:
    if kind == "room":
        return np.random.default_rng(3).random((48, 48, 3))
    return None if kind == "alpha" else np.full(3, 0.2)


@pytest.mark.parametrize("kind", ["alpha", "one colour", "room"])
def test_truth_is_laid_on_white_once(tmp_path, kind):
    capture, behind = capture_cases.balls(6), backdrop(kind)
    written(capture, tmp_path, behind)
    write_exr_picture(tmp_path / "sky.exr", np.ones((4, 8, 3), np.float32))
    truth = read_relit(tmp_path, tmp_path / "sky.exr", up="z")
    assert len(truth.views) == len(capture.views)
    shown = []
    nothing = {"Combined": np.zeros((48, 48, 4), np.float32)}
    score_relit(truth, [nothing] * 6, {}, lambda name, number, ours, true: shown.append(true))
    for picture, view in zip(shown, capture.views, strict=True):
        mask = view.mask[..., None]
        half = (view.mask > 0.3) & (view.mask < 0.7)
        wanted = view.colour + (1 - mask)
        if kind == "room":  # cut out: what shines through a half covered pixel stays
            wanted = (view.colour + (1 - mask) * behind) * mask + (1 - mask)
        assert half.sum() > 20
        np.testing.assert_allclose(picture[half], wanted[half].clip(0, 1), atol=0.02)


def test_a_picture_with_alpha_that_fills_its_frame_lies_on_white_already():
    colour, mask = np.full((2, 2, 3), 0.8, np.float32), np.full((2, 2), 0.5, np.float32)
    own_alpha = View("a", capture_cases.camera(0, 1, 2), colour, mask, on_white=True)
    cut = View("b", own_alpha.camera, colour, mask)
    assert np.array_equal(own_alpha.laid_on(WHITE, None), colour)
    np.testing.assert_allclose(own_alpha.laid_on((0.0, 0.0, 0.0), None), 0.3, atol=1e-6)
    np.testing.assert_allclose(cut.laid_on(WHITE, None), 0.9, atol=1e-6)
