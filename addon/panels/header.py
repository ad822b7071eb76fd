"""The newest warning or error in the header of 3D viewports, for those who have the sidebar closed."""

from __future__ import annotations

import textwrap

import bpy

from .. import messages
from .sidebar import ICONS

#: Letters that a header has room for; a click shows the rest.
LETTERS = 40


def draw(header: bpy.types.Header, context: bpy.types.Context) -> None:
    """Show it until the messages are cleared."""
    newest = next((m for m in reversed(list(messages.history)) if m.level != "INFO"), None)
    if newest is not None:
        text = textwrap.shorten(newest.text, LETTERS, placeholder="...")
        header.layout.popover("DRGS_PT_messages", text=text, icon=ICONS[newest.level])


def register() -> None:
    bpy.types.VIEW3D_HT_header.append(draw)


def unregister() -> None:
    bpy.types.VIEW3D_HT_header.remove(draw)
