"""Blender's own panels that also make sense for DR-GS: output, camera, world, material, light, passes we have."""

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
    "DATA_PT_light",  # the one below has more
}
#: Eevee's panels for what DR-GS renders as well: nodes of materials and worlds, the quantities of lights.
INCLUDED = {
    "EEVEE_MATERIAL_PT_context_material",
    "EEVEE_MATERIAL_PT_surface",
    "EEVEE_WORLD_PT_surface",
    "DATA_PT_EEVEE_light",
    "DATA_PT_camera_dof",
    "DATA_PT_camera_dof_aperture",
}


def _shared() -> Iterator[type[bpy.types.Panel]]:
    for panel in bpy.types.Panel.__subclasses__():
        engines = getattr(panel, "COMPAT_ENGINES", ())
        if ("BLENDER_RENDER" in engines and panel.__name__ not in EXCLUDED) or panel.__name__ in INCLUDED:
            yield panel


def share_panels() -> None:
    """Show them when DR-GS is the render engine."""
    for panel in _shared():
        panel.COMPAT_ENGINES.add(DrgsRenderEngine.bl_idname)


def withdraw_panels() -> None:
    """Undo `share_panels`."""
    for panel in _shared():
        panel.COMPAT_ENGINES.discard(DrgsRenderEngine.bl_idname)
