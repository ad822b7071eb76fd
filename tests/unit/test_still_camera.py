"""Objects that were turned before a camera that stood still are refused before cameras are sought."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift
from test_capture_registration import never, ring

from drgs_blender.capture import pipeline
from drgs_blender.capture.registration import Registration
from drgs_blender.capture.soundness import check_directions
from drgs_blender.capture.still_camera import likeness_of_rims, stood_still
from drgs_blender.core.errors import AssetError


def room(seed: int) -> np.ndarray:
    found = gaussian_filter(np.random.default_rng(seed).normal(size=(32, 32)), 0.8)
    return (0.5 + 0.1 * found / found.std()).astype(np.float32)


def pictures(rooms: list[np.ndarray], moved: float = 0.0) -> list[np.ndarray]:
    """An object with a pattern of its own in the middle, before these rooms."""
    rng, found = np.random.default_rng(3), []
    for k, behind in enumerate(rooms):
        picture = shift(behind, rng.uniform(-moved, moved, 2), order=1, mode="reflect")
        picture[8:24, 8:24] = room(100 + k)[8:24, 8:24]
        found.append(picture)
    return found


def test_the_same_rims_say_that_the_camera_stood_still() -> None:
    assert stood_still(pictures(16 * [room(0)]))
    assert stood_still(pictures(16 * [room(0)], moved=2.0))  # held by hand
    assert not stood_still(pictures([room(k) for k in range(16)]))


def test_nothing_is_said_of_plain_backdrops_and_few_pictures() -> None:
    assert likeness_of_rims(pictures(16 * [np.full((32, 32), 0.9, np.float32)])) is None
    assert likeness_of_rims(pictures(3 * [room(0)])) is None


def test_a_real_turntable_without_masks_is_refused_before_the_work(shared_data: Path, tmp_path: Path) -> None:
    photographs = tmp_path / "head"
    photographs.mkdir()
    for path in sorted((shared_data / "multiview/ethiopianHead_1000/images").iterdir())[::5]:
        shutil.copy(path, photographs)
    done: list[str] = []

    def heard(phase: str, part: float) -> None:
        done.append(phase)

    with pytest.raises(AssetError, match=r"same surroundings in all pictures.*Draw masks.*--poses features"):
        pipeline.make_capture(photographs, tmp_path / "out", pipeline.Settings(size=400), heard, never)
    assert set(done) == {"reading pictures"}


def test_cameras_that_look_the_same_way_are_refused() -> None:
    found = Registration(ring(12), {}, {}, {}, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "test")
    check_directions(found, "photographs")
    one = found.matrices["00.jpg"]
    found.matrices = {f"{k}.jpg": one for k in range(12)}
    with pytest.raises(AssetError, match=r"photographs: shows one side alone: its 12 cameras .* 0 degrees"):
        check_directions(found, "photographs")
