"""Surfels without the engine: discs with their albedo where the deformed mesh has carried them.

Of an object that is edited, the mesh or its surfels as points, they stand a little farther behind, so that vertices and
points are seen before them.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import bpy
import gpu
import numpy as np
from mathutils import Matrix, Vector

from ...drgs_blender.core.asset import Asset
from ...drgs_blender.core.errors import DrgsError
from ...drgs_blender.core.frame import ProxyMesh
from ...drgs_blender.core.level_of_detail import Detail
from ...drgs_blender.core.material_adjustments import edited_asset
from .. import assets, mesh_arrays, proxies, surfel_points
from ..export.export_cache import PAINTED, ExportCache, uid
from ..export.objects import appearance_of
from ..export.painted_images import are_painted
from ..level_of_detail import most_surfels
from . import draw, views

Array = np.ndarray

#: Diameter of a disc in standard deviations of its surfel: neighbours just overlap.
_WIDTH = 2.5
cache = ExportCache()
#: Orders of the surfels of assets, by their centres.
_orders: mesh_arrays.OfArrays[Detail] = mesh_arrays.OfArrays(8)
#: What viewports show in place of all surfels as they are painted, in words, by `views.name_of`.
_reductions: dict[str, str] = {}


def forget() -> None:
    """Drop everything."""
    cache.clear()
    _orders.clear()
    _reductions.clear()


def reduction(name: str) -> str:
    """What a viewport shows in place of all surfels as they are painted, in words; "" where it shows them."""
    return _reductions.get(name, "")


def posed_centres(asset: Asset, vertices: Array, rows: Array | slice = slice(None)) -> Array:
    """(n, 3) float32: where the surfels are when the mesh has these (v, 3) vertices; bound ones follow their face.

    `rows` chooses surfels.
    """
    binding = asset.binding
    if binding is None or len(vertices) != len(asset.mesh.vertices):
        return asset.surfels.centre[rows]
    faces, offset = asset.mesh.faces[binding.face[rows]], binding.offset[rows]
    corners = vertices[faces]
    found = np.einsum("nk,nkc->nc", binding.barycentric[rows], corners)
    if offset.any():
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        rest = asset.mesh.vertices[faces]
        edge = np.linalg.norm(rest - np.roll(rest, 1, axis=1), axis=2).mean(axis=1)
        found += (offset * edge)[:, None] * normal
    return np.ascontiguousarray(found, np.float32)


def places_of(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[Array, Array]:
    """(n,) int32 surfels of its asset that an object has, and (n, 3) float32 where they are as it is posed, its space.

    Raises
    ------
    AssetError
        As of `surfel_points.left_of`.
    """
    asset = assets.load(assets.file_of(obj))
    left = surfel_points.left_of(obj, asset)
    rows = np.arange(len(asset.surfels), dtype=np.int32) if left is None else left
    vertices, shown = evaluated_vertices(obj, depsgraph), obj.evaluated_get(depsgraph).data
    proxy = proxies.read(shown) if proxies.is_proxy(shown, asset) else None
    own = mesh_arrays.source_rows(obj.data, asset.mesh)
    if own is not None and len(own) == len(vertices):  # what was deleted stays where it was
        posed = asset.mesh.vertices.copy()
        posed[own[own >= 0]] = vertices[own >= 0]
        vertices = posed
    places = posed_centres(asset, vertices) if proxy is None else proxies.carried(asset.surfels.centre, proxy)
    return rows, places[rows]


def evaluated_vertices(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Array:
    """(n, 3) float32 object space, as modifiers move them; where these change their number, of the mesh itself."""
    moved = mesh_arrays.read_vertices(obj.evaluated_get(depsgraph).data)
    return moved if len(moved) == len(obj.data.vertices) else mesh_arrays.read_vertices(obj.data)


def show(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
    """Draw the surfels of all visible DR-GS objects, no more than the scene's limit."""
    region, rv3d = context.region, context.region_data
    share = _share(context, depsgraph)
    for instance in depsgraph.object_instances:
        obj = instance.object
        if not instance.show_self or not assets.is_drgs(obj):
            continue
        key, owners = _state(obj)
        found = cache.get(("discs", *key, share), owners, partial(_batch, obj, depsgraph, share))
        if found is None:
            continue
        batch, size = found
        matrix: Matrix = instance.matrix_world
        scale = 0.5 * region.height * rv3d.window_matrix[1][1] * matrix.median_scale
        transform = rv3d.perspective_matrix @ matrix
        if is_edited(obj):
            middle = sum((Vector(corner) for corner in obj.bound_box), Vector()) / 8
            depth = -(rv3d.view_matrix @ matrix @ middle).z
            transform = set_back(rv3d.window_matrix, depth, size * matrix.median_scale) @ transform
        draw.discs(batch, transform, scale, rv3d.is_perspective)
    cache.end()


