"""Strands as tubes: how thick they look, where they run, and what is no strand."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.core import strands


def wavy(count: int = 40, points: int = 6, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bent strands in random directions: points, offsets, radii."""
    random = np.random.default_rng(seed)
    steps = random.normal(0, 1, (count, 1, 3)) + 0.5 * random.normal(0, 1, (count, points, 3))
    places = np.cumsum(steps, axis=1) + random.uniform(-5, 5, (count, 1, 3))
    return places.reshape(-1, 3), np.arange(count + 1) * points, random.uniform(0.01, 0.05, count * points)


def corners(made: strands.Tubes) -> np.ndarray:
    """(r, sides, 3) the corners of every ring."""
    return made.vertices.reshape(-1, made.sides, 2, 3)[:, :, 0]


def volume(made: strands.Tubes) -> float:
    a, b, c = made.vertices[made.faces].astype(np.float64).transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("sides", [3, 4, 6])
def test_the_mean_width_from_all_directions_is_the_diameter(sides):
    random = np.random.default_rng(1)
    ends = random.normal(0, 1, (2000, 3))
    ends *= 3 / np.linalg.norm(ends, axis=1, keepdims=True)
    points = np.stack((np.zeros_like(ends), ends), axis=1).reshape(-1, 3)
    made = strands.tubes(points, np.arange(2001) * 2, np.full(4000, 0.1), sides=sides)
    middle = corners(made)[::2]
    view = random.normal(0, 1, (2000, 3))
    across = np.cross(view, ends)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    seen = np.einsum("ksc,kc->ks", middle, across)
    assert np.ptp(seen, axis=1).mean() == pytest.approx(0.2, rel=0.005)


def test_parallel_strands_are_as_thick_together_from_any_side():
    """Were all turned the same way about themselves, a fur would be thin from one side and thick from another."""
    points = np.tile([[0.0, 0, 0], [0, 0, 1]], (500, 1))
    made = strands.tubes(points, np.arange(501) * 2, np.full(1000, 0.1))
    rings = corners(made)[::2]
    for angle in np.linspace(0, np.pi, 7):
        seen = rings @ np.array([np.cos(angle), np.sin(angle), 0])
        assert np.ptp(seen, axis=1).mean() == pytest.approx(0.2, rel=0.02)


def test_strands_run_through_their_points_with_their_radii():
    points, offsets, radii = wavy()
    made = strands.tubes(points, offsets, radii)
    rings = corners(made).mean(axis=1)
    at = np.flatnonzero(made.part == 0)
    np.testing.assert_allclose(rings[at], points[made.point[at]], atol=2e-5)
    wide = np.linalg.norm(corners(made)[at, 0] - points[made.point[at]], axis=1)
    np.testing.assert_allclose(wide, radii[made.point[at]] * np.pi / (2 * np.sqrt(2)), rtol=1e-2)
    assert (np.bincount(made.strand) > strands.SEGMENTS).all()


def test_the_spline_is_that_of_catmull_and_rom():
    """At the middle of four points it is (-1, 9, 9, -1) / 16 of them; of a line it is the line."""
    points = np.array([[0, 0, 0], [1, 2, 0], [3, -1, 1], [4, 0, 5]], float)
    made = strands.tubes(points, np.array([0, 4]), np.full(4, 1e-3))
    rings = corners(made).mean(axis=1)
    (half,) = np.flatnonzero((made.point == 1) & (made.part == 0.5))
    np.testing.assert_allclose(rings[half], np.array([-1, 9, 9, -1]) @ points / 16, atol=1e-6)
    straight = strands.tubes(points, np.array([0, 4]), np.full(4, 1e-3), linear=True)
    np.testing.assert_allclose(corners(straight).mean(axis=1), points, atol=1e-6)


