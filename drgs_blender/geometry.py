"""Geometry shared by deformation and rendering: vertex normals of a triangle mesh whose faces stay the same."""

from __future__ import annotations

import math

import numpy as np

from .errors import AssetError
from .jit import njit, prange

Array = np.ndarray


def corner_table(faces: Array, n_vertices: int) -> tuple[Array, Array]:
    """Which face corners touch each vertex, as compressed rows.

    Parameters
    ----------
    faces : (m, 3) int
    n_vertices : number of vertices

    Returns
    -------
    start : (n_vertices + 1,) int32
        The corners of vertex v are ``corner[start[v]:start[v + 1]]``, in ascending order.
    corner : (3 m,) int32
        Corner index: 3 x face + position in the face.
    """
    flat = np.asarray(faces).reshape(-1)
    corner = np.argsort(flat, kind="stable").astype(np.int32)
    start = np.zeros(n_vertices + 1, np.int32)
    np.cumsum(np.bincount(flat, minlength=n_vertices), out=start[1:])
    return start, corner


class VertexNormals:
    """Smooth vertex normals weighted by corner angle, as Blender's.

    Each vertex gathers its own faces in a fixed order, so the result does not depend on the number of threads.
    Degenerate faces weigh nothing; a vertex without any proper face gets (0, 0, 1).

    Parameters
    ----------
    faces : (m, 3) int, counter-clockwise seen from outside
    n_vertices : number of vertices
    """

    def __init__(self, faces: Array, n_vertices: int) -> None:
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        self.n_vertices = int(n_vertices)
        self.start, self.corner = corner_table(self.faces, self.n_vertices)

    def __call__(self, vertices: Array) -> Array:
        """Return the (n, 3) float32 unit normals of `vertices` (n, 3), in the frame of reference of `vertices`."""
        vertices = np.ascontiguousarray(vertices, dtype=np.float32)
        if vertices.shape != (self.n_vertices, 3):
            raise AssetError("mesh vertices", f"have shape {vertices.shape}, expected ({self.n_vertices}, 3)")
        normals = np.empty_like(vertices)
        weighted = np.empty((len(self.faces), 3, 3), np.float32)
        _gather_normals(vertices, self.faces, self.start, self.corner, weighted, normals)
        return normals


@njit(parallel=True)
def _gather_normals(
    vertices: Array, faces: Array, start: Array, corner: Array, weighted: Array, normals: Array
) -> None:
    """Fill `weighted` (m, 3, 3) with angle x unit normal of each corner, then sum it over each vertex's corners."""
    for f in prange(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        # Differences in double: the sides of a tiny face far from the origin keep their direction.
        ux = np.float64(vertices[b, 0]) - vertices[a, 0]
        uy = np.float64(vertices[b, 1]) - vertices[a, 1]
        uz = np.float64(vertices[b, 2]) - vertices[a, 2]
        vx = np.float64(vertices[c, 0]) - vertices[a, 0]
        vy = np.float64(vertices[c, 1]) - vertices[a, 1]
        vz = np.float64(vertices[c, 2]) - vertices[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        twice_area = math.sqrt(nx * nx + ny * ny + nz * nz)
        uu, vv, uv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, ux * vx + uy * vy + uz * vz
        proper = 1e-10 * (uu + vv) < twice_area < 1e30  # false for NaN
        inverse = 1.0 / twice_area if proper else 0.0
        for k in range(3):
            cosine = uv if k == 0 else (uu - uv if k == 1 else vv - uv)
            w = math.atan2(twice_area, cosine) * inverse if proper else 0.0
            weighted[f, k, 0] = w * nx if proper else 0.0
            weighted[f, k, 1] = w * ny if proper else 0.0
            weighted[f, k, 2] = w * nz if proper else 0.0
    flat = weighted.reshape(-1, 3)
    for v in prange(len(vertices)):
        x, y, z = 0.0, 0.0, 0.0
        for i in range(start[v], start[v + 1]):
            c = corner[i]
            x += flat[c, 0]
            y += flat[c, 1]
            z += flat[c, 2]
        length = math.sqrt(x * x + y * y + z * z)
        if length > 1e-6:
            normals[v, 0], normals[v, 1], normals[v, 2] = x / length, y / length, z / length
        else:
            normals[v, 0], normals[v, 1], normals[v, 2] = 0.0, 0.0, 1.0


def unit(vectors: Array, fallback: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Array:
    """Normalise (..., 3) vectors, keeping their dtype; those without a direction become `fallback`."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    proper = np.isfinite(length) & (length > 1e-30)
    return np.where(proper, vectors / np.where(proper, length, 1), np.asarray(fallback, vectors.dtype))


def rotation_matrices(quaternions: Array) -> Array:
    """(n, 4) unit quaternions wxyz -> (n, 3, 3) rotation matrices of the same dtype; columns are the rotated axes."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternions(matrices: Array) -> Array:
    """(n, 3, 3) rotation matrices -> (n, 4) unit quaternions wxyz with w >= 0, of the same dtype.

    Of the four rows of 4 q q^T the one with the largest diagonal is normalised, which never divides by a small number.
    """
    m = np.moveaxis(matrices, (-2, -1), (0, 1))
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    diagonal = np.stack([1 + trace] + [1 - trace + 2 * m[k, k] for k in range(3)], -1)
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = np.stack(
        [
            np.stack([diagonal[..., 0], wx, wy, wz], -1),
            np.stack([wx, diagonal[..., 1], xy, xz], -1),
            np.stack([wy, xy, diagonal[..., 2], yz], -1),
            np.stack([wz, xz, yz, diagonal[..., 3]], -1),
        ],
        -2,
    )
    best = np.take_along_axis(rows, np.argmax(diagonal, -1)[..., None, None], -2)[..., 0, :]
    best = best / np.linalg.norm(best, axis=-1, keepdims=True)
    return np.where(best[..., :1] < 0, -best, best)
