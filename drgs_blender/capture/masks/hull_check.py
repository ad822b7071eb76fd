"""How well each mask fits the hull of the others: what it has more, and what it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.arrays import Array
from .hull import Hull
from .mask_view import MaskView

#: Parts above which a mask is doubtful, and above which it is wrong.
DOUBTFUL, WRONG = 0.15, 0.4


@dataclass(slots=True)
class Fit:
    """A mask against the hull of the others.

    Attributes
    ----------
    name : str
        File name of the photograph.
    outside : float
        Part of the mask outside the hull, by more than a voxel; 1 where the hull is not in the picture.
    missing : float
        Part of the hull, a voxel smaller, that the mask does not cover.
    """

    name: str
    outside: float
    missing: float

    @property
    def doubtful(self) -> bool:
        """Whether someone should look at it."""
        return max(self.outside, self.missing) > DOUBTFUL

    @property
    def wrong(self) -> bool:
        """Whether it cuts the object."""
        return max(self.outside, self.missing) > WRONG

    @property
    def said(self) -> str:
        """Both figures in words."""
        return f"{self.outside:.0%} of it outside the others' hull, {self.missing:.0%} of the hull missing"

    def __str__(self) -> str:
        return f"{self.name} ({self.said})"


def check_masks(cv2: Any, views: Sequence[MaskView], masks: Sequence[Array], hull: Hull) -> list[Fit]:
    """Compare each mask with the hull of all others.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
    masks : sequence of (h, w) bool arrays
    hull : Hull
        Of these masks in this order.
    """
    found = []
    for k, (view, mask) in enumerate(zip(views, masks, strict=True)):
        outline = hull.seen_by(view, hull.solid(without=k)).astype(np.uint8)
        disc = np.ones((2 * hull.pixels(view) + 1,) * 2, np.uint8)
        larger, smaller = cv2.dilate(outline, disc) > 0, cv2.erode(outline, disc) > 0
        outside = float((mask & ~larger).sum() / mask.sum()) if mask.any() else 0.0
        missing = float((smaller & ~mask).sum() / smaller.sum()) if smaller.any() else 0.0
        found.append(Fit(view.name, outside, missing))
    return found
