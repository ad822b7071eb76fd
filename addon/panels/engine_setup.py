"""Progress of the engine's set-up, or the buttons that begin it."""

from __future__ import annotations

import bpy

from .. import engine_bundle, engine_environment, engine_link, setup_job
from .text_layout import bar_text, wrapped


def draw_engine(layout: bpy.types.UILayout, context: bpy.types.Context, always: bool = False) -> None:
    """Set-up of the engine: its buttons where there is none (or `always`), or how far it is."""
    job = setup_job.job
    if job is not None and not job.done:
        layout.progress(text=bar_text(layout, context, job.text, job.fraction), factor=job.fraction)
        layout.operator("drgs.engine_setup_cancel", icon="CANCEL")
        return
    if not engine_link.problem() and not always:
        return
    if setup_job.job is not None and setup_job.job.error is not None:
        wrapped(layout, context, str(setup_job.job.error), "ERROR")
    if used := engine_link.described():
        wrapped(layout, context, used, "CHECKMARK")
    if fault := engine_bundle.fault():
        wrapped(layout, context, f"The packages that came with the extension {fault}", "ERROR")
    if engine_link.origin() == "bundle":
        text = "Set Up Engine is for more: photographs, NVIDIA cards, USD files"
        wrapped(layout, context, text, "BLANK1")
    if engine_environment.needs_network(engine_link.engine_folder()) and not bpy.app.online_access:
        wrapped(layout, context, "The set-up fetches Python packages; Blender is offline", "INTERNET_OFFLINE")
        layout.prop(context.preferences.system, "use_online_access")
    column = layout.column(align=True)
    column.operator("drgs.engine_setup", icon="IMPORT")
    column.operator("drgs.engine_choose", icon="FILE_FOLDER")
