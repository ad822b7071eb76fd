"""Normal maps and bump maps at a point of a surface: shading normals as Cycles makes them.

Normal maps are those of Cycles' ``svm_node_normal_map``: in tangent space the frame is that of the shape, before its
matrix, of blended, not normalised tangents and normals of the corners. Bump maps are those of
``svm_node_set_bump`` (Mikkelsen 2010), with derivatives of the height instead of differences over a part of a pixel.
"""

from __future__ import annotations

import math

import numpy as np

from ...compute.jit import njit
from ..memory import load_float, load_int32, load_int64
from ..sampling import ONE, TWO, ZERO, F
from .tangents import tangent_at
from .texture_lookup import blend, colour_at
from .texture_slopes import slopes_at

#: Kinds of steps. The two of Blender's own have y and z the other way round.
KINDS = {"tangent": 0, "object": 1, "world": 2, "blender_object": 3, "blender_world": 4, "bump": 5}
_TANGENT, _OBJECT, _WORLD, _BLENDER_OBJECT, _BLENDER_WORLD, _BUMP = range(6)
#: Columns of a step's integers and numbers; of a material's slots; of a mesh's frame.
KIND, TEXTURE, TANGENTS, STEP_INTS = 0, 1, 2, 4
STRENGTH, DISTANCE, COLOUR, STEP_FLOATS = 0, 1, 2, 8
ALPHA, FIRST_STEP, STEPS, FRAME, SLOTS = 4, 5, 6, 7, 8
NORMALS, VERTICES, FACES, MATRICES, TURNS, FRAME_INTS = 0, 1, 2, 3, 4, 5
#: Places of the tables in ``Geometry.materials``.
STEP_TABLE, NUMBER_TABLE, ALPHA_TABLE, MULTISCATTER_TABLE, FRAME_TABLE = 7, 8, 9, 10, 11
_TINY = F(1e-30)


@njit
def _unit(x, y, z, ox, oy, oz):  # type: ignore[no-untyped-def]
    """(x, y, z) at unit length; (ox, oy, oz) where it has none."""
    length = x * x + y * y + z * z
    if not (length > _TINY and length < F(1e30)):
        return ox, oy, oz
    scale = ONE / math.sqrt(length)
    return x * scale, y * scale, z * scale


@njit
def _turned(matrix, row, stride, x, y, z):  # type: ignore[no-untyped-def]
    """A vector through the linear part of a row-major matrix whose rows lie `stride` apart."""
    m = matrix
    return (
        load_float(m, row) * x + load_float(m, row + 1) * y + load_float(m, row + 2) * z,
        load_float(m, row + stride) * x + load_float(m, row + stride + 1) * y + load_float(m, row + stride + 2) * z,
        load_float(m, row + 2 * stride) * x
        + load_float(m, row + 2 * stride + 1) * y
        + load_float(m, row + 2 * stride + 2) * z,
    )


@njit
def _in_tangent_frame(corners, place, tangents, frames, frame, layers):  # type: ignore[no-untyped-def]
    """Normal and tangent of the shape, blended from the corners, and the sign of the bitangent."""
    _, _, _, u, v = place
    w = ONE - u - v
    i, j, k = corners
    rows = load_int64(frames, frame + NORMALS)
    nx = blend(rows, i, j, k, w, u, v)
    ny = blend(rows, i + 1, j + 1, k + 1, w, u, v)
    nz = blend(rows, i + 2, j + 2, k + 2, w, u, v)
    tx, ty, tz, sign = tangent_at(tangents, corners, place, rows, layers)
    return nx, ny, nz, tx, ty, tz, sign


@njit
def _mapped(kind, strength, colour, normal, side, frame_of, at):  # type: ignore[no-untyped-def]
    """The normal that a normal map says."""
    nx, ny, nz = normal
    x, y, z = TWO * (colour[0] - F(0.5)), TWO * (colour[1] - F(0.5)), TWO * (colour[2] - F(0.5))
    corners, place, instance = at
    frames, frame, tangents, layers = frame_of
    if kind == _TANGENT:
        ax, ay, az, tx, ty, tz, sign = _in_tangent_frame(corners, place, tangents, frames, frame, layers)
        x, y = strength * x, strength * y
        share = min(max(strength, ZERO), ONE)
        z = ONE + share * (z - ONE)
        bx, by, bz = sign * (ay * tz - az * ty), sign * (az * tx - ax * tz), sign * (ax * ty - ay * tx)
        x, y, z = x * tx + y * bx + z * ax, x * ty + y * by + z * ay, x * tz + y * bz + z * az
    elif kind in (_BLENDER_OBJECT, _BLENDER_WORLD):
        y, z = -y, -z
    if kind in (_TANGENT, _OBJECT, _BLENDER_OBJECT):
        x, y, z = _unit(x, y, z, ZERO, ZERO, ZERO)
        x, y, z = _turned(load_int64(frames, frame + TURNS), 9 * instance, 3, x, y, z)
    x, y, z = _unit(side * x, side * y, side * z, nx, ny, nz)
    if kind != _TANGENT and strength != ONE:
        x, y, z = _unit(nx + strength * (x - nx), ny + strength * (y - ny), nz + strength * (z - nz), nx, ny, nz)
    return x, y, z


