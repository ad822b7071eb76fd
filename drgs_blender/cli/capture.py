"""Make a capture of photographs or a video without cameras: find where each picture was taken, and its lens.

INPUT is a folder of photographs (its masks in `masks`, if it has any) or a video. FOLDER gets the pictures, upright,
with `transforms.json`, which `drgs reconstruct` reads, sparse points, and a report: capture.png, capture.json. A run
that was stopped goes on when the same command is given again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from .interrupt import interruptible
from .progress import WORK_SECONDS, FractionBar
from .sampling import above_zero, int_range

EXAMPLES = """examples:
  drgs capture photographs --out statue
  drgs capture walk.mp4 --out statue --video-frames 120
  drgs capture photographs --out statue --poses markers --marker-length 29.4
  drgs capture turntable --out cup --brackets 3
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs capture``."""
    parser.add_argument("input", type=Path, metavar="INPUT", help="folder of photographs, or a video")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FOLDER", help="folder to write")
    parser.add_argument(
        "--video-frames",
        type=int_range(10, 400),
        default=90,
        metavar="N",
        help="frames of a video that are used, about; default 90",
    )
    parser.add_argument(
        "--poses",
        choices=("auto", "markers", "features"),
        default="auto",
        help="find cameras by a marker sheet (drgs markers) or by features of the pictures; default auto: by the sheet "
        "where most pictures show it",
    )
    parser.add_argument(
        "--marker-length",
        type=above_zero("no length"),
        metavar="MM",
        help="side of the sheet's black squares as measured; default: as printed in true size",
    )
    parser.add_argument(
        "--camera-distance",
        type=above_zero("no length"),
        metavar="M",
        help="metres from the cameras to the object, typically, where no sheet gives the scale",
    )
    parser.add_argument(
        "--feature-resolution",
        type=int_range(320, 8192),
        default=1600,
        metavar="N",
        help="pixels of the longer side at which features and markers are sought; default 1600",
    )
    parser.add_argument(
        "--brackets",
        type=_brackets,
        default="auto",
        metavar="N",
        help="merge exposure brackets to linear EXR pictures: auto: those that EXIF shows (default); a number: so many "
        "files that follow each other are one; none",
    )
    parser.add_argument(
        "--masks",
        default="given",
        metavar="HOW",
        help="given: use and check masks that are there (default); auto: make them where there are none, of an object "
        "on a ground that shows texture, in about two minutes; FILE.onnx, or a name: make them by this segmentation "
        "model; none: neither make nor use any",
    )


def _brackets(text: str) -> str:
    """Parser of the setting of brackets."""
    return text if text in ("auto", "none") else str(int_range(2, 9)(text))


def run(args: argparse.Namespace) -> int:
    """Make one capture."""
    from ..capture.pipeline import Settings, make_capture

    settings = Settings(
        args.video_frames,
        args.feature_resolution,
        args.poses,
        args.marker_length,
        args.camera_distance,
        args.masks,
        args.brackets,
    )
    with interruptible() as cancelled, FractionBar(args, "capturing", every=WORK_SECONDS) as bar:
        made = make_capture(args.input, args.out, settings, bar, cancelled)
    if not args.quiet:
        print(f"{args.out}: {made.lines[0]}" if not made.kept else made.lines[0])
        for line in made.lines[1:]:
            print(f"  {line}")
    return 0
