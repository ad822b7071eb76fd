"""What surfels carry so that their blend shows the mesh's materials and normals, and is no blur of them."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

torch = pytest.importorskip("torch")

from capture_cases import balls  # noqa: E402

from drgs_blender.geometry.normals import unit  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.pixels import pixels_of  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.surfel_tomography import blended_as  # noqa: E402
from drgs_blender.reconstruct.model.gaussians import Gaussians  # noqa: E402
from drgs_blender.render.scene.triangle_bvh import TriangleBVH  # noqa: E402

#: Of its balls in `balls`, metres.
RADIUS = 0.7


@pytest.fixture(scope="module")
def views():
    return balls(24, 96).training


@pytest.fixture(scope="module")
def mesh():
    vertices, faces = sphere_mesh(4)
    return plain_mesh((RADIUS * vertices).astype(np.float32), faces)


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    """Discs anywhere on the ball, each over several others."""
    points = unit(np.random.default_rng(0).normal(size=(4000, 3)))
    return Gaussians.on_surface(RADIUS * points, points, np.full(points.shape, 0.5), 0.03)


def striped(points: np.ndarray) -> np.ndarray:
    """Two values of points: stripes a few discs wide, and a slope."""
    return np.stack([0.5 + 0.4 * np.sin(16 * points[:, 2]), 0.5 + 0.3 * points[:, 0]], 1).astype(np.float32)


def lacking(gaussians: Gaussians, columns: np.ndarray, mesh, values: np.ndarray, views) -> float:
    """Root mean square of what the blend of the columns differs from the mesh's values, over the pixels of views."""
    tree = TriangleBVH()
    tree.build(mesh.vertices, mesh.faces)
    squares = []
    for k, view in enumerate(views):
        pixels = pixels_of(k, view, mesh, tree)
        with torch.no_grad():
            drawn = gaussians.render(view.camera, torch.zeros(3), 0, reflections=False, materials=torch.tensor(columns))
        alpha = drawn.maps.alpha.flatten()[pixels.place].numpy()
        shown = drawn.materials.flatten(0, 1)[pixels.place].numpy() / alpha[:, None]
        true = pixels.blended(values)
        squares.append(((shown - true) ** 2)[alpha > 0.5])
    return float(np.sqrt(np.concatenate(squares).mean()))


def test_blends_are_nearer_to_the_mesh(gaussians, mesh, views):
    values, start = striped(mesh.vertices), striped(gaussians.centres().detach().numpy())
    before = lacking(gaussians, start, mesh, values, views)
    found = blended_as(gaussians, np.ones(len(start), bool), start, mesh, values, views)
    assert before > 0.05 and lacking(gaussians, found, mesh, values, views) < 0.9 * before


def test_what_is_the_same_everywhere_stays(gaussians, mesh, views):
    start = np.full((len(gaussians), 1), 0.3, np.float32)
    found = blended_as(gaussians, np.ones(len(start), bool), start, mesh, np.full((len(mesh.vertices), 1), 0.3), views)
    np.testing.assert_allclose(found, start, atol=1e-4)


def test_surfels_that_are_not_drawn_keep_theirs_and_hide_nothing(gaussians, mesh, views):
    values = striped(mesh.vertices)
    start = striped(gaussians.centres().detach().numpy())
    visible = np.arange(len(start)) % 5 > 0
    start[~visible] = 100.0  # would spoil all around them
    found = blended_as(gaussians, visible, start, mesh, values, views)
    np.testing.assert_array_equal(found[~visible], start[~visible])
    kept = gaussians.select(np.flatnonzero(visible))
    before = lacking(kept, start[visible], mesh, values, views)
    assert lacking(kept, found[visible], mesh, values, views) < 0.9 * before


def test_no_round_is_begun_that_time_does_not_allow(gaussians, mesh, views):
    values, start = striped(mesh.vertices), striped(gaussians.centres().detach().numpy())
    told: list[float] = []
    visible = np.ones(len(start), bool)
    found = blended_as(gaussians, visible, start, mesh, values, views, told.append, seconds=1e-6)
    assert len(told) == len(views) and max(told) < 0.25 and not np.array_equal(found, start)
