"""Surfels of sand that runs: grains where they are stretched, and nothing new where they are not."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.deform.granular import grainy

N = 4000
SCALE = np.random.default_rng(1).uniform(0.01, 0.03, (N, 2)).astype(np.float32)


def stretched(by: tuple[float, float, float]) -> PosedSurfels:
    """Surfels of a plane that lie in it in any direction, after it was stretched."""
    turn = Rotation.from_rotvec(np.random.default_rng(2).uniform(0, 7, (N, 1)) * [0, 0, 1]).as_matrix()
    u, v = ((turn[:, :, k] * SCALE[:, k : k + 1] * by).astype(np.float32) for k in (0, 1))
    flat, one = np.tile(np.float32([[0, 0, 1]]), (N, 1)), np.ones(N, np.float32)
    return PosedSurfels(flat, u, v, flat, one, np.full((N, 3), 0.4, np.float32), one, one, np.zeros(N, np.int32))


def test_what_is_not_stretched_stays_as_it_is():
    for by in ((1, 1, 1), (0.5, 0.8, 1)):
        rest = stretched(by)
        same = grainy(rest, SCALE, 0.35)
        for name in ("tangent_u", "tangent_v", "albedo"):
            np.testing.assert_array_equal(getattr(same, name), getattr(rest, name))
        np.testing.assert_allclose(same.normal, rest.normal, atol=1e-7)
    larger = grainy(rest, 7 * SCALE, 0.35)  # an object that is scaled is not stretched
    np.testing.assert_array_equal(larger.tangent_u, rest.tangent_u)


def test_what_is_stretched_becomes_round_grains_that_cover_it_alike():
    skin = stretched((4, 1.8, 1))
    grains = grainy(skin, SCALE, 0.35)
    u, v = grains.tangent_u, grains.tangent_v
    np.testing.assert_allclose(np.einsum("nc,nc->n", u, v), 0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1), rtol=1e-5)
    area = np.cross(skin.tangent_u, skin.tangent_v)
    np.testing.assert_allclose(np.cross(u, v), 1.3**2 * area, rtol=1e-4, atol=1e-9)
    slopes = grains.normal[:, :2] / grains.normal[:, 2:]
    assert abs(slopes.std() - 0.35) < 0.01 and abs(slopes.mean()) < 0.02
    assert 0.05 < np.log(grains.albedo[:, 0]).std() < 0.4 and abs(grains.albedo.mean() - 0.4) < 0.02
    assert np.ptp(grains.albedo, axis=1).max() < 1e-6, "its hue stays"
    again = grainy(stretched((4, 1.8, 1)), SCALE, 0.35)
    np.testing.assert_array_equal(again.normal, grains.normal, err_msg="grains do not flicker")
    half = grainy(stretched((1.25, 1.25, 1)), SCALE, 0.35)
    assert 0.3 < np.std(half.normal[:, 0]) / np.std(grains.normal[:, 0]) < 0.7, "it comes gradually"


def test_lines_points_and_hidden_surfels_stay_finite():
    for by in ((5, 0, 0), (0, 0, 0), (1e-20, 1e-20, 1), (1e12, 1e12, 1)):
        found = grainy(stretched(by), SCALE, 0.35)
        assert all(np.isfinite(getattr(found, name)).all() for name in ("tangent_u", "tangent_v", "normal", "albedo"))
