"""Make an asset from photographs: surfels, a closed mesh, materials and light.

CAPTURE is a folder or file of NeRF-synthetic, NGP, nerfstudio, COLMAP, LLFF, NeRO GlossySynthetic or TensoIR. Of a
folder of photographs or a video without cameras these are found first, as by `drgs capture`, in A.capture. A run that
was stopped goes on when the same command is given again. While surfels are learned, a picture beside the output,
A.preview.png, shows a view as it is now and its photograph.

Every setting of both stages has a name (--print-settings, docs/reconstruct-settings.md), for a file (--config) and for
--set. Options and --set come before the file; the asset keeps them all, and --config A.drgs repeats its run.
"""

from __future__ import annotations

import argparse
import contextlib
import glob
import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import Cancelled, DeviceError, UsageError
from ..core.file_types import CAMERAS, TURNTABLE
from ..core.own_python import install_remedy
from ..core.phases import is_preparing
from ..formats.axes import UP_AXES
from .frame_lines import emit
from .interrupt import interruptible
from .output import check_suffix, check_writable, write_and_report
from .progress import FractionBar, ProgramLines, Steps, lines_wanted
from .sampling import above_zero, int_range
from .uncalibrated import FIELDS, MASKS_HELP, add_options, capture_settings, said_of_masks, tell_unused

if TYPE_CHECKING:
    from ..core.asset import Asset
    from ..reconstruct.capture.capture import Capture
    from ..reconstruct.pipeline import Progress
    from ..reconstruct.settings import Reading, Settings

logger = logging.getLogger(__name__)

#: As pip is told.
_TORCH = '"torch>=2.5"'

EXAMPLES = """examples:
  drgs reconstruct lego --out lego.drgs --resolution 400 --time-budget 10
  drgs reconstruct statue/colmap --out statue.drgs --test-every 8 --variant m
  drgs reconstruct --print-settings --set schedule.iterations=8000 > long.toml
  drgs reconstruct lego --out lego.drgs --config long.toml --set decoupling.metal_albedo_prior=0
  drgs reconstruct lego --out again.drgs --config lego.drgs
"""

#: Options -> the settings that they give.
OPTIONS = {
    "variant": "variant",
    "resolution": "capture.resolution",
    "iterations": "schedule.iterations",
    "surfels": "schedule.surfels",
    "voxels": "mesh_resolution",
    "time_budget": "minutes",
    "test_every": "capture.test_every",
    "materials": "materials",
    "device": "device",
    "axes": "capture.axes",
    "up": "capture.up",
    "turntable": "capture.turntable",
    "masks": "capture.masks",
    "normals": "capture.normals",
    **{name: f"capture.{name}" for name in FIELDS},
}

