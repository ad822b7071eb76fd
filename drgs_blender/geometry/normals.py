"""Vertex normals of a triangle mesh whose faces stay the same, for deformation and rendering."""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import inlined, njit, plain
from ..compute.threads import ELEMENTS, over_range
from ..core.errors import AssetError

Array = np.ndarray

_BLOCK = 256  # faces worked on together


def corner_table(faces: Array, n_vertices: int) -> tuple[Array, Array]:
    """Face corners at each vertex, as compressed rows (CSR).

    Parameters
    ----------
    faces : (m, 3) int array
    n_vertices : int
        Number of vertices.

    Returns
    -------
    start : (n_vertices + 1,) int32 array
        The corners of vertex v are ``corner[start[v]:start[v + 1]]``, in ascending order.
    corner : (3 m,) int32 array
        Corner index: 3 x face + position in the face.
    """
    flat = np.asarray(faces).reshape(-1)
    start = np.zeros(n_vertices + 1, np.int32)
    np.cumsum(np.bincount(flat, minlength=n_vertices), out=start[1:])
    corner = np.empty(len(flat), np.int32)
    _sort_corners(plain(flat), start[:-1].copy(), corner)
    return start, corner


@njit
def _sort_corners(vertex, place, corner):  # type: ignore[no-untyped-def]
    for c in range(len(vertex)):
        corner[place[vertex[c]]] = c
        place[vertex[c]] += 1


class VertexNormals:
    """Smooth vertex normals weighted by corner angle, as Blender's.

    Each vertex gathers its own faces in a fixed order, so the result does not depend on the number of threads.
    Degenerate faces weigh nothing; a vertex without any proper face gets (0, 0, 1).

    Parameters
    ----------
    faces : (m, 3) int array
        Counter-clockwise seen from outside.
    n_vertices : int
        Number of vertices.

    Attributes
    ----------
    start : (n_vertices + 1,) int32 array
        The rows of each vertex's corners.
    place : (3 m,) int32 array
        The row of each corner.
    """

    def __init__(self, faces: Array, n_vertices: int) -> None:
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        self.n_vertices = int(n_vertices)
        self.start, corner = corner_table(self.faces, self.n_vertices)
        self.place = np.empty(len(corner), np.int32)
        self.place[corner] = np.arange(len(corner), dtype=np.int32)

    def __call__(self, vertices: Array) -> Array:
        """Return the (n, 3) float32 unit normals of `vertices` (n, 3), in the frame of reference of `vertices`."""
        vertices = np.ascontiguousarray(vertices, dtype=np.float32)
        if vertices.shape != (self.n_vertices, 3):
            raise AssetError("mesh vertices", f"have shape {vertices.shape}, expected ({self.n_vertices}, 3)")
        normals = np.empty_like(vertices)
        self.into(vertices, self.faces, normals)
        return normals

    def into(self, vertices: Array, faces: Array, normals: Array) -> int:
        """Write vertex normals into (n, 3) float32 `normals`; returns the number of faces without area.

        Parameters
        ----------
        vertices : (n, 3) float32 array
        faces : (m, 3) int32 array
            The object's faces, of which some may be collapsed to a point.
        normals : (n, 3) float32 array
            Written.
        """
        weighted = np.empty((len(self.place), 3), np.float32)  # not kept: the largest array of all that a mesh needs
        corners = plain(vertices), plain(faces), self.place
        empty = sum(over_range(_weigh, len(faces), *corners, weighted, fewest=ELEMENTS))
        over_range(_sum, len(normals), weighted, self.start, normals, fewest=ELEMENTS)
        return empty


#: arctan(x) / x in powers of x^2, to 2e-8 on [0, 1]: Abramowitz and Stegun 4.4.49.
_ARCTAN = tuple(
    np.float32(a)
    for a in (
        *(0.0028662257, -0.0161657367, 0.0429096138, -0.0752896400),
        *(0.1065626393, -0.1420889944, 0.1999355085, -0.3333314528, 1.0),
    )
)


@inlined
def _angle(y, x):  # type: ignore[no-untyped-def]
    """arctan2(y, x) for y > 0, without branches."""
    a = abs(x)
    low, high = min(a, y), max(a, y)
    q = low / high
    s = q * q
    p = _ARCTAN[0]
    p = p * s + _ARCTAN[1]
    p = p * s + _ARCTAN[2]
    p = p * s + _ARCTAN[3]
    p = p * s + _ARCTAN[4]
    p = p * s + _ARCTAN[5]
    p = p * s + _ARCTAN[6]
    p = p * s + _ARCTAN[7]
    p = (p * s + _ARCTAN[8]) * q
    p = np.float32(0.5 * math.pi) - p if y > a else p
    return np.float32(math.pi) - p if x < np.float32(0.0) else p


