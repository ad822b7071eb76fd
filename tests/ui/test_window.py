"""The workflow in a real window, with the extension installed from its zip.

    DRGS_UI_BLENDER="path/to/blender" python -m pytest tests/ui

The command may have arguments; without it, ``blender`` of the PATH. Without a display Xvfb is started. Photographs of
the window are left in ``out/ui`` where ImageMagick's ``import`` is there: look at them.
"""

from __future__ import annotations

import pytest
import window


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> window.Seen:
    return window.run("window_job.py", tmp_path_factory.mktemp("window"))


def test_each_step_leads_to_the_next(seen):
    result = seen.result
    assert "error" not in result, result["error"]
    steps = ("first", "with engine", "imported", "lit", "seen", "camera")
    assert [result[s] for s in steps] == ["engine", "import", "light", "view", "render", "bind"]
    assert result["mode"] == "EDIT_LATTICE", "of lattice and cage, the lattice is what Pose goes to"
    assert not result["messages"]


def test_a_file_is_written_beside_the_window(seen):
    assert seen.result["exported"]


def test_binding_is_undone_and_redone(seen):
    result = seen.result
    assert result["bound"] == ["DR-GS Lattice"]
    assert result["undone"] == [[], 0] and result["redone"] == [["DR-GS Lattice"], 1]


def test_nothing_fails_where_blender_only_prints_it(seen):
    """Panels that cannot be drawn, properties that are not known: Blender tells the console alone."""
    for word in ("Traceback", "rna_uiItem", "unknown operator", "Error: Python"):
        assert word not in seen.log, seen.log[-3000:]
