"""Generalised moving least squares (GMLS): points carried along by particles that know their deformation gradient.

Algorithm 2 of the DR-GS paper, after Martin et al. 2010, in a form that is exact for affine motion with any number of
neighbours in any position and, with enough of them, for quadratic motion: values and gradients of the neighbours are
blended with

    N_k = w_k (1 + dX_k^T (C + r 1)^-1 (y - Xb)),    Q_k = N_k (d_k + sum_m N_m d_m) / 2,
    F = sum N_k F_k,    y' = sum N_k x_k + sum F_k Q_k,

where Xb is the weighted mean of the X_k, dX_k = X_k - Xb, C = sum w_k dX_k dX_k^T, d_k = y - X_k. As sum N_k = 1, an
affine map of the neighbours maps y alike. N and Q depend on the rest shape alone; a frame
is a gather. (The formula as printed fails away from the origin and in flat neighbourhoods.)
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.simd import LANES, aligned, fold, lanes, load, quads, repeat, spread
from ..compute.threads import ELEMENTS, checkpoint, over_range
from ..core.errors import UsageError
from ..geometry.occupancy import Volume, crosses_gap

Array = np.ndarray
log = logging.getLogger(__name__)

#: Neighbours of a point, and how far beyond them are looked at to replace those across a gap.
NEIGHBOURS = 16
_CANDIDATES = 3
#: Points whose neighbours are found at once.
_ROWS = 1 << 17
#: Width of the weights: the distance to the last neighbour over this.
_WIDTH = 1.5
#: r = RIDGE * sigma^2
RIDGE = 0.01
#: Matter is torn where neighbours have moved apart, or believe to be stretched, this much more than the other says.
_TORN = 3.0


@dataclass(slots=True)
class Weights:
    """Sources and weights of each of n points; computed once.

    Attributes
    ----------
    source : (n, k) int32 array
        Neighbours, the first one always of use; N and Q are 0 where fewer than k are of use.
    weight : (n, k, 4) float32 array
        Q in metres, and N.
    offset : (n, 3) float32 array
        From the first neighbour to the point, metres.
    reach : (n,) float32 array
        From the first neighbour to the farthest that is of use, metres.
    separated : int
        Number of points that had neighbours across a gap, which are not used.
    stranded : int
        Number of points all of whose neighbours were across a gap, which carry them all the same.
    """

    source: Array
    weight: Array
    offset: Array
    reach: Array
    separated: int = 0
    stranded: int = 0


def bind_points(
    points: Array,
    sources: Array,
    *,
    neighbours: int = NEIGHBOURS,
    space: Volume | None = None,
    parts: Array | None = None,
    point_parts: Array | None = None,
) -> Weights:
    """Find what carries each point along.

    Parameters
    ----------
    points : (n, 3) array
        Metres.
    sources : (s, 3) array
        Metres, at rest.
    neighbours : int
        Used at most.
    space : Volume, optional
        Filled space of which the sources are inside; a neighbour counts only if the way to it stays inside.
    parts : (s,) int array, optional
        Number of the connected part of each source; neighbours are all of one part: that of the nearest.
    point_parts : (n,) int array, optional
        Overrides the part; -1 leaves it to the nearest.

    Raises
    ------
    UsageError
        There are no sources.
    """
    from scipy.spatial import cKDTree  # an engine starts without

    points = np.ascontiguousarray(points, np.float64)
    sources = np.ascontiguousarray(sources, np.float64)
    if not len(sources):
        raise UsageError("sources", "are none: nothing can carry the points along", "Fill the mesh, or choose a mesh")
    tree, n, count = cKDTree(sources), len(points), min(neighbours, len(sources))
    parts, point_parts = (None if p is None else np.asarray(p) for p in (parts, point_parts))
    found = Weights(
        np.empty((n, count), np.int32), np.empty((n, count, 4), np.float32), np.empty((n, 3), np.float32),
        np.zeros(n, np.float32),
    )  # fmt: skip
    for first in range(0, n, _ROWS):  # bounds memory
        checkpoint()
        rows = slice(first, first + _ROWS)
        some = points[rows]
        own = None if point_parts is None else point_parts[rows]
        index, distance, separated, stranded = _neighbours(tree, some, sources, count, space, parts, own)
        found.separated, found.stranded = found.separated + separated, found.stranded + stranded
        over_range(_weigh, len(some), some, sources, index, distance, found.weight[rows], found.reach[rows])
        found.offset[rows] = some - sources[index[:, 0]]
        # What is of no use must not be taken for one that moved apart.
        found.source[rows] = np.where(distance < 0.0, index[:, :1], index)
    if found.stranded:
        log.info("%d points lie beyond a gap from all particles near them", found.stranded)
    return found


def _neighbours(
    tree: Any, points: Array, sources: Array, count: int, space: Volume | None, parts: Array | None,
    own: Array | None,
) -> tuple[Array, Array, int, int]:  # fmt: skip
    """`count` neighbours of each point, their distances (-1: of no use); how many are separated, and stranded."""
    many = min(_CANDIDATES * count, len(sources)) if space is not None or parts is not None else count
    distance, index = (a.reshape(len(points), many) for a in tree.query(points, k=many, workers=-1))
    same = np.ones(index.shape, bool)
    if parts is not None:
        nearest = parts[index[:, 0]]
        same = parts[index] == (nearest if own is None else np.where(own >= 0, own, nearest))[:, None]
        same[~same.any(axis=1), 0] = True
    usable = same if space is None else same & ~crosses_gap(space, points, sources, index)
    stranded = ~usable.any(axis=1)
    usable[stranded] = same[stranded]
    separated = ~usable[:, :count].all(axis=1)
    # The nearest usable ones first; what is left over has no weight.
    order = np.argsort(~usable, axis=1, kind="stable")[:, :count]
    index = np.take_along_axis(index, order, 1)
    distance = np.where(np.take_along_axis(usable, order, 1), np.take_along_axis(distance, order, 1), -1.0)
    return index, distance, int(separated.sum()), int(stranded.sum())


@inlined
def _squared(x, a, b):  # type: ignore[no-untyped-def]
    """Squared distance between two rows."""
    return (x[a, 0] - x[b, 0]) ** 2 + (x[a, 1] - x[b, 1]) ** 2 + (x[a, 2] - x[b, 2]) ** 2


@njit
def _weigh(first, last, points, sources, index, distance, weight, reach):  # type: ignore[no-untyped-def]
    """N, Q and reach of each point; a neighbour with a negative distance does not count."""
    count = index.shape[1]
    for i in range(first, last):
        far = 0.0
        for k in range(count):
            far = max(far, distance[i, k])
        sigma = far / _WIDTH + 1e-30
        w = np.zeros(count)
        total = mx = my = mz = 0.0
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        for k in range(count):
            if distance[i, k] >= 0.0:
                w[k] = np.exp(-((distance[i, k] / sigma) ** 2))
                total += w[k]
                reach[i] = max(reach[i], np.float32(np.sqrt(_squared(sources, index[i, k], index[i, 0]))))
        for k in range(count):  # coordinates from the point itself, so that nothing is lost far from the origin
            w[k] /= total
            s = index[i, k]
            mx += w[k] * (sources[s, 0] - px)
            my += w[k] * (sources[s, 1] - py)
            mz += w[k] * (sources[s, 2] - pz)
        r = RIDGE * sigma * sigma
        xx = yy = zz = r
        xy = xz = yz = 0.0
        for k in range(count):
            s = index[i, k]
            x, y, z = sources[s, 0] - px - mx, sources[s, 1] - py - my, sources[s, 2] - pz - mz
            xx, yy, zz = xx + w[k] * x * x, yy + w[k] * y * y, zz + w[k] * z * z
            xy, xz, yz = xy + w[k] * x * y, xz + w[k] * x * z, yz + w[k] * y * z
        a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        det = xx * a + xy * b + xz * c
        inverse = 1.0 / det if det > 0.0 else 0.0
        # (C + r 1)^-1 (y - Xb), where y is 0
        gx = -(a * mx + b * my + c * mz) * inverse
        gy = -(b * mx + d * my + e * mz) * inverse
        gz = -(c * mx + e * my + f * mz) * inverse
        sx = sy = sz = 0.0
        for k in range(count):
            s = index[i, k]
            x, y, z = sources[s, 0] - px, sources[s, 1] - py, sources[s, 2] - pz
            n = w[k] * (1.0 + gx * (x - mx) + gy * (y - my) + gz * (z - mz))
            w[k] = n
            sx, sy, sz = sx - n * x, sy - n * y, sz - n * z
        for k in range(count):
            s = index[i, k]
            weight[i, k, 0] = 0.5 * w[k] * (px - sources[s, 0] + sx)
            weight[i, k, 1] = 0.5 * w[k] * (py - sources[s, 1] + sy)
            weight[i, k, 2] = 0.5 * w[k] * (pz - sources[s, 2] + sz)
            weight[i, k, 3] = w[k]


def carry(weights: Weights, x: Array, gradients: Array) -> tuple[Array, Array, int]:
    """Move points.

    Parameters
    ----------
    weights : Weights
    x : (s, 3) float32 or float64 array
        Metres: the sources now.
    gradients : (s, 3, 3) float32 array
        Their deformation gradients since they were bound.

    Returns
    -------
    points : (n, 3) array
        Of the type of x.
    gradients : (n, 3, 3) float32 array
    turned : int
        Points where blending would have turned matter inside out or spanned a tear; the nearest neighbour alone
        carries those, stretched no more than the neighbours have moved apart.
    """
    x = np.ascontiguousarray(x)
    rows, centre = pack(x, gradients)
    points, out, turned = blank(weights, x.dtype)
    weight = weights.weight.reshape(-1)
    over_range(
        _carry,
        len(weights.source),
        (weights.source, weight, weights.offset, weights.reach),
        rows.reshape(-1),
        centre,
        points,
        out,
        turned,
        fewest=ELEMENTS,
    )
    return points, out, int(np.count_nonzero(turned))


def blank(weights: Weights, kind: np.dtype) -> tuple[Array, Array, Array]:
    """Memory for what `carry` returns, and for whether each point is `turned`."""
    n = len(weights.source)
    return np.empty((n, 3), kind), np.empty((n, 3, 3), np.float32), np.zeros(n, np.bool_)


def pack(x: Array, gradients: Array) -> tuple[Array, Array]:
    """Sources as they are read.

    Returns
    -------
    rows : (s, 16) float32 array
        A cache line each: the columns of its gradient and its place, each with a free one.
    centre : (3,) float64 array
        From which places are.
    """
    centre = _centre(x)
    rows = aligned(LANES * len(x), np.float32)
    over_range(
        _pack, len(x), x, np.ascontiguousarray(gradients, np.float32).reshape(-1, 3, 3), centre, rows, fewest=ELEMENTS
    )
    return rows.reshape(-1, LANES), centre


@njit
def _centre(x):  # type: ignore[no-untyped-def]
    """(3,) float64 mean of the positions that are finite."""
    total, count = np.zeros(3), 0
    for i in range(len(x)):
        a, b, c = np.float64(x[i, 0]), np.float64(x[i, 1]), np.float64(x[i, 2])
        if np.isfinite(a + b + c):
            total[0], total[1], total[2] = total[0] + a, total[1] + b, total[2] + c
            count += 1
    return total / max(count, 1)


@njit
def _pack(first, last, x, gradients, centre, rows):  # type: ignore[no-untyped-def]
    for s in range(first, last):
        row = LANES * s
        for c in range(3):
            for j in range(3):
                rows[row + 4 * j + c] = gradients[s, c, j]
            rows[row + 12 + c] = np.float32(x[s, c] - centre[c])


@njit
def _determinant(f):  # type: ignore[no-untyped-def]
    return f[0] * (f[4] * f[8] - f[5] * f[7]) - f[1] * (f[3] * f[8] - f[5] * f[6]) + f[2] * (f[3] * f[7] - f[4] * f[6])


@njit
def _squares(f):  # type: ignore[no-untyped-def]
    """Their sum."""
    return (
        f[0] * f[0] + f[1] * f[1] + f[2] * f[2] + f[3] * f[3] + f[4] * f[4] + f[5] * f[5] + f[6] * f[6] + f[7] * f[7]
        + f[8] * f[8]
    )  # fmt: skip


@njit
def _columns(a):  # type: ignore[no-untyped-def]
    """A matrix, row by row, of a vector that holds it column by column."""
    return a[0], a[4], a[8], a[1], a[5], a[9], a[2], a[6], a[10]


@njit
def settled(f, p, g, offset, apart, reach):  # type: ignore[no-untyped-def]
    """A point as the blend has it, or where matter is torn or inside out as its nearest neighbour has it.

    Parameters
    ----------
    f : tuple of float
        The blended gradient, row by row.
    p : tuple of float
        The blended place, from the nearest neighbour.
    g : tuple of float
        Gradient of the nearest neighbour.
    offset : (3,) array
        The point from it at rest.
    apart : float
        From it to the farthest neighbour now, squared.
    reach : float
        The same at rest, not squared.

    Returns
    -------
    f, p : tuple of float
        The deformation gradient and the position to use.
    turned : bool
        Whether they are the nearest neighbour's.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    own, blended = _squares(g), _squares(f)
    grown, believed = np.sqrt(apart) / max(reach, np.float32(1e-30)), np.sqrt(own / np.float32(3.0))
    most = np.sqrt(max(own, blended) / np.float32(3.0))
    torn = reach > zero and max(grown, most / max(grown, np.float32(1e-30))) > np.float32(_TORN)
    turned = torn or (not (_determinant(f) > zero) and _determinant(g) > zero)
    if turned:
        keep = min(one, max(grown, one) / believed) if torn and believed > zero else one
        f = (
            keep * g[0], keep * g[1], keep * g[2], keep * g[3], keep * g[4], keep * g[5], keep * g[6],
            keep * g[7], keep * g[8],
        )  # fmt: skip
        x, y, z = offset
        p = f[0] * x + f[1] * y + f[2] * z, f[3] * x + f[4] * y + f[5] * z, f[6] * x + f[7] * y + f[8] * z
    return f, p, turned


