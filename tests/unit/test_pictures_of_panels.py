"""The guide shows every panel of the extension, or tests/ui/pictured.py says why not."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pictured
import pytest

ROOT = Path(__file__).resolve().parents[2]
GUIDE = (ROOT / "docs" / "user-guide.md").read_text(encoding="utf-8")
SHOWN = {
    **pictured.SIDEBAR,
    **{name: panels for name, (_, panels) in pictured.TABS.items()},
    **pictured.OTHERS,
}
#: Bytes of a picture of panels, and of all of them.
LARGEST, ALL = 40_000, 600_000


def panels() -> Iterator[str]:
    """Classes of the extension that Blender has draw something under a title of theirs, or as preferences."""
    for path in sorted((ROOT / "addon").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                bases = {ast.unparse(base) for base in node.bases}
                if bases & {"bpy.types.Panel", "bpy.types.AddonPreferences"}:
                    yield node.name


def test_every_panel_is_in_a_picture_or_left_out_with_a_reason() -> None:
    there = set(panels())
    named = [panel for names in SHOWN.values() for panel in names] + list(pictured.LEFT_OUT)
    assert len(there) > 20 and there == set(named) and len(named) == len(set(named))
    assert all(len(reason.split()) > 3 for reason in pictured.LEFT_OUT.values())


@pytest.mark.parametrize("name", SHOWN)
def test_the_guide_has_the_picture_and_says_what_it_shows(name: str) -> None:
    (text,) = re.findall(rf"!\[([^\]]*)\]\(images/{name}\.png\)", GUIDE)
    assert len(text.split()) > 1
    assert (ROOT / "docs" / "images" / f"{name}.png").is_file()


def test_pictures_of_panels_are_small() -> None:
    sizes = [(ROOT / "docs" / "images" / f"{name}.png").stat().st_size for name in SHOWN]
    assert max(sizes) <= LARGEST and sum(sizes) <= ALL
