"""Render properties: how DR-GS solves a frame."""

from __future__ import annotations

import bpy


class _RenderPanel:
    """Shown when DR-GS is the render engine."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == "DRGS"


class DRGS_PT_sampling(_RenderPanel, bpy.types.Panel):
    bl_label = "Sampling"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.drgs
        layout.prop(settings, "use_custom_split")
        column = layout.column(align=True)
        if settings.use_custom_split:
            for name in ("cosine", "ggx", "environment"):
                column.prop(settings, name)
        else:
            column.prop(settings, "rays")
        row = layout.row(heading="Noise Threshold")
        row.prop(settings, "use_noise_threshold", text="")
        value = row.row()
        value.active = settings.use_noise_threshold
        value.prop(settings, "noise_threshold", text="")
        layout.prop(settings, "aa")
        layout.prop(settings, "denoise")
        row = layout.row(align=True)
        row.prop(settings, "seed")
        row.prop(settings, "use_animated_seed", text="", icon="TIME")


class DRGS_PT_light(_RenderPanel, bpy.types.Panel):
    bl_label = "Light and Surface"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.drgs
        for name in ("bounces", "clamp_indirect", "look", "primary"):
            layout.prop(settings, name)


class DRGS_PT_film(_RenderPanel, bpy.types.Panel):
    bl_label = "Film"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(context.scene.render, "film_transparent", text="Transparent")


CLASSES = (DRGS_PT_sampling, DRGS_PT_light, DRGS_PT_film)
