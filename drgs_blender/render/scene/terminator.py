"""Shadow terminator of smooth meshes: where shadow rays of grazing light start, as in Cycles.

A coarse mesh that is shaded smooth stands for a curved surface, which its own flat faces would shadow. Light that comes
in flat to a face is therefore looked for from the curved surface: from the point moved along the smooth normal by the
height of the surface that vertices and their normals describe. The height is the half of a parabola over the triangle,
or the lower envelope of the planes at the corners where that is more. How near to grazing light must be is the
terminator offset of the object, Blender's Shadow Terminator Geometry Offset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import ELEMENTS, over_range
from ...core.frame import MeshState
from ..memory import AddressOf, address, load_float, load_int32, load_int64
from ..sampling import HALF, ONE, ZERO, F
from .interaction import Geometry
from .texture_lookup import blend
from .trace_mesh import TraceObject

Array = np.ndarray

#: Entries of the table of addresses: vertices, faces, limits of objects, matrices of instances.
VERTICES, FACES, LIMITS, MATRICES = range(4)


class TerminatorOffsets:
    """The offsets of all objects of a scene, as compiled code reads them."""

    def __init__(self) -> None:
        self._limits: Array = np.zeros(0, np.float32)
        self._table: Array = np.zeros(4, np.int64)

    def take(self, objects: Sequence[TraceObject], meshes: Sequence[MeshState], source: Array) -> None:
        """Take those of a scene; `source` is that of each of its objects. Where light meets surfels there is none."""
        offsets = [0.0 if o.seen_only else o.terminator_offset for o in objects]
        offsets += [mesh.terminator_offset for mesh in meshes]
        self._limits = np.nan_to_num(np.array(offsets, np.float32))[source]

    def at(self, address_of: AddressOf, vertices: Array, faces: Array, matrices: Array) -> int:
        """Address of the table of addresses, each by `address_of`; 0 where no object has an offset."""
        if not self._limits.any():
            return 0
        table = np.array([address_of(array) for array in (vertices, faces, self._limits, matrices)], np.int64)
        if address_of is address:
            self._table[:] = table  # in place: who has its address may still read it
            table = self._table
        return address_of(table)


@inlined
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _minus(a, b):  # type: ignore[no-untyped-def]
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit
def _row(rows, i):  # type: ignore[no-untyped-def]
    return load_float(rows, i), load_float(rows, i + 1), load_float(rows, i + 2)


@njit
def _unit_row(rows, i):  # type: ignore[no-untyped-def]
    x, y, z = _row(rows, i)
    square = x * x + y * y + z * z
    scale = ONE / math.sqrt(square) if square > F(1e-30) else ZERO
    return x * scale, y * scale, z * scale


@njit
def _corner(a, b, c, normal, point, side):  # type: ignore[no-untyped-def]
    """Height over the face at a point of the plane at corner `a`, no part of the triangle above which it is below."""
    highest = max(max(side * _dot(_minus(b, a), normal), side * _dot(_minus(c, a), normal)), ZERO)
    return max(side * _dot(_minus(a, point), normal) + highest, ZERO)


@njit
def height(v, n, u, w, side):  # type: ignore[no-untyped-def]
    """Height of the smooth surface over a triangle, along the interpolated normal.

    Parameters
    ----------
    v, n : tuple of tuple
        The three corners and their unit normals.
    u, w : float32
        Barycentric coordinates of the second and third corner.
    side : float32
        1 where the normals are on the seen side, else -1; the sign of the result.

    Returns
    -------
    float32
    """
    a, b, c = v
    first = ONE - u - w
    point = (
        first * a[0] + u * b[0] + w * c[0],
        first * a[1] + u * b[1] + w * c[1],
        first * a[2] + u * b[2] + w * c[2],
    )
    p = _dot(_minus(n[2], n[0]), _minus(a, c))
    q = _dot(_minus(n[2], n[1]), _minus(b, c))
    r = _dot(_minus(n[1], n[0]), _minus(b, a))
    parabola = p * first * (first - ONE) + (p + q + r) * first * u + q * u * (u - ONE)
    envelope = _corner(a, b, c, n[0], point, side)
    envelope = min(envelope, _corner(b, a, c, n[1], point, side))
    envelope = min(envelope, _corner(c, a, b, n[2], point, side))
    return side * max(envelope, side * parabola * HALF)


@njit
def terminator_at(face, instance, u, v, gx, gy, gz, geometry):  # type: ignore[no-untyped-def]
    """How a shadow ray's start is moved at a point of a face, and for which light.

    Parameters
    ----------
    face, instance : int32
        As of `Hit`; face -1: not on a mesh.
    u, v : float32
        Barycentric coordinates of the second and third corner.
    gx, gy, gz : float32
        Geometric normal, unit, world, on the seen side.
    geometry : Geometry
        Its `terminators` is not 0.

    Returns
    -------
    hx, hy, hz : float32
        World, m.
    limit : float32
        Largest cosine between face and light that is grazing; 0: no ray is moved.
    """
    if face < 0:
        return ZERO, ZERO, ZERO, ZERO
    tables = geometry.terminators
    owner = load_int32(geometry.face_object, np.int64(face))
    if instance >= 0:
        owner = load_int32(geometry.instance_object, np.int64(instance))
    limit = load_float(load_int64(tables, LIMITS), np.int64(owner))
    if not limit > ZERO:
        return ZERO, ZERO, ZERO, ZERO
    corner = 3 * np.int64(face)
    vertices, faces = load_int64(tables, VERTICES), load_int64(tables, FACES)
    a = _row(vertices, 3 * np.int64(load_int32(faces, corner)))
    b = _row(vertices, 3 * np.int64(load_int32(faces, corner + 1)))
    c = _row(vertices, 3 * np.int64(load_int32(faces, corner + 2)))
    rows, width = geometry.normals, 3
    if face < geometry.vertex_faces:
        rows, width = geometry.shading, 8
    i = width * np.int64(load_int32(geometry.shading_faces, corner))
    j = width * np.int64(load_int32(geometry.shading_faces, corner + 1))
    k = width * np.int64(load_int32(geometry.shading_faces, corner + 2))
    w = ONE - u - v
    nx, ny, nz = (
        blend(rows, i, j, k, w, u, v),
        blend(rows, i + 1, j + 1, k + 1, w, u, v),
        blend(rows, i + 2, j + 2, k + 2, w, u, v),
    )
    if instance >= 0:
        m, at = load_int64(tables, MATRICES), 12 * np.int64(instance)
        nx, ny, nz = (
            load_float(m, at) * nx + load_float(m, at + 1) * ny + load_float(m, at + 2) * nz,
            load_float(m, at + 4) * nx + load_float(m, at + 5) * ny + load_float(m, at + 6) * nz,
            load_float(m, at + 8) * nx + load_float(m, at + 9) * ny + load_float(m, at + 10) * nz,
        )
    side = ONE if nx * gx + ny * gy + nz * gz > ZERO else -ONE
    normals = _unit_row(rows, i), _unit_row(rows, j), _unit_row(rows, k)
    h = height((a, b, c), normals, u, v, side)
    hx, hy, hz = h * nx, h * ny, h * nz
    if not abs(hx) + abs(hy) + abs(hz) < F(1e18):
        return ZERO, ZERO, ZERO, ZERO
    return hx, hy, hz, limit


def terminators(face: Array, instance: Array, barycentric: Array, geometric_normal: Array, geometry: Geometry) -> Array:
    """(n, 4) float32: results of `terminator_at` for many points.

    Parameters
    ----------
    face, instance : (n,) int32 array
    barycentric : (n, 2) float32 array
    geometric_normal : (n, 3) float32 array
    geometry : Geometry
    """
    out = np.empty((len(face), 4), np.float32)
    over_range(_many, len(out), face, instance, barycentric, geometric_normal, geometry, out, fewest=ELEMENTS)
    return out


@njit
def _many(first, last, face, instance, where, normal, geometry, out):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = terminator_at(
            face[i], instance[i], where[i, 0], where[i, 1], normal[i, 0], normal[i, 1], normal[i, 2], geometry
        )
