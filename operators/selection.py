"""The objects that operators work on: selected DR-GS objects that may be changed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ..addon import assets, mesh_arrays
from ..drgs_blender.core.errors import UsageError

Array = np.ndarray

#: Metres from the origin, squares of which single precision still holds.
FARTHEST = 1e15


def selected(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The selected DR-GS objects and the active one, the active one last."""
    chosen = [o for o in context.selected_objects if assets.is_drgs(o) and o is not context.active_object]
    return [*chosen, context.active_object] if assets.is_drgs(context.active_object) else chosen


def editable(
    objects: Iterable[bpy.types.Object], *, vertices: bool = True, data: bool = False
) -> list[bpy.types.Object]:
    """`objects` as a list, when all may be changed, with their meshes (`data`), and have `vertices`.

    Raises
    ------
    UsageError
        One comes from a library, or has no vertices; names it. Or there is none.
    """
    found = list(objects)
    for obj in found:
        if not obj.is_editable or (data and not obj.data.is_editable):
            raise UsageError(
                f'Object "{obj.name}"',
                "comes from a library and cannot be changed here",
                "Choose Object > Relations > Make Local" + ("" if data else ", or Library Override > Make"),
            )
        if vertices and not len(obj.data.vertices):
            raise UsageError(
                f'Object "{obj.name}"',
                "has surfels but no mesh that could be bent",
                "Choose Add Proxy Mesh (sidebar > DR-GS > Workflow > Bind), or move it as a whole",
            )
    if not found:
        raise UsageError("Selection", "holds no DR-GS object", "Select one or several")
    return found


def own_mesh(obj: bpy.types.Object) -> None:
    """Give an object a mesh of its own where it shares that with others, or has that of a library."""
    if obj.data.users - obj.data.use_fake_user > 1 or not obj.data.is_editable:
        obj.data = obj.data.copy()


def bounds(objects: Iterable[bpy.types.Object]) -> tuple[Array, Array]:
    """Lowest and highest corner, (3,) float64 metres in the world, of undeformed meshes."""
    points = np.concatenate([world_vertices(o) for o in objects])
    return points.min(axis=0), points.max(axis=0)


def world_vertices(obj: bpy.types.Object) -> Array:
    """(n, 3) float64 undeformed vertices in the world; see `in_world` for the error."""
    return in_world(obj, mesh_arrays.read_vertices(obj.data))


def in_world(obj: bpy.types.Object, points: Array) -> Array:
    """(n, 3) float64 in the world, of (n, 3) points of `obj`.

    Raises
    ------
    UsageError
        One is nowhere.
    """
    matrix = np.array(obj.matrix_world, np.float64)
    placed = points @ matrix[:3, :3].T + matrix[:3, 3]
    lost = np.count_nonzero(~(np.abs(placed) < FARTHEST).all(axis=1))
    if lost:
        raise UsageError(
            f'Object "{obj.name}"',
            f"has {lost} vertices that are not finite or too far away",
            "Correct them, its transform and the drivers of that",
        )
    return placed


def check_size(obj: bpy.types.Object) -> None:
    """UsageError where `obj` has no volume to be bent in, as its scale is zero along an axis."""
    if not abs(obj.matrix_world.to_3x3().determinant()) > 1e-30:
        raise UsageError(f'Object "{obj.name}"', "is scaled to nothing", "Give it a size, then bind it")


class ObjectMode:
    """Poll of operators that need Object Mode and a selected DR-GS object."""

    if TYPE_CHECKING:  # of Blender's Operator
        poll_message_set: Callable[[str], None]

    needs = "Select one or several DR-GS objects in Object Mode"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT" or not selected(context):
            cls.poll_message_set(cls.needs)
            return False
        return True


def add_modifier(obj: bpy.types.Object, kind: str, name: str, **values: object) -> bpy.types.Modifier:
    """A modifier with `values`; one of the same name is replaced."""
    if (old := obj.modifiers.get(name)) is not None:
        obj.modifiers.remove(old)
    modifier = obj.modifiers.new(name, kind)
    for key, value in values.items():
        setattr(modifier, key, value)
    return modifier


def select_only(context: bpy.types.Context, objects: Iterable[bpy.types.Object], active: bpy.types.Object) -> None:
    """Make `objects` the selection and `active` its active object."""
    for obj in context.selected_objects:
        obj.select_set(False)
    for obj in objects:
        obj.select_set(True)
    context.view_layer.objects.active = active


def remove_with_mesh(obj: bpy.types.Object) -> None:
    """Remove an object, then its mesh: Blender 4.2 has crashed where the mesh was taken from under its object."""
    mesh = obj.data
    bpy.data.objects.remove(obj)
    bpy.data.meshes.remove(mesh)


def of_type(objects: Iterable[bpy.types.Object], kind: str) -> Iterator[bpy.types.Object]:
    """The `objects` of a type that are no DR-GS objects."""
    return (o for o in objects if o.type == kind and not assets.is_drgs(o))
