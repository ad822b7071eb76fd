"""Masks by a segmentation model that the user has: an ONNX file, by path or by the name that rembg gives it.

Nothing is downloaded. Pictures are prepared as the program that published a model does it (`KNOWN`).
"""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from ...core.arrays import Array
from ...core.errors import AssetError, Cancelled, UsageError, first_of
from ..features import Tell
from ..picture_model import IMAGENET, PictureModel, Preparation
from .hull_check import Fit
from .mask_view import MaskView
from .settling import REMEDY, hull_of_masks, resized, settle, whole

logger = logging.getLogger(__name__)

#: Beginning of a file's name -> how pictures are prepared (of rembg 2.0.76, MIT, and of the models' own programs); the
#: longest that fits counts, the last is for all others.
KNOWN = {
    "u2net": Preparation(320, *IMAGENET),
    "silueta": Preparation(320, *IMAGENET),
    "isnet": Preparation(1024, IMAGENET[0], (1.0, 1.0, 1.0)),
    "birefnet": Preparation(1024, *IMAGENET),
    "bria-rmbg": Preparation(1024, *IMAGENET),
    "rmbg-1.4": Preparation(1024, (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)),
    "": Preparation(1024, *IMAGENET),
}
#: A model whose largest value is below it sees nothing; one whose least value is as near to 1, an object all over.
_NOTHING = 0.1


def find_model(given: str) -> Path | None:
    """The file of a model, by its path or by its name in rembg's folder; None where there is none.

    Parameters
    ----------
    given : str
        As in "models/mine.onnx" or "isnet-general-use".
    """
    if Path(given).is_file():
        return Path(given)
    home = _home()
    return next((path for path in (home / given, home / f"{given}.onnx") if path.is_file()), None)


def _home() -> Path:
    """The folder of rembg's models, as rembg finds it."""
    return Path(os.path.expanduser(os.environ.get("U2NET_HOME") or f"{os.environ.get('XDG_DATA_HOME') or '~'}/.u2net"))


def model_file(given: str, modes: tuple[str, ...] = ()) -> Path:
    """`find_model`; UsageError where there is none, which names the `modes` that may stand in its place."""
    path = find_model(given)
    if path is None:
        problem = f"is {given!r}: no file of that name, nor a model in {_home()}"
        choice = f"Choose from {', '.join(modes)}, or give" if modes else "Give"
        raise UsageError("masks", problem, f"{choice} a segmentation model in ONNX format")
    return path


@functools.cache
def load_model(given: str) -> SegmentationModel:
    """`SegmentationModel`, read once in a process."""
    return SegmentationModel(given)


class SegmentationModel(PictureModel):
    """A model that tells the object of a picture from all else.

    Parameters
    ----------
    given : str
        As of `find_model`.

    Raises
    ------
    AssetError, DeviceError
        As of `PictureModel`.
    UsageError
        There is no such file.
    """

    def __init__(self, given: str) -> None:
        super().__init__(model_file(given), KNOWN, "segmentation")

    def __call__(self, pixels: Array, subject: str) -> Array:
        """How sure the model is of the object, in [0, 1].

        Parameters
        ----------
        pixels : (h, w, 3) uint8 array
            sRGB.
        subject : str
            Of the picture, for messages.

        Returns
        -------
        (h, w) float32 array

        Raises
        ------
        AssetError
            What the model gives is no mask.
        """
        height, width = pixels.shape[:2]
        found, *_ = self.run(pixels, subject, max(int(pixels.max()), 1))  # as rembg does
        if found.ndim not in (3, 4) or found.shape[0] != 1 or found.size != found.shape[-1] * found.shape[-2]:
            raise AssetError(str(self.path), f"gives values of the shape {found.shape}",
                             "A segmentation model gives one mask: (1, 1, height, width)")  # fmt: skip
        found = found.reshape(found.shape[-2:])
        low, high = float(found.min()), float(found.max())
        if low < 0 or high > 1:  # logits
            found = (1 / (1 + np.exp(-np.clip(found, -40, 40)))).astype(np.float32)
            low, high = float(found.min()), float(found.max())
        if high < _NOTHING or low > 1 - _NOTHING or high <= low:  # nothing, or all, is the object
            return np.full((height, width), high > 0.5, np.float32)
        whole = Pillow.fromarray((found - low) / (high - low)).resize((width, height), Pillow.Resampling.BILINEAR)
        return np.asarray(whole)


def masks_by_model(model: SegmentationModel, cv2: Any, views: Sequence[MaskView], sheet: Path, subject: str, tell: Tell,
                   cancelled: Callable[[], bool]) -> tuple[list[Array] | None, list[Fit]]:  # fmt: skip
    """Masks that a segmentation model makes, held against each other.

    Parameters
    ----------
    model : SegmentationModel
    cv2 : module
        OpenCV.
    views : sequence of MaskView
    sheet : Path
        Contact sheet to write.
    subject : str
        For messages.
    tell, cancelled : callable

    Returns
    -------
    masks : list of (h, w) uint8 arrays, optional
        In the size of the views; None, with a warning, where they do not fit each other.
    fits : list of Fit

    Raises
    ------
    AssetError
        The model fails on a picture.
    Cancelled
        `cancelled` said so.
    """
    drawn = []
    for k, view in enumerate(views):
        tell("masks", k / len(views))
        if cancelled():
            raise Cancelled
        drawn.append((model(view.pixels, view.name) * 255 + 0.5).astype(np.uint8))
    if nothing := [view.name for view, mask in zip(views, drawn, strict=True) if mask.max() < 128]:
        logger.warning(
            "%s: %s finds no object in %s: these masks are empty", subject, model.path.name, first_of(nothing)
        )
    small = [whole(view) for view in views]
    masks = [resized(mask, view) for mask, view in zip(drawn, small, strict=True)]
    hull = hull_of_masks(cv2, small, masks)
    if hull is None:
        logger.warning("%s: the masks of %s have no part of the space in common: none are used. %s", subject,
                       model.path.name, REMEDY)  # fmt: skip
        return None, []
    settled = list(masks)
    fit, fits = settle(cv2, small, settled, hull, sheet, subject)
    for k, (old, new) in enumerate(zip(masks, settled, strict=True)):
        if new is not old:
            height, width = views[k].shape
            outline = Pillow.fromarray(new.astype(np.uint8) * 255)
            drawn[k] = np.asarray(outline.resize((width, height), Pillow.Resampling.BILINEAR))
    return drawn if fit else None, fits