#: Parts of the whole bar that finding cameras takes, and each model that looks at the photographs.
_CAMERAS, _BY_MODEL = 0.3, 0.05
#: Seconds within which an asset is surely written: a younger half of one may be another process's.
_WRITTEN_WITHIN = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs reconstruct``."""
    parser.add_argument(
        "capture", type=Path, nargs="?", metavar="CAPTURE", help="folder or file of photographs, or a video"
    )
    parser.add_argument("--out", type=Path, metavar="A.drgs", help="asset to write; required")
    parser.add_argument(
        "--variant",
        choices=("p", "m"),
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
        help="at most, before --variant m makes its own; default: as many as the photographs show, up to 64000, or "
        "with a --time-budget 2700 per minute of it, from 16000 on",
    )
    parser.add_argument(
        "--voxels",
        type=int_range(16, 1024),
        metavar="N",
        help="of the mesh's longest side, none smaller than a pixel; default 512, or 256 with --variant m or a "
        "--time-budget",
    )
    parser.add_argument(
        "--time-budget",
        type=above_zero("not a time"),
        metavar="M",
        help="minutes of learning, about, once cameras and masks are found and kernels compiled",
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
        help="separate materials from lighting (default); without, the albedo is the photographed colour",
    )
    parser.add_argument("--masks", metavar="HOW", help=MASKS_HELP)
    parser.add_argument(
        "--normals",
        metavar="FILE",
        help="FILE.onnx: a model of normals that you have, which the first part of learning follows; default none",
    )
    parser.add_argument(
        "--device",
        choices=("cpu", "cuda"),
        help="device of the optimisation: cpu or cuda; falls back to cpu. Default cpu",
    )
    parser.add_argument(
        "--axes",
        choices=tuple(CAMERAS),
        help="convention of the camera matrices; default opengl: that of the layout",
    )
    parser.add_argument("--up", choices=tuple(UP_AXES), help="up axis of the capture's world; default: found")
    parser.add_argument(
        "--turntable",
        choices=TURNTABLE,
        help="yes: the object was turned, and the light stood still with the camera; no: the light stood still with "
        "the object; auto: as the surroundings of the object show (default)",
    )
    add_options(parser)
    group = parser.add_argument_group("all settings")
    group.add_argument(
        "--config", type=Path, metavar="FILE", help="TOML file of settings, or an asset whose settings to use again"
    )
    group.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="one setting, such as schedule.iterations=5000 or decoupling.normals=false; may be given several times",
    )
    group.add_argument("--print-settings", action="store_true", help="write all settings as TOML, and stop")


def run(args: argparse.Namespace) -> int:
    """Reconstruct one capture."""
    given = {OPTIONS[name]: value for name in OPTIONS if (value := getattr(args, name)) is not None}
    settings, reading = resolved_settings(args.config, given, args.set)
    if args.print_settings:
        from ..reconstruct.settings_file import as_toml

        print(as_toml(settings, reading), end="")
        return 0
    if args.capture is None or args.out is None:
        raise UsageError("reconstruct", "needs CAPTURE and --out A.drgs", "See `drgs reconstruct --help`")
    check_suffix(args.out, (".drgs",))
    check_writable(args.out, (args.capture,))

    reconstruct = reconstruction()
    from ..capture.inspection import tell_of_views
    from ..capture.masks.default_mode import resolve_mode
    from ..capture.masks.stage import check_mode
    from ..capture.normal_model import load_model
    from ..capture.pictures import check_pictures, has_pictures
    from ..reconstruct.readers import has_cameras, read_capture
    from ..reconstruct.settings_table import NONE, as_tables

    calibrated = has_cameras(args.capture)
    if not calibrated and not has_pictures(args.capture):
        check_pictures(args.capture)
        calibrated = True  # the readers say what else is wrong with it
    masks = resolve_mode(reading.masks, args.capture, calibrated)
    check_mode(masks)
    if reading.normals != NONE:
        load_model(reading.normals)
    steps = Steps(args, "reconstructing")
    source, told = (args.capture, False) if calibrated else _find_cameras(args, steps, reading, masks)
    capture = read_capture(
        source, reading.resolution, reading.test_every, reading.axes, reading.up, turntable=reading.turntable,
        tell_guesses=not told,
    )  # fmt: skip
    if calibrated:  # else `drgs capture` has looked at them
        tell_unused(reading, args.capture, calibrated)
        tell_of_views(capture)
    if calibrated or masks == "none" or _masks_after_cameras(reading, masks):  # else `drgs capture` has made them
        _mask(args, steps, capture, masks)
    if reading.normals != NONE:
        _give_normals(args, steps, capture, reading.normals)
    logger.info("%d views to learn from, %d left out", len(capture.training), len(capture.testing))
    work = args.out.with_name(f"{args.out.stem}.reconstruct")

    def note(text: str) -> None:
        if not args.quiet and any(work.glob("*.state")):
            emit(f"{text}\n", sys.stderr)

    note(f"an earlier run was stopped: going on with {work}, where it is of these photographs and settings")
    with interruptible() as cancelled, steps.step() as bar:
        try:
            asset = reconstruct(capture, settings, _Teller(args, bar), cancelled, work)
        except (Cancelled, KeyboardInterrupt):
            note("the same command goes on from here")
            raise
        finally:
            _remove_if_empty(work)  # where there is nothing to go on from
    # Beside those that `reconstruct` kept, of which some follow from the photographs and this machine.
    asset.provenance.setdefault("settings", as_tables(settings))["capture"] = as_tables(settings, reading)["capture"]
    write_and_report(args.out, asset)
    clear(work, args.out)
    report = asset.provenance["report"]
    taken = ", ".join(f"{phase} {done} of {of}" for phase, (done, of) in report["steps"].items())
    print(f"  steps: {taken}")
    if "psnr" in report:
        # Not what `drgs evaluate` says, which renders the asset under the light that was found.
        print(f"  colours as photographed, views left out: PSNR {report['psnr']:.2f} dB, SSIM {report['ssim']:.4f}")
    if "decoupling" in report:
        print(
            f"  materials in the light that was found, pixels learned from: PSNR {report['decoupling']['psnr']:.2f} dB"
        )
    shape = asset.mesh.vertices if len(asset.mesh.vertices) else asset.surfels.centre
    size = " x ".join(f"{side:.2g}" for side in shape.max(axis=0) - shape.min(axis=0))
    print(f"  size: {size} m; look: drgs relight {args.out} --orbit 12 --out '{args.out.stem}/####.png'")
    return 0


def reconstruction() -> Callable[..., Asset]:
    """`pipeline.reconstruct`, which is imported when it is needed. Raises DeviceError where PyTorch is absent."""
    try:
        import torch  # noqa: F401 - which the pipeline needs

        from ..reconstruct.pipeline import reconstruct
    except ImportError as error:
        if error.name != "torch":
            raise
        remedy = f"Install it: {install_remedy(_TORCH, 'Reconstruction from Photographs')}"
        raise DeviceError("reconstruct", "needs PyTorch", remedy) from error
    return reconstruct


def resolved_settings(config: Path | None, options: dict[str, Any], sets: list[str]) -> tuple[Settings, Reading]:
    """The settings that a file, options and --set give together, each before the one before it.

    Parameters
    ----------
    config : Path or None
        Of --config.
    options : dict of str to object
        Value by name of a setting.
    sets : list of str
        Of --set.

    Raises
    ------
    UsageError
        One cannot be used, or is given as an option and by --set.
    AssetError
        The asset of --config is damaged.
    """
    from ..reconstruct.settings import Reading, Settings
    from ..reconstruct.settings_file import parse_setting, read_settings
    from ..reconstruct.settings_table import with_values

    settings, reading = Settings(), Reading()
    if config is not None:
        settings, reading = with_values(settings, reading, read_settings(config), str(config))
    settings, reading = with_values(settings, reading, options)
    seen: set[str] = set()
    for text in sets:
        name, value = parse_setting(text)
        if name in options or name in seen:
            flags = {of: f"--{key.replace('_', '-')}" for key, of in OPTIONS.items()}
            other = flags[name] if name in options else "--set"
            raise UsageError(f"--set {text}", f"is given twice, also by {other}", "Leave one of them out")
        seen.add(name)
        settings, reading = with_values(settings, reading, {name: value}, "--set")
    settings.check()
    return settings, reading


def _find_cameras(args: argparse.Namespace, steps: Steps, reading: Reading, masks: str) -> tuple[Path, bool]:
    """A capture with cameras, made of photographs without, beside the output; whether its guesses have been told."""
    from ..capture.pipeline import make_capture

    folder = args.out.with_name(f"{args.out.stem}.capture")

    def note(text: str) -> None:
        if not args.quiet:  # without "drgs:", by which programs know warnings and errors
            emit(f"{text}\n", sys.stderr)

    chosen = f"; {said_of_masks(masks)}" if masks != reading.masks else ""
    note(f"{args.capture} has no cameras: they are found first, in {folder}{chosen}")
    tell_unused(reading, args.capture, calibrated=False)
    settings = capture_settings(reading, "given" if _masks_after_cameras(reading, masks) else masks)
    with interruptible() as cancelled, steps.step(_CAMERAS) as bar:
        made = make_capture(args.capture, folder, settings, _telling(args, bar), cancelled)
    for line in made.lines:
        note(line)
    if lines_wanted(args):
        print(f"DRGS_CAPTURE {folder}", flush=True)  # for programs that read the lines
    return folder, not made.kept


def _masks_after_cameras(reading: Reading, masks: str) -> bool:
    """Whether masks are made when the views that are left out are known, as these may not be learned from."""
    return masks == "auto" and reading.test_every is not None


def _telling(args: argparse.Namespace, bar: FractionBar) -> Callable[[str, float], None]:
    """Called as (phase, part done): the bar, and lines on stdout that programs may read."""
    lines = ProgramLines(args)

    def tell(phase: str, part: float) -> None:
        bar(phase, part)
        lines(phase, bar.of_all(part))

    return tell


def _mask(args: argparse.Namespace, steps: Steps, capture: Capture, masks: str) -> None:
    """Make masks of a capture that has none, or leave them out, as `capture.masks` says."""
    from ..capture.masks.of_capture import mask_capture

    with interruptible() as cancelled, steps.step(_BY_MODEL) as bar:
        sheet = args.out.with_name(f"{args.out.stem}.masks.png")
        mask_capture(capture, masks, sheet, _telling(args, bar), cancelled)


def _give_normals(args: argparse.Namespace, steps: Steps, capture: Capture, model: str) -> None:
    """Ask a model for the normals of the photographs."""
    from ..capture.normal_model import give_normals

    with interruptible() as cancelled, steps.step(_BY_MODEL) as bar:
        give_normals(capture, model, _telling(args, bar), cancelled)


def clear(folder: Path, made: Path) -> None:
    """Remove what a run kept to go on from, and nothing else: a folder of this name may have been there before.

    Of runs that were killed as they wrote a state or what they had `made`, half of it as well.
    """
    for file in (*folder.glob("*.state"), *folder.glob(".*.state.*.tmp")):
        with contextlib.suppress(OSError):
            file.unlink()
    for file in made.parent.glob(f".{glob.escape(made.name)}.*.tmp"):
        with contextlib.suppress(OSError):
            if file.stat().st_mtime < time.time() - _WRITTEN_WITHIN:
                file.unlink()
    _remove_if_empty(folder)


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


class _Teller:
    """Shows progress: a bar, lines on stdout that programs may read, the preview."""

    def __init__(self, args: argparse.Namespace, bar: FractionBar) -> None:
        self._bar, self._lines = bar, ProgramLines(args)
        self._preview = args.out.with_name(f"{args.out.stem}.preview.png")

    def __call__(self, progress: Progress) -> None:
        known = progress.psnr is not None
        surfels = f", {progress.surfels} surfels" if progress.surfels else ""
        about = "" if is_preparing(progress.phase) else f"{surfels}{f', {progress.psnr:.1f} dB' if known else ''}"
        self._bar(f"{progress.phase}{about}", progress.part)
        self._lines(progress.phase, self._bar.of_all(progress.part), progress.surfels, progress.psnr)
        if progress.picture is not None:
            from ..formats.images import write_png

            write_png(self._preview, (progress.picture * 255 + 0.5).astype("uint8"))
