"""Alpha blending of one sample's contributions: sorted by depth, weighed front to back, averaged.

A sample's contributions are `n` entries from `base` on of the lists of its block.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from ..surfel_columns import ALBEDO, METALLIC, NORMAL, ROUGHNESS, SIZE

#: Samples that vector code works on at a time; a tile's side and the capacity of `Contributions` are multiples of it.
LANES = 16
#: Contributions beyond which sorting by merging is faster than by counting.
MANY = 128
#: Depth jump that separates two surfaces, in units of the mean of the two surfels' sizes.
GAP = 3.0
#: Blending stops once no more than this part of the background is left.
MIN_TRANSMITTANCE = 1e-4
#: Where surfels smaller than the filter cover a sample before their weights, less than their coverage, are used up, it
#: goes on behind that depth: by these pixels over the root of the samples per pixel, the depth that a slope of 2 has
#: within the filter; and to this number of contributions.
BEHIND, MOST_BEHIND = 9.4, 512

Array = np.ndarray


class Contributions(NamedTuple):
    """Contributions of splats to the samples of a block, `LANES` lists one after the other.

    Attributes
    ----------
    capacity : int
        Places in each list.
    depth : (LANES * capacity,) float32 array
        Metres along the view axis.
    cover : (LANES * capacity,) float32 array
        Opacity times kernel.
    strength : (LANES * capacity,) float32 array
        The same, of surfels smaller than the filter times their share of it (`splats.SHARE`).
    splat : (LANES * capacity,) int32 array
        Its number.
    """

    capacity: int
    depth: Array
    cover: Array
    strength: Array
    splat: Array


class Scratch(NamedTuple):
    """Scratch memory for resolving the list of one sample.

    Attributes
    ----------
    rank : (LANES,) int32 array
    order : (capacity,) int32 array
        Of the contributions, front to back.
    weights : (capacity,) float32 array
        Of the contributions in that order.
    """

    rank: Array
    order: Array
    weights: Array


_1, _2, _3, _4, _5, _6, _7 = (np.uintp(k) for k in range(1, 8))


@njit
def merge_sort(z, base, n, order):  # type: ignore[no-untyped-def]
    """Order of many contributions by depth: merge sort, stable.

    Parameters
    ----------
    z : (LANES * capacity,) float32 array
        Depths, `Contributions.depth`.
    base, n : int64
        First entry of the sample, and how many.
    order : (capacity,) int32 array
        `n` entries are written: places from `base` on, nearest first.
    """
    by_depth = np.argsort(z[base : base + n], kind="mergesort")
    for k in range(n):
        order[k] = by_depth[k]


@njit
def rank_sort(z, base, n, rank, order):  # type: ignore[no-untyped-def]
    """Order of a few contributions by depth, stable: counts, for each, how many come before it. Vector code, no branch.

    Parameters
    ----------
    z : (LANES * capacity,) float32 array
        Depths, `Contributions.depth`; entries beyond the sample's up to a multiple of LANES are set to infinity.
    base, n : int64
        First entry of the sample, and how many.
    rank : (LANES,) int32 array
        Scratch.
    order : (capacity,) int32 array
        `n` entries are written: places from `base` on, nearest first.
    """
    for k in range(n, (n + LANES - 1) // LANES * LANES):
        z[np.uintp(base + k)] = np.float32(np.inf)
    for at in range(0, n, LANES):
        mine = np.uintp(base + at)
        for k in range(LANES):
            rank[k] = 0
        for j in range(0, n, 8):
            # Eight at once: fewer would make LLVM unroll the loop over lanes instead.
            other, distance = np.uintp(base + j), np.int32(j - at)
            z0, z1, z2, z3 = z[other], z[other + _1], z[other + _2], z[other + _3]
            z4, z5, z6, z7 = z[other + _4], z[other + _5], z[other + _6], z[other + _7]
            for k in range(LANES):
                zk = z[mine + np.uintp(k)]
                later = np.int32(np.int32(k) - distance)
                rank[k] = np.int32(
                    rank[k]
                    + np.int32((z0 < zk) | ((z0 == zk) & (later > np.int32(0))))
                    + np.int32((z1 < zk) | ((z1 == zk) & (later > np.int32(1))))
                    + np.int32((z2 < zk) | ((z2 == zk) & (later > np.int32(2))))
                    + np.int32((z3 < zk) | ((z3 == zk) & (later > np.int32(3))))
                    + np.int32((z4 < zk) | ((z4 == zk) & (later > np.int32(4))))
                    + np.int32((z5 < zk) | ((z5 == zk) & (later > np.int32(5))))
                    + np.int32((z6 < zk) | ((z6 == zk) & (later > np.int32(6))))
                    + np.int32((z7 < zk) | ((z7 == zk) & (later > np.int32(7))))
                )
        for k in range(min(LANES, n - at)):
            order[np.uintp(rank[np.uintp(k)])] = at + k


@njit
def sort(lists, base, n, scratch):  # type: ignore[no-untyped-def]
    """Sort the contributions of a sample by depth, front to back.

    Parameters
    ----------
    lists : Contributions
    base, n : int64
        First entry of the sample, and how many.
    scratch : Scratch
        `order` is written.
    """
    if n > MANY:
        merge_sort(lists.depth, base, n, scratch.order)
    else:
        rank_sort(lists.depth, base, n, scratch.rank, scratch.order)


@njit
def prune(lists, base, n, scratch, view):  # type: ignore[no-untyped-def]
    """Sort the contributions of a sample in place, and drop those behind the point where blending stops.

    Parameters
    ----------
    lists : Contributions
        Written.
    base, n : int64
        First entry of the sample, and how many.
    scratch : Scratch
        Written.
    view : View
        See `raster`.

    Returns
    -------
    int64
        How many remain.
    """
    sort(lists, base, n, scratch)
    z, cover, alpha, splat, order = lists.depth, lists.cover, lists.strength, lists.splat, scratch.order
    old_z, old_cover, old_alpha, old_splat = (
        z[base : base + n].copy(),
        cover[base : base + n].copy(),
        alpha[base : base + n].copy(),
        splat[base : base + n].copy(),
    )
    t, clear, behind = np.float32(1.0), np.float32(1.0), np.float32(np.inf)
    kept = 0
    while kept < n and goes_on(t, clear, behind, old_z[order[kept]], kept):
        k = order[kept]
        z[base + kept], cover[base + kept], alpha[base + kept] = old_z[k], old_cover[k], old_alpha[k]
        splat[base + kept] = old_splat[k]
        t *= np.float32(1.0) - old_alpha[k]
        clear *= np.float32(1.0) - old_cover[k]
        behind = behind_of(clear, behind, old_z[k], view.pixel_base, view.pixel, view.behind)
        kept += 1
    return kept


@inlined
def goes_on(t, clear, behind, z, k):  # type: ignore[no-untyped-def]
    """Whether the k-th contribution of a sample, at depth `z`, still counts.

    Parameters
    ----------
    t, clear : float32
        Transmittance of those before, by strength and by coverage.
    behind : float32
        See `behind_of`.
    z : float32
        Metres.
    k : int64
    """
    stop = np.float32(MIN_TRANSMITTANCE)
    return (t >= stop) & ((clear >= stop) | ((z <= behind) & (k < MOST_BEHIND)))


@inlined
def behind_of(clear, behind, z, pixel_base, pixel, reach):  # type: ignore[no-untyped-def]
    """Depth behind which nothing counts, metres: infinite until contributions cover the sample.

    Parameters
    ----------
    clear : float32
        Transmittance by coverage, with the contribution at depth `z`.
    behind : float32
        As it was.
    z, pixel_base, pixel : float32
        ``pixel_base + pixel z`` is the width of a pixel at depth z, m.
    reach : float32
        Pixels, of `BEHIND`.
    """
    covered = (clear < np.float32(MIN_TRANSMITTANCE)) & (behind == np.float32(np.inf))
    return z + reach * (pixel_base + pixel * z) if covered else behind


@njit
def contributions(capacity):  # type: ignore[no-untyped-def]
    """Lists for the contributions of a block, not filled.

    Parameters
    ----------
    capacity : int64
        Places per sample, a multiple of LANES.

    Returns
    -------
    Contributions
    """
    size = LANES * capacity
    depth, cover, strength = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    return Contributions(capacity, depth, cover, strength, np.empty(size, np.int32))


@njit
def scratch_for(capacity):  # type: ignore[no-untyped-def]
    """Scratch memory for lists of this capacity.

    Parameters
    ----------
    capacity : int64
        As of `contributions`.

    Returns
    -------
    Scratch
    """
    return Scratch(np.empty(LANES, np.int32), np.empty(capacity, np.int32), np.empty(capacity, np.float32))


@njit
def widen(lists):  # type: ignore[no-untyped-def]
    """Copy of the lists with twice the capacity.

    Parameters
    ----------
    lists : Contributions

    Returns
    -------
    Contributions
    """
    capacity, wider = lists.capacity, contributions(2 * lists.capacity)
    for lane in range(LANES):
        old, new = capacity * lane, 2 * capacity * lane
        for k in range(capacity):  # assigning slices would take a second to compile
            wider.depth[new + k] = lists.depth[old + k]
            wider.cover[new + k] = lists.cover[old + k]
            wider.strength[new + k] = lists.strength[old + k]
            wider.splat[new + k] = lists.splat[old + k]
    return wider


@njit
def weigh(surface, lists, base, n, scratch, view):  # type: ignore[no-untyped-def]
    """Weights (transmittance times strength) of the sorted contributions of a sample, and its heaviest cluster.

    Parameters
    ----------
    surface : (m, SPLAT) float32 array
        Of the splats; see `columns`.
    lists : Contributions
    base, n : int64
        First entry of the sample, and how many.
    scratch : Scratch
        `order` is read, see `sort`; `weights` is written.
    view : View
        See `raster`.

    Returns
    -------
    clear : float32
        Transmittance of all, by their coverage.
    weight : float32
        Of the heaviest cluster; so the others.
    depth : float32
        Sum of depth times weight, m.
    owner : int32
        Splat of the largest weight.
    begin, end : int64
        Its contributions, half-open, in their order.
    """
    order, weights = scratch.order, scratch.weights
    depths, covers, strengths, splats = lists.depth, lists.cover, lists.strength, lists.splat
    zero, one = np.float32(0.0), np.float32(1.0)
    t, clear, behind, last, last_size = one, one, np.float32(np.inf), zero, np.float32(1e30)
    weight, depth, heaviest, owner, begin = zero, zero, zero, np.int32(0), 0
    best_weight, best_depth, best_owner, best_begin, best_end = zero, zero, np.int32(0), 0, 0
    k = 0
    while k < n:
        at = np.uintp(base + order[np.uintp(k)])
        z, alpha, i = depths[at], strengths[at], np.uintp(splats[at])
        if not goes_on(t, clear, behind, z, k):
            break
        share = t * alpha
        t = t * (one - alpha)
        clear = clear * (one - covers[at])
        behind = behind_of(clear, behind, z, view.pixel_base, view.pixel, view.behind)
        size = max(surface[i, SIZE], view.pixel_base + view.pixel * z)
        if z - last > np.float32(0.5 * GAP) * (size + last_size):
            if weight > best_weight:
                best_weight, best_depth, best_owner, best_begin, best_end = weight, depth, owner, begin, k
            weight, depth, heaviest, begin = zero, zero, zero, k
        weights[np.uintp(k)] = share
        weight += share
        depth += share * z
        owner = np.int32(i) if share > heaviest else owner
        heaviest = max(share, heaviest)
        last, last_size = z, size
        k += 1
    if weight > best_weight:
        best_weight, best_depth, best_owner, best_begin, best_end = weight, depth, owner, begin, k
    return clear, best_weight, best_depth, best_owner, best_begin, best_end


@njit
def mean(surface, lists, base, scratch, total, begin, end):  # type: ignore[no-untyped-def]
    """Mean attributes, by weight, of the contributions of a cluster.

    Parameters
    ----------
    surface : (m, SPLAT) float32 array
        Of the splats; see `columns`.
    lists : Contributions
    base : int64
        First entry of the sample.
    scratch : Scratch
        As `weigh` left it.
    total : float32
        Sum of their weights.
    begin, end : int64
        The contributions, half-open, in their order.

    Returns
    -------
    nx, ny, nz : float32
        Shading normal, unit, world; 0 where normals cancel.
    red, green, blue : float32
        Albedo, linear Rec.709.
    roughness, metallic : float32
        In [0, 1].
    size : float32
        Larger standard deviation, m.
    """
    order, weights, splats = scratch.order, scratch.weights, lists.splat
    zero, one = np.float32(0.0), np.float32(1.0)
    nx = ny = nz = red = green = blue = roughness = metallic = size = zero
    for k in range(begin, end):
        i, w = np.uintp(splats[np.uintp(base + order[np.uintp(k)])]), weights[np.uintp(k)]
        # Both sides of a thin sheet may lie in one cluster: normals agree with the nearest one.
        signed = -w if nx * surface[i, NORMAL] + ny * surface[i, NORMAL + 1] + nz * surface[i, NORMAL + 2] < zero else w
        nx += signed * surface[i, NORMAL]
        ny += signed * surface[i, NORMAL + 1]
        nz += signed * surface[i, NORMAL + 2]
        red += w * surface[i, ALBEDO]
        green += w * surface[i, ALBEDO + 1]
        blue += w * surface[i, ALBEDO + 2]
        roughness += w * surface[i, ROUGHNESS]
        metallic += w * surface[i, METALLIC]
        size += w * surface[i, SIZE]
    g = one / total
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    f = one / length if length > np.float32(1e-6) * total else zero
    return f * nx, f * ny, f * nz, red * g, green * g, blue * g, roughness * g, metallic * g, size * g
