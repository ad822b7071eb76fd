"""Mark as Asset: DR-GS objects in Blender's asset browser."""

from __future__ import annotations

import bpy

from . import selection
from .base import DrgsOperator

TAG = "DR-GS"


class DRGS_OT_mark_assets(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Offer the selected DR-GS objects in the asset browser, with preview and the tag DR-GS"""

    bl_idname = "drgs.mark_assets"
    bl_label = "Mark as Asset"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    def run(self, context: bpy.types.Context) -> set[str]:
        mark(selection.editable(selection.selected(context), vertices=False))
        return {"FINISHED"}


def mark(objects: list[bpy.types.Object]) -> None:
    """Mark `objects`; what was typed in before stays."""
    for obj in objects:
        obj.asset_mark()
        data = obj.asset_data
        data.tags.new(TAG, skip_if_exists=True)
        if not data.description:
            data.description = f"Captured object, {len(obj.data.vertices):,} vertices. Rig, animate, paint and relight"
        if not bpy.app.background:  # needs a window to draw in
            obj.asset_generate_preview()


CLASSES = (DRGS_OT_mark_assets,)
