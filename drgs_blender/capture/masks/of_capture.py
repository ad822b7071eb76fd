"""Masks of a capture that has cameras and no masks, before it is reconstructed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import first_of
from ...reconstruct.capture.capture import Capture, View
from ...reconstruct.meshing.visual_hull import have_silhouettes
from ...reconstruct.readers.lens import Lens
from .. import libraries
from ..capture_folder import known_ground
from ..features import Tell
from ..registration import Registration
from ..world_alignment import GUESSED, LOWEST, PLANE, align_to_ground
from .contact_sheet import draw_contact_sheet
from .making import make_masks
from .mask_view import MaskView
from .segmentation_model import SegmentationModel, load_model, masks_by_model
from .settling import REMEDY, resized, whole
from .stage import ABOVE_LOWEST, MODEL_UNUSED, MODES, ONLY_SOME, check_given

logger = logging.getLogger(__name__)

_NO_PLANE = "the plane on which the object stands is not known"
#: Masks that are checked against each other: no fewer, and of more evenly chosen ones.
_FEWEST, _CHECKED = 6, 120
#: Voxels of their hull, along its longest side: enough to find masks that cut the object.
_COARSE = 44


def mask_capture(capture: Capture, mode: str, sheet: Path, tell: Tell, cancelled: Callable[[], bool]) -> None:
    """Give the views masks where none has one ("auto", or a model), or take theirs away ("none"), in place.

    Those that are given ("given") are held against each other; with a warning they stay as they are. Masks are learned
    from training views alone; views left out get those of what is learned, as they see it. A model makes those of all.

    Parameters
    ----------
    capture : Capture
    mode : str
        One of `stage.MODES`, or a segmentation model.
    sheet : Path
        Contact sheet to write where masks are made, or given ones do not fit.
    tell, cancelled : callable

    Raises
    ------
    DeviceError
        Masks are to be made, and a library is absent, see `stage.check_mode`.
    Cancelled
        `cancelled` said so.
    """
    sheet.unlink(missing_ok=True)  # of another run
    if mode == "none":
        for view in capture.views:
            view.set_mask(None)
        capture.background = None
        return
    subject = str(capture.source)
    if mode == "given":
        _check_given(capture, sheet, subject)
        return
    if have_silhouettes(capture):
        if mode not in MODES:
            logger.warning(MODEL_UNUSED, subject, mode)
        return
    if masked := sum(view.mask is not None for view in capture.training):
        logger.warning(ONLY_SOME, subject, masked, len(capture.training))
        return
    cv2: Any = libraries.load("opencv")
    if mode not in MODES:
        _by_model(load_model(mode), capture, cv2, sheet, tell, cancelled)
        return
    points = np.zeros((0, 3)) if capture.points is None else np.asarray(capture.points, np.float64)
    matrices = {view.name: np.asarray(view.camera.matrix_world, np.float64) for view in capture.views}
    found = Registration(matrices, {}, {}, {}, points, np.zeros((len(points), 3), np.uint8), "")
    ground = _to_ground(found, capture.source)
    if ground is None:
        logger.warning("%s: %s (no sparse points on it, nor a marker sheet): no masks are made. %s",
                       subject, _NO_PLANE, REMEDY)  # fmt: skip
        return
    if ground == LOWEST:
        logger.warning("%s: %s. %s", subject, _NO_PLANE, ABOVE_LOWEST.format(sheet.name))
    views = [_mask_view(view, found.matrices[view.name]) for view in capture.training]
    made, _ = make_masks(cv2, views, found.points, sheet, subject, tell, cancelled)
    if made is None:
        return
    for k, view in enumerate(capture.training):
        height, width = view.colour.shape[:2]
        view.set_mask(made.whole(k, (height, width), (width, height)).astype(np.float32) / 255, made.band(k))
    for view in capture.testing:
        if view.mask is None:
            view.set_mask(made.seen_by(cv2, _mask_view(view, found.matrices[view.name])).astype(np.float32) / 255)


def _check_given(capture: Capture, sheet: Path, subject: str) -> None:
    """Name masks that do not fit the others, and draw all; nothing where too few are there, or OpenCV is not."""
    views = [view for view in capture.training if view.mask is not None]
    if len(views) < _FEWEST or not libraries.is_there("opencv"):
        return
    views = views[:: -(-len(views) // _CHECKED)]
    cv2: Any = libraries.load("opencv")
    small = [whole(_mask_view(view, np.asarray(view.camera.matrix_world, np.float64))) for view in views]
    drawn = [np.asarray(view.mask, np.float32) * 255 for view in views]
    masks = [resized(mask.astype(np.uint8), one) for mask, one in zip(drawn, small, strict=True)]
    fits = check_given(cv2, small, masks, _COARSE)
    doubtful = [str(fit) for fit in fits if fit.wrong]
    if doubtful:
        draw_contact_sheet(sheet, small, masks, fits)
        logger.warning(
            "%s: %d of %d masks do not fit the others, or their cameras do not: %s. Look at %s; draw them again, leave "
            "these photographs out, or give --masks none", subject, len(doubtful), len(fits), first_of(doubtful), sheet,
        )  # fmt: skip


def _by_model(model: SegmentationModel, capture: Capture, cv2: Any, sheet: Path, tell: Tell,
              cancelled: Callable[[], bool]) -> None:  # fmt: skip
    """Masks of all views by a model, where they fit each other."""
    views = [_mask_view(view, np.asarray(view.camera.matrix_world, np.float64)) for view in capture.views]
    masks, _ = masks_by_model(model, cv2, views, sheet, str(capture.source), tell, cancelled)
    if masks is None:
        return
    for view, mask in zip(capture.views, masks, strict=True):
        view.set_mask(mask.astype(np.float32) / 255)


def _to_ground(found: Registration, source: Path) -> str | None:
    """Bring cameras and points onto the ground; what it rests on, None where it is not known.

    Captures that `drgs capture` made say what their ground rests on, and are on it.
    """
    folder = source if source.is_dir() else source.parent
    above = all(matrix[2, 3] > 0 for matrix in found.matrices.values())  # not where the world has been turned
    known = known_ground(folder)
    if above and known not in (None, GUESSED):
        return known
    aligned = align_to_ground(found)
    aligned.apply(found)
    return PLANE if aligned.ground_from == PLANE else None


def _mask_view(view: View, matrix: np.ndarray) -> MaskView:
    camera = view.camera
    lens = Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return MaskView(view.name, (view.colour * 255 + 0.5).astype(np.uint8), matrix, lens)
