"""The nearest place on meshes for each of some points: what one mesh takes from others."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from ..addon import mesh_arrays
from ..drgs_blender.core.asset import Mesh
from ..drgs_blender.core.errors import UsageError
from . import selection

Array = np.ndarray


#: Distance, as a part of the diagonal, within which a vertex lies where another does.
AT_PLACE = 1e-4


@dataclass(slots=True)
class Source:
    """One mesh that gives weights: its arrays at rest in world space."""

    object: bpy.types.Object
    vertices: Array  # (n, 3) float64 world
    triangles: Array  # (m, 3) int
    matrix: Array  # (4, 4) object to world


@dataclass(slots=True)
class Match:
    """For each target vertex: the nearest place on the sources."""

    source: Array  # (n,) index into the sources
    corners: Array  # (n, 3) vertices of the nearest triangle, in its source
    barycentric: Array  # (n, 3)
    distance: Array  # (n,) metres


def source_of(obj: bpy.types.Object) -> Source:
    """The undeformed mesh of `obj` in the world; UsageError where it has no faces."""
    mesh = obj.data
    if mesh.shape_keys:
        local = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.shape_keys.reference_key.points.foreach_get("co", local.ravel())
    else:
        local = mesh_arrays.read_vertices(mesh)
    triangles = mesh_arrays.loop_triangles(mesh)
    if not len(triangles):
        raise UsageError(f'Object "{obj.name}"', "has no faces", "Deselect it")
    matrix = np.array(obj.matrix_world, np.float64)
    return Source(obj, selection.in_world(obj, local), triangles, matrix)


def nearest(points: Array, sources: list[Source]) -> Match:
    """Nearest place on the sources for each point, (n, 3) world."""
    starts = np.cumsum([0, *(len(s.vertices) for s in sources)])
    vertices = np.concatenate([s.vertices for s in sources])
    triangles = np.concatenate([s.triangles + start for s, start in zip(sources, starts)])
    tree = BVHTree.FromPolygons(vertices.tolist(), triangles.tolist(), all_triangles=True)
    hits = [tree.find_nearest(p) for p in points.tolist()]
    found = np.array([h[0] for h in hits], np.float64)
    corners = triangles[[h[2] for h in hits]]
    source = np.searchsorted(starts, corners[:, 0], side="right") - 1
    return Match(
        source=source,
        corners=corners - starts[source][:, None],
        barycentric=barycentric(found, vertices[corners]),
        distance=np.linalg.norm(found - points, axis=1),
    )


def by_numbers(points: Array, rest: Mesh, sources: list[Source]) -> Match | None:
    """The vertices of the sources from which those of an asset were made, by their numbers.

    Exact also where surfaces touch or lie in each other, where the nearest place may be another's. A vertex between
    those of several sources, which were one surface in the asset's making, takes the nearest place.

    Parameters
    ----------
    points : (n, 3) array
        World: the asset's vertices, undeformed.
    rest : Mesh
        Of the asset.
    sources : list of Source
        In the order in which the asset's source has them.

    Returns
    -------
    Match or None
        None where the sources are not the mesh that the asset was made from, or lie elsewhere.
    """
    vertices = np.concatenate([s.vertices for s in sources])
    starts = np.cumsum([0, *(len(s.vertices) for s in sources)])
    n = len(points)
    tries = []
    if rest.source is not None and len(vertices) == rest.source_count and n == len(rest.source.index):
        tries.append((rest.source.index, rest.source.weights))
    if len(vertices) == n:
        tries.append((np.arange(n)[:, None], np.ones((n, 1))))
    for index, weights in tries:
        found = np.einsum("nk,nkc->nc", weights, vertices[index])
        distance = np.linalg.norm(found - points, axis=1)
        if distance.max(initial=0) > AT_PLACE * float(np.linalg.norm(np.ptp(vertices, axis=0))):
            continue
        used = weights != 0
        corners, shares = np.repeat(index[np.arange(n), used.argmax(axis=1)][:, None], 3, axis=1), np.zeros((n, 3))
        corners[:, : index.shape[1]][used], shares[:, : index.shape[1]] = index[used], weights
        of = np.searchsorted(starts, corners, side="right") - 1
        match = Match(of[:, 0], corners - starts[of], shares, distance)
        across = np.flatnonzero((of != of[:, :1]).any(axis=1))  # in faces with a vertex that another source has, too
        if len(across):
            near = nearest(points[across], sources)
            match.source[across], match.corners[across] = near.source, near.corners
            match.barycentric[across], match.distance[across] = near.barycentric, near.distance
        return match
    return None


def barycentric(points: Array, triangles: Array) -> Array:
    """Barycentric coordinates, clamped to the triangle, of (n, 3) points in (n, 3, 3) triangles."""
    a, b, c = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = points - a
    bb, bc, cc = (np.einsum("ij,ij->i", x, y) for x, y in ((b, b), (b, c), (c, c)))
    pb, pc = np.einsum("ij,ij->i", p, b), np.einsum("ij,ij->i", p, c)
    area = bb * cc - bc * bc
    flat = area <= 1e-12 * np.maximum(bb * cc, 1e-300)
    area = np.where(flat, 1, area)
    v, w = (cc * pb - bc * pc) / area, (bb * pc - bc * pb) / area
    weights = np.clip(np.stack((1 - v - w, v, w), axis=1), 0, 1)
    weights[weights < 1e-5] = 0  # a vertex that coincides takes exactly its partner's values
    near = np.linalg.norm(triangles - points[:, None], axis=2).argmin(axis=1)
    weights[flat] = np.eye(3)[near[flat]]
    return weights / weights.sum(axis=1, keepdims=True)
