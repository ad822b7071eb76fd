"""Write a job for a farm manager: chunks of frames for `drgs render`, and optionally a step of `drgs denoise` after it.

Before that the scene is opened and looked at as on a node: files that are missing or that a node does not see, another
version, what DR-GS does not render. `check` does nothing else.

The command that submits the job is printed, not run.
"""

from __future__ import annotations

import argparse
import logging
import shlex
from pathlib import Path

from ..core.errors import AssetError, UsageError
from . import sampling
from .farm import flamenco, openjd, slurm
from .farm.job import Job
from .find_blender import find_blender
from .frame_range import absolute_template, check_template, parse_frames
from .output import check_suffix, check_writable

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs submit check shot.blend --frames 1-240 --out '//frames/####.exr' --shared /projects
  drgs submit openjd shot.blend --frames 1-240 --out '//frames/####.exr' --to job --options='--samples 128'
  drgs submit slurm shot.blend --frames 1-240 --chunk 8 --out '//frames/####.exr' --to job --sbatch=--cpus-per-task=8
  drgs submit flamenco shot.blend --frames 1-240 --out '//noisy/####.exr' --denoised '//clean/####.exr' --to job
"""

MANAGERS = ("check", "openjd", "slurm", "flamenco")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs submit``."""
    parser.add_argument("manager", choices=MANAGERS, help="who runs the job; check only looks at the scene")
    parser.add_argument("scene", type=Path, metavar="SCENE.blend", help="Blender file, on a disk that every node sees")
    parser.add_argument("--frames", required=True, help="frames: 1-24, every second 1-24x2, several 1-24x2,30")
    parser.add_argument("--out", required=True, metavar="PATTERN", help="EXR files, as of drgs render")
    parser.add_argument("--denoised", metavar="PATTERN", help="EXR files of a second step that denoises over time")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="where the job is written; default: SCENE-job")
    parser.add_argument(
        "--chunk", type=sampling.int_range(1, 1_000_000), default=5, metavar="N", help="frames a task; 5"
    )
    parser.add_argument("--name", help="name of the job; default: the scene's")
    parser.add_argument("--drgs", default="drgs", metavar="COMMAND", help="how a node starts drgs; default drgs")
    parser.add_argument(
        "--options", default="", metavar="'...'", help="options of drgs render: --options='--samples 64'"
    )
    group = parser.add_argument_group("check")
    group.add_argument("--no-check", action="store_true", help="submit without looking at the scene")
    group.add_argument(
        "--shared", type=Path, action="append", default=[], metavar="FOLDER", help="folder on all nodes; repeatable"
    )
    group.add_argument("--blender", metavar="PATH", help="blender program, or a Python that has bpy, for the check")
    group = parser.add_argument_group("managers")
    group.add_argument(
        "--chunk-seconds",
        type=sampling.int_range(0, 86400),
        default=0,
        metavar="S",
        help="openjd: how long a chunk should take, where the scheduler adapts chunks",
    )
    group.add_argument(
        "--retries",
        type=sampling.int_range(0, 1000),
        default=slurm.RETRIES,
        metavar="N",
        help=f"slurm: how often a chunk is queued again after code 75 or 73; default {slurm.RETRIES}",
    )
    group.add_argument(
        "--sbatch", action="append", default=[], metavar="OPTION", help="slurm: option of sbatch; repeatable"
    )
    group.add_argument("--manager-url", default="http://localhost:8080", metavar="URL", help="flamenco: the Manager")


def run(args: argparse.Namespace) -> int:
    """Check the scene, write the job, say how to submit it."""
    job = job_of(args)
    if not job.scene.is_file():
        raise AssetError(str(args.scene), "does not exist", "Check the path of the .blend file")
    files: list[Path] = []
    if args.manager == "check" or not args.no_check:
        files = check(job, args)
    if args.manager == "check":
        return 0
    folder = (args.to or job.scene.with_name(f"{job.scene.stem}-job")).absolute()
    check_writable(folder / "job")
    if args.manager == "openjd":
        command = openjd.write_bundle(job, folder, args.chunk_seconds, files)
    elif args.manager == "slurm":
        command = slurm.write_job(job, folder, args.retries, tuple(args.sbatch))
    else:
        command = flamenco.write_job(job, folder, args.manager_url)
    print(f"{folder}: {len(job.frames)} frames in {len(job.chunks)} tasks. Submit with\n{command}")
    return 0


def job_of(args: argparse.Namespace) -> Job:
    """The job that the options describe."""
    frames = parse_frames(args.frames)
    scene = args.scene.absolute()
    out = absolute_template(args.out, scene)
    clean = absolute_template(args.denoised, scene) if args.denoised else None
    for pattern in (out, clean):
        if pattern:
            check_template(pattern, frames)
            check_suffix(Path(pattern), (".exr",))
    if clean == out:
        raise UsageError(f"--denoised {args.denoised}", "is where the rendered frames are", "Choose another folder")
    program, options = words("--drgs", args.drgs), words("--options", args.options)
    if not program:
        raise UsageError("--drgs", "is empty", "Name the program")
    check_options(options)
    return Job(args.name or scene.stem, scene, frames, out, clean, args.chunk, options, program)


def words(flag: str, text: str) -> tuple[str, ...]:
    """The words of a command line, divided as a shell does."""
    try:
        return tuple(shlex.split(text))
    except ValueError as error:
        raise UsageError(f"{flag} {text}", f"cannot be divided into words ({error})", "Close its quotes") from error


def check_options(options: tuple[str, ...]) -> None:
    """Refuse what ``drgs render`` would refuse on the node, and what the job itself says."""
    from .main import build_parser

    parsed = build_parser().parse_args(["render", "scene", "--frames=0", "--out=#.exr", *options])
    if (parsed.frames, parsed.out, str(parsed.scene)) != ("0", "#.exr", "scene"):
        raise UsageError(shlex.join(options), "has --frames or --out, which the job itself gives", "Leave them out")


def check(job: Job, args: argparse.Namespace) -> list[Path]:
    """Print what a node would miss; return the files that the scene refers to.

    Raises
    ------
    DrgsError
        A node could not render the scene.
    """
    from .farm.check import check_scene

    blender = find_blender(args.blender)
    scripts = "--enable-scripts" in job.options
    report = check_scene(job.scene, job.frames, blender, args.shared, scripts)
    for text in report.faults:
        print(f"missing  {text}")
    for text in report.notes:
        print(f"note     {text}")
    if args.manager == "check":
        for path in report.files:
            print(f"file     {path}")
    report.raise_fault(job.scene)
    print(f"ok       {job.scene}: {len(report.files)} files, frames {job.range}")
    return report.files
