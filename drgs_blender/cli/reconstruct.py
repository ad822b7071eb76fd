"""Make an asset from photographs: surfels, a closed mesh, materials and light.

CAPTURE is a folder or file of NeRF-synthetic, NGP, nerfstudio, COLMAP, LLFF, NeRO GlossySynthetic or TensoIR. Of a
folder of photographs or a video without cameras these are found first, as by `drgs capture`, in A.capture. A run that
was stopped goes on when the same command is given again. While surfels are learned, a picture beside the output,
A.preview.png, shows a view as it is now and its photograph.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.file_types import CAMERAS
from ..core.phases import is_preparing
from ..formats.axes import UP_AXES
from .frame_lines import emit
from .interrupt import interruptible
from .output import check_suffix, check_writable, write_and_report
from .progress import WORK_SECONDS, FractionBar
from .sampling import above_zero, int_range

if TYPE_CHECKING:
    from ..reconstruct.capture.capture import Capture
    from ..reconstruct.pipeline import Progress

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs reconstruct lego --out lego.drgs --resolution 400 --time-budget 10
  drgs reconstruct statue/colmap --out statue.drgs --test-every 8 --variant m
"""

#: Seconds between two lines of progress on stdout.
_REPORT_EVERY = 2.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs reconstruct``."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder or file of photographs, or a video")
    parser.add_argument("--out", type=Path, required=True, metavar="A.drgs", help="asset to write")
    parser.add_argument(
        "--variant",
        choices=("p", "m"),
        default="p",
        help="p keeps free surfels, for particles and for meshes (default); m attaches them to the mesh's faces",
    )
    parser.add_argument(
        "--resolution", type=int_range(8, 1 << 16), metavar="N", help="pixels of the longer side; default: all"
    )
    parser.add_argument(
        "--iterations", type=int_range(1, 10**7), metavar="N", help="steps of the surfels; default 3000"
    )
    parser.add_argument(
        "--surfels",
        type=int_range(10, 5_000_000),
        metavar="N",
        help="at most, before --variant m makes its own; default 16000",
    )
    parser.add_argument(
        "--voxels", type=int_range(16, 1024), metavar="N", help="of the mesh's longest side; default 256"
    )
    parser.add_argument(
        "--time-budget",
        type=above_zero("not a time"),
        metavar="M",
        help="minutes of all stages together, about, once kernels are compiled",
    )
    parser.add_argument(
        "--test-every",
        type=int_range(2, 10**6),
        metavar="K",
        help="leave out every K-th view, and measure on those; if the capture does not say which",
    )
    parser.add_argument(
        "--materials",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="separate materials from lighting; without, the albedo is the photographed colour",
    )
    parser.add_argument(
        "--masks",
        choices=("given", "auto", "none"),
        default="given",
        help="given: use masks that are there (default); auto: make them where there are none, of an object on a "
        "ground that shows texture; none: use none, the surroundings are learned, too",
    )
    parser.add_argument(
        "--device",
        choices=("cpu", "cuda"),
        default="cpu",
        help="device of the optimisation: cpu or cuda; falls back to cpu. Default cpu",
    )
    parser.add_argument(
        "--axes",
        choices=tuple(CAMERAS),
        default="opengl",
        help="convention of the camera matrices; default opengl: that of the layout",
    )
    parser.add_argument("--up", choices=tuple(UP_AXES), help="up axis of the capture's world; default: found")


def run(args: argparse.Namespace) -> int:
    """Reconstruct one capture."""
    check_suffix(args.out, (".drgs",))
    check_writable(args.out, (args.capture,))

    from ..core.errors import Cancelled, DeviceError

    try:
        from ..reconstruct.pipeline import Settings, reconstruct
    except ImportError as error:
        if error.name != "torch":
            raise
        raise DeviceError(
            "reconstruct", "needs PyTorch", f'Install it: "{sys.executable}" -m pip install "torch>=2.5"'
        ) from error
    from ..reconstruct.optim.schedule import Schedule
    from ..reconstruct.readers import read_capture

    source = _with_cameras(args)
    capture = read_capture(source, args.resolution, args.test_every, args.axes, args.up)
    _mask(args, capture)
    logger.info("%d views to learn from, %d left out", len(capture.training), len(capture.testing))
    given = {"iterations": args.iterations, "surfels": args.surfels}
    settings = Settings(
        variant=args.variant,
        schedule=Schedule(**{name: value for name, value in given.items() if value is not None}),
        mesh_resolution=args.voxels or Settings().mesh_resolution,
        minutes=args.time_budget,
        materials=args.materials,
        device=args.device,
    )
    work = args.out.with_name(f"{args.out.stem}.reconstruct")

    def note(text: str) -> None:
        if not args.quiet and any(work.glob("*.state")):
            emit(f"drgs: {text}\n", sys.stderr)

    note(f"an earlier run was stopped: going on with {work}, where it is of these photographs and settings")
    with interruptible() as cancelled, FractionBar(args, "reconstructing") as bar:
        try:
            asset = reconstruct(capture, settings, _Teller(args, bar), cancelled, work)
        except (Cancelled, KeyboardInterrupt):
            note("the same command goes on from here")
            raise
        finally:
            _remove_if_empty(work)  # where there is nothing to go on from
    write_and_report(args.out, asset)
    _clear(work)
    report = asset.provenance["report"]
    if "psnr" in report:
        # Not what `drgs evaluate` says, which renders the asset under the light that was found.
        print(f"  colours as photographed, views left out: PSNR {report['psnr']:.2f} dB, SSIM {report['ssim']:.4f}")
    if "decoupling" in report:
        shown = report["decoupling"]["psnr"]
        print(f"  materials in the light that was found, pixels learned from: PSNR {shown:.2f} dB")
    return 0


