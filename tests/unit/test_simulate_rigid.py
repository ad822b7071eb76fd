"""The body that never bends, against mechanics."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from simulation_cases import lattice, solver_of

from drgs_blender.core.errors import Cancelled, UsageError
from drgs_blender.simulation.colliders import Collider
from drgs_blender.simulation.contact import Plane
from drgs_blender.simulation.fields import ForceField
from drgs_blender.simulation.rigid import Rigid
from drgs_blender.simulation.solver import Forces

FRAME = 1 / 24
GRAVITY = (0.0, 0.0, -9.81)
FLOOR = Plane((0, 0, 0), (0, 0, 1))


def block(size=(0.4, 0.4, 0.4), turn=(0, 0, 0), lift=0.0, **more):
    points = lattice(size, 0.05) - np.multiply(size, 0.5)
    points = points @ Rotation.from_rotvec(turn).as_matrix().T + [0, 0, lift]
    return solver_of(points, 0.1, **more).body


def moved(rigid: Rigid) -> np.ndarray:
    return rigid.points - rigid.body.points


def test_it_falls_and_keeps_its_shape():
    rigid = Rigid(block(), Forces(gravity=GRAVITY))
    rigid.advance(0.5)
    n = rigid.steps
    assert np.abs(moved(rigid) - [0, 0, -9.81 * 0.25 * (n + 1) / (2 * n)]).max() < 1e-9
    assert np.abs(rigid.gradients - np.eye(3)).max() < 1e-7


def test_it_tumbles_and_keeps_its_momenta():
    """About the axis between the largest and the smallest moment, where turning is not stable."""
    points = lattice((0.6, 0.4, 0.2), 0.05) - [0.3, 0.2, 0.1]
    body = solver_of(points, 0.1, velocity=np.add(np.cross([0.02, 6.0, 0.01], points), [0.3, 0, 0])).body
    rigid = Rigid(body, Forces(gravity=(0, 0, 0)))
    momentum = rigid.turn @ rigid._inertia @ rigid.spin
    turned = 0.0
    for _ in range(72):
        rigid.advance(FRAME)
        turned = max(turned, np.degrees(np.arccos(np.clip(rigid.turn[1, 1], -1, 1))))
    assert turned > 90, "it flips over"
    assert np.abs(rigid.turn @ rigid._inertia @ rigid.turn.T @ rigid.spin - momentum).max() < 1e-9
    assert np.abs(moved(rigid).mean(axis=0) - [0.9, 0, 0]).max() < 1e-9
    distance = np.linalg.norm(rigid.points[::7, None] - rigid.points[None, ::7], axis=2)
    assert np.abs(distance - np.linalg.norm(points[::7, None] - points[None, ::7], axis=2)).max() < 1e-9


@pytest.mark.parametrize("friction", [0.2, 1.0])
def test_coulomb_friction_on_a_slope(friction):
    slope = np.radians(30)
    gravity = tuple(9.81 * np.array([np.sin(slope), 0, -np.cos(slope)]))
    body = block((0.4, 0.4, 0.2), lift=0.1)
    rigid = Rigid(body, Forces(gravity=gravity), (), [Plane((0, 0, 0), (0, 0, 1), friction=friction)])
    for _ in range(12):
        rigid.advance(FRAME)
    expected = 0.5 * max(0.0, 9.81 * (np.sin(slope) - friction * np.cos(slope))) * 0.25
    assert moved(rigid)[:, 0].mean() == pytest.approx(expected, rel=0.02, abs=2e-3)
    assert np.abs(moved(rigid)[:, 2]).max() < 0.01


@pytest.mark.parametrize("obstacle", ["plane", "mesh"])
def test_a_block_that_falls_on_its_edge_comes_to_rest_on_a_side(obstacle):
    slab = trimesh.creation.box((4, 4, 0.5))
    slab.apply_translation([0, 0, -0.25])
    meshes = [Collider("slab", np.asarray(slab.faces), slab.vertices)] if obstacle == "mesh" else []
    rigid = Rigid(block(turn=(0.4, 0.3, 0), lift=0.6), Forces(gravity=GRAVITY), meshes, [] if meshes else [FLOOR])
    lowest = 1.0
    for _ in range(72):
        rigid.advance(FRAME)
        lowest = min(lowest, rigid.points[:, 2].min())
    assert lowest > -0.01, "a ball of 0.025 around each particle"
    assert rigid.place[2] == pytest.approx(0.2, abs=0.01)
    assert np.linalg.norm(rigid.motion) < 0.02 and np.linalg.norm(rigid.spin) < 0.1
    upright = np.abs(Rotation.from_matrix(rigid.turn).as_matrix() @ Rotation.from_rotvec([0.4, 0.3, 0]).as_matrix())[2]
    assert upright.max() > 0.999


def test_what_is_under_it_carries_it_and_what_hits_it_moves_it():
    table = trimesh.creation.box((2, 2, 0.4))
    table.apply_translation([0, 0, -0.4])
    frames = np.arange(13)
    lift = Collider("lift", np.asarray(table.faces), table.vertices + frames[:, None, None] * [0.02, 0, 0.03])
    rigid = Rigid(block(), Forces(gravity=GRAVITY), [lift])
    for _ in range(12):
        rigid.advance(FRAME)
    assert moved(rigid)[:, 2].mean() == pytest.approx(0.36, abs=0.03)
    assert moved(rigid)[:, 0].mean() == pytest.approx(0.24, abs=0.05)
    bat = trimesh.creation.box((0.4, 1, 1))
    bat.apply_translation([-0.6, 0, 0])
    fast = Collider("bat", np.asarray(bat.faces), bat.vertices + np.array([0, 2.0])[:, None, None] * [1, 0, 0])
    hit = Rigid(block(), Forces(gravity=(0, 0, 0)), [fast])
    hit.advance(FRAME)
    assert hit.points[:, 0].min() > 1.6 - 0.05, "it has not passed through"


def test_sticky_holds_and_slip_slides():
    for contact, x in (("sticky", 0.0), ("slip", 0.5 * 2.0 * 0.25), ("separate", 0.5 * 2.0 * 0.25)):
        plane = Plane((0, 0, -0.2), (0, 0, 1), contact, 0.0)
        rigid = Rigid(block(), Forces(gravity=(2.0, 0, 1.0)), (), [plane])
        for _ in range(12):
            rigid.advance(FRAME)
        assert moved(rigid)[:, 0].mean() == pytest.approx(x, abs=0.01)
        assert moved(rigid)[:, 2].mean() == pytest.approx(0.125 if contact == "separate" else 0.0, abs=0.01)


def test_forces_and_pins_lead_it():
    wind = ForceField("wind", frames=((0, 0, 0, 1, 0, 0, 4.0, 0.0),))
    rigid = Rigid(block(), Forces(gravity=(0, 0, 0), fields=(wind,)))
    rigid.advance(0.5)
    assert moved(rigid)[:, 0] == pytest.approx(0.5, rel=0.01)
    points = block().points
    held = points[:, 0] < 0
    led = Rigid(block(pinned=held), Forces(gravity=GRAVITY))
    led.advance(FRAME)
    assert np.abs(moved(led)).max() == 0
    turn = Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix()
    led.advance(FRAME, points[held] @ turn.T + [1, 2, 3])
    assert np.abs(led.points - points @ turn.T - [1, 2, 3]).max() < 1e-9
    assert np.abs(led.gradients - turn).max() < 1e-6


def test_restoring_and_cancelling_change_no_bit():
    def fresh():
        return Rigid(block(turn=(0.4, 0.3, 0), lift=0.4), Forces(gravity=GRAVITY), (), [FLOOR])

    whole, part = fresh(), fresh()
    for _ in range(8):
        whole.advance(FRAME)
    for _ in range(4):
        part.advance(FRAME)
    calls = iter([False] * 5 + [True])
    with pytest.raises(Cancelled):
        part.advance(FRAME, cancelled=lambda: next(calls))
    later = fresh()
    assert later.restore(4, part.arrays())
    for _ in range(4):
        later.advance(FRAME)
    assert later.points.tobytes() == whole.points.tobytes()


def test_what_cannot_go_well_is_said():
    with pytest.raises(UsageError, match="overlaps the body at the start"):
        Rigid(block(), Forces(), (), [Plane((0, 0, 0.1), (0, 0, 1))])
    with pytest.raises(UsageError, match=r"frame 1: moves at 1e\+07 m/s.*Slow it down"):
        Rigid(block(velocity=(1e7, 0, 0)), Forces()).advance(FRAME)
