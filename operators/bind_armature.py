"""Bind to Armature: skinning with automatic weights of an existing armature, that leave no vertex behind."""

from __future__ import annotations

import bpy
import numpy as np

from ..drgs_blender.core.errors import UsageError
from . import selection
from .base import DrgsOperator
from .bind_rig import rest_pose
from .vertex_weights import Weights, read_weights, write_weights

Array = np.ndarray

#: Bones that move a vertex at most, as in most engines.
BONES = 4
#: How fast a bone's influence falls with the distance to it, where heat finds no way.
FALLOFF = 4


class DRGS_OT_bind_to_armature(DrgsOperator, selection.ObjectMode, bpy.types.Operator):
    """Let the selected DR-GS objects follow the selected armature with automatic weights"""

    bl_idname = "drgs.bind_to_armature"
    bl_label = "Automatic Weights"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender
    needs = "Select DR-GS objects and the armature that shall move them, in Object Mode"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not any(o.type == "ARMATURE" for o in context.selected_objects):
            cls.poll_message_set(cls.needs)
            return False
        return super().poll(context)

    def run(self, context: bpy.types.Context) -> set[str]:
        armatures = list(selection.of_type(context.selected_objects, "ARMATURE"))
        if len(armatures) != 1:
            raise UsageError("Selection", f"holds {len(armatures)} armatures", "Select one")
        objects = selection.editable(selection.selected(context), data=True)
        filled = bind_to_armature(context, objects, armatures[0])
        for name, share in filled.items():
            self.warn(
                f'"{name}": bone heat reached {1 - share:.0%} of the vertices; the others follow the bones nearby'
            )
        return {"FINISHED"}


def bind_to_armature(
    context: bpy.types.Context, objects: list[bpy.types.Object], armature: bpy.types.Object
) -> dict[str, float]:
    """Parent `objects` to `armature` and weight their vertices by Blender's bone heat.

    Heat spreads over the surface and finds no solution on open or torn parts, which captures have: vertices that it
    leaves without a weight follow the nearest bones.

    Returns
    -------
    dict
        Object name -> share of its vertices that heat did not reach, where there are any.

    Raises
    ------
    UsageError
        The armature has no deforming bone.
    """
    bones = [b for b in armature.data.bones if b.use_deform]
    if not bones:
        raise UsageError(f'Armature "{armature.name}"', "has no bone that deforms", "Switch on Deform of its bones")
    names = [b.name for b in bones]
    index = {name: i for i, name in enumerate(names)}
    filled = {}
    with rest_pose(context, armature):
        matrix = np.array(armature.matrix_world, np.float64)
        segments = np.array([(b.head_local, b.tail_local) for b in bones]) @ matrix[:3, :3].T + matrix[:3, 3]
        for obj in objects:
            for modifier in [m for m in obj.modifiers if m.type == "ARMATURE"]:
                obj.modifiers.remove(modifier)
            _heat(context, obj, armature)
            obj.modifiers.move(len(obj.modifiers) - 1, 0)
            weights = read_weights(obj, index)
            bare = np.flatnonzero(weights.totals(len(obj.data.vertices)) <= 1e-6)
            if len(bare):
                near = nearby(selection.world_vertices(obj)[bare], segments, bare)
                write_weights(obj, Weights.joined(names, [weights, near]))
                filled[obj.name] = len(bare) / len(obj.data.vertices)
    return filled


def _heat(context: bpy.types.Context, obj: bpy.types.Object, armature: bpy.types.Object) -> None:
    """Blender's own automatic weights; adds the modifier and the parent."""
    before = list(context.selected_objects), context.view_layer.objects.active
    selection.select_only(context, (obj, armature), armature)
    try:
        bpy.ops.object.parent_set(type="ARMATURE_AUTO")
    finally:
        selection.select_only(context, *before)


def nearby(points: Array, segments: Array, rows: Array) -> Weights:
    """Weights that fall with the distance to bones.

    Parameters
    ----------
    points : (n, 3) metres, world
    segments : (b, 2, 3) heads and tails, metres, world
    rows : (n,) the vertices these points are

    Returns
    -------
    Weights
        Of the `BONES` nearest bones, groups numbered as `segments`; they sum to one.
    """
    head, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    squared = np.maximum((along**2).sum(axis=1), 1e-24)
    distance = np.empty((len(points), len(segments)))
    for bone in range(len(segments)):
        t = np.clip((points - head[bone]) @ along[bone] / squared[bone], 0, 1)
        distance[:, bone] = np.linalg.norm(points - head[bone] - t[:, None] * along[bone], axis=1)
    kept = min(BONES, len(segments))
    near = np.argpartition(distance, kept - 1, axis=1)[:, :kept]
    d = np.take_along_axis(distance, near, axis=1)
    weight = (np.maximum(d.min(axis=1, keepdims=True), 1e-9) / np.maximum(d, 1e-9)) ** FALLOFF
    weight /= weight.sum(axis=1, keepdims=True)
    return Weights([], np.repeat(rows, kept), near.ravel(), weight.ravel())


CLASSES = (DRGS_OT_bind_to_armature,)