@inlined
def face_normal(ux, uy, uz, vx, vy, vz):  # type: ignore[no-untyped-def]
    """Unit normal and the angles of a face with edges u, v at its first corner; zeros if it has no area.

    Parameters
    ----------
    ux, uy, uz, vx, vy, vz : float32
        Edges from the first corner to the second and to the third, m.

    Returns
    -------
    nx, ny, nz : float32
        Unit normal.
    first, second, third : float32
        Angles at the corners, radians.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    uu, vv, uv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, ux * vx + uy * vy + uz * vz
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area = np.sqrt(nx * nx + ny * ny + nz * nz)
    proper = (area > np.float32(1e-10) * (uu + vv)) & (area < np.float32(1e18))
    area = area if proper else one
    scale = one / area
    return (
        nx * scale if proper else zero,
        ny * scale if proper else zero,
        nz * scale if proper else zero,
        _angle(area, uv) if proper else zero,
        _angle(area, uu - uv) if proper else zero,
        _angle(area, vv - uv) if proper else zero,
    )


@inlined
def vertex_normal(weighted, first, last):  # type: ignore[no-untyped-def]
    """Vertex normal: the unit sum of weighted normals of face corners, always in the same order.

    Parameters
    ----------
    weighted : (3 m, 3) float32 array
        Normals times angles, vertex by vertex.
    first, last : int
        Rows of the vertex, half-open.

    Returns
    -------
    nx, ny, nz : float32
        Unit; +z where they cancel.
    """
    x = y = z = np.float32(0.0)
    for i in range(first, last):
        x, y, z = x + weighted[i, 0], y + weighted[i, 1], z + weighted[i, 2]
    length = np.sqrt(x * x + y * y + z * z)
    if length > np.float32(1e-6):
        scale = np.float32(1.0) / length
        return x * scale, y * scale, z * scale
    return np.float32(0.0), np.float32(0.0), np.float32(1.0)


@njit
def _weigh(first: int, last: int, vertices: Array, faces: Array, place: Array, weighted: Array) -> int:
    """Put angle x unit normal of each face corner where its vertex looks for it; return how many faces have no area.

    Scattering here lets `_sum` read in order: twice as fast as gathering there, where one misses the cache and waits.
    """
    zero = np.float32(0.0)
    empty = 0
    s = np.empty((6, _BLOCK), np.float32)
    for begin in range(first, last, _BLOCK):
        count = min(_BLOCK, last - begin)
        # Gathered first: what follows is then the same arithmetic on eight faces or more at a time.
        for i in range(count):
            a, b, c = faces[begin + i, 0], faces[begin + i, 1], faces[begin + i, 2]
            x, y, z = vertices[a, 0], vertices[a, 1], vertices[a, 2]
            s[0, i], s[1, i], s[2, i] = vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z
            s[3, i], s[4, i], s[5, i] = vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z
        for i in range(count):
            s[0, i], s[1, i], s[2, i], s[3, i], s[4, i], s[5, i] = face_normal(
                s[0, i], s[1, i], s[2, i], s[3, i], s[4, i], s[5, i]
            )
        for i in range(count):
            x, y, z = s[0, i], s[1, i], s[2, i]
            empty += x == zero and y == zero and z == zero
            for k in range(3):
                p, w = place[3 * (begin + i) + k], s[3 + k, i]
                weighted[p, 0], weighted[p, 1], weighted[p, 2] = w * x, w * y, w * z
    return empty


@njit
def _sum(first: int, last: int, weighted: Array, start: Array, normals: Array) -> None:
    for v in range(first, last):
        normals[v, 0], normals[v, 1], normals[v, 2] = vertex_normal(weighted, start[v], start[v + 1])


def lengths(vectors: Array) -> Array:
    """Lengths (...) of (..., 3) vectors: those of np.linalg.norm, which is slow at rows of three numbers."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.sqrt(x * x + y * y + z * z)


def unit(vectors: Array, fallback: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Array:
    """Normalise (..., 3) vectors, keeping their dtype; those without a direction become `fallback`."""
    length = lengths(vectors)
    proper = np.isfinite(length) & (length > 1e-30)
    result = vectors / np.where(proper, length, 1)[..., None]
    if not proper.all():
        result[~proper] = fallback
    return result


def rotation_matrices(quaternions: Array) -> Array:
    """(n, 4) unit quaternions wxyz -> (n, 3, 3) rotation matrices of the same dtype; columns are the rotated axes."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def rotation_between(first: Array, second: Array) -> float:
    """Angle of the rotation that leads from one (3, 3) rotation to another, radians; 0 between equal ones.

    Matrices that scale, too, count as the rotations in them.

    Examples
    --------
    >>> round(rotation_between(np.diag([1.0, -1.0, -1.0]), np.diag([1.0, 1.0, 1.0])), 4)
    3.1416
    """
    a, b = (np.asarray(m, np.float64) * np.sqrt(3) / np.linalg.norm(m) for m in (first, second))
    return float(2 * np.arcsin(min(np.linalg.norm(a - b) / np.sqrt(8), 1.0)))


def quaternions(matrices: Array) -> Array:
    """(n, 3, 3) rotation matrices -> (n, 4) unit quaternions wxyz with w >= 0, of the same dtype.

    Of the four rows of 4 q q^T the one with the largest diagonal is normalised, which never divides by a small number.

    Examples
    --------
    Half a turn about Z, there and back:

    >>> half_turn = rotation_matrices(np.array([[0.0, 0, 0, 1]]))
    >>> half_turn.diagonal(axis1=1, axis2=2)
    array([[-1., -1.,  1.]])
    >>> quaternions(half_turn)
    array([[0., 0., 0., 1.]])
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
