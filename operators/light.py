"""Choose Light: an HDRI becomes the World, with a Mapping node to turn it."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import FloatProperty, StringProperty

from ..addon import blend_paths
from ..addon.world_setup import choose_light, nodes_of
from .base import DrgsOperator, DropTarget

SUFFIXES = (".hdr", ".exr")


class DRGS_OT_choose_light(DrgsOperator, bpy.types.Operator):
    """Light the scene by an HDR image all around it"""

    bl_idname = "drgs.choose_light"
    bl_label = "Choose Light"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(
        name="Image",
        description="Equirectangular image, EXR or HDR",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    filter_glob: StringProperty(default="*.exr;*.hdr", options={"HIDDEN"})
    rotation: FloatProperty(
        name="Rotation",
        description="Turn of the light about the vertical axis, in degrees",
        subtype="ANGLE",
        default=0.0,
        options={"SKIP_SAVE"},
    )
    strength: FloatProperty(
        name="Strength",
        description="Factor on the light; 1 is as in the image",
        min=0.0,
        soft_max=10.0,
        default=1.0,
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.filepath:  # dropped, or chosen from the menu
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.path.abspath(self.chosen("Light")))
        given = self.properties.is_property_set
        if (now := nodes_of(context.scene.world)) is not None:  # another image, turned and as strong as the last
            if not given("rotation"):
                self.rotation = now[1].inputs["Rotation"].default_value[2]
            if not given("strength"):
                self.strength = now[2].inputs["Strength"].default_value
        choose_light(context.scene, path, self.rotation, self.strength)
        return {"FINISHED"}


class DRGS_MT_lights(bpy.types.Menu):
    """Images that light the scene: those that come with Blender or were added to it, and files"""

    bl_idname = "DRGS_MT_lights"
    bl_label = "Choose Light"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        for light in sorted(context.preferences.studio_lights, key=lambda s: s.name):
            if light.type == "WORLD" and light.path:
                name = bpy.path.display_name(light.name)
                layout.operator("drgs.choose_light", text=name, icon="WORLD").filepath = light.path
        layout.separator()
        layout.operator("drgs.choose_light", text="Open...", icon="FILE_FOLDER")


class DRGS_FH_light(DropTarget, bpy.types.FileHandler):
    """Drop an HDR image on the viewport."""

    bl_idname = "DRGS_FH_light"
    bl_label = "Light of the scene (DR-GS)"
    bl_import_operator = "drgs.choose_light"
    bl_file_extensions = ";".join(SUFFIXES)
    areas = ("VIEW_3D",)


CLASSES = (DRGS_OT_choose_light, DRGS_MT_lights, DRGS_FH_light)
