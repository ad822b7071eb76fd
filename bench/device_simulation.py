"""Simulated matter on every device there is: frames a second, and how far apart they end.

python bench/device_simulation.py [--particles 100000] [--frames 24]    # prints; bench_device.py writes it
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path

import numpy as np
from report import table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "unit"))
from simulation_cases import lattice, solver_of

from drgs_blender.compute.threads import use_threads
from drgs_blender.compute.warp.kernels import Launcher
from drgs_blender.compute.warp.runtime import cuda_devices
from drgs_blender.core.errors import DeviceError
from drgs_blender.simulation.contact import Plane
from drgs_blender.simulation.gpu.grid import DeviceGrid
from drgs_blender.simulation.solver import Solver

NOT_MEASURED = "not measured: no card"
FRAME = 1 / 24
H = 1 / 64


def cube(particles: int) -> Solver:
    """A cube of about `particles` particles of jelly, 8 per cell, that falls onto a floor."""
    side = (particles / 8) ** (1 / 3) * H
    points = lattice((side,) * 3, H / 2) + 0.05
    floor = Plane((0, 0, 0), (0, 0, 1))
    return solver_of(
        points, H, youngs_modulus=4e5, gravity=(0, 0, -9.81), planes=[floor], low=(-1, -1, -0.5), high=(1.5,) * 3
    )


def timed(solver: Solver, frames: int) -> tuple[float, float]:
    """Seconds of the first frame, and the median of the following frames."""
    grid, seconds = solver.grid, []
    for _ in range(frames):
        began = time.perf_counter()
        solver.advance(FRAME)
        seconds.append(time.perf_counter() - began)
    if solver.grid is not grid:
        raise DeviceError("device", "failed, see above", "")
    return seconds[0], statistics.median(seconds[1:])


def matter(particles: int, frames: int, pair: bool = False) -> str:
    """The section's part: a table and what it is of; of a `pair`, the CPU and the card alone."""
    cards = cuda_devices()
    rows, reference, body = [], None, None
    for name, device, threads in (
        ("Numba, all threads", "", 0),
        ("Warp on the processor, 1 thread", "cpu", 1),
        ("Warp on CUDA", cards[0] if cards else None, 0),
    ):
        if device == "cpu" and pair:
            continue
        if device is None:
            rows.append([name, *[NOT_MEASURED] * 4])
            continue
        body = cube(particles)
        if device:
            body.grid = DeviceGrid(body._scene, Launcher(device))
        use_threads(threads)
        first, seconds = timed(body, frames)
        use_threads(0)
        reference = body.points if reference is None else reference
        apart = np.linalg.norm(body.points - reference, axis=1).max() / H
        steps = body.steps / frames
        likeness = f"{apart:.1e} cells" if device else "the reference"
        rows.append([name, f"{first:.1f} s", f"{1000 * seconds / steps:.2f} ms", f"{1 / seconds:.2f}", likeness])
    assert body is not None
    return (
        f"\n\nSimulated matter: {len(body.points)} particles of jelly that fall onto a floor, {frames} frames of "
        f"{body.steps / frames:.0f} time steps, copies to and from the device included, without files. Held to: 24 "
        "frames a second on a data-centre card.\n\n"
        + table(["Where", "First frame", "A step", "Frames a second", "Farthest particle at the end"], rows)
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=24)
    options = parser.parse_args()
    print(matter(options.particles, options.frames))
