"""Differentiable rasteriser of surfels: the maps of the paper's rasterisation equation, and their gradients.

Kernel and strengths are those of `render.surfels.raster` with one sample a pixel; here surfels are blended in the
order of their centres (one sort a view), which has gradients everywhere, and means are not divided by coverage.
With T_i = prod_{j<i} (1 - a_j) and w_i = T_i a_i the maps are

    features  sum w_i f_i         depth  sum w_i z_i         alpha  sum w_i
    distortion  sum_{j<i} w_i w_j (z_i - z_j)^2      (Huang et al. 2024, "2D Gaussian Splatting", of metres)
    median  z of the contribution at which T falls below one half; 0 where it never does

Backwards a pixel is walked front to back once more: dL/da_i = T_i g_i - (S - R_i) / (1 - a_i), where g_i is the
gradient of w_i, S the sum of all w_j g_j (known from the maps themselves) and R_i the part of it up to i. Gradients of
a surfel are summed within a tile, kept by (surfel, tile), then summed in the order of tiles: the same bits with any
number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...compute.jit import get_num_threads, njit, prange
from ...core.arrays import Array
from ...core.errors import UsageError
from ...core.frame import Camera, RenderSettings
from ...render.camera import CLIP_END, CLIP_START, camera_parameters
from ...render.surfels.raster import MAX_ALPHA, gaussian
from ...render.surfels.splats import TILE, depth_order, list_by_tile
from .projection import (
    CUT,
    DIM,
    I0,
    IX,
    IY,
    LOW_PASS,
    OPACITY,
    PARAMETERS,
    RECORD,
    RX,
    RY,
    UX,
    UY,
    VX,
    VY,
    project,
    project_backward,
)

MIN_TRANSMITTANCE = 1e-4
#: Side of a block of pixels, and pixels of it, that vector code works on at a time.
SIDE, LANES = 4, 16
_BLOCKS = TILE // SIDE
# Rows of a block's state, forwards; _W is the weight of the splat at hand. Distances between rows are constants, as
# vector code wants them.
_T, _Z, _ZZ, _DIST, _MED, _W, _FEATURES = 0, 1, 2, 3, 4, 5, 6
# Backwards: running transmittance and sum; total sum, alpha, depth and squared depth of the pixel; gradients of alpha,
# depth, median and distortion, g and weight of the splat at hand; those of the features.
_R, _S, _A, _M, _MM, _GA, _GZ, _GM, _GD, _G, _GW, _GF = 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12
#: Columns of a splat's gradients before the features': the record's, then the travel of its pixels (see `Tally`).
TRAVEL, BEFORE = PARAMETERS, PARAMETERS + 1


@dataclass(slots=True)
class Maps:
    """What a view shows: features (h, w, c), the others (h, w); see the module."""

    features: Tensor
    alpha: Tensor
    depth: Tensor
    median: Tensor
    distortion: Tensor


@dataclass(slots=True)
class Tally:
    """What a backward pass notes about surfels, for densification.

    Attributes
    ----------
    travel : (n,) float32 tensor
        += sum over pixels of |dL/dx| + |dL/dy| of the projected centre (Ye et al. 2024, "AbsGS": absolute values, so
        that pixels that pull in opposite directions do not cancel).
    views : (n,) int32 tensor
        += 1 where the surfel was listed in a tile.
    """

    travel: Tensor
    views: Tensor

    @classmethod
    def of(cls, n: int, place: torch.device | None = None) -> Tally:
        """Nothing noted yet about `n` surfels."""
        return cls(torch.zeros(n, device=place), torch.zeros(n, dtype=torch.int32, device=place))


def rasterise(
    centre: Tensor,
    tangent_u: Tensor,
    tangent_v: Tensor,
    opacity: Tensor,
    features: Tensor,
    camera: Camera,
    tally: Tally | None = None,
) -> Maps:
    """Blend surfels into the maps of a view; differentiable in all tensors.

    Parameters
    ----------
    centre, tangent_u, tangent_v : (n, 3) float32 tensor
        World space, tangents scaled by the standard deviations.
    opacity : (n,) float32 tensor
    features : (n, c) float32 tensor
        Of any kind.
    camera : Camera
        Perspective, the whole picture.
    tally : Tally, optional
        Is added to when gradients are computed.

    Raises
    ------
    UsageError: the camera is orthographic or cannot take a picture.
    """
    parameters, size = view_of(camera)
    return Maps(*_Rasterise.apply(centre, tangent_u, tangent_v, opacity, features, parameters, size, tally))


def view_of(camera: Camera) -> tuple[Array, tuple[int, int]]:
    """`camera_parameters` of a camera that photographs, and the picture's width and height; see `rasterise`."""
    if camera.orthographic:
        raise UsageError("camera", "is orthographic", "Photographs to learn from are perspective")
    return camera_parameters(camera, RenderSettings(subpixel_samples=1), 0), (camera.width, camera.height)


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, centre: Tensor, tangent_u: Tensor, tangent_v: Tensor, opacity: Tensor, features: Tensor,
        parameters: Array, size: tuple[int, int], tally: Tally | None,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        arrays = [np.ascontiguousarray(t.detach().numpy(), np.float32) for t in (centre, tangent_u, tangent_v)]
        alpha = np.ascontiguousarray(opacity.detach().numpy(), np.float32)
        width, height = size
        n = len(alpha)
        record, depth, box = np.empty((n, RECORD), np.float32), np.empty(n, np.float32), np.empty((n, 4), np.int32)
        project(*arrays, alpha, parameters, width, height, record, depth, box)
        order = depth_order(depth, box)
        record, box = record[order], box[order]
        values = np.ascontiguousarray(features.detach().numpy()[order], np.float32)
        tiles_x, tiles_y = (width - 1) // TILE + 1, (height - 1) // TILE + 1
        start, listed = list_by_tile(box, 0, 0, tiles_x, tiles_y)
        maps = np.zeros((height, width, _FEATURES + values.shape[1]), np.float32)
        _forward(record, values, box, start, listed, parameters, tiles_x, 4 * get_num_threads(), maps)
        ctx.save = (arrays, parameters, order, record, values, box, start, listed, tiles_x, maps, tally, n)
        ctx.set_materialize_grads(False)
        out = torch.from_numpy(maps)
        # Copies: the maps are needed as they are for the way back.
        return out[..., _FEATURES:].clone(), 1 - out[..., _T], *(out[..., k].clone() for k in (_Z, _MED, _DIST))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Any, ...]:
        arrays, parameters, order, record, values, box, start, listed, tiles_x, maps, tally, n = ctx.save
        height, width, _ = maps.shape
        channels = values.shape[1]
        incoming = np.zeros((height, width, 4 + channels), np.float32)
        g_features, *others = gradients
        for k, g in enumerate(others):
            if g is not None:
                incoming[..., k] = g.numpy()
        if g_features is not None:
            incoming[..., 4:] = g_features.numpy()
        slots = np.zeros((len(listed), BEFORE + channels), np.float32)
        _backward(record, values, box, start, listed, parameters, tiles_x, 4 * get_num_threads(), maps, incoming, slots)
        total = np.zeros((len(order), BEFORE + channels), np.float32)
        _sum_slots(listed, slots, total)
        moved = [np.zeros((n, 3), np.float32) for _ in range(3)]
        project_backward(*arrays, parameters, order, total, *moved)
        g_opacity, g_values = np.zeros(n, np.float32), np.zeros((n, channels), np.float32)
        g_opacity[order], g_values[order] = total[:, OPACITY], total[:, BEFORE:]
        if tally is not None:
            tally.travel.numpy()[order] += total[:, TRAVEL]
            tally.views.numpy()[order] += 1
        return *(torch.from_numpy(g) for g in (*moved, g_opacity, g_values)), None, None, None


