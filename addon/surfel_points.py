"""Surfels as points that Blender's own tools select and delete: a mesh of vertices says which surfels are left."""

from __future__ import annotations

import random

import bpy
import numpy as np

from ..drgs_blender.core.asset import Asset
from ..drgs_blender.core.errors import AssetError, UsageError

Array = np.ndarray

#: Attribute with the number of the surfel that each point is. As a property of the mesh: the surfels that were removed
#: before these points were edited, until Finish.
SURFEL = "drgs_surfel"
#: Attribute and property with a number of all points of a mesh, by which others that are joined to them are known.
SET = "drgs_points"


def new_points(name: str, rows: Array, places: Array) -> bpy.types.Mesh:
    """A mesh of points at (n, 3) `places`, object space, that are the surfels `rows`, (n,) int32."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(rows))
    if len(rows):
        mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(places, np.float32).ravel())
    mesh[SET] = random.SystemRandom().randrange(1, 1 << 31)
    for attribute, values in ((SURFEL, rows), (SET, np.full(len(rows), mesh[SET]))):
        mesh.attributes.new(attribute, "INT", "POINT").data.foreach_set("value", values.astype(np.int32))
    mesh.update()
    return mesh


def rows_of(mesh: bpy.types.Mesh, number: int | None = None) -> Array | None:
    """(n,) int32 surfels that the points of a mesh are, -1 of others; None where it does not know.

    Parameters
    ----------
    mesh : bpy.types.Mesh
        Not one in Edit Mode: that shows none of its attributes.
    number : int, optional
        Of its points; by default what the mesh says. 0: any.
    """
    rows = _integers(mesh, SURFEL)
    number = mesh.get(SET, 0) if number is None else number
    if rows is None or not number:
        return rows
    own = _integers(mesh, SET)
    return rows if own is None else np.where(own == number, rows, -1).astype(np.int32)


def read_points(points: bpy.types.Object) -> tuple[Array, Array]:
    """(n,) int32 surfels that the points of an object are, -1 of others, and (n,) bool: which of them are selected.

    In Edit Mode, what Blender has written back: call `update_from_editmode` before.

    Raises
    ------
    UsageError
        They do not know what they are; names the object.
    """
    written = points.to_mesh()  # the mesh in Edit Mode shows no attributes
    try:
        rows, selected = rows_of(written, points.data.get(SET, 0)), read_selection(written)
    finally:
        points.to_mesh_clear()
    if rows is None:
        raise UsageError(f'Object "{points.name}"', "has points that are no surfels", "Undo the edit")
    return rows, selected


def read_selection(mesh: bpy.types.Mesh) -> Array:
    """(n,) bool: which vertices of a mesh are selected."""
    selected, attribute = np.zeros(len(mesh.vertices), bool), mesh.attributes.get(".select_vert")
    if mesh.is_editmode:
        mesh.vertices.foreach_get("select", selected)
    elif attribute is not None:  # else none is
        attribute.data.foreach_get("value", selected)
    return selected


def _integers(mesh: bpy.types.Mesh, name: str) -> Array | None:
    attribute = mesh.attributes.get(name)
    if attribute is None or (attribute.data_type, attribute.domain) != ("INT", "POINT"):
        return None
    values = np.empty(len(mesh.vertices), np.int32)
    if len(values):
        attribute.data.foreach_get("value", values)
    return values


def state_of(obj: bpy.types.Object) -> tuple[int, int]:
    """What changes when surfels of an object are removed or brought back; for keys of caches."""
    mesh = obj.original.drgs.surfel_points
    return (0, -1) if mesh is None else (mesh.session_uid, len(mesh.vertices))


def objects_of(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """Objects of points that are surfels of a DR-GS object: those that count first, then copies."""
    mesh = obj.drgs.surfel_points
    return sorted((o for o in bpy.data.objects if o.drgs.points_of == obj), key=lambda o: o.data != mesh)


def is_unfinished(obj: bpy.types.Object) -> bool:
    """Whether surfels of an object were edited as points without Finish."""
    mesh = obj.drgs.surfel_points
    return mesh is not None and SURFEL in mesh and not _is_anothers(obj, mesh)


def check_finished(obj: bpy.types.Object) -> None:
    """UsageError where the surfels of an object are still edited; names it."""
    if is_unfinished(obj):
        raise UsageError(
            f'Object "{obj.name}"', "has surfels that are still edited as points",
            "Press Finish in sidebar > DR-GS > Clean",
        )  # fmt: skip


def left_of(obj: bpy.types.Object, asset: Asset, depsgraph: bpy.types.Depsgraph | None = None) -> Array | None:
    """(n,) int32 surfels of its asset, in order, that an object has; None: all.

    Parameters
    ----------
    obj : bpy.types.Object
    asset : Asset
    depsgraph : bpy.types.Depsgraph, optional
        While points are edited, those that this shows count; else those that Blender has written back.

    Raises
    ------
    AssetError
        The points are those of another asset; names the object.
    """
    mesh = obj.original.drgs.surfel_points
    if mesh is None:
        return None
    count = len(asset.surfels)
    if SURFEL in mesh and _is_anothers(obj.original, mesh):  # a copy made meanwhile
        gone = np.array(mesh[SURFEL], np.int64)
        return np.delete(np.arange(count, dtype=np.int32), gone[gone < count])
    rows = _rows_now(mesh, depsgraph)
    if rows is None or (len(rows) and rows.max() >= count):
        raise AssetError(
            f'Object "{obj.name}"', f'its points "{mesh.name}" are not of the {count} surfels of its asset',
            "Press Restore Surfels in sidebar > DR-GS > Clean",
        )  # fmt: skip
    return np.unique(rows[rows >= 0])


def removed_of(obj: bpy.types.Object, asset: Asset, depsgraph: bpy.types.Depsgraph | None = None) -> Array | None:
    """(k,) int32 surfels of its asset that an object lacks; None: none. As `left_of`, which has the error, too."""
    left = left_of(obj, asset, depsgraph)
    gone = None if left is None else lacking(left, len(asset.surfels))
    return gone if gone is not None and len(gone) else None


def lacking(left: Array, count: int) -> Array:
    """(k,) int32 of `count` surfels, those that are not among the surfels `left`, (n,) int."""
    gone = np.ones(count, bool)
    gone[left] = False
    return np.flatnonzero(gone).astype(np.int32)


def _is_anothers(obj: bpy.types.Object, mesh: bpy.types.Mesh) -> bool:
    """Whether a mesh of points is edited for another object, of which `obj` is a copy."""
    owners = [o.drgs.points_of for o in bpy.data.objects if o.data == mesh]
    return any(owners) and obj not in owners


def _rows_now(mesh: bpy.types.Mesh, depsgraph: bpy.types.Depsgraph | None) -> Array | None:
    """What `rows_of` says, also while points are edited: then a converted copy of the object has the attributes."""
    if not mesh.is_editmode:
        return rows_of(mesh)
    points = next(o for o in bpy.data.objects if o.data == mesh and o.mode == "EDIT")
    shown = points if depsgraph is None else points.evaluated_get(depsgraph)
    try:
        return rows_of(shown.to_mesh(), mesh.get(SET, 0))
    finally:
        shown.to_mesh_clear()
