"""Undo and redo, loading, the add-on off and on, all while the viewport renders: nothing dies, lingers or is stale.

Few times by default; ``DRGS_FAULTS=whole`` does 200, 50 and 20.
"""

from __future__ import annotations

import os

import numpy as np
import psutil
import pytest
import window

WHOLE = os.environ.get("DRGS_FAULTS") == "whole"
COUNTS = (200, 50, 20) if WHOLE else (20, 4, 3)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> window.Seen:
    folder = tmp_path_factory.mktemp("soak")
    found = window.run("soak_job.py", folder, seconds=7200 if WHOLE else 1800, DRGS_SOAK=" ".join(map(str, COUNTS)))
    found.result["folder"] = str(folder)
    return found


def viewport(seen: window.Seen, name: str) -> np.ndarray:
    """What the viewport shows in a photograph."""
    left, top, right, bottom = seen.result["viewport"]
    return seen.photograph(f"soak-{name}")[top:bottom, left:right]


def test_nothing_fails(seen):
    result = seen.result
    assert "error" not in result, result["error"]
    assert not result["errors"]
    assert "Traceback" not in seen.log, seen.log[-3000:]


def test_undo_and_redo_are_what_they_say(seen):
    assert seen.result["places"] == [[0, 0.0], [1, 1.0]]


@pytest.mark.parametrize("name", ["3-undone", "4-loaded", "5-switched"])
def test_no_picture_is_stale(seen, name):
    """Back at the first state the screen shows the first picture again, sample for sample."""
    first, moved = viewport(seen, "1-before"), viewport(seen, "2-moved")
    now = viewport(seen, name)
    assert np.abs(now - first).mean() < 0.02 * np.abs(moved - first).mean()


def test_one_engine_at_a_time_and_none_without_the_add_on(seen):
    assert seen.result["engines"] == 1
    assert not seen.result["left"]


def test_what_is_edited_during_f12_changes_nothing_of_its_picture(seen):
    """The object is moved and deleted meanwhile; undo brings it back."""
    assert seen.result["deleted while it renders"] and seen.result["brought back"] == 0.0
    alone, disturbed = (window.picture(seen.result[name]) for name in ("alone", "disturbed"))
    assert np.array_equal(alone, disturbed) and alone.std() > 0.05


def test_no_process_outlives_blender(seen):
    left = []
    for process in psutil.process_iter(["cmdline"]):
        try:
            if process.environ().get("DRGS_WINDOW_JOB") == seen.result["folder"]:
                left.append(process.info["cmdline"])
        except psutil.Error:  # ended just now, or somebody else's
            continue
    assert not left
