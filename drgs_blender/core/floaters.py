"""Floaters: surfels that a capture left in the air, found without its photographs; numpy alone."""

from __future__ import annotations

import numpy as np

from .asset.model import Array, Asset, Surfels

#: Side of the cells in which surfels are connected, in medians of their larger deviation.
CELL = 3.0
#: A part with less of the largest part's area than this is in the air.
PART = 0.01
#: Surfels with fewer in their cell and those around it than this part of the median stand alone.
SPARSE = 0.04
#: Deviations from the mesh, in medians of the larger deviation, beyond which a surfel that stands alone is in the air.
OFF = 3.0
#: A surfel that is larger than this many medians is no detail.
WIDE = 8.0
#: Fainter ones are haze where they stand alone.
FAINT = 0.3


def find_floaters(surfels: Surfels, away: Array | None = None, strength: float = 1.0) -> Array:
    """(n,) bool: which surfels are in the air.

    These are surfels of small parts, which nothing connects with the rest, and those that stand alone (few are around)
    and are faint, wide, or away from the mesh.

    Parameters
    ----------
    surfels : Surfels
    away : (n,) float array, optional
        Metres from the mesh.
    strength : float
        1 is usual; larger finds more.
    """
    if not len(surfels):
        return np.zeros(0, bool)
    size = _larger(surfels)
    typical = max(median_size(surfels), 1e-12)
    place, cells = _cells(surfels.centre, CELL * typical)
    area = surfels.opacity * surfels.scale.prod(axis=1)
    solid = size < WIDE * typical
    total = np.bincount(place, np.where(solid, area, 0), len(cells))
    first, second = _neighbours(cells)
    part = connected_parts(len(cells), first, second)
    of_part = np.bincount(part, total, len(cells))
    small = (of_part < strength * PART * of_part.max())[part][place]
    count = np.bincount(place, minlength=len(cells)).astype(np.float64)
    around = count + np.bincount(first, count[second], len(cells)) + np.bincount(second, count[first], len(cells))
    alone = around[place] < strength * SPARSE * np.median(around[place])
    doubtful = (surfels.opacity < FAINT) | ~solid
    if away is not None:
        doubtful |= away > OFF / strength * typical
    return small | (alone & doubtful)


def median_size(surfels: Surfels) -> float:
    """Median of the larger deviation of surfels, metres; 0 of none."""
    return float(np.median(_larger(surfels))) if len(surfels) else 0.0


def _larger(surfels: Surfels) -> Array:
    """(n,) larger deviations; numpy's own maximum of rows of two takes five times as long."""
    return np.maximum(surfels.scale[:, 0], surfels.scale[:, 1])


def distance_from_mesh(asset: Asset) -> Array | None:
    """(n,) metres of the surfels from the place where each hangs on the mesh, at rest; None of unbound ones."""
    binding, mesh = asset.binding, asset.mesh
    if binding is None:
        return None
    vertices, away = mesh.vertices.astype(np.float64), asset.surfels.centre.astype(np.float64)
    for weight, corner in zip(binding.barycentric.clip(0, 1).T, mesh.faces.T, strict=True):
        away -= weight[:, None] * vertices[corner[binding.face]]
    return lengths(away)


def lengths(vectors: Array) -> Array:
    """(n,) of (n, 3) float64 vectors."""
    return np.sqrt(np.einsum("nc,nc->n", vectors, vectors))


def connected_parts(count: int, first: Array, second: Array) -> Array:
    """(count,) int64: the lowest number of those that each of `count` is connected with, by pairs (first, second)."""
    parent = np.arange(count)
    while True:
        a, b = parent[first], parent[second]
        apart = a != b
        if not apart.any():
            return parent
        np.minimum.at(parent, np.maximum(a, b)[apart], np.minimum(a, b)[apart])
        while not np.array_equal(parent, parent[parent]):
            parent = parent[parent]


def _cells(places: Array, side: float) -> tuple[Array, Array]:
    """The cell of each of (n, 3) places, by number, and the (k,) int64 packed cells that hold any, sorted."""
    found = np.floor((places.astype(np.float64) - np.median(places, axis=0)) / side).clip(-(2**19), 2**19 - 2)
    found = found.astype(np.int64)
    low = found.min(axis=0)
    shape = found.max(axis=0) - low + 1
    if shape.prod() > 8 * len(places) + 4096:
        cells, place = np.unique(_packed(found), return_inverse=True)
        return place.reshape(-1), cells
    at = np.ravel_multi_index(tuple((found - low).T), tuple(shape))  # few of the grid are empty: no sorting
    holds = np.bincount(at, minlength=shape.prod()) > 0
    cells = np.stack(np.unravel_index(np.flatnonzero(holds), tuple(shape)), axis=1) + low
    return (np.cumsum(holds) - 1)[at], _packed(cells)


def _packed(cells: Array) -> Array:
    """(n,) int64: one number of three, each from -2^20 to 2^20."""
    return ((cells[:, 0] + 2**20) << 42) | ((cells[:, 1] + 2**20) << 21) | (cells[:, 2] + 2**20)


def _neighbours(cells: Array) -> tuple[Array, Array]:
    """Pairs of neighbours among sorted packed cells, each once."""
    steps = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)]
    first, second = [], []
    for x, y, z in steps:
        wanted = cells + ((x << 42) + (y << 21) + z)
        at = np.searchsorted(cells, wanted).clip(max=len(cells) - 1)
        there = np.flatnonzero(cells[at] == wanted)
        first.append(there)
        second.append(at[there])
    return np.concatenate(first), np.concatenate(second)
