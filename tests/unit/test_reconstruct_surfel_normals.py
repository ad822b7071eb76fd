"""Normals of a fused mesh that take in those of its surfels: nearer to the truth, and only where both are alike."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

pytest.importorskip("torch")

from capture_cases import balls

from drgs_blender.geometry.normals import VertexNormals, unit
from drgs_blender.reconstruct.inverse_rendering.run import decouple
from drgs_blender.reconstruct.inverse_rendering.settings import Settings
from drgs_blender.reconstruct.meshing.surfel_normals import with_surfel_normals


@pytest.fixture(scope="module")
def rough():
    """A ball with noise, its true normals and those that it shows."""
    vertices, faces = sphere_mesh(4)
    noise = 0.02 * np.random.default_rng(0).normal(size=(len(vertices), 1))
    mesh = plain_mesh(0.7 * vertices * (1 + noise), faces)
    return mesh, unit(vertices.astype(np.float64)), VertexNormals(faces, len(vertices))(mesh.vertices)


@pytest.fixture(scope="module")
def views():
    return balls(24, 96).training


def off(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def constant(normal: tuple[float, float, float]):
    return lambda view: np.tile(np.float32(normal), (*view.colour.shape[:2], 1))


def test_independent_errors_of_both_are_halved(rough, views):
    """Normals of surfels that lean as much as those of the mesh, each view's another way."""
    mesh, true, own = rough
    rng = np.random.default_rng(1)

    def surfels(view):
        """Those of the ball's point nearest to the pixel's ray, turned."""
        camera = view.camera
        x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in (camera.width, camera.height)))
        local = np.stack([(x - camera.cx) / camera.fx, -(y - camera.cy) / camera.fy, -np.ones_like(x)], -1)
        matrix = np.asarray(camera.matrix_world)
        ray, eye = unit(local @ matrix[:3, :3].T), matrix[:3, 3]
        along = -(ray @ eye)[..., None]
        nearest = eye + along * ray
        inside = np.sqrt(np.maximum(0.49 - (nearest**2).sum(-1, keepdims=True), 0))
        return unit(nearest - inside * ray + 0.7 * np.radians(off(own, true).mean()) * rng.normal(size=ray.shape))

    found = with_surfel_normals(mesh, views, surfels)
    before = off(own, true)
    assert before.mean() > 5 and off(found, true).mean() < 0.7 * before.mean()
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_normals_of_something_else_are_left_out(rough, views):
    mesh, _, own = rough
    found = with_surfel_normals(mesh, views, constant((0, 0, 1)))
    beyond, near = own[:, 2] < 0.45, own[:, 2] > 0.9
    np.testing.assert_allclose(found[beyond], own[beyond], atol=1e-6)
    assert off(found, own)[near & (off(own, (0, 0, 1)) > 1)].min() > 0  # the same, where they are alike


def test_nothing_is_said_of_what_no_view_shows(rough, views):
    mesh, _, own = rough
    np.testing.assert_allclose(with_surfel_normals(mesh, views, constant((0, 0, 0))), own, atol=1e-6)


def test_learning_begins_with_normals_that_are_given(rough):
    mesh, true, own = rough
    still = Settings(iterations=1, pixels=64, cosine=2, ggx=2, light=2, environment=8, coarse=1, normals=False)
    given, alone = (decouple(balls(), mesh, still, start=n).normals for n in (true.astype(np.float32), None))
    assert off(given, true).max() < 0.1 and off(alone, own).max() < 0.1
