"""The picture of the ground as seen from all cameras, and what a photograph would show without the object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core.arrays import Array
from .mask_view import MaskView
from .object_box import ObjectBox

#: Side of the picture, pixels at most; views that make it.
_SIDE, _VIEWS = 640, 24
#: Half width in parts of the box's largest side; beyond it the ground is not known.
_REACH = 3.0
#: Least number of views that must see a spot.
_FEWEST = 3
#: Agreement: difference in parts of the spread of the spot over the views, least difference (of 255).
_SPREADS, _FLOOR = 1.5, 6.0
#: Spread, in parts of the median one, above which a spot of the ground is not known.
_UNSURE = 2.5
#: Photographs are blurred before they are compared, pixels.
_BLUR = 1.0


class GroundPicture:
    """Median over views of what is seen in the plane z = 0, and its spread.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
    box : ObjectBox
    """

    def __init__(self, cv2: Any, views: Sequence[MaskView], box: ObjectBox):
        self._cv2 = cv2
        size = box.high - box.low
        middle = (box.low + box.high)[:2] / 2
        half = _REACH * float(size.max())
        pixel = min(float(np.linalg.norm(view.centre - [*middle, 0])) / view.lens.fx for view in views)
        self._side = int(np.clip(2 * half / pixel, 64, _SIDE))
        self._low, self._cell = middle - half, 2 * half / self._side
        step = (np.arange(self._side) + 0.5) * self._cell
        x, y = np.meshgrid(self._low[0] + step, self._low[1] + step)
        spots = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        chosen = np.unique(np.linspace(0, len(views) - 1, min(_VIEWS, len(views))).round().astype(int))
        stack = np.stack([self._seen(views[k], spots) for k in chosen])
        enough = np.isfinite(stack[..., 0]).sum(axis=0) >= _FEWEST
        stack[:, ~enough] = 0
        self.colour = _median(stack)
        gains = [exposure_gain(picture, self.colour, enough) for picture in stack]
        for picture, gain in zip(stack, gains, strict=True):
            picture *= gain
        self.colour = _median(stack)
        spread = 1.48 * _median(np.abs(stack - self.colour).mean(axis=-1))
        # where the object hides the ground from many views the median may be the object: the ground is not known there
        if enough.any():
            unsure = (spread > _UNSURE * float(np.median(spread[enough]))).astype(np.uint8)
            unsure = cv2.morphologyEx(unsure, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
            enough &= cv2.dilate(unsure, np.ones((5, 5), np.uint8)) == 0
        self.spread = spread
        self._mean = self.colour[enough].mean(axis=0) if enough.any() else np.full(3, 128.0)
        self.colour[~enough] = np.nan

    def _blurred(self, pixels: Array) -> Array:
        return self._cv2.GaussianBlur(pixels, (0, 0), _BLUR).astype(np.float32)

    def _seen(self, view: MaskView, spots: Array) -> Array:
        """(side, side, 3) float32 of one view; NaN where it does not see the ground."""
        at, _ = view.project(spots)
        at = (at - 0.5).astype(np.float32).reshape(self._side, self._side, 2)
        at[~np.isfinite(at)] = -10
        pixels = self._blurred(view.pixels)
        return self._cv2.remap(pixels, at, None, self._cv2.INTER_LINEAR, borderValue=(np.nan,) * 3)

    def without_object(self, view: MaskView, outline: Array, near: tuple[Array, Array]) -> Array:
        """(h, w, 3) float32 in 0..1, sRGB: what the view would show behind the object and the ground `near` it.

        The photograph itself outside of the `outline` (h, w, bool) of the object's box, and inside where it agrees with
        the ground; else the ground; where that is not known, what is around. Of the ground between the corners
        `near`, (2,) each, the mean colour: it is learned.
        """
        cv2 = self._cv2
        places = view.on_ground()
        with np.errstate(invalid="ignore"):
            learned = ((places > near[0]) & (places < near[1])).all(axis=-1)
        at = ((places - self._low) / self._cell - 0.5).astype(np.float32)
        at[~np.isfinite(at)] = -10
        expected = cv2.remap(self.colour, at, None, cv2.INTER_LINEAR, borderValue=(np.nan,) * 3)
        spread = cv2.remap(self.spread, at, None, cv2.INTER_LINEAR, borderValue=np.nan)
        pixels = self._blurred(view.pixels)
        gain = exposure_gain(pixels, np.nan_to_num(expected), np.isfinite(expected[..., 0]))
        difference = np.abs(pixels * gain - expected).mean(axis=-1)
        known = np.isfinite(difference)
        weight = cv2.boxFilter(known.astype(np.float32), -1, (3, 3))
        smooth = cv2.boxFilter(np.where(known, difference, 0).astype(np.float32), -1, (3, 3))
        agrees = known & (smooth < np.maximum(weight, 1e-6) * (_FLOOR + _SPREADS * np.nan_to_num(spread)))
        expected = np.where(known[..., None], np.nan_to_num(expected) / gain, view.pixels)
        expected[agrees | ~outline] = view.pixels[agrees | ~outline]
        behind = np.clip(expected, 0, 255).astype(np.uint8)
        hidden = (outline & ~known & ~learned).astype(np.uint8)
        if hidden.any() and not hidden.all():
            behind = cv2.inpaint(behind, hidden, 3, cv2.INPAINT_TELEA)
        behind[learned] = self._mean
        return behind.astype(np.float32) / 255


def exposure_gain(picture: Array, colour: Array, known: Array) -> Array:
    """(3,) by which the exposure of a picture differs from that of `colour`, (h, w, 3) each, where that is `known`."""
    known = known & np.isfinite(picture[..., 0]) & (picture.min(axis=-1) > 8) & (colour.min(axis=-1) > 8)
    if known.sum() < 100:
        return np.ones(3, np.float32)
    return np.median(colour[known] / picture[known], axis=0).astype(np.float32)


def _median(stack: Array) -> Array:
    """Median over the first axis of what is finite, the lower one of two; faster than NumPy's."""
    count = np.isfinite(stack).sum(axis=0)
    order = np.sort(stack, axis=0)  # NaN come last
    return np.take_along_axis(order, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
