"""Surfels to sub-pixel samples: exact ray-splat intersection, blended front to back, on the CPU.

A surfel is the plane p(u, v) = c + u a + v b with kernel exp(-(u^2 + v^2) / 2); a and b are its scaled tangents and
need not be orthogonal. In camera coordinates x right, y down, s forward, the ray through a pixel is a linear function
of the pixel, so by Cramer's rule u, v and the depth s are quotients of linear functions of the pixel that share one
denominator. They are written relative to the projected centre, where u = v = 0: no cancellation far from the camera.
The same form holds for orthographic cameras. (Huang et al., "2D Gaussian Splatting", 2024, section 4, states it
through two planes.)

The kernel of a sample is G = max(exp(-(u^2 + v^2) / 2), exp(-n d^2)), d the distance in pixels between the sample and
the projected centre, n the samples a pixel: the low-pass filter of that paper at the rate at which the picture is
sampled, so that silhouettes do not grow by a pixel where there are sub-samples. A sample that the low-pass decides has
the centre's depth.
Contributions alpha G below 1/255 are skipped, others clamped to 0.99 and blended until the transmittance is below 1e-4.

Order. Surfels are sorted once by centre depth, yet blended by the depth at which the ray meets them: every sample
keeps a window of its WINDOW nearest unblended contributions, sorted; the nearest is blended when the window is full.
The order is exact unless a contribution is more than WINDOW places off.

Depth gaps. Where a ray passes the edge of one surface and meets another, the mean of both would be a point between
them. Contributions are therefore split into clusters where the depth jumps by more than `GAP` standard deviations of
the surfels on both sides (or of the pixel, when that is larger). Position, normal and material are those of the
heaviest cluster alone; coverage is that of all.

Work is divided in tiles; a sample's result depends neither on the tiles nor on the rows rendered together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..asset.model import PosedSurfels
from ..frame import Camera
from ..jit import get_num_threads, njit, prange
from .camera import AA, CLIP_END, CLIP_START, CX, CY, FX, FY, ORTHOGRAPHIC, POSITION, WIDTH, lattice, pixel_shift

Array = np.ndarray

TILE = 16
WINDOW = 16  # a power of two
_RING = WINDOW - 1
#: Depth jump that separates two surfaces, in units of the mean of the two surfels' sizes.
GAP = 3.0
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4

# Columns of a splat's screen record. A_, B_, N_, D_: constant, x and y coefficients of u, v, denominator and depth.
_RX, _RY, _A, _B, _N, _D, _ZC, _CUT, _LOW, _RECORD = 0, 1, 2, 5, 8, 11, 14, 15, 16, 20
# Columns of a splat's surface record: normal, albedo, roughness, metallic, size, opacity.
_NORMAL, _ALBEDO, _ROUGHNESS, _METALLIC, _SIZE, _OPACITY, _SURFACE = 0, 3, 6, 7, 8, 9, 10
# Columns of a cluster of a sample: sums by weight of the first nine columns above, of one and of depth; the heaviest
# contribution's weight and object; depth and size of the last contribution.
_WEIGHT, _DEPTH, _HEAVIEST, _OWNER, _LAST, _LAST_SIZE, _CLUSTER = 9, 10, 11, 12, 13, 14, 16


@dataclass(slots=True)
class Splats:
    """Surfels of one frame on the screen, sorted by the depth of their centres.

    Attributes
    ----------
    screen : (m, _RECORD) float32 coefficients in pixels of the full picture
    surface : (m, _SURFACE) float32 world-space normal, material, size (metres, larger standard deviation), opacity
    box : (m, 4) int32 pixels (x0, y0, x1, y1), half-open, inside the window; conservative
    nearest : (m,) float32 least depth of any contribution
    object_index : (m,) int32
    tile_start : (tiles + 1,) int64 and tile_list (k,) int32: splats of each tile, in order
    window : (x0, y0, x1, y1), the camera's
    parameters : see `camera.camera_parameters`
    """

    screen: Array
    surface: Array
    box: Array
    nearest: Array
    object_index: Array
    tile_start: Array
    tile_list: Array
    window: tuple[int, int, int, int]
    parameters: Array

    def __len__(self) -> int:
        return len(self.screen)


@dataclass(slots=True)
class SurfelSamples:
    """Dense samples of some rows; where ``alpha`` is 0 the other arrays are undefined.

    Attributes
    ----------
    alpha : (rows, width, aa) float32 coverage, 1 - transmittance
    depth : (rows, width, aa) float32, metres along the view axis
    surface : (rows, width, aa, 9) float32: world normal (unit, on the surfels' own side, which may face away from the
        viewer; 0 where they cancel), albedo, roughness, metallic, and the mean standard deviation in metres
    object_index : (rows, width, aa) int32
    """

    alpha: Array
    depth: Array
    surface: Array
    object_index: Array


def prepare(posed: PosedSurfels, camera: Camera, parameters: Array) -> Splats:
    """Project, cull and sort the surfels of a frame, and list them by tile.

    Parameters
    ----------
    posed : surfels in world space; a surfel with a non-finite number is left out
    camera : gives the window
    parameters : `camera.camera_parameters`
    """
    x0, y0, x1, y1 = camera.window
    n = len(posed)
    screen = np.empty((n, _RECORD), np.float32)
    box = np.empty((n, 4), np.int32)
    nearest = np.empty(n, np.float32)
    _project(
        posed.centre, posed.tangent_u, posed.tangent_v, posed.opacity, parameters, x0, y0, x1, y1, screen, box, nearest
    )
    order = _depth_order(screen, box)
    surface = np.empty((len(order), _SURFACE), np.float32)
    _gather_surface(
        order,
        posed.tangent_u,
        posed.tangent_v,
        posed.normal,
        posed.albedo,
        posed.roughness,
        posed.metallic,
        posed.opacity,
        surface,
    )
    box = box[order]
    tiles_x = (x1 - 1) // TILE - x0 // TILE + 1
    tiles_y = (y1 - 1) // TILE - y0 // TILE + 1
    start, listed = _list_by_tile(box, x0 // TILE, y0 // TILE, tiles_x, tiles_y)
    return Splats(
        screen[order], surface, box, nearest[order], posed.object_index[order], start, listed, camera.window, parameters
    )


def rasterise(splats: Splats, y0: int, y1: int) -> SurfelSamples:
    """Blend the splats for the rows ``y0 .. y1`` (full-picture pixels, inside the window)."""
    x0, top, x1, _ = splats.window
    aa = int(splats.parameters[AA])
    shape = (y1 - y0, x1 - x0, aa)
    samples = SurfelSamples(
        np.zeros(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty((*shape, 9), np.float32),
        np.empty(shape, np.int32),
    )
    if len(splats):
        _blend(
            splats.screen,
            splats.surface,
            splats.box,
            splats.nearest,
            splats.object_index,
            splats.tile_start,
            splats.tile_list,
            splats.parameters,
            x0,
            x1,
            top // TILE,
            y0,
            y1,
            aa,
            4 * get_num_threads(),
            samples.alpha,
            samples.depth,
            samples.surface,
            samples.object_index,
        )
    return samples


@njit(inline="always")
def _to_camera(p: Any, x: Any, y: Any, z: Any) -> Any:
    """World direction to camera coordinates (right, down, forward)."""
    return (
        p[0] * x + p[3] * y + p[6] * z,
        -(p[1] * x + p[4] * y + p[7] * z),
        -(p[2] * x + p[5] * y + p[8] * z),
    )


@njit(inline="always")
def _span(focal: Any, centre: Any, sc: Any, pa: Any, pb: Any, sa: Any, sb: Any, r2: Any) -> Any:
    """Least and greatest screen coordinate of the disc u^2 + v^2 <= r2, wholly in front of the camera.

    The tangent lines x = x0 + t of the disc's outline solve a quadratic in t; ``pa``, ``pb`` are the tangents'
    components minus x0 times their depth components, x0 the centre's coordinate.
    """
    qa = sc * sc - r2 * (sa * sa + sb * sb)
    qb = r2 * (pa * sa + pb * sb)
    root = np.sqrt(max(qb * qb + qa * r2 * (pa * pa + pb * pb), 0.0))
    return centre + focal * (-qb - root) / qa, centre + focal * (-qb + root) / qa


@njit(inline="always")
def _clipped_bounds(c: Any, a: Any, b: Any, r: Any, near: Any, p: Any) -> Any:
    """Screen bounds of the square c +- r a +- r b cut at depth `near` (camera coordinates): for discs that cross it."""
    x0 = y0 = np.inf
    x1 = y1 = -np.inf
    for k in range(4):
        su, sv = (r, r) if k == 0 else (-r, r) if k == 1 else (-r, -r) if k == 2 else (r, -r)
        tu, tv = (-r, r) if k == 0 else (-r, -r) if k == 1 else (r, -r) if k == 2 else (r, r)
        ax, ay, az = c[0] + su * a[0] + sv * b[0], c[1] + su * a[1] + sv * b[1], c[2] + su * a[2] + sv * b[2]
        bx, by, bz = c[0] + tu * a[0] + tv * b[0], c[1] + tu * a[1] + tv * b[1], c[2] + tu * a[2] + tv * b[2]
        for end in range(2):
            # The corner itself if it is in front, and the point where the edge to the next corner meets the plane.
            if end == 0 and az >= near:
                x, y, z = ax, ay, az
            elif end == 1 and (az - near) * (bz - near) < 0.0:
                t = (near - az) / (bz - az)
                x, y, z = ax + t * (bx - ax), ay + t * (by - ay), near
            else:
                continue
            px, py = p[CX] + p[FX] * x / z, p[CY] + p[FY] * y / z
            x0, x1, y0, y1 = min(x0, px), max(x1, px), min(y0, py), max(y1, py)
    return x0, x1, y0, y1


@njit(parallel=True)
def _project(
    centre: Any,
    tangent_u: Any,
    tangent_v: Any,
    opacity: Any,
    p: Any,
    wx0: Any,
    wy0: Any,
    wx1: Any,
    wy1: Any,
    screen: Any,
    box: Any,
    nearest: Any,
) -> None:
    """Fill screen records, boxes and nearest depths; a culled surfel has an empty box (x1 = x0 = 0)."""
    near, far, ortho = p[CLIP_START], p[CLIP_END], p[ORTHOGRAPHIC] != 0.0
    fx, fy = p[FX], p[FY]
    for i in prange(len(centre)):
        box[i] = 0
        ox = np.float64(centre[i, 0]) - p[POSITION]
        oy = np.float64(centre[i, 1]) - p[POSITION + 1]
        oz = np.float64(centre[i, 2]) - p[POSITION + 2]
        c = _to_camera(p, ox, oy, oz)
        a = _to_camera(p, np.float64(tangent_u[i, 0]), np.float64(tangent_u[i, 1]), np.float64(tangent_u[i, 2]))
        b = _to_camera(p, np.float64(tangent_v[i, 0]), np.float64(tangent_v[i, 1]), np.float64(tangent_v[i, 2]))
        alpha = np.float64(opacity[i])
        total = c[0] + c[1] + c[2] + a[0] + a[1] + a[2] + b[0] + b[1] + b[2] + alpha
        if not abs(total) < 1e30 or not alpha > MIN_ALPHA:
            continue
        cut = 2.0 * np.log(alpha / MIN_ALPHA)
        reach = np.sqrt(cut * (a[2] * a[2] + b[2] * b[2]))
        if c[2] + reach <= near or c[2] - reach >= far:
            continue
        # Normal of the plane, scaled to one so that float32 holds tiny surfels.
        nx = a[1] * b[2] - a[2] * b[1]
        ny = a[2] * b[0] - a[0] * b[2]
        nz = a[0] * b[1] - a[1] * b[0]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        in_front = c[2] > near
        # The record is relative to the projected centre, or to the picture's centre when that is behind the camera.
        rx, ry = p[CX], p[CY]
        if ortho:
            rx, ry = p[CX] + fx * c[0], p[CY] + fy * c[1]
        elif in_front:
            rx, ry = p[CX] + fx * c[0] / c[2], p[CY] + fy * c[1] / c[2]
        s = screen[i]
        s[:] = 0.0
        s[_RX], s[_RY], s[_ZC], s[_CUT] = rx, ry, c[2], cut
        s[_LOW] = 2.0 * p[AA] if in_front else 1e30
        if length <= 0.0:
            s[_A], s[_N], s[_D] = 1e15, 1.0, c[2]  # a point: only the low-pass sees it
        elif ortho:
            k = 1.0 / length
            s[_A + 1], s[_A + 2] = k * b[1] / fx, -k * b[0] / fy
            s[_B + 1], s[_B + 2] = -k * a[1] / fx, k * a[0] / fy
            s[_N] = k * nz
            s[_D], s[_D + 1], s[_D + 2] = k * c[2] * nz, -k * nx / fx, -k * ny / fy
        else:
            k = 1.0 / length
            bcx, bcy = k * (b[1] * c[2] - b[2] * c[1]), k * (b[2] * c[0] - b[0] * c[2])
            cax, cay = k * (c[1] * a[2] - c[2] * a[1]), k * (c[2] * a[0] - c[0] * a[2])
            s[_A + 1], s[_A + 2] = bcx / fx, bcy / fy
            s[_B + 1], s[_B + 2] = cax / fx, cay / fy
            s[_N + 1], s[_N + 2] = k * nx / fx, k * ny / fy
            s[_D] = k * (c[0] * nx + c[1] * ny + c[2] * nz)
            if in_front:
                s[_N] = s[_D] / c[2]
            else:
                s[_A] = k * (b[0] * c[1] - b[1] * c[0])
                s[_B] = k * (c[0] * a[1] - c[1] * a[0])
                s[_N] = k * nz
        # Screen bounds.
        low = np.sqrt(0.5 * cut / p[AA])
        if ortho:
            lo_x, hi_x = _span(fx, rx, 1.0, a[0], b[0], 0.0, 0.0, cut)
            lo_y, hi_y = _span(fy, ry, 1.0, a[1], b[1], 0.0, 0.0, cut)
        elif c[2] - reach > near:
            x, y = c[0] / c[2], c[1] / c[2]
            lo_x, hi_x = _span(fx, rx, c[2], a[0] - x * a[2], b[0] - x * b[2], a[2], b[2], cut)
            lo_y, hi_y = _span(fy, ry, c[2], a[1] - y * a[2], b[1] - y * b[2], a[2], b[2], cut)
        else:
            lo_x, hi_x, lo_y, hi_y = _clipped_bounds(c, a, b, np.sqrt(cut), near, p)
        if in_front:
            lo_x, hi_x = min(lo_x, rx - low), max(hi_x, rx + low)
            lo_y, hi_y = min(lo_y, ry - low), max(hi_y, ry + low)
        if not (lo_x < wx1 and hi_x > wx0 and lo_y < wy1 and hi_y > wy0):
            continue
        box[i, 0] = np.int32(np.floor(max(lo_x, float(wx0))))
        box[i, 1] = np.int32(np.floor(max(lo_y, float(wy0))))
        box[i, 2] = np.int32(min(np.floor(hi_x), wx1 - 1.0)) + 1
        box[i, 3] = np.int32(min(np.floor(hi_y), wy1 - 1.0)) + 1
        nearest[i] = max(c[2] - reach, near)


@njit
def _depth_order(screen: Any, box: Any) -> Any:
    """Indices of the surfels with a box, by centre depth; equal depths keep their order. Radix sort, 3 x 11 bits."""
    n = 0
    for i in range(len(box)):
        if box[i, 2] > box[i, 0]:
            n += 1
    order, other = np.empty(n, np.int64), np.empty(n, np.int64)
    depth = np.empty(n, np.float32)
    n = 0
    for i in range(len(box)):
        if box[i, 2] > box[i, 0]:
            order[n] = i
            depth[n] = screen[i, _ZC]
            n += 1
    # Bits of a float32 compare like integers once negative numbers are reversed.
    keys = depth.view(np.uint32)
    for i in range(n):
        keys[i] = ~keys[i] if keys[i] >> np.uint32(31) else keys[i] | np.uint32(0x80000000)
    other_keys = np.empty(n, np.uint32)
    for shift in (0, 11, 22):
        count = np.zeros(2049, np.int64)
        for i in range(n):
            count[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for d in range(2048):
            count[d + 1] += count[d]
        for i in range(n):
            d = (keys[i] >> np.uint32(shift)) & np.uint32(2047)
            other[count[d]] = order[i]
            other_keys[count[d]] = keys[i]
            count[d] += 1
        order, other = other, order
        keys, other_keys = other_keys, keys
    return order


@njit(parallel=True)
def _gather_surface(
    order: Any,
    tangent_u: Any,
    tangent_v: Any,
    normal: Any,
    albedo: Any,
    roughness: Any,
    metallic: Any,
    opacity: Any,
    out: Any,
) -> None:
    """Pack what blending reads of a splat, in depth order."""
    for k in prange(len(order)):
        i = order[k]
        uu = vv = np.float32(0.0)
        for c in range(3):
            out[k, _NORMAL + c] = normal[i, c]
            out[k, _ALBEDO + c] = albedo[i, c]
            uu += tangent_u[i, c] * tangent_u[i, c]
            vv += tangent_v[i, c] * tangent_v[i, c]
        out[k, _ROUGHNESS], out[k, _METALLIC], out[k, _OPACITY] = roughness[i], metallic[i], opacity[i]
        out[k, _SIZE] = np.sqrt(max(uu, vv))


@njit
def _list_by_tile(box: Any, tile_x0: Any, tile_y0: Any, tiles_x: Any, tiles_y: Any) -> Any:
    """Counting sort of (tile, splat) pairs: start of each tile's list, and the lists, in splat order."""
    start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    for i in range(len(box)):
        for ty in range(box[i, 1] // TILE - tile_y0, (box[i, 3] - 1) // TILE - tile_y0 + 1):
            for tx in range(box[i, 0] // TILE - tile_x0, (box[i, 2] - 1) // TILE - tile_x0 + 1):
                start[ty * tiles_x + tx + 1] += 1
    for t in range(tiles_x * tiles_y):
        start[t + 1] += start[t]
    listed = np.empty(start[-1], np.int32)
    fill = start[:-1].copy()
    for i in range(len(box)):
        for ty in range(box[i, 1] // TILE - tile_y0, (box[i, 3] - 1) // TILE - tile_y0 + 1):
            for tx in range(box[i, 0] // TILE - tile_x0, (box[i, 2] - 1) // TILE - tile_x0 + 1):
                t = ty * tiles_x + tx
                listed[fill[t]] = i
                fill[t] += 1
    return start, listed


@njit(inline="always")
def _gaussian(q: Any) -> Any:
    """exp(-q / 2) for 0 <= q <= 12, relative error below 4e-6: Taylor's series of exp(-q / 32) to the 16th power.

    Branch-free, so that a loop over samples becomes vector code.
    """
    t = q * np.float32(-1.0 / 32.0)
    y = np.float32(1.0 / 720.0)
    y = y * t + np.float32(1.0 / 120.0)
    y = y * t + np.float32(1.0 / 24.0)
    y = y * t + np.float32(1.0 / 6.0)
    y = y * t + np.float32(0.5)
    y = y * t + np.float32(1.0)
    y = y * t + np.float32(1.0)
    y = y * y
    y = y * y
    y = y * y
    return y * y


@njit(inline="always")
def _meet(
    screen: Any,
    i: Any,
    opacity: Any,
    near: Any,
    far: Any,
    sx: Any,
    sy: Any,
    first: Any,
    count: Any,
    alpha: Any,
    depth: Any,
) -> None:
    """Strength (0 below MIN_ALPHA or when clipped) and depth of a splat at samples first .. first + count.

    Without a branch: the loop becomes vector code.
    """
    big, zero = np.float32(1e30), np.float32(0.0)
    rx, ry, zc, cut, low = screen[i, _RX], screen[i, _RY], screen[i, _ZC], screen[i, _CUT], screen[i, _LOW]
    a0, a1, a2 = screen[i, _A], screen[i, _A + 1], screen[i, _A + 2]
    b0, b1, b2 = screen[i, _B], screen[i, _B + 1], screen[i, _B + 2]
    n0, n1, n2 = screen[i, _N], screen[i, _N + 1], screen[i, _N + 2]
    d0, d1, d2 = screen[i, _D], screen[i, _D + 1], screen[i, _D + 2]
    for j in range(count):
        ex, ey = sx[first + j] - rx, sy[first + j] - ry
        inverse = np.float32(1.0) / (n0 + n1 * ex + n2 * ey)
        u = (a0 + a1 * ex + a2 * ey) * inverse
        v = (b0 + b1 * ex + b2 * ey) * inverse
        z = (d0 + d1 * ex + d2 * ey) * inverse
        # NaN and points outside the clip range leave the low-pass alone.
        exact = u * u + v * v if (z > near) & (z < far) else big
        filtered = low * (ex * ex + ey * ey)
        take = exact <= filtered
        q = exact if take else filtered
        z = z if take else zc
        seen = (q < cut) & (z > near) & (z < far)
        alpha[j] = min(opacity * _gaussian(q), np.float32(MAX_ALPHA)) if seen else zero
        depth[j] = z


@njit(inline="always")
def _absorb(
    surface: Any, i: Any, owner: Any, z: Any, alpha: Any, least: Any, t: Any, acc: Any, best: Any, at: Any
) -> Any:
    """Blend one contribution into the accumulators of its sample; returns the transmittance behind it.

    ``acc`` is the cluster being gathered, ``best`` the heaviest one so far. ``least`` is the width of a pixel at this
    depth, metres.
    """
    weight = t * alpha
    size = max(surface[i, _SIZE], least)
    if acc[at, _WEIGHT] > np.float32(0.0) and z - acc[at, _LAST] > np.float32(0.5 * GAP) * (size + acc[at, _LAST_SIZE]):
        if acc[at, _WEIGHT] > best[at, _WEIGHT]:
            for c in range(_CLUSTER):
                best[at, c] = acc[at, c]
        acc[at, _WEIGHT] = np.float32(0.0)
    if acc[at, _WEIGHT] == np.float32(0.0):
        for c in range(_CLUSTER):
            acc[at, c] = np.float32(0.0)
        acc[at, _LAST] = z
    # Both sides of a thin sheet may lie in one cluster: normals agree with the nearest one.
    signed = weight
    if acc[at, 0] * surface[i, 0] + acc[at, 1] * surface[i, 1] + acc[at, 2] * surface[i, 2] < np.float32(0.0):
        signed = -weight
    for c in range(3):
        acc[at, c] += signed * surface[i, c]
    for c in range(3, 9):
        acc[at, c] += weight * surface[i, c]
    acc[at, _WEIGHT] += weight
    acc[at, _DEPTH] += weight * z
    if weight > acc[at, _HEAVIEST]:
        acc[at, _HEAVIEST] = weight
        acc[at, _OWNER] = np.float32(owner)
    acc[at, _LAST] = max(z, acc[at, _LAST])
    acc[at, _LAST_SIZE] = size
    return t * (np.float32(1.0) - alpha)


@njit(inline="always")
def _finish(best: Any, at: Any, out: Any, y: Any, x: Any, k: Any) -> Any:
    """Write the normalised attributes of a sample. Returns its depth and object index."""
    inverse = np.float32(1.0) / best[at, _WEIGHT]
    nx, ny, nz = best[at, 0], best[at, 1], best[at, 2]
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    scale = np.float32(1.0) / length if length > np.float32(1e-6) * best[at, _WEIGHT] else np.float32(0.0)
    out[y, x, k, 0], out[y, x, k, 1], out[y, x, k, 2] = scale * nx, scale * ny, scale * nz
    for c in range(3, 9):
        out[y, x, k, c] = best[at, c] * inverse
    return best[at, _DEPTH] * inverse, np.int32(best[at, _OWNER])


@njit(parallel=True)
def _blend(
    screen: Any,
    surface: Any,
    box: Any,
    nearest: Any,
    objects: Any,
    tile_start: Any,
    tile_list: Any,
    p: Any,
    x0: Any,
    x1: Any,
    tile_y0: Any,
    y0: Any,
    y1: Any,
    aa: Any,
    workers: Any,
    out_alpha: Any,
    out_depth: Any,
    out_surface: Any,
    out_object: Any,
) -> None:
    """Blend all tiles that meet the rows y0 .. y1. A worker takes every `workers`-th tile: neighbours cost alike."""
    tile_x0 = x0 // TILE
    tiles_x = (x1 - 1) // TILE - tile_x0 + 1
    first_row, last_row = y0 // TILE, (y1 - 1) // TILE
    n_tiles = tiles_x * (last_row - first_row + 1)
    width = np.int64(p[WIDTH])
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    ortho = p[ORTHOGRAPHIC] != 0.0
    # A pixel at depth z is pixel_base + pixel * z metres wide.
    pixel = np.float32(0.0 if ortho else 1.0 / min(p[FX], p[FY]))
    pixel_base = np.float32(1.0 / min(p[FX], p[FY]) if ortho else 0.0)
    stop = np.float32(MIN_TRANSMITTANCE)
    zero, big = np.float32(0.0), np.float32(1e30)
    per_row = TILE * aa
    capacity = TILE * per_row
    for worker in prange(workers):
        sx, sy = np.empty(capacity, np.float32), np.empty(capacity, np.float32)
        count, head = np.empty(capacity, np.int32), np.empty(capacity, np.int32)
        running, resolved = np.empty(capacity, np.float32), np.empty(capacity, np.float32)
        farthest = np.empty(capacity, np.float32)
        win_z, win_a = np.empty((capacity, WINDOW), np.float32), np.empty((capacity, WINDOW), np.float32)
        win_i = np.empty((capacity, WINDOW), np.uint32)
        acc, best = np.empty((capacity, _CLUSTER), np.float32), np.empty((capacity, _CLUSTER), np.float32)
        alpha_run, z_run = np.empty(per_row, np.float32), np.empty(per_row, np.float32)
        for task in range(worker, n_tiles, workers):
            tx, ty = tile_x0 + task % tiles_x, first_row + task // tiles_x
            tile = (ty - tile_y0) * tiles_x + task % tiles_x
            begin, end = tile_start[tile], tile_start[tile + 1]
            if begin == end:
                continue
            left, top = max(tx * TILE, x0), max(ty * TILE, y0)
            right, bottom = min(tx * TILE + TILE, x1), min(ty * TILE + TILE, y1)
            for y in range(top, bottom):
                for x in range(left, right):
                    shift_x, shift_y = pixel_shift(p, y * width + x)
                    at = (y - top) * per_row + (x - left) * aa
                    for k in range(aa):
                        jx, jy = lattice(shift_x, shift_y, k, p[AA])
                        sx[at + k], sy[at + k] = x + jx, y + jy
                        count[at + k] = head[at + k] = 0
                        running[at + k] = resolved[at + k] = np.float32(1.0)
                        farthest[at + k] = -big
                        acc[at + k, _WEIGHT] = best[at + k, _WEIGHT] = zero
            open_samples = (bottom - top) * (right - left) * aa
            limit = big
            for entry in range(begin, end):
                i = tile_list[entry]
                if open_samples == 0:
                    # All samples are opaque: only what might lie in front of their windows' ends still matters.
                    if limit == big:
                        limit = -big
                        for y in range(bottom - top):
                            for j in range(y * per_row, y * per_row + (right - left) * aa):
                                limit = max(limit, farthest[j])
                    if nearest[i] >= limit:
                        continue
                bx0, bx1 = max(box[i, 0], left), min(box[i, 2], right)
                by0, by1 = max(box[i, 1], top), min(box[i, 3], bottom)
                run = (bx1 - bx0) * aa
                for y in range(by0, by1):
                    base = (y - top) * per_row + (bx0 - left) * aa
                    _meet(screen, i, surface[i, _OPACITY], near, far, sx, sy, base, run, alpha_run, z_run)
                    for j in range(run):
                        alpha = alpha_run[j]
                        if alpha == zero:
                            continue
                        at = np.uintp(base + j)  # unsigned: no check for negative indices
                        z = z_run[j]
                        before = running[at]
                        if before < stop and z >= farthest[at]:
                            continue
                        n, h = count[at], head[at]
                        if n == WINDOW:
                            k = win_i[at, h]
                            t = _absorb(
                                surface, k, objects[k], win_z[at, h], win_a[at, h],
                                pixel_base + pixel * win_z[at, h], resolved[at], acc, best, at,
                            )  # fmt: skip
                            resolved[at] = t
                            h = (h + 1) & _RING
                            head[at] = h
                            n -= 1
                            if t < stop:
                                count[at] = 0
                                open_samples -= before >= stop
                                running[at] = zero
                                farthest[at] = -big
                                continue
                        to = (h + n) & _RING
                        for _ in range(n):
                            fro = (to - 1) & _RING
                            if win_z[at, fro] <= z:
                                break
                            win_z[at, to], win_a[at, to], win_i[at, to] = win_z[at, fro], win_a[at, fro], win_i[at, fro]
                            to = fro
                        win_z[at, to], win_a[at, to], win_i[at, to] = z, alpha, i
                        count[at] = n + 1
                        farthest[at] = max(farthest[at], z)
                        after = before * (np.float32(1.0) - alpha)
                        running[at] = after
                        open_samples -= after < stop and before >= stop
            for y in range(top, bottom):
                for x in range(left, right):
                    for k in range(aa):
                        at = (y - top) * per_row + (x - left) * aa + k
                        t = resolved[at]
                        for w in range(count[at]):
                            if t < stop:
                                break
                            h = (head[at] + w) & _RING
                            i = win_i[at, h]
                            t = _absorb(
                                surface, i, objects[i], win_z[at, h], win_a[at, h],
                                pixel_base + pixel * win_z[at, h], t, acc, best, at,
                            )  # fmt: skip
                        if acc[at, _WEIGHT] == np.float32(0.0):
                            continue
                        if acc[at, _WEIGHT] > best[at, _WEIGHT]:
                            for c in range(_CLUSTER):
                                best[at, c] = acc[at, c]
                        depth, owner = _finish(best, at, out_surface, y - y0, x - x0, k)
                        out_alpha[y - y0, x - x0, k] = np.float32(1.0) - t
                        out_depth[y - y0, x - x0, k] = depth
                        out_object[y - y0, x - x0, k] = owner
