"""What becomes of masks that were made: those that fit the hull of the others are kept, wrong ones become that hull."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from ...core.arrays import Array
from ...core.errors import first_of
from ..world_alignment import look_at
from .contact_sheet import draw_contact_sheet
from .hull import VOXELS, Hull
from .hull_check import Fit, check_masks
from .mask_view import MaskView
from .object_box import ObjectBox

logger = logging.getLogger(__name__)

#: Pixels of the longer side at which whole masks are checked.
_WHOLE = 560
REMEDY = "Draw the masks by hand (white on the object, folder masks), or give --masks none"
#: Part of the masks that may be doubtful; with more none are used.
_DOUBTED = 0.25


def whole(view: MaskView) -> MaskView:
    """The view in the size at which whole masks are checked."""
    height, width = view.shape
    return view.cropped((0, 0, width, height), min(_WHOLE, max(width, height)))


def resized(mask: Array, view: MaskView) -> Array:
    """(h, w) bool: a mask of 0 to 255 in the size of a view."""
    return np.asarray(Pillow.fromarray(mask).resize(view.shape[::-1], Pillow.Resampling.BILINEAR)) > 127


def settle(cv2: Any, views: Sequence[MaskView], masks: list[Array], hull: Hull, sheet: Path,
           subject: str) -> tuple[bool, list[Fit]]:  # fmt: skip
    """Whether masks that were made fit each other, and their figures; those that are wrong become the others' hull.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
    masks : list of (h, w) bool arrays
        Those that are wrong are replaced in it.
    hull : Hull
        Of these masks in this order.
    sheet : Path
        Contact sheet to write.
    subject : str
        For messages.
    """
    fits = check_masks(cv2, views, masks, hull)
    doubtful = [str(fit) for fit in fits if fit.doubtful]
    if len(doubtful) > _DOUBTED * len(fits) or not hull.solid().any():
        draw_contact_sheet(sheet, views, masks, fits)
        logger.warning(
            "%s: of %d masks that were made %d do not fit the others (%s): none are used. They are drawn in %s. %s",
            subject, len(fits), len(doubtful), first_of(doubtful), sheet.name, REMEDY,
        )  # fmt: skip
        return False, fits
    replaced = []
    for index, fit in enumerate(fits):
        if fit.wrong:  # the others know better
            masks[index] = hull.seen_by(views[index], hull.solid(without=index))
            replaced.append(str(fit))
    draw_contact_sheet(sheet, views, masks, fits)
    if replaced:
        logger.warning("%s: masks that do not fit the others are replaced by these' hull: %s", subject,
                       first_of(replaced))  # fmt: skip
    return True, fits


def hull_of_masks(cv2: Any, views: Sequence[MaskView], masks: list[Array], voxels: int = VOXELS) -> Hull | None:
    """The visual hull of masks, wherever it is; None where they have no part of the space in common.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
    masks : list of (h, w) bool arrays
    voxels : int
        Along the longest side.
    """
    box = _box_of_masks(views)
    for _ in range(2):  # around what the cameras look at, then around the hull
        hull = Hull(cv2, views, masks, box, voxels)
        if not hull.solid().any():
            return None
        box = hull.box(box)
    return Hull(cv2, views, masks, box, voxels)


def _box_of_masks(views: Sequence[MaskView]) -> ObjectBox:
    """A cube around what the cameras look at, as large as their nearest distance from it."""
    target = look_at(np.stack([view.matrix for view in views]))
    near = 0.7 * min(float(np.linalg.norm(view.centre - target)) for view in views)
    return ObjectBox(target - near, target + near, np.zeros((0, 3)))
