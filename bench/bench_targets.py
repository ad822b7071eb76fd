"""What kernels for a fixed target cost against those for this very processor.

    python bench/bench_targets.py [--runs 7] [--targets x86-64-v4 x86-64-v3 ...]

One process per target, each with one thread, which take turns; processor time, so that what else runs on the machine
matters little. The same frames are also compared bit for bit.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from report import ROOT, table, write_section

SIZE = 256
TASKS = ("mesh", "surfels", "surfel rays", "denoised", "simulated")
COLUMNS = ["work", "kernels for", "ms", "against native", "spread", "same bits"]


def tasks(asset: Path) -> dict[str, Callable[[], np.ndarray]]:
    """Name -> the work, which gives what it made."""
    sys.path.insert(0, str(ROOT / "tests" / "unit"))
    from dataclasses import replace

    from simulation_cases import lattice, solver_of

    from drgs_blender.core.asset.container import read_asset
    from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
    from drgs_blender.engine.session import Session

    session = Session()
    key = session.load_asset(str(asset))
    vertices = np.array(read_asset(asset).mesh.vertices, np.float32)
    camera = Camera(np.eye(4), SIZE, SIZE, 1.1 * SIZE, 1.1 * SIZE, SIZE / 2, SIZE / 2)
    camera.matrix_world[2, 3] = 2.5
    world = World(np.random.default_rng(0).uniform(0, 1, (64, 128, 3)).astype(np.float32))
    settings = RenderSettings(samples=12, subpixel_samples=1)
    frame = Frame(1, camera, [ObjectState("sheet", key, vertices=vertices)], world, settings)

    def render(**changes: object) -> Callable[[], np.ndarray]:
        changed = replace(frame, settings=replace(settings, **changes))  # type: ignore[arg-type]
        return lambda: session.render(changed, lambda phase, part: None, lambda: False)["Combined"]

    points = lattice((0.2,) * 3, 1 / 128) + 0.2

    def simulate() -> np.ndarray:
        speed = 0.3 * np.sin(9 * points[:, [1, 2, 0]])
        solver = solver_of(points, 1 / 64, "jelly", velocity=speed, low=(0,) * 3, high=(1,) * 3)
        solver.advance(1 / 100)
        return np.array(solver.points)

    return {
        "mesh": render(camera_sees="mesh"),
        "surfels": render(),
        "surfel rays": render(rays_see="surfels"),
        "denoised": render(denoise="svgf"),
        "simulated": simulate,
    }


def work(asset: Path) -> None:
    """A child: a line with a name is answered by seconds and the digest of what was made."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    made = tasks(asset)
    for line in sys.stdin:
        begun = time.process_time()
        result = made[line.strip()]()
        seconds = time.process_time() - begun
        answers.write(json.dumps([seconds, hashlib.sha256(result.tobytes()).hexdigest()]) + "\n")
        answers.flush()


@contextlib.contextmanager
def child(target: str, asset: Path) -> Iterator[Callable[[str], tuple[float, str]]]:
    """A process whose kernels are compiled for a target."""
    environment = os.environ | {"DRGS_CPU_TARGET": target, "NUMBA_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(Path(__file__).resolve()), "--child", str(asset)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, encoding="utf-8"
    )

    def ask(task: str) -> tuple[float, str]:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(task + "\n")
        process.stdin.flush()
        seconds, digest = json.loads(process.stdout.readline())
        return seconds, digest

    try:
        yield ask
    finally:
        process.kill()
        process.wait()


def measure(targets: list[str] | None = None, runs: int = 7) -> list[list[object]]:
    """Rows of `COLUMNS`.

    Parameters
    ----------
    targets : list of str, optional
        Those to compare with the native one; all that this processor has without it.
    runs : int
        How often each work is done for each target, after a first time that does not count.
    """
    from bench_engine import plane_asset

    from drgs_blender.compute import targets as known

    if targets is None:
        from llvmlite import binding

        has = binding.get_host_cpu_features()
        targets = [t.name for t in known.here() if all(has.get(feature, False) for feature in t.needs)]
    names = [known.NATIVE, *targets]
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        asset = Path(folder) / "sheet.drgs"
        plane_asset(asset, 40)
        children = {name: stack.enter_context(child(name, asset)) for name in names}
        for task in TASKS:
            first = {name: ask(task)[1] for name, ask in children.items()}
            took: dict[str, list[float]] = {name: [] for name in names}
            for turn in range(runs):
                for name in names[turn % len(names) :] + names[: turn % len(names)]:
                    took[name].append(children[name](task)[0])
            for name in names:
                ratios = [own / native for own, native in zip(took[name], took[known.NATIVE], strict=True)]
                change = 100 * (statistics.median(took[name]) / statistics.median(took[known.NATIVE]) - 1)
                spread = f"{100 * (min(ratios) - 1):+.0f} to {100 * (max(ratios) - 1):+.0f} %"
                same = "yes" if first[name] == first[known.NATIVE] else "no"
                milliseconds = 1000 * statistics.median(took[name])
                rows.append([task, name, milliseconds, f"{change:+.1f} %", spread, same])
            print(table(COLUMNS, rows[-len(names) :]), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", nargs="+", help="all that this processor has")
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        work(options.child)
        return
    rows = measure(options.targets, options.runs)
    text = (
        "Processor time of one thread, each kind of kernels in a process of its own, in turn; medians of "
        f"{options.runs}. Spread: of single turns. Same bits: of the frame, or of the particles, as by kernels for "
        "this very processor.\n\n"
    )
    write_section("targets", "Kernels for fixed targets", text + table(COLUMNS, rows))


if __name__ == "__main__":
    main()
