"""What is told of bodies and obstacles that are in each other's way before anything moves."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from simulation_cases import lattice

from drgs_blender.core.errors import UsageError
from drgs_blender.simulation.colliders import Collider, MovingCollider, check_apart
from drgs_blender.simulation.contact import Plane, plane_rows

CELL = 0.1


def slab(low: float, high: float, reach: float = 2.0) -> trimesh.Trimesh:
    """A level plate between two heights, much wider than the body unless `reach` is small."""
    plate = trimesh.creation.box((reach, reach, high - low))
    return plate.apply_translation((0.4, 0.4, (low + high) / 2))


def told(caplog, points: np.ndarray, mesh: trimesh.Trimesh | None, planes: tuple[Plane, ...] = ()) -> str:
    """What is said of a body, filled as simulations fill it, and a collider."""
    caplog.clear()
    colliders = []
    if mesh is not None:
        collider = Collider("thing", np.asarray(mesh.faces), np.asarray(mesh.vertices))
        colliders = [MovingCollider(collider, CELL, points.min(axis=0) - 1, points.max(axis=0) + 1)]
    check_apart(points, CELL, colliders, plane_rows(planes))
    return caplog.text


@pytest.fixture(params=[0.0, 0.25], ids=["in order", "in disorder"])
def body(request) -> np.ndarray:
    """A cube of eight cells a side from the origin on, eight particles a cell."""
    points = lattice((0.8, 0.8, 0.8), CELL / 2)
    return points + np.random.default_rng(0).uniform(-request.param, request.param, points.shape) * CELL / 2


@pytest.mark.parametrize("thickness", [1.0, 0.6, 0.3, 0.01])
@pytest.mark.parametrize("height", [0.4, 0.41, 0.43])
def test_a_plate_thinner_than_a_cell_is_named_wherever_it_passes_through(body, caplog, thickness, height):
    half = thickness * CELL / 2
    for reach in (2.0, 0.4):
        said = told(caplog, body, slab(height - half, height + half, reach))
        assert "thing: passes through the body at the start" in said and "move the two apart" in said
    assert not told(caplog, body, slab(-2 * half - 1e-6, 0.0)), "what lies on it is not divided by it"


def test_what_stands_beside_matter_or_within_its_hollows_is_not_named(body, caplog):
    hollow = body[np.linalg.norm(body[:, :2] - 0.4, axis=1) > 0.15]
    pole = trimesh.creation.cylinder(0.12, 4.0).apply_translation((0.4, 0.4, 0.4))
    assert not told(caplog, hollow, pole)
    room = trimesh.creation.box((1.1, 1.1, 1.1)).apply_translation((0.4, 0.4, 0.4))
    room.invert()
    walls = trimesh.util.concatenate([room, trimesh.creation.box((1.4, 1.4, 1.4)).apply_translation((0.4, 0.4, 0.4))])
    assert not told(caplog, body, walls)


def test_a_quarter_of_a_cell_is_named_and_more_than_a_cell_refused(caplog):
    """Of the particles: a surface sinks in by a quarter of a cell more, which they do not mind."""
    body = lattice((0.8, 0.8, 0.8), CELL / 2)
    for obstacle in ("mesh", "floor"):
        for sunk, named in ((0.3, False), (0.45, False), (0.55, True), (1.2, True)):
            mesh = slab(-1.0, sunk * CELL) if obstacle == "mesh" else None
            planes = (Plane((0, 0, sunk * CELL), (0, 0, 1)),) if obstacle == "floor" else ()
            assert ("overlaps the body at the start" in told(caplog, body, mesh, planes)) == named
        deep = (slab(-1.0, 1.6 * CELL), ()) if obstacle == "mesh" else (None, (Plane((0, 0, 0.16), (0, 0, 1)),))
        with pytest.raises(UsageError, match=r"overlaps the body at the start.*Move one of the two apart"):
            told(caplog, body, *deep)
