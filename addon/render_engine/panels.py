"""Blender's own panels that also make sense for DR-GS: output, camera, world, material, passes we have."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from .engine import DrgsRenderEngine

#: Panels for engines that only other engines can honour.
EXCLUDED = {
    "VIEWLAYER_PT_filter",
    "VIEWLAYER_PT_layer_passes",
    "RENDER_PT_freestyle",
    "RENDER_PT_simplify",
    "RENDER_PT_gpencil",
    "RENDER_PT_motion_blur",
    "RENDER_PT_hydra_debug",
    "OBJECT_PT_relations_render",
}


def _shared() -> Iterator[type[bpy.types.Panel]]:
    for panel in bpy.types.Panel.__subclasses__():
        engines = getattr(panel, "COMPAT_ENGINES", ())
        if "BLENDER_RENDER" in engines and panel.__name__ not in EXCLUDED:
            yield panel


def share_panels() -> None:
    """Show them when DR-GS is the render engine."""
    for panel in _shared():
        panel.COMPAT_ENGINES.add(DrgsRenderEngine.bl_idname)


def withdraw_panels() -> None:
    """Undo `share_panels`."""
    for panel in _shared():
        panel.COMPAT_ENGINES.discard(DrgsRenderEngine.bl_idname)
