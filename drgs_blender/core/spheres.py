"""Points as spheres of triangles, which everything that meets meshes meets: numpy alone.

They are icosahedra, divided, with the normals of the sphere. By Cauchy's formula the mean area of a convex body's
shadow is a fourth of its surface: they are as much larger than the sphere as makes that the sphere's.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from .strands import Tubes

Array = np.ndarray

#: How often the faces of an icosahedron are divided in four, at most.
FINEST = 3


def sphere_faces(level: int) -> int:
    """How many triangles a sphere has."""
    return int(20 * 4**level)


def spheres(points: Array, radii: Array, level: int = FINEST) -> Tubes:
    """Make a mesh of spheres.

    Parameters
    ----------
    points : (n, 3) float array
    radii : (n,) float array
        In the unit of the points. What has none, or is not finite, has no faces.
    level : int
        See `FINEST`.

    Returns
    -------
    Tubes
        A ring is the sphere of a point.
    """
    points, radii = np.asarray(points, np.float32), np.asarray(radii, np.float32)
    unit, faces, larger = _icosphere(level)
    bad = ~(np.isfinite(points).all(axis=1) & np.isfinite(radii))
    place, radius = np.where(bad[:, None], np.float32(0), points), np.where(bad, np.float32(0), radii)
    vertices = place[:, None] + (larger * radius)[:, None, None] * unit
    drawn = np.flatnonzero(radius > 0)
    number = np.arange(len(points), dtype=np.int32)
    return Tubes(
        vertices.reshape(-1, 3),
        np.tile(unit, (len(points), 1)),
        (faces + (len(unit) * drawn.astype(np.int32))[:, None, None]).reshape(-1, 3),
        len(unit) // 2,
        number,
        number,
        np.zeros(len(points), np.float32),
        bad,
    )


@cache
def _icosphere(level: int) -> tuple[Array, Array, np.float32]:
    """(v, 3) float32 unit vertices, (m, 3) int32 faces counter-clockwise from outside, and by how much it is larger."""
    golden = (1 + math.sqrt(5)) / 2
    corners = [(a, b * golden, 0) for a in (-1, 1) for b in (-1, 1)]
    found = [tuple(corner[(k - turn) % 3] for k in range(3)) for turn in range(3) for corner in corners]
    vertices = np.array(found, float) / math.hypot(1, golden)
    near = np.linalg.norm(vertices[:, None] - vertices, axis=2) < 1.1  # an edge is 1.05 long
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    faces = np.array([t for t in triples if all(near[t[a], t[a - 1]] for a in range(3))])
    outward = np.linalg.det(vertices[faces]) > 0
    faces = np.where(outward[:, None], faces, faces[:, [0, 2, 1]])
    for _ in range(level):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
        kinds, number = np.unique(edges, axis=0, return_inverse=True)
        middle = vertices[kinds].sum(axis=1)
        ab, bc, ca = (number.reshape(-1, 3) + len(vertices)).T
        vertices = np.concatenate([vertices, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        a, b, c = faces.T
        faces = np.concatenate([np.stack(t, -1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    sides = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1).sum()
    return vertices.astype(np.float32), faces.astype(np.int32), np.float32(math.sqrt(4 * math.pi / area))
