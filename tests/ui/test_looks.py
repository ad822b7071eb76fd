"""What viewports show: the relit object among Blender's own in every shading, regions, the camera, time that runs."""

from __future__ import annotations

import numpy as np
import pytest
import window


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> window.Seen:
    return window.run("looks_job.py", tmp_path_factory.mktemp("looks"))


def viewport(seen: window.Seen, name: str) -> np.ndarray:
    left, top, right, bottom = seen.result["viewport"]
    return seen.photograph(f"looks-{name}")[top:bottom, left:right]


def test_nothing_fails(seen):
    assert "error" not in seen.result, seen.result["error"]
    assert not seen.result["messages"]
    assert "Traceback" not in seen.log, seen.log[-3000:]


BLENDERS_OWN = [f"1-{kind}{clean}" for kind in ("solid", "material", "rendered") for clean in ("", "-clean")]


@pytest.mark.parametrize("name", [*BLENDERS_OWN, "2-rendered"])
def test_what_is_nearer_hides_what_is_farther(seen, name):
    """A blue cube before the object is seen, one behind it is not; without Blender's overlays too."""
    photograph = seen.photograph(f"looks-{name}")
    blue = {}
    for cube, (x, y) in seen.result["places"].items():
        red, _, colour = photograph[y - 3 : y + 4, x - 3 : x + 4].mean(axis=(0, 1))
        blue[cube] = colour > red + 0.2
    assert blue == {"front": True, "behind": False}


def test_a_region_is_rendered_alone(seen):
    """Left of its edge the picture is that of the whole view; right of it, it is not there."""
    assert seen.result["border"]
    x, y = seen.result["line"]
    region, whole = (seen.photograph(f"looks-{name}") for name in ("3-region", "4-whole"))
    difference = np.abs(region - whole).max(axis=2)
    assert np.median(difference[y - 100 : y + 100, x - 140 : x - 10]) < 0.02
    assert np.median(difference[y - 100 : y + 100, x + 10 : x + 140]) > 0.05


def test_the_camera_is_looked_through(seen):
    assert seen.result["perspective"] == "CAMERA"
    assert np.abs(viewport(seen, "5-camera") - viewport(seen, "4-whole")).mean() > 0.02
    x, y = seen.result["head"]
    red, _, blue = seen.photograph("looks-5-camera")[y - 2 : y + 3, x - 2 : x + 3].mean(axis=(0, 1))
    assert red > blue + 0.2, "the robot's orange head"


def test_time_runs_and_no_picture_is_stale(seen):
    assert seen.result["frames"] > 2
    first, last, again = (viewport(seen, name) for name in ("6-first", "8-last", "9-first-again"))
    moved = np.abs(last - first).mean()
    assert moved > 0.005 and np.abs(again - first).mean() < 0.05 * moved
