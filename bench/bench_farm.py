"""Farms: frames on three nodes while things fail, chunks, killed engines, what is left, overhead, scaling, other
processors, endurance.

    python bench/bench_farm.py [--part faults chunks kills leftovers overhead scaling processors soak] [--count N]

Each part writes its own section. Linux; `faults` and `chunks` need root and Slurm (docs/farm/slurm.md).
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import farm_slurm
import numpy as np
from bench_engine import plane_asset
from farm_tools import MARK, PROGRAM, drgs, leftovers, marked
from report import table, write_section

from drgs_blender.core.asset.container import read_asset
from drgs_blender.core.errors import DeviceError, EngineError
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.ipc.client import EngineClient, engine_command

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests" / "unit"))
from blend_files import make_blend_files


def sheet(folder: Path) -> tuple[Path, np.ndarray]:
    """An asset of 3,200 triangles and its vertices."""
    path = folder / "sheet.drgs"
    plane_asset(path, 40)
    return path, np.array(read_asset(path).mesh.vertices)


def picture(key: str, vertices: np.ndarray, number: int, size: int, samples: int) -> Frame:
    """A frame in which the sheet is bent by its number."""
    camera = Camera(np.eye(4), size, size, 1.1 * size, 1.1 * size, size / 2, size / 2)
    camera.matrix_world[2, 3] = 2.5
    moved = vertices + np.float32([0, 0, 0.05]) * np.sin(0.1 * number + vertices[:, :1])
    world = World(np.random.default_rng(0).uniform(0, 1, (32, 64, 3)).astype(np.float32))
    settings = RenderSettings(samples=3 * samples, subpixel_samples=1)
    return Frame(number, camera, [ObjectState("sheet", key, vertices=moved.astype(np.float32))], world, settings)


def kills(scene: Path, folder: Path, count: int, samples: int) -> str:
    """An engine killed in the middle of each of `count` frames."""
    path, vertices = sheet(folder)
    seen, same = [], 0
    with EngineClient(engine_command(sys.executable), restarts=0) as client:
        calm = client.render(picture(client.load_asset(str(path)), vertices, 1, 48, 4))["Combined"]
        for number in range(1, count + 1):
            key = client.load_asset(str(path))
            long = picture(key, vertices, 1, 400, 4096)
            killed = [0.0]

            def kill(killed: list[float] = killed, number: int = number) -> None:
                time.sleep(0.2 + 0.02 * (number % 10))
                killed[0] = time.monotonic()
                os.kill(client.pid, signal.SIGKILL)

            thread = threading.Thread(target=kill)
            thread.start()
            try:
                client.render(long)
            except EngineError:
                seen.append(time.monotonic() - killed[0])
            thread.join()
            key = client.load_asset(str(path))
            same += bool(np.array_equal(client.render(picture(key, vertices, 1, 48, 4))["Combined"], calm))
    rows = [
        ["killed in the middle of a frame", count],
        ["noticed", len(seen)],
        ["seconds until noticed: median, most", f"{statistics.median(seen):.3f}, {max(seen):.3f}"],
        ["next frame, of a new engine, equal bit for bit", same],
    ]
    return "SIGKILL 0.2 to 0.4 s into a frame, one engine after the other.\n\n" + table(["", ""], rows)


def leftovers_report(scene: Path, folder: Path, count: int, samples: int) -> str:
    """What remains on the machine of jobs that were ended in every way."""
    rows = []
    for what in ("engine killed", "Blender killed", "drgs killed", "drgs terminated", "session killed", "disk full"):
        scratch, out = folder / what.replace(" ", "-"), folder / f"out {what}"
        scratch.mkdir()
        out.mkdir()
        before = leftovers(folder=scratch)
        code = _disturbed(what, scene, scratch, out)
        rows.append([what, code, leftovers(before, scratch), sum(not p.name.endswith(".exr") for p in out.iterdir())])
    columns = ["fault", "exit code", "processes, temporary files, shared memory, sockets", "files beside frames"]
    return "Counted three seconds after the command has ended, -9 is SIGKILL.\n\n" + table(columns, rows)


def _disturbed(what: str, scene: Path, scratch: Path, out: Path) -> int:
    """Render, do `what` in the middle of a frame; the exit code."""
    environment = os.environ | {"TMPDIR": str(scratch)}
    place = scratch.with_name(f"{scratch.name}-session")
    command = [*PROGRAM.split(), "render", str(scene), "--frames", "1-3", "--out", str(out / "####.exr")]
    command += ["--samples", "16384"]
    if what == "session killed":
        subprocess.run([*PROGRAM.split(), "session", "start", str(place)], env=environment, check=True)
        command += ["--session", str(place)]
    if what == "disk full":
        with farm_slurm.small_disk(out / "disk", 1):
            (out / "disk/filler").write_bytes(bytes(1 << 20))
            command[command.index("--out") + 1] = str(out / "disk/####.exr")
            code = subprocess.run(command, env=environment, capture_output=True).returncode
            odd = [path for path in (out / "disk").iterdir() if path.name != "filler"]
        (out / "disk").rmdir()
        for path in odd:
            (out / path.name).touch()
        return code
    job = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert job.stdout is not None
    while not job.stdout.readline().startswith("Fra:1 "):
        if job.poll() is not None:
            raise SystemExit(f"drgs render ended: {job.communicate()[1]}")
    time.sleep(0.3)
    victims = {"engine killed": "drgs_blender.engine", "Blender killed": "blender_job.py"}
    if what in victims:
        (pid,) = marked(MARK, command=victims[what])  # exactly one, or the row would say nothing
        os.kill(pid, signal.SIGKILL)
    elif what == "session killed":
        os.kill(int((place / "pid").read_text()), signal.SIGKILL)
    else:
        job.send_signal(signal.SIGKILL if what == "drgs killed" else signal.SIGTERM)
    job.communicate(timeout=300)
    return job.returncode


def overhead(scene: Path, folder: Path, count: int, samples: int) -> str:
    """Seconds of a chunk beyond its frames: cold, in a session, and as a task of OpenJD."""
    place = folder / "session"
    drgs("session", "start", str(place))
    try:
        cold = [_chunk(scene, folder / "cold", k, samples) for k in range(3)]
        warm = [_chunk(scene, folder / "warm", k, samples, "--session", str(place)) for k in range(count)]
    finally:
        drgs("session", "stop", str(place))
    tasks, second = _tasks(scene, folder / "openjd", count, samples)
    rows = [
        ["drgs render, a process for each chunk", statistics.median(cold), max(cold)],
        ["drgs render --session, first chunk (Blender opens the scene)", warm[0], warm[0]],
        ["drgs render --session, later chunks", statistics.median(warm[1:]), max(warm[1:])],
        ["first task of a session of OpenJD", tasks[0], tasks[0]],
        ["later tasks", statistics.median(tasks[1:]), max(tasks[1:])],
        ["first task of the second step, which denoises", second[0], second[0]],
        ["its later tasks", statistics.median(second[1:]), max(second[1:])],
    ]
    return (
        f"{count} chunks of 2 frames of 32 x 24 pixels. Seconds from start to end of the command or task, less those "
        "of its frames.\n\n" + table(["", "median s", "most s"], rows)
    )


def _tasks(scene: Path, out: Path, count: int, samples: int) -> tuple[list[float], list[float]]:
    """Seconds of every task of both steps of a session of OpenJD beyond those of its frames."""
    command = drgs(
        "submit", "openjd", str(scene), "--no-check", "--to", str(out / "job"), "--drgs", PROGRAM, "--frames",
        f"1-{2 * count}", "--chunk", "2", f"--options=--samples {samples}", "--out", str(out / "####.exr"),
        "--denoised", str(out / "clean" / "####.exr"),
    ).stdout.splitlines()[-1]  # fmt: skip
    words = [str(farm_slurm.OPENJD), *shlex.split(command)[1:]]
    done = subprocess.run(words, capture_output=True, text=True, timeout=900)
    if done.returncode:
        raise SystemExit(f"openjd run ended with {done.returncode}: {done.stdout[-2000:]}")
    found: list[float] = []
    for text in done.stdout.split("--------- Running Task")[1:]:
        stamps = re.findall(r"^(\d+):(\d\d):(\d\d\.\d+)\t(.*)$", text, re.M)
        times = [(3600 * int(h) + 60 * int(m) + float(s), line) for h, m, s, line in stamps]
        end = next(stamp for stamp, line in times if "exited with code" in line)
        found.append(end - times[0][0] - _of_frames(text))
    return found[:count], found[count:]


def _of_frames(text: str) -> float:
    """Seconds that frames took, as their lines say."""
    return sum(map(float, re.findall(r" Time: 00:(\d\d\.\d\d)", text)))


def _chunk(scene: Path, out: Path, number: int, samples: int, *options: str) -> float:
    """Seconds of two frames beyond those of the frames themselves."""
    frames = f"{2 * number + 1}-{2 * number + 2}"
    started = time.monotonic()
    done = drgs(
        "render", str(scene), "--frames", frames, "--out", str(out / "####.exr"), "--samples", str(samples), *options
    )
    whole = time.monotonic() - started
    return whole - _of_frames(done.stdout)


def scaling(scene: Path, folder: Path, count: int, samples: int) -> str:
    """Frames an hour of one worker on one core, and of two on a core each."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    if len(cores) < 2:
        raise SystemExit("two cores are needed")
    both = {core: folder / f"worker{core}" for core in cores}
    one = {cores[0]: both[cores[0]]}
    for core, place in both.items():
        subprocess.run([*pinned(core), "session", "start", str(place)], check=True, stdout=subprocess.DEVNULL)
    try:
        _work(both, scene, folder / "warm-up", 2, 64)  # Blender opens the scene, kernels are loaded
        times = {
            len(places): [_work(places, scene, folder / f"{len(places)}-{k}", count, samples) for k in range(3)]
            for places in (one, both)
        }
    finally:
        for place in both.values():
            drgs("session", "stop", str(place))
    hours = {workers: 3600 * workers * count / statistics.median(times[workers]) for workers in times}
    rows = [[workers, hours[workers], hours[workers] / hours[1]] for workers in hours]
    return (
        f"{count} frames of 32 x 24 pixels with {samples} samples for each worker, a session on one core with one "
        f"thread; "
        "medians of three runs.\n\n" + table(["workers", "frames an hour", "of one"], rows)
    )


