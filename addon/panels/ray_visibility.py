"""Object and light properties: which rays meet an object, and what of a light Blender's own panel leaves out."""

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


CLASSES = (DRGS_PT_rays, DRGS_PT_beam)
