"""Masks without learning: points and box as seeds, the ground's picture, GrabCut, a visual hull as the next prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.ndimage import binary_fill_holes, label

from ...core.arrays import Array
from ...core.errors import Cancelled
from ..features import Tell
from .ground_picture import GroundPicture
from .hull import Hull
from .mask_view import MaskView
from .object_box import ObjectBox

#: Voxels and tolerance of the first hull, of masks with holes.
_COARSE = (56, 0.25)
#: Voxels that an object has at least.
_LEAST_VOXELS = 30
#: Times the ground is cleaned of the object before GrabCut; rim of a mask, in parts of its largest depth.
_CLEANING, _RIM = 3, 0.3
#: GrabCut's iterations; rounds in all, the first without a hull.
_ITERATIONS, _ROUNDS = 4, 3
#: Per round: voxels by which the outline may be wrong, none: any number; tolerance of the hull that follows.
_SLACK, _TOLERANCE = (None, 12.0, 7.0), (0.2, 0.15, 0.12)
#: Agreement with the ground below which a pixel is surely ground, and above which it surely is not.
_GROUND, _OTHER = 0.7, 1.3
#: Colours of the surroundings are learned from this margin around the box, in parts of its size in the picture.
_SURROUNDINGS = 0.35
#: Parts of the mask smaller than this part of the largest are dropped.
_SMALL = 0.02


def find_masks(cv2: Any, views: Sequence[MaskView], box: ObjectBox, tell: Tell,
               cancelled: Callable[[], bool]) -> tuple[list[Array], Hull]:  # fmt: skip
    """Masks of the object and their hull.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
    box : ObjectBox
    tell, cancelled : callable

    Returns
    -------
    masks : list of (h, w) bool arrays
    hull : Hull

    Raises
    ------
    Cancelled
        `cancelled` said so.
    """
    boxes, agreements, masks = _first_guess(cv2, views, box)
    hull = Hull(cv2, views, masks, box, *_COARSE)
    for _ in range(_CLEANING):  # the object hides the ground beside it from many views: what is surely it is left out
        ground = GroundPicture(cv2, views, box, [_core(cv2, mask) for mask in masks])
        agreements = [ground.agreement(view) for view in views]
        masks = [_not_ground(cv2, *pair) for pair in zip(boxes, agreements, strict=True)]
        hull = Hull(cv2, views, masks, box, *_COARSE)
        masks = [mask & hull.seen_by(view, hull.solid()) for view, mask in zip(views, masks, strict=True)]
    for step in range(_ROUNDS):
        solid = hull.solid()
        found = []
        for k, view in enumerate(views):
            if cancelled():
                raise Cancelled
            tell("masks", (step * len(views) + k) / (_ROUNDS * len(views)))
            prior = hull.seen_by(view, solid)
            away = float(np.linalg.norm(view.centre - (box.low + box.high) / 2))
            cell = max(1.0, hull.cell * view.lens.fx / away)
            found.append(_cut(cv2, view, box, boxes[k], agreements[k], prior, cell, _SLACK[step]))
        masks = found
        hull = Hull(cv2, views, masks, box, tolerance=_TOLERANCE[step])
        if step + 1 < _ROUNDS:
            ground = GroundPicture(cv2, views, box, [_core(cv2, mask) for mask in masks])
            agreements = [ground.agreement(view) for view in views]
    return masks, hull


def _first_guess(cv2: Any, views: Sequence[MaskView], box: ObjectBox) -> tuple[list[Array], list[Array], list[Array]]:
    """Per view: where the box is, the agreement with the ground, and what of the box does not agree."""
    boxes = [_outline(cv2, view, box.corners) for view in views]
    ground = GroundPicture(cv2, views, box)
    agreements = [ground.agreement(view) for view in views]
    return boxes, agreements, [_not_ground(cv2, *pair) for pair in zip(boxes, agreements, strict=True)]


def refine_box(cv2: Any, views: Sequence[MaskView], box: ObjectBox) -> ObjectBox | None:
    """A guessed box made as small as what stands on the ground; None where nothing does."""
    _, _, rough = _first_guess(cv2, views, box)
    hull = Hull(cv2, views, rough, box, *_COARSE)
    return hull.box(box) if hull.solid().sum() >= _LEAST_VOXELS else None


def window_of(cv2: Any, view: MaskView, box: ObjectBox) -> tuple[int, int, int, int] | None:
    """(left, top, right, bottom) of the box in a view with some of its surroundings; None where it is not in it."""
    seen = _outline(cv2, view, box.corners)
    return _around(seen) if seen.sum() >= 16 else None


def _around(seen: Array) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) of what is true in (h, w), with some of its surroundings."""
    rows, columns = np.nonzero(seen)
    margin = 4 + int(_SURROUNDINGS * max(np.ptp(rows), np.ptp(columns)))
    height, width = seen.shape
    left, top = max(0, columns.min() - margin), max(0, rows.min() - margin)
    return left, top, min(width, columns.max() + margin + 1), min(height, rows.max() + margin + 1)


