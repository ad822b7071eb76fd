"""The small steps between import and picture: pose, look through DR-GS, add a camera."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import bpy
from mathutils import Matrix, Vector

from ..addon import assets
from ..addon.viewport.surfels import places_of
from ..addon.workflow import poser_of, target
from ..drgs_blender.core.errors import AssetError, UsageError
from . import selection
from .base import DrgsOperator

ENGINE = "DRGS"
#: How often, and after how many seconds each, a sidebar is asked whether it has tabs.
TRIES, PAUSE = 100, 0.05
#: Kind of object -> the mode in which it is posed.
MODES = {"ARMATURE": "POSE", "LATTICE": "EDIT", "MESH": "EDIT"}


class DRGS_OT_pose(DrgsOperator, bpy.types.Operator):
    """Go to what bends the active DR-GS object: its armature in Pose Mode, its lattice or cage in Edit Mode"""

    bl_idname = "drgs.pose"
    bl_label = "Pose"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT" or target(context) is None:
            cls.poll_message_set("There must be a DR-GS object, in Object Mode")
            return False
        return True

    def run(self, context: bpy.types.Context) -> set[str]:
        obj = target(context)
        assert obj is not None, "poll has looked"
        poser = poser_of(obj)
        if poser is None:
            raise UsageError(
                f'Object "{obj.name}"', "follows no armature, lattice or cage", "Bind it first, in sidebar > DR-GS"
            )
        if poser.name not in context.view_layer.objects or poser.hide_get():
            raise UsageError(f'Object "{poser.name}"', f'moves "{obj.name}" but is hidden', "Show it in the Outliner")
        if poser.library is not None:
            raise UsageError(
                f'Object "{poser.name}"', "comes from a library", "Choose Object > Library Override > Make"
            )
        selection.select_only(context, [poser], poser)
        bpy.ops.object.mode_set(mode=MODES[poser.type])
        return {"FINISHED"}


class DRGS_OT_show_rendered(DrgsOperator, bpy.types.Operator):
    """Make DR-GS the render engine of the scene and show this viewport as it renders"""

    bl_idname = "drgs.show_rendered"
    bl_label = "Show Rendered"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    def run(self, context: bpy.types.Context) -> set[str]:
        context.scene.render.engine = ENGINE
        if context.area is not None and context.area.type == "VIEW_3D":
            context.space_data.shading.type = "RENDERED"
        return {"FINISHED"}


class DRGS_OT_add_camera(DrgsOperator, bpy.types.Operator):
    """Add a camera that sees what this viewport sees, or all DR-GS objects from the front, and make it active"""

    bl_idname = "drgs.add_camera"
    bl_label = "Add Camera"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Go to Object Mode")
        return context.mode == "OBJECT"

    def run(self, context: bpy.types.Context) -> set[str]:
        camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
        assets.collection(context).objects.link(camera)
        context.scene.camera = camera
        view = context.region_data if context.area is not None and context.area.type == "VIEW_3D" else None
        if view is not None:
            camera.matrix_world = viewpoint(view)
        else:
            objects = [o for o in context.scene.objects if assets.is_drgs(o)]
            frame(context, camera, objects)
        return {"FINISHED"}


def viewpoint(view: bpy.types.RegionView3D) -> Matrix:
    """Camera-to-world matrix of a viewport; Blender has orthographic ones stand in what they look at."""
    back = view.view_distance if view.view_perspective == "ORTHO" else 0.0
    return view.view_matrix.inverted() @ Matrix.Translation((0, 0, back))


def frame(context: bpy.types.Context, camera: bpy.types.Object, objects: list[bpy.types.Object]) -> None:
    """Put `camera` in front (-Y) of `objects` so that they fill its picture."""
    camera.rotation_euler = (1.5707963, 0, 0)
    context.view_layer.update()
    depsgraph = context.evaluated_depsgraph_get()
    corners = [o.matrix_world @ Vector(c) for o in objects for c in _box_of(o, depsgraph)]
    if not corners:
        camera.location = (0, -5, 0)
        return
    camera.location, _ = camera.camera_fit_coords(depsgraph, [x for c in corners for x in c])
    middle = sum(corners, Vector()) / len(corners)
    camera.location = middle + (camera.location - middle) * 1.1


def _box_of(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Iterable[Iterable[float]]:
    """Corners of the box around an object, its space; of one without a mesh around its surfels, as they are posed."""
    try:
        if len(assets.load(assets.file_of(obj)).mesh.vertices):
            return obj.bound_box
        places = places_of(obj, depsgraph)[1]
    except AssetError:  # reported when it is rendered
        return obj.bound_box
    return product(*zip(places.min(axis=0), places.max(axis=0))) if len(places) else ()


class DRGS_OT_show_sidebar(DrgsOperator, bpy.types.Operator):
    """Open the sidebar of this viewport (N) on the tab DR-GS"""

    bl_idname = "drgs.show_sidebar"
    bl_label = "DR-GS is in the sidebar (N)"
    bl_options = {"INTERNAL"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Press it in a 3D viewport")
        return context.area is not None and context.area.type == "VIEW_3D"

    def run(self, context: bpy.types.Context) -> set[str]:
        context.space_data.show_region_ui = True
        area, tries = context.area.as_pointer(), iter(range(TRIES))

        def turn() -> float | None:
            found = (a for w in bpy.context.window_manager.windows for a in w.screen.areas if a.as_pointer() == area)
            region = next((r for a in found for r in a.regions if r.type == "UI"), None)
            if region is None:
                return None
            try:
                region.active_panel_category = "DR-GS"
            except (AttributeError, TypeError):  # a sidebar has tabs once it was drawn
                return None if next(tries, None) is None else PAUSE
            region.tag_redraw()
            return None

        bpy.app.timers.register(turn, first_interval=0.0)
        return {"FINISHED"}


CLASSES = (DRGS_OT_show_sidebar, DRGS_OT_pose, DRGS_OT_show_rendered, DRGS_OT_add_camera)
