"""The exact surfel update, against its definition and against the paper's rule."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drgs_blender.deform.surfel_update import paper_update, surfel_update
from drgs_blender.geometry.normals import quaternions, rotation_matrices

IDENTITY = np.eye(3)[None]


def random_surfels(n: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(n, random_state=rng).as_matrix().astype(np.float32)
    return rotation, rng.uniform(0.2, 2, (n, 2)).astype(np.float32), rng


def covariance(rotation, scale):
    tangents = rotation[..., :2].astype(float) * scale[..., None, :]
    return tangents @ tangents.swapaxes(-1, -2)


def test_covariance_and_normal_are_exact_on_random_gradients():
    rotation, scale, rng = random_surfels(20_000)
    gradient = rng.normal(size=(len(scale), 3, 3)).astype(np.float32)
    new_rotation, new_scale = surfel_update(gradient, rotation, scale)
    assert new_rotation.dtype == new_scale.dtype == np.float32
    wide = gradient.astype(float)
    expected = wide @ covariance(rotation, scale) @ wide.swapaxes(-1, -2)
    error = np.linalg.norm(covariance(new_rotation, new_scale) - expected, axis=(1, 2))
    assert (error / np.linalg.norm(expected, axis=(1, 2))).max() < 1e-5
    image = wide @ (rotation[..., :2] * scale[:, None, :])
    slant = np.einsum("ni,nij->nj", new_rotation[..., 2], image)
    assert (np.abs(slant).max(1) / np.linalg.norm(image, axis=(1, 2))).max() < 1e-5
    np.testing.assert_allclose(
        new_rotation.swapaxes(1, 2) @ new_rotation, np.tile(np.eye(3), (20_000, 1, 1)), atol=1e-5
    )
    assert (np.linalg.det(new_rotation) > 0).all()


@pytest.mark.parametrize(
    ("stretch", "exact", "paper_descending", "paper_ascending"),
    [
        ((2, 1, 1), (2, 1), (1, 2), (1, 1)),
        ((1, 1, 3), (1, 1), (1, 3), (1, 1)),
        ((0.5, 0.5, 2), (0.5, 0.5), (0.5, 2), (0.5, 0.5)),
    ],
)
def test_stretches_and_what_the_paper_makes_of_them(stretch, exact, paper_descending, paper_ascending):
    gradient, scale = np.diag(np.float64(stretch))[None], np.ones((1, 2))
    rotation, new_scale = surfel_update(gradient, IDENTITY, scale)
    np.testing.assert_allclose(new_scale[0], exact, atol=1e-12)
    np.testing.assert_allclose(rotation, IDENTITY, atol=1e-12)
    np.testing.assert_allclose(paper_update(gradient, IDENTITY, scale)[1][0], paper_descending, atol=1e-12)
    np.testing.assert_allclose(
        paper_update(gradient, IDENTITY, scale, descending=False)[1][0], paper_ascending, atol=1e-12
    )


def test_shear_along_the_surface_does_not_tilt_the_normal_but_does_in_the_paper():
    gradient = np.array([[[1.0, 0, 1], [0, 1, 0], [0, 0, 1]]])
    exact, _ = surfel_update(gradient, IDENTITY, np.ones((1, 2)))
    paper, _ = paper_update(gradient, IDENTITY, np.ones((1, 2)))
    np.testing.assert_allclose(exact[0, :, 2], [0, 0, 1], atol=1e-12)
    assert np.degrees(np.arccos(paper[0, 2, 2])) == pytest.approx(26.565, abs=1e-3)


def test_rigid_motion_moves_the_frame_and_keeps_the_scale():
    rotation, scale, rng = random_surfels(1000)
    scale[:, 1] *= 0.1
    motion = Rotation.random(1000, random_state=rng).as_matrix().astype(np.float32)
    new_rotation, new_scale = surfel_update(motion, rotation, scale)
    np.testing.assert_allclose(new_rotation, motion @ rotation, atol=2e-6)
    np.testing.assert_allclose(new_scale, scale, rtol=2e-6)


def test_frame_does_not_swap_when_the_order_of_the_scales_does():
    angles = np.linspace(0, 0.4, 200)
    squeeze = np.array([np.diag([1 + 0.5 * np.sin(9 * a), 1 - 0.5 * np.sin(9 * a), 1.0]) for a in angles])
    rotation, _ = surfel_update(squeeze, np.tile(IDENTITY, (200, 1, 1)), np.tile([[1.0, 0.9]], (200, 1)))
    np.testing.assert_allclose(rotation, np.tile(IDENTITY, (200, 1, 1)), atol=1e-12)


def test_mirror_keeps_the_normal_on_the_side_of_the_matter():
    rotation, scale, rng = random_surfels(500)
    mirror = (np.diag([-1.0, 1, 1]) @ Rotation.random(500, random_state=rng).as_matrix()).astype(np.float32)
    new_rotation, _ = surfel_update(mirror, rotation, scale)
    expected = np.einsum("nij,nj->ni", mirror, rotation[..., 2])  # a mirror is its own inverse transpose
    np.testing.assert_allclose(new_rotation[..., 2], expected, atol=2e-6)
    assert (np.linalg.det(new_rotation) > 0).all()


@pytest.mark.parametrize("stretch", [(0, 1, 1), (0, 0, 1), (1, 0, 0), (0, 0, 0), (1, 1, 0)])
def test_collapse_stays_finite_and_orthonormal(stretch):
    rotation, scale, _ = random_surfels(200)
    new_rotation, new_scale = surfel_update(np.tile(np.diag(np.float32(stretch)), (200, 1, 1)), rotation, scale)
    assert np.isfinite(new_scale).all()
    np.testing.assert_allclose(new_rotation.swapaxes(1, 2) @ new_rotation, np.tile(np.eye(3), (200, 1, 1)), atol=1e-4)


def test_paper_rule_is_exact_for_rotation_times_scale_only():
    rotation, scale, rng = random_surfels(300)
    similar = 1.7 * Rotation.random(300, random_state=rng).as_matrix()
    exact, paper = surfel_update(similar, rotation, scale), paper_update(similar, rotation, scale)
    np.testing.assert_allclose(covariance(*paper), covariance(*exact), atol=1e-5)
    general = rng.normal(size=(300, 3, 3))
    exact = covariance(*surfel_update(general, rotation, scale))
    error = np.linalg.norm(covariance(*paper_update(general, rotation, scale)) - exact, axis=(1, 2))
    assert np.median(error / np.linalg.norm(exact, axis=(1, 2))) > 0.4


def test_quaternions_round_trip():
    matrices = Rotation.random(1000, random_state=1).as_matrix()
    matrices[:3] = [np.diag([1, -1, -1]), np.diag([-1, 1, -1]), np.diag([-1, -1, 1])]  # half turns: w = 0
    np.testing.assert_allclose(rotation_matrices(quaternions(matrices)), matrices, atol=1e-12)
