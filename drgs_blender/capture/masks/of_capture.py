"""Masks of a capture that has cameras and no masks, before it is reconstructed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import DeviceError
from ...reconstruct.capture.capture import Capture, View
from ...reconstruct.meshing.visual_hull import have_silhouettes
from ...reconstruct.readers.lens import Lens
from .. import libraries
from ..features import Tell
from ..registration import Registration
from ..world_alignment import align_to_ground
from .making import make_masks
from .mask_view import MaskView

logger = logging.getLogger(__name__)


def mask_capture(capture: Capture, mode: str, sheet: Path, tell: Tell, cancelled: Callable[[], bool]) -> None:
    """Give the views masks where none has one ("auto"), or take theirs away ("none"), in place.

    Parameters
    ----------
    capture : Capture
    mode : str
        One of `stage.MODES`.
    sheet : Path
        Contact sheet to write where masks are made.
    tell, cancelled : callable

    Raises
    ------
    Cancelled
        `cancelled` said so.
    """
    if mode == "none":
        for view in capture.views:
            view.mask = None
        return
    if mode != "auto" or have_silhouettes(capture) or any(view.mask is not None for view in capture.views):
        return
    subject = str(capture.source)
    try:
        cv2: Any = libraries.load("opencv")
    except DeviceError as error:
        logger.warning("%s: masks are not made: %s", subject, error)
        return
    points = np.zeros((0, 3)) if capture.points is None else np.asarray(capture.points, np.float64)
    matrices = {view.name: np.asarray(view.camera.matrix_world, np.float64) for view in capture.views}
    found = Registration(matrices, {}, {}, {}, points, np.zeros((len(points), 3), np.uint8), "")
    align_to_ground(found).apply(found)
    views = [_mask_view(view, found.matrices[view.name]) for view in capture.views]
    made, _ = make_masks(cv2, views, found.points, sheet, subject, tell, cancelled)
    for k, view in enumerate(capture.views if made is not None else ()):
        height, width = view.colour.shape[:2]
        assert made is not None
        view.mask = made.whole(k, (height, width), (width, height)).astype(np.float32) / 255


def _mask_view(view: View, matrix: np.ndarray) -> MaskView:
    camera = view.camera
    lens = Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return MaskView(view.name, (view.colour * 255 + 0.5).astype(np.uint8), matrix, lens)