@njit
def _carry(first, last, weights, rows, centre, points, out, turned):  # type: ignore[no-untyped-def]
    source, weight, offset, reach = weights
    zero, one = np.float32(0.0), np.float32(1.0)
    for i in range(first, last):
        nearest = LANES * source[i, 0]
        ox, oy, oz = rows[nearest + 12], rows[nearest + 13], rows[nearest + 14]
        # Relative to the first neighbour: N sums to 1 in exact arithmetic alone.
        origin = quads(zero, zero, zero, one) * repeat(ox, oy, oz, zero)
        place = gradient = spread(zero)
        apart = zero
        w = 4 * i * source.shape[1]
        for k in range(source.shape[1]):
            s = LANES * source[i, k]
            row = load(rows, s) - origin
            n = weight[w + 3]
            place = place + quads(weight[w], weight[w + 1], weight[w + 2], n) * row  # F Q + N x, column by column
            gradient = gradient + n * row
            dx, dy, dz = rows[s + 12] - ox, rows[s + 13] - oy, rows[s + 14] - oz
            apart = max(apart, dx * dx + dy * dy + dz * dz)
            w += 4
        px, py, pz, _ = fold(place)
        f, g = _columns(lanes(gradient)), _columns(lanes(load(rows, nearest)))
        q = offset[i, 0], offset[i, 1], offset[i, 2]
        f, p, turned[i] = settled(f, (px, py, pz), g, q, apart, reach[i])
        out[i, 0, 0], out[i, 0, 1], out[i, 0, 2] = f[0], f[1], f[2]
        out[i, 1, 0], out[i, 1, 1], out[i, 1, 2] = f[3], f[4], f[5]
        out[i, 2, 0], out[i, 2, 1], out[i, 2, 2] = f[6], f[7], f[8]
        px, py, pz = p
        points[i, 0], points[i, 1], points[i, 2] = centre[0] + (ox + px), centre[1] + (oy + py), centre[2] + (oz + pz)