@njit(inline="always")
def strength(ex, ey, ux, uy, vx, vy, i0, ix, iy, zc, dim, near, far):  # type: ignore[no-untyped-def]
    """Squared radius and depth where a pixel at (ex, ey) from the centre meets a splat.

    Then whether the exact intersection decides (else the screen-space filter); u, v over z are the last two.
    """
    big = np.float32(1e30)
    z = np.float32(1.0) / (i0 + ix * ex + iy * ey)
    su, sv = ux * ex + uy * ey, vx * ex + vy * ey
    exact = (su * su + sv * sv) * z * z if (z > near) & (z < far) else big
    filtered = np.float32(LOW_PASS) * (ex * ex + ey * ey) + dim
    take = exact <= filtered
    return exact if take else filtered, z if take else zc, take, su, sv


@njit
def _blend(record, i, values, x, y, near, far, state, base, channels):  # type: ignore[no-untyped-def]
    """Blend splat i into the block at (x, y); how many of its pixels are still open. No branch: vector code."""
    zero, one, half, stop = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(MIN_TRANSMITTANCE)
    rx, ry, opacity, cut = record[i, RX], record[i, RY], record[i, OPACITY], record[i, CUT]
    ux, uy, vx, vy = record[i, UX], record[i, UY], record[i, VX], record[i, VY]
    i0, ix, iy, dim = record[i, I0], record[i, IX], record[i, IY], record[i, DIM]
    zc, dx, dy = one / i0, np.float32(x + 0.5) - rx, np.float32(y + 0.5) - ry
    is_open, hits = np.int32(0), np.int32(0)
    for j in range(LANES):
        at = base + np.uintp(j)
        ex, ey = dx + np.float32(j % SIDE), dy + np.float32(j // SIDE)
        q, z, _, _, _ = strength(ex, ey, ux, uy, vx, vy, i0, ix, iy, zc, dim, near, far)
        t, depth, square = state[at], state[at + np.uintp(_Z * LANES)], state[at + np.uintp(_ZZ * LANES)]
        seen = (q < cut) & (t >= stop)
        w = t * min(opacity * gaussian(q), np.float32(MAX_ALPHA)) if seen else zero
        after = t - w
        state[at] = after
        state[at + np.uintp(_Z * LANES)] = depth + w * z
        state[at + np.uintp(_ZZ * LANES)] = square + w * z * z
        state[at + np.uintp(_DIST * LANES)] += w * (z * z * (one - t) + square - (z + z) * depth)
        middle = (t > half) & (after <= half)
        before = state[at + np.uintp(_MED * LANES)]
        state[at + np.uintp(_MED * LANES)] = z if middle else before
        state[at + np.uintp(_W * LANES)] = w
        is_open = np.int32(is_open + np.int32(after >= stop))
        hits = np.int32(hits + np.int32(seen))
    if hits > 0:
        for c in range(channels):
            f, to = values[i, np.uintp(c)], base + np.uintp(LANES) * np.uintp(_FEATURES + c)
            for j in range(LANES):
                state[to + np.uintp(j)] += state[base + np.uintp(_W * LANES + j)] * f
    return is_open


@njit(inline="always")
def _blocks(box, i, left, top):  # type: ignore[no-untyped-def]
    """Blocks (x0, y0, x1, y1), half-open, of the tile at (left, top) that splat i touches."""
    x0, y0 = max(box[i, 0] - left, 0) // SIDE, max(box[i, 1] - top, 0) // SIDE
    x1, y1 = (min(box[i, 2] - left, TILE) - 1) // SIDE + 1, (min(box[i, 3] - top, TILE) - 1) // SIDE + 1
    return x0, y0, x1, y1


@njit
def _forward_tile(record, values, box, listed, begin, end, left, top, near, far, state, rows, is_open, maps):  # type: ignore[no-untyped-def]
    """All splats of a tile, front to back."""
    height, width, channels = maps.shape[0], maps.shape[1], values.shape[1]
    state[:] = np.float32(0.0)
    left_open = 0
    for block in range(_BLOCKS * _BLOCKS):
        x, y = left + block % _BLOCKS * SIDE, top + block // _BLOCKS * SIDE
        inside = (x < width) & (y < height)
        is_open[block] = inside
        left_open += inside
        for j in range(LANES):
            # Pixels beyond the picture count as opaque.
            if inside and x + j % SIDE < width and y + j // SIDE < height:
                state[block * rows * LANES + j] = np.float32(1.0)
    for entry in range(begin, end):
        i = np.uintp(listed[entry])
        x0, y0, x1, y1 = _blocks(box, i, left, top)
        for by in range(y0, y1):
            for bx in range(x0, x1):
                block = by * _BLOCKS + bx
                if not is_open[block]:
                    continue
                base = np.uintp(block * rows * LANES)
                if _blend(record, i, values, left + bx * SIDE, top + by * SIDE, near, far, state, base, channels) == 0:
                    is_open[block] = False
                    left_open -= 1
        if left_open == 0:
            break
    for block in range(_BLOCKS * _BLOCKS):
        for j in range(LANES):
            x, y = left + block % _BLOCKS * SIDE + j % SIDE, top + block // _BLOCKS * SIDE + j // SIDE
            if x < width and y < height:
                for k in range(rows):
                    maps[y, x, k] = state[(block * rows + k) * LANES + j]


@njit(parallel=True)
def _forward(record, values, box, start, listed, p, tiles_x, workers, maps):  # type: ignore[no-untyped-def]
    """Fill the maps (h, w, state rows and features). A worker takes every `workers`-th tile: neighbours cost alike."""
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    rows = _FEATURES + values.shape[1]
    for worker in prange(workers):
        state = np.empty(_BLOCKS * _BLOCKS * rows * LANES, np.float32)
        is_open = np.empty(_BLOCKS * _BLOCKS, np.bool_)
        for tile in range(worker, len(start) - 1, workers):
            _forward_tile(
                record, values, box, listed, start[tile], start[tile + 1], tile % tiles_x * TILE,
                tile // tiles_x * TILE, near, far, state, rows, is_open, maps,
            )  # fmt: skip


@njit(inline="always")
def slopes(g_alpha, g_depth, alpha, ex, ey, z, exact, su, sv, ux, uy, vx, vy, ix, iy):  # type: ignore[no-untyped-def]
    """Gradients of a pixel's place (ex, ey), of u and v over z, of 1 / z, and the last where the place changes it."""
    zero = np.float32(0.0)
    g_q = np.float32(-0.5) * alpha * g_alpha
    # Where the intersection decides, q = (su^2 + sv^2) z^2; else it is the squared distance on the screen.
    by_su, by_sv = (g_q + g_q) * su * z * z, (g_q + g_q) * sv * z * z
    by_i = -z * z * (g_depth + (g_q + g_q) * (su * su + sv * sv) * z)
    by_ex, by_ey = by_su * ux + by_sv * vx + by_i * ix, by_su * uy + by_sv * vy + by_i * iy
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
def _blend_backward(record, i, values, x, y, near, far, state, base, channels, sums):  # type: ignore[no-untyped-def]
    """Gradients of splat i from the block at (x, y), added to `sums` lane by lane; how many pixels are still open."""
    zero, one, half, stop = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(MIN_TRANSMITTANCE)
    most = np.float32(MAX_ALPHA)
    rx, ry, opacity, cut = record[i, RX], record[i, RY], record[i, OPACITY], record[i, CUT]
    ux, uy, vx, vy = record[i, UX], record[i, UY], record[i, VX], record[i, VY]
    i0, ix, iy, dim = record[i, I0], record[i, IX], record[i, IY], record[i, DIM]
    zc, dx, dy = one / i0, np.float32(x + 0.5) - rx, np.float32(y + 0.5) - ry
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
        q, z, exact, su, sv = strength(ex, ey, ux, uy, vx, vy, i0, ix, iy, zc, dim, near, far)
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
        g_ex, g_ey, g_su, g_sv, g_i, slope = slopes(
            g_alpha, g_depth, alpha, ex, ey, z, exact, su, sv, ux, uy, vx, vy, ix, iy
        )
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
        sums[np.uintp(TRAVEL * LANES) + lane] += abs(g_ex) + abs(g_ey)
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
    alpha = np.float32(1.0) - maps[y, x, _T]
    g_alpha, g_depth, g_median, g_dist = incoming[y, x, 0], incoming[y, x, 1], incoming[y, x, 2], incoming[y, x, 3]
    # Twice: the distortion is quadratic in the weights.
    total = g_alpha * alpha + g_depth * maps[y, x, _Z] + np.float32(2.0) * g_dist * maps[y, x, _DIST]
    for c in range(channels):
        g = incoming[y, x, 4 + c]
        total += g * maps[y, x, _FEATURES + c]
        state[base + (_GF + c) * LANES] = g
    state[base] = np.float32(1.0)
    state[base + _S * LANES], state[base + _A * LANES] = total, alpha
    state[base + _M * LANES], state[base + _MM * LANES] = maps[y, x, _Z], maps[y, x, _ZZ]
    state[base + _GA * LANES], state[base + _GZ * LANES] = g_alpha, g_depth
    state[base + _GM * LANES], state[base + _GD * LANES] = g_median, g_dist


@njit
def _backward_tile(  # type: ignore[no-untyped-def]
    record, values, box, listed, begin, end, left, top, near, far, state, rows, is_open, sums, maps, incoming, slots
):
    """Gradients of all splats of a tile, front to back."""
    height, width, channels = maps.shape[0], maps.shape[1], values.shape[1]
    columns = BEFORE + channels
    state[:] = np.float32(0.0)
    left_open = 0
    for block in range(_BLOCKS * _BLOCKS):
        x, y = left + block % _BLOCKS * SIDE, top + block // _BLOCKS * SIDE
        inside = (x < width) & (y < height)
        is_open[block] = inside
        left_open += inside
        for j in range(LANES):
            if inside and x + j % SIDE < width and y + j // SIDE < height:
                _load(maps, incoming, y + j // SIDE, x + j % SIDE, state, block * rows * LANES + j, channels)
    for entry in range(begin, end):
        i = np.uintp(listed[entry])
        x0, y0, x1, y1 = _blocks(box, i, left, top)
        touched = False
        for by in range(y0, y1):
            for bx in range(x0, x1):
                block = by * _BLOCKS + bx
                if not is_open[block]:
                    continue
                if not touched:
                    sums[:] = np.float32(0.0)
                    touched = True
                base = np.uintp(block * rows * LANES)
                x, y = left + bx * SIDE, top + by * SIDE
                if _blend_backward(record, i, values, x, y, near, far, state, base, channels, sums) == 0:
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


@njit(parallel=True)
def _backward(record, values, box, start, listed, p, tiles_x, workers, maps, incoming, slots):  # type: ignore[no-untyped-def]
    """Gradients (entries of all tiles, BEFORE + channels) of each splat by tile, into `slots`."""
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    rows = _GF + values.shape[1]
    for worker in prange(workers):
        state = np.empty(_BLOCKS * _BLOCKS * rows * LANES, np.float32)
        sums = np.empty((BEFORE + values.shape[1]) * LANES, np.float32)
        is_open = np.empty(_BLOCKS * _BLOCKS, np.bool_)
        for tile in range(worker, len(start) - 1, workers):
            _backward_tile(
                record, values, box, listed, start[tile], start[tile + 1], tile % tiles_x * TILE,
                tile // tiles_x * TILE, near, far, state, rows, is_open, sums, maps, incoming, slots,
            )  # fmt: skip


@njit
def _sum_slots(listed, slots, total):  # type: ignore[no-untyped-def]
    """Add up the slots of each splat, in the order of tiles."""
    for entry in range(len(listed)):
        i = listed[entry]
        for c in range(total.shape[1]):
            total[i, c] += slots[entry, c]
