"""Object, light and world properties: ray visibility, light groups, what of a light Blender's own panel leaves out."""

from __future__ import annotations

import bpy


class DRGS_PT_rays(bpy.types.Panel):
    bl_label = "Ray Visibility"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "object"
    bl_parent_id = "OBJECT_PT_visibility"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == "DRGS" and context.object is not None and context.object.type != "CAMERA"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        obj = context.object
        column = layout.column()
        for name in ("camera", "diffuse", "glossy"):
            column.prop(obj, f"visible_{name}", text=name.title())
        if obj.type != "LIGHT":
            column.prop(obj, "visible_shadow", text="Shadow")
            column.prop(obj, "is_shadow_catcher")
            name = "shadow_terminator_geometry_offset"
            owner = obj if hasattr(obj, name) else getattr(obj, "cycles", None)  # the latter before Blender 5.0
            if owner is not None and hasattr(owner, name):
                column.prop(owner, name, text="Terminator Offset")
        _light_group(layout, obj, context.view_layer)


class DRGS_PT_world_group(bpy.types.Panel):
    bl_label = "Light Group"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "world"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == "DRGS" and getattr(context, "world", None) is not None

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        _light_group(self.layout, context.world, context.view_layer)


def _light_group(
    layout: bpy.types.UILayout, owner: bpy.types.Object | bpy.types.World, view_layer: bpy.types.ViewLayer
) -> None:
    given = owner, "lightgroup", view_layer, "lightgroups"
    layout.prop_search(*given, text="Light Group", results_are_suggestions=True)


class DRGS_PT_beam(bpy.types.Panel):
    bl_label = "Beam and Shadow"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "data"
    bl_parent_id = "DATA_PT_EEVEE_light"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == "DRGS" and getattr(context, "light", None) is not None

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        light = context.light
        layout.prop(light, "use_shadow", text="Cast Shadow")
        if light.type == "AREA":
            layout.prop(light, "spread")


CLASSES = (DRGS_PT_rays, DRGS_PT_world_group, DRGS_PT_beam)
