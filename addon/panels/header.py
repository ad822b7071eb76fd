"""The header of 3D viewports: the newest warning or error, what is awaited, and, until it is known, where DR-GS is."""

from __future__ import annotations

import textwrap

import bpy

from .. import messages, preferences
from ..viewport import surfels, views
from .sidebar import ICONS

#: Letters that a header has room for; a click shows the rest.
LETTERS = 40


def draw(header: bpy.types.Header, context: bpy.types.Context) -> None:
    """Show the message until they are cleared, and what is awaited where Blender writes nothing over the picture."""
    scene = context.scene
    if not preferences.read("knows_sidebar", True):
        header.layout.operator("drgs.show_sidebar", icon="INFO")
    if scene.drgs.overlay == "LIT" and not views.is_rendered(context.space_data, scene):
        phase, part = views.preparation()
        if phase:
            header.layout.label(text=f"{phase}  {part:.0%}", icon="TIME")
    fewer = _reduction(context)
    if fewer:
        header.layout.label(text=fewer, icon="POINTCLOUD_DATA")
    newest = next((m for m in reversed(list(messages.history)) if m.level != "INFO"), None)
    if newest is not None:
        text = textwrap.shorten(newest.text, LETTERS, placeholder="...")
        header.layout.popover("DRGS_PT_messages", text=text, icon=ICONS[newest.level])


def _reduction(context: bpy.types.Context) -> str:
    """What is shown in place of all surfels, in words, where Blender writes nothing over the picture."""
    shown = context.scene.drgs.overlay
    if shown == "OFF" or views.is_rendered(context.space_data, context.scene):
        return ""
    window = next((r for r in context.area.regions if r.type == "WINDOW"), None)
    return "" if window is None else (surfels if shown == "SURFELS" else views).reduction(views.name_of(window))


def register() -> None:
    bpy.types.VIEW3D_HT_header.append(draw)


def unregister() -> None:
    bpy.types.VIEW3D_HT_header.remove(draw)