@njit
def _edges(face, frames, frame):  # type: ignore[no-untyped-def]
    """Both edges of a face from its first corner, object space."""
    faces, v = load_int64(frames, frame + FACES), load_int64(frames, frame + VERTICES)
    i = 3 * np.int64(load_int32(faces, 3 * face))
    j, k = 3 * np.int64(load_int32(faces, 3 * face + 1)), 3 * np.int64(load_int32(faces, 3 * face + 2))
    x, y, z = load_float(v, i), load_float(v, i + 1), load_float(v, i + 2)
    return (
        (load_float(v, j) - x, load_float(v, j + 1) - y, load_float(v, j + 2) - z),
        (load_float(v, k) - x, load_float(v, k + 1) - y, load_float(v, k + 2) - z),
    )


@njit
def _bumped(height, strength, normal, edges, matrix, instance):  # type: ignore[no-untyped-def]
    """The normal of a surface that rises by `height`, metres along the two edges of its face."""
    nx, ny, nz = normal
    first, second = edges
    ax, ay, az = _turned(matrix, 12 * instance, 4, first[0], first[1], first[2])
    bx, by, bz = _turned(matrix, 12 * instance, 4, second[0], second[1], second[2])
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    det = cx * nx + cy * ny + cz * nz
    # (height_1 b - height_2 a) x n, the gradient along the surface times the determinant.
    dx, dy, dz = height[0] * bx - height[1] * ax, height[0] * by - height[1] * ay, height[0] * bz - height[1] * az
    sx, sy, sz = dy * nz - dz * ny, dz * nx - dx * nz, dx * ny - dy * nx
    scale = ONE / max(abs(det), _TINY)
    sign = scale if det >= ZERO else -scale
    x, y, z = _unit(nx - sign * sx, ny - sign * sy, nz - sign * sz, nx, ny, nz)
    share = max(strength, ZERO)
    return _unit(
        nx + share * (x - nx), ny + share * (y - ny), nz + share * (z - nz), nx, ny, nz,
    )  # fmt: skip


@njit
def detailed_normal(material, corners, place, instance, normal, side, geometry):  # type: ignore[no-untyped-def]
    """Shading normal with the normal and bump maps of a material.

    Parameters
    ----------
    material : int32
        Row of the table.
    corners : tuple of int64
        Where the normals of the face's corners lie, in rows of three of ``Geometry.normals``.
    place : tuple
        See `texture_lookup`.
    instance : int32
        Row of the instance, or -1.
    normal : tuple of float32
        Shading normal without them, unit, world, towards the viewer.
    side : float32
        1 where that is the normal of the shape, -1 where it was turned towards the viewer.
    geometry : Geometry

    Returns
    -------
    nx, ny, nz : float32
        Unit, world.
    """
    m = geometry.materials
    addresses = (
        load_int64(m, 0), load_int64(m, 1), load_int64(m, 2), load_int64(m, 3), load_int64(m, 4), load_int64(m, 5),
        load_int64(m, 6),
    )  # fmt: skip
    steps, numbers, frames = load_int64(m, STEP_TABLE), load_int64(m, NUMBER_TABLE), load_int64(m, FRAME_TABLE)
    slot = SLOTS * np.int64(material)
    first, count = load_int32(addresses[1], slot + FIRST_STEP), load_int32(addresses[1], slot + STEPS)
    frame = FRAME_INTS * np.int64(load_int32(addresses[1], slot + FRAME))
    which = np.int64(max(instance, np.int32(0)))
    nx, ny, nz = normal
    for step in range(first, first + count):
        i, k = STEP_INTS * np.int64(step), STEP_FLOATS * np.int64(step)
        kind, texture = load_int32(steps, i + KIND), np.int64(load_int32(steps, i + TEXTURE))
        strength, distance = load_float(numbers, k + STRENGTH), load_float(numbers, k + DISTANCE)
        k += COLOUR
        r, g, b = load_float(numbers, k), load_float(numbers, k + 1), load_float(numbers, k + 2)
        if kind == _BUMP:
            if texture >= 0:
                up, right = slopes_at(texture, place, addresses, geometry.uvs)
                scale = r * distance
                edges = _edges(np.int64(place[2]), frames, frame)
                matrix = load_int64(frames, frame + MATRICES)
                height = (scale * up, scale * right)
                nx, ny, nz = _bumped(height, strength, (nx, ny, nz), edges, matrix, which)
        else:
            if texture >= 0:
                x, y, z = colour_at(texture, place, addresses)
                r, g, b = r * x, g * y, b * z
            tangents = np.int64(load_int32(steps, i + TANGENTS))
            frame_of = (frames, frame, tangents, addresses[6])
            at = (corners, place, which)
            nx, ny, nz = _mapped(kind, strength, (r, g, b), (nx, ny, nz), side, frame_of, at)
    return nx, ny, nz
