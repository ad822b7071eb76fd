"""Gradients of the maps of a view by what was blended into them; `raster` has the formulas."""

from __future__ import annotations

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import over_strided
from ...render.surfels.blending import MIN_TRANSMITTANCE
from ...render.surfels.raster import gaussian
from ...render.surfels.splats import MAX_ALPHA, TILE
from .blend import (
    BLOCKS,
    DISTORTION,
    FEATURES,
    LANES,
    SIDE,
    ZZ,
    Splats,
    T,
    Tiles,
    Z,
    blocks_of,
    open_blocks,
    strength,
)
from .projection import I0, IX, IY, LOW_PASS, OPACITY, PARAMETERS, RX, RY, UX, UY, VX, VY, splat_of

Array = np.ndarray

# Rows of a block's state after the transmittance: running sum of weights times gradients; its total, alpha, depth and
# squared depth of the pixel; gradients of alpha, depth, median and distortion, g and weight of the splat at hand; those
# of the features.
_R, _S, _A, _M, _MM, _GA, _GZ, _GM, _GD, _G, _GW, _GF = 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12
#: Columns of a splat's gradients before the features': the record's, then what
#: `raster.GradientStatistics` counts.
SCREEN_GRADIENT, BEFORE = PARAMETERS, PARAMETERS + 1


@inlined
def slopes(g_alpha, g_depth, alpha, ex, ey, z, exact, su, sv, splat):  # type: ignore[no-untyped-def]
    """Gradients of one pixel by what `strength` computes from, given those by alpha and depth.

    Parameters
    ----------
    g_alpha, g_depth : float32
        Gradients of the loss by the alpha of the splat at the pixel and by its depth.
    alpha : float32
    ex, ey, z, exact, su, sv : float32 or bool
        As of `strength`.
    splat : Splat

    Returns
    -------
    by_ex, by_ey : float32
        By the pixel's place from the projected centre.
    by_su, by_sv : float32
        By u and v over z.
    by_i : float32
        By 1 / z.
    by_slope : float32
        The same where the place changes it: 0 unless the intersection decides.
    """
    zero = np.float32(0.0)
    g_q = np.float32(-0.5) * alpha * g_alpha
    # Where the intersection decides, q = (su^2 + sv^2) z^2; else it is the squared distance on the screen.
    by_su, by_sv = (g_q + g_q) * su * z * z, (g_q + g_q) * sv * z * z
    by_i = -z * z * (g_depth + (g_q + g_q) * (su * su + sv * sv) * z)
    by_ex = by_su * splat.ux + by_sv * splat.vx + by_i * splat.ix
    by_ey = by_su * splat.uy + by_sv * splat.vy + by_i * splat.iy
    low = np.float32(2.0 * LOW_PASS) * g_q
    g_i = by_i if exact else -z * z * g_depth
    return (
        by_ex if exact else low * ex,
        by_ey if exact else low * ey,
        by_su if exact else zero,
        by_sv if exact else zero,
        g_i,
        g_i if exact else zero,
    )


