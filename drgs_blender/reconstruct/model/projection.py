"""Surfels on the screen, forwards and backwards: what `raster` blends, as functions of centre and tangents.

In camera coordinates (x right, y down, depth along the view) the ray of a pixel at (ex, ey) from the projected centre
meets the plane c + u a + v b where, by Cramer's rule and with n = a x b, d = c . n,

    1 / z = (1, ex / fx, ey / fy) . (1 / c_z, n_x / d, n_y / d),
    u = z (ex / fx, ey / fy) . (b x c)_xy / d,    v = z (ex / fx, ey / fy) . (c x a)_xy / d:

nine numbers a surfel, the record. `render.surfels.splats` states the same, unscaled, for planes behind the camera too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import over_range
from ...render.camera import CLIP_END, CLIP_START, CX, CY, FX, FY, POSITION
from ...render.surfels.splats import MIN_ALPHA, span, to_camera

Array = np.ndarray

# Columns of a record: projected centre, coefficients of u, v and 1 / z; what follows is not differentiated here.
RX, RY, UX, UY, VX, VY, I0, IX, IY, OPACITY, CUT, DIM, RECORD = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12
#: Columns that have a gradient.
PARAMETERS = 10
#: Surfels seen at a smaller cosine are edge-on: not seen at all.
EDGE_ON = 1e-3
#: Fewest surfels for which another thread is worth while.
_FEW = 1024
#: Inverse variance of the screen-space filter, per square pixel: that of pictures with four samples a pixel. What it
#: shows is weakened by the cosine at which the surfel is seen (without a gradient): the many surfels edge-on along a
#: silhouette would else widen it by most of a pixel, and the shape would shrink by as much to fit the masks.
LOW_PASS = 8.0


class WorldSurfels(NamedTuple):
    """Surfels in world space, or the gradients of these numbers.

    Attributes
    ----------
    centre : (n, 3) float32 array
        Metres.
    tangent_u, tangent_v : (n, 3) float32 array
        Metres, scaled by the standard deviations.
    opacity : (n,) float32 array
    """

    centre: Array
    tangent_u: Array
    tangent_v: Array
    opacity: Array


class Projected(NamedTuple):
    """Surfels on the screen.

    Attributes
    ----------
    record : (n, RECORD) float32 array
        See this module's head.
    depth : (n,) float32 array
        Of the centres, metres along the view.
    box : (n, 4) int32 array
        Pixels (x0, y0, x1, y1) that may see them, half-open; empty where none does.
    """

    record: Array
    depth: Array
    box: Array


class Splat(NamedTuple):
    """A surfel's record: projected centre, coefficients of u, v and 1 / z, opacity, cut and dimming."""

    rx: np.float32
    ry: np.float32
    ux: np.float32
    uy: np.float32
    vx: np.float32
    vy: np.float32
    i0: np.float32
    ix: np.float32
    iy: np.float32
    opacity: np.float32
    cut: np.float32
    dim: np.float32


@inlined
def splat_of(record, i):  # type: ignore[no-untyped-def]
    """The record of surfel i.

    Parameters
    ----------
    record : (n, RECORD) float32 array
        `Projected.record`.
    i : int64

    Returns
    -------
    Splat
    """
    return Splat(
        record[i, RX], record[i, RY], record[i, UX], record[i, UY], record[i, VX], record[i, VY], record[i, I0],
        record[i, IX], record[i, IY], record[i, OPACITY], record[i, CUT], record[i, DIM],
    )  # fmt: skip


@njit
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit
def _in_camera(p, surfels, i):  # type: ignore[no-untyped-def]
    """Centre and tangents of surfel i in camera coordinates, float64."""
    centre, tangent_u, tangent_v, _ = surfels
    c = to_camera(
        p,
        np.float64(centre[i, 0]) - p[POSITION],
        np.float64(centre[i, 1]) - p[POSITION + 1],
        np.float64(centre[i, 2]) - p[POSITION + 2],
    )
    a = to_camera(p, np.float64(tangent_u[i, 0]), np.float64(tangent_u[i, 1]), np.float64(tangent_u[i, 2]))
    b = to_camera(p, np.float64(tangent_v[i, 0]), np.float64(tangent_v[i, 1]), np.float64(tangent_v[i, 2]))
    return c, a, b


