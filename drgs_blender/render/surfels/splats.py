"""Surfels as splats on the screen: projected, culled, sorted by depth and listed by tile, ready for `raster`.

A surfel is the plane p(u, v) = c + u a + v b with kernel exp(-(u^2 + v^2) / 2); a and b are its scaled tangents and
need not be orthogonal. In camera coordinates x right, y down, s forward, the ray through a pixel is a linear function
of the pixel, so by Cramer's rule u, v and the depth s are quotients of linear functions of the pixel that share one
denominator. They are written relative to the projected centre, where u = v = 0: no cancellation far from the camera.
The same form holds for orthographic cameras. (Huang et al., "2D Gaussian Splatting", 2024, section 4, states it
through two planes.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit, plain
from ...compute.threads import ELEMENTS, checkpoint, over_range
from ...core.asset.model import PosedSurfels
from ...core.frame import Camera
from ..camera import CLIP_END, CLIP_START, CX, CY, FILTER, FX, FY, LEAN, ORTHOGRAPHIC, POSITION, SUBPIXELS
from ..pixel_filter import filter_reach
from ..surfel_columns import ALBEDO, METALLIC, NORMAL, OPACITY, ROUGHNESS, SIZE, SPLAT

Array = np.ndarray

#: Side of a tile, pixels.
TILE = 16
#: Surfels that one thread projects at least: each costs as much as several elements elsewhere.
_FEW = ELEMENTS // 8
#: Alpha of a contribution: fainter ones are skipped, stronger ones clamped.
MIN_ALPHA, MAX_ALPHA = 1.0 / 255.0, 0.99

# Columns of a splat's screen record. A_, B_, N_, D_: constant, x and y coefficients of u, v, denominator and depth; ZC:
# depth of the centre; CUT: square radius at which a splat ends. The screen-space filter has the square radius
# LOW d^2 + DIM, weakened by the cosine at which the surfel is seen: the many surfels edge-on along a silhouette would
# else widen it. SHARE: part of the filter's area that the surfel, seen face-on, fills.
RX, RY, A, B, N, D, ZC, CUT, LOW, DIM, SHARE, RECORD = 0, 1, 2, 5, 8, 11, 14, 15, 16, 17, 18, 21
#: Least `SHARE`: what has no area still has a material.
LEAST_SHARE = 1e-4


class Posed(NamedTuple):
    """The arrays of `PosedSurfels` as kernels take them.

    Attributes
    ----------
    centre, tangent_u, tangent_v, normal, opacity, albedo, roughness, metallic, object_index : array
        See there.
    """

    centre: Array
    tangent_u: Array
    tangent_v: Array
    normal: Array
    opacity: Array
    albedo: Array
    roughness: Array
    metallic: Array
    object_index: Array

    @classmethod
    def of(cls, posed: PosedSurfels) -> Posed:
        """The splats of `posed`."""
        return cls(*(plain(getattr(posed, name)) for name in cls._fields))


class Splats(NamedTuple):
    """Surfels of one frame on the screen, sorted by the depth of their centres.

    Attributes
    ----------
    screen : (m, RECORD) float32 array
        Coefficients in pixels of the full picture.
    surface : (m, SPLAT) float32 array
        See `columns`: world-space normal, material, size (metres, larger standard deviation), opacity.
    box : (m, 4) int32 array
        Pixels (x0, y0, x1, y1), half-open, inside the window; conservative.
    nearest : (m,) float32 array
        Least depth of any contribution.
    object_index : (m,) int32 array
    tile_start : (tiles + 1,) int64 array
        First entry of each tile in ``tile_list``, row by row.
    tile_list : (k,) int32 array
        Splats of each tile, in order.
    x0, y0, x1, y1 : int
        The camera's window, full-picture pixels.
    parameters : array
        See `camera.camera_parameters`.
    """

    screen: Array
    surface: Array
    box: Array
    nearest: Array
    object_index: Array
    tile_start: Array
    tile_list: Array
    x0: int
    y0: int
    x1: int
    y1: int
    parameters: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All arrays but the parameters, as kernels of a device take them."""
        return self[:7]

    @property
    def number(self) -> int:
        """Number of splats."""
        return len(self.screen)


def prepare(posed: PosedSurfels, camera: Camera, parameters: Array) -> Splats:
    """Project, cull and sort the surfels of a frame, and list them by tile.

    Parameters
    ----------
    posed : PosedSurfels
        Surfels in world space; a surfel with a non-finite number is left out.
    camera : Camera
        Gives the window.
    parameters : array
        `camera.camera_parameters`.
    """
    n = len(posed)
    screen = np.empty((n, RECORD), np.float32)
    box = np.empty((n, 4), np.int32)
    nearest = np.empty(n, np.float32)
    arrays = Posed.of(posed)
    over_range(_project, n, arrays, parameters, camera.window, screen, box, nearest, fewest=_FEW)
    return arranged(arrays, (screen, box, nearest), camera.window, parameters)[0]


