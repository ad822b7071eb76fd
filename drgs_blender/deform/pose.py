"""A surfel posed by its mesh, see `mesh_driven`: for Numba, called by `pose_blocks`, and by translation for Warp."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..compute.jit import njit

Array = np.ndarray

#: Surfels of a block.
_BLOCK = 256


class PosedMesh(NamedTuple):
    """A mesh in the world.

    Attributes
    ----------
    vertices : (k, 3) float32 array
        Metres.
    faces : (m, 3) int32 array
    normals : (k, 3) or (3 m, 3) float32 array
        Unit ones, of the vertices or of the corners.
    """

    vertices: Array
    faces: Array
    normals: Array


class Rest(NamedTuple):
    """Surfels bound to a mesh, at rest.

    Attributes
    ----------
    face : (n,) int32 array
    weights : (n, 3) float32 array
        Barycentric coordinates.
    offset : (n,) float32 array
        Metres off the face.
    rest_edge : (m,) float32 array
        Mean edge of the faces that have no area, metres; else 0.
    normal : (n, 3) float32 array
        In the smooth shading frame.
    coordinates : (n, 3, 2) float32 array
        Tangents in the frame of the face's edges and its normal.
    span : (n, 3) int32 array
        See `wide_support.spans`.
    in_span : (n, 3, 2) float32 array
        Tangents in the frame of the span's edges and normal.
    """

    face: Array
    weights: Array
    offset: Array
    rest_edge: Array
    normal: Array
    coordinates: Array
    span: Array
    in_span: Array


class Posed(NamedTuple):
    """Surfels in the world.

    Attributes
    ----------
    centre, tangent_u, tangent_v, normal : (n, 3) float32 array
        Metres; unit normals.
    opacity : (n,) float32 array
        Changed to 0 where a vertex is not finite.
    """

    centre: Array
    tangent_u: Array
    tangent_v: Array
    normal: Array
    opacity: Array


@njit
def _transformed_normal(linear: Any, nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """A unit normal n as an offset vector through matrix_world: A normalise(A^T n), A its linear part."""
    ox = linear[0, 0] * nx + linear[1, 0] * ny + linear[2, 0] * nz
    oy = linear[0, 1] * nx + linear[1, 1] * ny + linear[2, 1] * nz
    oz = linear[0, 2] * nx + linear[1, 2] * ny + linear[2, 2] * nz
    length = math.sqrt(ox * ox + oy * oy + oz * oz)
    length = 1.0 / length if length > 1e-300 else 0.0
    ox, oy, oz = ox * length, oy * length, oz * length
    return (
        linear[0, 0] * ox + linear[0, 1] * oy + linear[0, 2] * oz,
        linear[1, 0] * ox + linear[1, 1] * oy + linear[1, 2] * oz,
        linear[2, 0] * ox + linear[2, 1] * oy + linear[2, 2] * oz,
    )


@njit
def _tangents(u: Any, v: Any, h: Any, coordinates: Any, i: Any) -> tuple[float, float, float, float, float, float]:
    """Both tangents of a surfel whose `coordinates` are in the frame of u, v and h, each (x, y, z)."""
    ux, uy, uz = u
    vx, vy, vz = v
    hx, hy, hz = h
    p, q, r = coordinates[i, 0, 0], coordinates[i, 1, 0], coordinates[i, 2, 0]
    a, b, c = coordinates[i, 0, 1], coordinates[i, 1, 1], coordinates[i, 2, 1]
    return (
        ux * p + vx * q + hx * r, uy * p + vy * q + hy * r, uz * p + vz * q + hz * r,
        ux * a + vx * b + hx * c, uy * a + vy * b + hy * c, uz * a + vz * b + hz * c,
    )  # fmt: skip


@njit
def tangent_frame(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float, sx: float, sy: float, sz: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Axes t, b, s of the shading frame: s = normalised (sx, sy, sz), t = a (else b, else an axis) projected off s."""
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    if not (length > 1e-12):
        sx, sy, sz, length = 0.0, 0.0, 1.0, 1.0
    sx, sy, sz = sx / length, sy / length, sz / length
    tx, ty, tz, length = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        if k == 1:
            ax, ay, az = bx, by, bz
        elif k == 2:
            along_x = abs(sx) <= abs(sy) and abs(sx) <= abs(sz)
            along_y = not along_x and abs(sy) <= abs(sz)
            ax, ay = 1.0 if along_x else 0.0, 1.0 if along_y else 0.0
            az = 1.0 - ax - ay
        d = ax * sx + ay * sy + az * sz
        tx, ty, tz = ax - d * sx, ay - d * sy, az - d * sz
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
        if length > 1e-6 * math.sqrt(ax * ax + ay * ay + az * az):
            break
    tx, ty, tz = tx / length, ty / length, tz / length
    return tx, ty, tz, sy * tz - sz * ty, sz * tx - sx * tz, sx * ty - sy * tx, sx, sy, sz