@njit
def project_surfel(i, surfels, p, picture, out):  # type: ignore[no-untyped-def]
    """Project a surfel, see `project`.

    Parameters
    ----------
    i : int64
        Row of the surfel.
    surfels : WorldSurfels
        Or a tuple in its order, as devices have it; so `out`.
    p : (PARAMETERS,) float64 array
        `render.camera.camera_parameters`.
    picture : tuple of int
        Width and height, pixels.
    out : Projected
        Row `i` is written.
    """
    _, _, _, opacity = surfels
    width, height = picture
    record, depth, box = out
    for k in range(4):
        box[i, k] = 0
    near, far, fx, fy = p[CLIP_START], p[CLIP_END], p[FX], p[FY]
    c, a, b = _in_camera(p, surfels, i)
    alpha = np.float64(opacity[i])
    total = c[0] + c[1] + c[2] + a[0] + a[1] + a[2] + b[0] + b[1] + b[2] + alpha
    if not abs(total) < 1e30 or not alpha > MIN_ALPHA:
        return
    cut = 2.0 * np.log(alpha / MIN_ALPHA)
    reach = np.sqrt(cut * (a[2] * a[2] + b[2] * b[2]))
    if c[2] - reach <= near or c[2] >= far:
        return
    nx, ny, nz = _cross(a[0], a[1], a[2], b[0], b[1], b[2])
    d = c[0] * nx + c[1] * ny + c[2] * nz
    size = np.sqrt((c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) * (nx * nx + ny * ny + nz * nz))
    if not abs(d) > EDGE_ON * size:
        return
    rx, ry = p[CX] + fx * c[0] / c[2], p[CY] + fy * c[1] / c[2]
    x, y = c[0] / c[2], c[1] / c[2]
    disc_x0, disc_x1 = span(fx, rx, c[2], a[0] - x * a[2], b[0] - x * b[2], a[2], b[2], cut)
    disc_y0, disc_y1 = span(fy, ry, c[2], a[1] - y * a[2], b[1] - y * b[2], a[2], b[2], cut)
    low = np.sqrt(cut / LOW_PASS)
    lo_x, hi_x = min(disc_x0, rx - low), max(disc_x1, rx + low)
    lo_y, hi_y = min(disc_y0, ry - low), max(disc_y1, ry + low)
    if not (lo_x < width and hi_x > 0.0 and lo_y < height and hi_y > 0.0):
        return
    px, py, _ = _cross(b[0], b[1], b[2], c[0], c[1], c[2])
    qx, qy, _ = _cross(c[0], c[1], c[2], a[0], a[1], a[2])
    record[i, RX], record[i, RY], record[i, I0] = rx, ry, 1.0 / c[2]
    record[i, OPACITY], record[i, CUT], record[i, DIM] = alpha, cut, 2.0 * np.log(size / abs(d))
    record[i, UX], record[i, UY] = px / (d * fx), py / (d * fy)
    record[i, VX], record[i, VY] = qx / (d * fx), qy / (d * fy)
    record[i, IX], record[i, IY] = nx / (d * fx), ny / (d * fy)
    depth[i] = c[2]
    box[i, 0], box[i, 1] = np.int32(max(lo_x, 0.0)), np.int32(max(lo_y, 0.0))
    box[i, 2] = np.int32(min(np.floor(hi_x), width - 1.0)) + 1
    box[i, 3] = np.int32(min(np.floor(hi_y), height - 1.0)) + 1


def project(surfels: WorldSurfels, p: Array, picture: tuple[int, int], out: Projected) -> None:
    """Project surfels; what is not seen, or reaches behind the clip start, has an empty box.

    Parameters
    ----------
    surfels : WorldSurfels
    p : array
        `render.camera.camera_parameters` of a perspective camera.
    picture : tuple of int
        Width and height, pixels.
    out : Projected
        To be filled.
    """
    over_range(_project, len(surfels.opacity), surfels, p, picture, out, fewest=_FEW)


@njit
def _project(first, last, surfels, p, picture, out):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        project_surfel(i, surfels, p, picture, out)


