"""Alpha blending of surfels into the maps of a view, pixel by pixel, front to back; `raster` has the formulas.

Pixels are taken in blocks, of which a splat meets all at once: vector code. A worker keeps the blocks of a tile.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import over_strided
from ...render.surfels.blending import MIN_TRANSMITTANCE
from ...render.surfels.raster import gaussian
from ...render.surfels.splats import MAX_ALPHA, TILE
from .projection import LOW_PASS, splat_of

Array = np.ndarray

#: Side of a block of pixels, pixels of it, that vector code works on at a time, and blocks along a side of a tile.
SIDE, LANES = 4, 16
BLOCKS = TILE // SIDE
#: Rows of a block's state, of which all but the weight of the splat at hand become the maps: transmittance, sums of
#: weighted depth and of its square, distortion, median, features. Distances between rows are constants, as vector code
#: wants them.
T, Z, ZZ, DISTORTION, MEDIAN, _W, FEATURES = 0, 1, 2, 3, 4, 5, 6


class Splats(NamedTuple):
    """Surfels that a view shows, in the order of their centres.

    Attributes
    ----------
    record : (m, RECORD) float32 array
        See `projection`.
    values : (m, channels) float32 array
        Features.
    box : (m, 4) int32 array
        See `projection.Projected`.
    near, far : np.float32
        Metres along the view between which a surfel is met; beyond, only the screen-space filter shows it.
    """

    record: Array
    values: Array
    box: Array
    near: np.float32
    far: np.float32


class Tiles(NamedTuple):
    """Splats per tile of the picture.

    Attributes
    ----------
    start : (tiles + 1,) int64 array
        First entry of each tile, row by row.
    listed : (entries,) int32 array
        Splats, in their order.
    across : int
        Tiles in a row.
    """

    start: Array
    listed: Array
    across: int


@inlined
def strength(ex, ey, splat, near, far):  # type: ignore[no-untyped-def]
    """Kernel of a splat at a pixel: of the exact intersection, or of the screen-space filter where that is stronger.

    Parameters
    ----------
    ex, ey : float32
        Pixel from the projected centre, pixels.
    splat : Splat
    near, far : float32
        Metres along the view between which the intersection counts.

    Returns
    -------
    q : float32
        Square radius in standard deviations, that of the filter with its dimming: alpha is opacity exp(-q / 2).
    z : float32
        Depth, m along the view; of the centre where the filter decides.
    exact : bool
        Whether the intersection decides.
    su, sv : float32
        u and v over z, 1/m.
    """
    big, one = np.float32(1e30), np.float32(1.0)
    z = one / (splat.i0 + splat.ix * ex + splat.iy * ey)
    su, sv = splat.ux * ex + splat.uy * ey, splat.vx * ex + splat.vy * ey
    exact = (su * su + sv * sv) * z * z if (z > near) & (z < far) else big
    filtered = np.float32(LOW_PASS) * (ex * ex + ey * ey) + splat.dim
    take = exact <= filtered
    return exact if take else filtered, z if take else one / splat.i0, take, su, sv


@njit
def _blend(splats, i, x, y, state, base):  # type: ignore[no-untyped-def]
    """Blend splat i into the block at (x, y); how many of its pixels are still open. No branch: vector code."""
    zero, one, half, stop = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(MIN_TRANSMITTANCE)
    values, near, far = splats.values, splats.near, splats.far
    splat = splat_of(splats.record, i)
    opacity, cut = splat.opacity, splat.cut
    dx, dy = np.float32(x + 0.5) - splat.rx, np.float32(y + 0.5) - splat.ry
    is_open, hits = np.int32(0), np.int32(0)
    for j in range(LANES):
        at = base + np.uintp(j)
        ex, ey = dx + np.float32(j % SIDE), dy + np.float32(j // SIDE)
        q, z, _, _, _ = strength(ex, ey, splat, near, far)
        t, depth, square = state[at], state[at + np.uintp(Z * LANES)], state[at + np.uintp(ZZ * LANES)]
        seen = (q < cut) & (t >= stop)
        w = t * min(opacity * gaussian(q), np.float32(MAX_ALPHA)) if seen else zero
        after = t - w
        state[at] = after
        state[at + np.uintp(Z * LANES)] = depth + w * z
        state[at + np.uintp(ZZ * LANES)] = square + w * z * z
        state[at + np.uintp(DISTORTION * LANES)] += w * (z * z * (one - t) + square - (z + z) * depth)
        middle = (t > half) & (after <= half)
        before = state[at + np.uintp(MEDIAN * LANES)]
        state[at + np.uintp(MEDIAN * LANES)] = z if middle else before
        state[at + np.uintp(_W * LANES)] = w
        is_open = np.int32(is_open + np.int32(after >= stop))
        hits = np.int32(hits + np.int32(seen))
    if hits > 0:
        for c in range(values.shape[1]):
            f, to = values[i, np.uintp(c)], base + np.uintp(LANES) * np.uintp(FEATURES + c)
            for j in range(LANES):
                state[to + np.uintp(j)] += state[base + np.uintp(_W * LANES + j)] * f
    return is_open


@inlined
def blocks_of(box, i, left, top):  # type: ignore[no-untyped-def]
    """Blocks of a tile that a splat touches.

    Parameters
    ----------
    box : (m, 4) int32 array
        Pixels, see `Splats`.
    i : int64
        Splat.
    left, top : int64
        First pixel of the tile.

    Returns
    -------
    x0, y0, x1, y1 : int64
        Columns and rows of blocks in the tile, half-open.
    """
    x0, y0 = max(box[i, 0] - left, 0) // SIDE, max(box[i, 1] - top, 0) // SIDE
    x1, y1 = (min(box[i, 2] - left, TILE) - 1) // SIDE + 1, (min(box[i, 3] - top, TILE) - 1) // SIDE + 1
    return x0, y0, x1, y1


@inlined
def open_blocks(is_open, left, top, width, height):  # type: ignore[no-untyped-def]
    """Open the blocks of a tile that are in the picture, as not yet opaque.

    Parameters
    ----------
    is_open : (BLOCKS * BLOCKS,) bool array
        Written.
    left, top : int64
        First pixel of the tile.
    width, height : int64
        Of the picture, pixels.

    Returns
    -------
    int64
        How many are open.
    """
    count = 0
    for block in range(BLOCKS * BLOCKS):
        inside = (left + block % BLOCKS * SIDE < width) & (top + block // BLOCKS * SIDE < height)
        is_open[block] = inside
        count += inside
    return count


@njit
def _blend_tile(splats, tiles, tile, state, is_open, maps):  # type: ignore[no-untyped-def]
    """All splats of a tile, front to back."""
    height, width, rows = maps.shape
    left, top = tile % tiles.across * TILE, tile // tiles.across * TILE
    state[:] = np.float32(0.0)
    left_open = open_blocks(is_open, left, top, width, height)
    for block in range(BLOCKS * BLOCKS):
        x, y = left + block % BLOCKS * SIDE, top + block // BLOCKS * SIDE
        for j in range(LANES):
            # Pixels beyond the picture count as opaque.
            if x + j % SIDE < width and y + j // SIDE < height:
                state[block * rows * LANES + j] = np.float32(1.0)
    for entry in range(tiles.start[tile], tiles.start[tile + 1]):
        i = np.uintp(tiles.listed[entry])
        x0, y0, x1, y1 = blocks_of(splats.box, i, left, top)
        for by in range(y0, y1):
            for bx in range(x0, x1):
                block = by * BLOCKS + bx
                if not is_open[block]:
                    continue
                base = np.uintp(block * rows * LANES)
                if _blend(splats, i, left + bx * SIDE, top + by * SIDE, state, base) == 0:
                    is_open[block] = False
                    left_open -= 1
        if left_open == 0:
            break
    for block in range(BLOCKS * BLOCKS):
        for j in range(LANES):
            x, y = left + block % BLOCKS * SIDE + j % SIDE, top + block // BLOCKS * SIDE + j // SIDE
            if x < width and y < height:
                for k in range(rows):
                    maps[y, x, k] = state[(block * rows + k) * LANES + j]


def blend(splats: Splats, tiles: Tiles, maps: Array) -> None:
    """Fill the maps (h, w, state rows and features)."""
    over_strided(_blend_tiles, len(tiles.start) - 1, splats, tiles, maps)


@njit
def _blend_tiles(first, last, workers, splats, tiles, maps):  # type: ignore[no-untyped-def]
    state = np.empty(BLOCKS * BLOCKS * maps.shape[2] * LANES, np.float32)
    is_open = np.empty(BLOCKS * BLOCKS, np.bool_)
    for worker in range(first, last):
        for tile in range(worker, len(tiles.start) - 1, workers):
            _blend_tile(splats, tiles, tile, state, is_open, maps)
