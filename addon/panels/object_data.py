"""Mesh properties: the asset of a DR-GS object."""

from __future__ import annotations

import bpy

from .. import assets


def draw_asset(layout: bpy.types.UILayout, obj: bpy.types.Object) -> None:
    """The asset of `obj`: path, size, whether it fits the mesh. Drawing reads no file."""
    settings = obj.drgs
    layout.template_ID(settings, "asset")
    layout.prop(settings, "path", text="File")
    if settings.asset.packed_file:
        layout.label(text="Packed into the .blend", icon="PACKAGE")
    layout.label(text=f"{len(obj.data.vertices):,} vertices, {len(obj.data.polygons):,} faces", icon="MESH_DATA")


class DRGS_PT_asset(bpy.types.Panel):
    bl_label = "DR-GS"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "data"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return assets.is_drgs(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        draw_asset(self.layout, context.object)
        self.layout.prop(context.object.drgs, "captured_colours")
        self.layout.operator("drgs.bind_to_rig", icon="ARMATURE_DATA")
        self.layout.operator("drgs.play_point_cache", icon="MOD_MESHDEFORM")


CLASSES = (DRGS_PT_asset,)
