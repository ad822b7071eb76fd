"""Render properties: frames rendered by a farm."""

from __future__ import annotations

import bpy

from .. import submit
from .text_layout import wrapped


class DRGS_PT_submit(bpy.types.Panel):
    bl_label = "Farm"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine == "DRGS"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.drgs.submit
        layout.prop(settings, "manager")
        column = layout.column()
        for name in ("out", "chunk", "folder"):
            column.prop(settings, name)
        for switch, path in (("use_denoise", "denoised"), ("use_check", "shared")):
            column = layout.column()
            column.prop(settings, switch)
            row = column.row()
            row.active = getattr(settings, switch)
            row.prop(settings, path)
        column = layout.column()
        own = {"slurm": ("retries", "sbatch"), "flamenco": ("manager_url",)}
        for name in ("program", "options", *own.get(settings.manager, ())):
            column.prop(settings, name)
        draw_job(layout, context)


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The button, and what became of the last job."""
    job = submit.job
    if job is not None and not job.done:
        row = layout.row()
        row.label(text=job.text, icon="SORTTIME")
        row.operator("drgs.submit_cancel", text="", icon="CANCEL")
        return
    layout.operator("drgs.submit", icon="EXPORT")
    if job is None:
        return
    box = layout.box()
    if job.error:
        wrapped(box, context, job.error, "CANCEL")
    else:
        wrapped(box, context, job.text, "CHECKMARK" if job.command else "NONE")
    for note in job.notes:
        wrapped(box, context, note, "ERROR")
    if job.command:
        wrapped(box, context, job.command, "CONSOLE")
        box.operator("drgs.copy_submit", icon="COPYDOWN")


CLASSES = (DRGS_PT_submit,)