@pytest.mark.parametrize("tip", [0.02, 0.0])
def test_tubes_are_closed_and_face_outwards(tip):
    points, offsets, radii = wavy()
    radii[:], radii[offsets[1:] - 1] = 0.03, tip
    made = strands.tubes(points, offsets, radii)
    one = np.unique(made.vertices, axis=0, return_inverse=True)[1].ravel()  # sides meet in corners, tips in a point
    faces = one[made.faces]
    edges = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    back, counts = edges[:, ::-1], np.unique(edges, axis=0, return_counts=True)[1]
    assert (counts == 1).all() and set(map(tuple, edges)) == set(map(tuple, back))
    a, b, c = made.vertices[made.faces].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    assert (np.linalg.norm(normal, axis=1) > 0).all() and volume(made) > 0
    np.testing.assert_allclose(np.linalg.norm(made.normals, axis=1), 1, atol=1e-5)


def test_sides_are_flat_across_and_smooth_along():
    t = np.linspace(0, 1, 60)
    points = np.column_stack((t, 0.3 * t**2, np.zeros_like(t)))
    made = strands.tubes(points, np.array([0, 60]), np.full(60, 0.01))
    a, b, c = made.vertices[made.faces[:-4]].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shading = made.normals[made.faces[:-4]]
    assert (np.einsum("mkc,mc->mk", shading, normal) > 0.999).all()
    assert np.ptp(shading, axis=1).max() > 1e-4, "along the bend they change"


def test_frames_do_not_twist():
    """Around a bend the tube keeps its section: no turn of its own from ring to ring."""
    t = np.linspace(0, 2 * np.pi, 200)
    points = np.column_stack((np.cos(t), np.sin(t), 0.2 * t))
    made = strands.tubes(points, np.array([0, 200]), np.full(200, 0.01))
    normals = made.normals.reshape(-1, 8, 3)
    assert (np.einsum("rc,rc->r", normals[1:, 0], normals[:-1, 0]) > 0.999).all()


def test_what_is_no_strand_has_no_faces_and_keeps_its_vertices():
    points, offsets, radii = wavy(6)
    whole = strands.tubes(points, offsets, radii)
    points[offsets[1] + 2] = np.nan
    radii[offsets[2]] = np.inf
    points[offsets[3] : offsets[4]] = 1.0
    radii[offsets[4] : offsets[5]] = 0.0
    made = strands.tubes(points, offsets, radii)
    assert made.bad.tolist() == [False, True, True, False, False, False]
    assert set(made.strand[made.ring]) == {0, 5}
    assert len(made.vertices) == len(whole.vertices) and np.isfinite(made.vertices).all()
    np.testing.assert_array_equal(made.vertices[made.strand.repeat(8) == 0], whole.vertices[made.strand.repeat(8) == 0])


@pytest.mark.parametrize("counts", [[], [1], [0, 1, 1], [1, 2, 0, 5, 1]])
def test_empty_and_single_points(counts):
    offsets = np.concatenate(([0], np.cumsum(counts))).astype(int)
    points = np.random.default_rng(0).normal(0, 1, (offsets[-1], 3))
    made = strands.tubes(points, offsets, np.full(offsets[-1], 0.1))
    assert set(made.strand[made.ring].tolist()) == {i for i, n in enumerate(counts) if n > 1}
    assert len(made.faces) == strands.triangle_count(offsets)


def test_points_at_one_place_within_a_strand_change_nothing():
    line = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 1, 1]], float)
    made = strands.tubes(line, np.array([0, 5]), np.full(5, 0.05))
    assert np.isfinite(made.vertices).all() and np.isfinite(made.normals).all() and len(made.faces)


def test_values_of_points_are_blended_on_the_way():
    points, offsets, radii = wavy(3, 4)
    made = strands.tubes(points, offsets, radii)
    whole = np.arange(len(points), dtype=float)[:, None]
    np.testing.assert_allclose(made.blend(whole)[:, 0], made.point + made.part, atol=1e-5)
