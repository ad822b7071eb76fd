"""Faces that only removed surfels covered: they would throw the shadow of nothing; numpy alone."""

from __future__ import annotations

import numpy as np

from .asset.model import Array, Asset
from .floaters import distance_from_mesh, lengths, median_size

#: Medians of the larger deviation within which a surfel covers a face, from it, or from the rim of another one.
REACH = 4.0


def bare_faces(asset: Asset, removed: Array) -> Array:
    """(m,) bool: the faces on which removed surfels alone hang; of those without any, the ones nearest to such.

    The nearest is looked for ring by ring, on the faces around. Surfels in the air cover no face, though they hang
    on it.

    Parameters
    ----------
    asset : Asset
    removed : (k,) int array
        Surfels.
    """
    mesh, binding, away = asset.mesh, asset.binding, distance_from_mesh(asset)
    if binding is None or away is None:
        return np.zeros(len(mesh.faces), bool)
    centre, least = asset.surfels.centre.astype(np.float64), REACH * median_size(asset.surfels)
    vertices = mesh.vertices.astype(np.float64)
    middle = sum(vertices[corner] for corner in mesh.faces.T) / 3
    near = np.flatnonzero(away <= least)
    on = binding.face[near]
    nearest = _nearest(near, on, lengths(centre[near] - middle[on]), len(middle))
    empty = np.flatnonzero(nearest < 0)
    if len(empty):
        corners = vertices[mesh.faces]
        reach = least + np.linalg.norm(corners[empty] - middle[empty, None], axis=2).max(axis=1)
        place = _places(mesh.vertices)[mesh.faces]
    while len(empty):
        known = np.flatnonzero(nearest >= 0)
        known = known[np.isin(place[known], place[empty]).any(axis=1)]
        at = place[known].reshape(-1)
        offered = np.repeat(nearest[known], 3)
        gap = np.linalg.norm(centre[offered] - corners[known].reshape(-1, 3), axis=1)
        offers = _nearest(offered, at, gap, int(place.max()) + 1)[place[empty]]
        gaps = np.linalg.norm(centre[offers] - middle[empty, None], axis=2)
        gaps[(offers < 0) | (gaps > reach[:, None])] = np.inf
        best = gaps.argmin(axis=1)
        found = np.isfinite(gaps.min(axis=1))
        if not found.any():
            break
        nearest[empty[found]] = offers[found, best[found]]
        empty, reach = empty[~found], reach[~found]
    gone = np.zeros(len(centre) + 1, bool)  # the last one is that of faces without any
    gone[removed] = True
    stays = np.zeros(len(middle), bool)  # else what hangs there would go with it
    stays[binding.face[~gone[:-1]]] = True
    return gone[nearest] & ~stays


def _nearest(candidates: Array, of: Array, distance: Array, count: int) -> Array:
    """(count,) int64: the candidate, (k,), with the least distance of those that are `of` each; -1: none is."""
    least = np.full(count, np.inf)
    np.minimum.at(least, of, distance)
    found = np.full(count, -1, np.int64)
    hit = distance == least[of]
    found[of[hit]] = candidates[hit]
    return found


def _places(vertices: Array) -> Array:
    """(n,) int64 number of the place of each vertex: those of seams are at one."""
    order = np.lexsort(vertices.T)
    new = (np.diff(vertices[order], axis=0) != 0).any(axis=1)
    place = np.empty(len(vertices), np.int64)
    place[order] = np.r_[0, np.cumsum(new)]
    return place
