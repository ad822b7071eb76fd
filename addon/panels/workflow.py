"""The first panel of the DR-GS tab: every step from a file to a picture, with the buttons that take it."""

from __future__ import annotations

from pathlib import Path

import bpy

from .. import assets, reconstruction, running, workflow, world_setup
from ..viewport import views
from .engine_setup import draw_engine
from .render import draw_detail
from .text_layout import bar_text, wrapped


def _running(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What commands do beside the window, and how to end them."""
    for index, command in enumerate(running.commands):
        box = layout.box()
        if command.part is None:
            wrapped(box, context, command.shown(), "SORTTIME")
        else:
            box.progress(text=bar_text(box, context, command.shown(), command.part), factor=command.part)
        box.operator("drgs.cancel_command", icon="CANCEL").index = index


def _import(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    row = layout.row(align=True)
    row.operator("drgs.import_parts", text="Import", icon="IMPORT").browse = True
    row.operator("drgs.import_parts", text="Make Asset", icon="FILE_NEW")
    if workflow.target(context) is not None:
        row.operator("drgs.mark_assets", text="", icon="ASSET_MANAGER")
    job = reconstruction.job
    if job is None:
        row = layout.row(align=True)
        row.operator("drgs.reconstruct", text="From Photographs", icon="CAMERA_DATA")
        row.operator("drgs.print_markers", text="", icon="FILE_BLANK")
        _made(layout, context)
        return
    if icon := job.icon():
        layout.template_icon(icon, scale=8.0)
    layout.progress(text=bar_text(layout, context, job.text, job.part), factor=job.part)
    layout.operator("drgs.reconstruct_cancel", icon="CANCEL")


def _made(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """How the last reconstruction went, while its object is the one that the workflow is about."""
    made, obj = reconstruction.made, workflow.target(context)
    if made is None or obj is None or Path(bpy.path.abspath(obj.drgs.asset.filepath)) != made.out:
        return
    row = layout.row(align=True)
    for title, file in made.pictures.items():
        row.operator("drgs.reconstruct_show", text=f"Show {title}", icon="IMAGE_DATA").filepath = str(file)
    for text in made.doubts:
        wrapped(layout, context, text, "ERROR")


def _bind(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    obj = workflow.target(context)
    if obj is None:
        return
    if not len(obj.data.vertices):
        layout.operator("drgs.add_proxy", icon="MESH_ICOSPHERE")
        return
    grid = layout.grid_flow(columns=2, align=True, even_columns=True)
    grid.operator("drgs.bind_to_rig", text="Transfer Rig", icon="OUTLINER_OB_ARMATURE")
    grid.operator("drgs.bind_to_armature", text="Armature", icon="ARMATURE_DATA")
    grid.operator("drgs.bind_to_lattice", text="Lattice", icon="LATTICE_DATA")
    grid.operator("drgs.bind_to_cage", text="Cage", icon="MESH_ICOSPHERE")
    layout.operator("drgs.drive_from", icon="MOD_MESHDEFORM")


def _pose(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    obj = workflow.target(context)
    if context.mode != "OBJECT":
        layout.operator("object.mode_set", text="Back to Object Mode", icon="OBJECT_DATAMODE").mode = "OBJECT"
    elif obj is not None and workflow.poser_of(obj) is not None:
        layout.operator("drgs.pose", icon="POSE_HLT")


def _light(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    layout.menu("DRGS_MT_lights", icon="WORLD")
    nodes = world_setup.nodes_of(context.scene.world)
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
    column = layout.column(align=True)
    column.label(text="Viewport Display")
    column.row(align=True).prop(context.scene.drgs, "overlay", expand=True)
    obj = context.object
    if context.scene.drgs.overlay == "SURFELS" and context.mode == "EDIT_MESH" and obj is not None:
        if assets.is_drgs(obj):
            wrapped(column, context, "Splats are shown as edited, behind the vertices of their mesh", "INFO")
        elif assets.is_drgs(owner := obj.drgs.points_of):
            wrapped(column, context, f"Points are the splats of {owner.name}, which are shown behind them", "INFO")
    if context.scene.drgs.overlay != "OFF":
        draw_detail(layout.column(align=True), context.scene.drgs, expand=True)


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


class DRGS_PT_workflow(bpy.types.Panel):
    bl_label = "Workflow"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "DR-GS"

    def draw(self, context: bpy.types.Context) -> None:
        _running(self.layout, context)
        found = workflow.steps(context)
        following = workflow.next_step(found)
        for step in found:
            layout = self.layout.box() if step is following else self.layout.column()
            icon = "CHECKMARK" if step.done else "PLAY" if step is following else "RADIOBUT_OFF"
            layout.label(text=step.label, icon=icon)
            if step.text and (step is following or step.done):
                wrapped(layout, context, step.text, "BLANK1")
            BUTTONS[step.key](layout, context)


CLASSES = (DRGS_PT_workflow,)
