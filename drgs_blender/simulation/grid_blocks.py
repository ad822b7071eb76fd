"""The grid in blocks of 4^3 cells, and particles sorted by the block that they are in.

Only blocks near particles have memory: ``slot`` maps a block of the domain to its place in compact arrays. Each block
sums what its particles give in nodes of its own; every node then adds up those of the blocks around it, in an order
that does not depend on the number of threads. Particles may drift one cell from where they were sorted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.threads import ELEMENTS, get_num_threads, over_range

Array = np.ndarray

#: Cells of the domain on every side that particles must keep clear of.
MARGIN = 4

#: What a block costs by itself, in particles.
_BLOCK = 32
#: Particles for which another thread is worth while.
_SHARE = 1024
#: The same of slots, of 64 nodes each.
SLOTS = ELEMENTS // 64


@dataclass(frozen=True, slots=True)
class Domain:
    """The grid.

    Attributes
    ----------
    origin : (3,) float64 array
        Metres: node (0, 0, 0).
    spacing : float
        Metres between nodes.
    blocks : tuple of int
        Blocks of 4 cells along x, y and z.
    """

    origin: Array
    spacing: float
    blocks: tuple[int, int, int]

    @classmethod
    def around(cls, low: Array, high: Array, spacing: float) -> Domain:
        """The domain in which particles may be anywhere from `low` to `high`."""
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        cells = np.ceil((high - low) / spacing).astype(int) + 1
        blocks = -(-cells // 4) + 2
        return cls(low - (MARGIN + 0.5) * spacing, float(spacing), (int(blocks[0]), int(blocks[1]), int(blocks[2])))

    @property
    def low(self) -> Array:
        """Lowest corner that particles may reach."""
        return self.origin + (MARGIN + 0.5) * self.spacing

    @property
    def high(self) -> Array:
        """Highest corner that particles may reach."""
        return self.origin + (4 * (np.array(self.blocks) - 1) + 0.5) * self.spacing


class Arrangement(NamedTuple):
    """Blocks of particles and nodes, until the next sort.

    Attributes
    ----------
    order : (n,) int64 array
        The particles block by block, and then those that are in none.
    block : (b, 3) int32 array
        Blocks with particles, those of one parity together.
    shares : (k + 1,) int64 array
        Blocks cut into parts alike in work, at most one per thread.
    start : (b + 1,) int64 array
        Where the particles of each block begin.
    neighbour : (b, 27) int32 array
        The slot of each block around, x slowest.
    source : (27 b,) int64 array
        Slot by slot, the blocks around it with particles, in their order: 27 times the block, plus the column of the
        slot in `neighbour`.
    source_start : (a + 1,) int64 array
        Where those of each slot begin.
    active : (a, 3) int32 array
        Blocks that have memory, by slot.
    slot : (bx, by, bz) int32 array
        Slot of each block of the domain, -1 without memory.
    """

    order: Array
    block: Array
    shares: Array
    start: Array
    neighbour: Array
    source: Array
    source_start: Array
    active: Array
    slot: Array


class Nodes(NamedTuple):
    """The nodes of the blocks that have memory.

    Attributes
    ----------
    values : (a, 64, 4) float32 array
        Momentum (kg m/s) or velocity (m/s), and mass (kg); z fastest.
    active : (a, 3) int32 array
        See `Arrangement`.
    origin : (3,) float64 array
        See `Domain`.
    spacing : float
        See `Domain`.
    """

    values: Array
    active: Array
    origin: Array
    spacing: float


@inlined
def block_of(gx, gy, gz, bx, by, bz):  # type: ignore[no-untyped-def]
    """Number of the block of a place.

    Parameters
    ----------
    gx, gy, gz : float64
        Place, in grid spacings from the origin.
    bx, by, bz : int64
        `Domain.blocks`.

    Returns
    -------
    int64
        -1 if the place is outside or not finite.
    """
    low = MARGIN + 0.5
    inside = low <= gx < 4 * (bx - 1) + 0.5 and low <= gy < 4 * (by - 1) + 0.5 and low <= gz < 4 * (bz - 1) + 0.5
    if inside:  # not for NaN
        return ((int(gx - 0.5) >> 2) * by + (int(gy - 0.5) >> 2)) * bz + (int(gz - 0.5) >> 2)
    return -1


@njit
def _blocks_of(first, last, x, origin, scale, bx, by, bz, number):  # type: ignore[no-untyped-def]
    for p in range(first, last):
        gx, gy, gz = (x[p, 0] - origin[0]) * scale, (x[p, 1] - origin[1]) * scale, (x[p, 2] - origin[2]) * scale
        number[p] = block_of(gx, gy, gz, bx, by, bz)


@njit
def _counting_sort(number, count):  # type: ignore[no-untyped-def]
    """Stable order of particles by block, and how many each block has."""
    counts = np.zeros(count + 1, np.int64)
    for p in range(len(number)):
        counts[number[p] + 1] += 1
    place = np.cumsum(counts)
    order = np.empty(len(number), np.int64)
    for p in range(len(number)):
        order[place[number[p]]] = p
        place[number[p]] += 1
    return order, counts[1:]


@njit
def _sort_by_cell(first, last, x, origin, scale, start, order):  # type: ignore[no-untyped-def]
    """Order the particles of some blocks by cell: those that write to the same nodes one after another are faster."""
    for b in range(first, last):
        own = order[start[b] : start[b + 1]].copy()
        cells, place = np.empty(len(own), np.int64), np.zeros(65, np.int64)
        for k in range(len(own)):
            p = own[k]
            i, j = int((x[p, 0] - origin[0]) * scale - 0.5) & 3, int((x[p, 1] - origin[1]) * scale - 0.5) & 3
            cells[k] = (i * 4 + j) * 4 + (int((x[p, 2] - origin[2]) * scale - 0.5) & 3)
            place[cells[k] + 1] += 1
        for c in range(64):
            place[c + 1] += place[c]
        for k in range(len(own)):
            order[start[b] + place[cells[k]]] = own[k]
            place[cells[k]] += 1


@njit
def _activate(block, slot):  # type: ignore[no-untyped-def]
    """Give slots to all blocks around those with particles."""
    active = np.empty((27 * len(block), 3), np.int32)
    neighbour = np.empty((len(block), 27), np.int32)
    n = 0
    for b in range(len(block)):
        for e in range(27):
            i, j, k = block[b, 0] + e // 9 - 1, block[b, 1] + e // 3 % 3 - 1, block[b, 2] + e % 3 - 1
            if slot[i, j, k] < 0:
                slot[i, j, k] = n
                active[n, 0], active[n, 1], active[n, 2] = i, j, k
                n += 1
            neighbour[b, e] = slot[i, j, k]
    return neighbour, active[:n].copy()


@njit
def _sources(neighbour, slots):  # type: ignore[no-untyped-def]
    """`Arrangement.source` and `source_start`."""
    start = np.zeros(slots + 1, np.int64)
    for b in range(len(neighbour)):
        for e in range(27):
            start[neighbour[b, e] + 1] += 1
    for s in range(slots):
        start[s + 1] += start[s]
    place, source = start[:-1].copy(), np.empty(27 * len(neighbour), np.int64)
    for b in range(len(neighbour)):
        for e in range(27):
            s = neighbour[b, e]
            source[place[s]] = 27 * b + e
            place[s] += 1
    return source, start


def _numbers(x: Array, domain: Domain) -> Array:
    """(n,) block number of each particle; -1 where it is outside or not finite."""
    number = np.empty(len(x), np.int64)
    scale = 1.0 / domain.spacing
    over_range(_blocks_of, len(x), x, domain.origin, scale, *domain.blocks, number, fewest=ELEMENTS)
    return number


def outside_of(x: Array, domain: Domain) -> Array:
    """(k,) indices of the particles (n, 3) outside the domain or not finite."""
    return np.flatnonzero(_numbers(x, domain) < 0)


def arrange(x: Array, domain: Domain) -> tuple[Arrangement, Array]:
    """Sort particles into blocks.

    Parameters
    ----------
    x : (n, 3) float64 array
        Metres.
    domain : Domain

    Returns
    -------
    arrangement : Arrangement
    lost : (k,) array
        Indices of particles outside the domain or not finite, which are in no block.
    """
    bx, by, bz = domain.blocks
    number = _numbers(x, domain)
    lost, inside = np.flatnonzero(number < 0), np.flatnonzero(number >= 0)
    order, counts = _counting_sort(number[inside] if len(lost) else number, bx * by * bz)
    order = inside[order] if len(lost) else order
    used = np.flatnonzero(counts)
    first = (np.cumsum(counts) - counts)[used]
    block = np.stack(np.unravel_index(used, domain.blocks), -1).astype(np.int32)
    parity = (block[:, 0] & 1) * 4 + (block[:, 1] & 1) * 2 + (block[:, 2] & 1)
    by_parity = np.argsort(parity, kind="stable")
    # Particles follow the order of the blocks, so that a pass reads memory in order.
    sizes = counts[used][by_parity]
    start = np.concatenate([[0], np.cumsum(sizes)])
    order = order[np.repeat(first[by_parity] - start[:-1], sizes) + np.arange(len(order))]
    over_range(_sort_by_cell, len(block), x, domain.origin, 1.0 / domain.spacing, start, order, fewest=16)
    block = np.ascontiguousarray(block[by_parity])
    slot = np.full(domain.blocks, -1, np.int32)
    neighbour, active = _activate(block, slot)
    source, source_start = _sources(neighbour, len(active))
    work = start + _BLOCK * np.arange(len(start))
    parts = min(get_num_threads(), 1 + int(work[-1]) // _SHARE)
    shares = np.searchsorted(work, np.linspace(0, 1, parts + 1) * work[-1])
    order = np.concatenate([order, lost]) if len(lost) else order
    return Arrangement(order, block, shares, start, neighbour, source, source_start, active, slot), lost