def arranged(
    posed: Posed, projected: tuple[Array, Array, Array], window: tuple[int, int, int, int], parameters: Array
) -> tuple[Splats, Array]:
    """Projected surfels sorted by depth and listed by tile, and which surfel each is.

    Parameters
    ----------
    posed : Posed
    projected : tuple of array
        Screen records, boxes and nearest depths of all surfels, see `Splats`.
    window : tuple of int
    parameters : array
        `camera.camera_parameters`.
    """
    (screen, box, nearest), (x0, y0, x1, y1) = projected, window
    order = depth_order(np.ascontiguousarray(screen[:, ZC]), box)
    surface = np.empty((len(order), SPLAT), np.float32)
    over_range(_gather_surface, len(order), order, posed, surface, fewest=ELEMENTS)
    box = box.take(order, axis=0)  # faster than an index
    checkpoint()
    tiles_x = (x1 - 1) // TILE - x0 // TILE + 1
    tiles_y = (y1 - 1) // TILE - y0 // TILE + 1
    start, listed = list_by_tile(box, x0 // TILE, y0 // TILE, tiles_x, tiles_y)
    checkpoint()
    splats = Splats(
        screen.take(order, axis=0),
        surface,
        box,
        nearest.take(order),
        posed.object_index.take(order),
        start,
        listed,
        *window,
        parameters,
    )
    return splats, order


@inlined
def to_camera(p, x, y, z):  # type: ignore[no-untyped-def]
    """World vector to camera coordinates: x right, y down, depth forward.

    Parameters
    ----------
    p : (PARAMETERS,) float64 array
        `camera.camera_parameters`.
    x, y, z : float64
        World, m; of a point, from the camera's position.

    Returns
    -------
    right, down, forward : float64
        Metres.
    """
    right, up = p[0] * x + p[3] * y + p[6] * z, p[1] * x + p[4] * y + p[7] * z
    forward = p[LEAN] * right + p[LEAN + 1] * up - (p[2] * x + p[5] * y + p[8] * z)
    return right + p[LEAN] * forward, -(up + p[LEAN + 1] * forward), forward


@inlined
def span(focal, centre, sc, pa, pb, sa, sb, r2):  # type: ignore[no-untyped-def]
    """Least and greatest screen coordinate of the disc u^2 + v^2 <= r2, wholly in front of the camera.

    The tangent lines x = x0 + t of the disc's outline solve a quadratic in t; x0 is the centre's coordinate.

    Parameters
    ----------
    focal : float64
        Focal length, pixels; of an orthographic camera pixels per metre.
    centre : float64
        Screen coordinate of the disc's centre, pixels.
    sc : float64
        Depth of the centre, m; 1 for an orthographic camera.
    pa, pb : float64
        Components of the tangents along the axis, minus x0 times their depth components, m.
    sa, sb : float64
        Depth components of the tangents, m; 0 for an orthographic camera.
    r2 : float64
        Square radius in standard deviations.

    Returns
    -------
    low, high : float64
        Pixels.
    """
    qa = sc * sc - r2 * (sa * sa + sb * sb)
    qb = r2 * (pa * sa + pb * sb)
    root = np.sqrt(max(qb * qb + qa * r2 * (pa * pa + pb * pb), 0.0))
    return centre + focal * (-qb - root) / qa, centre + focal * (-qb + root) / qa


@inlined
def _clipped_bounds(c, a, b, r, near, p):  # type: ignore[no-untyped-def]
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


@njit
def _project(first, last, posed, p, window, screen, box, nearest):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        project_surfel(i, posed, p, window, screen, box, nearest)


@njit
def project_surfel(i, posed, p, window, screen, box, nearest):  # type: ignore[no-untyped-def]
    """Project a surfel: its screen record, box and nearest depth; a culled surfel has an empty box (x1 = x0 = 0).

    Parameters
    ----------
    i : int64
        Row of the surfel.
    posed : Posed
        World, m.
    p : (PARAMETERS,) float64 array
        `camera.camera_parameters`.
    window : tuple of int
        (x0, y0, x1, y1), full-picture pixels.
    screen, box, nearest : array
        Row `i` is written, see `Splats`.
    """
    centre, tangent_u, tangent_v, opacity = posed.centre, posed.tangent_u, posed.tangent_v, posed.opacity
    wx0, wy0, wx1, wy1 = window
    near, far, ortho = p[CLIP_START], p[CLIP_END], p[ORTHOGRAPHIC] != 0.0
    fx, fy = p[FX], p[FY]
    for side in range(4):
        box[i, side] = 0
    ox = np.float64(centre[i, 0]) - p[POSITION]
    oy = np.float64(centre[i, 1]) - p[POSITION + 1]
    oz = np.float64(centre[i, 2]) - p[POSITION + 2]
    c = to_camera(p, ox, oy, oz)
    a = to_camera(p, np.float64(tangent_u[i, 0]), np.float64(tangent_u[i, 1]), np.float64(tangent_u[i, 2]))
    b = to_camera(p, np.float64(tangent_v[i, 0]), np.float64(tangent_v[i, 1]), np.float64(tangent_v[i, 2]))
    alpha = np.float64(opacity[i])
    total = c[0] + c[1] + c[2] + a[0] + a[1] + a[2] + b[0] + b[1] + b[2] + alpha
    if not abs(total) < 1e30 or not alpha > MIN_ALPHA:
        return
    cut = 2.0 * np.log(alpha / MIN_ALPHA)
    deep = np.sqrt(cut * (a[2] * a[2] + b[2] * b[2]))
    if c[2] + deep <= near or c[2] - deep >= far:
        return
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
    for column in range(RECORD):
        screen[i, column] = 0.0
    screen[i, RX], screen[i, RY], screen[i, ZC], screen[i, CUT] = rx, ry, c[2], cut
    screen[i, LOW] = 2.0 * p[SUBPIXELS] if in_front else 1e30
    screen[i, SHARE] = 1.0
    if in_front:
        scale = np.sqrt(2.0 * p[SUBPIXELS] * fx * fy) / (1.0 if ortho else c[2])
        along_u = min(1.0, scale * np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]))
        along_v = min(1.0, scale * np.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2]))
        screen[i, SHARE] = max(along_u * along_v, LEAST_SHARE)
    if length <= 0.0:
        screen[i, A], screen[i, N], screen[i, D] = 1e15, 1.0, c[2]  # a point: only the low-pass sees it
    elif ortho:
        k = 1.0 / length
        screen[i, A + 1], screen[i, A + 2] = k * b[1] / fx, -k * b[0] / fy
        screen[i, B + 1], screen[i, B + 2] = -k * a[1] / fx, k * a[0] / fy
        screen[i, N] = k * nz
        screen[i, DIM] = _dim(k * nz, 1.0)
        screen[i, D], screen[i, D + 1], screen[i, D + 2] = k * c[2] * nz, -k * nx / fx, -k * ny / fy
    else:
        k = 1.0 / length
        bcx, bcy = k * (b[1] * c[2] - b[2] * c[1]), k * (b[2] * c[0] - b[0] * c[2])
        cax, cay = k * (c[1] * a[2] - c[2] * a[1]), k * (c[2] * a[0] - c[0] * a[2])
        screen[i, A + 1], screen[i, A + 2] = bcx / fx, bcy / fy
        screen[i, B + 1], screen[i, B + 2] = cax / fx, cay / fy
        screen[i, N + 1], screen[i, N + 2] = k * nx / fx, k * ny / fy
        screen[i, D] = k * (c[0] * nx + c[1] * ny + c[2] * nz)
        if in_front:
            screen[i, N] = screen[i, D] / c[2]
            screen[i, DIM] = _dim(screen[i, D], np.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2]))
        else:
            screen[i, A] = k * (b[0] * c[1] - b[1] * c[0])
            screen[i, B] = k * (c[0] * a[1] - c[1] * a[0])
            screen[i, N] = k * nz
    # Screen bounds.
    low = np.sqrt(0.5 * cut / p[SUBPIXELS])
    if ortho:
        lo_x, hi_x = span(fx, rx, 1.0, a[0], b[0], 0.0, 0.0, cut)
        lo_y, hi_y = span(fy, ry, 1.0, a[1], b[1], 0.0, 0.0, cut)
    elif c[2] - deep > near:
        x, y = c[0] / c[2], c[1] / c[2]
        lo_x, hi_x = span(fx, rx, c[2], a[0] - x * a[2], b[0] - x * b[2], a[2], b[2], cut)
        lo_y, hi_y = span(fy, ry, c[2], a[1] - y * a[2], b[1] - y * b[2], a[2], b[2], cut)
    else:
        lo_x, hi_x, lo_y, hi_y = _clipped_bounds(c, a, b, np.sqrt(cut), near, p)
    if in_front:
        lo_x, hi_x = min(lo_x, rx - low), max(hi_x, rx + low)
        lo_y, hi_y = min(lo_y, ry - low), max(hi_y, ry + low)
    reach = filter_reach(p[FILTER])
    lo_x, hi_x, lo_y, hi_y = lo_x - reach, hi_x + reach, lo_y - reach, hi_y + reach
    if not (lo_x < wx1 and hi_x > wx0 and lo_y < wy1 and hi_y > wy0):
        return
    box[i, 0] = np.int32(np.floor(max(lo_x, float(wx0))))
    box[i, 1] = np.int32(np.floor(max(lo_y, float(wy0))))
    box[i, 2] = np.int32(min(np.floor(hi_x), wx1 - 1.0)) + 1
    box[i, 3] = np.int32(min(np.floor(hi_y), wy1 - 1.0)) + 1
    nearest[i] = max(c[2] - deep, near)


