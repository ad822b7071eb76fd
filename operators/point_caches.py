"""Play Point Cache: a DR-GS object plays the PC2 or MDD of the mesh that its asset was made from, or of its own."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..addon import assets, blend_paths, point_caches
from ..drgs_blender.core.asset import Mesh
from ..drgs_blender.core.errors import UsageError
from . import selection
from .engine_command import CommandOperator

_ORDERS = (
    ("AUTO", "Automatic", "As the number of vertices says"),
    ("ASSET", "This Mesh", "The vertices of this object"),
    ("SOURCE", "Original Mesh", "The vertices of the mesh that its asset was made from, in the file's axes and unit"),
)


class DRGS_OT_play_point_cache(CommandOperator, selection.ObjectMode, bpy.types.Operator):
    """Let the active DR-GS object play a point cache (PC2, MDD), also one of the mesh that its asset was made from"""

    bl_idname = "drgs.play_point_cache"
    bl_label = "Play Point Cache"
    bl_options = {"UNDO"}  # noqa: RUF012 - read by Blender

    filepath: StringProperty(
        description="The point cache", subtype="FILE_PATH", options={"SKIP_SAVE", *blend_paths.RELATIVE}
    )
    filter_glob: StringProperty(default="*.pc2;*.mdd", options={"HIDDEN"})
    vertex_order: EnumProperty(name="Vertices", description="What the cache moves", items=_ORDERS, default="AUTO")
    use_file_start: BoolProperty(
        name="Start at Its Frame", description="Play from the frame that the file names, else the first of the scene",
        default=True,
    )  # fmt: skip

    _name, _target = "", Path()
    _first = 1

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        obj = context.active_object
        if not assets.is_drgs(obj):
            raise UsageError("Play Point Cache", "the active object is no DR-GS object", "Select one")
        selection.editable([obj])
        subject = f'Object "{obj.name}"'
        path = Path(bpy.path.abspath(self.chosen(subject)))
        if not path.is_file():
            raise UsageError(str(path), "does not exist", "Choose a .pc2 or .mdd")
        found = point_caches.header_of(path)
        if found is None:
            raise UsageError(str(path), "is neither PC2 nor MDD", "Export the motion in one of these formats")
        asset = assets.file_of(obj)
        rest = assets.load(asset).mesh
        points, first = found
        self._name, self._first = obj.name, first if self.use_file_start else context.scene.frame_start
        left = len(obj.data.vertices)
        if left not in (points, len(rest.vertices)):
            problem = f"has {left} vertices left of {len(rest.vertices)}; {path.name} has {points}"
            raise UsageError(subject, problem, "Choose a cache of what is left, or import the asset again")
        order = self._order(rest, points, subject, path) if left == len(rest.vertices) else "ASSET"
        if order == "ASSET":
            self._target = path
            return self.done(context)
        self._target = _beside(path, obj)
        arguments = ["convert", str(asset), str(self._target), "--vertices", str(path), "--vertex-order", "source"]
        status, failure = f"Reading {path.name}", f"cannot play {path.name}"
        return self.start(context, arguments, subject, status, failure, [self._target])

    def done(self, context: bpy.types.Context) -> set[str]:
        obj = bpy.data.objects.get(self._name)
        if obj is None:
            raise UsageError(f'Object "{self._name}"', "is gone", "Undo what removed it")
        point_caches.attach(obj, self._target, self._first)
        return {"FINISHED"}

    def _order(self, rest: Mesh, points: int, subject: str, path: Path) -> str:
        """ASSET or SOURCE: what a cache of so many vertices moves."""
        own, fitting = len(rest.vertices), [order.upper() for order in rest.orders_of(points)]
        if not fitting or self.vertex_order not in ("AUTO", *fitting):
            made_from = "" if rest.source is None else f", the mesh it was made from {rest.source_count}"
            problem = f"has {own} vertices{made_from}; {path.name} has {points}"
            raise UsageError(subject, problem, "Choose another cache")
        if self.vertex_order != "AUTO":
            return self.vertex_order
        if len(fitting) > 1:
            problem = f"has {own} vertices as the mesh it was made from, in another order or unit"
            raise UsageError(subject, problem, "Choose This Mesh or Original Mesh under Vertices")
        return fitting[0]


def _beside(path: Path, obj: bpy.types.Object) -> Path:
    """Where the cache in the asset's order is written: beside the .blend, else beside the given one."""
    folder = Path(bpy.path.abspath("//")) if bpy.data.filepath else path.parent
    return folder / f"{path.stem}_{bpy.path.clean_name(obj.name)}.pc2"


CLASSES = (DRGS_OT_play_point_cache,)
