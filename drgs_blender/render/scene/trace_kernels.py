"""Vertices, normals and materials of one object on their way into the traced scene's arrays, compiled."""

from __future__ import annotations

import numpy as np

from ...compute.jit import inlined, njit
from ..surfel_columns import ALBEDO, METALLIC, ROUGHNESS

#: Coordinates beyond this (metres) are as unusable as NaN: their products overflow.
FARTHEST = 1e15


@njit
def _put(x, y, z, target, i):  # type: ignore[no-untyped-def]
    """Put a vertex, or the origin for an unusable one, to row i: 1 if unusable, 1 if changed, largest coordinate."""
    zero = np.float32(0.0)
    size = max(abs(x), max(abs(y), abs(z)))
    # A NaN may hide in the maximum, yet not in the sum.
    usable = size < FARTHEST and abs(x + y + z) < 4 * FARTHEST
    if not usable:
        x, y, z, size = zero, zero, zero, zero
    changed = x != target[i, 0] or y != target[i, 1] or z != target[i, 2]
    if changed:
        target[i, 0], target[i, 1], target[i, 2] = x, y, z
    return int(not usable), int(changed), size


@njit
def copy_vertices(first, last, source, target):  # type: ignore[no-untyped-def]
    """Copy usable vertices, put the others at the origin: how many those are, how many moved, largest coordinate.

    Parameters
    ----------
    first, last : int
        Rows, of all.
    source, target : (n, 3) float32 array
        Metres; `target` is written.

    Returns
    -------
    bad, moved : int
    reach : float32
    """
    bad = moved = 0
    reach = np.float32(0.0)
    for i in range(first, last):
        unusable, changed, size = _put(source[i, 0], source[i, 1], source[i, 2], target, i)
        bad, moved, reach = bad + unusable, moved + changed, max(reach, size)
    return bad, moved, reach


@njit
def move_vertices(first, last, source, matrix, target):  # type: ignore[no-untyped-def]
    """As `copy_vertices`, moved by a (3, 4) float64 matrix.

    Parameters
    ----------
    first, last : int
        Rows, of all.
    source, target : (n, 3) float32 array
    matrix : (3, 4) float64 array

    Returns
    -------
    bad, moved : int
    reach : float32
    """
    bad = moved = 0
    reach = np.float32(0.0)
    m00, m01, m02, m03 = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    m10, m11, m12, m13 = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    m20, m21, m22, m23 = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    for i in range(first, last):
        a, b, c = source[i, 0], source[i, 1], source[i, 2]
        x = np.float32(m00 * a + m01 * b + m02 * c + m03)
        y = np.float32(m10 * a + m11 * b + m12 * c + m13)
        z = np.float32(m20 * a + m21 * b + m22 * c + m23)
        unusable, changed, size = _put(x, y, z, target, i)
        bad, moved, reach = bad + unusable, moved + changed, max(reach, size)
    return bad, moved, reach


