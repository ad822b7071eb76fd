"""`RenderSettings`: how many samples a pixel has, and where."""

from __future__ import annotations

import numpy as np
import pytest
from test_integrate import EMPTY, WHITE, points

from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame import RenderSettings
from drgs_blender.render.integrator.integrate import integrate


@pytest.mark.parametrize(
    ("settings", "samples"),
    [
        (RenderSettings(), 32),
        (RenderSettings(samples=7), 7),
        (RenderSettings(samples=7, strategy_samples=(16, 8, 8)), 32),
        (RenderSettings(strategy_samples=(0, 0, 3)), 3),
    ],
)
def test_samples_are_one_number_unless_strategies_have_their_own(settings: RenderSettings, samples: int) -> None:
    assert settings.sample_count == samples


@pytest.mark.parametrize("samples", [1, 2, 3, 8, 32, 100, 1024])
@pytest.mark.parametrize("sees", ["surfels", "mesh"])
def test_a_pixel_has_no_more_places_than_samples(samples: int, sees: str) -> None:
    settings = RenderSettings(samples=samples, camera_sees=sees)  # type: ignore[arg-type]
    assert 1 <= settings.subpixel_count <= min(samples, 64)
    assert RenderSettings(samples=samples, subpixel_samples=5).subpixel_count == 5


@pytest.mark.parametrize("sees", ["surfels", "mesh"])
def test_more_samples_never_leave_a_pixel_or_its_places_with_fewer(sees: str) -> None:
    counts = np.arange(1, 600)
    places = np.array([RenderSettings(samples=int(n), camera_sees=sees).subpixel_count for n in counts])  # type: ignore[arg-type]
    assert (np.diff(places) >= 0).all()
    assert (counts[counts >= 16] / places[counts >= 16] >= 2).all()


@pytest.mark.parametrize("samples", [1, 2, 5])
def test_few_samples_find_the_light_of_a_white_environment_in_the_mean(samples: int) -> None:
    """One sample per pixel is one, of whichever strategy: the mean over many pixels is the radiance all the same."""
    settings = RenderSettings(samples=samples, bounces=0, subpixel_samples=1)
    few = integrate(EMPTY, WHITE, points(6000, albedo=0.5, roughness=0.6), settings, 1).total[:, 1]
    many = integrate(EMPTY, WHITE, points(600, albedo=0.5, roughness=0.6), RenderSettings(256, bounces=0), 1).total[
        :, 1
    ]
    assert abs(few.mean() - many.mean()) < 4 * few.std() / np.sqrt(len(few)) + 0.005


def test_samples_below_zero_are_refused() -> None:
    for wrong in (RenderSettings(samples=-1), RenderSettings(strategy_samples=(4, -1, 4))):
        with pytest.raises(UsageError, match="negative"):
            integrate(EMPTY, WHITE, points(2), wrong, 0)
