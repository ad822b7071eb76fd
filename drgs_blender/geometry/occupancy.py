"""Voxel occupancy of a solid, with a line-of-sight test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..compute.jit import njit
from ..compute.threads import ELEMENTS, over_range

Array = np.ndarray

#: Neighbours of which the farthest gives the spacing: on a grid the first six are one step away, and the nearest is not
#: nearer than this share of it.
_AROUND, _REGULAR = 6, 0.9
#: Points whose neighbours are looked at.
_PROBES = 4096
#: Side of the cells that points in no order fill, in spacings.
_CELL = 1.5
#: Cells at most.
_MOST = 1 << 26


@dataclass(frozen=True, slots=True)
class Volume:
    """Cells of space that matter fills.

    Attributes
    ----------
    origin : (3,) float64 array
        Metres: lowest corner of cell (0, 0, 0).
    spacing : float
        Metres, side of a cell.
    part : (nx, ny, nz) int32 array
        Number of the connected part a cell belongs to, -1 outside.
    """

    origin: Array
    spacing: float
    part: Array

    def centres(self) -> Array:
        """(n, 3) float64 centres of the filled cells, in the order of ``part[part >= 0]``."""
        return self.origin + (np.argwhere(self.part >= 0) + 0.5) * self.spacing


def spacings(points: Array) -> tuple[float, float]:
    """Metres from one of (n, 3) points to the nearest other and to the `_AROUND`th, in the median; 0 for one alone."""
    if len(points) < 2:
        return 0.0, 0.0
    from scipy.spatial import cKDTree  # an engine starts without

    points = np.asarray(points, np.float64)
    probes = points[:: max(len(points) // _PROBES, 1)]
    neighbours = min(_AROUND + 1, len(points))
    distance = cKDTree(points).query(probes, k=neighbours, workers=-1)[0]
    return float(np.median(distance[:, 1])), float(np.median(distance[:, -1]))


def volume_of(points: Array, nearest: float, around: float) -> Volume | None:
    """The space that points fill.

    Parameters
    ----------
    points : (n, 3) float array
        Metres.
    nearest, around : float
        Their `spacings`.

    Returns
    -------
    Volume or None
        Cells that have a point: of the spacing of points on a grid, wider among others, so that next to none between
        neighbours is left out. None where all points are in one place.
    """
    from scipy import ndimage

    points = np.asarray(points, np.float64)
    if around <= 0:
        return None
    side = around if nearest > _REGULAR * around else _CELL * around
    with np.errstate(over="ignore"):
        cells = np.ceil(np.ptp(points, axis=0) / side) + 3
    side *= max(1.0, float(np.prod(cells / _MOST ** (1 / 3))) ** (1 / 3) * 1.01)
    origin = points.min(axis=0) - 1.5 * side
    size = np.ceil((points.max(axis=0) - origin) / side).astype(np.int64) + 2
    filled = np.zeros(size, bool)
    filled[tuple(((points - origin) / side).astype(np.int64).T)] = True
    part = ndimage.label(filled, np.ones((3, 3, 3)))[0].astype(np.int32) - 1
    return Volume(origin, side, part)


@njit
def _crossings(first, last, points, starts, chosen, part, origin, spacing, reach, out):  # type: ignore[no-untyped-def]
    nx, ny, nz = part.shape
    for i in range(first, last):
        for m in range(chosen.shape[1]):
            k = chosen[i, m]
            dx, dy, dz = points[i, 0] - starts[k, 0], points[i, 1] - starts[k, 1], points[i, 2] - starts[k, 2]
            length = np.sqrt(dx * dx + dy * dy + dz * dz) / spacing
            steps = int(2.0 * (length - reach)) + 1 if length > reach else 0
            empty = False
            for s in range(steps):
                t = 0.5 * (s + 1) / length
                a = int(np.floor((starts[k, 0] + t * dx - origin[0]) / spacing))
                b = int(np.floor((starts[k, 1] + t * dy - origin[1]) / spacing))
                c = int(np.floor((starts[k, 2] + t * dz - origin[2]) / spacing))
                if not (0 <= a < nx and 0 <= b < ny and 0 <= c < nz) or part[a, b, c] < 0:
                    empty = True
            out[i, m] = empty


def crosses_gap(volume: Volume, points: Array, sources: Array, chosen: Array, reach: float = 1.5) -> Array:
    """Whether the straight way from a source to a point leaves the filled space.

    Parameters
    ----------
    volume : Volume
    points : (n, 3) float64 array
        Metres.
    sources : (k, 3) float64 array
        Points in filled cells.
    chosen : (n, m) int array
        Sources to look at from each point.
    reach : float
        Cells before the point that may be empty: a surface lies just outside of what fills it.

    Returns
    -------
    (n, m) bool array
    """
    out = np.empty(chosen.shape, np.bool_)
    ways = [np.ascontiguousarray(a, t) for a, t in ((points, np.float64), (sources, np.float64), (chosen, np.int64))]
    grid = volume.part, volume.origin, volume.spacing
    over_range(_crossings, len(chosen), *ways, *grid, reach, out, fewest=ELEMENTS)
    return out
