"""Wide support: the three vertices that a surfel follows if it is larger than its face."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compute.jit import njit
from ..geometry.normals import corner_table
from .face_frames import Faces

Array = np.ndarray

#: Most vertices that are looked at for one surfel.
_MOST = 2048
#: Cosine to the face from which on a vertex is of the same side of the object.
_SAME_SIDE = 0.3
#: Part of an equilateral triangle's area, over the same longest edge, that a span has at least.
_BROAD = 0.3


class MeshAdjacency(NamedTuple):
    """A mesh to walk on.

    Attributes
    ----------
    vertices : (k, 3) float64 array
    faces : (m, 3) int32 array
    normals : (k, 3) array
        Smooth ones, of the vertices.
    face_normals : (m, 3) float64 array
    start, corner : array
        See `geometry.normals.corner_table`.
    """

    vertices: Array
    faces: Array
    normals: Array
    face_normals: Array
    start: Array
    corner: Array


class SurfelSpots(NamedTuple):
    """Attachment of surfels to a mesh.

    Attributes
    ----------
    face : (n,) int32 array
    place : (n, 3) float64 array
    along, across : (n, 3) float64 array
        Unit vectors in the face, at right angles.
    reach : (n,) float64 array
        How large the surfels are, in the unit of the mesh.
    """

    face: Array
    place: Array
    along: Array
    across: Array
    reach: Array


def spans(
    vertices: Array, indices: Array, normals: Array, faces: Faces, face: Array, weights: Array, reach: Array
) -> Array:
    """Vertices about `reach` away from where surfels hang, a third of a turn apart.

    The surface is walked from the face on, so that they are of the same sheet: not of the other side of a wall, nor of
    what only comes near.

    Parameters
    ----------
    vertices : (k, 3) array
        Of the mesh at rest.
    indices : (m, 3) int32 array
        Its faces.
    normals : (k, 3) array
        Its smooth normals.
    faces : Faces
        The mesh's faces, measured.
    face : (n,) array
        Faces on which the surfels hang.
    weights : (n, 3) array
        Barycentric coordinates of where they do.
    reach : (n,) array
        Metres; those that are no larger than the mean edge of their face need no span.

    Returns
    -------
    (n, 3) int32 array
        -1 for surfels that follow their own face: small ones, and those without a broad triangle that is larger.
    """
    wanted = np.flatnonzero((reach > faces.mean_edge[face]) & ~faces.degenerate[face])
    found = np.full((len(face), 3), -1, np.int32)
    if len(wanted):
        own = face[wanted]
        corners = faces.corners[own]
        inside = np.maximum(weights[wanted], 0)
        foot = np.einsum("nk,nkc->nc", inside / inside.sum(axis=1, keepdims=True), corners)
        along = corners[:, 1] - corners[:, 0]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        across = np.cross(faces.normal[own], along)
        start, corner = corner_table(indices, len(vertices))
        mesh = MeshAdjacency(vertices.astype(np.float64), indices, normals, faces.normal, start, corner)
        found[wanted] = _walk(mesh, SurfelSpots(own, foot, along, across, reach[wanted].astype(np.float64)))
        triangle = vertices[found[wanted]].astype(np.float64)
        edges = np.roll(triangle, -1, axis=1) - triangle
        area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        longest = (edges**2).sum(axis=2).max(axis=1)
        broad = (area > faces.area[own]) & (area > _BROAD * np.sqrt(3) / 4 * longest)
        found[wanted[~broad]] = -1
    return found


@njit
def _walk(mesh: MeshAdjacency, feet: SurfelSpots) -> Array:
    """For each surfel the vertices nearest to three places around its foot."""
    vertices, indices, normals, face_normals, start, corner = mesh
    face, foot, along, across, reach = feet
    found = np.empty((len(face), 3), np.int32)
    seen = np.full(len(vertices), -1, np.int32)
    queue = np.empty(_MOST, np.int32)
    best = np.empty(3)
    for i in range(len(face)):
        f, r = face[i], reach[i]
        best[:] = np.inf
        first, last = 0, 0
        for k in range(3):
            found[i, k] = queue[last] = indices[f, k]
            seen[queue[last]] = i
            last += 1
        while first < last:
            v = queue[first]
            first += 1
            a = b = 0.0
            for c in range(3):
                a += (vertices[v, c] - foot[i, c]) * along[i, c]
                b += (vertices[v, c] - foot[i, c]) * across[i, c]
            for k in range(3):
                angle = 2 * np.pi / 3 * k
                gap = (a - r * np.cos(angle)) ** 2 + (b - r * np.sin(angle)) ** 2
                if gap < best[k]:
                    best[k] = gap
                    found[i, k] = v
            for at in range(start[v], start[v + 1]):
                for k in range(3):
                    w = indices[corner[at] // 3, k]
                    if seen[w] == i or last == _MOST:
                        continue
                    seen[w] = i
                    square = turned = 0.0
                    for c in range(3):
                        square += (vertices[w, c] - foot[i, c]) ** 2
                        turned += normals[w, c] * face_normals[f, c]
                    if square < (1.5 * r) ** 2 and turned > _SAME_SIDE:
                        queue[last] = w
                        last += 1
    return found
