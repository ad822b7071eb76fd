"""View layer properties: the passes of the one table."""

from __future__ import annotations

from typing import Any, ClassVar

import bpy

from ...drgs_blender.core.passes import PASSES
from ..view_layer_passes import label
from ..view_layer_settings import switch_of


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
        row = layout.row()
        row.active = context.scene.render.use_motion_blur
        row.prop(view_layer, "use_motion_blur", text="Motion Blur")
        column = layout.column(heading="Include")
        switches: dict[str, tuple[Any, str]] = {}  # one for all passes of a kind
        for p in PASSES:
            owner, name = (view_layer, p.blender) if p.blender else (view_layer.drgs, switch_of(p))
            switches.setdefault(name, (owner, label(p).removesuffix("00")))
        for name, (owner, text) in switches.items():
            column.prop(owner, name, text=text)


class _BelowPasses:
    """A panel below Passes."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "view_layer"
    bl_parent_id = "DRGS_PT_passes"
    bl_options: ClassVar = {"DEFAULT_CLOSED"}


def _draw_list(layout: bpy.types.UILayout, view_layer: bpy.types.ViewLayer, kind: str, item: str) -> bpy.types.UILayout:
    """Draw the list of `item`s; the column of its buttons."""
    row = layout.row()
    given = view_layer, f"{item}s", view_layer, f"active_{item}_index"
    row.column().template_list(kind, f"{item}s", *given, rows=3)
    column = row.column(align=True)
    column.operator(f"scene.view_layer_add_{item}", icon="ADD", text="")
    column.operator(f"scene.view_layer_remove_{item}", icon="REMOVE", text="")
    return column


class DRGS_PT_aovs(_BelowPasses, bpy.types.Panel):
    bl_label = "Shader AOV"

    def draw(self, context: bpy.types.Context) -> None:
        view_layer = context.view_layer
        _draw_list(self.layout, view_layer, "VIEWLAYER_UL_aov", "aov")
        if view_layer.active_aov and not view_layer.active_aov.is_valid:
            self.layout.label(text="Another render pass has this name", icon="ERROR")


class DRGS_PT_light_groups(_BelowPasses, bpy.types.Panel):
    bl_label = "Light Groups"

    def draw(self, context: bpy.types.Context) -> None:
        column = _draw_list(self.layout, context.view_layer, "UI_UL_list", "lightgroup")
        column.separator()
        column.menu("VIEWLAYER_MT_lightgroup_sync", icon="DOWNARROW_HLT", text="")


CLASSES = (DRGS_PT_passes, DRGS_PT_aovs, DRGS_PT_light_groups)
