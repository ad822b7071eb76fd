"""Viewport display of the meshes of DR-GS objects while the viewport draws their splats in their place."""

from __future__ import annotations

import bpy

from . import assets


def update_display(scene: bpy.types.Scene) -> None:
    """Show the meshes of DR-GS objects as boxes while something is drawn in their place, else as they were.

    Points of surfels stand in front of the meshes; what is drawn in the place of these would hide them there.
    """
    for obj in scene.objects:
        if assets.is_drgs(obj.drgs.points_of):
            obj.show_in_front = scene.drgs.overlay == "OFF"
        if not assets.is_drgs(obj) or obj.library is not None:
            continue
        settings = obj.drgs
        if scene.drgs.overlay != "OFF":
            if obj.display_type != "BOUNDS":
                settings.shown_as, obj.display_type = obj.display_type, "BOUNDS"
        elif settings.shown_as:
            obj.display_type, settings.shown_as = settings.shown_as, ""