def _with_cameras(args: argparse.Namespace) -> Path:
    """The capture, or one made of photographs without cameras, beside the output."""
    from ..reconstruct.readers import has_cameras

    if has_cameras(args.capture):
        return args.capture
    from ..capture.pictures import has_pictures

    if not has_pictures(args.capture):
        return args.capture  # the readers say what is wrong with it
    from ..capture.pipeline import Settings, make_capture

    folder = args.out.with_name(f"{args.out.stem}.capture")
    if not args.quiet:
        emit(f"drgs: {args.capture} has no cameras: they are found first, in {folder}\n", sys.stderr)
    with interruptible() as cancelled, FractionBar(args, "capturing", every=WORK_SECONDS) as bar:
        made = make_capture(args.capture, folder, Settings(masks=args.masks), _telling(args, bar), cancelled)
    for line in made.lines if not args.quiet else ():
        emit(f"drgs: {line}\n", sys.stderr)
    return folder


def _telling(args: argparse.Namespace, bar: FractionBar) -> Callable[[str, float], None]:
    """Called as (phase, part done): the bar, and lines on stdout that programs may read."""
    said = 0.0

    def tell(phase: str, part: float) -> None:
        nonlocal said
        bar(phase, part)
        if not args.quiet and not sys.stdout.isatty() and time.monotonic() >= said + _REPORT_EVERY:
            said = time.monotonic()
            print(f'DRGS_PROGRESS part={part:.3f} surfels=0 phase="{phase}"', flush=True)

    return tell


def _mask(args: argparse.Namespace, capture: Capture) -> None:
    """Make masks of a capture that has none, or leave them out, as `--masks` says."""
    from ..capture.masks.of_capture import mask_capture

    with interruptible() as cancelled, FractionBar(args, "finding the object", every=WORK_SECONDS) as bar:
        sheet = args.out.with_name(f"{args.out.stem}.masks.png")
        mask_capture(capture, args.masks, sheet, _telling(args, bar), cancelled)


def _clear(folder: Path) -> None:
    """Remove what a run kept to go on from, and nothing else: a folder of this name may have been there before."""
    for pattern in ("*.state", ".*.state.*.tmp"):  # the latter of runs that were killed
        for file in folder.glob(pattern):
            with contextlib.suppress(OSError):
                file.unlink()
    _remove_if_empty(folder)


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


class _Teller:
    """Shows progress: a bar, lines on stdout that programs may read, the preview."""

    def __init__(self, args: argparse.Namespace, bar: FractionBar) -> None:
        self._bar, self._next = bar, 0.0
        self._lines = not args.quiet and not sys.stdout.isatty()  # they are for programs, and would break the bar
        self._preview = args.out.with_name(f"{args.out.stem}.preview.png")

    def __call__(self, progress: Progress) -> None:
        known = progress.psnr is not None
        surfels = f", {progress.surfels} surfels" if progress.surfels else ""
        about = "" if is_preparing(progress.phase) else f"{surfels}{f', {progress.psnr:.1f} dB' if known else ''}"
        self._bar(f"{progress.phase}{about}", progress.part)
        now = time.monotonic()
        if self._lines and now >= self._next:
            self._next = now + _REPORT_EVERY
            psnr = f"psnr={progress.psnr:.2f} " if known else ""
            print(
                f'DRGS_PROGRESS part={progress.part:.3f} surfels={progress.surfels} {psnr}phase="{progress.phase}"',
                flush=True,
            )
        if progress.picture is not None:
            from ..formats.images import write_png

            write_png(self._preview, (progress.picture * 255 + 0.5).astype("uint8"))
