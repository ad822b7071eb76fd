"""The first panel of the DR-GS tab: every step from a file to a picture, with the buttons that take it."""

from __future__ import annotations

import textwrap

import bpy

from .. import engine_link, engine_setup, lighting, reconstruction, setup_job, tour
from ..viewport import views

#: Pixels of a letter, about, at a scale of 1.
LETTER = 7.5
#: Pixels of a panel that pops up, at a scale of 1.
POPOVER = 400


def wrapped(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE") -> None:
    """A text in as many lines as the region needs."""
    column = layout.column(align=True)
    for i, line in enumerate(textwrap.wrap(text, _letters(context), break_on_hyphens=False)):
        column.label(text=line, icon="BLANK1" if i and icon != "NONE" else icon)


def _letters(context: bpy.types.Context) -> int:
    """Letters that fit into a line of the region; what pops up from a header has a width of its own."""
    region, scale = context.region, context.preferences.system.ui_scale or 1
    width = POPOVER * scale if region and region.type == "HEADER" else region.width if region else 240
    return max(24, int(width / (LETTER * scale)) - 4)


def bar_text(
    layout: bpy.types.UILayout, context: bpy.types.Context, text: str, part: float, percent: bool = True
) -> str:
    """What a progress bar says: `text`, followed by a number where `percent` asks for it.

    Where the region is too narrow, the text is written above the bar, which says the number alone.
    """
    number = f"{part:.0%}"
    said = f"{text}  {number}" if percent else text
    if len(said) <= _letters(context):
        return said
    wrapped(layout, context, text)
    return number


def draw_engine(layout: bpy.types.UILayout, context: bpy.types.Context, always: bool = False) -> None:
    """Set-up of the engine: its buttons where there is none (or `always`), or how far it is."""
    if setup_job.running():
        job = setup_job.job
        layout.progress(text=bar_text(layout, context, job.text, job.fraction), factor=job.fraction)
        layout.operator("drgs.engine_setup_cancel", icon="CANCEL")
        return
    if not engine_link.problem() and not always:
        return
    if setup_job.job is not None and setup_job.job.error is not None:
        wrapped(layout, context, str(setup_job.job.error), "ERROR")
    if engine_setup.needs_network(engine_link.own_folder()) and not bpy.app.online_access:
        wrapped(layout, context, "The set-up fetches Python packages; Blender is offline", "INTERNET_OFFLINE")
        layout.prop(context.preferences.system, "use_online_access")
    column = layout.column(align=True)
    column.operator("drgs.engine_setup", icon="IMPORT")
    column.operator("drgs.engine_choose", icon="FILE_FOLDER")


def _import(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    row = layout.row(align=True)
    row.operator("import_scene.drgs", text="Import", icon="IMPORT")
    row.operator("drgs.import_parts", text="Make", icon="FILE_NEW")
    if tour.target(context) is not None:
        row.operator("drgs.mark_assets", text="", icon="ASSET_MANAGER")
    job = reconstruction.job
    if job is None:
        layout.operator("drgs.reconstruct", text="From Photographs", icon="CAMERA_DATA")
        return
    if icon := job.icon():
        layout.template_icon(icon, scale=8.0)
    layout.progress(text=bar_text(layout, context, job.text, job.part), factor=job.part)
    layout.operator("drgs.reconstruct_cancel", icon="CANCEL")


def _bind(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    if tour.target(context) is None:
        return
    grid = layout.grid_flow(columns=2, align=True, even_columns=True)
    grid.operator("drgs.bind_to_rig", text="Rigged Mesh", icon="OUTLINER_OB_ARMATURE")
    grid.operator("drgs.bind_to_armature", text="Armature", icon="ARMATURE_DATA")
    grid.operator("drgs.bind_to_lattice", text="Lattice", icon="LATTICE_DATA")
    grid.operator("drgs.bind_to_cage", text="Cage", icon="MESH_ICOSPHERE")


def _pose(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    obj = tour.target(context)
    if context.mode != "OBJECT":
        layout.operator("object.mode_set", text="Back to Object Mode", icon="OBJECT_DATAMODE").mode = "OBJECT"
    elif obj is not None and tour.poser_of(obj) is not None:
        layout.operator("drgs.pose", icon="POSE_HLT")


def _light(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    layout.menu("DRGS_MT_lights", icon="WORLD")
    nodes = lighting.nodes_of(context.scene.world)
    if nodes is not None:
        _, mapping, background = nodes
        column = layout.column(align=True)
        column.prop(mapping.inputs["Rotation"], "default_value", index=2, text="Rotation")
        column.prop(background.inputs["Strength"], "default_value", text="Strength")


def _view(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    layout.operator("drgs.show_rendered", icon="SHADING_RENDERED")
    phase, part = views.preparation()
    if phase:
        layout.progress(text=bar_text(layout, context, phase, part), factor=part)
    layout.row().prop(context.scene.drgs, "overlay", expand=True)


def _render(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    if context.scene.camera is None:
        layout.operator("drgs.add_camera", icon="OUTLINER_OB_CAMERA")
        return
    row = layout.row(align=True)
    row.popover("DRGS_PT_presets", text="Quality", icon="PRESET")
    row.operator_context = "INVOKE_DEFAULT"
    row.operator("render.render", text="Render", icon="RENDER_STILL").use_viewport = True


#: Key of a step -> what draws its buttons.
BUTTONS = {
    "engine": draw_engine,
    "import": _import,
    "bind": _bind,
    "pose": _pose,
    "light": _light,
    "view": _view,
    "render": _render,
}


class DRGS_PT_tour(bpy.types.Panel):
    bl_label = "Steps"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "DR-GS"

    def draw(self, context: bpy.types.Context) -> None:
        found = tour.steps(context)
        following = tour.next_step(found)
        for step in found:
            layout = self.layout.box() if step is following else self.layout.column()
            icon = "CHECKMARK" if step.done else "PLAY" if step is following else "RADIOBUT_OFF"
            layout.label(text=step.label, icon=icon)
            if step.text and (step is following or step.done):
                wrapped(layout, context, step.text, "BLANK1")
            BUTTONS[step.key](layout, context)


CLASSES = (DRGS_PT_tour,)