@inlined
def _doubled_area(vertices, faces, f):  # type: ignore[no-untyped-def]
    """Normal of a face, as long as its area is large, twice."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@inlined
def _unit_or(x, y, z, ux, uy, uz):  # type: ignore[no-untyped-def]
    """A normal made unit; (ux, uy, uz) where it is unusable."""
    length = np.sqrt(x * x + y * y + z * z)
    usable = length > 1e-12 and length < FARTHEST
    scale = np.float32(1.0) / length if usable else np.float32(0.0)
    return x * scale if usable else ux, y * scale if usable else uy, z * scale if usable else uz


@njit
def corner_normals(first, last, normals, vertices, faces, out):  # type: ignore[no-untyped-def]
    """Fill (3 m, 3) `out` with the (m, 3, 3) normals made unit; count the faces without area.

    Parameters
    ----------
    first, last : int
        Faces, of all.
    normals : (m, 3, 3) float32 array
    vertices : (n, 3) float32 array
    faces : (m, 3) int32 array
    out : (3 m, 3) float32 array
        Written; a face's own normal where the given one is unusable.

    Returns
    -------
    int
    """
    empty = 0
    for f in range(first, last):
        gx, gy, gz = _doubled_area(vertices, faces, f)
        area = np.sqrt(gx * gx + gy * gy + gz * gz)
        if area > np.float32(0.0):
            gx, gy, gz = gx / area, gy / area, gz / area
        else:
            empty += 1
            gx, gy, gz = np.float32(0.0), np.float32(0.0), np.float32(1.0)
        for k in range(3):
            x, y, z = _unit_or(normals[f, k, 0], normals[f, k, 1], normals[f, k, 2], gx, gy, gz)
            out[3 * f + k, 0], out[3 * f + k, 1], out[3 * f + k, 2] = x, y, z
    return empty


@njit
def unit_normals(first, last, normals, out):  # type: ignore[no-untyped-def]
    """Fill (n, 3) `out` with the normals made unit.

    Parameters
    ----------
    first, last : int
        Rows, of all.
    normals, out : (n, 3) float32 array
        `out` is written, (0, 0, 1) where a normal is unusable.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    for i in range(first, last):
        x, y, z = _unit_or(normals[i, 0], normals[i, 1], normals[i, 2], zero, zero, one)
        out[i, 0], out[i, 1], out[i, 2] = x, y, z


@njit
def count_empty(first, last, vertices, faces):  # type: ignore[no-untyped-def]
    """Faces without area.

    Parameters
    ----------
    first, last : int
        Faces, of all.
    vertices : (n, 3) float32 array
    faces : (m, 3) int32 array

    Returns
    -------
    int
    """
    empty = 0
    for f in range(first, last):
        gx, gy, gz = _doubled_area(vertices, faces, f)
        empty += int(not gx * gx + gy * gy + gz * gz > np.float32(0.0))
    return empty


@njit
def turn_normals(first, last, normals, matrix, out):  # type: ignore[no-untyped-def]
    """Unit normals through a (3, 3) matrix of normals; (0, 0, 1) where they have no direction.

    Parameters
    ----------
    first, last : int
        Rows, of all.
    normals, out : (n, 3) float32 array
        `out` is written.
    matrix : (3, 3) float64 array
    """
    for i in range(first, last):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        a = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z
        b = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z
        c = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z
        length = np.sqrt(a * a + b * b + c * c)
        if length > np.float32(1e-15):
            scale = np.float32(1.0) / length
            a, b, c = a * scale, b * scale, c * scale
        else:
            a, b, c = np.float32(0.0), np.float32(0.0), np.float32(1.0)
        out[i, 0], out[i, 1], out[i, 2] = a, b, c


@njit
def copy_materials(first, last, vertex, albedo, roughness, metallic, rows):  # type: ignore[no-untyped-def]
    """Copy the material of vertex[i] to shading row i, within [0, 1]; NaN becomes 0.

    Parameters
    ----------
    first, last : int
        Shading rows, of all.
    vertex : (k,) int32 array
    albedo : (n, 3) float32 array
        Linear Rec.709.
    roughness, metallic : (n,) float32 array
    rows : (k, VERTEX) float32 array
        Written.
    """
    for i in range(first, last):
        v = vertex[i]
        for k in range(3):
            rows[i, ALBEDO + k] = min(np.float32(1.0), max(np.float32(0.0), albedo[v, k]))
            if not rows[i, ALBEDO + k] >= 0.0:
                rows[i, ALBEDO + k] = 0.0
        rows[i, ROUGHNESS] = min(np.float32(1.0), max(np.float32(0.0), roughness[v]))
        rows[i, METALLIC] = min(np.float32(1.0), max(np.float32(0.0), metallic[v]))
        for k in (ROUGHNESS, METALLIC):
            if not rows[i, k] >= 0.0:
                rows[i, k] = 0.0