@njit
def pose_surfel(i, mesh, by_corner, linear, sign, rest, out):  # type: ignore[no-untyped-def]
    """Pose one surfel.

    Arithmetic in double so that a small object far from the origin stays exact.

    Parameters
    ----------
    i : int
        Its index.
    mesh : PosedMesh
        Or a tuple in its order, as devices have it; so `rest` and `out`.
    by_corner : bool
        Whether the mesh has normals of its corners.
    linear : (3, 3) float64 array
        Of the object's matrix.
    sign : float
        -1 if that mirrors (swaps handedness), else 1.
    rest : Rest
    out : Posed
        Written.
    """
    vertices, faces, normals = mesh
    face, weights, offset, rest_edge, local_normal, coordinates, span, in_span = rest
    centre, tangent_u, tangent_v, normal, opacity = out
    f = face[i]
    ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
    wa, wb, wc = np.float64(weights[i, 0]), np.float64(weights[i, 1]), np.float64(weights[i, 2])
    ax, ay, az = np.float64(vertices[ia, 0]), np.float64(vertices[ia, 1]), np.float64(vertices[ia, 2])
    ux, uy, uz = vertices[ib, 0] - ax, vertices[ib, 1] - ay, vertices[ib, 2] - az
    vx, vy, vz = vertices[ic, 0] - ax, vertices[ic, 1] - ay, vertices[ic, 2] - az
    size = abs(ax) + abs(ay) + abs(az) + abs(ux) + abs(uy) + abs(uz) + abs(vx) + abs(vy) + abs(vz)
    if not (size < 1e30):  # a comparison: math.isfinite(a + b) is folded to True when sums may be reordered
        opacity[i] = 0.0
        for k in range(3):
            centre[i, k] = tangent_u[i, k] = tangent_v[i, k] = 0.0
            normal[i, k] = 1.0 if k == 2 else 0.0
        return

    # Smooth normal: of the vertices or of the corners.
    ja, jb, jc = (3 * f, 3 * f + 1, 3 * f + 2) if by_corner else (ia, ib, ic)
    pa, pb, pc = max(wa, 0.0), max(wb, 0.0), max(wc, 0.0)  # weights may leave the face, its normal does not
    sx = pa * normals[ja, 0] + pb * normals[jb, 0] + pc * normals[jc, 0]
    sy = pa * normals[ja, 1] + pb * normals[jb, 1] + pc * normals[jc, 1]
    sz = pa * normals[ja, 2] + pb * normals[jb, 2] + pc * normals[jc, 2]

    # Outward unit face normal; a collapsed face takes the smooth one.
    nx, ny, nz = sign * (uy * vz - uz * vy), sign * (uz * vx - ux * vz), sign * (ux * vy - uy * vx)
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    uu, vv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    if not (length > 1e-10 * (uu + vv)):
        nx, ny, nz = sx, sy, sz
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        if not (length > 1e-12):
            nx, ny, nz, length = 0.0, 0.0, 1.0, 1.0
    nx, ny, nz = nx / length, ny / length, nz / length
    if not (sx * sx + sy * sy + sz * sz > 1e-12):
        sx, sy, sz = nx, ny, nz
    tx, ty, tz, bx, by, bz, sx, sy, sz = tangent_frame(ux, uy, uz, vx, vy, vz, sx, sy, sz)

    hx, hy, hz = _transformed_normal(linear, nx, ny, nz)
    d = np.float64(offset[i])
    centre[i, 0] = ax + wb * ux + wc * vx + d * hx
    centre[i, 1] = ay + wb * uy + wc * vy + d * hy
    centre[i, 2] = az + wb * uz + wc * vz + d * hz

    if rest_edge[f] > 0.0:
        wx, wy, wz = vx - ux, vy - uy, vz - uz
        edges = math.sqrt(uu) + math.sqrt(vv) + math.sqrt(wx * wx + wy * wy + wz * wz)
        grow = edges / (3.0 * rest_edge[f])
        ux, uy, uz = grow * tx, grow * ty, grow * tz
        vx, vy, vz = sign * grow * bx, sign * grow * by, sign * grow * bz
        hx, hy, hz = grow * sx, grow * sy, grow * sz
    fx, fy, fz, gx, gy, gz = _tangents((ux, uy, uz), (vx, vy, vz), (hx, hy, hz), coordinates, i)
    if span[i, 0] >= 0:
        ia, ib, ic = span[i, 0], span[i, 1], span[i, 2]
        ax, ay, az = np.float64(vertices[ia, 0]), np.float64(vertices[ia, 1]), np.float64(vertices[ia, 2])
        ux, uy, uz = vertices[ib, 0] - ax, vertices[ib, 1] - ay, vertices[ib, 2] - az
        vx, vy, vz = vertices[ic, 0] - ax, vertices[ic, 1] - ay, vertices[ic, 2] - az
        nx, ny, nz = sign * (uy * vz - uz * vy), sign * (uz * vx - ux * vz), sign * (ux * vy - uy * vx)
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        if length > 1e-10 * (ux * ux + uy * uy + uz * uz + vx * vx + vy * vy + vz * vz):
            hx, hy, hz = _transformed_normal(linear, nx / length, ny / length, nz / length)
            px, py, pz, qx, qy, qz = _tangents((ux, uy, uz), (vx, vy, vz), (hx, hy, hz), in_span, i)
            own = fx * fx + fy * fy + fz * fz + gx * gx + gy * gy + gz * gz
            if px * px + py * py + pz * pz + qx * qx + qy * qy + qz * qz < own:  # a comparison: false if not finite
                fx, fy, fz, gx, gy, gz = px, py, pz, qx, qy, qz
    tangent_u[i, 0], tangent_u[i, 1], tangent_u[i, 2] = fx, fy, fz
    tangent_v[i, 0], tangent_v[i, 1], tangent_v[i, 2] = gx, gy, gz

    lx, ly, lz = np.float64(local_normal[i, 0]), sign * local_normal[i, 1], np.float64(local_normal[i, 2])
    nx = tx * lx + bx * ly + sx * lz
    ny = ty * lx + by * ly + sy * lz
    nz = tz * lx + bz * ly + sz * lz
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if not (length > 1e-12):
        nx, ny, nz, length = sx, sy, sz, 1.0
    normal[i, 0], normal[i, 1], normal[i, 2] = nx / length, ny / length, nz / length


@njit
def pose_surfels(thread, stride, scratch, mesh, by_corner, linear, sign, rest, out):  # type: ignore[no-untyped-def]
    """Pose every `stride`-th block of surfels, from the `thread`-th on.

    Parameters
    ----------
    thread, stride : int
    scratch : object
        Not used.
    mesh, by_corner, linear, sign, rest, out : object
        As of `pose_surfel`.
    """
    face = rest[0]
    for block in range(thread, (len(face) + _BLOCK - 1) // _BLOCK, stride):
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, len(face))):
            pose_surfel(i, mesh, by_corner, linear, sign, rest, out)
