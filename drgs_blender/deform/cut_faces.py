"""Triangles cut along the cells of a lattice.

A corner of a cut is known by what crosses there: a vertex of the mesh, one of its edges and a plane of the lattice, or
a triangle and two planes. Cuts of triangles that share an edge therefore share their corners.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compute.jit import njit
from ..geometry.distinct_rows import distinct_row_indices
from .bond_kernels import find, key_of
from .bonds import Cells

Array = np.ndarray

#: Corners of a piece at most: three and one for each side of a cell.
_MOST = 12
#: Kinds of corners, the first column of their keys.
VERTEX, EDGE, FACE = range(3)
#: Edges of pieces: those of the triangle, then planes, by axis and place.
_PLANES = 3


class Pieces(NamedTuple):
    """What cuts have left of triangles: convex polygons, each in one cell.

    Attributes
    ----------
    start : (p + 1,) int64 array
        First corner of each piece.
    face : (p,) int32 array
        Which triangle it is of.
    cell : (p, 3) int64 array
    key : (c, 5) int64 array
        Of the corners: what they are (`VERTEX`, `EDGE`, `FACE`), and where.
    share : (c, 3) float64 array
        Barycentric coordinates of the corners in their triangle.
    label : (c,) int64 array
        What the edge from each corner to the next lies on.
    """

    start: Array
    face: Array
    cell: Array
    key: Array
    share: Array
    label: Array

    def kept(self, which: Array) -> Pieces:
        """Those of (p,) bool `which`."""
        lengths = np.diff(self.start)
        corners = np.repeat(which, lengths)
        start = np.concatenate([[0], np.cumsum(lengths[which])])
        return Pieces(
            start, self.face[which], self.cell[which], self.key[corners], self.share[corners], self.label[corners]
        )

    def and_whole(self, which: Array, faces: Array) -> Pieces:
        """These, and triangles `which` (k,) that are not cut, whose cell is that of their corners."""
        corners, n = faces[which].reshape(-1), 3 * len(which)
        keys = np.zeros((n, 5), np.int64)
        keys[:, 1] = corners
        return Pieces(
            np.concatenate([self.start, len(self.key) + np.arange(3, n + 1, 3)]),
            np.concatenate([self.face, which.astype(np.int32)]),
            np.concatenate([self.cell, np.zeros((len(which), 3), np.int64)]), np.concatenate([self.key, keys]),
            np.concatenate([self.share, np.tile(np.eye(3), (len(which), 1))]),
            np.concatenate([self.label, np.tile(np.arange(3), len(which))]),
        )  # fmt: skip

    @property
    def of(self) -> Array:
        """(c,) int64: the piece of each corner."""
        return np.repeat(np.arange(len(self.face)), np.diff(self.start))

    @property
    def following(self) -> Array:
        """(c,) int64: the corner after each in its piece."""
        after = np.arange(1, len(self.key) + 1)
        after[self.start[1:] - 1] = self.start[:-1]
        return after

    def triangles(self) -> tuple[Array, Array]:
        """(t, 3) int64 corners of triangles that fill the pieces, and (t,) int64 pieces."""
        lengths = np.diff(self.start)
        piece = np.repeat(np.arange(len(lengths)), lengths - 2)
        first = self.start[piece]
        step = np.arange(len(piece)) - np.repeat(np.concatenate([[0], np.cumsum(lengths - 2)[:-1]]), lengths - 2)
        return np.stack([first, first + step + 1, first + step + 2], axis=1), piece

    def corner_ids(self) -> Array:
        """(c,) int64: corners that are the same have the same number."""
        return distinct_row_indices(*self.key.T)


def near_open(places: Array, faces: Array, cells: Cells) -> Array:
    """(k,) int64: triangles that lie in several cells of which one has an open face; `places` in cells."""
    found = np.zeros(len(faces), np.bool_)
    opened = np.zeros(len(cells.keys), np.bool_)
    _around_open(cells, opened)
    _near(places, faces, cells, opened, found)
    return np.flatnonzero(found)


def cut(places: Array, faces: Array, chosen: Array) -> Pieces:
    """Cut triangles along the planes of a lattice.

    Parameters
    ----------
    places : (n, 3) float64 array
        In cells; no coordinate is a whole number.
    faces : (m, 3) int32 array
    chosen : (k,) int64 array
        Which of them.
    """
    pieces = 16 * len(chosen) + 64
    while True:
        corners = 6 * pieces
        out = (
            np.zeros(pieces + 1, np.int64), np.empty(pieces, np.int32), np.empty((pieces, 3), np.int64),
            np.empty((corners, 5), np.int64), np.empty((corners, 3)), np.empty(corners, np.int64),
        )  # fmt: skip
        count = _cut(places, faces, chosen, *out)
        if count >= 0:
            used = int(out[0][count])
            return Pieces(out[0][: count + 1], *(a[:count] for a in out[1:3]), *(a[:used] for a in out[3:]))
        pieces *= 2


def open_faces(pieces: Pieces, cells: Cells) -> tuple[Array, Array]:
    """Row of `cells` of the lower cell of the open face that the edge after each corner lies on, -1; and its axis."""
    found, axes = np.full(len(pieces.label), -1, np.int64), (pieces.label - _PLANES) % 3
    _on_open(pieces.label, pieces.cell[pieces.of], cells, found)
    return found, axes


@njit
def _around_open(cells, out):  # type: ignore[no-untyped-def]
    """Cells with an open face on any side."""
    strides = (cells.size[1] * cells.size[2], cells.size[2], 1)
    for c in range(len(cells.keys)):
        for axis in range(3):
            if cells.open[c, axis]:
                out[c] = True
                out[find(cells.keys, cells.keys[c] + strides[axis])] = True


@njit
def _near(places, faces, cells, opened, out):  # type: ignore[no-untyped-def]
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for f in range(len(faces)):
        many, fine = 1, True
        for c in range(3):
            a, b, d = places[faces[f, 0], c], places[faces[f, 1], c], places[faces[f, 2], c]
            least, most = min(a, b, d), max(a, b, d)
            if not (least > -1e6 and most < 1e6):
                fine = False
                break
            low[c], high[c] = int(np.floor(least)), int(np.floor(most))
            many *= high[c] - low[c] + 1
        if not fine or many == 1:
            continue
        if many > 4096:
            out[f] = True
            continue
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    if out[f]:
                        continue
                    key = key_of(i, j, k, cells.size)
                    row = find(cells.keys, key) if key >= 0 else -1
                    out[f] = row >= 0 and opened[row]


@njit
def _crossing(key, f, faces, label, axis, plane):  # type: ignore[no-untyped-def]
    """The key of the corner where an edge of a piece meets a plane."""
    if label < _PLANES:
        a, b = faces[f, label], faces[f, (label + 1) % 3]
        key[0], key[1], key[2], key[3], key[4] = EDGE, min(a, b), max(a, b), axis, plane
        return
    other, place = (label - _PLANES) % 3, (label - _PLANES) // 3
    key[0], key[1] = FACE, f
    if other < axis:
        key[2], key[3], key[4] = 3 * other + axis, place, plane
    else:
        key[2], key[3], key[4] = 3 * axis + other, plane, place


@njit
def _split(stack, row, n, axis, plane, f, faces, places):  # type: ignore[no-untyped-def]
    """Part the piece in a row of the stack, into the two rows after it; numbers of corners below and above."""
    place, share, key, label = stack
    counts = np.zeros(2, np.int64)
    for i in range(n):
        j = (i + 1) % n
        side, other = int(place[row, i, axis] >= plane), int(place[row, j, axis] >= plane)
        at, to = counts[side], row + 1 + side
        place[to, at], share[to, at], key[to, at] = place[row, i], share[row, i], key[row, i]
        label[to, at] = label[row, i]
        counts[side] += 1
        if side == other:
            continue
        for s in range(2):
            at, to = counts[s], row + 1 + s
            counts[s] += 1
            _crossing(key[to, at], f, faces, label[row, i], axis, plane)
            if label[row, i] < _PLANES:  # the same for all triangles of the edge
                a, b = label[row, i], (label[row, i] + 1) % 3
                if faces[f, a] > faces[f, b]:
                    a, b = b, a
                x, y = places[faces[f, a]], places[faces[f, b]]
                t = (plane - x[axis]) / (y[axis] - x[axis])
                for c in range(3):
                    share[to, at, c] = 0.0
                    place[to, at, c] = x[c] + t * (y[c] - x[c])
                share[to, at, a], share[to, at, b] = 1.0 - t, t
            else:
                t = (plane - place[row, i, axis]) / (place[row, j, axis] - place[row, i, axis])
                for c in range(3):
                    place[to, at, c] = place[row, i, c] + t * (place[row, j, c] - place[row, i, c])
                    share[to, at, c] = share[row, i, c] + t * (share[row, j, c] - share[row, i, c])
            place[to, at, axis] = plane
            # The side that the edge leaves goes on along the plane, the other one along the edge.
            label[to, at] = _PLANES + axis + 3 * plane if s == side else label[row, i]
    return counts


@njit
def _cut(places, faces, chosen, start, face, cell, key, share, label):  # type: ignore[no-untyped-def]
    """Write the pieces; their number, -1 where there is no room."""
    rows = 32
    stack = (
        np.zeros((rows, _MOST, 3)), np.zeros((rows, _MOST, 3)), np.zeros((rows, _MOST, 5), np.int64),
        np.zeros((rows, _MOST), np.int64),
    )  # fmt: skip
    corners = np.zeros(rows, np.int64)
    count = at = 0
    for f in chosen:
        for i in range(3):
            stack[0][0, i] = places[faces[f, i]]
            stack[1][0, i], stack[2][0, i] = 0.0, 0
            stack[1][0, i, i], stack[2][0, i, 1], stack[3][0, i] = 1.0, faces[f, i], i
        corners[0] = 3
        row = 0
        while row >= 0:
            n, parted = corners[row], False
            for axis in range(3):
                plane = np.int64(np.floor(stack[0][row, :n, axis].min())) + 1
                if plane < stack[0][row, :n, axis].max():
                    counts = _split(stack, row, n, axis, plane, f, faces, places)
                    # What is above waits in the row of the whole.
                    for array in stack[:2]:
                        array[row] = array[row + 2]
                    stack[2][row], stack[3][row] = stack[2][row + 2], stack[3][row + 2]
                    corners[row], corners[row + 1] = counts[1], counts[0]
                    row += 1
                    parted = True
                    break
            if parted:
                continue
            if count == len(face) or at + n > len(label):
                return -1
            for c in range(3):
                cell[count, c] = np.int64(np.floor(stack[0][row, :n, c].mean()))
            face[count], start[count] = f, at
            for i in range(n):
                key[at], share[at], label[at] = stack[2][row, i], stack[1][row, i], stack[3][row, i]
                at += 1
            count += 1
            start[count] = at
            row -= 1
    return count


@njit
def _on_open(label, cell, cells, out):  # type: ignore[no-untyped-def]
    for c in range(len(label)):
        if label[c] < _PLANES:
            continue
        axis, plane = (label[c] - _PLANES) % 3, (label[c] - _PLANES) // 3
        i, j, k = cell[c, 0], cell[c, 1], cell[c, 2]
        if cell[c, axis] == plane:
            i, j, k = i - (axis == 0), j - (axis == 1), k - (axis == 2)
        key = key_of(i, j, k, cells.size)
        row = find(cells.keys, key) if key >= 0 else -1
        if row >= 0 and cells.open[row, axis]:
            out[c] = row
