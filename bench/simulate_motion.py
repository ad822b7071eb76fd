"""Motion of simulated matter against mechanics and exact answers: a part of bench_simulate.py."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import trimesh
from report import table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "unit"))
from simulation_cases import cantilever, energy, lattice, momenta, solver_of, timoshenko

from drgs_blender.deform.gmls import bind_points, carry
from drgs_blender.simulation.contact import Plane
from drgs_blender.simulation.fill import fill

FRAME = 1 / 24
Rows = list[list[object]]


def conservation(options: argparse.Namespace) -> Rows:
    """Free fall, momenta and energy."""
    falling = solver_of(lattice((0.4, 0.4, 0.4), 0.05), 0.1, gravity=(0, 0, -9.81), low=(-1, -1, -3))
    start = falling.points.copy()
    falling.advance(0.5)
    n = falling.steps
    exact = -9.81 * (0.5 / n) ** 2 * n * (n + 1) / 2
    error = np.abs(falling.points - start - [0, 0, exact]).max() / -exact
    rows: Rows = [["free fall against the discrete solution, relative error", float(error), "1e-5"]]

    points = lattice((0.5, 0.4, 0.3), 0.05)
    turning = np.cross([1.0, -2.0, 4.0], points - points.mean(axis=0)) + 0.3 * np.sin(7 * points[:, [1, 2, 0]])
    spinning = solver_of(
        points, 0.1, youngs_modulus=2e4, velocity=turning - turning.mean(axis=0), low=[-1] * 3, high=[1.6] * 3
    )
    linear, angular = momenta(spinning)
    size = (spinning.body.volume * 1000 * np.linalg.norm(spinning.state.v, axis=1)).sum()
    while spinning.steps < (300 if options.short else 3000):
        spinning.advance(0.5)
    later, turned = momenta(spinning)
    rows.append(
        [f"linear momentum after {spinning.steps} steps, error", float(np.abs(later - linear).max() / size), "1e-5"]
    )
    share = float(np.linalg.norm(turned - angular) / np.linalg.norm(angular))
    rows.append([f"angular momentum after {spinning.steps} steps, relative error", share, "1e-5"])

    h = 0.0625
    points = lattice((1, 0.5, 0.5), h / 2)
    stretch = 0.5 * np.sin(np.pi * (points[:, 0] - 0.5))
    solver = solver_of(points, h, youngs_modulus=1e5, velocity=np.stack([stretch, 0 * stretch, 0 * stretch], -1))
    begin, step, seen = energy(solver)[0], 0.4 / solver.steps_of(0.4), []
    for _ in range(6):
        solver.advance(0.05)
        stored = energy(solver)[1]
        solver.advance(step)
        kinetic, after = energy(solver)
        seen.append((kinetic + 0.5 * (stored + after)) / begin)  # velocities belong to the middle of a step
    rows.append(["energy of a vibrating block, highest in 0.3 s", max(seen), "at most 1.001"])
    rows.append(["the same, at 0.3 s", seen[-1], "at least 0.93"])
    return rows


def droop(per: int, youngs_modulus: float, gravity: float, frames: int, **more: float) -> float:
    """Of the tip of a cantilever, metres."""
    beam = cantilever(per, youngs_modulus=youngs_modulus, gravity=(0, 0, -gravity), **more)
    rest = beam.points.copy()
    tip = rest[:, 0] > rest[:, 0].max() - beam.domain.spacing
    for _ in range(frames):
        beam.advance(FRAME)
    return float((rest - beam.points)[tip, 2].mean())


def beams(options: argparse.Namespace) -> Rows:
    """Cantilevers against theory."""
    rows: Rows = []
    for per in (4,) if options.short else (4, 8):
        # The clamp ends at a node: how long the beam is depends on where the grid lies.
        ratios = [droop(per, 1e6, 0.1, 60, damping=8.0, offset=k / 4) / timoshenko(100.0) for k in range(4)]
        shown = f"{np.mean(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})"
        what = f"cantilever of {per} cells, droop over Timoshenko's: mean and range of four places in the grid"
        rows.append([what, shown, "mean 0.97 to 1.03"])
    beam = cantilever(4, length=0.75, gravity=(0, 0, -0.1))
    rest = beam.points.copy()
    tip = rest[:, 0] > rest[:, 0].max() - beam.domain.spacing
    swing = []
    for _ in range(24):
        beam.advance(0.025)
        swing.append(float((rest - beam.points)[tip, 2].mean()))
    top = int(np.argmax(swing))
    a, b, c = swing[top - 1 : top + 2]
    half = (top + 1 + 0.5 * (a - c) / (a - 2 * b + c)) * 0.025
    exact = 3.516 / (2 * np.pi) * np.sqrt(1e6 * 0.125**2 / 12 / 1000) / 0.75**2
    rows.append(["cantilever, first frequency over Euler and Bernoulli's", 0.5 / half / exact, "0.93 to 0.98"])
    droops = {
        youngs_modulus: droop(4, youngs_modulus, 2.0, 24 if options.short else 96, damping=6.0)
        for youngs_modulus in (1e5, 4e5, 1.6e6)
    }
    values = list(droops.values())
    shown = ", ".join(f"{value:.3f}" for value in values)
    ordered = values[0] > values[1] > values[2] > 0
    rows.append(
        ["droop under 2 m/s² for E = 1e5, 4e5, 1.6e6, m", shown, f"strictly ordered: {'yes' if ordered else 'no'}"]
    )
    stiff = droop(4, 1.6e6, 0.2, 24 if options.short else 60, damping=8.0) / timoshenko(200.0, youngs_modulus=1.6e6)
    rows.append(["stiffest, under 0.2 m/s², over the linear one", stiff, "0.97 to 1.03"])
    return rows


def drops(options: argparse.Namespace) -> Rows:
    """Blocks that fall on the ground."""
    rows: Rows = []
    h = 0.1
    points = np.add(lattice((0.6, 0.6, 0.6), h / 2), [0, 0, 0.2])
    for youngs_modulus in (3e4, 1e5, 5e5):
        solver = solver_of(
            points, h, youngs_modulus=youngs_modulus, gravity=(0, 0, -9.81), damping=2, planes=[Plane((0, 0, 0), (0,
                0, 1))],
            low=(-0.8, -0.8, -0.4), high=(1.4, 1.4, 1.4),
        )  # fmt: skip
        lowest = np.inf
        for _ in range(8 if options.short else 48):
            solver.advance(FRAME)
            lowest = min(lowest, float(solver.points[:, 2].min()) - h / 4)  # the surface is half a spacing below
        # Its own weight presses this much out of it: a pillar's mean strain times the share that is of volume.
        pressed = 1000 * 9.81 * 0.3 / youngs_modulus * (1 - 2 * 0.3)
        volume = (np.linalg.det(solver.gradients.astype(float)) * solver.body.volume).sum() / solver.body.volume.sum()
        rows.append(
            [f"block dropped on the ground, E = {youngs_modulus:g}: penetration, cells", max(0.0, -lowest / h), "0.75"]
        )
        rows.append(
            ["its volume in the end, with what its weight presses out", float(volume + pressed), "at least 0.96"]
        )
    return rows


def followed(options: argparse.Namespace) -> Rows:
    """What GMLS does: affine maps, particles that were left out, two slabs."""
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(60, 3))
    shapes = {"full": cloud, "coplanar": cloud * [1, 1, 0], "collinear": cloud * [1, 0, 0], "one neighbour": cloud[:1]}
    turn = np.eye(3) + 0.4 * rng.normal(size=(3, 3))
    turn *= np.sign(np.linalg.det(turn))
    rows: Rows = []
    for name, sources in shapes.items():
        points = cloud[:40] * 0.5
        x = (sources @ turn.T + [0.3, -0.2, 0.1]).astype(np.float32)
        gradients = np.tile(turn.astype(np.float32), (len(sources), 1, 1))
        moved, at, _ = carry(bind_points(points, sources), x, gradients)
        place = float(np.abs(moved - points @ turn.T - [0.3, -0.2, 0.1]).max())
        rows.append([f"GMLS under an affine map, float32, {name}: positions", place, "1e-6 of the size"])
        rows.append([f"the same, gradients ({name})", float(np.abs(at - turn).max()), "2e-5"])

    h = 0.05
    points = np.add(lattice((0.6, 0.3, 0.6), h / 2), [0, 0, 0.1])
    floor = [Plane((0, 0, 0), (0, 0, 1))]
    solver = solver_of(points, h, youngs_modulus=5e4, gravity=(0, 0, -9.81), planes=floor, velocity=(0.5, 0, -1))
    for _ in range(10):
        solver.advance(FRAME)
    out = np.random.default_rng(0).random(len(points)) < 0.05
    weights = bind_points(points[out], points[~out])
    moved, _, _ = carry(weights, solver.points[~out], solver.gradients[~out])
    error = np.linalg.norm(moved - solver.points[out], axis=1) / h
    rows.append(["particles left out of a run, median error, cells", float(np.median(error)), "0.01"])

    slab = trimesh.creation.box((1, 1, 0.2)).subdivide().subdivide().subdivide()
    spacing, gap = 0.025, 0.055
    upper = np.add(slab.vertices, [0, 0, 0.2 + gap])
    vertices = np.concatenate([slab.vertices, upper])
    space = fill(vertices, np.concatenate([slab.faces, slab.faces + len(upper)]), spacing)
    lifted = [0, 0, 1.0]
    x = space.points + np.where(space.points[:, 2:] > 0.1 + gap / 2, lifted, 0.0)
    still = np.tile(np.eye(3, dtype=np.float32), (len(x), 1, 1))
    moved, _, _ = carry(bind_points(vertices, space.points, space=space.space, parts=space.part), x, still)
    wanted = np.concatenate([slab.vertices, upper + lifted])
    wrong = int((np.abs(moved - wanted).max(axis=1) > 1e-5).sum())
    rows.append(
        [f"two slabs {gap / spacing:.1f} particles apart, pulled apart: points that follow the wrong one", wrong, "0"]
    )
    return rows


def motion(options: argparse.Namespace) -> str:
    """All figures that are held to mechanics or to an exact answer."""
    rows = [row for part in (conservation, beams, drops, followed) for row in part(options)]
    return table(["what", "measured", "hold to"], rows)
