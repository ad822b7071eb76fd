"""Photographs without cameras: options and settings that `drgs capture` and `drgs reconstruct` share."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from .sampling import above_zero, int_range

if TYPE_CHECKING:
    from ..capture.pipeline import Settings
    from ..reconstruct.settings import Reading

logger = logging.getLogger(__name__)

#: Options, named as the fields of `Reading` -> the fields of `capture.pipeline.Settings` that they give.
FIELDS = {
    "video_frames": "frames",
    "feature_resolution": "size",
    "poses": "poses",
    "marker_length": "marker_length",
    "camera_distance": "distance",
    "brackets": "brackets",
}
BRACKETS = ("auto", "none", *map(str, range(2, 10)))
MASKS_HELP = (
    "auto-without-cameras: auto where the photographs have no cameras, else given (default); given: use masks that are "
    "there; auto: make them where there are none, of an object on a ground that shows texture, in about two minutes; "
    "FILE.onnx, or a name: make them by this segmentation model; none: neither make nor use any, the surroundings are "
    "learned, too"
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of photographs without cameras; those that are not given are None."""
    group = parser.add_argument_group("photographs without cameras")
    group.add_argument(
        "--video-frames",
        type=int_range(10, 400),
        metavar="N",
        help="frames of a video that are used, about; default 90",
    )
    group.add_argument(
        "--poses",
        choices=("auto", "markers", "features"),
        help="find cameras by a marker sheet (drgs markers) or by features of the pictures; default auto: by the sheet "
        "where most pictures show it",
    )
    group.add_argument(
        "--marker-length",
        type=above_zero("no length"),
        metavar="MM",
        help="side of the sheet's black squares as measured; default: as printed in true size",
    )
    group.add_argument(
        "--camera-distance",
        type=above_zero("no length"),
        metavar="M",
        help="metres from the cameras to the object, typically, where no sheet gives the scale",
    )
    group.add_argument(
        "--feature-resolution",
        type=int_range(320, 8192),
        metavar="N",
        help="pixels of the longer side at which features and markers are sought; default 1600",
    )
    group.add_argument(
        "--brackets",
        choices=BRACKETS,
        metavar="N",
        help="merge exposure brackets to linear EXR pictures: auto: those that EXIF shows (default); a number from 2 "
        "to 9: so many files that follow each other are one; none",
    )


def capture_settings(reading: Reading, masks: str) -> Settings:
    """Settings of `make_capture`.

    Parameters
    ----------
    reading : Reading
    masks : str
        What its masks come to, see `masks.default_mode.resolve_mode`.
    """
    from ..capture.pipeline import Settings

    return Settings(masks=masks, **{field: getattr(reading, name) for name, field in FIELDS.items()})


def said_of_masks(mode: str) -> str:
    """What is done about masks, where that was left to the program."""
    return f"masks are {'made where none are given' if mode == 'auto' else 'used as given'} (--masks {mode})"


def tell_unused(reading: Reading, source: Path, calibrated: bool) -> None:
    """Warn of settings that are not the default and decide nothing, as of photographs that have cameras."""
    from ..capture.pictures import find_video
    from ..reconstruct.settings import Reading

    default = Reading()
    changed = [name for name in FIELDS if getattr(reading, name) != getattr(default, name)]
    if not calibrated:
        changed = [name for name in changed if name == "video_frames" and find_video(source) is None]
    if changed:
        names = ", ".join(f"capture.{name}" for name in changed)
        logger.warning("%s: %s: no effect, %s", source, names, "it has cameras" if calibrated else "it is no video")
    if not calibrated and reading.poses == "features" and reading.marker_length is not None:
        logger.warning("%s: capture.marker_length: no effect, capture.poses is features", source)
