"""A .blend as the input of ``drgs convert``: Blender evaluates its frames, or writes them as Alembic itself."""

from __future__ import annotations

import argparse
import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.errors import AssetError, EngineError, UsageError
from ..core.file_types import LOST_IN_ALEMBIC
from ..core.frame_sequences import frame_path
from ..formats.writers import find_writer
from ..ipc.frame_file import SUFFIX, write_frame_file
from .blender_process import BlenderProcess
from .convert_sequence import check_one_file, is_sequence, refuse_options
from .find_blender import find_blender
from .frame_range import check_template, parse_frames
from .output import check_writable
from .progress import bar

logger = logging.getLogger(__name__)

#: Ending of Alembic.
ALEMBIC = ".abc"


@contextmanager
def evaluated_frames(args: argparse.Namespace) -> Iterator[argparse.Namespace | None]:
    """The arguments with the frames of the scene as Blender evaluated them for IN; None: Alembic, which is written.

    Raises
    ------
    UsageError, AssetError
        Options do not go together, or what Blender's side reports.
    EngineError, DeviceError
        Blender does not start, or died.
    """
    scene = args.input.resolve()
    if not scene.is_file():
        raise AssetError(str(args.input), "does not exist", "Check the path of the .blend file")
    if not args.frames:
        raise UsageError(str(args.input), "is a scene, whose frames are not said", "Say them: --frames 1-24")
    refuse_options(args, ("vertices", "env", "from_up"), "a .blend")
    frames = parse_frames(args.frames)
    check_writable(args.output, (scene,))
    _check_names(args, frames)
    job: dict[str, Any] = {
        "scene": str(scene),
        "frames": frames,
        "scripts": args.enable_scripts,
        "passes": ["Combined"],
    }
    if args.output.suffix.lower() == ALEMBIC:
        _write_alembic(args, job)
        yield None
        return
    with tempfile.TemporaryDirectory(prefix="drgs-convert-") as folder:
        template = str(Path(folder) / f"####{SUFFIX}")
        report = _write_frames(args, job | {"report": True, "surfaces": True}, template)
        of_scene = {"input": Path(template), "scene": args.input, "scene_fps": report["fps"]}
        yield argparse.Namespace(**(vars(args) | of_scene))


def _check_names(args: argparse.Namespace, frames: list[int]) -> None:
    """Refuse an OUT that cannot be written before Blender evaluates a frame."""
    if args.output.suffix.lower() == ALEMBIC:
        check_one_file(args.output)
    elif not is_sequence(args, frames):
        find_writer(args.output, [args.kind] if args.kind else ("mesh", "splats", "environment"))
        check_template(str(args.output), frames)


def _write_frames(args: argparse.Namespace, job: dict[str, Any], template: str) -> dict[str, Any]:
    """Describe the frames of a scene in files; what Blender says of it."""
    noted: dict[str, None] = {}
    done: set[int] = set()
    with (
        BlenderProcess(find_blender(args.blender), job, str) as blender,
        bar(args, "frames", len(job["frames"])) as shown,
    ):
        for evaluated in blender.frames():
            if evaluated.number in done:
                noted[f"view layer {evaluated.layer} is left out: the first one is written"] = None
                continue
            noted.update(dict.fromkeys(evaluated.warnings))
            write_frame_file(frame_path(template, evaluated.number), evaluated.frame)
            done.add(evaluated.number)
            shown.update()
        report = blender.report
    for text in noted:
        logger.warning("%s", text)
    if missing := [number for number in job["frames"] if number not in done]:
        raise EngineError("Blender", f"did not evaluate frame {missing[0]} and {len(missing) - 1} more", "Try again")
    return report


def _write_alembic(args: argparse.Namespace, job: dict[str, Any]) -> None:
    """Let Blender write the meshes."""
    for option in ("kind", "up", "colour", "surfels", "fps", "materials", "kernel", "compress", "spz_version"):
        if getattr(args, option):
            name = {"kind": "as"}.get(option, option).replace("_", "-")
            raise UsageError(f"--{name}", "is no option of Alembic, which Blender writes", "Leave it out")
    given = {"path": str(args.output.absolute()), "objects": args.object or [], "scale": args.scale}
    with BlenderProcess(find_blender(args.blender), job | {"alembic": given}, str) as blender:
        for _ in blender.frames():
            pass
        names = blender.report["objects"]
    if not args.output.is_file():
        raise EngineError("Blender", f"did not write {args.output}", "-vv shows what it prints")
    frames = job["frames"]
    print(f"{args.output}: frames {frames[0]} to {frames[-1]} of {', '.join(names)}, Alembic by Blender")
    print(f"  {LOST_IN_ALEMBIC}")
