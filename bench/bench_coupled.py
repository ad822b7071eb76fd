"""Bodies that push each other: momentum, friction and impact against mechanics, and what it costs.

python bench/bench_coupled.py [--short] [--no-write]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import igl
import numpy as np
import trimesh
from report import table, write_section

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "unit"))
from coupled_cases import Slope, balls, mean_velocity, mesh_of, momentum
from scipy.spatial import cKDTree
from simulation_cases import masses

from drgs_blender.core.asset.model import Mesh
from drgs_blender.simulation.coupled_job import CoupledJob, prepare_coupled
from drgs_blender.simulation.coupled_settings import parse_coupled
from drgs_blender.simulation.job import prepare

FRAME = 1 / 24
Rows = list[list[object]]


def impact(options: argparse.Namespace) -> Rows:
    """Two equal balls, head on and one beside the other's way: momentum, velocities and distance."""
    rows: Rows = []
    for h in (0.06,) if options.short else (0.06, 0.04):
        for aside in (0.0, 0.2):
            coupled = balls(h, aside=aside)
            one, other = coupled.bodies
            (before, turning), scale = momentum(coupled), 2 * masses(one).sum()
            worst, closest = 0.0, np.inf
            for _ in range(16):
                coupled.advance(FRAME / 2)
                worst = max(worst, float(np.linalg.norm(momentum(coupled)[0] - before)) / scale)
                closest = min(closest, float(cKDTree(one.points).query(other.points)[0].min()) / h)
            turned = float(np.linalg.norm(momentum(coupled)[1] - turning)) / scale / 0.3
            what = f"balls of {2 * 0.3 / h:.0f} cells at 1 m/s each, {'head on' if not aside else '0.2 m aside'}"
            rows.append([f"{what}: momentum lost, of that of both", worst, "1e-6"])
            rows.append(["the same: angular momentum, of that of both at a radius", turned, ""])
            if not aside:
                exchanged = -float(mean_velocity(one)[0])
                rows.append(["the same: speed afterwards, m/s; what is missing swings in the balls", exchanged, "0.85"])
            rows.append(["the same: least distance of particles, cells (surfaces touch at 0.5)", closest, "0.4"])
    return rows


def friction(options: argparse.Namespace) -> Rows:
    """A block on a plate that leans askew to the grid."""
    rows: Rows = []
    cases = [
        (20, 0.0, "separate"),
        (20, 0.2, "separate"),
        (30, 0.3, "separate"),
        (20, 0.5, "separate"),
        (20, 0, "slip"),
    ]
    for degrees, mu, contact in cases[1:2] if options.short else [*cases, (20, 0.5, "sticky")]:
        slope, angle, h, frames = Slope(degrees, 0.05, contact, mu), np.radians(degrees), 0.05, 12
        way, off = [0.0], 0.0
        for _ in range(frames):
            slope.coupled.advance(FRAME)
            way.append(slope.slid())
            off = max(off, abs(slope.lifted()) / h)
        late = np.arange(frames // 3, frames + 1)
        measured = 2 * float(np.polyfit(late * FRAME, np.array(way)[late], 2)[0])
        pull = np.sin(angle) - mu * np.cos(angle) if contact != "sticky" else 0.0
        exact = 9.81 * max(0.0, float(pull))
        shown = f"{measured:.3f}, Coulomb {exact:.3f}"
        what = f"block of 8 cells on a slope of {degrees}°, {contact}, friction {mu}"
        rows.append([f"{what}: acceleration, m/s²", shown, "within 0.02"])
        rows.append(["the same: off the slope at most, cells", off, "0.1"])
    return rows


def pair(resolution: int, last: int = 4) -> tuple[list[Mesh], CoupledJob]:
    """A ball of jelly on a block of sand."""
    top = trimesh.creation.icosphere(4, 0.3)
    top.apply_translation([0, 0, 0.62])
    pile = trimesh.creation.box((0.7, 0.7, 0.3))
    pile.apply_translation([0, 0, 0.15])
    meshes = [mesh_of(top), mesh_of(pile.subdivide().subdivide())]
    bodies = [
        {"asset": "ball", "material": {"name": "jelly", "youngs_modulus": 1e5, "density": 500}, "velocity": [0, 0, -2]},
        {"asset": "pile", "material": "sand"},
    ]
    scene = {"floor": 0, "resolution": resolution, "last": last, "bodies": bodies}
    return meshes, prepare_coupled(meshes, parse_coupled(scene, out=Path("none")))


def cost(options: argparse.Namespace) -> Rows:
    """Seconds of two bodies that touch, against the sum of the two alone with the same time step."""
    pair(8)[1].solver.advance(FRAME)
    frames, fits = (2, 16) if options.short else (4, 28)
    meshes, job = pair(fits)
    begin = time.perf_counter()
    for _ in range(frames):
        job.solver.advance(FRAME)
    together = time.perf_counter() - begin
    alone = 0.0
    for one, mesh in zip(pair(fits)[1].jobs, meshes, strict=True):
        single = prepare(mesh, one.settings, "body", job.solver.domain).solver
        single.rate = job.solver.rate
        begin = time.perf_counter()
        for _ in range(frames):
            single.advance(FRAME)
        alone += time.perf_counter() - begin
    count = sum(len(body.points) for body in job.solver.bodies)
    what = f"ball of jelly on sand, {count} particles: time over that of the two alone with the same time step"
    surface = np.array(job.jobs[0].now().vertices, np.float64), np.asarray(meshes[0].faces)
    grains = np.array(job.jobs[1].now().points, np.float64)
    depth = max(0.0, -float(igl.signed_distance(grains, *surface)[0].min())) / job.solver.domain.spacing
    return [
        [what, together / alone, "2"],
        ["the same: deepest grain in the ball, cells", depth, "0.5"],
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="fewer cases, to see that it works")
    parser.add_argument("--no-write", action="store_true", help="print, and leave docs/benchmarks.md as it is")
    options = parser.parse_args()
    rows = [row for part in (impact, friction, cost) for row in part(options)]
    text = table(["what", "measured", "hold to"], rows)
    title = "Simulated matter: bodies that push each other"
    if options.no_write:
        print(f"{title}\n\n{text}\n", flush=True)
    else:
        write_section("coupled", title, text)


if __name__ == "__main__":
    main()
