"""Masks of photographs of an object on a ground: the scene is learned, cut in space, and seen from each camera."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow
from scipy.ndimage import binary_fill_holes, label

from ...compute.prepare import PHASE, prepare_kernels
from ...core.arrays import Array
from ...reconstruct.model.gaussians import Gaussians
from ..features import Tell
from .ground_contact import shows_ground
from .hull import Hull
from .hull_check import Fit
from .learned_scene import Effort, learn_scene
from .mask_view import MaskView
from .object_box import ObjectBox, find_box
from .object_surfels import Cut, box_around, cut_object, height_of_object, share_of_object
from .settling import REMEDY, settle

logger = logging.getLogger(__name__)

#: First roughly, to find the box around the object; then that.
EFFORTS = (Effort(160, 300, 16000), Effort(256, 900, 30000, 384))
#: Pixels of the longer side of masks, of the part around the object.
PART = 640
#: Surfels that an object has at least; views that show it (three make a hull, which a fourth is held against).
_FEWEST_SURFELS, _FEWEST_VIEWS = 30, 4
#: Pixels of a side at which masks are looked at, and the part of the pictures' edges that an object may be at.
_EDGE, _AT_EDGES = 64, 0.4
#: Parts of a mask smaller than this part of the largest are dropped, holes smaller than this part of it are filled.
_SMALL, _PINHOLE = 0.01, 1e-3


@dataclass(slots=True)
class Found:
    """Masks that were made.

    Attributes
    ----------
    windows : dict of int to tuple of int
        View -> (left, top, right, bottom) of the part around the object; views without it are missing.
    parts : list of MaskView
        These parts.
    masks : list of (h, w) bool arrays
        Of the parts.
    hull : Hull
        Of the masks.
    scene, cut, box : Gaussians, Cut, ObjectBox
        What is learned, what of it is the object, and where that is.
    photographed : list of MaskView
        The parts in the size at which they were photographed, at most that of masks.
    finest : int
        Pixels of a window's longer side in which it is learned.
    """

    windows: dict[int, tuple[int, int, int, int]]
    parts: list[MaskView]
    masks: list[Array]
    hull: Hull
    scene: Gaussians
    cut: Cut
    box: ObjectBox
    photographed: list[MaskView] = field(default_factory=list)
    finest: int = PART

    def whole(self, view: int, shape: tuple[int, int], size: tuple[int, int]) -> Array:
        """(h, w) uint8: the mask of a whole picture of `size` (w, h), whose view has the `shape` (h, w)."""
        if view not in self.windows:
            return np.zeros(size[::-1], np.uint8)
        return _drawn(self.masks[list(self.windows).index(view)], self.windows[view], shape, size)

    def band(self, view: int) -> float:
        """Pixels of a view by which outlines may be wrong: one pixel of what is learned, and no less than one."""
        left, top, right, bottom = self.windows.get(view, (0, 0, 0, 0))
        return max(1.0, max(right - left, bottom - top) / self.finest)

    def seen_by(self, cv2: Any, view: MaskView) -> Array:
        """(h, w) uint8: the mask of a view that was not learned from."""
        window, shape = self.box.window(view), view.shape
        if window is None:
            return np.zeros(shape, np.uint8)
        mask = _mask_of(cv2, view.cropped(window, PART), self.scene, self.cut)
        views = [_as_photographed(view, window), *self.photographed]
        mask = _without_ground(cv2, views, 0, mask, self.scene, self.cut, self.box)
        return _drawn(mask, window, shape, shape[::-1])


def _drawn(mask: Array, window: tuple[int, int, int, int], shape: tuple[int, int], size: tuple[int, int]) -> Array:
    """(h, w) uint8: a picture of `size` (w, h) with the mask of a window of a view of the `shape` (h, w)."""
    drawn = np.zeros(size[::-1], np.uint8)
    sizes = zip(window, size * 2, shape[::-1] * 2, strict=True)
    left, top, right, bottom = (round(edge * new / old) for edge, new, old in sizes)
    part = Pillow.fromarray(mask.astype(np.uint8) * 255)
    resized = part.resize((right - left, bottom - top), Pillow.Resampling.BILINEAR)
    drawn[top:bottom, left:right] = np.asarray(resized)
    return drawn


def _mask_of(cv2: Any, part: MaskView, scene: Gaussians, cut: Cut) -> Array:
    """(h, w) bool: the pixels of a part of a photograph of which the object covers more than half."""
    camera = part.pinhole(PART)
    return without_specks(part.distorted(cv2, camera, share_of_object(scene, cut, camera)) > 0.5)


def _as_photographed(view: MaskView, window: tuple[int, int, int, int]) -> MaskView:
    left, top, right, bottom = window
    return view.cropped(window, min(PART, max(right - left, bottom - top)))


def _without_ground(cv2: Any, views: Sequence[MaskView], which: int, mask: Array, scene: Gaussians, cut: Cut,
                    box: ObjectBox) -> Array:  # fmt: skip
    """The mask of one of the views, of any size, without what `shows_ground` of its foot."""
    view = views[which]
    camera = view.pinhole(max(view.shape))
    height = view.distorted(cv2, camera, height_of_object(scene, cut, camera))
    inside = cv2.resize(mask.astype(np.float32), view.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
    ground = shows_ground(cv2, views, which, inside, height, box)
    if not ground.any():
        return mask
    return without_specks(mask & (cv2.resize(ground, mask.shape[::-1], interpolation=cv2.INTER_LINEAR) <= 0.5))


class NoMasks(Exception):
    """Why there are none."""


def make_masks(cv2: Any, views: Sequence[MaskView], points: Array, sheet: Path, subject: str, tell: Tell,
               cancelled: Callable[[], bool]) -> tuple[Found | None, list[Fit]]:  # fmt: skip
    """Masks of the object that fit each other, and their figures; none, with a warning, where there are none.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
        Z up, ground at 0.
    points : (n, 3) float64 array
        Sparse points; may be none.
    sheet : Path
        Contact sheet to write.
    subject : str
        For messages.
    tell, cancelled : callable

    Raises
    ------
    Cancelled
        `cancelled` said so.
    """
    try:
        found = find_masks(cv2, views, points, tell, cancelled)
        _check_edges(found, views)
    except NoMasks as why:
        logger.warning("%s: %s: no masks are made. %s", subject, why, REMEDY)
        return None, []
    fit, fits = settle(cv2, found.parts, found.masks, found.hull, sheet, subject)
    return found if fit else None, fits


def _check_edges(found: Found, views: Sequence[MaskView]) -> None:
    """Raise NoMasks where the masks hold the surroundings: an object is seldom at so much of the pictures' edges."""
    size = (_EDGE, _EDGE)
    edges = []
    for index, view in enumerate(views):
        mask = found.whole(index, view.shape, size) > 127
        edges.append(np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]]).mean())
    if (share := float(np.median(edges))) > _AT_EDGES:
        raise NoMasks(f"what would be the object is at {share:.0%} of the pictures' edges, as surroundings are")


