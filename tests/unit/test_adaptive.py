"""Adaptive sampling: parts that add up to the whole, samples only where the noise is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drgs_blender.core.frame import RenderSettings, World
from drgs_blender.render.integrator.adaptive import part_count, sample_adaptively
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.scene.trace_scene import TraceScene
from drgs_blender.render.shading_points import Radiance, ShadingPoints

WIDTH = 40


def row_of_points(count: int, subpixels: int = 1) -> ShadingPoints:
    """Points of one row of pixels on a matte plane, `subpixels` to a pixel."""
    n = count * subpixels
    up, view = np.tile(np.float32([0, 0, 1]), (n, 1)), np.tile(np.float32([0.6, 0, 0.8]), (n, 1))
    pixel, sample = np.repeat(np.arange(count), subpixels), np.tile(np.arange(subpixels), count)
    return ShadingPoints(
        pixel, sample, np.full(n, 1 / subpixels), np.zeros((n, 3)), up, up, view, np.full((n, 3), 0.7), np.full(n, 0.4),
        np.zeros(n),
    )  # fmt: skip


def lively_light() -> EnvironmentLight:
    return EnvironmentLight(World(np.random.default_rng(3).random((8, 16, 3)).astype(np.float32) ** 4))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 1),  # no threshold
        ({"noise_threshold": 0.1}, 2),  # parts of 16 rays
        ({"noise_threshold": 0.1, "samples": 19}, 1),
        ({"noise_threshold": 0.1, "strategy_samples": (16, 8, 8)}, 8),
        ({"noise_threshold": 0.1, "strategy_samples": (3, 8, 8)}, 1),  # no common divisor
        ({"noise_threshold": 0.1, "samples": 8192}, 32),
    ],
)
def test_the_samples_are_divided_into_equal_parts(changes: dict, expected: int) -> None:
    assert part_count(replace(RenderSettings(), **changes)) == expected


def test_the_mean_of_all_parts_is_the_whole() -> None:
    """A part draws the very samples that the whole draws, so that nothing is lost by stopping late."""
    points, light, scene = row_of_points(12, subpixels=2), lively_light(), TraceScene()
    settings = RenderSettings(samples=32, bounces=0, subpixel_samples=2)
    whole = integrate(scene, light, points, settings, 5)
    parts = [integrate(scene, light, points, settings, 5, part=(i, 4)) for i in range(4)]
    mean = np.mean([p.components for p in parts], axis=0)
    np.testing.assert_allclose(mean, whole.components, rtol=1e-4, atol=1e-6)
    assert np.abs(parts[0].components - whole.components).max() > 1e-3  # the parts differ, so they are parts


def fake(deviation: np.ndarray, drawn: np.ndarray, value: float = 1.0):
    """A tracer of grey light whose parts have the given deviation at each pixel; counts what it is asked for."""

    def trace(points: ShadingPoints, part: tuple[int, int]) -> Radiance:
        n = len(points)
        drawn[points.pixel] += 1
        light = np.zeros((n, 4, 3), np.float32)
        light[:, 0] = value
        variance = np.zeros((n, 2), np.float32)
        variance[:, 0] = deviation[points.pixel] ** 2
        return Radiance(light, variance)

    return trace


def test_quiet_pixels_stop_and_noisy_ones_go_on() -> None:
    deviation, drawn = np.zeros(20, np.float32), np.zeros(20, int)
    deviation[10] = 100.0
    sample_adaptively(row_of_points(20), 128, 8, 0.05, fake(deviation, drawn))
    assert drawn[10] == 8
    assert (np.delete(drawn, 10) == 1).all()


def test_black_pixels_stop_and_nothing_is_divided_by_their_light() -> None:
    drawn = np.zeros(4, int)
    with np.errstate(all="raise"):
        sample_adaptively(row_of_points(4), 128, 8, 0.05, fake(np.zeros(4, np.float32), drawn, 0.0))
    assert (drawn == 1).all()


def test_nobody_stops_before_the_sixteenth_sample() -> None:
    drawn = np.zeros(3, int)
    sample_adaptively(row_of_points(3), 32, 16, 0.05, fake(np.zeros(3, np.float32), drawn))
    assert (drawn == 8).all()  # parts of two samples


def test_a_pixel_stops_as_soon_as_its_error_is_small_enough() -> None:
    """The deviation of a mean of n parts falls as 1 / sqrt(n): the threshold is met at a part that can be told."""
    threshold, sigma = 0.1, 0.2
    # 3 * 0.7979 * sigma / sqrt(n) / sqrt(3) < threshold
    needed = int(np.ceil((3 * 0.7979 * sigma / np.sqrt(3) / threshold) ** 2))
    drawn = np.zeros(5, int)
    result = sample_adaptively(row_of_points(5), 512, 32, threshold, fake(np.full(5, sigma, np.float32), drawn))
    assert (drawn == needed).all()
    np.testing.assert_allclose(result.total, 1.0)
    np.testing.assert_allclose(result.variance[:, 0], sigma**2 / needed, rtol=1e-5)


def test_a_lower_threshold_gives_a_smaller_error() -> None:
    points, light, scene = row_of_points(WIDTH), lively_light(), TraceScene()
    settings = RenderSettings(samples=512, bounces=0, subpixel_samples=1)
    truth = integrate(scene, light, points, replace(settings, samples=16384), 1).total
    errors, samples = [], []
    for threshold in (0.4, 0.02):
        asked = 0

        def trace(some: ShadingPoints, part: tuple[int, int]) -> Radiance:
            nonlocal asked
            asked += len(some)
            return integrate(scene, light, some, settings, 0, part=part)

        found = sample_adaptively(points, settings.sample_count, 32, threshold, trace)
        errors.append(float(np.sqrt(np.mean((found.total - truth) ** 2))))
        samples.append(asked)
    assert samples[1] > 2 * samples[0]
    assert errors[1] < 0.7 * errors[0]
