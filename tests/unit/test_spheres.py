"""Points as spheres of triangles."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.core.spheres import FINEST, sphere_faces, spheres


@pytest.mark.parametrize("level", range(FINEST + 1))
def test_a_sphere_is_closed_faces_outwards_and_is_as_large_in_the_mean(level: int) -> None:
    """Each edge lies between two faces, once in each direction; the mean shadow is that of the round sphere."""
    made = spheres(np.array([[3.0, -2.0, 1.0]]), np.array([0.5]), level)
    edges = made.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(made.faces) == sphere_faces(level)
    assert {tuple(e) for e in edges.tolist()} == {tuple(e) for e in edges[:, ::-1].tolist()}
    assert len(np.unique(edges, axis=0)) == len(edges)
    corners = made.vertices[made.faces].astype(np.float64) - [3.0, -2.0, 1.0]
    assert (np.linalg.det(corners) > 0).all()
    rng = np.random.default_rng(0)
    shadows = []
    for direction in rng.normal(size=(400, 3)):
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        shadows.append(np.abs(across @ direction).sum() / 2 / np.linalg.norm(direction))
    assert np.mean(shadows) == pytest.approx(np.pi * 0.25, rel=0.01)


def test_rows_of_faces_are_those_of_points_and_what_is_none_has_no_faces() -> None:
    points = np.array([[0, 0, 0], [9, 0, 0], [np.nan, 0, 0], [0, 9, 0], [0, 0, 9]])
    made = spheres(points, np.array([1.0, 0.0, 1.0, -1.0, 2.0]), 1)
    assert np.isfinite(made.vertices).all() and made.bad.tolist() == [False, False, True, False, False]
    np.testing.assert_array_equal(np.unique(made.ring), [0, 4])
    for point, radius in ((0, 1.0), (4, 2.0)):
        near = made.vertices[made.faces[made.ring == point]].reshape(-1, 3) - points[point]
        np.testing.assert_allclose(np.linalg.norm(near, axis=1), radius, rtol=0.05)
    np.testing.assert_array_equal(made.blend(points[:, :2])[[0, 4]], points[[0, 4], :2])


def test_no_points() -> None:
    made = spheres(np.zeros((0, 3)), np.zeros(0))
    assert len(made.faces) == 0 and made.vertices.shape == (0, 3)