@njit
def _blend_backward(splats, i, x, y, state, base, sums):  # type: ignore[no-untyped-def]
    """Gradients of splat i from the block at (x, y), added to `sums` lane by lane; how many pixels are still open."""
    zero, one, half, stop = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(MIN_TRANSMITTANCE)
    most = np.float32(MAX_ALPHA)
    values, near, far = splats.values, splats.near, splats.far
    channels = values.shape[1]
    splat = splat_of(splats.record, i)
    opacity, cut = splat.opacity, splat.cut
    dx, dy = np.float32(x + 0.5) - splat.rx, np.float32(y + 0.5) - splat.ry
    for j in range(LANES):
        state[base + np.uintp(_G * LANES + j)] = state[base + np.uintp(_GA * LANES + j)]
    for c in range(channels):
        f, at = values[i, np.uintp(c)], base + np.uintp(LANES) * np.uintp(_GF + c)
        for j in range(LANES):
            state[base + np.uintp(_G * LANES + j)] += f * state[at + np.uintp(j)]
    is_open, hits = np.int32(0), np.int32(0)
    for j in range(LANES):
        lane = np.uintp(j)
        at = base + lane
        ex, ey = dx + np.float32(j % SIDE), dy + np.float32(j // SIDE)
        q, z, exact, su, sv = strength(ex, ey, splat, near, far)
        t = state[at]
        seen = (q < cut) & (t >= stop)
        kernel = gaussian(q)
        alpha = min(opacity * kernel, most) if seen else zero
        w = t * alpha
        after = t - w
        g_z, g_dist = state[at + np.uintp(_GZ * LANES)], state[at + np.uintp(_GD * LANES)]
        total, mean, square = (
            state[at + np.uintp(_A * LANES)],
            state[at + np.uintp(_M * LANES)],
            state[at + np.uintp(_MM * LANES)],
        )
        g = state[at + np.uintp(_G * LANES)] + g_z * z + g_dist * (z * z * total + square - (z + z) * mean)
        run = state[at + np.uintp(_R * LANES)] + w * g
        state[at], state[at + np.uintp(_R * LANES)] = after, run
        g_alpha = t * g - (state[at + np.uintp(_S * LANES)] - run) / (one - alpha)
        middle = (t > half) & (after <= half)
        g_depth = w * (g_z + (g_dist + g_dist) * (z * total - mean))
        g_depth += state[at + np.uintp(_GM * LANES)] if middle else zero
        g_alpha = g_alpha if seen & (opacity * kernel < most) else zero
        g_depth = g_depth if seen else zero
        g_ex, g_ey, g_su, g_sv, g_i, slope = slopes(g_alpha, g_depth, alpha, ex, ey, z, exact, su, sv, splat)
        sums[np.uintp(RX * LANES) + lane] -= g_ex
        sums[np.uintp(RY * LANES) + lane] -= g_ey
        sums[np.uintp(UX * LANES) + lane] += g_su * ex
        sums[np.uintp(UY * LANES) + lane] += g_su * ey
        sums[np.uintp(VX * LANES) + lane] += g_sv * ex
        sums[np.uintp(VY * LANES) + lane] += g_sv * ey
        sums[np.uintp(I0 * LANES) + lane] += g_i
        sums[np.uintp(IX * LANES) + lane] += slope * ex
        sums[np.uintp(IY * LANES) + lane] += slope * ey
        sums[np.uintp(OPACITY * LANES) + lane] += g_alpha * kernel if seen else zero
        sums[np.uintp(SCREEN_GRADIENT * LANES) + lane] += abs(g_ex) + abs(g_ey)
        state[at + np.uintp(_GW * LANES)] = w
        is_open = np.int32(is_open + np.int32(after >= stop))
        hits = np.int32(hits + np.int32(seen))
    if hits > 0:
        for c in range(channels):
            to, at = np.uintp((BEFORE + c) * LANES), base + np.uintp(LANES) * np.uintp(_GF + c)
            for j in range(LANES):
                sums[to + np.uintp(j)] += state[base + np.uintp(_GW * LANES + j)] * state[at + np.uintp(j)]
    return is_open


@njit
def _load(maps, incoming, y, x, state, base, channels):  # type: ignore[no-untyped-def]
    """The pixel's totals and gradients into a lane of a block's state, rows LANES apart from `base` on."""
    alpha = np.float32(1.0) - maps[y, x, T]
    g_alpha, g_depth, g_median, g_dist = incoming[y, x, 0], incoming[y, x, 1], incoming[y, x, 2], incoming[y, x, 3]
    # Twice: the distortion is quadratic in the weights.
    total = g_alpha * alpha + g_depth * maps[y, x, Z] + np.float32(2.0) * g_dist * maps[y, x, DISTORTION]
    for c in range(channels):
        g = incoming[y, x, 4 + c]
        total += g * maps[y, x, FEATURES + c]
        state[base + (_GF + c) * LANES] = g
    state[base] = np.float32(1.0)
    state[base + _S * LANES], state[base + _A * LANES] = total, alpha
    state[base + _M * LANES], state[base + _MM * LANES] = maps[y, x, Z], maps[y, x, ZZ]
    state[base + _GA * LANES], state[base + _GZ * LANES] = g_alpha, g_depth
    state[base + _GM * LANES], state[base + _GD * LANES] = g_median, g_dist


@njit
def _blend_tile_backward(splats, tiles, tile, state, is_open, sums, maps, incoming, slots):  # type: ignore[no-untyped-def]
    """Gradients of all splats of a tile, front to back."""
    height, width, channels = maps.shape[0], maps.shape[1], splats.values.shape[1]
    columns, rows = BEFORE + channels, _GF + channels
    left, top = tile % tiles.across * TILE, tile // tiles.across * TILE
    state[:] = np.float32(0.0)
    left_open = open_blocks(is_open, left, top, width, height)
    for block in range(BLOCKS * BLOCKS):
        x, y = left + block % BLOCKS * SIDE, top + block // BLOCKS * SIDE
        for j in range(LANES):
            if x + j % SIDE < width and y + j // SIDE < height:
                _load(maps, incoming, y + j // SIDE, x + j % SIDE, state, block * rows * LANES + j, channels)
    for entry in range(tiles.start[tile], tiles.start[tile + 1]):
        i = np.uintp(tiles.listed[entry])
        x0, y0, x1, y1 = blocks_of(splats.box, i, left, top)
        touched = False
        for by in range(y0, y1):
            for bx in range(x0, x1):
                block = by * BLOCKS + bx
                if not is_open[block]:
                    continue
                if not touched:
                    sums[:] = np.float32(0.0)
                    touched = True
                base = np.uintp(block * rows * LANES)
                x, y = left + bx * SIDE, top + by * SIDE
                if _blend_backward(splats, i, x, y, state, base, sums) == 0:
                    is_open[block] = False
                    left_open -= 1
        if touched:
            _fold(sums, columns, slots, entry)
        if left_open == 0:
            break


@njit
def _fold(sums, columns, slots, entry):  # type: ignore[no-untyped-def]
    """Add up the lanes of each column into the slot."""
    for c in range(columns):
        at = np.uintp(c * LANES)
        for j in range(8):
            sums[at + np.uintp(j)] += sums[at + np.uintp(j + 8)]
        a = (sums[at] + sums[at + np.uintp(4)]) + (sums[at + np.uintp(1)] + sums[at + np.uintp(5)])
        b = (sums[at + np.uintp(2)] + sums[at + np.uintp(6)]) + (sums[at + np.uintp(3)] + sums[at + np.uintp(7)])
        slots[entry, c] = a + b


def blend_backward(splats: Splats, tiles: Tiles, maps: Array, incoming: Array, slots: Array) -> None:
    """Gradients of each splat by tile.

    Parameters
    ----------
    splats : Splats
    tiles : Tiles
    maps : (h, w, rows) float32 array
        Output of `blend`.
    incoming : (h, w, 4 + channels) float32 array
        Gradients of alpha, depth, median, distortion and features.
    slots : (entries of all tiles, BEFORE + channels) float32 array
        Written.
    """
    over_strided(_blend_tiles_backward, len(tiles.start) - 1, splats, tiles, maps, incoming, slots)


@njit
def _blend_tiles_backward(first, last, workers, splats, tiles, maps, incoming, slots):  # type: ignore[no-untyped-def]
    channels = splats.values.shape[1]
    state = np.empty(BLOCKS * BLOCKS * (_GF + channels) * LANES, np.float32)
    sums = np.empty((BEFORE + channels) * LANES, np.float32)
    is_open = np.empty(BLOCKS * BLOCKS, np.bool_)
    for worker in range(first, last):
        for tile in range(worker, len(tiles.start) - 1, workers):
            _blend_tile_backward(splats, tiles, tile, state, is_open, sums, maps, incoming, slots)


@njit
def sum_slots(listed: Array, slots: Array, total: Array) -> None:
    """Add up the slots of each splat, in the order of tiles."""
    for entry in range(len(listed)):
        i = listed[entry]
        for c in range(total.shape[1]):
            total[i, c] += slots[entry, c]
