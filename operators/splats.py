"""Object > Convert: DR-GS objects as a point cloud of Blender's own splats."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..addon import splat_attributes
from .scene_frames import SceneFrames, draw_colour


class DRGS_OT_splats(SceneFrames, bpy.types.Operator):
    """Add a point cloud of Blender's own splats: the DR-GS objects as they are posed, painted and lit"""

    bl_idname = "drgs.splats"
    bl_label = "DR-GS to Splats"
    bl_options = {"UNDO"}  # noqa: RUF012 - read by Blender

    _splats: Path

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("This Blender makes no point clouds")
        return splat_attributes.can_write()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(self, "use_selection")
        draw_colour(layout, self)

    def run(self, context: bpy.types.Context) -> set[str]:
        with self.folder("drgs-splats-") as folder:
            self._splats = folder / "splats.ply"
            arguments = [*self.describe(context, self._splats, "splats"), "--up=z"]
        return self.start(context, arguments, "Splats", "Making splats", "could not be made", [self._splats])

    def done(self, context: bpy.types.Context) -> set[str]:
        splat_attributes.new_object(context, "Splats", splat_attributes.read_ply(self._splats))
        return {"FINISHED"}


CLASSES = (DRGS_OT_splats,)
