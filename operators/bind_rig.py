"""Transfer Rig: the weights and shape keys of a rigged mesh, carried over to a DR-GS object at the same place."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import bpy
import numpy as np

from ..addon import assets
from ..drgs_blender.core.asset import Mesh
from ..drgs_blender.core.errors import AssetError, UsageError
from . import selection
from .base import DrgsOperator
from .nearest_surface import Match, Source, by_numbers, nearest, source_of
from .shape_keys import transfer_shape_keys
from .vertex_weights import Weights, read_weights, write_weights

Array = np.ndarray

#: Mean distance between the surfaces, as a part of the source's diagonal, above which it is refused.
WRONG = 0.2
#: Distance of a vertex, as such a part, above which it is off the surface, and part of the vertices from which on the
#: user is warned: the others may fit well while an arm is elsewhere.
OFF, DOUBTFUL = 0.005, 0.02


class DRGS_OT_bind_to_rig(DrgsOperator, bpy.types.Operator):
    """Let the selected DR-GS objects follow the rig of the other selected meshes: copy their weights and shape keys"""

    bl_idname = "drgs.bind_to_rig"
    bl_label = "Transfer Rig"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT" or not assets.is_drgs(context.active_object):
            cls.poll_message_set("Select the rigged meshes, then a DR-GS object, in Object Mode")
            return False
        return True

    def run(self, context: bpy.types.Context) -> set[str]:
        active = context.active_object
        sources = [o for o in context.selected_objects if o is not active and o.type == "MESH"]
        objects = [active]
        if not all(map(assets.is_drgs, sources)):  # else one DR-GS object takes the rig of others
            objects = selection.selected(context)
            sources = [o for o in sources if not assets.is_drgs(o)]
        for target in selection.editable(objects, data=True):
            off = bind_to_rig(context, target, sources)
            if off > DOUBTFUL:
                self.warn(
                    f'{off:.0%} of the vertices of "{target.name}" lie more than {OFF:.1%} of its size away from the '
                    "meshes it was bound to, and may bend wrongly. Undo, move it onto them at rest, bind again"
                )
        return {"FINISHED"}


def bind_to_rig(context: bpy.types.Context, target: bpy.types.Object, sources: list[bpy.types.Object]) -> float:
    """Make `target` follow the armature and shape keys of `sources`, which it must coincide with at rest.

    Each vertex takes what the nearest point of the sources has: vertex weights interpolated over the triangle (exact
    where a vertex coincides), all of one bone where the source is parented to a bone, and shape key offsets.

    Returns
    -------
    float
        Part of the vertices that are off the surface of the sources.

    Raises
    ------
    UsageError
        No usable source, several armatures, an object that is scaled to nothing, or they do not coincide.
    """
    if not sources:
        raise UsageError(
            f'Object "{target.name}"',
            "there is no other mesh selected to take the rig from",
            "Select the rigged meshes first and the DR-GS object last",
        )
    armature = armature_of(target.name, sources)
    for obj in filter(None, (target, armature)):
        selection.check_size(obj)
    with rest_pose(context, armature):
        places = [source_of(o) for o in sources]
        matrix = np.array(target.matrix_world, np.float64)
        armature_matrix = armature.matrix_world.copy() if armature else None
    points = selection.world_vertices(target)
    match = by_numbers(points, _rest(target), places) or nearest(points, places)
    everything = np.concatenate([s.vertices for s in places])
    away = match.distance / max(float(np.linalg.norm(np.ptp(everything, axis=0))), 1e-12)
    if (distance := float(away.mean())) > WRONG:
        raise UsageError(
            f'Object "{target.name}"',
            f"lies {distance:.0%} of their size away from the selected meshes",
            "Move it onto them in their rest pose, then bind again",
        )
    if armature is not None:
        write_weights(target, _weights(places, match, armature))
        _attach(target, armature, armature_matrix, sources)
    transfer_shape_keys(target, matrix, [(s.object, s.matrix) for s in places], match)
    return float((away > OFF).mean())


def _rest(target: bpy.types.Object) -> Mesh:
    """The mesh of the asset; without its file one that is made of no other."""
    try:
        return assets.load(assets.file_of(target)).mesh
    except AssetError:
        return Mesh.empty()


def armature_of(name: str, sources: list[bpy.types.Object]) -> bpy.types.Object | None:
    """The armature that moves the sources; None when shape keys alone do."""
    found = {a for a in map(armature_over, sources) if a is not None}
    if len(found) > 1:
        names = ", ".join(sorted(f'"{a.name}"' for a in found))
        raise UsageError(f'Object "{name}"', f"the selected meshes follow several armatures: {names}", "Bind to one")
    if not found and not any(s.data.shape_keys for s in sources):
        raise UsageError(
            f'Object "{name}"', "none of the selected meshes has an armature or shape keys", "Select the rigged meshes"
        )
    return found.pop() if found else None


def armature_over(obj: bpy.types.Object) -> bpy.types.Object | None:
    """Armature by modifier or parenting, through parents."""
    if (found := obj.find_armature()) is not None:
        return found
    parent = obj.parent
    while parent is not None and parent.type != "ARMATURE":
        parent = parent.parent
    return parent


@contextlib.contextmanager
def rest_pose(context: bpy.types.Context, armature: bpy.types.Object | None) -> Iterator[None]:
    """Show the armature in its rest pose for a while."""
    if armature is None:
        yield
        return
    before = armature.data.pose_position
    armature.data.pose_position = "REST"
    context.view_layer.update()
    try:
        yield
    finally:
        armature.data.pose_position = before
        context.view_layer.update()


def _weights(sources: list[Source], match: Match, armature: bpy.types.Object) -> Weights:
    """Weights of each target vertex for the armature's bones."""
    bones = [b.name for b in armature.data.bones]
    index = {name: i for i, name in enumerate(bones)}
    parts = []
    for number, source in enumerate(sources):
        rows = np.flatnonzero(match.source == number)
        if not len(rows):
            continue
        own = read_weights(source.object, index)
        parts.append(own.interpolated(match.corners[rows], match.barycentric[rows], rows))
    return Weights.joined(bones, parts)


def _attach(
    target: bpy.types.Object, armature: bpy.types.Object, matrix: bpy.types.Matrix, sources: list[bpy.types.Object]
) -> None:
    """Parent to the armature without moving, and deform by it, before all other modifiers."""
    world = target.matrix_world.copy()
    target.parent, target.parent_type = armature, "OBJECT"
    target.matrix_parent_inverse = matrix.inverted()
    target.matrix_world = world
    modifier = next((m for m in target.modifiers if m.type == "ARMATURE"), None)
    if modifier is None:
        modifier = target.modifiers.new("Armature", "ARMATURE")
        target.modifiers.move(len(target.modifiers) - 1, 0)
    modifier.object = armature
    modifier.use_deform_preserve_volume = any(
        m.type == "ARMATURE" and m.use_deform_preserve_volume for s in sources for m in s.modifiers
    )


CLASSES = (DRGS_OT_bind_to_rig,)
