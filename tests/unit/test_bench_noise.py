"""The measures of bench/noise.py on curves and pictures whose answer is known."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def noise(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "bench"))
    import noise as module

    return module


def monte_carlo(samples: np.ndarray, rate: float, overhead: float = 0.0) -> tuple[list[float], list[float]]:
    """Seconds and dB of a renderer of so many samples a second whose error falls with the number of samples."""
    return list(overhead + samples / rate), list(20 + 10 * np.log10(samples))


def test_time_of_a_monte_carlo_renderer_is_exact(noise: ModuleType) -> None:
    seconds, decibels = monte_carlo(np.array([4.0, 16, 64, 256]), rate=8)
    for target in (27.0, 30.0, 33.3, 41.0):
        assert noise.time_at(seconds, decibels, target) == pytest.approx(10 ** ((target - 20) / 10) / 8)


def test_time_does_not_depend_on_the_order_of_the_pictures(noise: ModuleType) -> None:
    seconds, decibels = monte_carlo(np.array([64.0, 4, 256, 16]), rate=3)
    assert noise.time_at(seconds, decibels, 33) == pytest.approx(10**1.3 / 3)


def test_measured_points_are_met_exactly(noise: ModuleType) -> None:
    assert [noise.time_at([1, 3, 5], [30, 31, 35], q) for q in (30, 31, 35)] == pytest.approx([1, 3, 5])


def test_no_time_outside_of_what_was_measured(noise: ModuleType) -> None:
    curve = monte_carlo(np.array([4.0, 16]), rate=1)
    assert np.isnan(noise.time_at(*curve, 20 + 10 * np.log10(4) - 0.1))
    assert np.isnan(noise.time_at(*curve, 20 + 10 * np.log10(16) + 0.1))


def test_pictures_without_a_time_do_not_count(noise: ModuleType) -> None:
    assert noise.time_at([np.nan, 2, 8], [28, 30, 34], 32) == pytest.approx(4)
    assert np.isnan(noise.time_at([np.nan, 2, 8], [28, 30, 34], 29))


def test_a_setback_in_quality_takes_the_first_time_the_target_is_reached(noise: ModuleType) -> None:
    assert noise.time_at([1, 2, 4, 8], [30, 34, 33, 36], 34) == pytest.approx(2)


def test_a_picture_that_took_longer_than_a_better_one_does_not_count(noise: ModuleType) -> None:
    # the first was disturbed: a renderer that has 40 dB after one second has 38 dB no later
    assert noise.time_at([1.7, 1.0, 4.0], [36, 40, 44], 42) == pytest.approx(2.0)
    assert np.isnan(noise.time_at([1.7, 1.0, 4.0], [36, 40, 44], 38))


def test_ratio_of_speeds_is_the_ratio_of_times(noise: ModuleType) -> None:
    ours, theirs = monte_carlo(np.array([8.0, 32, 128]), rate=10), monte_carlo(np.array([16.0, 64, 512]), rate=2.5)
    ratios = noise.time_ratios(ours, theirs, (30, 32, 34, 36, 40, 60))
    assert sorted(ratios) == [34, 36, 40]  # they start at 32.04 dB, we end at 41.07
    assert list(ratios.values()) == pytest.approx([4.0] * 3)


def test_relative_error_of_a_scaled_picture(noise: ModuleType) -> None:
    reference = np.full((10, 10, 4), 0.5)
    picture = reference * 1.1
    expected = 0.05**2 / (0.5**2 + noise.EPSILON)
    assert noise.relative_mse(picture, reference, np.ones((10, 10), bool)) == pytest.approx(expected)


def test_trimming_forgives_exactly_the_worst_pixels(noise: ModuleType) -> None:
    reference = np.ones((40, 50, 3))
    picture = reference + 0.1
    picture[3, 4], picture[20, 20] = 1000, 500
    mask = np.ones((40, 50), bool)
    even = 0.1**2 / (1 + noise.EPSILON)
    assert noise.relative_mse(picture, reference, mask, trim=0.001) == pytest.approx(even)
    whole = (1998 * 0.1**2 + 999**2 + 499**2) / 2000 / (1 + noise.EPSILON)
    assert noise.relative_mse(picture, reference, mask) == pytest.approx(whole)


def test_only_the_mask_counts(noise: ModuleType) -> None:
    reference, picture = np.ones((8, 8, 3)), np.ones((8, 8, 3))
    picture[0, 0] = 7
    mask = np.ones((8, 8), bool)
    mask[0, 0] = False
    assert noise.relative_mse(picture, reference, mask) == 0


def series(noise: ModuleType, counts: tuple[int, ...], seconds: list[float], setup: float) -> Any:
    """A renderer's figures, whose relative variance is one over the number of samples."""
    return noise.Series(counts, [noise.Noise(0.0, 1 / n, 1 / n, s) for n, s in zip(counts, seconds)], setup)


def test_samples_are_charged_what_they_took_not_what_one_more_does(noise: ModuleType) -> None:
    """The first samples cost more than later ones: a tenth of a second, then a hundredth each."""
    found = series(noise, (10, 20, 30), [2.0, 2.1, 2.2], 1.0)
    assert found.time_to(1 / 10) == pytest.approx(1.0)
    assert found.time_to(1 / 15) == pytest.approx(1.05)
    assert found.time_to(1 / 5) == pytest.approx(0.5)
    assert found.time_to(1 / 50) == pytest.approx(1.4)


def test_the_setup_is_no_part_of_sampling(noise: ModuleType) -> None:
    quick, slow = (series(noise, (8, 32), [setup + 0.8, setup + 3.2], setup) for setup in (0.1, 7.0))
    assert quick.time_to(1 / 16) == pytest.approx(slow.time_to(1 / 16)) == pytest.approx(1.6)
