"""Bonds between particles that fill cells of a lattice, and what of the lattice is open where bonds have broken.

Neighbours at rest lie in cells that share a face; their bond is broken where they have moved apart as far as faces of a
mesh must grow to be torn (`fracture`). Cells that hold no particle, but parts of the surface, belong to the particle
nearest to them. A face between two cells is open where what they belong to is not joined any more.

All is in cells: the frame of the lattice, its lowest corner the origin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compute.jit import njit
from .fracture import STRETCH
from .gmls import NEIGHBOURS, Weights, _weigh

Array = np.ndarray

#: Empty cells around the lattice.
_PAD = 4
#: Cells from one without a particle to the one that it belongs to, and to particles that carry a point, at most.
_REACH = 2
_SIDE = 2 * _REACH + 1


class Cells(NamedTuple):
    """A sorted table of cells.

    Attributes
    ----------
    keys : (c,) int64 array
        Ascending; (i * ny + j) * nz + k of each cell.
    owner : (c,) int32 array
        The particle that it belongs to; -1: none.
    open : (c, 3) bool array
        Whether its upper face along each axis is open.
    size : (3,) int64 array
        Of the lattice.
    """

    keys: Array
    owner: Array
    open: Array
    size: Array


class Bonds:
    """Particles on a lattice at rest.

    Parameters
    ----------
    rest : (n, 3) float array
        Metres, object space.
    to_cells : (4, 4) float array
        Brings places of object space into the lattice: cells have sides of 1.

    Attributes
    ----------
    to_cells : (4, 4) float64 array
        The same, from the lattice's lowest corner.
    rest : (n, 3) float64 array
        The particles at rest, in cells.
    size : (3,) int64 array
        Of the lattice.
    neighbour : (n, 6) int32 array
        Down and up each axis; -1: none.
    """

    def __init__(self, rest: Array, to_cells: Array) -> None:
        self.to_cells = np.array(to_cells, np.float64)
        low = np.floor(self.placed(rest)).min(axis=0) - _PAD
        self.to_cells[:3, 3] -= low
        self.rest = self.placed(rest)
        cell = np.floor(self.rest).astype(np.int64)
        self.size = cell.max(axis=0) + 1 + _PAD
        keys = _keys(cell, self.size)
        self._order = np.argsort(keys, kind="stable").astype(np.int32)
        self._keys = keys[self._order]
        self.neighbour = np.full((len(keys), 6), -1, np.int32)
        for side, step in enumerate(s * k for k in _strides(self.size) for s in (-1, 1)):
            at = np.searchsorted(self._keys, keys + step).clip(0, len(keys) - 1)
            there = self._keys[at] == keys + step
            self.neighbour[there, side] = self._order[at[there]]

    def placed(self, points: Array) -> Array:
        """(n, 3) float64 places in the lattice of points of object space."""
        return np.asarray(points, np.float64) @ self.to_cells[:3, :3].T + self.to_cells[:3, 3]

    def returned(self, places: Array) -> Array:
        """(n, 3) float32 points of object space at places in the lattice."""
        found: Array = ((places - self.to_cells[:3, 3]) @ np.linalg.inv(self.to_cells[:3, :3]).T).astype(np.float32)
        return found

    def returned_gradients(self, gradients: Array) -> Array:
        """(n, 3, 3) float32 deformation gradients of object space for those of the lattice."""
        linear = self.to_cells[:3, :3]
        found: Array = (np.linalg.inv(linear) @ np.asarray(gradients, np.float64) @ linear).astype(np.float32)
        return found

    def broken(self, now: Array, gap: float) -> Array:
        """(n, 3) bool: whether the bond up each axis is broken.

        Parameters
        ----------
        now : (n, 3) float64 array
            The particles now, in cells.
        gap : float
            Cells by which neighbours have moved apart at least.
        """
        found = np.zeros((len(now), 3), bool)
        for axis in range(3):
            a = np.flatnonzero(self.neighbour[:, 2 * axis + 1] >= 0)
            b = self.neighbour[a, 2 * axis + 1]
            before, after = (np.linalg.norm(x[a] - x[b], axis=1) for x in (self.rest, now))
            found[a, axis] = after > np.maximum(before + gap, STRETCH * before)
        return found

    def stretch(self, now: Array, broken: Array, which: Array) -> Array:
        """(k,) by how many times the longest bond of some particles that holds is longer than at rest, at least 1."""
        found = np.ones(len(self.rest))
        for axis in range(3):
            a = np.flatnonzero((self.neighbour[:, 2 * axis + 1] >= 0) & ~broken[:, axis])
            b = self.neighbour[a, 2 * axis + 1]
            before, after = (np.linalg.norm(x[a] - x[b], axis=1) for x in (self.rest, now))
            for ends in (a, b):  # each is among them once
                found[ends] = np.fmax(found[ends], after / before)
        return found[which]

    def zone(self, now: Array, broken: Array, gap: float) -> Cells:
        """The cells around broken bonds, and which of their faces are open."""
        rows, axes = np.nonzero(broken)
        ends = np.concatenate([rows, self.neighbour[rows, 2 * axes + 1]])
        cells = np.unique(_keys(np.floor(self.rest[ends]).astype(np.int64), self.size))
        for _ in range(_REACH):
            steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3) @ _strides(self.size)
            cells = np.unique(cells[:, None] + steps)
        owner = self.owners(cells)
        opened = np.zeros((len(cells), 3), np.bool_)
        zone = Cells(cells, owner, opened, self.size)
        _open(zone, self._keys, self.neighbour, broken, self.rest, now, gap, opened)
        return zone

    def filled(self, cells: Array) -> Array:
        """(c,) bool: which of (c, 3) cells hold a particle."""
        keys = _keys(cells, self.size)
        at = np.searchsorted(self._keys, keys).clip(0, len(self._keys) - 1)
        found: Array = self._keys[at] == keys
        return found

    def owners(self, cells: Array) -> Array:
        """(c,) int32: the particle that each of some cells, given by keys, belongs to; -1: none is near."""
        found = np.empty(len(cells), np.int32)
        _owners(np.ascontiguousarray(cells), self._keys, self._order, self.rest, self.size, found)
        return found

    def carriers(self, points: Array, owner: Array, broken: Array) -> tuple[Weights, Array]:
        """What carries points along: particles to which the one that owns them is joined.

        Parameters
        ----------
        points : (n, 3) float64 array
            At rest, in cells.
        owner : (n,) int32 array
        broken : (n, 3) bool array

        Returns
        -------
        weights : Weights
        parted : (n,) bool array
            Whether others near by are not joined to it.
        """
        own, row = np.unique(owner, return_inverse=True)
        reached = np.full((len(own), _SIDE**3), -1, np.int32)
        parted = np.zeros(len(own), np.bool_)
        _joined_to(own, self.neighbour, broken, self.rest, reached, parted)
        n, most = len(points), NEIGHBOURS
        index, distance = np.empty((n, most), np.int64), np.empty((n, most))
        _nearest(points, row.reshape(-1).astype(np.int64), reached, self.rest, index, distance)
        weights = Weights(
            np.where(distance < 0, index[:, :1], index).astype(np.int32), np.zeros((n, most, 4), np.float32),
            (points - self.rest[index[:, 0]]).astype(np.float32), np.zeros(n, np.float32),
        )  # fmt: skip
        _weigh(0, n, points, self.rest, index, distance, weights.weight, weights.reach)
        return weights, parted[row.reshape(-1)]


def _strides(size: Array) -> Array:
    return np.array([size[1] * size[2], size[2], 1], np.int64)


def _keys(cells: Array, size: Array) -> Array:
    return cells @ _strides(size)


@njit
def key_of(i, j, k, size):  # type: ignore[no-untyped-def]
    """The key of a cell; -1 outside the lattice.

    Parameters
    ----------
    i, j, k : int
        The cell.
    size : (3,) int64 array
        Of the lattice.
    """
    if i < 0 or j < 0 or k < 0 or i >= size[0] or j >= size[1] or k >= size[2]:
        return -1
    return (i * size[1] + j) * size[2] + k


@njit
def find(keys, key):  # type: ignore[no-untyped-def]
    """Row of a key in a sorted array; -1 where it is not there.

    Parameters
    ----------
    keys : (n,) int64 array
        Ascending.
    key : int
    """
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(keys) and keys[low] == key else -1


@njit
def _owners(cells, keys, order, rest, size, out):  # type: ignore[no-untyped-def]
    for c in range(len(cells)):
        row = find(keys, cells[c])
        if row >= 0:
            out[c] = order[row]
            continue
        out[c] = -1
        k = cells[c] % size[2]
        j = (cells[c] // size[2]) % size[1]
        i = cells[c] // (size[1] * size[2])
        best = 1e30
        for a in range(i - _REACH, i + _REACH + 1):
            for b in range(j - _REACH, j + _REACH + 1):
                for d in range(k - _REACH, k + _REACH + 1):
                    far = float((a - i) ** 2 + (b - j) ** 2 + (d - k) ** 2)
                    if far >= best:
                        continue
                    row = find(keys, key_of(a, b, d, size))
                    if row >= 0:
                        best, out[c] = far, order[row]


@njit
def _passes(p, side, neighbour, broken):  # type: ignore[no-untyped-def]
    """The neighbour of a particle on a side to which it is joined; -1: there is none."""
    q = neighbour[p, side]
    if q < 0:
        return -1
    return -1 if broken[p if side % 2 == 1 else q, side // 2] else q


@njit
def _spread(p, low, high, neighbour, broken, rest, whole, seen, stack):  # type: ignore[no-untyped-def]
    """Mark in `seen` the cells from `low` to `high` that particle `p` is joined to; `whole`: was at rest.

    Returns their number, with the particles in `stack`.
    """
    ny, nz = high[1] - low[1] + 1, high[2] - low[2] + 1
    seen[:] = False
    count, done = 1, 0
    stack[0] = p
    a, b, c = int(rest[p, 0]) - low[0], int(rest[p, 1]) - low[1], int(rest[p, 2]) - low[2]
    seen[(a * ny + b) * nz + c] = True
    while done < count:
        at = stack[done]
        done += 1
        for side in range(6):
            q = neighbour[at, side] if whole else _passes(at, side, neighbour, broken)
            if q < 0:
                continue
            a, b, c = int(rest[q, 0]), int(rest[q, 1]), int(rest[q, 2])
            if a < low[0] or b < low[1] or c < low[2] or a > high[0] or b > high[1] or c > high[2]:
                continue
            cell = ((a - low[0]) * ny + b - low[1]) * nz + c - low[2]
            if not seen[cell]:
                seen[cell] = True
                stack[count] = q
                count += 1
    return count


@njit
def _joined(p, q, neighbour, broken, rest, now, gap, seen, stack):  # type: ignore[no-untyped-def]
    """Whether two particles near each other are joined as they were at rest; else whether they have stayed near."""
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for wider in range(2):
        for c in range(3):
            low[c] = int(min(rest[p, c], rest[q, c])) - wider
            high[c] = int(max(rest[p, c], rest[q, c])) + wider
        for whole in (True, False):
            count = _spread(p, low, high, neighbour, broken, rest, whole, seen, stack)
            found = False
            for s in range(count):
                found = found or stack[s] == q
            if whole and not found:
                break
            if not whole:
                return found
    before = after = 0.0
    for c in range(3):
        before += (rest[p, c] - rest[q, c]) ** 2
        after += (now[p, c] - now[q, c]) ** 2
    before = np.sqrt(before)
    return not np.sqrt(after) > max(before + gap, STRETCH * before)


@njit
def _open(zone, keys, neighbour, broken, rest, now, gap, out):  # type: ignore[no-untyped-def]
    """Which upper faces of the cells of a zone are open; `keys` are of the cells that hold particles."""
    size = zone.size
    strides = (size[1] * size[2], size[2], 1)
    most = (_SIDE + 2 + _REACH) ** 3
    seen, stack = np.empty(most, np.bool_), np.empty(most, np.int64)
    for c in range(len(zone.keys)):
        p = zone.owner[c]
        if p < 0:
            continue
        for axis in range(3):
            other = find(zone.keys, zone.keys[c] + strides[axis])
            if other < 0 or zone.owner[other] < 0 or zone.owner[other] == p:
                continue
            q = zone.owner[other]
            if neighbour[p, 2 * axis + 1] == q:
                out[c, axis] = broken[p, axis]
            else:
                out[c, axis] = not _joined(p, q, neighbour, broken, rest, now, gap, seen, stack)


@njit
def _joined_to(own, neighbour, broken, rest, reached, parted):  # type: ignore[no-untyped-def]
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    seen, stack = np.empty(_SIDE**3, np.bool_), np.empty(_SIDE**3, np.int64)
    for r in range(len(own)):
        for c in range(3):
            low[c], high[c] = int(rest[own[r], c]) - _REACH, int(rest[own[r], c]) + _REACH
        whole = _spread(own[r], low, high, neighbour, broken, rest, True, seen, stack)
        count = _spread(own[r], low, high, neighbour, broken, rest, False, seen, stack)
        parted[r] = count < whole
        for s in range(count):
            reached[r, s] = stack[s]


@njit
def _nearest(points, row, reached, rest, index, distance):  # type: ignore[no-untyped-def]
    """The nearest of the particles that may carry each point, the first one its owner's nearest; -1: of no use."""
    most = index.shape[1]
    for i in range(len(points)):
        count = 0
        for s in range(reached.shape[1]):
            q = reached[row[i], s]
            if q < 0:
                break
            d = np.sqrt((points[i, 0] - rest[q, 0]) ** 2 + (points[i, 1] - rest[q, 1]) ** 2
                        + (points[i, 2] - rest[q, 2]) ** 2)  # fmt: skip
            if count == most and d >= distance[i, most - 1]:
                continue
            at = min(count, most - 1)
            while at > 0 and distance[i, at - 1] > d:
                distance[i, at], index[i, at] = distance[i, at - 1], index[i, at - 1]
                at -= 1
            distance[i, at], index[i, at] = d, q
            count = min(count + 1, most)
        for k in range(count, most):
            index[i, k], distance[i, k] = index[i, 0], -1.0