def _share(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> float:
    """The part of all surfels that the scene's limit allows. The viewport's header says it, and what is not shown."""
    name, most, whole = views.name_of(context.region), most_surfels(depsgraph.scene), number(depsgraph)
    share = most / whole if 0 < most < whole else 1.0
    parts = [f"{most:,} of {whole:,} surfels"] if share < 1.0 else []
    if any(_is_painted(obj) for obj in _visible(depsgraph)):
        parts.append("Splats show painted images after Save Edited Asset")
    told = "  |  ".join(parts)
    if told != reduction(name):
        for other in context.area.regions:
            if other.type == "HEADER":
                other.tag_redraw()
    _reductions[name] = told
    return share


def number(depsgraph: bpy.types.Depsgraph) -> int:
    """Surfels of all visible objects, as far as these were not cut; those of instances once more."""
    shown = (_shown(obj, depsgraph) for obj in _visible(depsgraph))
    return sum(0 if found is None else len(found[0].surfels) for found in shown)


def _visible(depsgraph: bpy.types.Depsgraph) -> Iterator[bpy.types.Object]:
    """DR-GS objects; those of instances once more."""
    return (i.object for i in depsgraph.object_instances if i.show_self and assets.is_drgs(i.object))


def _is_painted(obj: bpy.types.Object) -> bool:
    """Whether images of its asset are painted over on an object: the engine alone gives their colours to surfels."""

    def found() -> bool:
        try:
            return are_painted(obj, assets.load(assets.file_of(obj)))
        except DrgsError:  # reported when the object is rendered
            return False

    return cache.get((PAINTED, uid(obj)), (uid(obj), uid(obj.data)), found)


def _state(obj: bpy.types.Object) -> tuple[tuple[Any, ...], tuple[int, ...]]:
    """On what the surfels of an object depend: as the cache's key, and its owners."""
    look = obj.drgs.show_captured, obj.drgs.adjustment.values(), surfel_points.state_of(obj)
    owners = uid(obj), uid(obj.data), uid(obj.original.drgs.surfel_points)
    return (uid(obj), obj.data.as_pointer(), obj.mode, look), owners


def is_edited(obj: bpy.types.Object) -> bool:
    """Whether an object, or what its surfels are as points, is in Edit Mode."""
    points = obj.original.drgs.surfel_points
    return obj.mode == "EDIT" or (points is not None and points.is_editmode)


def set_back(window: Matrix, depth: float, distance: float) -> Matrix:
    """A map of clip space by which what is at a depth before the viewer is `distance` farther, and looks the same.

    Parameters
    ----------
    window : Matrix
        Projection of a viewport, from camera to clip space.
    depth, distance : float
        Metres.
    """

    def depth_of(away: float) -> float:
        z = window @ Vector((0, 0, -away, 1))
        return float(z.z / z.w)

    depth = max(depth, distance, 1e-6)
    moved = Matrix.Identity(4)
    moved[2][3] = depth_of(depth + distance) - depth_of(depth)
    return moved


def _shown(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[Asset, Array, ProxyMesh | None] | None:
    """`shown_asset` of an object, read once; None where it has none."""

    def read() -> tuple[Asset, Array, ProxyMesh | None] | None:
        try:
            return shown_asset(obj, assets.load(assets.file_of(obj)), depsgraph)
        except DrgsError:  # reported when the object is rendered
            return None

    key, owners = _state(obj)
    return cache.get(("shown", *key), owners, read)


def _batch(
    obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, share: float
) -> tuple[gpu.types.GPUBatch, float] | None:
    """Discs, and the median of their diameters."""
    found = _shown(obj, depsgraph)
    if found is None:
        return None
    shown, vertices, proxy = found
    rows, growth = first_rows(shown, share)
    scale = shown.surfels.scale[rows]
    sizes = _WIDTH * np.maximum(scale.max(axis=1, initial=0), np.sqrt(scale.prod(axis=1) * growth))
    places = posed_centres(shown, vertices, rows)
    if proxy is not None:
        places = proxies.carried(shown.surfels.centre, proxy, rows)
    batch = draw.disc_batch(places, shown.surfels.albedo[rows], sizes.astype(np.float32))
    return batch, float(np.median(sizes)) if len(sizes) else 0.0


def first_rows(asset: Asset, share: float) -> tuple[Array | slice, Array | float]:
    """The surfels that stand for a share of all, and by how much their area grows."""
    count = max(1, round(share * len(asset.surfels)))
    if share >= 1.0 or count >= len(asset.surfels):
        return slice(None), 1.0
    detail = _orders.get(asset.surfels.centre, lambda: Detail.of(asset.surfels))
    return detail.order[:count], detail.growth(count)


def shown_asset(
    obj: bpy.types.Object, asset: Asset, depsgraph: bpy.types.Depsgraph | None = None
) -> tuple[Asset, Array, ProxyMesh | None]:
    """What the evaluated object has of its asset, as painted and adjusted, its (n, 3) vertices, and its proxy."""
    try:
        found = appearance_of(obj, asset, lambda text: None, depsgraph)
    except DrgsError:  # reported, as warnings are, when the object is rendered
        return asset, asset.mesh.vertices if obj.mode == "EDIT" else mesh_arrays.read_vertices(obj.data), None
    captured = obj.drgs.show_captured
    shown = found.asset if captured else edited_asset(found.asset, found.painted, found.adjustment)
    return shown, found.vertices, found.proxy
