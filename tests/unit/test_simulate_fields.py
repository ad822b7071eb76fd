"""Force fields: each kind against what it is said to do, in both solvers, and from settings."""

from __future__ import annotations

import numpy as np
import pytest
from simulation_cases import lattice, solver_of

from drgs_blender.core.errors import UsageError
from drgs_blender.simulation.fields import FieldRows, ForceField, noise, push_of
from drgs_blender.simulation.settings import parse_settings
from drgs_blender.simulation.solver import Forces
from drgs_blender.simulation.xpbd import Lattice


def still(kind, *, place=(0, 0, 0), axis=(0, 0, 1), strength=1.0, flow=0.0, **more):
    return ForceField(kind, ((*place, *axis, strength, flow),), **more)


def push(field, at):
    return np.array(push_of(FieldRows([field]).at(0, 0.0)[0], *map(float, at)))


def test_a_force_points_away_and_falls_with_distance():
    field = still("force", place=(1, 0, 0), strength=8.0, power=2.0, nearest=1.0, farthest=4.0)
    assert push(field, (1.5, 0, 0)) == pytest.approx([8, 0, 0, 0])
    assert push(field, (1, -2, 0)) == pytest.approx([0, -8 / (1 + 1) ** 2, 0, 0])
    assert push(field, (5.5, 0, 0)) == pytest.approx(0)
    assert push(still("force", strength=-2.0), (0, 0, 3)) == pytest.approx([0, 0, -2, 0])


def test_a_plane_a_side_a_tube_and_a_cone_bound_it():
    plane = still("wind", axis=(0, 0, 2), strength=3.0, shape="plane", power=1.0, side="above")
    assert push(plane, (50, 9, 1)) == pytest.approx([0, 0, 1.5, 0])
    assert push(plane, (0, 0, -0.1)) == pytest.approx(0)
    tube = still("wind", falloff="tube", outer=0.5)
    assert push(tube, (0.4, 0, 9))[2] == pytest.approx(1) and not push(tube, (0.6, 0, 0)).any()
    cone = still("wind", falloff="cone", outer=30.0)
    assert push(cone, (0.5, 0, 1))[2] == pytest.approx(1) and not push(cone, (0.7, 0, 1)).any()


def test_a_vortex_turns_around_its_axis():
    assert push(still("vortex", strength=2.0), (3, 0, 4)) == pytest.approx([0, 10, 0, 0])
    x, y, z, flow = push(still("vortex", strength=2.0, shape="plane"), (3, 0, 4))
    assert (x, y, z, flow) == pytest.approx((-12, 6, 0, 1))


def test_noise_is_smooth_and_fills_its_range():
    rng = np.random.default_rng(0)
    at = rng.uniform(-50, 50, (4000, 3))
    values = np.array([noise(*p, 3) for p in at])
    near = np.array([noise(*p, 3) for p in at + 1e-4])
    assert abs(values.mean()) < 0.03 and 0.2 < values.std() < 0.6 and 0.7 < np.abs(values).max() < 1.6
    assert np.abs(values - near).max() < 2e-3
    assert abs(np.corrcoef(values, [noise(*p, 4) for p in at])[0, 1]) < 0.06


@pytest.mark.parametrize("quick", [False, True])
def test_wind_carries_matter_at_its_speed_and_fields_may_move(quick):
    """Wind of 6 m/s^2 and a flow of 3 1/s blows at 2 m/s; in the second case it turns up after a frame."""
    points = lattice((0.4, 0.4, 0.4), 0.05)

    def made(*fields):
        forces = Forces(gravity=(0, 0, 0), fields=fields)
        solver = solver_of(points, 0.1, youngs_modulus=2e5, high=(4, 4, 4), low=(-1, -1, -1))
        if quick:
            return Lattice(solver.body, forces, cubes=4)
        return type(solver)(solver.body, solver.domain, forces)

    def speed(solver):
        before = solver.points.mean(axis=0)
        solver.advance(0.1)
        return (solver.points.mean(axis=0) - before) / 0.1

    wind = made(still("wind", axis=(1, 0, 0), strength=6.0, flow=3.0))
    for _ in range(3):
        wind.advance(0.1)
    assert speed(wind) == pytest.approx([2 * (1 - np.exp(-3 * 0.35)), 0, 0], abs=0.03)
    rows = tuple((0, 0, 0, 0, 0, 1, strength, 0) for strength in (0.0, 0.0, 5.0))
    late = made(ForceField("wind", rows))
    assert np.abs(speed(late)).max() < 1e-6
    assert speed(late)[2] == pytest.approx(0.5 * 0.1 * 5 / 3, rel=0.1)  # from 0 to 5 in that frame
    speed(late)
    assert speed(late)[2] == pytest.approx((0.5 + 1 + 0.5) * 0.1 * 5, rel=0.05)


def test_settings_of_fields_are_checked_by_name():
    data = {"fields": [{"kind": "wind", "axis": [0, 1, 0], "strength": 4, "flow": 1, "farthest": 3}]}
    (field,) = parse_settings(data).fields
    assert field.frames == ((0, 0, 0, 0, 1, 0, 4, 1),) and field.farthest == 3 and field.nearest == 0
    for wrong, said in (
        ({}, "has no kind"),
        ({"kind": "magnet"}, "kind.*force, wind"),
        ({"kind": "wind", "strength": "much"}, "field.*strength"),
        ({"kind": "wind", "frames": [[1, 2]]}, "rows of 8 numbers"),
        ({"kind": "wind", "speed": 1}, "speed.*is not a setting"),
    ):
        with pytest.raises(UsageError, match=said):
            parse_settings({"fields": [wrong]})
