"""Contact of bodies with each other, at nodes of the grid where several have matter, in compiled code.

Multi-field contact (Bardenhagen et al. 2001; Huang et al. 2011): every body has velocities of its own at the nodes.
Where those of two bodies would bring them closer than they may come, both get the same impulse, with opposite signs:
momentum is kept. Quadratic splines reach one and a half cells, so that bodies share nodes long before they touch: how
far apart their particles are along the normal decides, with how deep these lay in their body at rest, as rows of
particles make steps of an even surface that lies askew. Of several normals that counts along which bodies are farthest
apart.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.threads import over_range
from .p2g_g2p import cell_of, weights_of
from .packed import MASS, VOLUME

Array = np.ndarray

_ZERO, _HALF, _ONE_HALF = np.float32(0.0), np.float32(0.5), np.float32(1.5)

#: Cells between bodies below which what slips is held, and what sticks.
_SLIPS, _STICKS = 0.1, 0.5
#: Cosine of the angle between the normals of two bodies up to which they lie flat on each other.
_FLAT = 0.95
#: The same up to which two normals are one.
_SAME = 0.9995
#: Cells from the surface of matter to its outermost particles, of which two lie in a cell; and from the surface at rest
#: to particles that may come to lie at a surface, where that is known.
RIM, DEEPEST_RIM = 0.25, 0.5


#: Normals that are tried: shares of the one and of the other body, and where in the rows of `_gather` they stand.
_SHARES = ((1, 0, 3), (0, 1, 3), (1, 0, 0), (0, 1, 0), (1, 1, 0))
CANDIDATES = len(_SHARES)
#: Cells by which a later one must keep bodies farther apart, to be better.
_ALIKE = 0.02


class Side(NamedTuple):
    """A body on its grid, between the halves of a step.

    Attributes
    ----------
    x : (n, 3) float64 array
        See `Packed`; so `motion`.
    motion : (n, WIDTH) float32 array
    rim : (n, 4) float32 array
        See `Scene`.
    gradient : (n, WIDTH) float32 array
        From column `first` on the deformation gradient since the start less 1.
    first : int
    start, source, source_start, active, slot : array
        See `Arrangement`.
    values : (a, 64, 4) float32 array
        Velocity and mass, see `Nodes`.
    marks : (a, 64) bool array
        Nodes that no other body moves; without rows there are none.
    """

    x: Array
    motion: Array
    rim: Array
    gradient: Array
    first: int
    start: Array
    source: Array
    source_start: Array
    active: Array
    slot: Array
    values: Array
    marks: Array


def shared_slots(active: Array, slot: Array, other: Array) -> Array:
    """(k, 2) slots of the blocks that have memory for both of two bodies, see `Arrangement`."""
    theirs = other[tuple(active.T)]
    ours = slot[tuple(active.T)]
    both = theirs >= 0
    return np.stack([ours[both], theirs[both]], axis=-1)


def meet(
    slots: Array, one: Side, other: Side, origin: Array, spacing: float, dt: float, rule: tuple[int, float]
) -> None:
    """Contact of two bodies in a step: the velocities of nodes that both have matter at, in place.

    Parameters
    ----------
    slots : (k, 2) int array
        See `shared_slots`.
    one, other : Side
        Their values are written.
    origin : (3,) float64 array
        See `Domain`.
    spacing : float
        See `Domain`.
    dt : float
        Seconds.
    rule : tuple
        Contact, an index of `contact.CONTACTS`, and Coulomb's coefficient.
    """
    over_range(_meet, len(slots), slots, one, other, origin, spacing, dt, *rule)


@inlined
def _slopes(f):  # type: ignore[no-untyped-def]
    """Derivatives of `weights_of` by where the particle is, per spacing."""
    return f - _ONE_HALF, np.float32(-2.0) * f + np.float32(2.0), f - _HALF


@inlined
def _moved_normal(side, p):  # type: ignore[no-untyped-def]
    """Normal of the surface near a particle: that at rest by the cofactors of the deformation gradient; 0 for none."""
    x, y, z = side.rim[p, 0], side.rim[p, 1], side.rim[p, 2]
    if x == _ZERO and y == _ZERO and z == _ZERO:
        return x, y, z
    f = side.gradient[p, side.first : side.first + 9]
    one = np.float32(1.0)
    a, b, c, d, e, g, h, i, j = one + f[0], f[1], f[2], f[3], one + f[4], f[5], f[6], f[7], one + f[8]
    return (
        (e * j - g * i) * x + (g * h - d * j) * y + (d * i - e * h) * z,
        (c * i - b * j) * x + (a * j - c * h) * y + (b * h - a * i) * z,
        (b * g - c * e) * x + (c * d - a * g) * y + (a * e - b * d) * z,
    )


@inlined
def _length(side, s):  # type: ignore[no-untyped-def]
    """Particles in the blocks around a slot."""
    count = 0
    for q in range(side.source_start[s], side.source_start[s + 1]):
        b = side.source[q] // 27
        count += side.start[b + 1] - side.start[b]
    return count


@njit
def _gather(side, s, origin, scale, shared, found, outward):  # type: ignore[no-untyped-def]
    """List the particles that a slot's nodes feel, and add what they say of the way out of their body at shared nodes.

    That is twice three numbers: how their volume at the node changes as they move, and normals of the surface at rest
    that have moved with them.
    """
    cx, cy, cz = 4 * side.active[s, 0], 4 * side.active[s, 1], 4 * side.active[s, 2]
    count = 0
    for q in range(side.source_start[s], side.source_start[s + 1]):
        b = side.source[q] // 27
        for p in range(side.start[b], side.start[b + 1]):
            if side.motion[p, MASS] == _ZERO:
                continue
            i, j, k, fx, fy, fz = cell_of(side.x, p, origin, scale)
            i, j, k = i - cx, j - cy, k - cz
            if not (-3 < i < 4 and -3 < j < 4 and -3 < k < 4):
                continue
            wx, wy, wz = weights_of(fx), weights_of(fy), weights_of(fz)
            sx, sy, sz = _slopes(fx), _slopes(fy), _slopes(fz)
            n0, n1, n2 = _moved_normal(side, p)
            near = False
            for ii in range(max(0, -i), min(3, 4 - i)):
                for jj in range(max(0, -j), min(3, 4 - j)):
                    for kk in range(max(0, -k), min(3, 4 - k)):
                        n = ((i + ii) * 4 + j + jj) * 4 + k + kk
                        if shared[n]:
                            near = True
                            v = side.motion[p, VOLUME]
                            outward[n, 0] += v * sx[ii] * wy[jj] * wz[kk]
                            outward[n, 1] += v * wx[ii] * sy[jj] * wz[kk]
                            outward[n, 2] += v * wx[ii] * wy[jj] * sz[kk]
                            w = wx[ii] * wy[jj] * wz[kk]
                            outward[n, 3] += w * n0
                            outward[n, 4] += w * n1
                            outward[n, 5] += w * n2
            if near:
                found[count] = p
                count += 1
    return count


@njit
def _reach(side, s, origin, scale, counts, found, normals, sign, reach):  # type: ignore[no-untyped-def]
    """How far the particles that a shared node feels reach along its normals times `sign`, in spacings from it."""
    cx, cy, cz = 4 * side.active[s, 0], 4 * side.active[s, 1], 4 * side.active[s, 2]
    for p in found:
        rim = side.rim[p, 3]
        i, j, k, fx, fy, fz = cell_of(side.x, p, origin, scale)
        i, j, k = i - cx, j - cy, k - cz
        for ii in range(max(0, -i), min(3, 4 - i)):
            for jj in range(max(0, -j), min(3, 4 - j)):
                for kk in range(max(0, -k), min(3, 4 - k)):
                    n = ((i + ii) * 4 + j + jj) * 4 + k + kk
                    if counts[n] > 0:
                        for c in range(counts[n]):
                            x, y, z = normals[n, c, 0], normals[n, c, 1], normals[n, c, 2]
                            reach[n, c] = max(reach[n, c], rim + sign * ((fx - ii) * x + (fy - jj) * y + (fz - kk) * z))


@inlined
def _candidates(one, other, normals):  # type: ignore[no-untyped-def]
    """Unit normals from one body to another: by the surfaces of each, and by the volumes of one, the other and both.

    Parameters
    ----------
    one, other : (6,) float64 array
        What `_gather` has found of each at a node.
    normals : (CANDIDATES, 3) float64 array
        Written: those that differ.

    Returns
    -------
    count : int64
        How many these are.
    flat : bool
        Whether the normals of the two bodies agree.
    """
    count, flat, before = 0, False, (0.0, 0.0, 0.0)
    for c in range(CANDIDATES):
        m, w, o = _SHARES[c][0], _SHARES[c][1], _SHARES[c][2]
        x = m * one[o] - w * other[o]
        y = m * one[o + 1] - w * other[o + 1]
        z = m * one[o + 2] - w * other[o + 2]
        length = np.sqrt(x * x + y * y + z * z)
        per = 1.0 / length if length > 0.0 else 0.0
        x, y, z = per * x, per * y, per * z
        if c == 1 or c == 3:
            flat = flat or x * before[0] + y * before[1] + z * before[2] > _FLAT
        before = x, y, z
        known = length <= 0.0
        for k in range(count):
            known = known or x * normals[k, 0] + y * normals[k, 1] + z * normals[k, 2] > _SAME
        if not known:
            normals[count, 0], normals[count, 1], normals[count, 2] = x, y, z
            count += 1
    return count, flat


@inlined
def _nearing(one, other, normals, count):  # type: ignore[no-untyped-def]
    """Whether two velocities bring bodies nearer along any of their normals."""
    x, y, z = other[0] - one[0], other[1] - one[1], other[2] - one[2]
    found = False
    for c in range(count):
        found = found or x * normals[c, 0] + y * normals[c, 1] + z * normals[c, 2] < 0.0
    return found


@inlined
def _most_apart(top, bottom, count):  # type: ignore[no-untyped-def]
    """The normal along which bodies are farthest apart, and how far, in spacings: what separates them best.

    At the edge of a body that lies on another, its own normal leans over.
    """
    best, gap = -1, -np.inf
    for c in range(count):
        if -bottom[c] - top[c] > gap + _ALIKE:
            best, gap = c, -bottom[c] - top[c]
    return best, gap


@inlined
def _after(relative, normal, gap, flat, spacing, dt, contact, friction):  # type: ignore[no-untyped-def]
    """Relative velocity of two bodies after contact: they come no nearer in the step than they are apart."""
    rx, ry, rz = relative
    nx, ny, nz = normal
    along = rx * nx + ry * ny + rz * nz
    held = contact == 1 and flat and gap < _SLIPS * spacing
    if contact == 2 and gap < _STICKS * spacing:
        return 0.0, 0.0, 0.0
    limit = -max(gap, 0.0) / dt
    if held:
        limit = min(0.0, max(limit, along)) if gap > 0.0 else 0.0
    elif along >= limit:
        return rx, ry, rz
    tx, ty, tz = rx - along * nx, ry - along * ny, rz - along * nz
    if contact == 0 and friction > 0.0:
        speed = np.sqrt(tx * tx + ty * ty + tz * tz)
        keep = max(0.0, 1.0 - friction * (limit - along) / speed) if speed > 1e-30 else 0.0
        tx, ty, tz = keep * tx, keep * ty, keep * tz
    return tx + limit * nx, ty + limit * ny, tz + limit * nz


@njit
def _meet(first, last, slots, one, other, origin, spacing, dt, contact, friction):  # type: ignore[no-untyped-def]
    scale = 1.0 / spacing
    most, more = 1, 1
    for q in range(first, last):
        most, more = max(most, _length(one, slots[q, 0])), max(more, _length(other, slots[q, 1]))
    mine, theirs = np.empty(most, np.int64), np.empty(more, np.int64)
    shared, flat, counts = np.empty(64, np.bool_), np.empty(64, np.bool_), np.empty(64, np.int64)
    ahead, behind = np.empty((64, 6)), np.empty((64, 6))
    normals = np.empty((64, CANDIDATES, 3))
    top, bottom = np.empty((64, CANDIDATES)), np.empty((64, CANDIDATES))
    for q in range(first, last):
        s, t = slots[q, 0], slots[q, 1]
        a, b = one.values[s], other.values[t]
        some = False
        for n in range(64):
            shared[n] = a[n, 3] > _ZERO and b[n, 3] > _ZERO
            some = some or shared[n]
        if not some:
            continue
        ahead[:], behind[:] = 0.0, 0.0
        ours = mine[: _gather(one, s, origin, scale, shared, mine, ahead)]
        others = theirs[: _gather(other, t, origin, scale, shared, theirs, behind)]
        for n in range(64):
            counts[n] = 0
            if shared[n]:
                counts[n], flat[n] = _candidates(ahead[n], behind[n], normals[n])
                if contact == 0 and not _nearing(a[n], b[n], normals[n], counts[n]):
                    counts[n] = 0
        top[:], bottom[:] = -np.inf, -np.inf
        _reach(one, s, origin, scale, counts, ours, normals, 1.0, top)
        _reach(other, t, origin, scale, counts, others, normals, -1.0, bottom)
        for n in range(64):
            if counts[n] == 0:
                continue
            best, gap = _most_apart(top[n], bottom[n], counts[n])
            # What a node that is held gives way by: nothing.
            m = 0.0 if len(one.marks) and one.marks[s, n] else 1.0 / a[n, 3]
            w = 0.0 if len(other.marks) and other.marks[t, n] else 1.0 / b[n, 3]
            if m + w == 0.0:
                continue
            rx = np.float64(b[n, 0]) - np.float64(a[n, 0])
            ry = np.float64(b[n, 1]) - np.float64(a[n, 1])
            rz = np.float64(b[n, 2]) - np.float64(a[n, 2])
            out = normals[n, best, 0], normals[n, best, 1], normals[n, best, 2]
            x, y, z = _after((rx, ry, rz), out, gap * spacing, flat[n], spacing, dt, contact, friction)
            x, y, z = (x - rx) / (m + w), (y - ry) / (m + w), (z - rz) / (m + w)
            a[n, 0], a[n, 1], a[n, 2] = a[n, 0] - m * x, a[n, 1] - m * y, a[n, 2] - m * z
            b[n, 0], b[n, 1], b[n, 2] = b[n, 0] + w * x, b[n, 1] + w * y, b[n, 2] + w * z
