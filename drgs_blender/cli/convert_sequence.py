"""All frames of ``drgs convert`` in one file: objects that move, as USD with a sample for each frame."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import UsageError
from ..core.file_types import USD_SUFFIXES
from ..core.frame_sequences import frame_path
from .output import check_writable
from .pose_file import is_point_cache, open_cache
from .progress import bar

if TYPE_CHECKING:
    from ..formats.usd_sequence import MovingObject
    from .convert_source import Source

#: Options that go to the writers of formats that take them.
OPTIONS = ("materials", "compress", "spz_version", "kernel", "surfels")
#: Frames per second of poses that do not say it.
FPS = 24.0


def is_sequence(args: argparse.Namespace, frames: Sequence[int] | None) -> bool:
    """Whether several frames go into one stage: it is asked for, or OUT is USD and has no number in its name."""
    stage = args.output.suffix.lower() in USD_SUFFIXES and "#" not in args.output.name
    return args.kind == "sequence" or (stage and args.kind != "environment" and len(frames or ()) > 1)


def check_one_file(path: Path) -> None:
    """Refuse a number in the name of a file that has all frames."""
    if "#" in path.name:
        raise UsageError(str(path), "has all frames, so its name has no number", "Leave out the #")


def refuse_options(args: argparse.Namespace, options: Sequence[str], what: str) -> None:
    """Refuse options, by their names in `args`, that do not go with what IN is. Raises UsageError."""
    for option in options:
        if getattr(args, option):
            name = {"kind": "as"}.get(option, option).replace("_", "-")
            raise UsageError(f"--{name}", f"does not go with {what}", "Leave it out")


def convert_sequence(args: argparse.Namespace, frames: Sequence[int] | None) -> None:
    """Write the frames, by default the only one that there is, as samples of one stage, and say what was written."""
    from ..formats.usd_sequence import write_usd_sequence
    from ..formats.usd_splats import check_usd
    from ..formats.writers import WRITERS, either
    from .convert_source import check_objects

    (writer,) = (w for w in WRITERS if w.name == "USD sequence")
    if args.output.suffix.lower() not in writer.extensions:
        raise UsageError(str(args.output), "holds no sequence", f"Name OUT {either(writer.extensions)}")
    check_one_file(args.output)
    if args.up not in (None, writer.up):
        raise UsageError("--up", f"is {args.up}, but {writer.name} is {writer.up} up", "Leave --up out")
    options = writer.chosen({name: getattr(args, name) for name in OPTIONS})
    surfels = bool(options.pop("surfels", False)) or args.kind == "splats"
    if options and not surfels:
        raise UsageError(f"--{next(iter(options))}", "is of surfels, which are not written", "Add --surfels")
    check_writable(args.output, (args.input, args.vertices, args.env))
    check_usd(str(args.output))
    numbers = sorted(frames) if frames else [args.frame or 1]
    span = f"frames {numbers[0]} to {numbers[-1]}" if len(numbers) > 1 else f"frame {numbers[0]}"
    told: dict[str, None] = {}
    counts: dict[str, tuple[int, int]] = {}
    seen: dict[str, None] = {}

    def moving() -> Iterator[tuple[int, list[MovingObject]]]:
        with bar(args, "frames", len(numbers)) as progress:
            for number, source in _sources(args, numbers, frames is not None):
                objects = [_scaled(state, args) for state in source.moving(args.kind != "splats", surfels)]
                told.update(dict.fromkeys(source.notes))
                seen.update(dict.fromkeys(getattr(source, "names", ())))
                for o in objects:
                    counts[o.name] = (
                        0 if o.mesh is None else len(o.mesh.faces),
                        0 if o.splats is None else len(o.splats),
                    )
                yield number, objects
                progress.update()
        check_objects(args, list(seen))
        if not counts:
            problem = f"has no DR-GS object that the camera sees in {span}"
            raise UsageError(str(args.scene or args.input), problem, "Show one in renders, or choose other frames")

    told.update(dict.fromkeys(write_usd_sequence(args.output, moving(), _fps(args), **options)))
    print(f"{args.output}: {span}, {_fps(args):g} per second, {writer.name}, z up")
    for name, (triangles, splats) in counts.items():
        print(f"  {name}: {triangles} triangles" + (f", {splats} surfels" if surfels or splats else ""))
    for note in told:
        print(f"  {note}")


def _sources(args: argparse.Namespace, numbers: Sequence[int], several: bool) -> Iterator[tuple[int, Source]]:
    """What IN is in each frame. Assets and scenes are kept between frames."""
    from ..core.asset.container import read_asset
    from ..engine.session import Session
    from ..ipc.frame_file import SUFFIX
    from .convert_source import AssetSource, FrameSource, open_source

    suffix = args.input.suffix.lower()
    asset = read_asset(args.input) if suffix == ".drgs" and "#" not in args.input.name else None
    session = Session() if suffix == SUFFIX else None
    moving = is_point_cache(args.vertices)
    for number in numbers:
        own = vars(args) | {"frame": number if moving else None, "name": args.input.stem.rstrip("#_.-") or "asset"}
        for name in ("input", "vertices"):
            if several and getattr(args, name) is not None:
                own[name] = frame_path(str(getattr(args, name)), number)
        of_frame = argparse.Namespace(**own)
        if asset is not None:
            yield number, AssetSource(of_frame, asset)
        elif session is not None:
            yield number, FrameSource(of_frame, session)
        else:
            yield number, open_source(of_frame)


def _fps(args: argparse.Namespace) -> float:
    """Frames per second: as given, else those of the scene or of a point cache."""
    given = args.fps or args.scene_fps
    if given is not None:
        return float(given)
    return open_cache(args.vertices).fps if is_point_cache(args.vertices) else FPS


def _scaled(state: MovingObject, args: argparse.Namespace) -> MovingObject:
    """The object with all lengths times ``--scale``."""
    if args.scale == 1:
        return state
    from ..build.make import scale_mesh
    from ..formats.splats import scaled

    matrix = np.array(state.matrix_world, np.float64)
    matrix[:3, 3] *= args.scale
    mesh = None if state.mesh is None else replace(state.mesh)
    if mesh is not None:
        scale_mesh(mesh, args.scale, str(args.output))
    splats = None if state.splats is None else scaled(state.splats, args.scale)
    return replace(state, mesh=mesh, matrix_world=matrix, splats=splats)
