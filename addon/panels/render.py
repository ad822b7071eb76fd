"""Render properties: how DR-GS solves a frame."""

from __future__ import annotations

import bpy
from bl_ui.utils import PresetPanel

from .. import bakes, presets
from ..viewport import views
from .text_layout import bar_text, wrapped


class _RenderPanel:
    """Shown when DR-GS is the render engine."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == "DRGS"


class DRGS_PT_presets(PresetPanel, bpy.types.Panel):
    bl_label = "Render Presets"
    preset_subdir = presets.FOLDER
    preset_operator = "drgs.render_preset"
    preset_add_operator = "drgs.render_preset_add"


class DRGS_PT_sampling(_RenderPanel, bpy.types.Panel):
    bl_label = "Sampling"

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        DRGS_PT_presets.draw_panel_header(self.layout)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.drgs
        layout.prop(settings, "device")
        layout.prop(settings, "use_strategy_samples")
        column = layout.column(align=True)
        if settings.use_strategy_samples:
            for name in ("cosine_samples", "ggx_samples", "environment_samples"):
                column.prop(settings, name)
        else:
            column.prop(settings, "samples")
        row = layout.row(heading="Noise Threshold")
        row.prop(settings, "use_noise_threshold", text="")
        value = row.row()
        value.active = settings.use_noise_threshold
        value.prop(settings, "noise_threshold", text="")
        layout.prop(settings, "subpixel_samples")
        row = layout.row()
        row.active = not settings.use_denoising_data
        row.prop(settings, "denoise")
        layout.prop(settings, "use_denoising_data")
        row = layout.row(align=True)
        row.prop(settings, "seed")
        row.prop(settings, "use_animated_seed", text="", icon="TIME")
        column = layout.column(heading="Viewport")
        column.prop(settings, "use_viewport_denoise")
        column.prop(context.scene.render, "preview_pixel_size")
        draw_detail(column, settings)


def draw_detail(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, expand: bool = False) -> None:
    """How many surfels moving viewports show; `expand` shows the choices as buttons."""
    layout.row(align=True).prop(settings, "level_of_detail", expand=expand)
    row = layout.row(align=True)
    row.active = settings.level_of_detail == "AUTOMATIC"
    row.prop(settings, "viewport_surfels")


class DRGS_PT_light(_RenderPanel, bpy.types.Panel):
    bl_label = "Light and Surface"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.drgs
        for name in ("bounces", "clamp_indirect", "filter_glossy", "shading_model", "camera_sees", "rays_see"):
            layout.prop(settings, name)


class DRGS_PT_blur(_RenderPanel, bpy.types.Panel):
    bl_label = "Blur"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        render, camera = context.scene.render, context.scene.camera
        layout.prop(render, "use_motion_blur", text="Motion Blur")
        column = layout.column()
        column.active = render.use_motion_blur
        column.prop(render, "motion_blur_position", text="Position")
        column.prop(render, "motion_blur_shutter")
        column.prop(context.scene.drgs, "use_viewport_motion_blur", text="In Viewports")
        if camera is not None and camera.type == "CAMERA":
            layout.prop(camera.data.dof, "use_dof", text="Depth of Field")
        layout.prop(context.scene.drgs, "blur_steps")
        for text in views.not_blurred():
            wrapped(layout, context, text, "INFO")


class DRGS_PT_film(_RenderPanel, bpy.types.Panel):
    bl_label = "Film"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.use_property_split = True
        self.layout.prop(context.scene.render, "film_transparent", text="Transparent")
        self.layout.prop(context.scene.drgs, "filter_width")


class DRGS_PT_bakes(_RenderPanel, bpy.types.Panel):
    bl_label = "Baked by Cycles"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.drgs
        layout.prop(settings, "bake_world_size")
        layout.prop(settings, "bake_texture_size")
        text, part = bakes.manager.status()
        if text:
            layout.progress(text=bar_text(layout, context, text, part), factor=part)
            layout.operator("drgs.bakes_cancel", icon="CANCEL")


CLASSES = (DRGS_PT_presets, DRGS_PT_sampling, DRGS_PT_light, DRGS_PT_bakes, DRGS_PT_blur, DRGS_PT_film)