@inlined
def _dim(along, whole):  # type: ignore[no-untyped-def]
    """-2 log of the cosine ``along / whole``."""
    return 2.0 * np.log(whole / max(abs(along), 1e-6 * whole))


@inlined
def depth_key(bits):  # type: ignore[no-untyped-def]
    """Key of a depth for a radix sort: the bits of a float32 as an integer that compares like the number.

    Parameters
    ----------
    bits : uint32

    Returns
    -------
    uint32
    """
    return np.uint32(~bits if bits >> np.uint32(31) else bits | np.uint32(0x80000000))


@njit
def depth_order(centre_depth, box):  # type: ignore[no-untyped-def]
    """Depth sort of the surfels that have a box (radix sort, 3 x 11 bits); equal depths keep their order.

    Parameters
    ----------
    centre_depth : (n,) float32 array
        Metres along the view axis.
    box : (n, 4) int32 array
        See `Splats`.

    Returns
    -------
    (m,) int64 array
        Rows, nearest first.
    """
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
            depth[n] = centre_depth[i]
            n += 1
    keys = depth.view(np.uint32)
    for i in range(n):
        keys[i] = depth_key(keys[i])
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


@njit
def _gather_surface(first, last, order, posed, out):  # type: ignore[no-untyped-def]
    for k in range(first, last):
        pack_surface(order[k], k, posed, out)


