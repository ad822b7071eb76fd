"""Visual hull of masks: voxels that most views have inside, without one view where that is asked, seen in views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import label

from ...core.arrays import Array
from .mask_view import MaskView
from .object_box import ObjectBox

#: Voxels along the longest side, where nothing else is asked; part of the views that see a voxel which may have it
#: outside their mask.
VOXELS, _TOLERANCE = 88, 0.1
#: Margin of a box around the hull, in parts of its largest side.
_MARGIN = 0.12
#: Views that must see a voxel; number of views from which on one may always have it outside.
_FEWEST, _MANY = 3, 6


class Hull:
    """Votes of masks for the voxels of a box.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
    masks : sequence of (h, w) bool arrays
    box : ObjectBox
    voxels : int
        Along the longest side.
    """

    def __init__(self, cv2: Any, views: Sequence[MaskView], masks: Sequence[Array], box: ObjectBox,
                 voxels: int = VOXELS):  # fmt: skip
        self._cv2 = cv2
        self.cell = float((box.high - box.low).max()) / voxels
        counts = np.maximum(np.ceil((box.high - box.low) / self.cell).astype(int), 1)
        axes = [low + (np.arange(n) + 0.5) * self.cell for low, n in zip(box.low, counts, strict=True)]
        self._shape = tuple(counts)
        self._middle, self._reach = (box.low + box.high) / 2, float((box.high - box.low)[:2].max()) / 2
        self.places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self._inside = np.zeros(len(self.places), np.int16)
        self._seen = np.zeros(len(self.places), np.int16)
        self._votes = []
        for view, mask in zip(views, masks, strict=True):
            vote = self._vote(view, mask)
            self._votes.append(vote)
            self._inside += vote == 1
            self._seen += vote >= 0

    def _vote(self, view: MaskView, mask: Array) -> Array:
        """(n,) int8: 1 inside the mask, 0 outside, -1 not in the picture."""
        at, depth = view.project(self.places)
        height, width = view.shape
        with np.errstate(invalid="ignore"):
            seen = (depth > 0) & (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
        vote = np.full(len(at), -1, np.int8)
        column, row = at[seen].astype(int).T
        vote[seen] = mask[row, column]
        return vote

    def solid(self, without: int | None = None) -> Array:
        """(n,) bool: voxels of the hull's main part, of all masks or of all but one."""
        inside, seen = self._inside, self._seen
        if without is not None:
            vote = self._votes[without]
            inside, seen = inside - (vote == 1), seen - (vote >= 0)
        out = seen - inside
        kept = (seen >= _FEWEST) & (out <= np.maximum(_TOLERANCE * seen, seen >= _MANY))
        parts, count = label(kept.reshape(self._shape))
        if count > 1:
            parts = parts.ravel()
            away = np.linalg.norm((self.places - self._middle)[:, :2], axis=1) / self._reach
            weight = np.bincount(parts, np.exp(-4 * away**2))
            kept = parts == weight[1:].argmax() + 1
        return kept

    def box(self, outer: ObjectBox) -> ObjectBox:
        """The box around the hull with a margin, within `outer`; `outer` where the hull is empty."""
        places = self.places[self.solid()]
        if not len(places):
            return outer
        low, high = places.min(axis=0), places.max(axis=0)
        margin = _MARGIN * float((high - low).max()) + self.cell
        low, high = np.maximum(low - margin, outer.low), np.minimum(high + margin, outer.high)
        return ObjectBox(low, high, outer.points)

    def pixels(self, view: MaskView) -> int:
        """Pixels of a voxel in a view, about."""
        away = max(float(np.linalg.norm(view.centre - self._middle)), 1e-9)
        return max(1, int(np.ceil(min(self.cell * view.lens.fx / away, max(view.shape)))))

    def seen_by(self, view: MaskView, solid: Array) -> Array:
        """(h, w) bool: the voxels' outline in a view."""
        height, width = view.shape
        at, depth = view.project(self.places[solid])
        at, depth = at[depth > 0], depth[depth > 0]
        drawn = np.zeros((height, width), np.uint8)
        if not len(at):
            return drawn > 0
        size = 1.2 * self.cell * view.lens.fx / max(float(np.median(depth)), 1e-9)
        size = 1 | int(np.ceil(min(size, 2 * max(height, width))))
        at = np.nan_to_num(at, nan=-1e6)
        fits = (at > -size).all(axis=1) & (at[:, 0] < width + size) & (at[:, 1] < height + size)
        column, row = np.clip(at[fits].astype(int), 0, [width - 1, height - 1]).T
        drawn[row, column] = 1
        square = np.ones((size, size), np.uint8)
        return self._cv2.dilate(drawn, square) > 0
