"""DR-GS over the picture of Cycles or EEVEE: the second scene and the nodes of it."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty

from ..addon import assets, compositing
from ..drgs_blender.core.errors import UsageError
from .base import DrgsOperator


class DRGS_OT_set_up_compositing(DrgsOperator, bpy.types.Operator):
    """Render DR-GS objects with DR-GS and everything else with this scene's engine, in one picture: adds a second scene
    that shares all objects, and compositor nodes. Press it again after adding objects outside of collections"""

    bl_idname = "drgs.set_up_compositing"
    bl_label = "Set Up Compositing"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    shadows: EnumProperty(
        name="Shadows",
        description="Who renders the shadows of DR-GS objects on other objects",
        items=(
            ("CATCHER", "DR-GS", "DR-GS, as a dark veil over the other engine's picture"),
            (
                "HOLDOUT",
                "Cycles",
                "Cycles, which also reflects the meshes of DR-GS objects and has light bounce off them",
            ),
        ),
        default="CATCHER",
    )
    compare: BoolProperty(
        name="Compare Depths",
        description="Also hide DR-GS objects behind what only the other engine renders: volumes, displacement. "
        "Their edges are not smooth",
        default=False,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("Go to Object Mode")
            return False
        if context.scene.render.engine == "DRGS":
            cls.poll_message_set("Choose Cycles or EEVEE as render engine, which renders all other objects")
            return False
        return True

    def run(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        subject = f'Scene "{scene.name}"'
        if not scene.is_editable:
            raise UsageError(subject, "comes from a library and cannot be changed here", "Make it local")
        if not any(map(assets.is_drgs, scene.objects)):
            raise UsageError(subject, "has no DR-GS object", "Import one, or link it into a collection of the scene")
        if scene.camera is None:
            raise UsageError(subject, "has no camera", "Add a camera, or make one active with Ctrl 0")
        if self.shadows == "HOLDOUT" and scene.render.engine != "CYCLES":
            raise UsageError("Shadows", "by Cycles need Cycles as render engine", "Choose Shadows: DR-GS")
        partner = compositing.set_up(scene, context.view_layer, self.shadows, self.compare)
        self.report({"INFO"}, f'F12 renders "{scene.name}" and "{partner.name}" together')
        return {"FINISHED"}


class DRGS_OT_clear_compositing(DrgsOperator, bpy.types.Operator):
    """Take back what Set Up Compositing made: the second scene and the nodes"""

    bl_idname = "drgs.clear_compositing"
    bl_label = "Remove Compositing"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if compositing.partner_of(context.scene) is None and not compositing.bereft(context.scene):
            cls.poll_message_set("DR-GS is not composited over this scene")
            return False
        cls.poll_message_set("Go to Object Mode")
        return context.mode == "OBJECT"

    def run(self, context: bpy.types.Context) -> set[str]:
        compositing.clear(context.scene)
        return {"FINISHED"}


CLASSES = (DRGS_OT_set_up_compositing, DRGS_OT_clear_compositing)
