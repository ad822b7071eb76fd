"""Adjustments of a DR-GS object: in the sidebar and in its data properties."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy

from .. import assets


class _Adjustments:
    if TYPE_CHECKING:  # of Blender's Panel
        layout: bpy.types.UILayout

    bl_label = "Adjustments"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return assets.is_drgs(context.object)

    def draw_header(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.object.drgs.adjustment, "use", text="")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        settings = context.object.drgs.adjustment
        layout.active = settings.use and not context.object.drgs.captured_colours
        column = layout.column(align=True)
        for name in ("tint", "hue", "saturation", "value", "brightness", "contrast"):
            column.prop(settings, name)
        for channel in ("roughness", "metallic"):
            column = layout.column(align=True)
            column.prop(settings, f"{channel}_gain", text=f"{channel.title()} ×")
            for part in ("offset", "low", "high"):
                column.prop(settings, f"{channel}_{part}")
        column = layout.column(align=True)
        for name in ("emission", "opacity"):
            column.prop(settings, name)
        row = layout.row(align=True)
        row.prop(settings, "mask")
        row.prop(settings, "use_invert", text="", icon="ARROW_LEFTRIGHT")
        layout.operator("drgs.mask_selection", icon="SELECT_SET")
        layout.operator("drgs.reset_adjustments", icon="LOOP_BACK")


class DRGS_PT_adjust(_Adjustments, bpy.types.Panel):
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "DR-GS"
    bl_parent_id = "DRGS_PT_object"


class DRGS_PT_adjust_data(_Adjustments, bpy.types.Panel):
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "data"
    bl_parent_id = "DRGS_PT_asset"


CLASSES = (DRGS_PT_adjust, DRGS_PT_adjust_data)
