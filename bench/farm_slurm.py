"""A Slurm of three nodes on this machine renders a job while things go wrong; run by bench_farm.py."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from farm_tools import PROGRAM, drgs, frames_differ, leftovers, marked
from report import table

from drgs_blender.cli.frame_range import cut_frames, write_frames

sys.path[:0] = [str(Path(__file__).resolve().parent.parent / "tests" / name) for name in ("farm", "unit")]
from disks import mount, unmount  # noqa: E402
from slurm_trio import NODES, Trio, absent  # noqa: E402

OPENJD = Path(sys.executable).with_name("openjd")
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


def log_lines(to: Path, step: str = "render") -> list[str]:
    """Every line of the logs of a job."""
    return [line for path in (to / "logs").glob(f"{step}-*.log") for line in path.read_text().splitlines()]


def saved(to: Path, step: str = "render") -> list[str]:
    """Files of which a job said that they are saved."""
    return [line for line in log_lines(to, step) if line.startswith("Saved: ")]


@contextlib.contextmanager
def small_disk(place: Path, megabytes: int) -> Iterator[None]:
    """A disk of that size mounted at `place`."""
    if not mount(place, f"size={megabytes}m"):
        raise SystemExit(f"a disk cannot be mounted at {place}")
    try:
        yield
    finally:
        unmount(place)


def fill(disk: Path, trio: Trio, to: Path) -> float:
    """Fill a disk until a chunk has met it, then give the room back; seconds it was full."""
    started = time.monotonic()
    about = os.statvfs(disk)
    filler = disk / "filler"
    with contextlib.suppress(OSError), open(filler, "wb", buffering=0) as file:
        for _ in range(about.f_bavail + 64):
            file.write(bytes(about.f_frsize))
    trio.until(lambda: any("wait for room" in line for line in log_lines(to)), 120)
    filler.unlink()
    return time.monotonic() - started


def faults(scene: Path, folder: Path, count: int, samples: int) -> str:
    """`count` frames while a node, an engine and a disk fail; compared with one machine that nothing disturbs."""
    before = leftovers()
    to, disk = folder / "job", folder / "disk"
    options = ("--frames", f"1-{count}", "--chunk", "10", f"--options=--samples {samples}")
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
        drgs(
            "render", str(scene), "--frames", f"1-{count}", "--out", str(alone / "####.exr"), "--samples", str(samples)
        )
        differ = frames_differ(alone, disk, count)
        odd = [p.name for p in disk.iterdir() if p.suffix != ".exr" or p.name.startswith(".")]
    rows = [
        ["frames that differ from those of one machine, of", f"{differ} of {count}"],
        ["finished frames that were made again", len(lines) - len(set(lines))],
        ["chunks queued again: node lost, disk full", sum("attempt 2" in line for line in log_lines(to))],
        ["files in the folder that are no frames", len(odd)],
        ["processes, shared memory and sockets left", leftovers(before)],
        ["seconds that the disk was full", full],
        ["seconds", seconds],
    ]
    return (
        f"{count} frames of 32 x 24 pixels with {samples} samples in chunks of 10, an array of Slurm on three nodes of "
        f"one "
        "core each. While they were rendered one node was ended with all it ran, an engine was killed, and the disk of "
        "the frames was filled until a chunk ended with code 73.\n\n" + table(["", ""], rows)
    )


def chunks(scene: Path, folder: Path, count: int, samples: int) -> str:
    """The same frames, denoised over time, in chunks of several sizes on three nodes: the same files?"""
    seconds: dict[str, float] = {}
    with cluster() as trio:
        for size in ("1", "4", "10", "adaptive"):
            started = time.monotonic()
            (_sessions if size == "adaptive" else _slurm)(trio, scene, folder / size, count, samples, size)
            seconds[size] = time.monotonic() - started
    rows = []
    for size in seconds:
        files = sorted((folder / size / "clean").glob("*.exr"))
        same = sum(path.read_bytes() == (folder / "10/clean" / path.name).read_bytes() for path in files)
        rows.append([size, len(files), same, seconds[size]])
    steps = {step: _by_node(folder / "adaptive/job", step) for step in ("render", "denoise")}
    if any(len(made) != len(NODES) for made in steps.values()):
        raise SystemExit(f"not every node took part: {steps}")
    nodes = [[node, *("; ".join(map(write_frames, made[node])) for made in steps.values())] for node in NODES]
    return (
        f"{count} frames of 32 x 24 pixels with {samples} samples, rendered and then denoised over a window of five "
        f"frames, "
        "on three nodes of Slurm; adaptive are arrays of sessions of OpenJD, each with a third of the frames, which "
        "choose the size of their chunks by their time. Files are compared byte for byte with those of chunks of 10."
        "\n\n"
        + table(["chunk", "denoised frames", "equal files", "seconds"], rows)
        + "\n\nThe adaptive chunks, and where they were made:\n\n"
        + table(["node", "rendered", "denoised"], nodes)
    )


def _slurm(trio: Trio, scene: Path, folder: Path, count: int, samples: int, size: str) -> None:
    submit(
        trio, scene, folder / "job", "--frames", f"1-{count}", "--chunk", size, f"--options=--samples {samples}",
        "--out", str(folder / "noisy/####.exr"), "--denoised", str(folder / "clean/####.exr"),
    )  # fmt: skip
    trio.until_done(900)


def _sessions(trio: Trio, scene: Path, folder: Path, count: int, samples: int, size: str) -> None:
    """A session of OpenJD on every node, each with a part of the frames, and then with denoising it."""
    command = drgs(
        "submit", "openjd", str(scene), "--no-check", "--to", str(folder / "job"), "--drgs", PROGRAM,
        "--frames", f"1-{count}", "--chunk", "2", "--chunk-seconds", "5", f"--options=--samples {samples}",
        "--out", str(folder / "noisy/####.exr"), "--denoised", str(folder / "clean/####.exr"),
    ).stdout.splitlines()[-1]  # fmt: skip
    parts = [write_frames(part) for part in cut_frames(list(range(1, count + 1)), -(-count // len(NODES)))]
    trio.submit_sessions(folder / "job", OPENJD, command, parts)
    trio.until_done(900)


def _by_node(to: Path, step: str) -> dict[str, list[list[int]]]:
    """Node -> the frames that it made, chunk by chunk, as the logs of its sessions say."""
    made: dict[str, list[list[int]]] = {}
    for path in sorted((to / "logs").glob(f"{step}-*.log")):
        head, *tasks = path.read_text().split("--------- Running Task")
        node = re.search(r"^drgs: node (\S+)$", head, re.M)[1]
        made.setdefault(node, []).extend(
            [int(k) for k in re.findall(r"Saved: '.*?(\d+)\.exr'", text)] for text in tasks
        )
    return made
