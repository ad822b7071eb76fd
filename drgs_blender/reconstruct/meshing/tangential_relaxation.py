"""Tangential relaxation: vertices slide along the surface until triangles are about alike.

Marching cubes leaves edges of a hundredth of a voxel. Whatever moves vertices afterwards turns the triangles at such an
edge over, and with them the vertex normals of a pixel around it.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ...geometry.normals import VertexNormals
from ..inverse_rendering.radiance_cache import adjacency, edges_of

#: Part of the way to the middle of its neighbours that a vertex goes in a round; rounds.
STEP, ROUNDS = 0.5, 3


def relaxed(vertices: Array, faces: Array, rounds: int = ROUNDS) -> Array:
    """Vertices of a closed mesh slid along it (Taubin 1995's umbrella, less its part along the normal).

    Parameters
    ----------
    vertices : (n, 3) array
    faces : (m, 3) int array
        Stay as they are.
    rounds : int

    Returns
    -------
    (n, 3) float32 array
    """
    near, normals = adjacency(edges_of(faces), len(vertices)), VertexNormals(faces, len(vertices))
    share = STEP / np.maximum(np.asarray(near.sum(axis=1)), 1)
    moved = vertices.astype(np.float64)
    for _ in range(rounds):
        along = normals(moved.astype(np.float32))
        step = share * (near @ moved) - STEP * moved
        moved += step - (step * along).sum(axis=1, keepdims=True) * along
    return moved.astype(np.float32)
