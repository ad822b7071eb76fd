"""Tangents at the corners of a mesh's faces, as MikkTSpace makes them (Mikkelsen 2008), which Cycles and glTF use.

Corners of one position, normal and texture coordinates share a tangent, where their faces lie the same way round in the
texture. Faces that meet in a corner without sharing an edge there share it too, unlike in MikkTSpace.

A tangent lies in the plane of its normal, so it is kept as one word: its direction there, counted along the diamond
|x| + |y| = 1 of the normal's own frame in steps of 2e-9, and the sign of the bitangent.
"""

from __future__ import annotations

import math

import numpy as np

from ...compute.jit import njit, plain
from ..memory import load_float, load_int64, load_uint32
from ..sampling import ONE, ZERO, F, basis

Array = np.ndarray

#: Numbers of a corner in the table of layers: what tells tangents from values.
WORDS = 1
_NUMBERS = 8  # that tell corners apart: three of the position, three of the normal, two of the texture
_TINY = np.float64(np.finfo(np.float32).tiny)
#: A word, from its lowest bit on: whether the sign is positive; steps along a side of the diamond; its quarter.
_STEP_BITS = 29
_STEPS = (1 << _STEP_BITS) - 1
_STEP = F(2.0**-_STEP_BITS)
#: Of corners that have no tangent: x, as in MikkTSpace.
_NONE = 0xFFFFFFFF


def corner_tangents(vertices: Array, faces: Array, normals: Array, rows: Array, uvs: Array) -> Array:
    """Tangents along u.

    Parameters
    ----------
    vertices : (n, 3) float32 array
        Object space.
    faces : (m, 3) int32 array
    normals : (k, 3) float32 array
        Unit, object space.
    rows : (m, 3) int32 array
        Which of the normals each corner has.
    uvs : (m, 3, 2) float32 array

    Returns
    -------
    (m, 3, WORDS) uint32 array
        For `tangent_at`.
    """
    count = 3 * len(faces)
    faces, rows = plain(np.asarray(faces, np.int32)), plain(np.asarray(rows, np.int32))
    given = [plain(np.asarray(array, np.float32)) for array in (vertices, normals, uvs)]
    group = np.empty(count, np.int32)
    table = np.full(1 << max(2 * count - 1, 1).bit_length(), -1, np.int32)
    groups = _group(faces, rows, *(array.view(np.uint32) for array in given), table, group)
    del table
    sums = np.zeros((2 * groups, 3))
    _add_up(faces, rows, *given, group, sums)
    out = np.empty((len(faces), 3, WORDS), np.uint32)
    _share_out(faces, rows, given[1], given[2], group, sums, out)
    return out


@njit
def tangent_at(layer, corners, place, normals, layers):  # type: ignore[no-untyped-def]
    """Tangent of the shape at a place, blended from the corners of its face.

    Parameters
    ----------
    layer : int64
        Row of `layers`.
    corners : tuple of int64
        Where the normals of the face's corners lie, from `normals` on.
    place : tuple
        See `texture_lookup`.
    normals, layers : int64
        Addresses of the normals that the tangents were made with, and of the table, see `mesh_layers.MeshLayers`.

    Returns
    -------
    x, y, z : float32
        Object space, not of unit length.
    sign : float32
        Of the bitangent, which is sign times normal x tangent.
    """
    _, _, face, u, v = place
    words, first, w = load_int64(layers, 2 * layer), 3 * np.int64(face), ONE - u - v
    i, j, k = corners
    ax, ay, az, a = _unpacked(np.int64(load_uint32(words, first)), normals, i)
    bx, by, bz, b = _unpacked(np.int64(load_uint32(words, first + 1)), normals, j)
    cx, cy, cz, c = _unpacked(np.int64(load_uint32(words, first + 2)), normals, k)
    return w * ax + u * bx + v * cx, w * ay + u * by + v * cy, w * az + u * bz + v * cz, w * a + u * b + v * c


@njit
def _unpacked(word, normals, corner):  # type: ignore[no-untyped-def]
    """Unit tangent of a corner, and the sign of its bitangent."""
    if word == _NONE:
        return ONE, ZERO, ZERO, ONE
    part = F((word >> 1) & _STEPS) * _STEP
    quarter = word >> (_STEP_BITS + 1)
    x, y = ONE - part, part
    if (quarter & 1) > 0:
        x, y = -y, x
    if (quarter & 2) > 0:
        x, y = -x, -y
    scale = ONE / math.sqrt(x * x + y * y)
    x, y = x * scale, y * scale
    ax, ay, az, bx, by, bz = basis(
        load_float(normals, corner), load_float(normals, corner + 1), load_float(normals, corner + 2)
    )
    return x * ax + y * bx, x * ay + y * by, x * az + y * bz, ONE if (word & 1) > 0 else -ONE


@njit
def _packed(x, y, z, sign, nx, ny, nz):  # type: ignore[no-untyped-def]
    """What `_unpacked` reads, of a unit tangent in the plane of a normal."""
    ax, ay, az, bx, by, bz = basis(nx, ny, nz)
    s, t = x * ax + y * ay + z * az, x * bx + y * by + z * bz
    along = abs(s) + abs(t)
    if not along > 1e-3:
        return np.uint32(_NONE)
    if t >= 0.0:
        quarter, part = (0, t) if s > 0.0 else (1, -s)
    else:
        quarter, part = (2, -t) if s < 0.0 else (3, s)
    # The last step is that of `_NONE`.
    step = min(np.int64(part / along * (_STEPS + 1) + 0.5), _STEPS - 1)
    return np.uint32(quarter << (_STEP_BITS + 1) | step << 1 | (1 if sign > 0.0 else 0))