@njit
def pack_surface(i, k, posed, out):  # type: ignore[no-untyped-def]
    """Pack what blending reads of surfel i as splat k.

    Parameters
    ----------
    i, k : int64
        Row of the surfel; row of the splat.
    posed : Posed
        World, m.
    out : (m, SPLAT) float32 array
        Row `k` is written, see `Splats.surface`.
    """
    tangent_u, tangent_v = posed.tangent_u, posed.tangent_v
    uu = vv = np.float32(0.0)
    for c in range(3):
        out[k, NORMAL + c] = posed.normal[i, c]
        out[k, ALBEDO + c] = posed.albedo[i, c]
        uu += tangent_u[i, c] * tangent_u[i, c]
        vv += tangent_v[i, c] * tangent_v[i, c]
    out[k, ROUGHNESS], out[k, METALLIC], out[k, OPACITY] = posed.roughness[i], posed.metallic[i], posed.opacity[i]
    out[k, SIZE] = np.sqrt(max(uu, vv))


@inlined
def tiles_of(box, i):  # type: ignore[no-untyped-def]
    """Tiles that the box of a splat touches.

    Parameters
    ----------
    box : (m, 4) int32 array
        See `Splats`.
    i : int64
        Row of the splat.

    Returns
    -------
    x0, y0, x1, y1 : int64
        Columns and rows of tiles in the full picture, half-open.
    """
    return box[i, 0] // TILE, box[i, 1] // TILE, (box[i, 2] - 1) // TILE + 1, (box[i, 3] - 1) // TILE + 1


@njit
def list_by_tile(box, tile_x0, tile_y0, tiles_x, tiles_y):  # type: ignore[no-untyped-def]
    """Lists of splats per tile: a counting sort of (tile, splat) pairs that keeps the order of the splats.

    Parameters
    ----------
    box : (m, 4) int32 array
        See `Splats`.
    tile_x0, tile_y0 : int64
        First column and row of tiles.
    tiles_x, tiles_y : int64
        Columns and rows of tiles.

    Returns
    -------
    start : (tiles + 1,) int64 array
        First entry of each tile in the lists, row by row.
    listed : (k,) int32 array
        Splats.
    """
    start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    for i in range(len(box)):
        x0, y0, x1, y1 = tiles_of(box, i)
        for ty in range(y0 - tile_y0, y1 - tile_y0):
            for tx in range(x0 - tile_x0, x1 - tile_x0):
                start[ty * tiles_x + tx + 1] += 1
    for t in range(tiles_x * tiles_y):
        start[t + 1] += start[t]
    listed = np.empty(start[-1], np.int32)
    fill = start[:-1].copy()
    for i in range(len(box)):
        x0, y0, x1, y1 = tiles_of(box, i)
        for ty in range(y0 - tile_y0, y1 - tile_y0):
            for tx in range(x0 - tile_x0, x1 - tile_x0):
                t = ty * tiles_x + tx
                listed[fill[t]] = i
                fill[t] += 1
    return start, listed