def find_masks(cv2: Any, views: Sequence[MaskView], points: Array, tell: Tell,
               cancelled: Callable[[], bool]) -> Found:  # fmt: skip
    """Masks of the object.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
        Z up, ground at 0.
    points : (n, 3) float64 array
        Sparse points; may be none.
    tell, cancelled : callable

    Raises
    ------
    NoMasks
        Too few views show the object, nothing stands on the ground, or too little of it is learned.
    Cancelled
        `cancelled` said so.
    """
    prepare_kernels(("reconstruct",), lambda _, part: tell(PHASE, 0.2 * part), cancelled)
    matrices = np.stack([view.matrix for view in views])
    box, object_surfels = find_box(points, matrices), None
    for step, effort in enumerate(EFFORTS):
        windows = {k: window for k, view in enumerate(views) if (window := box.window(view)) is not None}
        if len(windows) < _FEWEST_VIEWS:
            raise NoMasks(f"{len(windows)} photographs show the object, masks need {_FEWEST_VIEWS}")
        parts = [views[k].cropped(window, PART) for k, window in windows.items()]
        told = lambda phase, part, step=step: tell(phase, 0.2 + 0.7 * (step + part) / len(EFFORTS))  # noqa: E731
        shown = np.median([max(right - left, bottom - top) for left, top, right, bottom in windows.values()])
        fitting = effort.fitting(float(shown))
        scene = learn_scene(cv2, parts, box, fitting, object_surfels, told, cancelled)
        cut = cut_object(scene, box)
        if cut.surfels.sum() < _FEWEST_SURFELS:
            raise NoMasks("no object is found on the ground")
        box, object_surfels = box_around(scene, cut, box.points), scene.select(np.flatnonzero(cut.surfels))
    masks = [_mask_of(cv2, part, scene, cut) for part in parts]
    shown = [_as_photographed(views[k], window) for k, window in windows.items()]
    masks = [_without_ground(cv2, shown, k, mask, scene, cut, box) for k, mask in enumerate(masks)]
    if not any(mask.any() for mask in masks):
        raise NoMasks("what is learned of the object covers half of no pixel")
    return Found(windows, parts, masks, Hull(cv2, parts, masks, box), scene, cut, box, shown, fitting.size)


def without_specks(mask: Array) -> Array:
    """(h, w) bool: a mask without specks and pinholes."""
    parts, count = label(mask)
    if count > 1:
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        mask = (sizes >= max(_SMALL * sizes.max(), 9))[parts]
    holes, count = label(binary_fill_holes(mask) & ~mask)
    sizes = np.bincount(holes.ravel(), minlength=count + 1)
    return mask | ((sizes < max(_PINHOLE * mask.sum(), 2))[holes] & (holes > 0))