@njit
def _bits(vertices, faces, normals, rows, uvs, corner, k):  # type: ignore[no-untyped-def]
    """Bits of number k of a corner; 0 is 0, whatever its sign."""
    face, place = corner // 3, corner % 3
    if k < 3:
        bits = vertices[faces[face, place], k]
    elif k < 6:
        bits = normals[rows[face, place], k - 3]
    else:
        bits = uvs[face, place, k - 6]
    return np.uint32(0) if bits == np.uint32(0x80000000) else np.uint32(bits)


@njit
def _group(faces, rows, vertices, normals, uvs, table, group):  # type: ignore[no-untyped-def]
    """Number corners by what tells them apart, in the order of their first; how many groups there are.

    `table` is a hash table, open addressing, of the first corner of each group; its size is a power of 2.
    """
    last, groups = np.int64(len(table) - 1), 0
    for corner in range(len(group)):
        mixed = np.uint32(2166136261)
        for k in range(_NUMBERS):
            mixed = np.uint32((mixed ^ _bits(vertices, faces, normals, rows, uvs, corner, k)) * np.uint32(0x85EBCA6B))
            mixed = np.uint32(mixed ^ (mixed >> np.uint32(13)))
        slot = np.int64(mixed) & last
        while True:
            first = table[slot]
            if first < 0:
                table[slot], group[corner] = corner, groups
                groups += 1
                break
            same = True
            for k in range(_NUMBERS):
                mine = _bits(vertices, faces, normals, rows, uvs, corner, k)
                same = same and mine == _bits(vertices, faces, normals, rows, uvs, first, k)
            if same:
                group[corner] = group[first]
                break
            slot = (slot + 1) & last
    return groups


@njit
def _unit(x, y, z):  # type: ignore[no-untyped-def]
    """At unit length; zero where there is none."""
    length = math.sqrt(x * x + y * y + z * z)
    if not length > 1e-300:
        return 0.0, 0.0, 0.0
    return x / length, y / length, z / length


@njit
def _in_plane(x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Unit part of a vector in the plane of a normal."""
    along = x * nx + y * ny + z * nz
    return _unit(x - along * nx, y - along * ny, z - along * nz)


@njit
def _area(uvs, face):  # type: ignore[no-untyped-def]
    """Twice the area of a face in the texture; positive if it is counter-clockwise there."""
    u, v = np.float64(uvs[face, 0, 0]), np.float64(uvs[face, 0, 1])
    au, av, bu, bv = uvs[face, 1, 0] - u, uvs[face, 1, 1] - v, uvs[face, 2, 0] - u, uvs[face, 2, 1] - v
    return au * bv - av * bu, av, bv


@njit
def _add_up(faces, rows, vertices, normals, uvs, group, sums):  # type: ignore[no-untyped-def]
    """Sum the directions of u over the corners of each group, weighted by angle, per side of the texture."""
    for face in range(len(faces)):
        area, av, bv = _area(uvs, face)
        if not abs(area) > _TINY:
            continue
        sign, side = (1.0, 1) if area > 0.0 else (-1.0, 0)
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        px, py, pz = np.float64(vertices[a, 0]), np.float64(vertices[a, 1]), np.float64(vertices[a, 2])
        ux, uy, uz = vertices[b, 0] - px, vertices[b, 1] - py, vertices[b, 2] - pz
        vx, vy, vz = vertices[c, 0] - px, vertices[c, 1] - py, vertices[c, 2] - pz
        tx, ty, tz = _unit(
            sign * (bv * ux - av * vx), sign * (bv * uy - av * vy), sign * (bv * uz - av * vz)
        )  # fmt: skip
        for k in range(3):
            n = rows[face, k]
            nx, ny, nz = np.float64(normals[n, 0]), np.float64(normals[n, 1]), np.float64(normals[n, 2])
            here, right, left = faces[face, k], faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
            px, py, pz = np.float64(vertices[here, 0]), np.float64(vertices[here, 1]), np.float64(vertices[here, 2])
            ex, ey, ez = _in_plane(
                vertices[right, 0] - px, vertices[right, 1] - py, vertices[right, 2] - pz, nx, ny, nz
            )  # fmt: skip
            fx, fy, fz = _in_plane(
                vertices[left, 0] - px, vertices[left, 1] - py, vertices[left, 2] - pz, nx, ny, nz
            )  # fmt: skip
            angle = math.acos(min(max(ex * fx + ey * fy + ez * fz, -1.0), 1.0))
            gx, gy, gz = _in_plane(tx, ty, tz, nx, ny, nz)
            row = 2 * group[3 * face + k] + side
            sums[row, 0] += angle * gx
            sums[row, 1] += angle * gy
            sums[row, 2] += angle * gz


@njit
def _share_out(faces, rows, normals, uvs, group, sums, out):  # type: ignore[no-untyped-def]
    """Write the tangent of its group to each corner.

    A face without extent in the texture takes the tangent of its neighbours, whichever way round they lie.
    """
    for face in range(len(faces)):
        area, _, _ = _area(uvs, face)
        side = 1 if area > 0.0 else 0
        for k in range(3):
            row, sign = 2 * group[3 * face + k] + side, 1.0 if side else -1.0
            x, y, z = _unit(sums[row, 0], sums[row, 1], sums[row, 2])
            if x == 0.0 and y == 0.0 and z == 0.0:
                row, sign = row ^ 1, -sign
                x, y, z = _unit(sums[row, 0], sums[row, 1], sums[row, 2])
            n = rows[face, k]
            out[face, k, 0] = _packed(x, y, z, sign, normals[n, 0], normals[n, 1], normals[n, 2])
