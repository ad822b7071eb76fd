"""Interior particles: of good meshes and of the meshes that people have."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import trimesh

from drgs_blender.core.errors import AssetError, UsageError
from drgs_blender.simulation.fill import fill


def ball(levels: int = 4) -> trimesh.Trimesh:
    """A dented ball."""
    mesh = trimesh.creation.icosphere(levels)
    v = mesh.vertices
    mesh.vertices = v * (1 + 0.15 * np.sin(4 * v[:, [1, 2, 0]]).sum(axis=1, keepdims=True))
    return mesh


def overlap(a, b) -> float:
    """Intersection over union; the points of b are looked up in the cells of a."""
    cell = np.floor((b.points - a.space.origin) / a.space.spacing).astype(int)
    within = ((cell >= 0) & (cell < a.space.part.shape)).all(axis=1)
    both = int((a.space.part[tuple(cell[within].T)] >= 0).sum())
    return both / (len(a.points) + len(b.points) - both)


def damaged(noise: bool) -> tuple[np.ndarray, np.ndarray]:
    """The ball with six holes, and noise on its surface."""
    rng = np.random.default_rng(1)
    mesh = ball(5)
    keep = np.ones(len(mesh.faces), bool)
    for place in mesh.vertices[rng.integers(len(mesh.vertices), size=6)]:
        keep &= np.linalg.norm(mesh.triangles_center - place, axis=1) > 0.2
    vertices = mesh.vertices + noise * 0.01 * rng.normal(size=mesh.vertices.shape)
    return vertices, mesh.faces[keep]


SPACING = 2.6 / 64


@pytest.mark.parametrize("method", ["winding", "parity"])
def test_volume_and_place_of_a_closed_mesh(method):
    mesh = ball()
    filling = fill(mesh.vertices, mesh.faces, SPACING, method=method)
    assert filling.volume.sum() == pytest.approx(mesh.volume, rel=5e-3)
    assert np.abs(filling.points.mean(axis=0) - mesh.center_mass).max() < 0.1 * SPACING
    distance = igl.signed_distance(filling.points, mesh.vertices, np.asarray(mesh.faces))[0]
    assert distance.max() < 1e-3
    assert filling.report["parts"] == 1 and filling.report["bare_vertices"] == 0


@pytest.mark.parametrize("noise", [False, True])
def test_holes_and_noise_hardly_change_the_filling(noise):
    whole = ball(5)
    good = fill(whole.vertices, whole.faces, SPACING)
    bad = fill(*damaged(noise), SPACING)
    assert overlap(good, bad) > 0.95


def test_faces_inside_out_count_as_outwards():
    mesh = ball()
    turned = fill(mesh.vertices, mesh.faces[:, ::-1], SPACING)
    assert np.array_equal(turned.points, fill(mesh.vertices, mesh.faces, SPACING).points)


def test_faces_that_point_anywhere_are_filled_by_parity():
    mesh = ball()
    flip = np.random.default_rng(0).random(len(mesh.faces)) < 0.5
    faces = np.where(flip[:, None], mesh.faces[:, ::-1], mesh.faces)
    mixed = fill(mesh.vertices, faces, SPACING)
    assert mixed.report["method"] == "ray parity"
    assert overlap(mixed, fill(mesh.vertices, mesh.faces, SPACING)) > 0.99


def test_bodies_that_intersect_are_one_and_apart_are_two():
    mesh = ball(3)
    vertices = np.concatenate([mesh.vertices, np.add(mesh.vertices, [1, 0, 0])])
    faces = np.concatenate([mesh.faces, mesh.faces + len(mesh.vertices)])
    together = fill(vertices, faces, 0.08)
    assert together.report["parts"] == 1
    assert mesh.volume * 1.1 < together.volume.sum() < mesh.volume * 1.9
    vertices[len(mesh.vertices) :] += [4, 0, 0]
    apart = fill(vertices, faces, 0.08)
    assert apart.report["parts"] == 2
    assert np.array_equal(apart.part == apart.part[apart.points[:, 0].argmax()], apart.points[:, 0] > 2.5)


@pytest.mark.parametrize("shell", [False, True])
def test_where_bodies_intersect_is_inside_and_a_cavity_is_not(shell):
    outer = trimesh.creation.box((1, 1, 1))
    other = trimesh.creation.box((0.5, 0.5, 0.5)) if shell else trimesh.creation.box((0.4, 0.4, 3))
    faces = other.faces[:, ::-1] if shell else other.faces
    filling = fill(np.concatenate([outer.vertices, other.vertices]), np.concatenate([outer.faces, faces + 8]), 0.05)
    volume = 1 - 0.5**3 if shell else 1 + 2 * 0.4**2
    assert filling.volume.sum() == pytest.approx(volume, rel=0.01)
    assert filling.report["parts"] == 1


def test_debris_is_dropped_and_reported():
    mesh = ball(3)
    crumb = trimesh.creation.icosphere(1, radius=0.06)
    vertices = np.concatenate([mesh.vertices, np.add(crumb.vertices, [3, 0, 0])])
    filling = fill(vertices, np.concatenate([mesh.faces, crumb.faces + len(mesh.vertices)]), 0.06)
    assert filling.report["parts"] == 1 and filling.report["dropped_parts"] == 1
    assert filling.report["bare_vertices"] == len(crumb.vertices)


def test_jitter_moves_particles_within_their_cells():
    mesh = ball(3)
    rows, loose = (fill(mesh.vertices, mesh.faces, 0.08, jitter=j, seed=3) for j in (0.0, 0.8))
    moved = np.abs(loose.points - rows.points)
    assert 0.3 * 0.08 < moved.max() <= 0.4 * 0.08
    assert np.array_equal(loose.points, fill(mesh.vertices, mesh.faces, 0.08, jitter=0.8, seed=3).points)


def test_what_has_no_interior_is_refused_with_a_remedy():
    with pytest.raises(AssetError, match=r"no interior.*Solidify"):
        fill([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], 0.05)
    with pytest.raises(AssetError, match="no faces"):
        fill(np.zeros((3, 3)), np.empty((0, 3), int), 0.05)
    mesh = ball(1)
    with pytest.raises(UsageError, match="Use a spacing of at least"):
        fill(mesh.vertices, mesh.faces, 1e-5)
    with pytest.raises(UsageError, match="positive"):
        fill(mesh.vertices, mesh.faces, float("nan"))
