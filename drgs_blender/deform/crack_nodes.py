"""Corners where cracks run: how they move to smooth these, what is joined around them, and what is pressed together."""

from __future__ import annotations

import numpy as np

from ..compute.jit import njit
from .bond_kernels import find, key_of
from .bonds import Cells

Array = np.ndarray

#: How often corners of cracks move towards their neighbours, how far each time, and in all, in cells.
_ROUNDS, _SHARE, _FARTHEST = 8, 0.6, 0.45
#: Steps by which it is found where in the lattice a place then is.
_INVERTED = 5
#: Cells between both sides of a crack up to which it is shut, and from which it is open.
_SHUT, _OPEN = 0.5, 1.0


def cells_of(keys: Array, size: Array) -> Array:
    return np.stack([keys // (size[1] * size[2]), (keys // size[2]) % size[1], keys % size[2]], axis=-1)


def node_keys(cell: Array, axis: Array, corner: Array, size: Array) -> Array:
    """Keys of the corners of upper faces of cells, counter-clockwise as seen from above."""
    eye = np.eye(3, dtype=np.int64)
    across, along = np.array([0, 1, 1, 0])[corner], np.array([0, 0, 1, 1])[corner]
    node = cell + eye[axis] + across[:, None] * eye[(axis + 1) % 3] + along[:, None] * eye[(axis + 2) % 3]
    keys: Array = (node[:, 0] * (size[1] + 1) + node[:, 1]) * (size[2] + 1) + node[:, 2]
    return keys


def node_places(keys: Array, nodes: tuple[Array, Array], lattice: Array) -> Array:
    """(k, 3) float64 places of nodes at rest, with what has moved them."""
    known, moves = nodes
    at = np.searchsorted(known, keys).clip(0, max(len(known) - 1, 0))
    places = cells_of(keys, lattice).astype(np.float64)
    if len(known):
        places += np.where((known[at] == keys)[:, None], moves[at], 0.0)
    return places


def smoothed_nodes(zone: Cells) -> tuple[Array, Array]:
    """Keys of the corners of open faces, ascending, and (k, 3) by how much they move, in cells."""
    rows, axes = np.nonzero(zone.open)
    cell = cells_of(zone.keys[rows], zone.size)
    keys = np.stack([node_keys(cell, axes, np.full(len(rows), c), zone.size) for c in range(4)], axis=1)
    known, quads = np.unique(keys, return_inverse=True)
    quads = quads.reshape(-1, 4)
    rest = cells_of(known, zone.size + 1).astype(np.float64)
    a, b = quads.reshape(-1), np.roll(quads, -1, axis=1).reshape(-1)
    ends, others = np.concatenate([a, b]), np.concatenate([b, a])
    degree = np.bincount(ends, minlength=len(known)).astype(np.float64)[:, None]
    place = rest.copy()
    for _ in range(_ROUNDS):
        mean = np.stack([np.bincount(ends, place[others, c], len(known)) for c in range(3)], axis=1) / degree
        place += _SHARE * (mean - place)
        place = rest + np.clip(place - rest, -_FARTHEST, _FARTHEST)
    return known, place - rest


@njit
def warp(places, lattice, known, moves):  # type: ignore[no-untyped-def]
    """Move places to where corners of the lattice that have moved come from: planes lie there where they went.

    Parameters
    ----------
    places : (n, 3) float64 array
        In cells; changed.
    lattice : (3,) int64 array
        How many corners there are along each axis.
    known : (k,) int64 array
        Keys of corners, ascending.
    moves : (k, 3) float64 array
        By how much each has moved, in cells.
    """
    move, at = np.empty(3), np.empty(3)
    for v in range(len(places)):
        at[:] = places[v]
        if not (np.abs(at).max() < 1e6):
            continue
        for _ in range(_INVERTED):
            i, j, k = np.int64(np.floor(at[0])), np.int64(np.floor(at[1])), np.int64(np.floor(at[2]))
            x, y, z = at[0] - i, at[1] - j, at[2] - k
            move[:] = 0.0
            met = False
            for n in range(8):
                a, b, c = n & 1, (n >> 1) & 1, n >> 2
                key = key_of(i + a, j + b, k + c, lattice)
                row = find(known, key) if key >= 0 else -1
                if row >= 0:
                    w = (x if a else 1.0 - x) * (y if b else 1.0 - y) * (z if c else 1.0 - z)
                    for d in range(3):
                        move[d] += w * moves[row, d]
                    met = True
            for d in range(3):
                at[d] = places[v, d] - move[d]
            if not met:
                break
        places[v] = at


@njit
def rows_of(cells, zone, out):  # type: ignore[no-untyped-def]
    """Find cells in a table.

    Parameters
    ----------
    cells : (n, 3) int64 array
    zone : Cells
    out : (n,) int64 array
        Their rows, -1: not there; written.
    """
    for c in range(len(cells)):
        key = key_of(cells[c, 0], cells[c, 1], cells[c, 2], zone.size)
        out[c] = find(zone.keys, key) if key >= 0 else -1


@njit
def joined_at(planes, cell, zone, out):  # type: ignore[no-untyped-def]
    """Of a corner and a cell beside it: the key of the first cell around the corner to which that one is joined.

    Parameters
    ----------
    planes : (n, 3) int64 array
        The planes of the lattice on which each corner lies, -1: on none along this axis.
    cell : (n, 3) int64 array
    zone : Cells
    out : (n,) int64 array
        Keys; written.
    """
    row, key, root = np.empty(8, np.int64), np.empty(8, np.int64), np.empty(8, np.int64)
    for i in range(len(planes)):
        own = 0
        for n in range(8):
            key[n], row[n], root[n] = -1, -1, n
            there = True
            at0, at1, at2 = cell[i, 0], cell[i, 1], cell[i, 2]
            for axis in range(3):
                up = (n >> axis) & 1
                if planes[i, axis] < 0:
                    there = there and up == 0
                    continue
                place = planes[i, axis] - 1 + up
                if place == cell[i, axis]:
                    own |= up << axis
                if axis == 0:
                    at0 = place
                elif axis == 1:
                    at1 = place
                else:
                    at2 = place
            if there:
                key[n] = key_of(at0, at1, at2, zone.size)
                row[n] = find(zone.keys, key[n]) if key[n] >= 0 else -1
        for n in range(8):
            for axis in range(3):
                m = n | (1 << axis)
                if m == n or key[n] < 0 or key[m] < 0:
                    continue
                if row[n] >= 0 and (zone.owner[row[n]] < 0 or zone.open[row[n], axis]):
                    continue
                if row[m] >= 0 and zone.owner[row[m]] < 0:
                    continue
                a, b = min(root[n], root[m]), max(root[n], root[m])
                for o in range(8):
                    if root[o] == b:
                        root[o] = a
        out[i] = key[root[own]]


@njit
def press_together(corner, at, turn, opening):  # type: ignore[no-untyped-def]
    """Bring sides of a crack that are pressed together to one place, so that no line between them is seen.

    Parameters
    ----------
    corner : (r,) int64 array
        Ascending; rows of one corner are its sides.
    at : (r, 3) float64 array
        In cells; changed.
    turn : (r, 3, 3) float64 array
        Deformation gradients; changed.
    opening : (r,) float64 array
        From 0, where all sides of the corner are together, to 1; written.
    """
    place, gradient, weight = np.empty((8, 3)), np.empty((8, 3, 3)), np.empty((8, 8))
    first = 0
    while first < len(corner):
        count = 1
        while first + count < len(corner) and count < 8 and corner[first + count] == corner[first]:
            count += 1
        least = 1.0
        for a in range(count):
            place[a], gradient[a] = at[first + a], turn[first + a]
            for b in range(count):
                d = 0.0
                for c in range(3):
                    d += (at[first + a, c] - at[first + b, c]) ** 2
                t = min(max((np.sqrt(d) - _SHUT) / (_OPEN - _SHUT), 0.0), 1.0)
                weight[a, b] = 1.0 - t * t * (3.0 - 2.0 * t)
                least = min(least, weight[a, b])
        for a in range(count):
            opening[first + a] = 1.0 - least
            total = 0.0
            at[first + a], turn[first + a] = 0.0, 0.0
            for b in range(count):
                total += weight[a, b]
                at[first + a] += weight[a, b] * place[b]
                turn[first + a] += weight[a, b] * gradient[b]
            at[first + a] /= total
            turn[first + a] /= total
        first += count
