"""The quick look: a lattice that behaves as the particles do, roughly and fast."""

from __future__ import annotations

import numpy as np
import pytest
from simulation_cases import cantilever, lattice, solver_of, timoshenko

from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.errors import Cancelled, UsageError
from drgs_blender.simulation import xpbd
from drgs_blender.simulation.colliders import Collider
from drgs_blender.simulation.contact import Plane
from drgs_blender.simulation.solver import Forces
from drgs_blender.simulation.xpbd import Lattice

FRAME = 1 / 24


def block(material: str = "jelly", youngs_modulus: float = 1e5, **more):
    return solver_of(lattice((0.4, 0.4, 0.4), 0.05), 0.1, material, youngs_modulus=youngs_modulus, **more).body


@pytest.mark.parametrize("youngs_modulus", [1e4, 1e6, 2e9])
def test_matter_at_rest_stays(youngs_modulus):
    body = block(youngs_modulus=youngs_modulus)
    quick = Lattice(body, Forces(gravity=(0, 0, 0)), cubes=5)
    quick.advance(FRAME)
    assert np.abs(quick.points - body.points).max() < 1e-9
    assert np.abs(quick.gradients - np.eye(3)).max() < 1e-6


def test_it_falls_turns_and_keeps_its_momentum():
    points = lattice((0.4, 0.4, 0.4), 0.05)
    spin = np.add(np.cross([0, 0, 3.0], points - points.mean(axis=0)), [0.5, 0, 0])
    body = block(velocity=spin)
    quick = Lattice(body, Forces(), cubes=4)
    for _ in range(6):
        quick.advance(FRAME)
    n, t = quick.steps, 6 * FRAME
    moved = quick.points.mean(axis=0) - points.mean(axis=0)
    assert moved == pytest.approx([0.5 * t, 0, -9.81 * t**2 * (n + 1) / (2 * n)], abs=2e-3)
    gradient = quick.gradients.mean(axis=0)
    assert np.degrees(np.arctan2(gradient[1, 0], gradient[0, 0])) == pytest.approx(np.degrees(3 * t), abs=3)


@pytest.mark.parametrize("youngs_modulus", [1e4, 1e6, 2e9])
def test_no_stiffness_and_no_thin_part_makes_energy(youngs_modulus):
    """Ribs that fill cubes in part only, shaken: motion may die away, and nothing turns inside out."""
    points = lattice((1.0, 0.6, 0.3), 0.025)
    points = points[(points[:, 2] < 0.1) | (np.abs(points[:, 0] % 0.34 - 0.17) < 0.04)]
    shake = 0.4 * np.sin(9 * points[:, [1, 2, 0]]) + np.cross([0, 2.0, 1.0], points - points.mean(axis=0))
    quick = Lattice(
        solver_of(points, 0.05, youngs_modulus=youngs_modulus, velocity=shake).body, Forces(gravity=(0, 0, 0))
    )
    mass = 1 / quick._inverse_mass[:, None]
    start = (mass * quick.v**2).sum()
    for _ in range(24):
        quick.advance(FRAME)
    assert 0.1 * start < (mass * quick.v**2).sum() < 1.05 * start
    assert np.linalg.det(quick.gradients.astype(float)).min() > (0.5 if youngs_modulus > 1e5 else 0)


def test_it_is_as_stiff_as_it_should_be():
    """Stretched by its pinned ends it narrows by Poisson's ratio, and bears what Hooke says."""
    points = lattice((2.0, 0.4, 0.4), 0.05)
    ends = (points[:, 0] < 0.15) | (points[:, 0] > 1.85)
    for poisson in (0.0, 0.3):
        body = solver_of(points, 0.1, youngs_modulus=1e5, poisson=poisson, pinned=ends).body
        quick = Lattice(body, Forces(gravity=(0, 0, 0), damping=20.0), cubes=20)
        target = points[ends] * [1.05, 1, 1]
        for _ in range(16):
            quick.advance(FRAME, target)
        middle = np.abs(points[:, 0] - 1) < 0.3
        mean = quick.gradients[middle].astype(float).mean(axis=0)
        assert mean[0, 0] == pytest.approx(1.05, abs=0.01)
        assert mean[1, 1] == pytest.approx(1 - poisson * (mean[0, 0] - 1), abs=0.004)