@njit
def project_surfel_backward(k, surfels, p, index, gradient, out):  # type: ignore[no-untyped-def]
    """Gradients of a surfel's centre and tangents from those of its record, see `project_backward`.

    Parameters
    ----------
    k : int64
        Row of `index` and `gradient`.
    surfels : WorldSurfels
        Or a tuple in its order, as devices have it; so `out`.
    p : (PARAMETERS,) float64 array
        `render.camera.camera_parameters`.
    index : (m,) array
        Surfel of each row of `gradient`.
    gradient : (m, at least PARAMETERS) float32 array
    out : WorldSurfels
        Row ``index[k]`` of centre and tangents is written.
    """
    g_centre, g_u, g_v, _ = out
    fx, fy = p[FX], p[FY]
    i = np.int64(index[k])
    c, a, b = _in_camera(p, surfels, i)
    gx, gy, gi = np.float64(gradient[k, RX]), np.float64(gradient[k, RY]), np.float64(gradient[k, I0])
    z = c[2]
    nx, ny, nz = _cross(a[0], a[1], a[2], b[0], b[1], b[2])
    d = c[0] * nx + c[1] * ny + c[2] * nz
    px, py, _ = _cross(b[0], b[1], b[2], c[0], c[1], c[2])
    qx, qy, _ = _cross(c[0], c[1], c[2], a[0], a[1], a[2])
    # Gradients of b x c, c x a and a x b, and of d that divides them.
    ux, uy = gradient[k, UX] / (d * fx), gradient[k, UY] / (d * fy)
    vx, vy = gradient[k, VX] / (d * fx), gradient[k, VY] / (d * fy)
    nu, nv = gradient[k, IX] / (d * fx), gradient[k, IY] / (d * fy)
    gd = -(ux * px + uy * py + vx * qx + vy * qy + nu * nx + nv * ny) / d
    ix, iy, iz = nu + gd * c[0], nv + gd * c[1], gd * z
    # g . (s x t) has the gradients t x g and g x s.
    b_u = _cross(c[0], c[1], z, ux, uy, 0.0)
    c_u = _cross(ux, uy, 0.0, b[0], b[1], b[2])
    c_v = _cross(a[0], a[1], a[2], vx, vy, 0.0)
    a_v = _cross(vx, vy, 0.0, c[0], c[1], z)
    a_n = _cross(b[0], b[1], b[2], ix, iy, iz)
    b_n = _cross(ix, iy, iz, a[0], a[1], a[2])
    c0 = gx * fx / z + c_u[0] + c_v[0] + gd * nx
    c1 = gy * fy / z + c_u[1] + c_v[1] + gd * ny
    c2 = -(gx * fx * c[0] + gy * fy * c[1] + gi) / (z * z) + c_u[2] + c_v[2] + gd * nz
    for axis in range(3):
        # Camera to world: x right, y down, depth forward are columns 0, -1, -2 of the camera's matrix.
        x, y, w = p[3 * axis], -p[3 * axis + 1], -p[3 * axis + 2]
        g_centre[i, axis] = x * c0 + y * c1 + w * c2
        g_u[i, axis] = x * (a_v[0] + a_n[0]) + y * (a_v[1] + a_n[1]) + w * (a_v[2] + a_n[2])
        g_v[i, axis] = x * (b_u[0] + b_n[0]) + y * (b_u[1] + b_n[1]) + w * (b_u[2] + b_n[2])


def project_backward(surfels: WorldSurfels, p: Array, index: Array, gradient: Array, out: WorldSurfels) -> None:
    """Gradients of centre and tangents from those of the records.

    Parameters
    ----------
    surfels : WorldSurfels
    p : array
        As of `project`.
    index : (m,) array
        Surfel of each row of `gradient`.
    gradient : (m, at least PARAMETERS) float32 array
    out : WorldSurfels
        Centre and tangents are written; rows of surfels that were not seen stay as they are.
    """
    over_range(_project_backward, len(index), surfels, p, index, gradient, out, fewest=_FEW)


@njit
def _project_backward(first, last, surfels, p, index, gradient, out):  # type: ignore[no-untyped-def]
    for k in range(first, last):
        project_surfel_backward(k, surfels, p, index, gradient, out)
