"""Surfels without the engine: discs with their albedo where the deformed mesh has carried them."""

from __future__ import annotations

from functools import partial

import bpy
import gpu
import numpy as np
from mathutils import Matrix

from ...drgs_blender.core.asset import Asset
from ...drgs_blender.core.errors import DrgsError
from ...drgs_blender.core.material_adjustments import edited_asset
from .. import assets, mesh_arrays, surfel_points
from ..export.export_cache import ExportCache, uid
from ..export.objects import appearance_of
from . import draw

Array = np.ndarray

#: Diameter of a disc in standard deviations of its surfel: neighbours just overlap.
_WIDTH = 2.5
cache = ExportCache()


def posed_centres(asset: Asset, vertices: Array) -> Array:
    """(n, 3) float32: where the surfels are when the mesh has these (v, 3) vertices; bound ones follow their face."""
    binding = asset.binding
    if binding is None or len(vertices) != len(asset.mesh.vertices):
        return asset.surfels.centre
    corners = vertices[asset.mesh.faces[binding.face]]
    found = np.einsum("nk,nkc->nc", binding.barycentric, corners)
    if binding.offset.any():
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        rest = asset.mesh.vertices[asset.mesh.faces[binding.face]]
        edge = np.linalg.norm(rest - np.roll(rest, 1, axis=1), axis=2).mean(axis=1)
        found += (binding.offset * edge)[:, None] * normal
    return np.ascontiguousarray(found, np.float32)


def show(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
    """Draw the surfels of all visible DR-GS objects."""
    region, rv3d = context.region, context.region_data
    for instance in depsgraph.object_instances:
        obj = instance.object
        if not instance.show_self or not assets.is_drgs(obj):
            continue
        look = obj.drgs.show_captured, obj.drgs.adjustment.values(), surfel_points.state_of(obj)
        key = "object", uid(obj), obj.data.as_pointer(), obj.mode, look
        owners = uid(obj), uid(obj.data), uid(obj.original.drgs.surfel_points)
        batch = cache.get(key, owners, partial(_batch, obj, depsgraph))
        if batch is None:
            continue
        matrix: Matrix = instance.matrix_world
        scale = 0.5 * region.height * rv3d.window_matrix[1][1] * matrix.median_scale
        draw.discs(batch, rv3d.perspective_matrix @ matrix, scale, rv3d.is_perspective)
    cache.end()


def _batch(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> gpu.types.GPUBatch | None:
    try:
        asset = assets.load(assets.file_of(obj))
    except DrgsError:  # reported when the object is rendered
        return None
    shown, vertices = shown_asset(obj, asset, depsgraph)
    sizes = _WIDTH * shown.surfels.scale.max(axis=1, initial=0)
    return draw.disc_batch(posed_centres(shown, vertices), shown.surfels.albedo, sizes.astype(np.float32))


def shown_asset(
    obj: bpy.types.Object, asset: Asset, depsgraph: bpy.types.Depsgraph | None = None
) -> tuple[Asset, Array]:
    """What the evaluated object has of its asset, as it is painted and adjusted, and its (n, 3) vertices."""
    if obj.mode == "EDIT":  # then its mesh is a wrapper without attributes
        return asset, mesh_arrays.read_vertices(obj.data)
    try:
        found = appearance_of(obj, asset, lambda text: None, depsgraph)
    except DrgsError:  # reported, as warnings are, when the object is rendered
        return asset, mesh_arrays.read_vertices(obj.data)
    captured = obj.drgs.show_captured
    return found.asset if captured else edited_asset(found.asset, found.painted, found.adjustment), found.vertices
