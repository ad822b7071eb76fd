"""Surfels blended on a device, one thread per sample, exactly as `surfels.raster` blends them.

The functions here are translated and never run as they stand. A thread gathers the nearest contributions of its sample
in a list that is kept in order, and blends them; while more were met than the list holds, and light still passes, it
gathers those behind the last.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...compute.warp.kernels import Launcher, ScratchArray, WarpKernel
from ..camera import CLIP_END, CLIP_START, FX, FY, ORTHOGRAPHIC, SUBPIXELS, WIDTH, lattice, pixel_shift
from ..sampling import ONE, ZERO, F
from ..surfel_columns import ALBEDO, METALLIC, NORMAL, OPACITY, ROUGHNESS, SAMPLE, SIZE
from ..surfels.blending import BEHIND, GAP, MIN_TRANSMITTANCE, behind_of, goes_on
from ..surfels.raster import SurfelSamples, gaussian
from ..surfels.splats import CUT, DIM, LOW, MAX_ALPHA, RX, RY, SHARE, TILE, ZC, A, B, D, N, Splats

#: Contributions that a thread gathers at once.
MOST = 64
#: Sums over a cluster of contributions: weight, and times that depth, normal, albedo, roughness, metallic and size; the
#: weight of its heaviest one. Row 0 is the cluster at hand, row 1 the heaviest so far.
_WEIGHT, _DEPTH, _NORMAL, _COLOUR, _ROUGHNESS, _METALLIC, _SIZE, _HEAVIEST, _SUMS = 0, 1, 2, 5, 8, 9, 10, 11, 12


class Rows(NamedTuple):
    """Rows that are blended, in full-picture pixels.

    Attributes
    ----------
    x0, x1, top : int
        The window's columns, and its first row.
    y0, y1 : int
        The rows, half-open.
    subpixels : int
        Samples of a pixel.
    """

    x0: int
    x1: int
    top: int
    y0: int
    y1: int
    subpixels: int


class PixelPosition(NamedTuple):
    """Position of a sub-pixel sample.

    Attributes
    ----------
    x, y : int
        Its pixel.
    px, py : float
        Its position, pixels.
    near, far : float
        Clip range, metres.
    pixel_base, pixel, behind : float
        As of `surfels.raster.View`.
    """

    x: int
    y: int
    px: np.float32
    py: np.float32
    near: np.float32
    far: np.float32
    pixel_base: np.float32
    pixel: np.float32
    behind: np.float32


def meet(screen: Any, i: Any, opacity: Any, near: Any, far: Any, x: Any, y: Any) -> Any:
    """Coverage, strength (0 where it has no part) and depth of splat i on the screen, as `raster._meet` has them."""
    big = F(1e30)
    ex, ey = x - screen[i, RX], y - screen[i, RY]
    inverse = ONE / (screen[i, N] + screen[i, N + 1] * ex + screen[i, N + 2] * ey)
    u = (screen[i, A] + screen[i, A + 1] * ex + screen[i, A + 2] * ey) * inverse
    v = (screen[i, B] + screen[i, B + 1] * ex + screen[i, B + 2] * ey) * inverse
    z = (screen[i, D] + screen[i, D + 1] * ex + screen[i, D + 2] * ey) * inverse
    exact = u * u + v * v if z > near and z < far else big
    filtered = screen[i, LOW] * (ex * ex + ey * ey) + screen[i, DIM]
    q = exact if exact <= filtered else filtered
    depth = z if exact <= filtered else screen[i, ZC]
    if not (q < screen[i, CUT] and depth > near and depth < far):
        return ZERO, ZERO, depth
    cover = min(opacity * gaussian(q), F(MAX_ALPHA))
    return cover, cover if exact <= filtered else screen[i, SHARE] * cover, depth


def insert(
    lists_z: Any, lists_c: Any, lists_a: Any, lists_i: Any, n: Any, z: Any, cover: Any, alpha: Any, splat: Any
) -> None:
    """Put a contribution behind those of n that are not farther; if the list is full, its last one goes."""
    k = min(n, MOST - 1)
    while k > 0 and lists_z[k - 1] > z:
        lists_z[k], lists_c[k] = lists_z[k - 1], lists_c[k - 1]
        lists_a[k], lists_i[k] = lists_a[k - 1], lists_i[k - 1]
        k = k - 1
    lists_z[k], lists_c[k], lists_a[k], lists_i[k] = z, cover, alpha, np.int32(splat)


def settle(sums: Any, owner: Any) -> None:
    """The cluster at hand has ended: keep it if it is the heaviest, and begin another."""
    if sums[0, _WEIGHT] > sums[1, _WEIGHT]:
        owner[1] = owner[0]
        for c in range(_SUMS):
            sums[1, c] = sums[0, c]
    for c in range(_SUMS):
        sums[0, c] = ZERO


def add(sums: Any, owner: Any, surface: Any, i: Any, z: Any, w: Any) -> None:
    """Take a contribution of weight w into the cluster at hand, as `blending.weigh` and `blending.mean` do."""
    nx, ny, nz = surface[i, NORMAL], surface[i, NORMAL + 1], surface[i, NORMAL + 2]
    # Both sides of a thin sheet may lie in one cluster: normals agree with the nearest one.
    along = sums[0, _NORMAL] * nx + sums[0, _NORMAL + 1] * ny + sums[0, _NORMAL + 2] * nz
    signed = -w if along < ZERO else w
    sums[0, _WEIGHT] += w
    sums[0, _DEPTH] += w * z
    sums[0, _NORMAL] += signed * nx
    sums[0, _NORMAL + 1] += signed * ny
    sums[0, _NORMAL + 2] += signed * nz
    for c in range(3):
        sums[0, _COLOUR + c] += w * surface[i, ALBEDO + c]
    sums[0, _ROUGHNESS] += w * surface[i, ROUGHNESS]
    sums[0, _METALLIC] += w * surface[i, METALLIC]
    sums[0, _SIZE] += w * surface[i, SIZE]
    if w > sums[0, _HEAVIEST]:
        sums[0, _HEAVIEST], owner[0] = w, np.int32(i)


def gather(lists: Any, splats: Any, first: Any, last: Any, position: PixelPosition, passed: Any) -> Any:
    """List the nearest contributions of the entries first .. last of the tiles' list to a sample.

    `passed` is what is left by strength and by coverage, the depth behind which none counts, and the depth and the
    splat behind which to look; how many there are, those left out included.
    """
    lists_z, lists_c, lists_a, lists_i = lists
    screen, surface, box, nearest, _, _, tile_list = splats
    t, seen_through, behind, after, after_splat = passed
    stop = F(MIN_TRANSMITTANCE)
    n, left, clear, farthest = 0, t, seen_through, F(-1e30)
    for entry in range(first, last):
        i = np.int64(tile_list[entry])
        if position.x < box[i, 0] or position.x >= box[i, 2] or position.y < box[i, 1] or position.y >= box[i, 3]:
            continue
        if (left < stop and nearest[i] >= farthest) or nearest[i] > behind:
            continue
        cover, alpha, z = meet(screen, i, surface[i, OPACITY], position.near, position.far, position.px, position.py)
        if not alpha > ZERO or (left < stop and not z < farthest) or z > behind:
            continue
        if z < after or (z == after and i <= after_splat):
            continue
        if n < MOST or z < lists_z[MOST - 1]:
            insert(lists_z, lists_c, lists_a, lists_i, n, z, cover, alpha, i)
        n += 1
        farthest = max(farthest, z)
        left = left * (ONE - alpha)
        clear = clear * (ONE - cover)
        behind = behind_of(clear, behind, farthest, position.pixel_base, position.pixel, position.behind)
    return n


def blend_samples(thread: Any, stride: Any, scratch: Any, splats: Any, p: Any, rows: Rows, out: Any) -> None:
    """Blend samples as `raster._blend` does; `splats` are the arrays of `Splats`."""
    lists_z, lists_c, lists_a, lists_i, sums, owner = scratch
    lists = lists_z, lists_c, lists_a, lists_i
    _, surface, _, _, objects, tile_start, _ = splats
    x0, y0, subpixels = rows.x0, rows.y0, rows.subpixels
    out_alpha, out_depth, out_surface, out_object = out
    tile_x0 = x0 // TILE
    tiles_x = (rows.x1 - 1) // TILE - tile_x0 + 1
    columns = rows.x1 - x0
    width = np.int64(p[WIDTH])
    near, far = F(p[CLIP_START]), F(p[CLIP_END])
    slope = F(1.0 / min(p[FX], p[FY]))
    pixel = ZERO if p[ORTHOGRAPHIC] != 0.0 else slope
    pixel_base = slope if p[ORTHOGRAPHIC] != 0.0 else ZERO
    reach = F(BEHIND / math.sqrt(p[SUBPIXELS]))
    for sample in range(thread, (rows.y1 - y0) * columns * subpixels, stride):
        number = sample % subpixels
        column, row = sample // subpixels % columns, sample // (subpixels * columns)
        x, y = x0 + column, y0 + row
        tile = (y // TILE - rows.top // TILE) * tiles_x + x // TILE - tile_x0
        shift_x, shift_y = pixel_shift(p, y * width + x)
        jx, jy = lattice(shift_x, shift_y, number, p)
        for c in range(_SUMS):
            sums[0, c], sums[1, c] = ZERO, ZERO
        t, clear, behind, before, before_size = ONE, ONE, F(np.inf), ZERO, F(1e30)
        after, after_splat, taken = F(-1e30), np.int64(-1), 0
        position = PixelPosition(x, y, F(x + jx), F(y + jy), near, far, pixel_base, pixel, reach)
        more: Any = True
        while more:
            passed = t, clear, behind, after, after_splat
            n = gather(lists, splats, tile_start[tile], tile_start[tile + 1], position, passed)
            k = 0
            more = n > MOST
            while k < min(n, MOST):
                z, alpha, i = lists_z[k], lists_a[k], np.int64(lists_i[k])
                if not goes_on(t, clear, behind, z, taken):
                    more = False
                    break
                share = t * alpha
                t = t * (ONE - alpha)
                clear = clear * (ONE - lists_c[k])
                behind = behind_of(clear, behind, z, pixel_base, pixel, reach)
                size = max(surface[i, SIZE], pixel_base + pixel * z)
                if z - before > F(0.5 * GAP) * (size + before_size):
                    settle(sums, owner)
                add(sums, owner, surface, i, z, share)
                before, before_size, after, after_splat = z, size, z, i
                k += 1
                taken += 1
        settle(sums, owner)
        total = sums[1, _WEIGHT]
        if not total > ZERO:
            continue
        g = ONE / total
        nx, ny, nz = sums[1, _NORMAL], sums[1, _NORMAL + 1], sums[1, _NORMAL + 2]
        length = F(math.sqrt(nx * nx + ny * ny + nz * nz))
        f = ONE / length if length > F(1e-6) * total else ZERO
        out_alpha[row, column, number] = ONE - clear
        out_depth[row, column, number] = sums[1, _DEPTH] * g
        for c in range(3):
            out_surface[row, column, number, NORMAL + c] = f * sums[1, _NORMAL + c]
        for c in range(SAMPLE - ALBEDO):
            out_surface[row, column, number, ALBEDO + c] = sums[1, _COLOUR + c] * g
        out_object[row, column, number] = objects[owner[1]]


_SCRATCH = (
    ScratchArray("float32", (MOST,)),
    ScratchArray("float32", (MOST,)),
    ScratchArray("float32", (MOST,)),
    ScratchArray("int32", (MOST,)),
    ScratchArray("float32", (2, _SUMS)),
    ScratchArray("int32", (2,)),
)
BLEND = WarpKernel(blend_samples, _SCRATCH, {})


class DeviceSamples(SurfelSamples):
    """`SurfelSamples` that have come back from a device.

    Attributes
    ----------
    on_device : tuple
        Depth, surface and object index, where they still are.
    """

    on_device: tuple[Any, Any, Any]


def rasterise(launcher: Launcher, splats: Splats, y0: int, y1: int) -> DeviceSamples:
    """`surfels.raster.rasterise` on a device; where ``alpha`` is 0 the other arrays are undefined."""
    rows = Rows(splats.x0, splats.x1, splats.y0, y0, y1, int(splats.parameters[SUBPIXELS]))
    shape = y1 - y0, rows.x1 - rows.x0, rows.subpixels
    with launcher.failures("blending surfels"):
        alpha, depth, surface = (launcher.zeros(size) for size in (shape, shape, (*shape, SAMPLE)))
        owner = launcher.zeros(shape, "int32")
    arguments = splats.arrays, splats.parameters, rows
    launcher.launch(BLEND, int(np.prod(shape)), arguments, (alpha, depth, surface, owner))
    with launcher.failures("blending surfels"):
        samples = DeviceSamples(alpha.numpy(), depth.numpy(), surface.numpy(), owner.numpy())
    samples.on_device = depth, surface, owner
    return samples