def pinned(core: int) -> list[str]:
    """How drgs is started on one core."""
    return ["taskset", "-c", str(core), *PROGRAM.split()]


def _work(places: dict[int, Path], scene: Path, out: Path, count: int, samples: int) -> float:
    """Seconds in which every worker, a session on a core, renders `count` frames."""
    started = time.monotonic()
    jobs = [
        subprocess.Popen(
            [*pinned(core), "render", str(scene), "--frames", f"{k * count + 1}-{(k + 1) * count}", "--overwrite",
             "--out", str(out / "####.exr"), "--samples", str(samples), "--threads", "1", "--session", str(place)],
            stdout=subprocess.DEVNULL,
        )
        for k, (core, place) in enumerate(places.items())
    ]  # fmt: skip
    if any([job.wait() for job in jobs]):
        raise SystemExit("a worker failed")
    return time.monotonic() - started


def soak(scene: Path, folder: Path, count: int, samples: int) -> str:
    """Memory and time of an engine that renders `count` frames of a bending object."""
    path, vertices = sheet(folder)
    memory, seconds = [], []
    with EngineClient(engine_command(sys.executable)) as client:
        key = client.load_asset(str(path))
        for number in range(1, count + 1):
            started = time.perf_counter()
            client.render(picture(key, vertices, number, 48, 4))
            seconds.append(time.perf_counter() - started)
            status = Path(f"/proc/{client.pid}/status").read_text()
            memory.append(int(status.split("VmRSS:")[1].split()[0]) / 1024)
    tenth = max(1, count // 10)
    early, late = (slice(tenth, 2 * tenth), slice(count - tenth, count))
    rows = [
        ["resident memory, MiB", *(statistics.median(memory[part]) for part in (early, late))],
        ["wall ms a frame, median", *(1000 * statistics.median(seconds[part]) for part in (early, late))],
    ]
    growth = [f"{100 * (late / early - 1):+.2f} %" for _, early, late in rows]
    columns = ["", f"frames {tenth + 1} to {2 * tenth}", f"frames {count - tenth + 1} to {count}", "change"]
    return (
        f"{count} frames of 48 x 48 pixels, 12 rays, of a sheet of 3,200 triangles that moves, in one engine.\n\n"
        + table(columns, [[*row, change] for row, change in zip(rows, growth, strict=True)])
    )


#: What kernels are compiled for -> variables of the engine.
PROCESSORS = {
    "this processor": {"DRGS_CPU_TARGET": "native"},
    "x86-64-v4": {"DRGS_CPU_TARGET": "x86-64-v4"},
    "x86-64-v3": {"DRGS_CPU_TARGET": "x86-64-v3"},
    "SSE 4.2": {"NUMBA_CPU_NAME": "nehalem"},
}


def processors(scene: Path, folder: Path, count: int, samples: int) -> str:
    """The same frames with kernels compiled for this processor and for older ones."""
    path, vertices = sheet(folder)
    made: dict[str, np.ndarray] = {}
    kept = dict(os.environ)
    for what, variables in PROCESSORS.items():
        os.environ.update(variables)
        try:
            with EngineClient(engine_command(sys.executable)) as client:
                key = client.load_asset(str(path))
                frames = [picture(key, vertices, number, 96, samples) for number in range(1, count + 1)]
                made[what] = np.array([client.render(frame)["Combined"] for frame in frames])
        except DeviceError as error:  # it has no such instructions
            print(error)
        finally:
            os.environ.clear()
            os.environ.update(kept)
    ours = made.pop("this processor")
    rows: list[list[object]] = []
    for what, theirs in made.items():
        apart = np.abs(theirs - ours)
        relative = apart / np.maximum(np.abs(ours), 1e-3)
        rows.append([what, f"{(apart.max(axis=-1) > 0).mean():.2%}", float(relative.max()), float(apart.max())])
    return (
        f"{count} frames of 96 x 96 pixels, {3 * samples} samples, by engines whose kernels were compiled for fixed "
        f"targets "
        "and older processors, against this processor's own; Embree takes AVX2 where there is more.\n\n"
    ) + table(["kernels for", "pixels that differ", "largest relative difference", "largest difference"], rows)


#: part -> title, function, frames (or other counts), rays
PARTS: dict[str, tuple[str, Callable[[Path, Path, int, int], str], int, int]] = {
    "faults": ("Frames on three nodes while things fail", farm_slurm.faults, 240, 1024),
    "chunks": ("Chunks of any size give the same files", farm_slurm.chunks, 48, 64),
    "kills": ("Killed engines", kills, 50, 0),
    "leftovers": ("What faults leave behind", leftovers_report, 0, 0),
    "overhead": ("Overhead of a farm's task", overhead, 12, 64),
    "scaling": ("Workers on one machine", scaling, 10, 65536),
    "processors": ("Nodes with other processors", processors, 3, 16),
    "soak": ("Endurance of an engine", soak, 2000, 0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART")
    parser.add_argument("--count", type=int, help="frames (kills, chunks of part overhead); default by part")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "scene").mkdir()
        make_blend_files(folder / "scene")
        for part in options.part:
            title, run, count, samples = PARTS[part]
            (folder / part).mkdir()
            body = run(folder / "scene/relative.blend", folder / part, options.count or count, samples)
            write_section(f"farm-{part}", title, body)


if __name__ == "__main__":
    main()
