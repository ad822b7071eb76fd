"""Generalised moving least squares: points carried along by particles that know their deformation gradient.

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

import numpy as np
from scipy.spatial import cKDTree

from ..errors import UsageError
from ..jit import njit, prange
from ..volume import Volume, crosses_gap

Array = np.ndarray
log = logging.getLogger(__name__)

#: Neighbours of a point, and how far beyond them are looked at to replace those across a gap.
NEIGHBOURS = 16
_CANDIDATES = 3
#: Width of the weights: the distance to the last neighbour over this.
_WIDTH = 1.5
#: r = RIDGE * sigma^2
RIDGE = 0.01
#: Matter is torn where neighbours have moved apart, or believe to be stretched, this much more than the other says.
_TORN = 3.0


@dataclass(slots=True)
class Weights:
    """What carries each of n points along; computed once.

    Attributes
    ----------
    source : (n, k) int32, neighbours, the first one always of use; N and Q are 0 where fewer than k are of use
    value : (n, k) float32, N
    slope : (n, k, 3) float32, Q, metres
    offset : (n, 3) float32, from the first neighbour to the point, metres
    reach : (n,) float32, from the first neighbour to the farthest that is of use, metres
    separated : number of points that had neighbours across a gap, which are not used
    stranded : number of points all of whose neighbours were across a gap; the nearest carries them
    """

    source: Array
    value: Array
    slope: Array
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
    points : (n, 3) metres
    sources : (s, 3) metres, at rest
    neighbours : used at most
    space : filled space of which the sources are inside; a neighbour counts only if the way to it stays inside
    parts : (s,) int, number of the connected part of each source; neighbours are all of one part: that of the nearest
    point_parts : (n,) int, overrides the part; -1 leaves it to the nearest

    Raises
    ------
    UsageError
        There are no sources.
    """
    points = np.ascontiguousarray(points, np.float64)
    sources = np.ascontiguousarray(sources, np.float64)
    if not len(sources):
        raise UsageError("sources", "are none: nothing can carry the points along", "Fill the mesh, or choose a mesh")
    wanted = min(neighbours, len(sources))
    many = min(_CANDIDATES * wanted, len(sources)) if space is not None or parts is not None else wanted
    distance, index = cKDTree(sources).query(points, k=many, workers=-1)
    distance, index = distance.reshape(len(points), many), index.reshape(len(points), many)
    usable = np.ones(index.shape, bool)
    if parts is not None:
        own = np.asarray(parts)[index[:, 0]]
        if point_parts is not None:
            own = np.where(np.asarray(point_parts) >= 0, point_parts, own)
        usable &= np.asarray(parts)[index] == own[:, None]
    if space is not None:
        usable &= ~crosses_gap(space, points, sources, index)
    stranded = ~usable.any(axis=1)
    usable[stranded, 0] = True
    separated = int(np.count_nonzero(~usable[:, :wanted].all(axis=1)))
    if stranded.any():
        log.info("%d points lie beyond a gap from all particles near them", np.count_nonzero(stranded))

    # The nearest usable ones first; what is left over has no weight.
    order = np.argsort(~usable, axis=1, kind="stable")[:, :wanted]
    index = np.take_along_axis(index, order, 1)
    distance = np.where(np.take_along_axis(usable, order, 1), np.take_along_axis(distance, order, 1), -1.0)
    value = np.empty(index.shape, np.float32)
    slope = np.empty((*index.shape, 3), np.float32)
    reach = np.zeros(len(points), np.float32)
    _weigh(points, sources, index, distance, value, slope, reach)
    offset = (points - sources[index[:, 0]]).astype(np.float32)
    index = np.where(distance < 0.0, index[:, :1], index)  # of no use, and not to be taken for one that moved apart
    return Weights(index.astype(np.int32), value, slope, offset, reach, separated, int(stranded.sum()))


@njit(inline="always")
def _squared(x, a, b):  # type: ignore[no-untyped-def]
    """Squared distance between two rows."""
    return (x[a, 0] - x[b, 0]) ** 2 + (x[a, 1] - x[b, 1]) ** 2 + (x[a, 2] - x[b, 2]) ** 2


@njit(parallel=True)
def _weigh(points, sources, index, distance, value, slope, reach):  # type: ignore[no-untyped-def]
    """N, Q and reach of each point; a neighbour with a negative distance does not count."""
    count = index.shape[1]
    for i in prange(len(points)):
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
            value[i, k] = w[k]
            slope[i, k, 0] = 0.5 * w[k] * (px - sources[s, 0] + sx)
            slope[i, k, 1] = 0.5 * w[k] * (py - sources[s, 1] + sy)
            slope[i, k, 2] = 0.5 * w[k] * (pz - sources[s, 2] + sz)


