"""The faces of cells as far as they are inside of a mesh that is cut along the cells."""

from __future__ import annotations

import numpy as np

from ..compute.jit import njit

Array = np.ndarray

#: Corners of the ring around an open face at most.
_RING = 4096


def walls(cell: Array, axis: Array, start: Array, edges: Array, places: Array) -> tuple[Array, Array, Array]:
    """What of open faces is inside of the mesh, as triangles.

    Parameters
    ----------
    cell : (w, 3) int64 array
        Lower cell of each open face.
    axis : (w,) int64 array
    start : (w + 1,) int64 array
        First of its `edges`.
    edges : (e, 2) int64 array
        Where it meets the mesh: corners, the inside to the left as seen from the upper cell.
    places : (c, 3) float64 array
        Of the corners, in cells.

    Returns
    -------
    face : (t,) int64 array
        Which open face each triangle is of.
    triangles : (t, 3) int64 array
        Corners, counter-clockwise as seen from the upper cell; -1 to -4: the corners of the open face itself.
    bare : (w,) bool array
        Open faces whose sides the mesh does not meet: all or nothing of them is inside.
    """
    room = 4 * (len(edges) + len(cell)) + 64
    while True:
        out = np.empty(room, np.int64), np.empty((room, 3), np.int64)
        bare = np.zeros(len(cell), np.bool_)
        count = _walls(cell, axis, start, edges, places, *out, bare)
        if count >= 0:
            return out[0][:count], out[1][:count], bare
        room *= 2


@njit
def _turn(ax, ay, bx, by, cx, cy):  # type: ignore[no-untyped-def]
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


@njit
def _border(u, v):  # type: ignore[no-untyped-def]
    """How far around the unit square, counter-clockwise, a place on its border is, from 0 to 4."""
    down, right, up, left = abs(v), abs(1.0 - u), abs(1.0 - v), abs(u)
    least = min(down, right, up, left)
    u, v = min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    if least == down:
        return u
    if least == right:
        return 1.0 + v
    if least == up:
        return 3.0 - u
    return 4.0 - v


@njit
def _fill(ring, n, x, y, w, count, face, triangles):  # type: ignore[no-untyped-def]
    """Cut a ring into triangles, ears of the largest smallest angle first; the number of all, -1 without room."""
    left = np.arange(n)
    while n > 2:
        best, ear = -1e30, 0
        for i in range(n):
            a, b, c = left[(i - 1) % n], left[i], left[(i + 1) % n]
            area = _turn(x[a], y[a], x[b], y[b], x[c], y[c])
            longest = max((x[a] - x[b]) ** 2 + (y[a] - y[b]) ** 2, (x[c] - x[b]) ** 2 + (y[c] - y[b]) ** 2,
                          (x[a] - x[c]) ** 2 + (y[a] - y[c]) ** 2)  # fmt: skip
            worth = area / (longest + 1e-30)
            if worth <= best:
                continue
            empty = True
            if worth > 0.0:
                for m in range(n):
                    p = left[m]
                    if p in (a, b, c):
                        continue
                    if (_turn(x[a], y[a], x[b], y[b], x[p], y[p]) > 0.0
                            and _turn(x[b], y[b], x[c], y[c], x[p], y[p]) > 0.0
                            and _turn(x[c], y[c], x[a], y[a], x[p], y[p]) > 0.0):  # fmt: skip
                        empty = False
                        break
            if empty:
                best, ear = worth, i
        if count == len(face):
            return -1
        face[count] = w
        triangles[count, 0], triangles[count, 1] = ring[left[(ear - 1) % n]], ring[left[ear]]
        triangles[count, 2] = ring[left[(ear + 1) % n]]
        count += 1
        left[ear : n - 1] = left[ear + 1 : n].copy()
        n -= 1
    return count


@njit
def _walls(cell, axis, start, edges, places, face, triangles, bare):  # type: ignore[no-untyped-def]
    """Write triangles of what is inside of open faces; their number, -1 where there is no room."""
    ring = np.empty(_RING, np.int64)
    x, y = np.empty(_RING), np.empty(_RING)
    corner_x, corner_y = np.array([0.0, 1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0])
    count = 0
    for w in range(len(cell)):
        first, last = start[w], start[w + 1]
        m = last - first
        across, along = (axis[w] + 1) % 3, (axis[w] + 2) % 3
        before, after = np.full(m, -1, np.int64), np.full(m, -1, np.int64)  # the edges beside each
        for a in range(m):
            for b in range(m):
                if before[b] < 0 and after[a] < 0 and edges[first + a, 1] == edges[first + b, 0]:
                    after[a], before[b] = b, a
        begins, used = np.full(m, -1.0), np.zeros(m, np.bool_)
        met = False
        for a in range(m):
            if before[a] < 0:
                p = places[edges[first + a, 0]]
                begins[a] = _border(p[across] - cell[w, across], p[along] - cell[w, along])
                met = True
        bare[w] = not met
        for way in range(2):  # chains between the sides, then closed ones
            for a in range(m):
                if used[a] or (way == 0 and before[a] >= 0):
                    continue
                n, e = 0, a
                while not used[e] and n < _RING - 8:
                    used[e] = True
                    ring[n] = edges[first + e, 0]
                    n += 1
                    if after[e] >= 0:
                        e = after[e]
                        continue
                    ring[n] = edges[first + e, 1]
                    n += 1
                    # Along the sides to where the next chain begins.
                    p = places[edges[first + e, 1]]
                    here = _border(p[across] - cell[w, across], p[along] - cell[w, along])
                    nearest, e = 9.0, a
                    for b in range(m):
                        if before[b] < 0 and (not used[b] or b == a):
                            far = (begins[b] - here) % 4.0
                            if far < nearest:
                                nearest, e = far, b
                    for s in range(1, 6):
                        side = np.floor(here) + s
                        if side - here < nearest:
                            ring[n] = -1 - (np.int64(side) % 4)
                            n += 1
                area = 0.0
                for i in range(n):
                    if ring[i] < 0:
                        x[i], y[i] = corner_x[-1 - ring[i]], corner_y[-1 - ring[i]]
                    else:
                        x[i] = places[ring[i], across] - cell[w, across]
                        y[i] = places[ring[i], along] - cell[w, along]
                for i in range(n):
                    area += x[i] * y[(i + 1) % n] - x[(i + 1) % n] * y[i]
                if n < 3 or area <= 0.0:
                    continue
                count = _fill(ring, n, x, y, w, count, face, triangles)
                if count < 0:
                    return -1
    return count
