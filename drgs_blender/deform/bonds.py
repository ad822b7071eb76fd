"""Bonds between particles that fill cells of a lattice, and what of the lattice is open where bonds have broken.

Neighbours at rest lie in cells that share a face; their bond is broken where they have moved apart as far as faces of a
mesh must grow to be torn (`fracture`). Cells that hold no particle, but parts of the surface, belong to the particle
nearest to them. Where such cells touch across a gap of the matter, their particles have a bond, too. A face between two
cells is open where what they belong to is not joined any more. What has broken stays so: simulations keep bits of it.

All is in cells: the frame of the lattice, its lowest corner the origin.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from .bond_kernels import (
    REACH,
    SIDE,
    all_joined_to,
    bonds_across,
    bonds_apart,
    find_owners,
    nearest_carriers,
    open_faces_of,
)
from .gmls import NEIGHBOURS, Weights, _weigh

Array = np.ndarray

#: Empty cells around the lattice.
_PAD = 4


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


class Broken(NamedTuple):
    """Which bonds are broken.

    Attributes
    ----------
    up : (n, 3) bool array
        Of each particle, that to its neighbour up each axis.
    across : (k,) bool array
        Those of `Bonds.across`.
    """

    up: Array
    across: Array


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

    @cached_property
    def across(self) -> Array:
        """(k,) int64 ascending: p * n + q of particles p < q whose cells touch and that nothing near joins at rest."""
        surface = np.flatnonzero((self.neighbour < 0).any(axis=1))
        cells = self._around(np.floor(self.rest[surface]).astype(np.int64))
        found = np.empty(3 * len(cells), np.int64)
        count = bonds_across(cells, self.owners(cells), self.neighbour, self.rest, self.size, found)
        return np.unique(found[:count])

    def broken(self, now: Array, gap: float) -> Broken:
        """Which bonds are broken where particles are now.

        Parameters
        ----------
        now : (n, 3) float64 array
            The particles now, in cells.
        gap : float
            Cells by which neighbours have moved apart at least.
        """
        found, (p, q) = self.none(), np.divmod(self.across, len(self.rest))
        rows = np.arange(len(self.rest))
        for axis in range(3):
            bonds_apart(rows, self.neighbour[:, 2 * axis + 1], self.rest, now, gap, found.up[:, axis])
        bonds_apart(p, q, self.rest, now, gap, found.across)
        return found

    def none(self) -> Broken:
        """That nothing has broken."""
        return Broken(np.zeros((len(self.rest), 3), bool), np.zeros(len(self.across), bool))

    def packed(self, broken: Broken) -> Array:
        """(bytes,) uint8: what is broken, a bit for each bond."""
        return np.packbits(np.concatenate([broken.up.reshape(-1), broken.across]))

    def unpacked(self, bits: Array) -> Broken:
        """The inverse of `packed`; ValueError where the bits are of other bonds."""
        n, count = len(self.rest), 3 * len(self.rest) + len(self.across)
        if bits.dtype != np.uint8 or bits.shape != ((count + 7) // 8,):
            raise ValueError(f"{bits.shape} bytes of {bits.dtype} for {count} bonds")
        found = np.unpackbits(bits, count=count).view(bool)
        up: Array = found[: 3 * n].reshape(n, 3)
        return Broken(up & (self.neighbour[:, 1::2] >= 0), found[3 * n :])

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

    def zone(self, broken: Broken) -> Cells:
        """The cells around broken bonds, and which of their faces are open."""
        rows, axes = np.nonzero(broken.up)
        ends = np.concatenate([rows, self.neighbour[rows, 2 * axes + 1]])
        cells = self._around(np.floor(self.rest[ends]).astype(np.int64))
        owner = self.owners(cells)
        opened = np.zeros((len(cells), 3), np.bool_)
        zone = Cells(cells, owner, opened, self.size)
        open_faces_of(zone, self.neighbour, broken.up, self.across, broken.across, self.rest, opened)
        return zone

    def _around(self, cells: Array) -> Array:
        """Ascending keys of (n, 3) cells and those around them that may belong to a particle there."""
        found = np.unique(_keys(cells, self.size))
        steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3) @ _strides(self.size)
        for _ in range(REACH):
            found = np.unique(found[:, None] + steps)
        return found

    def filled(self, cells: Array) -> Array:
        """(c,) bool: which of (c, 3) cells hold a particle."""
        keys = _keys(cells, self.size)
        at = np.searchsorted(self._keys, keys).clip(0, len(self._keys) - 1)
        found: Array = self._keys[at] == keys
        return found

    def owners(self, cells: Array) -> Array:
        """(c,) int32: the particle that each of some cells, given by keys, belongs to; -1: none is near."""
        found = np.empty(len(cells), np.int32)
        find_owners(np.ascontiguousarray(cells), self._keys, self._order, self.rest, self.size, found)
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
        reached = np.full((len(own), SIDE**3), -1, np.int32)
        parted = np.zeros(len(own), np.bool_)
        all_joined_to(own, self.neighbour, broken, self.rest, reached, parted)
        n, most = len(points), NEIGHBOURS
        index, distance = np.empty((n, most), np.int64), np.empty((n, most))
        nearest_carriers(points, row.reshape(-1).astype(np.int64), reached, self.rest, index, distance)
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