def carry(weights: Weights, x: Array, gradients: Array) -> tuple[Array, Array, int]:
    """Move points.

    Parameters
    ----------
    x : (s, 3) float32 or float64, metres: the sources now
    gradients : (s, 3, 3) float32: their deformation gradients since they were bound

    Returns
    -------
    points : (n, 3) of the type of x
    gradients : (n, 3, 3) float32
    turned : int
        Points where blending would have turned matter inside out or spanned a tear; the nearest neighbour alone
        carries those, stretched no more than the neighbours have moved apart.
    """
    n = len(weights.source)
    x = np.ascontiguousarray(x)
    points, out = np.empty((n, 3), x.dtype), np.empty((n, 9), np.float32)
    turned = np.zeros(n, np.bool_)
    flat = np.ascontiguousarray(gradients, np.float32).reshape(-1, 9)
    _carry(weights.source, weights.value, weights.slope, weights.offset, weights.reach, x, flat, points, out, turned)
    return points, out.reshape(n, 3, 3), int(np.count_nonzero(turned))


@njit(inline="always")
def _determinant(f, i):  # type: ignore[no-untyped-def]
    return (
        f[i, 0] * (f[i, 4] * f[i, 8] - f[i, 5] * f[i, 7])
        - f[i, 1] * (f[i, 3] * f[i, 8] - f[i, 5] * f[i, 6])
        + f[i, 2] * (f[i, 3] * f[i, 7] - f[i, 4] * f[i, 6])
    )


@njit(parallel=True)
def _carry(source, value, slope, offset, reach, x, gradients, points, out, turned):  # type: ignore[no-untyped-def]
    for i in prange(len(source)):
        first = source[i, 0]
        ox, oy, oz = x[first, 0], x[first, 1], x[first, 2]
        px = py = pz = 0.0
        f0 = f1 = f2 = f3 = f4 = f5 = f6 = f7 = f8 = np.float32(0.0)
        apart = 0.0
        for k in range(source.shape[1]):
            s, n = source[i, k], value[i, k]
            g0, g1, g2 = gradients[s, 0], gradients[s, 1], gradients[s, 2]
            g3, g4, g5 = gradients[s, 3], gradients[s, 4], gradients[s, 5]
            g6, g7, g8 = gradients[s, 6], gradients[s, 7], gradients[s, 8]
            qx, qy, qz = slope[i, k, 0], slope[i, k, 1], slope[i, k, 2]
            # Relative to the first neighbour: N sums to 1 in exact arithmetic alone.
            dx, dy, dz = x[s, 0] - ox, x[s, 1] - oy, x[s, 2] - oz
            px += n * dx + (g0 * qx + g1 * qy + g2 * qz)
            py += n * dy + (g3 * qx + g4 * qy + g5 * qz)
            pz += n * dz + (g6 * qx + g7 * qy + g8 * qz)
            f0, f1, f2 = f0 + n * g0, f1 + n * g1, f2 + n * g2
            f3, f4, f5 = f3 + n * g3, f4 + n * g4, f5 + n * g5
            f6, f7, f8 = f6 + n * g6, f7 + n * g7, f8 + n * g8
            apart = max(apart, dx * dx + dy * dy + dz * dz)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = f0, f1, f2, f3, f4
        out[i, 5], out[i, 6], out[i, 7], out[i, 8] = f5, f6, f7, f8
        own = blended = 0.0
        for c in range(9):
            own += gradients[first, c] * gradients[first, c]
            blended += out[i, c] * out[i, c]
        grown, believed = np.sqrt(apart) / max(reach[i], np.float32(1e-30)), np.sqrt(own / 3.0)
        most = np.sqrt(max(own, blended) / 3.0)
        torn = reach[i] > 0.0 and max(grown, most / max(grown, 1e-30)) > _TORN
        if torn or (not (_determinant(out, i) > np.float32(0.0)) and _determinant(gradients, first) > np.float32(0.0)):
            turned[i] = True
            keep = min(1.0, max(grown, 1.0) / believed) if torn and believed > 0.0 else 1.0
            for c in range(9):
                out[i, c] = np.float32(keep) * gradients[first, c]
            qx, qy, qz = offset[i, 0], offset[i, 1], offset[i, 2]
            px = np.float64(out[i, 0] * qx + out[i, 1] * qy + out[i, 2] * qz)
            py = np.float64(out[i, 3] * qx + out[i, 4] * qy + out[i, 5] * qz)
            pz = np.float64(out[i, 6] * qx + out[i, 7] * qy + out[i, 8] * qz)
        points[i, 0], points[i, 1], points[i, 2] = ox + px, oy + py, oz + pz
