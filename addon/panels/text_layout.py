"""Texts that fit into the width of a region."""

from __future__ import annotations

import re
import textwrap

import bpy

#: Pixels of a letter, about, at a scale of 1.
LETTER = 7.5
#: Pixels of a panel that pops up, at a scale of 1.
POPOVER = 400


def wrapped(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE") -> None:
    """A text in as many lines as the region needs."""
    column = layout.column(align=True)
    letters = _letters(context)
    for i, line in enumerate(textwrap.wrap(broken_paths(text, letters), letters, break_on_hyphens=False)):
        column.label(text=line, icon="BLANK1" if i and icon != "NONE" else icon)


def broken_paths(text: str, letters: int) -> str:
    """The text with spaces after folders, where a path is longer than a line."""
    words = []
    for word in text.split():
        line = ""
        for part in re.findall(r"[^/\\]*[/\\]|[^/\\]+", word):
            if line and len(line) + len(part) > letters:
                words.append(line)
                line = ""
            line += part
        words.append(line)
    return " ".join(words)


def _letters(context: bpy.types.Context) -> int:
    """Letters that fit into a line of the region; what pops up from a header has a width of its own."""
    region, scale = context.region, context.preferences.system.ui_scale or 1
    width = POPOVER * scale if region and region.type == "HEADER" else region.width if region else 240
    return max(24, int(width / (LETTER * scale)) - 4)


def bar_text(
    layout: bpy.types.UILayout, context: bpy.types.Context, text: str, part: float, percent: bool = True
) -> str:
    """Text of a progress bar: `text`, followed by the percentage where `percent` asks for it.

    Where the region is too narrow, the text is written above the bar, which says the number alone.
    """
    number = f"{part:.0%}"
    full = f"{text}  {number}" if percent else text
    if len(full) <= _letters(context):
        return full
    wrapped(layout, context, text)
    return number
