"""Motion of surfels that hang on no mesh: what is seen moves as the surfel nearest to it.

A surfel's scaled tangents at two times say how its plane moves; beside it the normal is followed, as long as the
tangents have become. That is exact where all around is moved, turned and scaled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array, same_bits
from ...core.asset.model import PosedSurfels

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_WRITTEN = "centre", "tangent_u", "tangent_v"


class SurfelState:
    """Surfels of objects without a mesh at one time.

    Parameters
    ----------
    posed : sequence of PosedSurfels
        One for each object, world space.
    """

    def __init__(self, posed: Sequence[PosedSurfels]) -> None:
        self.objects = {int(part.object_index[0]): part for part in posed if len(part)}
        self._trees: dict[int, tuple[cKDTree, Array]] = {}

    def displace(self, then: SurfelState, owner: Array, face: Array, position: Array, previous: Array) -> Array:
        """Find where seen points are at another time.

        Parameters
        ----------
        then : SurfelState
            The same surfels at that time; objects that are missing there, or have another number, do not move.
        owner, face : (n,) int32 array
            Object of each point, and the face it is tied to; those that are tied to one are left out.
        position : (n, 3) float32 array
            World space, now.
        previous : (n, 3) float32 array
            Written where surfels say so.

        Returns
        -------
        (n,) bool array
            Points that surfels carry.
        """
        carried = np.zeros(len(position), bool)
        for index, now in self.objects.items():
            there = then.objects.get(index)
            if there is None or len(there) != len(now) or _alike(now, there):
                continue
            rows = np.flatnonzero((owner == index) & (face < 0))
            tree, surfels = self._tree(index)
            if not len(rows) or not len(surfels):
                continue
            nearest = surfels[tree.query(position[rows], workers=-1)[1]]
            moved = _carried(now, there, nearest, position[rows])
            known = np.isfinite(moved).all(axis=1) & (there.opacity[nearest] > 0.0)
            previous[rows[known]], carried[rows] = moved[known], known
        return carried

    def _tree(self, index: int) -> tuple[cKDTree, Array]:
        """The seen surfels of an object by their place, and which they are."""
        if index not in self._trees:
            from scipy.spatial import cKDTree  # an engine starts without

            posed = self.objects[index]
            rows = np.flatnonzero((posed.opacity > 0.0) & np.isfinite(posed.centre).all(axis=1))
            # Medians cost most of the time, and surfels lie evenly enough without.
            self._trees[index] = cKDTree(posed.centre[rows], balanced_tree=False, compact_nodes=False), rows
        return self._trees[index]


def _alike(a: PosedSurfels, b: PosedSurfels) -> bool:
    return a is b or all(same_bits(getattr(a, name), getattr(b, name)) for name in _WRITTEN)


def _carried(now: PosedSurfels, then: PosedSurfels, surfels: Array, position: Array) -> Array:
    """(n, 3) float32 places at another time of points that move as some surfels do."""
    centre, u, v = (getattr(now, name)[surfels].astype(np.float64) for name in _WRITTEN)
    centre_then, u_then, v_then = (getattr(then, name)[surfels].astype(np.float64) for name in _WRITTEN)
    normal, normal_then = np.cross(u, v), np.cross(u_then, v_then)
    area, area_then = (np.linalg.norm(array, axis=1, keepdims=True) for array in (normal, normal_then))
    away = position - centre
    with np.errstate(divide="ignore", invalid="ignore"):
        normal, normal_then = normal / area, normal_then / area_then
        along_u = _dot(np.cross(v, normal), away) / area
        along_v = _dot(np.cross(normal, u), away) / area
        beside = _dot(normal, away) * np.sqrt(area_then / area)
        moved = along_u * u_then + along_v * v_then + beside * normal_then
    # A surfel without area says no more than how far it went.
    return (centre_then + np.where(np.isfinite(moved).all(axis=1, keepdims=True), moved, away)).astype(np.float32)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("nk,nk->n", a, b)[:, None]
