"""Render frames of a .blend file through Blender with DR-GS, whatever engine the file selects.

Blender evaluates each frame as for a final render; the DR-GS engine makes the picture; this program writes it, in one
step, and reads it back before it says `Saved:`. Frames that are already there, complete and made with the same
settings, scene and assets, are skipped, so an interrupted job is simply started again.

Blender is --blender, the variable DRGS_BLENDER, `blender` on the PATH, or .venv-blender of a checkout. It may be the
program or a Python that has the module bpy. The extension need not be installed when drgs runs from a checkout.

The last line is DRGS_EXIT class=ok, or the class of what went wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import AssetError, EngineError, UsageError, without_numbers
from ..core.frame_sequences import frame_path
from ..core.phases import is_preparing
from . import sampling, session_link
from .find_blender import find_blender
from .frame_lines import FrameLines
from .frame_range import absolute_template, check_template, parse_frames
from .output import check_suffix, check_writable, file_pattern
from .progress import bar

if TYPE_CHECKING:
    from .machine import Machine

logger = logging.getLogger(__name__)


EXAMPLES = """examples:
  drgs render shot.blend --frames 1-24 --out 'frames/####.exr'
  drgs render shot.blend --frames 1-24x2,30 --out 'frames/####.exr' --samples 128 --denoise svgf --passes all
  drgs render shot.blend --frames 7 --out still.exr --blender /opt/blender/blender
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs render``."""
    parser.add_argument("scene", type=Path, metavar="SCENE.blend", help="Blender file")
    parser.add_argument("--frames", required=True, help="frames: 1-24, every second 1-24x2, several 1-24x2,30")
    parser.add_argument(
        "--out",
        type=file_pattern,
        required=True,
        metavar="PATTERN",
        help="EXR files; #### becomes the frame's number, // the scene's folder",
    )
    parser.add_argument(
        "--blender", metavar="PATH", help="blender program, or a Python (or its environment) that has bpy"
    )
    parser.add_argument("--overwrite", action="store_true", help="render frames that are already there, too")
    parser.add_argument(
        "--enable-scripts", action="store_true", help="let the file run its own Python scripts and drivers"
    )
    session_link.add_arguments(parser)
    group = parser.add_argument_group("machine")
    group.add_argument(
        "--memory-mb", type=sampling.int_range(256, 1 << 24), metavar="MB", help="most memory of the engine (Linux)"
    )
    group.add_argument(
        "--timeout", type=seconds, metavar="S", default=float("inf"), help="most seconds for a frame; then exit code 75"
    )
    sampling.add_arguments(parser, defaults=False)


def seconds(text: str) -> float:
    """A time that is longer than nothing."""
    value = sampling.number(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} is not a time")
    return value


def run(args: argparse.Namespace) -> int:
    """Render every frame that is not there yet, here or by the session's engine."""
    if args.session and (code := session_link.delegate(args.session, args.words)) is not None:
        return code
    from .machine import Machine

    with Machine() as machine:
        return render(args, machine)


def render(args: argparse.Namespace, machine: Machine) -> int:
    """Render every frame that is not there yet on `machine`."""
    frames = parse_frames(args.frames)
    scene = args.scene.resolve()
    template = absolute_template(args.out, scene)
    check_template(template, frames)
    check_suffix(Path(template), (".exr",))
    if not scene.is_file():
        raise AssetError(str(args.scene), "does not exist", "Check the path of the .blend file")
    check_writable(frame_path(template, frames[0]), (scene,))
    blender = find_blender(args.blender)
    logger.info("Blender: %s (%s)", blender.program, blender.origin)

    from . import frame_store
    from .picture import Picture

    frame_store.remove_abandoned(template)
    job = {"scene": str(scene), "frames": frames, "scripts": args.enable_scripts, "passes": args.passes}
    noted: set[str] = set()
    done: set[int] = set()
    files: dict[str, str] = {}
    engine = machine.engine(args.memory_mb)
    with (
        FrameLines(openjd=args.openjd and len(frames)) as lines,
        contextlib.closing(machine.frames(blender, job, args.timeout)) as evaluated,
        bar(args, "frames", len(frames)) as progress,
    ):

        def note(texts: list[str]) -> None:
            for text in sorted(text for text in set(texts) if without_numbers(text) not in noted):
                lines.note(text)
            noted.update(map(without_numbers, texts))

        for shot in evaluated:
            note(shot.warnings)
            number, path = shot.number, layer_path(frame_path(template, shot.number), shot.layer)
            claim(files, path, shot.layer)
            picture = Picture(shot, partial(sampling.override, args=args))
            sampling.check_size(picture.frame.camera, picture.frame.passes)
            if (
                not args.overwrite
                and path.is_file()
                and frame_store.is_complete(path, picture.frame, picture.settings_hash(machine.assets))
            ):
                lines.skipped(path)
            else:
                lines.begin(number, picture.frame.settings.sample_count)

                def report(phase: str, fraction: float, number: int = number) -> None:
                    lines.progress(number, phase, fraction)
                    progress.set_description(phase if is_preparing(phase) else "frames")

                try:
                    passes, settings = picture.render(engine, machine.assets, report, args.timeout)
                except AssetError:
                    machine.check_assets()  # one that is just being rewritten is not a damaged one
                    raise
                note(shot.warnings + passes.warnings)
                machine.check_assets()
                frame_store.save(path, passes, picture.frame, number, settings)
                lines.saved(path)
            progress.update(number not in done)
            done.add(number)
            lines.finished(len(done))
    if missing := [number for number in frames if number not in done]:
        raise EngineError("Blender", f"did not evaluate frame {missing[0]} and {len(missing) - 1} more", "Try again")
    return 0


def layer_path(path: Path, layer: str) -> Path:
    """File of a view layer: where a scene has several, the layer's name goes before the suffix."""
    safe = re.sub(r"[^\w.-]+", "_", layer)
    return path.with_name(f"{path.stem}_{safe}{path.suffix}") if layer else path


def claim(files: dict[str, str], path: Path, layer: str) -> None:
    """Note in `files` that `path` is of `layer`; UsageError when it is another's (or is where case is ignored)."""
    other = files.setdefault(str(path).casefold(), layer)
    if other != layer:
        remedy = "Rename one of them"
        raise UsageError(f"view layers {other!r} and {layer!r}", f"would both be written to {path.name}", remedy)
