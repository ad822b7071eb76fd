"""Kernels of bonds: cells by their keys, what particles own them, and which particles are joined near by."""

from __future__ import annotations

import numpy as np

from ..compute.jit import njit
from .fracture import STRETCH

#: Cells from one without a particle to the one that it belongs to, and to particles that carry a point, at most.
REACH = 2
SIDE = 2 * REACH + 1


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
def find_owners(cells, keys, order, rest, size, out):  # type: ignore[no-untyped-def]
    """The particle that each of some cells belongs to; -1: none is near.

    Parameters
    ----------
    cells : (c,) int64 array
        Their keys.
    keys : (n,) int64 array
        Of cells that hold a particle, ascending.
    order : (n,) int32 array
        The particle of each.
    rest : (n, 3) float64 array
    size : (3,) int64 array
        Of the lattice.
    out : (c,) int32 array
        Written.
    """
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
        for a in range(i - REACH, i + REACH + 1):
            for b in range(j - REACH, j + REACH + 1):
                for d in range(k - REACH, k + REACH + 1):
                    far = float((a - i) ** 2 + (b - j) ** 2 + (d - k) ** 2)
                    if far >= best:
                        continue
                    row = find(keys, key_of(a, b, d, size))
                    if row >= 0:
                        best, out[c] = far, order[row]


@njit
def bonds_apart(a, b, rest, now, gap, out):  # type: ignore[no-untyped-def]
    """Which bonds are broken: their ends are more than `gap` cells farther apart than at rest, and `STRETCH` times.

    Parameters
    ----------
    a, b : (k,) int array
        The ends of each; -1: it has none.
    rest, now : (n, 3) float64 array
        Particles, in cells.
    gap : float
    out : (k,) bool array
        Written.
    """
    for i in range(len(a)):
        p, q = a[i], b[i]
        before = after = 0.0
        if p >= 0 and q >= 0:
            for c in range(3):
                before += (rest[p, c] - rest[q, c]) ** 2
                after += (now[p, c] - now[q, c]) ** 2
        before = np.sqrt(before)
        out[i] = np.sqrt(after) > max(before + gap, STRETCH * before)


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
def _joined(p, q, neighbour, broken, rest, seen, stack):  # type: ignore[no-untyped-def]
    """Whether two particles near each other are joined there: 1, 0, or -1 where they were not at rest, either."""
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
                return 1 if found else 0
    return -1


@njit
def bonds_across(cells, owner, neighbour, rest, size, out):  # type: ignore[no-untyped-def]
    """Numbers p * n + q of owners of cells that touch which are not joined at rest, p < q; returns how many.

    Parameters
    ----------
    cells : (c,) int64 array
        Their keys, ascending.
    owner : (c,) int32 array
    neighbour : (n, 6) int32 array
    rest : (n, 3) float64 array
        See `bonds.Bonds`.
    size : (3,) int64 array
        Of the lattice.
    out : (3 c,) int64 array
        Written; a number may occur twice.
    """
    strides = (size[1] * size[2], size[2], 1)
    most = (SIDE + 2 + REACH) ** 3
    seen, stack = np.empty(most, np.bool_), np.empty(most, np.int64)
    none, count = np.zeros((len(rest), 3), np.bool_), 0
    for c in range(len(cells)):
        p = owner[c]
        for axis in range(3):
            other = find(cells, cells[c] + strides[axis])
            if p < 0 or other < 0 or owner[other] < 0 or owner[other] == p:
                continue
            q = owner[other]
            if neighbour[p, 2 * axis + 1] != q and _joined(p, q, neighbour, none, rest, seen, stack) < 0:
                out[count] = np.int64(min(p, q)) * len(rest) + max(p, q)
                count += 1
    return count


@njit
def open_faces_of(zone, neighbour, broken, across, parted, rest, out):  # type: ignore[no-untyped-def]
    """Which upper faces of the cells of a zone are open.

    Parameters
    ----------
    zone : Cells
    neighbour : (n, 6) int32 array
    broken : (n, 3) bool array
        See `bonds.Broken.up`.
    across : (k,) int64 array
    parted : (k,) bool array
        See `bonds.Broken.across`.
    rest : (n, 3) float64 array
    out : (c, 3) bool array
        Written.
    """
    size = zone.size
    strides = (size[1] * size[2], size[2], 1)
    most = (SIDE + 2 + REACH) ** 3
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
                continue
            joined = _joined(p, q, neighbour, broken, rest, seen, stack)
            if joined < 0:
                row = find(across, np.int64(min(p, q)) * len(rest) + max(p, q))
                joined = 0 if row >= 0 and parted[row] else 1
            out[c, axis] = joined == 0


@njit
def all_joined_to(own, neighbour, broken, rest, reached, parted):  # type: ignore[no-untyped-def]
    """The particles near by to which some are joined.

    Parameters
    ----------
    own : (k,) int32 array
    neighbour : (n, 6) int32 array
    broken : (n, 3) bool array
        See `bonds.Broken.up`.
    rest : (n, 3) float64 array
    reached : (k, SIDE ** 3) int32 array
        Begins with -1; written.
    parted : (k,) bool array
        Whether others near by are not joined any more; written.
    """
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    seen, stack = np.empty(SIDE**3, np.bool_), np.empty(SIDE**3, np.int64)
    for r in range(len(own)):
        for c in range(3):
            low[c], high[c] = int(rest[own[r], c]) - REACH, int(rest[own[r], c]) + REACH
        whole = _spread(own[r], low, high, neighbour, broken, rest, True, seen, stack)
        count = _spread(own[r], low, high, neighbour, broken, rest, False, seen, stack)
        parted[r] = count < whole
        for s in range(count):
            reached[r, s] = stack[s]


@njit
def nearest_carriers(points, row, reached, rest, index, distance):  # type: ignore[no-untyped-def]
    """The nearest of the particles that may carry each point.

    Parameters
    ----------
    points : (n, 3) float64 array
    row : (n,) int64 array
        Of `reached`, for each.
    reached : (k, SIDE ** 3) int32 array
        See `all_joined_to`.
    rest : (s, 3) float64 array
    index : (n, m) int64 array
        Particles, the nearest first; written.
    distance : (n, m) float64 array
        In cells; -1: of no use; written.
    """
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
