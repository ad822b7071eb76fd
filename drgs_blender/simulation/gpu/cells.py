"""Which particles are in which cells, on a device: functions that are translated and never run as they stand.

A particle's key is the number of its block and of its cell in it. Sorted by that, equals in their own order, particles
of a cell, and of the cells of a block that follow each other along z, stand together.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...compute.warp.kernels import WarpKernel
from ...compute.warp.search import first_of
from ...compute.warp.translate import Native
from ..grid_blocks import block_of

#: Where cells of a block begin: 64, and where the last one ends.
STARTS = 65
#: What `found` holds: how many particles are outside, how many blocks have particles, and then their numbers.
LOST, OCCUPIED, BLOCKS = range(3)


def add_to(counts: Any, at: Any, by: Any) -> Any:
    """Add to an element of an array; what it was before."""
    raise NotImplementedError


_ADD = """
@wp.func
def add_to(counts: wp.array(dtype=wp.int64), at: wp.int64, by: wp.int64):
    return wp.atomic_add(counts, wp.int32(at), by)
"""
_NATIVES = {add_to: Native(_ADD, "add_to", "int64")}


def number_particles(thread, stride, scratch, x, origin, scale, bx, by, bz, out):  # type: ignore[no-untyped-def]
    """Key of each particle, and its own number beside it; counts those outside or not finite.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`; so of all kernels here.
    x : (n, 3) float64 array
        Positions, world, m.
    origin : tuple of float
        `Domain.origin`, m.
    scale : float64
        1 / spacing, 1/m.
    bx, by, bz : int
        `Domain.blocks`.
    out : tuple of array
        Keys, numbers of the particles, and `found` (LOST is added to); written. Those that are lost come last.
    """
    keys, order, found = out
    for p in range(thread, len(x), stride):
        gx, gy, gz = (x[p, 0] - origin[0]) * scale, (x[p, 1] - origin[1]) * scale, (x[p, 2] - origin[2]) * scale
        block, cell = block_of(gx, gy, gz, bx, by, bz), 0
        if block >= 0:
            cell = ((int(gx - 0.5) & 3) * 4 + (int(gy - 0.5) & 3)) * 4 + (int(gz - 0.5) & 3)
        else:
            block = bx * by * bz  # after all others
            add_to(found, LOST, 1)
        keys[p] = block * 64 + cell
        order[p] = np.int32(p)


def list_blocks(thread, stride, scratch, n, keys, count, out):  # type: ignore[no-untyped-def]
    """Blocks with particles, once each, in any order.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    n : int
        Particles.
    keys : array
        Of `number_particles`, sorted.
    count : int
        Blocks of the domain.
    out : tuple of array
        `found`: OCCUPIED is added to, and BLOCKS on written.
    """
    (found,) = out
    for p in range(thread, n, stride):
        first = True
        if p > 0:
            first = keys[p] >> 6 != keys[p - 1] >> 6
        if first and keys[p] >> 6 < count:
            found[BLOCKS + add_to(found, OCCUPIED, 1)] = keys[p] >> 6


def index_blocks(thread, stride, scratch, n, keys, numbers, sizes, out):  # type: ignore[no-untyped-def]
    """Tables of the active blocks: their places, those around them, and where particles of their cells begin.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    n : int
        Particles.
    keys : array
        Of `number_particles`, sorted.
    numbers : array
        Numbers of the active blocks, sorted.
    sizes : array
        How many these are, then the domain's blocks along y and z.
    out : tuple of array
        Places (a, 3), slots around (a, 27; -1: not active) and first particle of each cell (a, STARTS), int32; written.
    """
    active, neighbour, first = out
    by, bz = sizes[1], sizes[2]
    for task in range(thread, sizes[0] * (27 + STARTS), stride):
        s, e = task // (27 + STARTS), task % (27 + STARTS)
        number = numbers[s]
        if e < 27:
            other = number + ((e // 9 - 1) * by + e // 3 % 3 - 1) * bz + e % 3 - 1
            at = first_of(numbers, sizes[0], other)
            known = False
            if at < sizes[0]:
                known = numbers[at] == other
            neighbour[s, e] = np.int32(at) if known else np.int32(-1)
        else:
            first[s, e - 27] = np.int32(first_of(keys, n, number * 64 + (e - 27)))
        if e == 0:
            active[s, 0], active[s, 1], active[s, 2] = number // (by * bz), number // bz % by, number % bz


def find_home_blocks(thread, stride, scratch, n, keys, numbers, sizes, out):  # type: ignore[no-untyped-def]
    """Active block of each particle, sorted.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    n, keys, numbers, sizes : int or array
        As of `index_blocks`.
    out : tuple of array
        Slot of each sorted particle, (n,) int32; written. -1 of those that are lost.
    """
    (home,) = out
    for p in range(thread, n, stride):
        slot = first_of(numbers, sizes[0], keys[p] >> 6)
        home[p] = np.int32(slot) if slot < sizes[0] else np.int32(-1)


NUMBER = WarpKernel(number_particles, (), _NATIVES)
LIST = WarpKernel(list_blocks, (), _NATIVES)
INDEX = WarpKernel(index_blocks, (), {})
FIND_HOMES = WarpKernel(find_home_blocks, (), {})


def around(occupied: np.ndarray, blocks: tuple[int, int, int]) -> np.ndarray:
    """Numbers of all blocks that touch some, which are not at the border of the domain; sorted."""
    _, by, bz = blocks
    steps = np.arange(-1, 2)
    near = ((steps[:, None, None] * by + steps[:, None]) * bz + steps).ravel()
    return np.unique(occupied[:, None] + near)
