"""Make a capture of photographs or a video without cameras: find where each picture was taken, and its lens.

INPUT is a folder of photographs (its masks in `masks`, if it has any) or a video. FOLDER gets the pictures, upright,
with `transforms.json`, which `drgs reconstruct` reads, sparse points, and a report: capture.png, capture.json. A run
that was stopped goes on when the same command is given again.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ..core.errors import Cancelled
from .frame_lines import emit
from .interrupt import interruptible
from .output import check_folders
from .progress import WORK_SECONDS, FractionBar
from .uncalibrated import FIELDS, MASKS_HELP, add_options, capture_settings, said_of_masks, tell_unused

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
    parser.add_argument("--masks", metavar="HOW", help=MASKS_HELP)
    add_options(parser)


def run(args: argparse.Namespace) -> int:
    """Make one capture."""
    from ..capture.capture_folder import INPUTS, WORK
    from ..capture.masks.default_mode import resolve_mode
    from ..capture.pipeline import make_capture
    from ..reconstruct.settings import Reading

    check_folders(args.out / WORK)
    given = {name: value for name in (*FIELDS, "masks") if (value := getattr(args, name)) is not None}
    reading = Reading(**given)
    masks = resolve_mode(reading.masks, args.input, calibrated=False)
    if masks != reading.masks and not args.quiet:
        emit(f"{args.input}: {said_of_masks(masks)}\n", sys.stderr)
    tell_unused(reading, args.input, calibrated=False)
    settings = capture_settings(reading, masks)
    work = args.out / WORK
    with interruptible() as cancelled, FractionBar(args, "capturing", every=WORK_SECONDS) as bar:
        try:
            made = make_capture(args.input, args.out, settings, bar, cancelled)
        except (Cancelled, KeyboardInterrupt):
            if (work / INPUTS).is_file() and not args.quiet:
                emit("the same command goes on from here\n", sys.stderr)
            raise
    if not args.quiet:
        print(f"{args.out}: {made.lines[0]}" if not made.kept else made.lines[0])
        for line in made.lines[1:]:
            print(f"  {line}")
    return 0
