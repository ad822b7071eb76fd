"""The box around the object: the main cluster of sparse points above the ground, near what the cameras look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.spatial import cKDTree

from ...core.arrays import Array
from ..world_alignment import look_at
from .mask_view import MaskView

#: Least height of a point above the ground, and cells of the clustering, in parts of the cameras' distance.
_ABOVE, _CELL = 0.012, 0.03
#: Radius around what the cameras look at, in parts of their distance: in it, points count as the object's.
_REACH = 0.6
#: Surroundings that a window shows beside the box, in parts of the box's size there.
_SURROUNDINGS = 0.1
#: Pixels that a window has at least on each side, and as a part of its longer side.
_NARROW, _THIN = 8, 1 / 16
#: Points that a cluster needs; margin of the box, in parts of its size; of the box without points, the half width and
#: the height in parts of the cameras' distance.
_FEWEST, _MARGIN, _GUESSED = 25, 0.15, (0.28, 0.5)


@dataclass(slots=True)
class ObjectBox:
    """Where the object is.

    Attributes
    ----------
    low, high : (3,) float64 array
        Corners; the lower one is on the ground, or below.
    points : (n, 3) float64 array
        On the object, without strays; may be empty.
    """

    low: Array
    high: Array
    points: Array

    @property
    def corners(self) -> Array:
        """(8, 3) corners."""
        grid = np.stack(np.meshgrid(*zip(self.low, self.high, strict=True), indexing="ij"), axis=-1)
        return grid.reshape(-1, 3)

    def outline(self, cv2: Any, view: MaskView) -> Array:
        """(h, w) bool: where the box is in a view."""
        drawn = np.zeros(view.shape, np.uint8)
        at, _ = view.project(self.corners)
        if not np.isfinite(at).all():
            return np.ones(view.shape, bool)  # the camera is within the box, or beside it
        corners = cv2.convexHull(np.clip(at, -1e4, 1e4).astype(np.float32).reshape(-1, 1, 2))
        cv2.fillConvexPoly(drawn, corners.round().astype(np.int32), 1)
        return drawn > 0

    def window(self, view: MaskView) -> tuple[int, int, int, int] | None:
        """(left, top, right, bottom) of the box in a view with some surroundings; None where it is not in it."""
        height, width = view.shape
        at, _ = view.project(self.corners)
        if not np.isfinite(at).all():
            return 0, 0, width, height  # the camera is within the box, or beside it
        low, high = at.min(axis=0), at.max(axis=0)
        margin = 2 + _SURROUNDINGS * float((high - low).max())
        low = np.maximum(np.floor(low - margin), 0).astype(int)
        high = np.minimum(np.ceil(high + margin), [width, height]).astype(int)
        return (
            (*low.tolist(), *high.tolist()) if (high - low >= max(_NARROW, _THIN * (high - low).max())).all() else None
        )


def find_box(points: Array, matrices: Array) -> ObjectBox:
    """The box of the object; without enough points above the ground, a guess around what the cameras look at.

    Parameters
    ----------
    points : (n, 3) float64 array
        Sparse points; Z up, ground at 0.
    matrices : (m, 4, 4) float64 array
        Camera to world, Blender's axes.
    """
    target = look_at(matrices)
    away = float(np.median(np.linalg.norm(matrices[:, :3, 3] - target, axis=1)))
    object_points = _main_cluster(points, target, away)
    if len(object_points) < _FEWEST:
        half, height = (part * away for part in _GUESSED)
        low = np.array([target[0] - half, target[1] - half, 0.0])
        return ObjectBox(low, low + np.array([2 * half, 2 * half, max(height, 1.3 * target[2])]), np.zeros((0, 3)))
    low, high = np.quantile(object_points, [0.002, 0.998], axis=0)
    low[2] = 0.0
    margin = _MARGIN * np.maximum(high - low, 0.35 * (high - low).max()) + 0.01 * away
    low, high = low - margin, high + margin
    low[2] = 0.0
    return ObjectBox(low, high, object_points)


def _main_cluster(points: Array, target: Array, away: float) -> Array:
    """Points of the largest group above the ground within reach of `target`, without strays."""
    flat = np.linalg.norm(points[:, :2] - target[:2], axis=1)
    near = points[(points[:, 2] > _ABOVE * away) & (flat < _REACH * away) & (points[:, 2] < away)]
    if len(near) < _FEWEST:
        return near
    nearest = cKDTree(near).query(near, k=min(6, len(near)))[0][:, -1]
    near = near[nearest < max(4 * float(np.median(nearest)), 0.01 * away)]
    cells = np.floor((near - near.min(axis=0)) / (_CELL * away)).astype(int)
    grid = np.zeros(cells.max(axis=0) + 3, bool)
    grid[tuple((cells + 1).T)] = True
    groups, count = label(binary_dilation(grid, np.ones((3, 3, 3))))
    of = groups[tuple((cells + 1).T)]
    # many points, close to what the cameras look at
    closeness = 1 / (1 + (np.linalg.norm(near[:, :2] - target[:2], axis=1) / (0.2 * away)) ** 2)
    weight = np.bincount(of, closeness, minlength=count + 1)
    found = near[of == weight.argmax()]
    return found if len(found) >= _FEWEST else np.zeros((0, 3))
