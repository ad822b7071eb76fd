"""A Slurm of three nodes on this machine renders a job while things go wrong; run by bench_farm.py."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from farm_tools import PROGRAM, drgs, frames_differ, leftovers, marked
from report import table

sys.path[:0] = [str(Path(__file__).resolve().parent.parent / "tests" / name) for name in ("farm", "unit")]
from slurm_trio import Trio, absent  # noqa: E402

OPENJD = str(Path(sys.executable).with_name("openjd"))
PAUSE = 2


@contextlib.contextmanager
def cluster() -> Iterator[Trio]:
    """A running Slurm of three nodes of one core."""
    if reason := absent():
        raise SystemExit(f"three nodes of Slurm cannot be started: {reason}")
    with tempfile.TemporaryDirectory(prefix="slurm") as root:  # a socket's path must be short
        Path(root).chmod(0o755)
        with Trio(Path(root)) as trio:
            trio.env["DRGS_PAUSE"] = str(PAUSE)
            yield trio


def submit(trio: Trio, scene: Path, to: Path, *options: str) -> None:
    """Write and submit a job."""
    command = ["submit", "slurm", str(scene), "--no-check", "--to", str(to), "--drgs", PROGRAM, *options]
    line = drgs(*command).stdout.splitlines()[-1]
    subprocess.run(line, shell=True, env=trio.env, check=True, capture_output=True, timeout=60)


def told(to: Path, step: str = "render") -> list[str]:
    """Every line of the logs of a job."""
    return [line for path in (to / "logs").glob(f"{step}-*.log") for line in path.read_text().splitlines()]


def saved(to: Path, step: str = "render") -> list[str]:
    """Files of which a job said that they are saved."""
    return [line for line in told(to, step) if line.startswith("Saved: ")]


@contextlib.contextmanager
def small_disk(place: Path, megabytes: int) -> Iterator[None]:
    """A disk of that size mounted at `place`."""
    place.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "none", str(place)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def fill(disk: Path, trio: Trio, to: Path) -> float:
    """Fill a disk until a chunk has met it, then give the room back; seconds it was full."""
    started = time.monotonic()
    about = os.statvfs(disk)
    filler = disk / "filler"
    with contextlib.suppress(OSError), open(filler, "wb", buffering=0) as file:
        for _ in range(about.f_bavail + 64):
            file.write(bytes(about.f_frsize))
    trio.until(lambda: any("wait for room" in line for line in told(to)), 120)
    filler.unlink()
    return time.monotonic() - started


def faults(scene: Path, folder: Path, count: int, rays: int) -> str:
    """`count` frames while a node, an engine and a disk fail; compared with one machine that nothing disturbs."""
    before = leftovers()
    to, disk = folder / "job", folder / "disk"
    options = ("--frames", f"1-{count}", "--chunk", "10", f"--options=--rays {rays}")
    with small_disk(disk, 64), cluster() as trio:
        submit(trio, scene, to, *options, "--out", str(disk / "####.exr"))
        node = lambda name: f"SLURMD_NODENAME={name}"  # noqa: E731
        engine = lambda name: marked(node(name), command="drgs_blender.engine")  # noqa: E731
        started = time.monotonic()
        trio.until(lambda: len(saved(to)) >= count // 8 and engine("n2"), 300)
        trio.kill_node("n2")
        trio.until(lambda: len(saved(to)) >= count // 4 and engine("n1"), 300)
        os.kill(engine("n1")[0], signal.SIGKILL)
        trio.until(lambda: len(saved(to)) >= count // 3, 300)
        full = fill(disk, trio, to)
        trio.until_done(900)
        seconds = time.monotonic() - started
        lines = saved(to)
        alone = folder / "alone"
        drgs("render", str(scene), "--frames", f"1-{count}", "--out", str(alone / "####.exr"), "--rays", str(rays))
        differ = frames_differ(alone, disk, count)
        odd = [p.name for p in disk.iterdir() if p.suffix != ".exr" or p.name.startswith(".")]
    rows = [
        ["frames that differ from those of one machine, of", f"{differ} of {count}"],
        ["finished frames that were made again", len(lines) - len(set(lines))],
        ["chunks queued again: node lost, disk full", sum("attempt 2" in line for line in told(to))],
        ["files in the folder that are no frames", len(odd)],
        ["processes, shared memory and sockets left", leftovers(before)],
        ["seconds that the disk was full", full],
        ["seconds", seconds],
    ]
    return (
        f"{count} frames of 32 x 24 pixels with {rays} rays in chunks of 10, an array of Slurm on three nodes of one "
        "core each. While they were rendered one node was ended with all it ran, an engine was killed, and the disk of "
        "the frames was filled until a chunk ended with code 73.\n\n" + table(["", ""], rows)
    )


def chunks(scene: Path, folder: Path, count: int, rays: int) -> str:
    """The same frames, denoised over time, in chunks of several sizes on three nodes: the same files?"""
    made: dict[str, tuple[Path, float]] = {}
    with cluster() as trio:
        for size in (1, 4, 10):
            started = time.monotonic()
            made[str(size)] = (_slurm(trio, scene, folder / str(size), count, rays, size), time.monotonic() - started)
        started = time.monotonic()
        made["adaptive"] = (_adaptive(trio, scene, folder / "adaptive", count, rays), time.monotonic() - started)
    first = made["10"][0]
    rows = []
    for size, (clean, seconds) in made.items():
        files = sorted(clean.glob("*.exr"))
        same = sum(path.read_bytes() == (first / path.name).read_bytes() for path in files)
        rows.append([size, len(files), same, seconds])
    return (
        f"{count} frames of 32 x 24 pixels with {rays} rays, rendered and then denoised over a window of five frames, "
        "on three nodes of Slurm; adaptive is a session of OpenJD on one of them, which chooses the size of its chunks "
        "by their time. Files are compared byte for byte with those of chunks of 10.\n\n"
        + table(["chunk", "denoised frames", "equal files", "seconds"], rows)
    )


def _slurm(trio: Trio, scene: Path, folder: Path, count: int, rays: int, size: int) -> Path:
    submit(
        trio, scene, folder / "job", "--frames", f"1-{count}", "--chunk", str(size), f"--options=--rays {rays}",
        "--out", str(folder / "noisy/####.exr"), "--denoised", str(folder / "clean/####.exr"),
    )  # fmt: skip
    trio.until_done(900)
    return folder / "clean"


def _adaptive(trio: Trio, scene: Path, folder: Path, count: int, rays: int) -> Path:
    command = drgs(
        "submit", "openjd", str(scene), "--no-check", "--to", str(folder / "job"), "--drgs", PROGRAM,
        "--frames", f"1-{count}", "--chunk", "2", "--chunk-seconds", "2", f"--options=--rays {rays}",
        "--out", str(folder / "noisy/####.exr"), "--denoised", str(folder / "clean/####.exr"),
    ).stdout.splitlines()[-1]  # fmt: skip
    words: Sequence[str] = [OPENJD, *shlex.split(command)[1:]]
    script = folder / "job" / "session.sbatch"
    script.write_text(f"#!/bin/sh\n#SBATCH --output={folder}/job/session.log\nexec {shlex.join(words)}\n")
    subprocess.run(["sbatch", str(script)], env=trio.env, check=True, capture_output=True, timeout=60)
    trio.until_done(900)
    return folder / "clean"
