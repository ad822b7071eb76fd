"""What is done about masks where nobody has said it: they are made where cameras have to be found, too."""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path

from ...core.errors import AssetError, DeviceError
from ..pictures import Picture, decode, find_pictures, find_video
from .stage import check_mode

logger = logging.getLogger(__name__)

#: The default of `capture.masks`: "auto" of photographs without cameras, which mostly show a room too, else "given".
AUTO_WITHOUT_CAMERAS = "auto-without-cameras"
_OPAQUE = (".jpg", ".jpeg")


def resolve_mode(mode: str, source: Path, calibrated: bool) -> str:
    """The mode of `stage.MODES`, or the model, that `mode` comes to.

    Parameters
    ----------
    mode : str
        `AUTO_WITHOUT_CAMERAS`, or what is returned as it is.
    source : Path
        Photographs or a video.
    calibrated : bool
        Whether they have cameras.

    Raises
    ------
    DeviceError
        Masks are to be made and a library for that is not there.
    """
    if mode != AUTO_WITHOUT_CAMERAS:
        return mode
    if calibrated:
        return "given"
    try:
        check_mode("auto")
    except DeviceError as error:
        if _has_masks(source):
            return "given"
        raise DeviceError(
            str(source),
            f"has no masks, and making them {error.problem}",
            f"{error.remedy}, or give --masks none: the surroundings are then learned with the object",
        ) from error
    return "auto"


def _has_masks(source: Path) -> bool:
    """Whether a picture has a mask, or alpha that counts."""
    pictures = [] if find_video(source) else find_pictures(source)
    return any(picture.mask is not None for picture in pictures) or any(map(_has_alpha, pictures))


def _has_alpha(picture: Picture) -> bool:
    with contextlib.suppress(AssetError):  # which is told later
        return picture.path.suffix.lower() not in _OPAQUE and decode(picture).shape[2] == 4
    return False
