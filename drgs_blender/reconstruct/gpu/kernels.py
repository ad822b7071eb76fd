"""Kernels of the differentiable rasteriser on a device, one thread per surfel, pixel or surfel in a tile.

The functions here are translated and never run as they stand; what they call is the CPU's. What they take comes
in tuples, in the order of `projection.WorldSurfels`, `projection.Projected`, `blend.Splats` and `blend.Tiles`.
Forwards, a thread walks the list of its pixel's tile. Backwards, a first kernel walks it again and leaves, in a
rectangle of each surfel's own, what its pixels let through before it and how they want its strength to change; a second
one takes a surfel in one tile and sums over these pixels, row by row: no two threads ever write to one number, and
every sum has one order. The results are the same bits each time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...compute.warp.kernels import ScratchArray, WarpKernel
from ...render.sampling import ONE, ZERO, F
from ...render.surfels.blending import MIN_TRANSMITTANCE
from ...render.surfels.raster import gaussian
from ...render.surfels.splats import MAX_ALPHA, TILE
from ..model.blend import strength
from ..model.blend_backward import BEFORE, SCREEN_GRADIENT, slopes
from ..model.projection import (
    CUT,
    I0,
    IX,
    IY,
    OPACITY,
    RX,
    RY,
    UX,
    UY,
    VX,
    VY,
    project_surfel,
    project_surfel_backward,
    splat_of,
)

#: Columns of a pixel's maps: transmittance, sums of weighted depth and of its square, distortion, median, features.
T, Z, ZZ, DISTORTION, MEDIAN, FEATURES = 0, 1, 2, 3, 4, 5
#: Columns of a pixel's gradients: of alpha, depth, median, distortion, features.
G_ALPHA, G_DEPTH, G_MEDIAN, G_DISTORTION, G_FEATURES = 0, 1, 2, 3, 4
#: Features at most.
CHANNELS = 16


def project_rows(thread, stride, scratch, surfels, p, picture, out):  # type: ignore[no-untyped-def]
    """`projection.project`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`; so of all kernels here.
    surfels, p, picture, out : tuple or array
        As of `projection.project_surfel`.
    """
    for i in range(thread, len(surfels[0]), stride):
        project_surfel(i, surfels, p, picture, out)


def list_pairs(thread, stride, scratch, box, first, tiles_x, out):  # type: ignore[no-untyped-def]
    """Tile and surfel of every pair of both, surfel by surfel, row by row of tiles.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    box : (n, 4) int32 array
        Pixels, see `projection.Projected`.
    first : array
        Number of the first pair of each surfel.
    tiles_x : int
        Tiles in a row.
    out : tuple of array
        Tile and surfel of each pair, int32; written.
    """
    tile, surfel = out
    for i in range(thread, len(box), stride):
        pair = first[i]
        for ty in range(box[i, 1] // TILE, (box[i, 3] - 1) // TILE + 1):
            for tx in range(box[i, 0] // TILE, (box[i, 2] - 1) // TILE + 1):
                tile[pair], surfel[pair] = np.int32(ty * tiles_x + tx), np.int32(i)
                pair += 1


def pixel_of(number: Any, tiles_x: Any) -> Any:
    """Tile, column and row of a thread's pixel: those of a tile follow each other."""
    tile, within = number // (TILE * TILE), number % (TILE * TILE)
    return tile, tile % tiles_x * TILE + within % TILE, tile // tiles_x * TILE + within // TILE


def inside(box: Any, i: Any, x: Any, y: Any) -> Any:
    """Whether a pixel may see surfel i."""
    return x >= box[i, 0] and x < box[i, 2] and y >= box[i, 1] and y < box[i, 3]


def meet(splat: Any, x: Any, y: Any, near: Any, far: Any) -> Any:
    """Place of a pixel from a surfel's centre, and what `blend.strength` says of it."""
    ex, ey = F(x) + F(0.5) - splat.rx, F(y) + F(0.5) - splat.ry
    q, z, exact, su, sv = strength(ex, ey, splat, near, far)
    return ex, ey, q, z, exact, su, sv


def blend_pixels(thread, stride, scratch, splats, tiles, out):  # type: ignore[no-untyped-def]
    """The maps of all pixels, as `blend._blend` sums them; neighbouring threads are of one tile.

    Parameters
    ----------
    thread, stride : int64
    scratch : tuple
        Memory for sums of features, (CHANNELS,) float32.
    splats, tiles : tuple
        In the order of `blend.Splats` and `blend.Tiles`.
    out : tuple of array
        Maps, (h, w, FEATURES + channels) float32; written.
    """
    record, values, box, near, far = splats
    start, listed, tiles_x = tiles
    (maps,) = out
    (sums,) = scratch
    height, width, channels = maps.shape[0], maps.shape[1], values.shape[1]
    half, stop = F(0.5), F(MIN_TRANSMITTANCE)
    for number in range(thread, (len(start) - 1) * TILE * TILE, stride):
        tile, x, y = pixel_of(number, tiles_x)
        if x >= width or y >= height:
            continue
        for c in range(channels):
            sums[c] = ZERO
        t, depth, square, distortion, median = ONE, ZERO, ZERO, ZERO, ZERO
        entry, last = start[tile], start[tile + 1]
        while entry < last and t >= stop:
            i = np.int64(listed[entry])
            entry += 1
            if inside(box, i, x, y):
                _, _, q, z, _, _, _ = meet(splat_of(record, i), x, y, near, far)
                if q < record[i, CUT]:
                    w = t * min(record[i, OPACITY] * gaussian(q), F(MAX_ALPHA))
                    after = t - w
                    distortion += w * (z * z * (ONE - t) + square - (z + z) * depth)
                    depth += w * z
                    square += w * z * z
                    if t > half and after <= half:
                        median = z
                    for c in range(channels):
                        sums[c] += w * values[i, c]
                    t = after
        maps[y, x, T], maps[y, x, Z], maps[y, x, ZZ] = t, depth, square
        maps[y, x, DISTORTION], maps[y, x, MEDIAN] = distortion, median
        for c in range(channels):
            maps[y, x, FEATURES + c] = sums[c]


def pull_pixels(thread, stride, scratch, splats, tiles, first, maps, incoming, out):  # type: ignore[no-untyped-def]
    """Transmittance before each surfel, and gradient of its strength, by pixels of the surfels' rectangles.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    splats, tiles : tuple
        As of `blend_pixels`.
    first : (m,) array
        First row of each surfel's rectangle in what is written.
    maps : array
        Output of `blend_pixels`.
    incoming : (h, w, G_FEATURES + channels) float32 array
        Gradients of the loss by the maps.
    out : tuple of array
        Transmittance and gradient, two columns, float32; written.
    """
    record, values, box, near, far = splats
    start, listed, tiles_x = tiles
    (pulls,) = out
    height, width, channels = maps.shape[0], maps.shape[1], values.shape[1]
    stop, most = F(MIN_TRANSMITTANCE), F(MAX_ALPHA)
    for number in range(thread, (len(start) - 1) * TILE * TILE, stride):
        tile, x, y = pixel_of(number, tiles_x)
        if x >= width or y >= height:
            continue
        alpha, mean, square = ONE - maps[y, x, T], maps[y, x, Z], maps[y, x, ZZ]
        g_alpha, g_depth, g_distortion = incoming[y, x, G_ALPHA], incoming[y, x, G_DEPTH], incoming[y, x, G_DISTORTION]
        # Twice: the distortion is quadratic in the weights.
        total = g_alpha * alpha + g_depth * mean + F(2.0) * g_distortion * maps[y, x, DISTORTION]
        for c in range(channels):
            total += incoming[y, x, G_FEATURES + c] * maps[y, x, FEATURES + c]
        t, run = ONE, ZERO
        entry, last = start[tile], start[tile + 1]
        while entry < last and t >= stop:
            i = np.int64(listed[entry])
            entry += 1
            if inside(box, i, x, y):
                _, _, q, z, _, _, _ = meet(splat_of(record, i), x, y, near, far)
                if q < record[i, CUT]:
                    strong = record[i, OPACITY] * gaussian(q)
                    a = min(strong, most)
                    w = t * a
                    g = g_alpha
                    for c in range(channels):
                        g += values[i, c] * incoming[y, x, G_FEATURES + c]
                    g = g + g_depth * z + g_distortion * (z * z * alpha + square - (z + z) * mean)
                    run += w * g
                    pull = t * g - (total - run) / (ONE - a)
                    at = first[i] + np.int64(y - box[i, 1]) * np.int64(box[i, 2] - box[i, 0]) + np.int64(x - box[i, 0])
                    pulls[at, 0], pulls[at, 1] = t, pull if strong < most else ZERO
                    t = t - w


def sum_pixels(thread, stride, scratch, splats, entries, first, maps, incoming, pulls, out):  # type: ignore[no-untyped-def]
    """Gradients of each surfel's record and features from its pixels in one tile.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    splats : tuple
        As of `blend_pixels`.
    entries : tuple
        (k,) arrays: surfel, tile and number of each pair, in the order of tiles; tiles in a row.
    first, maps, incoming : array
        As of `pull_pixels`.
    pulls : array
        Output of `pull_pixels`.
    out : tuple of array
        Gradients of each pair, (pairs, BEFORE + channels) float32; features are added to, the rest is written.
    """
    record, _, box, near, far = splats
    listed, tiles, pairs, tiles_x = entries
    (slots,) = out
    half, width, height = F(0.5), maps.shape[1], maps.shape[0]
    channels = incoming.shape[2] - G_FEATURES
    for entry in range(thread, len(listed), stride):
        i, tile, pair = np.int64(listed[entry]), np.int64(tiles[entry]), pairs[entry]
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        x0, x1 = max(left, np.int64(box[i, 0])), min(min(left + TILE, np.int64(box[i, 2])), width)
        y0, y1 = max(top, np.int64(box[i, 1])), min(min(top + TILE, np.int64(box[i, 3])), height)
        across = np.int64(box[i, 2] - box[i, 0])
        splat = splat_of(record, i)
        to_x, to_y, to_ux, to_uy, to_vx, to_vy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        to_i, to_ix, to_iy, to_opacity, gradient = ZERO, ZERO, ZERO, ZERO, ZERO
        for y in range(y0, y1):
            for x in range(x0, x1):
                at = first[i] + (y - np.int64(box[i, 1])) * across + x - np.int64(box[i, 0])
                t, pull = pulls[at, 0], pulls[at, 1]
                if t > ZERO:
                    ex, ey, q, z, exact, su, sv = meet(splat, x, y, near, far)
                    kernel = gaussian(q)
                    alpha = min(splat.opacity * kernel, F(MAX_ALPHA))
                    w = t * alpha
                    g_distortion = incoming[y, x, G_DISTORTION]
                    g_z = w * (
                        incoming[y, x, G_DEPTH]
                        + (g_distortion + g_distortion) * (z * (ONE - maps[y, x, T]) - maps[y, x, Z])
                    )
                    if t > half and t - w <= half:
                        g_z += incoming[y, x, G_MEDIAN]
                    g_ex, g_ey, g_su, g_sv, g_i, slope = slopes(pull, g_z, alpha, ex, ey, z, exact, su, sv, splat)
                    to_x -= g_ex
                    to_y -= g_ey
                    to_ux += g_su * ex
                    to_uy += g_su * ey
                    to_vx += g_sv * ex
                    to_vy += g_sv * ey
                    to_i += g_i
                    to_ix += slope * ex
                    to_iy += slope * ey
                    to_opacity += pull * kernel
                    gradient += abs(g_ex) + abs(g_ey)
                    for c in range(channels):
                        slots[pair, BEFORE + c] += w * incoming[y, x, G_FEATURES + c]
        slots[pair, RX], slots[pair, RY] = to_x, to_y
        slots[pair, UX], slots[pair, UY], slots[pair, VX], slots[pair, VY] = to_ux, to_uy, to_vx, to_vy
        slots[pair, I0], slots[pair, IX], slots[pair, IY] = to_i, to_ix, to_iy
        slots[pair, OPACITY], slots[pair, SCREEN_GRADIENT] = to_opacity, gradient


def sum_tiles(thread, stride, scratch, slots, first, out):  # type: ignore[no-untyped-def]
    """Add up the gradients of each surfel's pairs, in the order of tiles; one thread per number.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    slots : array
        Output of `sum_pixels`.
    first : (m + 1,) array
        First pair of each surfel.
    out : tuple of array
        Gradients of each surfel, (m, BEFORE + channels) float32; written.
    """
    (total,) = out
    columns = total.shape[1]
    for number in range(thread, total.shape[0] * columns, stride):
        i, c = number // columns, number % columns
        found = ZERO
        for pair in range(first[i], first[i + 1]):
            found += slots[pair, c]
        total[i, c] = found


def project_rows_backward(thread, stride, scratch, surfels, p, index, gradient, out):  # type: ignore[no-untyped-def]
    """`projection.project_backward`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    surfels, p, index, gradient, out : tuple or array
        As of `projection.project_surfel_backward`.
    """
    for k in range(thread, len(index), stride):
        project_surfel_backward(k, surfels, p, index, gradient, out)


PROJECT = WarpKernel(project_rows, (), {})
LIST = WarpKernel(list_pairs, (), {})
BLEND = WarpKernel(blend_pixels, (ScratchArray("float32", (CHANNELS,)),), {})
PULL = WarpKernel(pull_pixels, (), {})
SUM_PIXELS = WarpKernel(sum_pixels, (), {})
SUM_TILES = WarpKernel(sum_tiles, (), {})
PROJECT_BACKWARD = WarpKernel(project_rows_backward, (), {})
