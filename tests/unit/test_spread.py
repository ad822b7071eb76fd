"""The variance of a pixel, however few samples each of its positions has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_integrate import EMPTY, WHITE, points

from drgs_blender.core.frame import RenderSettings
from drgs_blender.render.integrator.adaptive import part_count, sample_adaptively
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.integrator.variance import variances
from drgs_blender.render.shading_points import Radiance, ShadingPoints


def pixels(count: int, subpixels: int) -> ShadingPoints:
    """`count` pixels of one matte plane, of `subpixels` positions each."""
    some = points(count * subpixels, albedo=0.7, roughness=0.4, weight=np.full(count * subpixels, 1 / subpixels))
    return replace(some, pixel=np.repeat(np.arange(count), subpixels), sample=np.tile(np.arange(subpixels), count))


def moments_of(samples: list[list[float]]) -> np.ndarray:
    """Moments of points with these diffuse samples; twice as much glossy light."""
    rows = [(len(s), sum(s), sum(x * x for x in s)) for s in samples]
    return np.float32([(n, a, b, 2 * a, 4 * b) for n, a, b in rows])


def test_few_samples_are_those_of_the_pixel_and_many_a_points_own() -> None:
    alike, apart = [[3.0], [3.0], [], [3.0, 3.0]], [[1.0, 2.0, 3.0, 4.0], [7.0] * 5]
    mixed, alone = [[2.0], [4.0], [6.0, 8.0]], [[5.0]]
    pixel = np.repeat([4, 7, 8, 9], [4, 2, 3, 1])
    found = variances(pixel, moments_of(alike + apart + mixed + alone))
    spread = np.var([1.0, 2, 3, 4], ddof=1) * 4, 0.0
    whole = np.var([2.0, 4, 6, 8], ddof=1)
    np.testing.assert_allclose(found[:, 0], [0, 0, 0, 0, *spread, whole, whole, 2 * whole, 25], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found[:, 1], 4 * found[:, 0], rtol=1e-5, atol=1e-4)


def test_points_of_a_pixel_may_be_integrated_in_different_calls() -> None:
    some, settings = pixels(30, 16), RenderSettings(subpixel_samples=16, bounces=0)
    whole = integrate(EMPTY, WHITE, some, settings, 0)
    calls = [integrate(EMPTY, WHITE, some[rows], settings, 0) for rows in (slice(0, 101), slice(101, None))]
    together = variances(some.pixel, np.concatenate([found.moments for found in calls]))
    np.testing.assert_array_equal(together, whole.variance)
    assert (np.concatenate([found.variance for found in calls]) != whole.variance).any()


def test_even_light_is_finished_early_at_many_positions() -> None:
    """512 rays at 64 positions come in 32 parts of a quarter of a sample a position."""
    settings = RenderSettings(samples=512, bounces=0, camera_sees="mesh", noise_threshold=0.2)
    parts, some, asked = part_count(settings), pixels(20, settings.subpixel_count), 0

    def trace(chosen: ShadingPoints, part: tuple[int, int]) -> Radiance:
        nonlocal asked
        asked += len(chosen)
        return integrate(EMPTY, WHITE, chosen, settings, 0, part=part)

    found = sample_adaptively(some, settings.sample_count, parts, settings.noise_threshold, trace)
    assert (settings.subpixel_count, parts) == (64, 32)
    assert asked < 0.25 * parts * len(some)
    mean = found.total.reshape(20, 64, 3).mean(axis=1)
    np.testing.assert_allclose(mean, np.broadcast_to(mean.mean(axis=0), mean.shape), rtol=0.3)