def _outline(cv2: Any, view: MaskView, points: Array) -> Array:
    """(h, w) bool: convex outline of points in a view."""
    height, width = view.shape
    at, _ = view.project(points)
    drawn = np.zeros((height, width), np.uint8)
    if not np.isfinite(at).all():
        return np.ones((height, width), bool)  # the camera is within the box
    corners = cv2.convexHull(np.clip(at, -1e4, 1e4).astype(np.float32).reshape(-1, 1, 2))
    cv2.fillConvexPoly(drawn, corners.round().astype(np.int32), 1)
    return drawn > 0


def _not_ground(cv2: Any, inside: Array, agreement: Array) -> Array:
    """The first guess: all in the box that does not agree with the ground; what is not known may be the object."""
    other = cv2.morphologyEx((inside & ~(agreement < 1)).astype(np.uint8), cv2.MORPH_OPEN, _disc(cv2, 1))
    return inside & binary_fill_holes(cv2.morphologyEx(other, cv2.MORPH_CLOSE, _disc(cv2, 3)) > 0)


def _core(cv2: Any, mask: Array) -> Array:
    """The mask without its rim, which may be ground."""
    padded = np.pad(mask.astype(np.uint8), 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1]
    return depth > max(2.0, _RIM * float(depth.max()))


def _disc(cv2: Any, radius: float) -> Array:
    side = 1 | int(2 * radius + 1)
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def _cut(cv2: Any, view: MaskView, box: ObjectBox, inside: Array, agreement: Array, prior: Array,
         cell: float, slack: float | None) -> Array:  # fmt: skip
    """GrabCut of one view.

    `inside` says where the box is, `agreement` how well pixels agree with the ground, `prior` is the outline of the
    hull; `cell` is a voxel in pixels, `slack` the voxels by which the outline may be wrong (None: it is a first guess).
    """
    height, width = view.shape
    drawn = prior.astype(np.uint8)
    outer = inside if slack is None else cv2.dilate(drawn, _disc(cv2, slack * cell)) > 0
    inner = cv2.erode(drawn, _disc(cv2, 5 * cell)) > 0
    clean = cv2.morphologyEx((agreement < _GROUND).astype(np.uint8), cv2.MORPH_OPEN, _disc(cv2, 1.5)) > 0
    label_of = np.where(prior, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    label_of[(agreement > _OTHER) & outer] = cv2.GC_PR_FGD
    label_of[inner & ~clean] = cv2.GC_FGD
    at, _ = view.project(box.points)
    seed = np.zeros((height, width), np.uint8)
    at = at[np.isfinite(at).all(axis=1)]
    at = at[(at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)].astype(int)
    seed[at[:, 1], at[:, 0]] = 1
    label_of[(seed > 0) & prior & ~clean] = cv2.GC_FGD
    near = cv2.dilate(drawn, _disc(cv2, 2 * cell)) > 0
    label_of[clean & ~inner] = cv2.GC_PR_BGD  # what lies flat on the ground looks like it: colours decide
    label_of[clean & ~near] = cv2.GC_BGD
    label_of[~inside | ~outer] = cv2.GC_BGD
    if not ((label_of == cv2.GC_FGD) | (label_of == cv2.GC_PR_FGD)).any():
        return np.zeros((height, width), bool)
    left, top, right, bottom = _around(outer & inside)
    window = slice(top, bottom), slice(left, right)
    part = np.ascontiguousarray(label_of[window])
    pixels = np.ascontiguousarray(view.pixels[window][..., ::-1])
    # of a picture of one colour GrabCut does not end
    if pixels.std() > 2 and ((part == cv2.GC_BGD) | (part == cv2.GC_PR_BGD)).any():
        cv2.setRNGSeed(0)
        cv2.grabCut(pixels, part, None, np.zeros((1, 65)), np.zeros((1, 65)), _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    mask = np.zeros((height, width), bool)
    mask[window] = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    return _tidy(cv2, mask)


def _tidy(cv2: Any, mask: Array) -> Array:
    """Without specks and pinholes."""
    parts, count = label(mask)
    if count > 1:
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        mask = (sizes >= max(_SMALL * sizes.max(), 9))[parts]
    filled = binary_fill_holes(mask)
    holes, count = label(filled & ~mask)
    sizes = np.bincount(holes.ravel(), minlength=count + 1)
    return mask | ((sizes < 1e-3 * max(mask.sum(), 1))[holes] & (holes > 0))
