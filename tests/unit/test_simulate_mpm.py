"""The particle solver against mechanics: free fall, momenta, energy, beams, bars, drops, friction, sand, water."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from plain_mpm import PlainMpm
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from simulation_cases import cantilever, energy, lattice, masses, momenta, solver_of, timoshenko

from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.errors import Cancelled, UsageError
from drgs_blender.simulation import grid_blocks, node_forces, p2g_g2p
from drgs_blender.simulation.colliders import Collider
from drgs_blender.simulation.contact import Plane
from drgs_blender.simulation.grid_blocks import arrange

FRAME = 1 / 24


def test_free_fall_is_the_discrete_solution():
    solver = solver_of(lattice((0.4, 0.4, 0.4), 0.05), 0.1, gravity=(0, 0, -9.81), low=(-1, -1, -3), youngs_modulus=1e5)
    rest = solver.points.copy()
    solver.advance(0.5)
    n = solver.steps
    expected = -9.81 * (0.5 / n) ** 2 * n * (n + 1) / 2
    assert np.abs(solver.points - rest - [0, 0, expected]).max() < 1e-5 * abs(expected)


def spinning_jelly(h: float = 0.1) -> object:
    points = lattice((0.5, 0.4, 0.3), h / 2)
    centre = points.mean(axis=0)
    turning = np.cross([1.0, -2.0, 4.0], points - centre) + 0.3 * np.sin(7 * points[:, [1, 2, 0]])
    turning -= turning.mean(axis=0) - [0.01, 0.02, 0.03]
    return solver_of(
        points, h, youngs_modulus=2e4, velocity=turning, low=points.min(axis=0) - 1, high=points.max(axis=0) + 1
    )


@pytest.mark.slow
def test_momenta_are_kept_over_3000_steps():
    solver = spinning_jelly()
    linear, angular = momenta(solver)
    moving = masses(solver) * np.linalg.norm(solver.state.v, axis=1)
    arm = np.linalg.norm(solver.points, axis=1)
    while solver.steps < 3000:
        solver.advance(0.5)
    later, turned = momenta(solver)
    assert np.abs(later - linear).max() < 1e-5 * moving.sum()
    assert np.abs(turned - angular).max() < 1e-5 * (moving * arm).sum()
    assert np.linalg.norm(angular) > 0.2 * (moving * arm).sum()


def test_energy_only_falls_and_slowly():
    """A body that vibrates in its lowest mode."""
    h = 0.0625
    points = lattice((1, 0.5, 0.5), h / 2)
    stretch = 0.5 * np.sin(np.pi * (points[:, 0] - 0.5))
    solver = solver_of(
        points, h, youngs_modulus=1e5, poisson=0.3, velocity=np.stack([stretch, 0 * stretch, 0 * stretch], -1)
    )
    start, step = energy(solver)[0], 0.4 / solver.steps_of(0.4)
    for _ in range(4):
        solver.advance(0.3 / 4)
        stored = energy(solver)[1]
        solver.advance(step)
        kinetic, later = energy(solver)
        # Velocities belong to the middle of a step, deformation to its ends.
        now = kinetic + 0.5 * (stored + later)
        assert now < 1.001 * start
    assert now > 0.93 * start


@pytest.mark.slow
def test_another_solver_goes_the_same_way():
    """1500 steps of one and the same state, against plain numpy in double precision."""
    h = 0.1
    points = lattice((0.3, 0.2, 0.2), h / 2)
    velocity = np.cross([2.0, -2.0, 4.0], points - points.mean(axis=0)) + 2 * np.sin(9 * points[:, [1, 2, 0]])
    solver = solver_of(
        points, h, youngs_modulus=1e6, velocity=velocity - velocity.mean(axis=0), gravity=(0.1, 0, -0.2),
        low=points.min(axis=0) - 0.4, high=points.max(axis=0) + 0.3,
    )  # fmt: skip
    plain = PlainMpm(solver)
    steps = 1500
    dt = 0.999 * 0.5 * h / float(solver.body.matter.wave_speed.max())
    for _ in range(5):
        solver.advance(steps / 5 * dt)
    assert solver.steps == steps
    for _ in range(steps):
        plain.step(dt)
    moved = np.linalg.norm(plain.x - points, axis=1) / h
    apart = np.sqrt((np.linalg.norm(plain.x - solver.points, axis=1) ** 2).mean()) / h
    assert moved.mean() > 2
    assert apart < 5e-4
    assert np.abs(plain.f - solver.gradients).max() < 1e-3


def tip_of(solver) -> np.ndarray:
    """Particles at the end of a cantilever."""
    x = solver.points[:, 0]
    return x > x.max() - solver.domain.spacing


@pytest.mark.slow
def test_cantilever_droops_as_timoshenko_says():
    solver = cantilever(4, length=0.75, gravity=(0, 0, -0.1), damping=14.0)
    rest, tip = solver.points.copy(), tip_of(solver)
    for _ in range(28):
        solver.advance(FRAME)
    assert (rest - solver.points)[tip, 2].mean() == pytest.approx(timoshenko(100.0, length=0.75), rel=0.03)


@pytest.mark.slow
def test_softer_beams_droop_more():
    droops = []
    for youngs_modulus in (1e5, 4e5, 1.6e6):
        beam = cantilever(4, youngs_modulus=youngs_modulus, gravity=(0, 0, -2.0), damping=6.0)
        rest, tip = beam.points.copy(), tip_of(beam)
        for _ in range(24):
            beam.advance(FRAME)
        droops.append((rest - beam.points)[tip, 2].mean())
    assert droops[0] > 1.1 * droops[1] > 1.21 * droops[2] > 0.05  # the softest hangs down already


@pytest.mark.slow
def test_strain_slower_than_the_digits_of_one_is_not_lost():
    """A bar pulled by 2e-8 of its length a step, which single precision cannot add to 1."""
    points = lattice((0.4, 0.1, 0.1), 0.025)
    held = (points[:, 0] < 0.1) | (points[:, 0] > 0.3)
    solver = solver_of(points, 0.05, youngs_modulus=1.2e7, damping=20.0, pinned=held)
    pulled = points[held] + [[4e-5, 0, 0]] * (points[held, :1] > 0.3)
    solver.advance(1.0, pulled)
    assert solver.steps > 5000
    middle = np.abs(points[:, 0] - 0.2) < 0.05
    strain = np.polyfit(points[middle, 0], (solver.points - points)[middle, 0], 1)[0]
    assert strain > 1e-4
    assert (solver.gradients[middle, 0, 0] - 1).mean() == pytest.approx(strain, rel=0.02)


@pytest.mark.slow
def test_cantilever_swings_at_its_first_frequency():
    """Against Euler and Bernoulli, whose beam is a little too stiff."""
    solver = cantilever(4, length=0.75, gravity=(0, 0, -0.1))
    rest, tip = solver.points.copy(), tip_of(solver)
    droop = []
    for _ in range(24):
        solver.advance(0.025)
        droop.append((rest - solver.points)[tip, 2].mean())
    # Released at rest it swings as 1 - cos: its lowest point is half a period from the start.
    top = int(np.argmax(droop))
    a, b, c = droop[top - 1 : top + 2]
    half = (top + 1 + 0.5 * (a - c) / (a - 2 * b + c)) * 0.025
    exact = 3.516 / (2 * np.pi) * np.sqrt(1e6 * 0.125**2 / 12 / 1000) / 0.75**2
    assert 0.93 < 0.5 / half / exact < 0.98


def test_a_hanging_bar_stretches_by_half_its_weight():
    h = 0.0625
    points = lattice((0.25, 0.25, 1 + 2 * h), h / 2)
    solver = solver_of(
        points,
        h,
        youngs_modulus=1e5,
        poisson=0.0,
        gravity=(0, 0, -0.5),
        damping=20,
        pinned=points[:, 2] > 1,
        low=(-0.2, -0.2, -1),
    )
    for _ in range(36):
        solver.advance(FRAME)
    end = points[:, 2] < h
    stretch = (points - solver.points)[end, 2].mean()
    assert stretch == pytest.approx(1000 * 0.5 * 1.0**2 / (2 * 1e5), rel=0.03)


def box(low, high) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.box(np.subtract(high, low))
    return mesh.vertices + np.add(low, high) / 2, np.asarray(mesh.faces)


@pytest.mark.parametrize("obstacle", ["plane", "mesh", "single face"])
@pytest.mark.parametrize("youngs_modulus", [3e4, 1e5, 5e5])
def test_a_dropped_block_neither_sinks_in_nor_shrinks(obstacle, youngs_modulus):
    h = 0.1
    points = np.add(lattice((0.6, 0.6, 0.6), h / 2), [0, 0, 0.2])
    colliders, planes = [], []
    if obstacle == "plane":
        planes = [Plane((0, 0, 0), (0, 0, 1))]
    elif obstacle == "mesh":
        vertices, faces = box((-1, -1, -0.5), (2, 2, 0))
        colliders = [Collider("slab", faces, vertices)]
    else:
        corners = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0.0]])
        colliders = [Collider("face", np.array([[0, 1, 2], [0, 2, 3]]), corners)]
    solver = solver_of(
        points, h, youngs_modulus=youngs_modulus, gravity=(0, 0, -9.81), damping=2, colliders=colliders, planes=planes,
        low=(-0.8, -0.8, -0.4), high=(1.4, 1.4, 1.4),
    )  # fmt: skip
    lowest = np.inf
    for _ in range(24):
        solver.advance(FRAME)
        lowest = min(lowest, float(solver.points[:, 2].min()))
    assert lowest > -0.75 * h
    volume = (np.linalg.det(solver.gradients.astype(float)) * solver.body.volume).sum()
    sag = 1000 * 9.81 * 0.3 / youngs_modulus * (1 - 2 * 0.3)  # what its own weight presses out of it
    assert volume > (0.96 - sag) * solver.body.volume.sum()
    assert solver.points[:, 2].max() < 0.8 + h


@pytest.mark.parametrize("friction", [0.2, 1.0])
def test_coulomb_friction_on_a_slope(friction):
    """A block on a slope of 30 degrees slides with g (sin - mu cos), or stays."""
    h, slope = 0.05, np.radians(30)
    points = lattice((0.4, 0.4, 0.2), h / 2)
    gravity = 9.81 * np.array([np.sin(slope), 0, -np.cos(slope)])
    solver = solver_of(
        points, h, youngs_modulus=1e6, gravity=tuple(gravity), planes=[Plane((0, 0, 0), (0, 0, 1), friction=friction)],
        low=(-0.2, -0.2, -0.2), high=(2.5, 0.6, 0.6),
    )  # fmt: skip
    solver.advance(0.1)  # settles
    start, speed = solver.points[:, 0].mean(), solver.state.v[:, 0].mean()
    solver.advance(0.3)
    expected = max(0.0, 9.81 * (np.sin(slope) - friction * np.cos(slope)))
    moved = solver.points[:, 0].mean() - start
    assert moved == pytest.approx(speed * 0.3 + 0.5 * expected * 0.3**2, abs=0.02)


def test_a_lift_carries_what_is_on_it_and_a_turntable_turns_it():
    h = 0.1
    points = lattice((0.4, 0.4, 0.3), h / 2) - [0.2, 0.2, 0]
    vertices, faces = box((-0.6, -0.6, -0.4), (0.6, 0.6, 0))
    frames = np.arange(13)
    turn = Rotation.from_rotvec(np.outer(frames * FRAME, [0, 0, 1.0])).as_matrix()
    path = np.stack([vertices @ r.T + [0, 0, f * FRAME * 0.5] for f, r in zip(frames, turn)])
    lift = Collider("lift", faces, path, contact="sticky")
    solver = solver_of(
        points,
        h,
        youngs_modulus=2e5,
        gravity=(0, 0, -9.81),
        colliders=[lift],
        low=(-1, -1, -0.6),
        high=(1, 1, 1.2),
        damping=1.0,
    )
    for _ in range(12):
        solver.advance(FRAME)
    assert solver.points[:, 2].mean() == pytest.approx(0.15 + 0.25, abs=0.05)
    low = points[:, 2] < 0.1
    expected = points[low] @ turn[-1].T
    assert np.abs(solver.points[low, :2] - expected[:, :2]).max() < 0.06


def test_a_collider_that_deforms_pushes():
    """A sheet that bulges upwards under a block."""
    h = 0.1
    points = lattice((0.4, 0.4, 0.2), h / 2) - [0.2, 0.2, -0.05]
    u, v = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21), indexing="ij")
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).reshape(-1)
    faces = np.concatenate(
        [np.stack([corner, corner + 21, corner + 22], -1), np.stack([corner, corner + 22, corner + 1], -1)]
    )
    bulge = np.exp(-4 * (u**2 + v**2))
    path = np.stack([np.stack([u, v, bulge * 0.04 * f], -1).reshape(-1, 3) for f in range(11)])
    solver = solver_of(
        points, h, youngs_modulus=2e5, gravity=(0, 0, -9.81), damping=2, colliders=[Collider("sheet", faces, path)],
        low=(-1, -1, -0.4), high=(1, 1, 1.2),
    )  # fmt: skip
    for _ in range(10):
        solver.advance(FRAME)
    middle = np.abs(points[:, :2]).max(axis=1) < 0.06
    assert solver.points[middle, 2].min() > 0.4 - 0.75 * h


def test_pins_follow_their_targets_and_pull_the_rest():
    h = 0.1
    points = lattice((0.8, 0.3, 0.3), h / 2)
    pinned = points[:, 0] < 0.2
    solver = solver_of(points, h, youngs_modulus=1e5, damping=5, pinned=pinned, low=(-0.5, -0.5, -0.5), high=(3, 1, 1))
    for k in range(1, 25):
        solver.advance(FRAME, points[pinned] + [0.02 * k, 0, 0])
    assert np.abs(solver.points[pinned] - points[pinned] - [0.48, 0, 0]).max() < 1e-6
    assert (solver.points - points)[~pinned, 0].mean() == pytest.approx(0.48, abs=0.12)


def slope_of_pile(solver) -> float:
    """Degrees: how steeply the surface of a round pile falls between a quarter and three quarters of its height."""
    x = solver.points - [*solver.points[:, :2].mean(axis=0), 0]
    radius = np.linalg.norm(x[:, :2], axis=1)
    edges = np.quantile(radius, np.linspace(0, 0.98, 13))
    height = np.array([np.quantile(x[(radius >= a) & (radius < b), 2], 0.97) for a, b in pairwise(edges)])
    middle = 0.5 * (edges[1:] + edges[:-1])
    use = (height > 0.2 * height.max()) & (height < 0.8 * height.max())
    return float(np.degrees(np.arctan(-np.polyfit(middle[use], height[use], 1)[0])))


def test_sand_holds_a_slope_below_its_angle_of_friction_only():
    """A cone of 27 degrees."""
    h = 0.08
    points = lattice((1.28, 1.28, 0.4), h / 2) - [0.64, 0.64, 0]
    points = points[points[:, 2] < 0.36 - 0.51 * np.linalg.norm(points[:, :2], axis=1)]
    slopes = {}
    for angle in (45.0, 12.0):
        solver = solver_of(
            points, h, "sand", gravity=(0, 0, -9.81), youngs_modulus=1e5, planes=[Plane((0, 0, 0), (0, 0, 1),
                friction=1.0)],
            low=(-1.5, -1.5, -0.3), high=(1.5, 1.5, 1), friction_angle=angle,
        )  # fmt: skip
        for _ in range(24):
            solver.advance(FRAME)
        slopes[angle] = slope_of_pile(solver)
    assert 22 < slopes[45.0] < 30
    assert slopes[12.0] < 16


def test_thick_fluids_come_to_rest_whatever_their_viscosity():
    """Explicit steps that heed elastic waves alone would throw them apart."""
    points = lattice((0.6, 0.6, 0.6), 0.05)
    velocity = np.stack([np.sin(9 * points[:, 1]), 0 * points[:, 1], np.cos(7 * points[:, 0])], 1)
    solver = solver_of(points, 0.1, "honey", velocity=velocity - velocity.mean(axis=0), viscosity=2e4)
    energies = [np.square(velocity - velocity.mean(axis=0)).sum()]
    for _ in range(4):
        solver.advance(1 / 24)
        energies.append(float(np.square(solver.state.v[: len(points)]).sum()))
    assert all(later <= earlier for earlier, later in pairwise(energies)), energies
    assert energies[-1] < 0.5 * energies[0]  # what is left turns as a whole


def test_standing_water_bears_its_weight():
    """A full box of water keeps its height but for its compressibility, and comes to rest."""
    h = 0.1
    points = lattice((0.8, 0.8, 0.8), h / 2)
    walls = [Plane((0, 0, 0), n, "slip") for n in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    walls += [Plane((0.8, 0.8, 0), n, "slip") for n in ((-1, 0, 0), (0, -1, 0))]
    solver = solver_of(points, h, "water", gravity=(0, 0, -9.81), planes=walls, damping=10.0)
    for _ in range(24):
        solver.advance(FRAME)
    assert solver.points[:, 2].mean() == pytest.approx(0.4, abs=0.02)
    depth = 0.8 - points[:, 2]
    pressure = -solver.state.tau[:, :3].mean(axis=1)
    deep = (points[:, 2] < 0.5) & (points[:, 2] > 0.1)
    assert pressure[deep].mean() == pytest.approx(1000 * 9.81 * depth[deep].mean(), rel=0.05)


def test_metal_stays_bent_and_jelly_does_not():
    """Both are pressed by a plate to two thirds of their height, which then lifts."""
    h = 0.1
    points = lattice((0.4, 0.4, 0.6), h / 2)
    vertices, faces = box((-0.5, -0.5, 0.62), (0.9, 0.9, 0.9))
    down = np.concatenate([np.linspace(0, -0.22, 11), np.linspace(-0.22, 0.3, 14)[1:], np.full(12, 0.3)])
    plate = Collider("plate", faces, vertices + down[:, None, None] * [0, 0, 1], friction=0.0)
    heights = {}
    for name in ("metal", "jelly"):
        solver = solver_of(
            points, h, name, planes=[Plane((0, 0, 0), (0, 0, 1), "separate", 0.0)], colliders=[plate], damping=3.0,
            youngs_modulus=1e5, **({"yield_stress": 3e3, "hardening": 0.0} if name == "metal" else {}),
        )  # fmt: skip
        for _ in range(len(down) - 1):
            solver.advance(FRAME)
        heights[name] = float(np.ptp(solver.points[:, 2]))
        if name == "metal":
            elastic, total = (np.linalg.norm(f, axis=1).mean() for f in (
                solver.state.elastic, solver.state.total))  # fmt: skip
            assert total > 2 * elastic  # the surfels follow the whole deformation, not what springs back
    assert heights["metal"] < 0.5
    assert heights["jelly"] > 0.54


@pytest.mark.parametrize(("strength", "plastic"), [(2.0, 0.0), (0.5, 0.0125)])
def test_a_bar_of_metal_bears_its_weight_or_is_upset_until_it_does(strength, plastic):
    """Density x gravity x height is 1e4 Pa; below z the bar flows by (that of what is above - Y) / H."""
    h, weight = 0.125, 1e4
    points = lattice((0.25, 0.25, 1.0), h / 2)
    numbers = {"youngs_modulus": 1e6, "poisson": 0.0, "density": weight / 9.81, "hardening": 1e5}
    solver = solver_of(
        points, h, "metal", gravity=(0, 0, -9.81), damping=150.0, yield_stress=strength * weight,
        planes=[Plane((0, 0, 0), (0, 0, 1), "slip")], **numbers,
    )  # fmt: skip
    top = points[:, 2] > 1 - 0.6 * h
    sunk = []
    for _ in range(4):
        solver.advance(1.0)
        sunk.append(float((points - solver.points)[top, 2].mean()))
    assert sunk[-1] - sunk[-2] < 0.02 * sunk[-1]  # at rest
    assert sunk[-1] == pytest.approx(weight / 2e6 + plastic, rel=0.08)
    assert (solver.state.memory.max() > 0) == (plastic > 0)


@pytest.mark.slow
def test_an_animal_of_metal_stands_and_a_fall_from_its_own_height_dents_it():
    h = 1.7 / 17
    body = np.add(lattice((0.9, 0.4, 0.9), h / 2), [0, 0, 0.8])
    leg = lattice((0.2, 0.15, 0.8), h / 2)
    points = np.concatenate([body, *(np.add(leg, [x, y, 0]) for x in (0.0, 0.7) for y in (0.0, 0.25))])
    plastic = {}
    for height in (0.0, 1.7):
        solver = solver_of(
            points, h, "metal", gravity=(0, 0, -9.81), low=(-2, -2, -2), high=(3, 3, 2),
            planes=[Plane((0, 0, -height), (0, 0, 1))],
        )  # fmt: skip
        while solver.frame * FRAME < (0.75 if height else 0.4):
            solver.advance(FRAME)
        sunk = (points - solver.points)[: len(body), 2].mean() - height
        plastic[height] = solver.state.memory
        assert sunk < (0.5 if height else 0.02) * 1.7
    assert (plastic[0.0] > 0.005).mean() < 0.02
    assert (plastic[1.7] > 0.05).mean() > 0.02


def test_turning_everything_turns_the_result():
    """A quarter turn maps the grid to itself: the motion is the same but for rounding."""
    h = 0.1
    points = lattice((0.5, 0.3, 0.2), h / 2) - [0.25, 0.15, 0.1]
    turn = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
    results = []
    for r in (np.eye(3), turn):
        solver = solver_of(
            points @ r.T, h, "clay", velocity=(points * [1, -2, 1] @ r.T), gravity=tuple(r @ [0.3, 0.2, -2.0]),
            low=(-1.6,) * 3, high=(1.6,) * 3, domain=None,
        )  # fmt: skip
        solver.advance(0.2)
        results.append(solver.points @ r)
    assert np.abs(results[0] - results[1]).max() < 1e-5


@pytest.mark.alone
def test_any_number_of_threads_gives_the_same_bits(monkeypatch):
    """Also where work is cut into the smallest pieces, into which so small a body would not be."""
    monkeypatch.setattr(grid_blocks, "_SHARE", 1)
    monkeypatch.setattr(p2g_g2p, "SLOTS", 1)
    monkeypatch.setattr(node_forces, "SLOTS", 1)
    threads = get_num_threads()
    results = []
    try:
        for count in (1, threads):
            use_threads(count)
            solver = spinning_jelly()
            assert len(arrange(solver.state.x, solver.domain)[0].shares) == count + 1
            solver.advance(0.3)
            results.append(solver.arrays())
    finally:
        use_threads(threads)
    for name in results[0]:
        assert results[0][name].tobytes() == results[1][name].tobytes()


def test_markers_are_not_lost_when_sand_falls_apart():
    """A block of sand hits a thin plate and runs over its rim: its surface stays with the grains."""
    h = 0.05
    points = np.add(lattice((0.3, 0.3, 0.5), h / 2), [0, 0, 0.05])
    rng = np.random.default_rng(0)
    on = points.min(axis=0) - h / 4 + (np.ptp(points, axis=0) + h / 2) * rng.random((400, 3))
    side, axis = rng.integers(2, size=400), rng.integers(3, size=400)
    on[np.arange(400), axis] = np.where(side, points.max(axis=0)[axis] + h / 4, points.min(axis=0)[axis] - h / 4)
    solver = solver_of(
        points, h, "sand", markers=on, gravity=(0, 0, -9.81), velocity=(0, 0, -2.0), low=(-1.5, -1.5, -1.6),
        high=(1.8, 1.8, 0.8), colliders=[Collider("plate", *box((0, 0, -0.12), (0.3, 0.3, 0)))],
    )  # fmt: skip
    for _ in range(7):
        solver.advance(FRAME)
        apart = cKDTree(solver.points).query(solver.markers)[0]
        assert apart.max() <= h * (1 + 1e-6)
        assert np.isfinite(solver.markers).all()


def test_markers_move_with_the_matter():
    from drgs_blender.core.sim_materials import make_material, particle_materials
    from drgs_blender.simulation.grid_blocks import Domain
    from drgs_blender.simulation.solver import Body, Forces, Solver

    h = 0.1
    points = lattice((0.5, 0.5, 0.5), h / 2)
    corners = np.array([[x, y, z] for x in (0, 0.5) for y in (0, 0.5) for z in (0, 0.5)])
    matter = particle_materials([make_material("sand")], np.zeros(len(points), int))
    body = Body(points, np.full(len(points), (h / 2) ** 3), matter, corners, velocity=(0.5, 0.2, 1.0))
    solver = Solver(body, Domain.around([-1] * 3, [2] * 3, h), Forces(gravity=(0, 0, 0)))
    mass = momenta(solver_of(points, h, "sand", velocity=(0.5, 0.2, 1.0)))[0]
    solver.advance(0.4)
    assert np.abs(solver.markers - corners - [0.2, 0.08, 0.4]).max() < 1e-4
    m = masses(solver)[:, None]
    assert (m * solver.state.v[: len(points)]).sum(axis=0) == pytest.approx(mass, rel=1e-4)  # markers weigh nothing


def straying(**more):
    """A block at rest, and a drop that flies out of the domain."""
    block, drop = lattice((0.4, 0.4, 0.4), 0.05), np.add(lattice((0.1, 0.1, 0.1), 0.05), [1.0, 0.1, 0.1])
    points = np.concatenate([block, drop])
    velocity = np.where(np.arange(len(points))[:, None] < len(block), [0.0, 0.0, 0.0], [15.0, 0.0, 0.0])
    return solver_of(points, 0.1, "water", velocity=velocity, **more), len(block)


def test_drops_that_leave_the_domain_stay_there_and_the_rest_goes_on():
    solver, block = straying()
    for _ in range(4):
        solver.advance(FRAME)
    drop = solver.points[block:].copy()
    assert solver.lost == len(drop) and not solver.state.v[block:].any()
    reached = solver.domain.high[0] + 2 * solver.domain.spacing
    assert (drop[:, 0] >= solver.domain.high[0]).all() and (drop[:, 0] < reached).all()
    solver.state.v[:block] = [0.3, 0.2, 0.1]
    before, rest = solver.points[:block].copy(), masses(solver)[:block]
    speed = (rest[:, None] * solver.state.v[:block]).sum(axis=0)
    solver.advance(FRAME)
    np.testing.assert_array_equal(solver.points[block:], drop)
    moved = (solver.points[:block] - before).mean(axis=0)
    assert moved == pytest.approx(np.array([0.3, 0.2, 0.1]) * FRAME, rel=1e-3)
    assert (rest[:, None] * solver.state.v[:block]).sum(axis=0) == pytest.approx(speed, rel=1e-4)


def test_a_frame_with_drops_outside_depends_on_nothing_but_its_beginning():
    """As a bake that goes on needs it, before, while and after they leave; on any number of threads."""
    solver, _ = straying(gravity=(0, 0, -1.0), low=(-1, -1, -1), high=(2, 2, 2))
    states, lost = [solver.arrays()], [0]
    for _ in range(5):
        solver.advance(FRAME)
        states.append(solver.arrays())
        lost.append(solver.lost)
    assert lost[1] == 0 < lost[-1]
    threads = get_num_threads()
    try:
        for frame in range(5):
            use_threads(1 + frame % 2)
            other, _ = straying(gravity=(0, 0, -1.0), low=(-1, -1, -1), high=(2, 2, 2))
            assert other.restore(frame, states[frame])
            other.advance(FRAME)
            for name, array in other.arrays().items():
                np.testing.assert_array_equal(array, states[frame + 1][name], err_msg=f"{name}, frame {frame}")
    finally:
        use_threads(threads)


def test_a_pin_may_not_leave_the_domain():
    points = lattice((0.4, 0.4, 0.4), 0.05)
    solver = solver_of(points, 0.1, pinned=points[:, 0] > 0.35)
    with pytest.raises(UsageError, match=r"outside the domain.*Give a larger domain"):
        for _ in range(24):
            solver.advance(FRAME, solver.points[points[:, 0] > 0.35] + [0.3, 0, 0])
    assert not solver.lost


def test_what_goes_wrong_is_said_with_frame_cause_and_remedy():
    points = lattice((0.4, 0.4, 0.4), 0.05)
    falling = solver_of(points, 0.1, gravity=(0, 0, -9.81))
    falling.first = 100
    with pytest.raises(UsageError, match=r"simulation, frame 1[0-4]\d: has .*outside the domain.*Give a larger domain"):
        for _ in range(48):
            falling.advance(FRAME)
    before = falling.arrays()
    assert 0 < falling.lost <= len(points) / 2  # the last whole frame is kept
    assert np.isfinite(before["x"]).all()

    vertices, faces = box((0.1, 0.1, 0.1), (1, 1, 1))
    with pytest.raises(UsageError, match=r"wall: overlaps the body.*Move one of the two apart"):
        solver_of(points, 0.1, colliders=[Collider("wall", faces, vertices)])

    broken = solver_of(points, 0.1)
    broken.state.v[5] = np.nan
    with pytest.raises(UsageError, match="velocities that are not finite"):
        broken.advance(FRAME)
    broken = solver_of(points, 0.1)
    broken.state.tau[5] = np.nan
    with pytest.raises(UsageError, match="became infinite"):
        broken.advance(FRAME)


@pytest.mark.parametrize("contact", ["separate", "slip", "sticky"])
def test_a_collider_that_starts_inside_is_named_and_throws_nothing(contact, caplog):
    points = lattice((0.4, 0.4, 0.4), 0.05)
    vertices, faces = box((0.08, 0.08, 0.08), (0.32, 0.32, 0.32))
    solver = solver_of(points, 0.1, colliders=[Collider("core", faces, vertices, contact)], gravity=(0, 0, -9.81))
    assert "core: overlaps the body at the start" in caplog.text
    fastest = 0.0
    for _ in range(24):
        solver.advance(FRAME)
        fastest = max(fastest, float(np.abs(solver.state.v).max()))
    assert fastest < 1.0  # it hangs on what is inside of it


def test_a_cancelled_frame_leaves_the_state_at_its_beginning():
    solver = solver_of(lattice((0.4, 0.4, 0.4), 0.05), 0.1, gravity=(0, 0, -1.0))
    solver.advance(FRAME)
    before = {k: v.copy() for k, v in solver.arrays().items()}
    calls = iter([False, False, True])
    with pytest.raises(Cancelled):
        solver.advance(FRAME, cancelled=lambda: next(calls))
    after = solver.arrays()
    assert solver.frame == 1
    assert all(np.array_equal(before[k], after[k]) for k in before)


def test_a_collider_faster_than_the_grid_shortens_the_step():
    h = 0.1
    points = lattice((0.4, 0.4, 0.4), h / 2)
    vertices, faces = box((-0.5, -0.2, -0.2), (-0.2, 0.6, 0.6))
    path = np.stack([vertices, np.add(vertices, [2.0, 0, 0])])  # 20 cells in a frame
    solver = solver_of(
        points, h, youngs_modulus=1e3, density=1000, colliders=[Collider("bat", faces, path)], high=(8, 1.5, 1.5)
    )
    solver.advance(FRAME)
    assert solver.steps >= 2.0 / (0.5 * h)
    assert solver.points[:, 0].min() > 1.8 - 1.5 * h  # the bat is before it, it has not passed through


def test_only_what_is_too_fast_for_its_size_has_run_away():
    """Soft matter as large as a hill needs few steps, and is not told to slow down."""
    size = 1e4
    points = lattice((0.4 * size,) * 3, 0.05 * size)
    hill = solver_of(points, 0.1 * size, gravity=(0, 0, -9.81))
    for _ in range(3):
        hill.advance(1 / 24)
    assert hill.steps == 3 and (hill.points - points)[:, 2].max() < 0
    with pytest.raises(UsageError, match="ran away: matter moves at 1e"):
        solver_of(points / size, 0.1, velocity=(1e6, 0, 0)).advance(1 / 24)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
def test_what_yields_takes_longer_steps_and_stays_stable(poisson):
    """A block of metal that tumbles and hits the ground, particles in disorder."""
    h, frames = 0.1, 6
    points = lattice((0.4, 0.3, 0.3), h / 2)
    points += np.random.default_rng(0).uniform(-0.2 * h, 0.2 * h, points.shape)
    velocity = np.cross([2.0, -2.0, 4.0], points - points.mean(axis=0)) + np.sin(9 * points[:, [1, 2, 0]]) - [0, 0, 3.0]
    numbers = {"youngs_modulus": 1e7, "yield_stress": 1e9, "poisson": poisson}
    solver = solver_of(
        points, h, "metal", gravity=(0, 0, -9.81), velocity=velocity, planes=[Plane((0, 0, -0.1), (0, 0, 1))],
        low=(-1.5, -1.5, -0.4), high=(2, 2, 1.5), courant=None, **numbers,
    )  # fmt: skip
    assert solver.rate * h / solver.body.matter.wave_speed[0] < 1 / 0.7
    limit = 0.5 * (masses(solver) * (velocity**2).sum(axis=1)).sum() + 9.81 * masses(solver).sum()
    for _ in range(frames):
        solver.advance(FRAME)
        assert 0.5 * (masses(solver) * (solver.state.v.astype(float) ** 2).sum(axis=1)).sum() < limit
    assert solver_of(points, h, courant=None).rate == solver_of(points, h).rate
