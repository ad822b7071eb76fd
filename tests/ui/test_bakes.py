"""A procedural world and material in a window: seen when they are baked, waited for by F12, which can be ended."""

from __future__ import annotations

import numpy as np
import pytest
import window

#: Parts of the screen that both colours of the cube take at least, and spread of red in the world's two.
PATCHES, BLUES = 0.005, 0.1


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> window.Seen:
    return window.run("bakes_job.py", tmp_path_factory.mktemp("bakes"))


def blues(picture: np.ndarray) -> np.ndarray:
    """Red of what is world."""
    return picture[..., 0][picture[..., 2] > 0.9]


def patches(picture: np.ndarray) -> tuple[float, float]:
    """Parts of the pixels that are clearly red and clearly green."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    return float(((red > 2 * green) & (red > blue)).mean()), float(((green > 2 * red) & (green > blue)).mean())


def viewport(seen: window.Seen, name: str) -> np.ndarray:
    left, top, right, bottom = seen.result["viewport"]
    return seen.photograph(f"bakes-{name}")[top:bottom, left:right]


def test_nothing_fails(seen):
    assert "error" not in seen.result, seen.result["error"]
    assert not seen.result["errors"]
    assert "Traceback" not in seen.log, seen.log[-3000:]


def test_the_viewport_goes_on_and_says_what_is_baked(seen):
    assert seen.result["line"].split("  |  ")[-1].startswith("Baking ")


def test_the_viewport_shows_both_when_they_are_baked(seen):
    """Two colours on the cube, two in the world; something plain before."""
    before, after = viewport(seen, "1-baking"), viewport(seen, "2-baked")
    assert max(patches(before)) < 0.001 and min(patches(after)) > PATCHES
    assert blues(after).std() > BLUES


def test_a_cancelled_bake_is_named_and_the_rest_is_shown(seen):
    assert seen.result["cancel"] == ["FINISHED"] and len(seen.result["cancelled"]) == 1
    assert seen.result["cancelled"][0].startswith('World "World" cannot be baked (it was cancelled)')
    assert min(patches(viewport(seen, "3-cancelled"))) > PATCHES, "the material is baked still"


def test_f12_waits_for_the_bakes(seen):
    assert seen.result["waits"] and seen.result["waited"] > 0
    picture = window.picture(seen.result["final"])
    assert min(patches(picture)) > PATCHES and blues(picture).std() > BLUES


def test_f12_is_ended_while_it_bakes(seen):
    """Nothing is kept of the large map that it waited for."""
    assert seen.result["left"] == []


def test_nothing_of_the_file_is_lost(seen):
    assert seen.result["same"]
    after = viewport(seen, "5-after")
    assert min(patches(after)) > PATCHES and blues(after).std() > BLUES
