"""Ground that masks took for the foot of the object: a plane sweep over the lowest heights tells which it is.

What is learned of the object holds bits of ground where it lies in the object's shadow and few photographs see it, as
between feet. These pixels look alike in neighbouring photographs when they are projected to the ground, and differ when
they are projected to a plane above it (Collins 1996); the object's own do not. The lowest of these are nearer to the
ground than to any such plane: the lower edge of the mask stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import find_objects

from ...core.arrays import Array
from .mask_view import MaskView
from .object_box import ObjectBox

#: Height of what is learned, in parts of the box's largest side, up to which it may be ground.
_LOW = 0.08
#: Heights of the planes above the ground with which it is compared, in the same parts.
_ABOVE = (0.02, 0.03, 0.04, 0.055, 0.07, 0.09, 0.12, 0.16)
#: Neighbouring photographs that are compared, and the number of the most alike of them that count.
_NEAR, _BEST = 6, 3
#: Pixels of a side over which differences are averaged, and by which photographs are blurred before.
_WINDOW, _BLUR = 5, 0.7
#: Difference at the ground, of 255, up to which photographs agree; part of the least one above it that it may be then,
#: and where they agree less, as by noise.
_AGREE, _BETTER, _CLEARLY = 8.0, 0.95, 0.75


def shows_ground(cv2: Any, views: Sequence[MaskView], which: int, mask: Array, height: Array, box: ObjectBox) -> Array:
    """(h, w) float32 in 0..1: the part of the pixels around each one that are in the mask and show the ground.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
        Z up, ground at 0; of about the size at which they were photographed.
    which : int
        Number of the view that is asked for.
    mask : (h, w) bool array
        Of that view.
    height : (h, w) float32 array
        Of what is learned of the object, where that is seen.
    box : ObjectBox
        Around the object.
    """
    view, size = views[which], float((box.high - box.low).max())
    ground = view.on_ground()
    with np.errstate(invalid="ignore"):
        beneath = ((ground > box.low[:2]) & (ground < box.high[:2])).all(axis=-1)
    asked = mask & beneath & (height < _LOW * size)
    shown = np.zeros(view.shape, np.float32)
    if not asked.any() or len(views) <= _BEST:
        return shown
    rows, columns = (
        slice(max(edge.start - _WINDOW, 0), edge.stop + _WINDOW) for edge in find_objects(asked.astype(int))[0]
    )
    part = rows, columns
    others = _neighbours(views, which, box)
    blurred = [cv2.GaussianBlur(one.pixels, (0, 0), _BLUR).astype(np.float32) for one in (view, *others)]
    rays, own = view.rays()[part], blurred[0][part]

    def difference(z: float) -> Array:
        """Least differences of the photographs in the plane at height z, mean over windows."""
        with np.errstate(all="ignore"):
            places = view.centre + ((z - view.centre[2]) / rays[..., 2])[..., None] * rays
        found = []
        for other, pixels in zip(others, blurred[1:], strict=True):
            at, _ = other.project(np.nan_to_num(places.reshape(-1, 3), posinf=0.0, neginf=0.0))
            at = np.nan_to_num(at - 0.5, nan=-10.0).clip(-10, 1e5).astype(np.float32).reshape(own.shape[0], -1, 2)
            seen = cv2.remap(pixels, at, None, cv2.INTER_LINEAR, borderValue=(np.nan,) * 3)
            apart = np.nan_to_num(np.abs(seen - own).mean(axis=-1), nan=255.0)
            found.append(cv2.boxFilter(apart.astype(np.float32), -1, (_WINDOW, _WINDOW)))
        return np.sort(np.stack(found), axis=0)[:_BEST].mean(axis=0)

    at_ground = difference(0.0)
    above = np.min([difference(part * size) for part in _ABOVE], axis=0)
    above_foot = _above_foot(view, mask, box)[part]
    is_ground = asked[part] & above_foot & (at_ground < np.where(at_ground < _AGREE, _BETTER, _CLEARLY) * above)
    shown[part] = cv2.boxFilter(is_ground.astype(np.float32), -1, (3, 3))
    return shown


def _above_foot(view: MaskView, mask: Array, box: ObjectBox) -> Array:
    """(h, w) bool: pixels of the mask that are farther from its lower edge than the lowest plane is from the ground."""
    foot, size = _foot(box), float((box.high - box.low).max())
    seen, _ = view.project(np.stack([foot, foot + np.array([0.0, 0.0, _ABOVE[0] * size])]))
    down = np.nan_to_num(seen[0] - seen[1])  # in the picture, x and y
    x, y = (int(math.copysign(math.ceil(abs(d) - 0.5), d)) for d in down)
    padded = np.pad(mask, ((abs(y), abs(y)), (abs(x), abs(x))))
    height, width = mask.shape
    return mask & padded[abs(y) + y : abs(y) + y + height, abs(x) + x : abs(x) + x + width]


def _foot(box: ObjectBox) -> Array:
    """(3,) place on the ground below the middle of the box."""
    return np.array([*(box.low + box.high)[:2] / 2, 0.0])


def _neighbours(views: Sequence[MaskView], which: int, box: ObjectBox) -> list[MaskView]:
    """The views that see the foot of the object from nearly the same side."""
    towards = np.array([view.centre - _foot(box) for view in views])
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    order = np.argsort(-(towards @ towards[which]), kind="stable")
    return [views[k] for k in order if k != which][:_NEAR]
