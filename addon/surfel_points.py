"""Surfels as points that Blender's own tools select and delete: a mesh of vertices says which surfels are left."""

from __future__ import annotations

import bpy
import numpy as np

from ..drgs_blender.core.asset import Asset
from ..drgs_blender.core.errors import AssetError

Array = np.ndarray

#: Attribute with the number of the surfel that each point is.
SURFEL = "drgs_surfel"


def new_points(name: str, rows: Array, places: Array) -> bpy.types.Mesh:
    """A mesh of points at (n, 3) `places`, object space, that are the surfels `rows`, (n,) int32."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(rows))
    if len(rows):
        mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(places, np.float32).ravel())
    mesh.attributes.new(SURFEL, "INT", "POINT").data.foreach_set("value", rows.astype(np.int32))
    mesh.update()
    return mesh


def rows_of(mesh: bpy.types.Mesh) -> Array | None:
    """(n,) int32 surfels that the points of a mesh are; None where it does not know."""
    attribute = mesh.attributes.get(SURFEL)
    if attribute is None or (attribute.data_type, attribute.domain) != ("INT", "POINT"):
        return None
    rows = np.empty(len(mesh.vertices), np.int32)
    if len(rows):
        attribute.data.foreach_get("value", rows)
    return rows


def state_of(obj: bpy.types.Object) -> tuple[int, int]:
    """What changes when surfels of an object are removed or brought back; for keys of caches."""
    mesh = obj.original.drgs.surfel_points
    return (0, -1) if mesh is None else (mesh.session_uid, len(mesh.vertices))


def removed_of(obj: bpy.types.Object, asset: Asset) -> Array | None:
    """(k,) int32 surfels of its asset that an object lacks; None: none. While points are edited, those of before.

    Raises
    ------
    AssetError
        The points are those of another asset; names the object.
    """
    mesh = obj.original.drgs.surfel_points
    if mesh is None:
        return None
    count = len(asset.surfels)
    if mesh.is_editmode:  # then its attributes have no data
        rows = np.array(mesh.get(SURFEL, ()), np.int32)
        left = np.delete(np.arange(count), rows[(rows >= 0) & (rows < count)])
    else:
        found = rows_of(mesh)
        if found is None or (len(found) and (found.min() < 0 or found.max() >= count)):
            raise AssetError(
                f'Object "{obj.name}"', f'its points "{mesh.name}" are not of the {count} surfels of its asset',
                "Press Restore Surfels in sidebar > DR-GS > Clean",
            )  # fmt: skip
        left = found
    gone = _lacking(left, count)
    return gone if len(gone) else None


def keep_removed(mesh: bpy.types.Mesh, count: int) -> None:
    """Have a mesh of points remember which of `count` surfels it lacks, for as long as it is edited."""
    rows = rows_of(mesh)
    gone = _lacking(np.zeros(0, np.int32) if rows is None else rows, count)
    if len(gone):
        mesh[SURFEL] = gone.tolist()
    elif SURFEL in mesh:
        del mesh[SURFEL]


def _lacking(left: Array, count: int) -> Array:
    """(k,) int32 of `count` surfels, those that are not among the surfels `left`, (n,) int."""
    gone = np.ones(count, bool)
    gone[left] = False
    return np.flatnonzero(gone).astype(np.int32)