@pytest.mark.slow
def test_stiffer_beams_droop_less_and_about_as_much_as_they_should():
    droops = {}
    for youngs_modulus in (1e5, 4e5, 1.6e6):
        beam = cantilever(4, youngs_modulus=youngs_modulus)
        quick = Lattice(beam.body, Forces(gravity=(0, 0, -0.1), damping=4.0), cubes=18)
        tip = beam.body.points[:, 0] > 0.97
        for _ in range(50):
            quick.advance(FRAME)
        droops[youngs_modulus] = (beam.body.points - quick.points)[tip, 2].mean()
    assert droops[1e5] > droops[4e5] > droops[1.6e6] > 0
    assert 0.4 < droops[1e5] / timoshenko(100.0, youngs_modulus=1e5) < 1.4


@pytest.mark.parametrize("kind", ["plane", "mesh"])
def test_it_lands_on_what_is_below(kind):
    import trimesh

    slab = trimesh.creation.box((2, 2, 0.4))
    colliders = [Collider("slab", np.asarray(slab.faces), slab.vertices - [0, 0, 0.4])] if kind == "mesh" else []
    planes = [Plane((0, 0, -0.2), (0, 0, 1))] if kind == "plane" else []
    quick = Lattice(block(), Forces(damping=1.0), colliders, planes, cubes=4)
    for _ in range(24):
        quick.advance(FRAME)
    assert -0.23 < quick.points[:, 2].min() < -0.1
    assert np.linalg.det(quick.gradients.astype(float)).mean() > 0.9
    assert np.linalg.norm(np.diff(quick.points, axis=0), axis=1).max() < 0.7  # no particle flew off


def test_friction_holds_on_a_slope_or_does_not():
    gravity = (9.81 * np.sin(0.5), 0, -9.81 * np.cos(0.5))
    moved = {}
    for friction in (0.0, 1.0):
        body = block()
        quick = Lattice(body, Forces(gravity=gravity), (), [Plane((0, 0, 0), (0, 0, 1), "separate", friction)], cubes=4)
        for _ in range(12):
            quick.advance(FRAME)
        moved[friction] = (quick.points - body.points)[:, 0].mean()
    assert moved[0.0] == pytest.approx(0.5 * gravity[0] * 0.25, rel=0.1)
    assert moved[1.0] < 0.2 * moved[0.0]  # it leans, and does not slide


def test_pins_hold_and_lead():
    points = lattice((0.4, 0.4, 0.4), 0.05)
    pinned = points[:, 0] < 0.12
    quick = Lattice(block(pinned=pinned), Forces(), cubes=4)
    for k in range(1, 9):
        quick.advance(FRAME, points[pinned] + [0, 0, 0.02 * k])
    held = points[:, 0] < 0.06
    assert np.abs(quick.points - points - [0, 0, 0.16])[held].max() < 0.01
    assert (quick.points - points)[~pinned, 2].mean() == pytest.approx(0.12, abs=0.08)


@pytest.mark.alone
def test_threads_restoring_and_cancelling_change_no_bit(monkeypatch):
    monkeypatch.setattr(xpbd, "_FEW", 1)  # so small a body would stay on one thread
    threads = get_num_threads()
    planes = [Plane((0, 0, -0.1), (0, 0, 1))]
    whole = Lattice(block(), Forces(), (), planes, cubes=5)
    for _ in range(6):
        whole.advance(FRAME)
    try:
        use_threads(1)
        part = Lattice(block(), Forces(), (), planes, cubes=5)
        for _ in range(3):
            part.advance(FRAME)
        calls = iter([False] * 5 + [True])
        with pytest.raises(Cancelled):
            part.advance(FRAME, cancelled=lambda: next(calls))
        later = Lattice(block(), Forces(), (), planes, cubes=5)
        assert later.restore(3, part.arrays())
        assert not later.restore(3, {"nodes": np.zeros((2, 3))})
        for _ in range(3):
            later.advance(FRAME)
    finally:
        use_threads(threads)
    assert later.points.tobytes() == whole.points.tobytes()


def test_what_begins_a_little_inside_of_the_floor_is_not_thrown(caplog):
    quick = Lattice(block(), Forces(gravity=(0, 0, 0)), (), [Plane((0, 0, 0.06), (0, 0, 1))], cubes=4)
    assert "floor or wall: overlaps the body at the start: 64 of 512 particles" in caplog.text
    for _ in range(6):
        quick.advance(FRAME)
    risen = (quick.points - quick.body.points)[:, 2].mean()
    assert risen < 0.5  # by what it was pressed together; 1.3 if each step took it for a hit
    assert quick.points[:, 2].min() > 0.05


def test_a_body_in_the_floor_is_refused():
    with pytest.raises(UsageError, match="overlaps the body at the start"):
        Lattice(block(), Forces(), (), [Plane((0, 0, 0.2), (0, 0, 1))], cubes=4)


def test_sand_is_refused():
    with pytest.raises(UsageError, match=r"no sand.*Use mpm"):
        Lattice(block("sand"))
