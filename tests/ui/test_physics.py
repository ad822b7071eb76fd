"""Physics in a window: one click bakes what is selected, one object after another, and Esc stops all of it."""

from __future__ import annotations

import pytest
import window

FRAMES = 5


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> window.Seen:
    return window.run("physics_job.py", tmp_path_factory.mktemp("physics"))


def test_nothing_fails(seen):
    assert "error" not in seen.result, seen.result["error"]
    for word in ("Traceback", "rna_uiItem", "unknown operator", "Error: Python"):
        assert word not in seen.log, seen.log[-3000:]


def test_one_click_bakes_the_scenes_frames_of_both(seen):
    assert seen.result["range"] == seen.result["baked"] == [FRAMES, FRAMES], seen.result["messages"]
    assert seen.result["modifiers"] == [["MESH_CACHE"]] * 2


def test_escape_stops_the_one_and_what_waits(seen):
    going, waited = sorted(seen.result["stopped"], reverse=True)
    assert going > FRAMES and waited == FRAMES
    stopped = [text for text in seen.result["messages"] if "stopped at" in text]
    assert len(stopped) == 1 and '.001": stopped at frame' in stopped[0], "the active one is last"


def test_undo_of_what_is_baked_ends_the_bake_with_a_warning_that_takes_no_keys(seen):
    """The redos after it arrive, as they would not below the window of an error."""
    assert sorted(seen.result["redone"]) == [0.0, 1.0]
    removed = [level for level, text in seen.result["undone"] if "was removed while it was simulated" in text]
    assert removed and {level for level, _ in seen.result["undone"]} <= {"WARNING", "INFO"}
