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
import logging
import re
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

from ..errors import AssetError, EngineError, UsageError
from . import sampling
from .find_blender import find_blender
from .frame_lines import FrameLines
from .frame_range import check_template, frame_path, parse_frames
from .output import check_suffix, check_writable
from .progress import bar

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs render shot.blend --frames 1-24 --out 'frames/####.exr'
  drgs render shot.blend --frames 1-24x2,30 --out 'frames/####.exr' --rays 128 --denoise svgf --passes all
  drgs render shot.blend --frames 7 --out still.exr --blender /opt/blender/blender
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs render``."""
    parser.add_argument("scene", type=Path, metavar="SCENE.blend", help="Blender file")
    parser.add_argument("--frames", required=True, help="frames: 1-24, every second 1-24x2, several 1-24x2,30")
    parser.add_argument(
        "--out",
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
    sampling.add_arguments(parser, defaults=False)


def run(args: argparse.Namespace) -> int:
    """Render every frame that is not there yet."""
    frames = parse_frames(args.frames)
    scene = args.scene.resolve()
    template = str(scene.parent / args.out[2:]) if args.out.startswith("//") else args.out
    check_template(template, frames)
    check_suffix(Path(template), (".exr",))
    if not scene.is_file():
        raise AssetError(str(args.scene), "does not exist", "Check the path of the .blend file")
    check_writable(frame_path(template, frames[0]))
    blender = find_blender(args.blender)
    logger.info("Blender: %s (%s)", blender.program, blender.origin)

    from ..engine.client import EngineClient, engine_command
    from . import frame_store
    from .blender_process import BlenderProcess

    job = {"scene": str(scene), "frames": frames, "scripts": args.enable_scripts}
    assets: dict[str, Path] = {}
    noted: set[str] = set()
    done: set[int] = set()
    files: dict[str, str] = {}
    with FrameLines() as lines, EngineClient(engine_command(sys.executable)) as engine:

        def key_of(path: Path) -> str:
            key = engine.load_asset(str(path))
            assets[key] = path
            return key

        def note(texts: list[str]) -> None:
            for text in sorted(set(texts) - noted):
                lines.note(text)
            noted.update(texts)

        with BlenderProcess(blender, job, key_of) as process, bar(args, "frames", len(frames)) as progress:
            for number, layer, scene_frame, warnings in process.frames():
                note(warnings)
                path = layer_path(frame_path(template, number), layer)
                claim(files, path, layer)
                frame = replace(
                    scene_frame,
                    settings=sampling.override(scene_frame.settings, args),
                    passes=args.passes or scene_frame.passes,
                )
                sampling.check_size(frame.camera, frame.passes)
                settings = frame_store.settings_hash(frame, assets)
                if not args.overwrite and frame_store.is_complete(path, frame, settings):
                    lines.skipped(path)
                else:
                    lines.begin(number)
                    pictures = engine.render(frame, partial(lines.progress, number))
                    note(pictures.warnings)
                    frame_store.save(path, pictures, frame, number, settings)
                    lines.saved(path)
                progress.update(number not in done)
                done.add(number)
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
