"""Clean: surfels as points, and what selects them."""

from __future__ import annotations

import bpy

from .. import assets, surfel_points


class DRGS_PT_clean(bpy.types.Panel):
    bl_label = "Clean"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "DR-GS"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        obj = context.object
        return obj is not None and (assets.is_drgs(obj) or assets.is_drgs(obj.drgs.points_of))

    def draw(self, context: bpy.types.Context) -> None:
        layout, obj = self.layout, context.object
        if assets.is_drgs(obj.drgs.points_of):
            if context.mode == "EDIT_MESH":
                layout.operator_menu_enum("drgs.select_surfels", "criterion", icon="RESTRICT_SELECT_OFF")
                layout.operator("mesh.delete", text="Delete", icon="TRASH").type = "VERT"
                layout.operator("drgs.mask_selection", icon="SELECT_SET")
            layout.operator("drgs.finish_surfels", icon="CHECKMARK")
            return
        row = layout.row(align=True)
        row.operator("drgs.edit_surfels", icon="POINTCLOUD_DATA")
        if obj.drgs.surfel_points is not None:
            row.operator("drgs.restore_surfels", text="", icon="LOOP_BACK")
        if surfel_points.is_unfinished(obj):
            layout.operator("drgs.finish_surfels", icon="CHECKMARK")
        layout.operator("drgs.crop", icon="MESH_CUBE")


CLASSES = (DRGS_PT_clean,)
