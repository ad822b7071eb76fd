"""From the installed zip to the first relit picture of a file that the user has, by clicks and keys."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import window

#: Clicks and keys.
MOST = 8


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> window.Seen:
    folder = tmp_path_factory.mktemp("first")
    file = shutil.copy(window.ROOT / "examples/cat/egyptian_cat.glb", folder)
    return window.run("first_picture_job.py", folder, DRGS_WINDOW_FILE=str(file))


def test_few_clicks_lead_to_a_picture(seen):
    result = seen.result
    assert "error" not in result, result["error"]
    assert not result["errors"] and not result["cubes"] and result["objects"] == [Path("egyptian_cat.glb").stem]
    assert len(result["done"]) <= MOST
    assert "Traceback" not in seen.log, seen.log[-3000:]


def test_the_guide_has_these_clicks(seen):
    guide = " ".join((window.ROOT / "docs/user-guide.md").read_text(encoding="utf-8").split())
    assert ", ".join(seen.result["done"]) in guide


def test_the_picture_shows_the_object(seen):
    """It stands in the middle of the viewport, where the cube was, and is no grey of the background."""
    picture = seen.photograph("first-picture")
    height, width = picture.shape[:2]
    middle = picture[height // 4 : 3 * height // 4, width // 4 : width // 2]
    assert np.ptp(middle, axis=(0, 1)).max() > 0.2
