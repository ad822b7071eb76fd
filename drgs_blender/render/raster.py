"""Surfels to sub-pixel samples: exact ray-splat intersection, blended front to back, on the CPU.

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

from ..jit import get_num_threads, njit, prange
from .camera import AA, CLIP_END, CLIP_START, FX, FY, ORTHOGRAPHIC, WIDTH, lattice, pixel_shift
from .splats import (
    CUT,
    LOW,
    OPACITY,
    RX,
    RY,
    SIZE,
    TILE,
    ZC,
    A,
    B,
    D,
    N,
    Splats,
)

Array = np.ndarray

WINDOW = 16  # a power of two
_RING = WINDOW - 1
#: Depth jump that separates two surfaces, in units of the mean of the two surfels' sizes.
GAP = 3.0
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4

# Columns of a cluster of a sample: sums by weight of the first nine columns above, of one and of depth; the heaviest
# contribution's weight and object; depth and size of the last contribution.
_WEIGHT, _DEPTH, _HEAVIEST, _OWNER, _LAST, _LAST_SIZE, _CLUSTER = 9, 10, 11, 12, 13, 14, 16


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
    rx, ry, zc, cut, low = screen[i, RX], screen[i, RY], screen[i, ZC], screen[i, CUT], screen[i, LOW]
    a0, a1, a2 = screen[i, A], screen[i, A + 1], screen[i, A + 2]
    b0, b1, b2 = screen[i, B], screen[i, B + 1], screen[i, B + 2]
    n0, n1, n2 = screen[i, N], screen[i, N + 1], screen[i, N + 2]
    d0, d1, d2 = screen[i, D], screen[i, D + 1], screen[i, D + 2]
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
    size = max(surface[i, SIZE], least)
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
                    _meet(screen, i, surface[i, OPACITY], near, far, sx, sy, base, run, alpha_run, z_run)
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
