"""View layer properties: the passes of the one table."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ...drgs_blender.core.passes import PASSES
from ..properties import switch_of
from ..view_layer_passes import label


class DRGS_PT_passes(bpy.types.Panel):
    bl_label = "Passes"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "view_layer"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == "DRGS"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        view_layer = context.view_layer
        layout.prop(view_layer.drgs, "others")
        column = layout.column(heading="Include")
        switches: dict[str, tuple[Any, str]] = {}  # one for all passes of a kind
        for p in PASSES:
            owner, name = (view_layer, p.blender) if p.blender else (view_layer.drgs, switch_of(p))
            switches.setdefault(name, (owner, label(p).removesuffix("00")))
        for name, (owner, text) in switches.items():
            column.prop(owner, name, text=text)


class DRGS_PT_aovs(bpy.types.Panel):
    bl_label = "Shader AOV"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "view_layer"
    bl_parent_id = "DRGS_PT_passes"
    bl_options: ClassVar = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        view_layer, row = context.view_layer, self.layout.row()
        given = view_layer, "aovs", view_layer, "active_aov_index"
        row.column().template_list("VIEWLAYER_UL_aov", "aovs", *given, rows=3)
        column = row.column(align=True)
        column.operator("scene.view_layer_add_aov", icon="ADD", text="")
        column.operator("scene.view_layer_remove_aov", icon="REMOVE", text="")
        if view_layer.active_aov and not view_layer.active_aov.is_valid:
            self.layout.label(text="Another render pass has this name", icon="ERROR")


class DRGS_PT_light_groups(bpy.types.Panel):
    bl_label = "Light Groups"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "view_layer"
    bl_parent_id = "DRGS_PT_passes"
    bl_options: ClassVar = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        view_layer, row = context.view_layer, self.layout.row()
        given = view_layer, "lightgroups", view_layer, "active_lightgroup_index"
        row.column().template_list("UI_UL_list", "lightgroups", *given, rows=3)
        column = row.column(align=True)
        column.operator("scene.view_layer_add_lightgroup", icon="ADD", text="")
        column.operator("scene.view_layer_remove_lightgroup", icon="REMOVE", text="")
        column.separator()
        column.menu("VIEWLAYER_MT_lightgroup_sync", icon="DOWNARROW_HLT", text="")


CLASSES = (DRGS_PT_passes, DRGS_PT_aovs, DRGS_PT_light_groups)
