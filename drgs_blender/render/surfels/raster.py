"""Surfels to sub-pixel samples: exact ray-splat intersection, blended front to back, on the CPU.

The kernel of a sample is G = max(exp(-(u^2 + v^2) / 2), exp(-n d^2)), d the distance in pixels between the sample and
the projected centre, n the samples a pixel: the low-pass filter of that paper at the rate at which the picture is
sampled, so that silhouettes do not grow by a pixel where there are sub-samples. A sample that the low-pass decides has
the centre's depth.
Contributions alpha G below 1/255 are skipped, others clamped to 0.99 and blended until the transmittance is below 1e-4.

Order. Contributions are blended by the depth at which the ray meets them, not by that of the surfels' centres: every
sample lists its contributions and sorts them once all are there. A list that is full is sorted early and cut where the
sample is opaque, and only when that does not make room it grows; as 1/255 is the least strength, it stays short.

Depth gaps. Where a ray passes the edge of one surface and meets another, the mean of both would be a point between
them. Contributions are therefore split into clusters where the depth jumps by more than `GAP` standard deviations of
the surfels on both sides (or of the pixel, when that is larger). Position, normal and material are those of the
heaviest cluster alone; coverage is that of all.

Work is divided in tiles and these in blocks of samples that are neighbours in a row; a sample's result depends neither
on them nor on the rows rendered together. Kernels that take many arrays are functions of their own, never inlined in
Numba's sense: in a loop that would count references of every array at every turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...compute.jit import get_num_threads, njit, prange
from ..camera import CLIP_END, CLIP_START, FX, FY, ORTHOGRAPHIC, SUBPIXELS, WIDTH, lattice, pixel_shift
from .blending import GAP, LANES, MANY, MIN_TRANSMITTANCE, mean, merge_sort, prune, rank_sort, weigh, widen
from .splats import (
    CUT,
    DIM,
    LOW,
    OPACITY,
    RECORD,
    RX,
    RY,
    SURFACE,
    TILE,
    ZC,
    A,
    B,
    D,
    N,
    Splats,
)

Array = np.ndarray

__all__ = ["GAP", "SurfelSamples", "rasterise"]

# Rows of the state of a block, `LANES` samples that vector code works on at a time: position; transmittance of all
# contributions gathered and the depth of the farthest; strength and depth of the splat at hand.
_X, _Y, _LEFT, _FARTHEST, _ALPHA, _DEPTH, _BLOCK = (np.uintp(LANES * k) for k in range(7))
# Columns of a splat's record that are free on the screen: opacity and nearest depth.
_STRENGTH, _NEAREST = RECORD - 2, RECORD - 1
#: Contributions of a sample there is room for at first.
ROOM = 64
#: Splats between two looks at which blocks are opaque.
_CHECK = 32
MAX_ALPHA = 0.99


@dataclass(slots=True)
class SurfelSamples:
    """Dense samples of some rows; where ``alpha`` is 0 the other arrays are undefined.

    Attributes
    ----------
    alpha : (rows, width, subpixels) float32 array
        Coverage, 1 - transmittance.
    depth : (rows, width, subpixels) float32 array
        Metres along the view axis.
    surface : (rows, width, subpixels, 9) float32 array
        World normal (unit, on the surfels' own side, which may face away from the viewer; 0 where they cancel), albedo,
        roughness, metallic, and the mean standard deviation in metres.
    object_index : (rows, width, subpixels) int32 array
    """

    alpha: Array
    depth: Array
    surface: Array
    object_index: Array


def rasterise(splats: Splats, y0: int, y1: int) -> SurfelSamples:
    """Blend the splats for the rows ``y0 .. y1`` (full-picture pixels, inside the window)."""
    x0, top, x1, _ = splats.window
    subpixels = int(splats.parameters[SUBPIXELS])
    shape = (y1 - y0, x1 - x0, subpixels)
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
            subpixels,
            4 * get_num_threads(),
            samples.alpha,
            samples.depth,
            samples.surface,
            samples.object_index,
        )
    return samples


@njit(inline="always")
def gaussian(q):  # type: ignore[no-untyped-def]
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


@njit
def _meet(screen, i, opacity, near, far, state, first, last):  # type: ignore[no-untyped-def]
    """Splat i at the lanes first .. last of a block: strength (0 where it has no part) and depth; how many have one.

    One array, constant distances, no branch: the loop becomes vector code.
    """
    big, zero, one, stop = np.float32(1e30), np.float32(0.0), np.float32(1.0), np.float32(MIN_TRANSMITTANCE)
    rx, ry, zc = screen[i, RX], screen[i, RY], screen[i, ZC]
    cut, low, dim = screen[i, CUT], screen[i, LOW], screen[i, DIM]
    a0, a1, a2 = screen[i, A], screen[i, A + 1], screen[i, A + 2]
    b0, b1, b2 = screen[i, B], screen[i, B + 1], screen[i, B + 2]
    n0, n1, n2 = screen[i, N], screen[i, N + 1], screen[i, N + 2]
    d0, d1, d2 = screen[i, D], screen[i, D + 1], screen[i, D + 2]
    hits = np.int32(0)
    for j in range(LANES):
        at = np.uintp(j)
        ex, ey = state[at + _X] - rx, state[at + _Y] - ry
        inverse = one / (n0 + n1 * ex + n2 * ey)
        u = (a0 + a1 * ex + a2 * ey) * inverse
        v = (b0 + b1 * ex + b2 * ey) * inverse
        z = (d0 + d1 * ex + d2 * ey) * inverse
        # NaN and points outside the clip range leave the low-pass alone.
        exact = u * u + v * v if (z > near) & (z < far) else big
        filtered = low * (ex * ex + ey * ey) + dim
        take = exact <= filtered
        q = exact if take else filtered
        z = z if take else zc
        before, farthest = state[at + _LEFT], state[at + _FARTHEST]
        inside = (np.int32(j) >= first) & (np.int32(j) < last)
        seen = inside & (q < cut) & (z > near) & (z < far) & ((before >= stop) | (z < farthest))
        alpha = min(opacity * gaussian(q), np.float32(MAX_ALPHA)) if seen else zero
        state[at + _ALPHA] = alpha
        state[at + _DEPTH] = z
        state[at + _LEFT] = before * (one - alpha)
        state[at + _FARTHEST] = z if seen & (z > farthest) else farthest
        hits = np.int32(hits + np.int32(seen))
    return hits


@njit
def _collect(  # type: ignore[no-untyped-def]
    tile_list, begin, end, screen, surface, box, nearest, left, top, right, bottom, tile_left, tile_top, subpixels,
    records, surfaces, spans,
):  # fmt: skip
    """Bring together what blending reads of a tile's splats; spans are samples of the tile's rows, and rows."""
    for entry in range(begin, end):
        i, e = np.uintp(tile_list[entry]), np.uintp(entry - begin)
        for c in range(RECORD):
            records[e, c] = screen[i, c]
        for c in range(SURFACE):
            surfaces[e, c] = surface[i, c]
        records[e, _STRENGTH], records[e, _NEAREST] = surface[i, OPACITY], nearest[i]
        spans[e, 0], spans[e, 2] = (
            (max(box[i, 0], left) - tile_left) * subpixels,
            (min(box[i, 2], right) - tile_left) * subpixels,
        )
        spans[e, 1], spans[e, 3] = max(box[i, 1], top) - tile_top, min(box[i, 3], bottom) - tile_top


@njit
def _count(spans, n, blocks_row, start):  # type: ignore[no-untyped-def]
    """start[b + 1] .. start[b + 2]: how many of the tile's splats touch the blocks before, and b as well."""
    start[:] = 0
    for e in range(n):
        first, last = spans[e, 0] // LANES, (spans[e, 2] - 1) // LANES
        for y in range(spans[e, 1], spans[e, 3]):
            for block in range(y * blocks_row + first, y * blocks_row + last + 1):
                start[np.uintp(block + 2)] += 1
    for b in range(2, len(start)):
        start[b] += start[b - 1]


@njit
def _bin(spans, n, blocks_row, start, binned):  # type: ignore[no-untyped-def]
    """Counting sort of the tile's splats by block, in order; afterwards start[b] .. start[b + 1] are those of b."""
    for e in range(n):
        first, last = spans[e, 0] // LANES, (spans[e, 2] - 1) // LANES
        for y in range(spans[e, 1], spans[e, 3]):
            for block in range(y * blocks_row + first, y * blocks_row + last + 1):
                to = start[np.uintp(block + 1)]
                binned[np.uintp(to)] = e
                start[np.uintp(block + 1)] = to + 1


@njit
def _limit(state):  # type: ignore[no-untyped-def]
    """Depth from which on a block takes no contribution, as all its samples are opaque."""
    limit = np.float32(-1e30)
    for lane in range(LANES):
        k = np.uintp(lane)
        is_open = state[_LEFT + k] >= np.float32(MIN_TRANSMITTANCE)
        limit = max(limit, np.float32(1e30) if is_open else state[_FARTHEST + k])
    return limit


@njit
def _place(p, width, y, tile_left, left, right, first, subpixels, state):  # type: ignore[no-untyped-def]
    """Start a block: positions of its samples, nothing gathered. Those outside the window count as opaque."""
    zero = np.float32(0.0)
    for lane in range(LANES):
        k = np.uintp(lane)
        x = tile_left + (first + lane) // subpixels
        state[_X + k] = state[_Y + k] = state[_LEFT + k] = zero
        state[_FARTHEST + k] = np.float32(-1e30)
        if left <= x < right:
            shift_x, shift_y = pixel_shift(p, y * width + x)
            jx, jy = lattice(shift_x, shift_y, (first + lane) % subpixels, p)
            state[_X + k], state[_Y + k], state[_LEFT + k] = x + jx, y + jy, np.float32(1.0)


@njit
def _gather(records, spans, binned, begin, end, first, near, far, state, count, lists_z, lists_a, lists_i, room):  # type: ignore[no-untyped-def]
    """List the contributions of the splats begin .. end to a block's samples.

    Returns the splat to go on with: it is less than `end` when a sample's list is full.
    """
    limit = np.float32(1e30)
    for entry in range(begin, end):
        i = np.uintp(binned[np.uintp(entry)])
        if (entry - begin) % _CHECK == _CHECK - 1:
            limit = _limit(state)
        if records[i, _NEAREST] >= limit:
            continue
        hits = _meet(
            records, i, records[i, _STRENGTH], near, far, state,
            np.int32(spans[i, 0] - first), np.int32(spans[i, 2] - first),
        )  # fmt: skip
        if hits == 0:
            continue
        most = np.int32(0)
        for lane in range(LANES):
            k = np.uintp(lane)
            n = count[k]
            to = k * np.uintp(room) + np.uintp(n)
            lists_z[to], lists_a[to], lists_i[to] = state[_DEPTH + k], state[_ALPHA + k], i
            n += np.int32(state[_ALPHA + k] > np.float32(0.0))
            count[k] = n
            most = max(most, n)
        if most == room:
            return entry + 1
    return end


@njit
def _finish(  # type: ignore[no-untyped-def]
    surfaces, lists_z, lists_a, lists_i, room, count, rank, order, weights, pixel_base, pixel, subpixels, y, x, first,
    owner, out_alpha, out_depth, out_surface,
):  # fmt: skip
    """Resolve the samples of a block and write them; ``owner`` gets each one's heaviest splat. x: of the tile."""
    for lane in range(LANES):
        n = np.int64(count[lane])
        if n == 0:
            continue
        base = lane * room
        if n > MANY:
            merge_sort(lists_z, base, n, order)
        else:
            rank_sort(lists_z, base, n, rank, order)
        column, k = x + (first + lane) // subpixels, (first + lane) % subpixels
        t, total, depth, owner[lane], begin, end = weigh(
            surfaces, lists_z, lists_a, lists_i, base, n, order, weights, pixel_base, pixel
        )
        values = mean(surfaces, lists_i, base, order, weights, total, begin, end)
        for c in range(9):
            out_surface[y, column, k, c] = values[c]
        out_alpha[y, column, k], out_depth[y, column, k] = np.float32(1.0) - t, depth * (np.float32(1.0) / total)


@njit(parallel=True)
def _blend(  # type: ignore[no-untyped-def]
    screen,
    surface,
    box,
    nearest,
    objects,
    tile_start,
    tile_list,
    p,
    x0,
    x1,
    tile_y0,
    y0,
    y1,
    subpixels,
    workers,
    out_alpha,
    out_depth,
    out_surface,
    out_object,
):
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
    blocks_row = TILE * subpixels // LANES
    for worker in prange(workers):
        state = np.empty(_BLOCK, np.float32)
        count = np.empty(LANES, np.int32)
        room = ROOM
        lists_z, lists_a = np.empty(LANES * room, np.float32), np.empty(LANES * room, np.float32)
        lists_i = np.empty(LANES * room, np.int32)
        rank, order, weights = np.empty(LANES, np.int32), np.empty(room, np.int32), np.empty(room, np.float32)
        start, binned = np.empty(TILE * blocks_row + 2, np.int64), np.empty(0, np.int32)
        records, surfaces = np.empty((0, RECORD), np.float32), np.empty((0, SURFACE), np.float32)
        spans, owner = np.empty((0, 4), np.int32), np.empty(LANES, np.int32)
        for task in range(worker, n_tiles, workers):
            tx, ty = tile_x0 + task % tiles_x, first_row + task // tiles_x
            tile = (ty - tile_y0) * tiles_x + task % tiles_x
            listed, n = tile_start[tile], tile_start[tile + 1] - tile_start[tile]
            if n == 0:
                continue
            left, top = max(tx * TILE, x0), max(ty * TILE, y0)
            right, bottom = min(tx * TILE + TILE, x1), min(ty * TILE + TILE, y1)
            if n > len(records):
                records, surfaces = np.empty((2 * n, RECORD), np.float32), np.empty((2 * n, SURFACE), np.float32)
                spans = np.empty((2 * n, 4), np.int32)
            _collect(
                tile_list, listed, listed + n, screen, surface, box, nearest, left, top, right, bottom,
                tx * TILE, ty * TILE, subpixels, records, surfaces, spans,
            )  # fmt: skip
            _count(spans, n, blocks_row, start)
            if start[-1] > len(binned):
                binned = np.empty(2 * start[-1], np.int32)
            _bin(spans, n, blocks_row, start, binned)
            for block in range(TILE * blocks_row):
                begin, end = start[block], start[block + 1]
                if begin == end:
                    continue
                y = ty * TILE + block // blocks_row
                first = block % blocks_row * LANES  # of the samples of the tile's row
                _place(p, width, y, tx * TILE, left, right, first, subpixels, state)
                count[:] = 0
                while True:
                    begin = _gather(
                        records, spans, binned, begin, end, first, near, far, state, count,
                        lists_z, lists_a, lists_i, room,
                    )  # fmt: skip
                    if begin == end:
                        break
                    most = 0
                    for lane in range(LANES):
                        if count[lane] == room:
                            kept = prune(lists_z, lists_a, lists_i, lane * room, room, rank, order)
                            if kept < room:
                                state[_FARTHEST + np.uintp(lane)] = lists_z[lane * room + kept - 1]
                            count[lane] = kept
                        most = max(most, count[lane])
                    if most > room // 2:
                        lists_z, lists_a = widen(lists_z, room), widen(lists_a, room)
                        lists_i = widen(lists_i, room)
                        room *= 2
                        order, weights = np.empty(room, np.int32), np.empty(room, np.float32)
                _finish(
                    surfaces, lists_z, lists_a, lists_i, room, count, rank, order, weights, pixel_base, pixel,
                    subpixels,
                    y - y0, tx * TILE - x0, first, owner, out_alpha, out_depth, out_surface,
                )  # fmt: skip
                for lane in range(LANES):
                    if count[lane] > 0:
                        out_object[y - y0, tx * TILE - x0 + (first + lane) // subpixels, (first + lane) % subpixels] = (
                            objects[tile_list[listed + owner[lane]]]
                        )
