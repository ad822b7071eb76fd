"""Simulated matter: what the solver costs, and how its motion compares with mechanics.

python bench/bench_simulate.py [--part throughput taichi stiff body surfels fill motion] [--taichi PYTHON]
    [--against COMMIT] [--short]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import igl
import numpy as np
from animal import body
from checkouts import Checkout
from report import ROOT, table, write_section
from simulate_motion import motion

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "unit"))
from simulation_cases import lattice, solver_of

from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.asset.model import Mesh, PosedSurfels
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.deform.particle_driven import Frames, ParticleDriven
from drgs_blender.simulation.fill import fill
from drgs_blender.simulation.grid_blocks import arrange
from drgs_blender.simulation.job import PER_CELL, prepare
from drgs_blender.simulation.settings import parse_settings
from drgs_blender.simulation.solver import Solver

BENCH = Path(__file__).resolve().parent
FRAME = 1 / 24


def clock(call) -> tuple[float, float]:  # type: ignore[no-untyped-def]
    """Processor and wall seconds."""
    p, w = time.process_time(), time.perf_counter()
    call()
    return time.process_time() - p, time.perf_counter() - w


def box_of(particles: int, material: str) -> Solver:
    """A moving cube of about `particles` particles, 8 per cell, on a grid of 64 cells."""
    side = (particles / 8) ** (1 / 3) / 64
    points = lattice((side,) * 3, 1 / 128) + 0.2
    velocity = 0.3 * np.sin(9 * points[:, [1, 2, 0]])
    return solver_of(points, 1 / 64, material, velocity=velocity, low=(0,) * 3, high=(1,) * 3)


def throughput(options: argparse.Namespace) -> str:
    """Million particle-steps a second, per core (one thread, processor time) and on all threads (wall time)."""
    threads = get_num_threads()
    rows: list[list[object]] = []
    for material in ("jelly", "elastic", "metal", "sand", "snow", "water"):
        speeds = []
        for count in (1, threads):
            use_threads(count)
            solver = box_of(options.particles, material)
            step = 0.9 * FRAME / solver.steps_of(FRAME)
            solver.advance(2 * step)
            before = solver.steps
            p, w = clock(lambda: solver.advance(20 * step))  # noqa: B023
            speeds.append(len(solver.points) * (solver.steps - before) / (p if count == 1 else w) / 1e6)
        rows.append([material, len(solver.points), *speeds])
    use_threads(threads)
    hold = "jelly, elastic: 9 on one core" + (f", 15 on {threads}" if threads == 2 else "")
    rows.append(["hold to", "", hold, ""])
    return table(["material", "particles", "M steps/s, one core", f"M steps/s, {threads} threads"], rows)


def in_taichi(python: Path, solver: Solver, dt: float, steps: int, threads: int, *how: str) -> tuple[dict, dict]:  # type: ignore[type-arg]
    """What Taichi makes of the state of a solver: seconds a step, and the arrays in the order of its particles."""
    s, matter = solver.state, solver.body.matter
    order = arrange(s.x, solver.domain)[0].order
    n = len(s.x)
    columns = {
        "x": s.x, "v": s.v, "c": s.affine.reshape(n, 3, 3), "f": solver.gradients,
        "mass": solver.body.volume * matter.density, "volume": solver.body.volume,
        "mu": matter.parameters[:, 0], "lam": matter.parameters[:, 1],
    }  # fmt: skip
    domain = solver.domain
    grid = {"origin": domain.origin, "spacing": domain.spacing, "size": 4 * np.array(domain.blocks)}
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(given, **{k: a[order] for k, a in columns.items()}, **grid, gravity=solver.forces.gravity, dt=dt)
        command = [python, BENCH / "taichi_mpm.py", given, made, "--steps", steps, "--threads", threads]
        said = subprocess.run([*map(str, command), *how], check=True, capture_output=True, text=True).stdout
        back = np.argsort(order)
        with np.load(made) as found:
            return json.loads(said.strip().splitlines()[-1]), {k: found[k][back] for k in found.files}


def against_taichi(options: argparse.Namespace) -> str:
    """Speed of both on the same matter in one run, and whether 1500 steps of one state lead to the same place."""
    installed = "Taichi has an interpreter of its own: `python -m venv V; V/bin/pip install taichi==1.7.4`, `--taichi V/bin/python`."  # noqa: E501
    if options.taichi is None:
        return f"{installed} Not given."
    threads, rows = get_num_threads(), []
    version = ""
    for count, how, hold in ((1, ["--atomic"], "2.0"), (1, [], ""), (threads, ["--atomic"], "1.6")):
        use_threads(count)
        solver = box_of(options.particles, "jelly")
        dt = 0.9 * FRAME / solver.steps_of(FRAME)
        solver.advance(2 * dt)
        theirs, _ = in_taichi(options.taichi, solver, dt, 20 if options.short else 100, count, *how)
        before = solver.steps
        p, w = clock(lambda: solver.advance(20 * dt))  # noqa: B023
        kind = "cpu" if count == 1 else "wall"
        n = len(solver.points) / 1e6
        ours = n * (solver.steps - before) / (p if count == 1 else w)
        rows.append([count, "atomic" if how else "plain", ours, n / theirs[kind], ours * theirs[kind] / n, hold])
        version = theirs["version"]
    use_threads(threads)
    h = 0.05
    points = lattice((0.4, 0.3, 0.3), h / 2)
    velocity = np.cross([2.0, -2.0, 4.0], points - points.mean(axis=0)) + 2 * np.sin(9 * points[:, [1, 2, 0]])
    velocity -= velocity.mean(axis=0)
    solver = solver_of(points, h, youngs_modulus=1e6, velocity=velocity, gravity=(0.1, 0, -0.2))
    dt, steps = 0.999 * 0.5 * h / float(solver.body.matter.wave_speed.max()), 1500
    _, found = in_taichi(options.taichi, solver, dt, steps, 1, "--double")
    for _ in range(5):
        solver.advance(steps / 5 * dt)
    apart = np.sqrt(((found["x"] - solver.points) ** 2).sum(axis=1).mean()) / h
    moved = np.linalg.norm(solver.points - points, axis=1).mean() / h
    return "\n\n".join([
        table(["threads", "sums in Taichi", "M steps/s", f"Taichi {version}", "ratio", "hold to"], rows),
        "Sums in Taichi are atomic, as in its examples; made for one thread alone, they need not be.",
        f"The state of {len(points)} particles that moved by {moved:.3g} cells on average in {solver.steps} steps, "
        f"stepped by Taichi in double precision: {apart:.2g} cells apart (rms); hold to 5e-4. {installed}",
    ])  # fmt: skip


def stiff(options: argparse.Namespace) -> str:
    """Metal of E = 1e8: what 24 frames cost, and how far they are from those of steps a tenth of the limit."""
    same = "now, with the earlier steps"
    names = ["now", same, *([options.against] if options.against else [])]
    few, fine, coarse, frames = (2, 24, 12, 4) if options.short else (3, 54, 28, 12)
    with tempfile.TemporaryDirectory() as folder:
        here = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, BENCH)))}
        places = {"now": (sys.executable, here), same: (sys.executable, here)}
        steps = {"now": 0, same: 0.5, options.against: 0}
        if options.against:
            other = Checkout(options.against, Path(folder) / "other")
            places[options.against] = other.python, other.environment

        def run(name: str, *arguments: object) -> tuple[dict, np.ndarray]:  # type: ignore[type-arg]
            python, environment = places[name]
            out = Path(folder) / "points.npz"
            command = [python, BENCH / "stiff_job.py", out, *arguments]
            said = subprocess.run([*map(str, command)], env=environment, check=True, capture_output=True, text=True)
            with np.load(out) as found:
                return json.loads(said.stdout.strip().splitlines()[-1]), found["points"]

        run("now", 12, 2, 0)
        _, exact = run("now", coarse, frames, 0.1)
        off = {
            name: np.sqrt(((run(name, coarse, frames, steps[name])[1] - exact) ** 2).sum(axis=2).mean())
            for name in names
        }
        costs = [
            {name: run(name, fine, few, steps[name])[0] for name in names} for _ in range(1 if options.short else 2)
        ]
    rows: list[list[object]] = []
    for name in names:
        cpu, wall = np.min([cost[name]["seconds"] for cost in costs], axis=0) / (few - 1)
        first = costs[0][name]
        rows.append([name, first["particles"], first["steps"] / (few - 1), 24 * cpu, 24 * wall, float(off[name])])
    hold = "Held to: a third of the earlier time at equal error."
    if options.against:
        for name in names[:2]:
            shares = [cost[name]["seconds"][1] / cost[options.against]["seconds"][1] for cost in costs]
            hold += f" {name.capitalize()}, over then, by the clock: {min(shares):.3g} to {max(shares):.3g}."
    columns = ["code", "particles", "steps a frame", "24 frames, processor s", "24 frames, s", "rms error, cells"]
    return (
        f"A body with legs that lands at 1.5 m/s; {few - 1} frames timed. Errors are those of a coarser body ({coarse} "
        f"cells) over {frames} frames, against steps of a Courant number of 0.1. {hold}\n\n{table(columns, rows)}"
    )


def jelly(options: argparse.Namespace) -> str:
    """Frames a second of a standing body, E = 1e5, 24 fps, as a bake computes them."""
    frames = 2 if options.short else 24
    shape = body().subdivide().subdivide()
    n = len(shape.vertices)
    mesh = Mesh(shape.vertices, np.asarray(shape.faces), np.ones((n, 3)), np.ones(n), np.zeros(n))
    rough = 0.02
    volume = len(fill(mesh.vertices, mesh.faces, rough).points) * rough**3
    spacing = (volume / options.particles) ** (1 / 3)
    fine = round(float(np.ptp(shape.vertices, axis=0).max()) / (PER_CELL * spacing))
    rows: list[list[object]] = []
    for name, hold in (("mpm", "1.5 frames/s, 250 frames in 180 s"), ("xpbd", "tens of frames/s")):
        for resolution in (12, fine):  # the first one compiles
            settings = {
                "solver": name,
                "material": {"name": "jelly", "youngs_modulus": 1e5},
                "floor": 0,
                "resolution": resolution,
            }
            job = prepare(mesh, parse_settings(settings | {"last": frames + 2}))
            with tempfile.TemporaryDirectory() as folder:
                cache = ParticleCache(folder)
                job.solver.advance(FRAME)
                cache.write(0, job.now())
                before, costs = job.solver.steps, []
                for frame in range(frames):
                    alone = clock(lambda: job.solver.advance(FRAME))  # noqa: B023
                    kept = clock(lambda: cache.write(frame, job.now()))  # noqa: B023
                    costs.append([*alone, *kept])
        cpu, wall, _, besides = np.median(costs, axis=0)
        steps = (job.solver.steps - before) / frames
        count = len(job.filling.points)
        rows.append([name, count, n, steps, 1 / cpu, 1 / wall, 1e3 * besides, 250 * (wall + besides), hold])
    columns = [
        "solver",
        "particles",
        "vertices",
        "steps a frame",
        "frames a processor second",
        "frames a second",
        "carrying and writing, ms",
        "250 frames with that, s",
        "hold to",
    ]
    return table(columns, rows)


def carrying(options: argparse.Namespace) -> str:
    """300k surfels on 16 neighbours each, milliseconds."""
    side = round(options.particles ** (1 / 3))
    sources = lattice((1, 1, 1), 1 / side)
    points = np.random.default_rng(0).random((300_000, 3))
    cell = (points * 64).astype(int)
    points = points[np.lexsort(cell.T)]
    bend = np.zeros((len(sources), 3, 3), np.float32)
    bend[:, 0, 2] = 0.6 * np.cos(3 * sources[:, 2])
    gradients = np.eye(3, dtype=np.float32) + bend
    x = (sources + np.stack([0.2 * np.sin(3 * sources[:, 2]), *np.zeros((2, len(sources)))], -1)).astype(np.float32)
    ones, flat = np.ones((len(points), 3), np.float32), np.ones(len(points), np.float32)
    rest = Frames(points.astype(np.float32), ones, ones, ones)
    ParticleDriven(Frames(*(array[:100] for array in rest)), sources)
    holder = []
    bound = clock(lambda: holder.append(ParticleDriven(rest, sources)))
    posed = PosedSurfels(*(np.empty_like(ones) for _ in range(4)), flat, ones, flat, flat, flat)

    def frame() -> None:
        holder[0].pose(posed, x, gradients)

    frame()
    cost = np.median([clock(frame) for _ in range(9)], axis=0)
    rows = [
        ["bind (once)", *(1e3 * np.array(bound))],
        ["surfels posed by particles, a frame", *(1e3 * cost)],
    ]
    return table(["step", "processor ms", "wall ms"], rows)


def filling(options: argparse.Namespace) -> str:
    """128 cells along the longest side: seconds, and overlap with the inside of the undamaged mesh."""
    mesh = body().subdivide().subdivide()
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    spacing = extent / 126
    rng = np.random.default_rng(1)
    keep = mesh.triangles_center[:, 2] > mesh.triangles_center[:, 2].min() + 0.02 * extent  # open feet
    for place in mesh.vertices[rng.integers(len(mesh.vertices), size=6)]:
        keep &= np.linalg.norm(mesh.triangles_center - place, axis=1) > 0.03 * extent
    noisy = mesh.vertices + 0.003 * extent * rng.normal(size=mesh.vertices.shape)
    fill(noisy, mesh.faces[keep], 4 * spacing)
    cells = fill(mesh.vertices, mesh.faces, spacing).space
    centres = cells.origin + (np.indices(cells.part.shape).reshape(3, -1).T + 0.5) * spacing
    whole = int(
        (igl.fast_winding_number(mesh.vertices, np.asarray(mesh.faces), centres) > 0.5).sum()
    )  # not what is filled
    rows = []
    for name, vertices, faces in (
        ("whole", mesh.vertices, mesh.faces),
        ("open feet, 6 holes", mesh.vertices, mesh.faces[keep]),
        ("and noise of 0.4 cells", noisy, mesh.faces[keep]),
    ):
        for method in ("auto", "parity"):
            found = []
            p, w = clock(lambda: found.append(fill(vertices, faces, spacing, method=method)))  # noqa: B023
            points = found[0].points
            both = int((igl.fast_winding_number(mesh.vertices, np.asarray(mesh.faces), points) > 0.5).sum())
            overlap = both / (whole + len(points) - both)
            hold = "0.95 within 2 s" if method == "auto" else ""
            rows.append([name, found[0].report["method"], len(points), overlap, p, w, hold])
    columns = ["mesh", "method", "particles", "overlap with the inside", "processor s", "wall s", "hold to"]
    return table(columns, rows)


#: Part -> title and what measures it.
PARTS = {
    "throughput": ("Simulated matter: speed by material", throughput),
    "taichi": ("Simulated matter: against Taichi", against_taichi),
    "stiff": ("Simulated matter: stiff metal, E = 1e8 Pa", stiff),
    "body": ("Simulated matter: a body with legs, E = 1e5 Pa, 24 frames a second", jelly),
    "surfels": ("Simulated matter: 300,000 surfels carried by 16 neighbours each", carrying),
    "fill": ("Simulated matter: filling, 128 cells along the longest side", filling),
    "motion": ("Simulated matter: motion against mechanics", motion),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART")
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--taichi", type=Path, metavar="PYTHON", help="interpreter with taichi 1.7")
    parser.add_argument("--against", metavar="COMMIT", help="an earlier one, for stiff metal")
    parser.add_argument("--short", action="store_true", help="fewer frames and cases, to see that it works")
    parser.add_argument("--no-write", action="store_true", help="print, and leave docs/benchmarks.md as it is")
    options = parser.parse_args()
    for part in options.part:
        title, run = PARTS[part]
        text = run(options)
        if options.no_write:
            print(f"{title}\n\n{text}\n", flush=True)
        else:
            write_section(f"simulate-{part}", title, text)


if __name__ == "__main__":
    main()
