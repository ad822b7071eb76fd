"""An artist's work in a real window, by clicks and keys alone: what is true in the file must be seen on the screen.

    DRGS_UI_BLENDER="path/to/blender" python -m pytest tests/ui/test_by_hand.py

Photographs of the window are left in ``out/ui``: look at them.
"""

from __future__ import annotations

import numpy as np
import pytest
import window
from subjects import asset_path

#: Difference of a colour channel from which a pixel is another one: more than the noise of a finished picture.
OTHER = 0.1


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> window.Seen:
    return window.run("by_hand_job.py", tmp_path_factory.mktemp("hand"))


def changed(seen: window.Seen, before: str, after: str) -> np.ndarray:
    """(h, w): which pixels of the free part of the viewport are others."""
    first, second = seen.photograph(f"hand-{before}"), seen.photograph(f"hand-{after}")
    left, top, right, bottom = seen.result["viewport"]
    different = np.abs(first - second).max(axis=2) > OTHER
    free = np.zeros_like(different)
    free[top:bottom, left:right] = different[top:bottom, left:right]
    return free


def inside_and_out(seen: window.Seen, where: np.ndarray, *boxes: str, margin: int = 8) -> tuple[float, float]:
    """Part of the pixels `where`, of those inside the boxes of the object and of the others in the viewport."""
    inside = np.zeros(where.shape, bool)
    for name in boxes:
        left, top, right, bottom = seen.result["boxes"][name]
        inside[max(top - margin, 0) : bottom + margin, max(left - margin, 0) : right + margin] = True
    left, top, right, bottom = seen.result["viewport"]
    view = np.zeros(where.shape, bool)
    view[top:bottom, left:right] = True
    return float(where[inside & view].mean()), float(where[view & ~inside].mean())


def solid(where: np.ndarray) -> np.ndarray:
    """What of `where` is no thin line: the pixels around which all are chosen."""
    padded = np.pad(where, 1)
    height, width = where.shape
    return np.all([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)


def test_the_way_led_to_its_end(seen):
    result = seen.result
    assert "error" not in result, result["error"]
    assert not result["messages"]
    for word in ("Traceback", "rna_uiItem", "unknown operator", "Error: Python"):
        assert word not in seen.log, seen.log[-3000:]


def test_import_by_the_file_browser(seen):
    result = seen.result
    assert result["cube"] == [] and result["start"] == "import" and result["imported"] == "view"
    where = solid(changed(seen, "1-start", "3-imported"))  # without the lines of the grid, as the view is another
    inside, outside = inside_and_out(seen, where, "hand-3-imported")
    assert inside > 10 * outside, "the object is where Blender says, and nothing else has changed"


def test_light_from_the_menu_fills_the_viewport(seen):
    result = seen.result
    assert result["light"] == "forest.exr" and result["shown"] == ["DRGS", "RENDERED"]
    assert changed(seen, "3-imported", "5-rendered").sum() > 0.5 * area(seen)


def test_binding_is_undone_and_redone_by_keys(seen):
    assert seen.result["lattices"] == [1, 0, 1] and seen.result["bound"] == "pose"


def test_a_moved_lattice_moves_the_picture(seen):
    result = seen.result
    assert result["mode"] == "EDIT_LATTICE" and result["back"] == "OBJECT"
    before, after = (np.array(result["boxes"][f"hand-{n}"]) for n in ("5-rendered", "8-posed"))
    assert np.abs(before - after).max() > 20
    where = solid(changed(seen, "6-posing", "7-bent"))  # without the lines of the lattice, which move too
    inside, outside = inside_and_out(seen, where, "hand-5-rendered", "hand-8-posed")
    assert inside > 10 * outside


def test_paint_is_seen_where_the_brush_went(seen):
    result = seen.result
    assert result["chosen"] == asset_path("robot").stem and result["painting"] == "PAINT_VERTEX"
    painted, of = result["painted"]
    assert 0 < painted < of / 2
    where = changed(seen, "11-paint-mode", "12-painted")
    inside, outside = inside_and_out(seen, where, "stroke", margin=result["brush"])
    assert inside > 10 * outside and inside > 0.1


def test_turned_light_is_other_light(seen):
    assert seen.result["turn"] == pytest.approx(np.radians(120))
    assert changed(seen, "13-object-mode", "14-turned").sum() > 0.25 * area(seen)


def test_the_overlay_shows_the_relit_object_in_solid_shading(seen):
    """What is drawn over Solid shading is what the rendered viewport shows of the object; around it all stays."""
    result = seen.result
    assert result["shading"] == "SOLID" and result["overlay"] == "LIT"
    inside, outside = inside_and_out(seen, changed(seen, "15-solid", "16-overlay"), "hand-16-overlay")
    assert inside > 10 * outside and inside > 0.05
    solid, overlay, rendered = (seen.photograph(f"hand-{n}") for n in ("15-solid", "16-overlay", "14-turned"))
    where = changed(seen, "15-solid", "16-overlay")
    to_rendered = np.abs(overlay - rendered).mean(axis=2)[where]
    assert np.median(to_rendered) < OTHER < np.median(np.abs(solid - rendered).mean(axis=2)[where])


def test_f12_shows_what_the_file_will_hold(seen):
    """The window of F12 shows the pixels of the finished picture."""
    result = seen.result
    assert result["percentage"] == 40
    screen = seen.photograph("hand-17-final")
    left, top, right, bottom = result["boxes"]["hand-17-final"]
    picture = window.picture(result["rendered"])
    rows = (np.arange(top, bottom) - top + 0.5) / (bottom - top) * picture.shape[0]
    columns = (np.arange(left, right) - left + 0.5) / (right - left) * picture.shape[1]
    wanted = picture[rows.astype(int)][:, columns.astype(int)]
    assert np.median(np.abs(screen[top:bottom, left:right] - wanted)) < 0.02
    assert wanted.std() > 0.05, "a picture, no plain colour"


def area(seen: window.Seen) -> int:
    """Pixels of the free part of the viewport."""
    left, top, right, bottom = seen.result["viewport"]
    return (right - left) * (bottom - top)
