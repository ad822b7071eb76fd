"""Proxy meshes: what Blender shows and bends in place of a capture that has no mesh.

Each vertex knows where it stands when the surfels are as they were captured; armatures, lattices, cages, shape keys,
simulations and nodes move it as they move any mesh, and the surfels follow.
"""

from __future__ import annotations

from typing import NamedTuple

import bpy
import numpy as np

from ..drgs_blender.core.asset import Asset
from ..drgs_blender.core.frame import ProxyMesh
from . import mesh_arrays

Array = np.ndarray

#: Attribute with the place of each vertex at rest, object space, metres.
REST = "drgs_rest"
#: Viewports show surfels by the rigid maps of so many parts of a proxy's length, each of its nearest vertices.
_PARTS, _NEAREST = 32, 12


def is_proxy(mesh: bpy.types.Mesh, asset: Asset) -> bool:
    """Whether a mesh stands for an asset that has none."""
    attribute = mesh.attributes.get(REST)
    known = attribute is not None and (attribute.data_type, attribute.domain) == ("FLOAT_VECTOR", "POINT")
    return known and not len(asset.mesh.vertices) and bool(len(mesh.vertices))


def fill(mesh: bpy.types.Mesh, vertices: Array, triangles: Array) -> None:
    """Make an empty mesh a proxy of (n, 3) vertices and (m, 3) triangles, object space, which are at rest."""
    mesh.clear_geometry()
    mesh.from_pydata(vertices.tolist(), [], triangles.tolist())
    attribute = mesh.attributes.new(REST, "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", np.ascontiguousarray(vertices, np.float32).ravel())
    mesh.update()


def read(mesh: bpy.types.Mesh) -> ProxyMesh | None:
    """What an evaluated proxy does; None where it is as at rest.

    Vertices of no face are left out where there are faces.
    """
    rest = read_rest(mesh)
    vertices, faces = mesh_arrays.read_vertices(mesh), mesh_arrays.loop_triangles(mesh)
    if len(faces):
        used, faces = np.unique(faces, return_inverse=True)
        rest, vertices = np.ascontiguousarray(rest[used]), np.ascontiguousarray(vertices[used])
        faces = np.ascontiguousarray(faces.reshape(-1, 3), np.int32)
    if np.array_equal(rest, vertices):
        return None
    for array in (rest, vertices, faces):
        array.flags.writeable = False  # so that the engine's client need not copy it
    return ProxyMesh(rest, vertices, faces)


def read_rest(mesh: bpy.types.Mesh) -> Array:
    """(n, 3) float32 places of the vertices of a proxy at rest."""
    rest = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.attributes[REST].data.foreach_get("vector", rest.ravel())
    return rest


class _Parts(NamedTuple):
    """Parts of space: which one each surfel is in, and the vertices that move each, at rest."""

    part: Array
    nearest: Array
    weight: Array
    middle: Array
    offset: Array


_parts: mesh_arrays.OfArrays[dict[bytes, _Parts]] = mesh_arrays.OfArrays(4)


def carried(centre: Array, proxy: ProxyMesh, rows: Array | slice = slice(None)) -> Array:
    """(n, 3) float32 about where a proxy takes surfels of an asset, for viewports; the engine's are exact.

    Parameters
    ----------
    centre : (n, 3) float32 array
        Of the surfels at rest, the asset's own array.
    proxy : ProxyMesh
    rows : (k,) int array or slice
        Chooses surfels.
    """
    known = _parts.get(centre, dict)
    key = proxy.rest.tobytes()
    if key not in known:
        known.clear()
        known[key] = _divided(np.asarray(centre), proxy.rest)
    parts = known[key]
    now = proxy.vertices.astype(np.float64)[parts.nearest]
    middle = np.einsum("pk,pkc->pc", parts.weight, now)
    moved = np.nan_to_num(now - middle[:, None])
    u, _, vt = np.linalg.svd(np.einsum("pk,pki,pkj->pij", parts.weight, moved, parts.offset))
    side = np.ones((len(u), 3))
    side[:, 2] = np.linalg.det(u @ vt)
    turn = (u * side[:, None]) @ vt
    at = parts.part[rows]
    found = np.einsum("nij,nj->ni", turn[at], centre[rows] - parts.middle[at]) + middle[at]
    return np.ascontiguousarray(found, np.float32)


def _divided(centre: Array, rest: Array) -> _Parts:
    side = max(float(np.ptp(centre, axis=0).max()) / _PARTS, 1e-9)
    cells, part = np.unique(np.floor(centre / side).astype(np.int32), axis=0, return_inverse=True)
    places, rest = (cells + 0.5) * side, rest.astype(np.float64)
    count = min(_NEAREST, len(rest))
    nearest = np.empty((len(places), count), np.int64)
    squared = np.empty((len(places), count))
    for first in range(0, len(places), 256):  # bounds memory
        some = slice(first, first + 256)
        away = _squares(places[some], rest)
        nearest[some] = np.argpartition(away, count - 1, axis=1)[:, :count]
        squared[some] = np.take_along_axis(away, nearest[some], axis=1)
    weight = 1.0 / (squared + (0.25 * side) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    middle = np.einsum("pk,pkc->pc", weight, rest[nearest])
    return _Parts(part.reshape(-1), nearest, weight, middle, rest[nearest] - middle[:, None])


def _squares(a: Array, b: Array) -> Array:
    """(n, m) squared distances."""
    found = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.maximum(found, 0.0)
