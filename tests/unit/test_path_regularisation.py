"""Filter Glossy: behind rough bounces surfaces are rougher, in either kernel, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_paths import FAR, card, picture, seen

from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame import World
from drgs_blender.core.materials import Material
from drgs_blender.render.integrator.bsdf.lobes import AX, AY, DELTA, DIFFUSE, GLASS, KIND, LOBE, METAL
from drgs_blender.render.integrator.path_regularisation import least_alpha, roughen

PAINT, SATIN = Material("paint", (0.5,) * 3, 1.0, 0.0), Material("satin", (0.5,) * 3, 0.5, 0.0)
POLISHED = Material("polished", (0.9,) * 3, 0.1, 1.0)


def low_sun(row: int = 22) -> World:
    """A texel of sun, below the horizon: it reaches what looks up by way of what looks down."""
    sky = np.full((32, 64, 3), 0.05, np.float32)
    sky[row, 40] = 400.0
    return World(sky)


def below_a_mirror(floor: Material, by_paths: bool, seed: int, ceiling: float = 0.1, **settings) -> np.ndarray:
    """The floor, under a metal ceiling beyond the camera; `by_paths` has paths trace it, not batches."""
    above = replace(POLISHED, roughness=ceiling)
    meshes = [card(floor), card(above, 8.0, 20.0), *([FAR] if by_paths else [])]
    return picture(meshes, world=low_sun(), size=8, samples=64, bounces=2, seed=seed, **settings)


def test_alpha_grows_as_the_bounce_spreads():
    found = [least_alpha(np.float32(pdf), np.float32(2.0)) for pdf in (0.0, 0.5, 1.5, 2.0, 90.0)]
    assert found == pytest.approx([0.5, 0.5 * 0.75**0.5, 0.25, 0.0, 0.0])
    assert least_alpha(np.float32(0.0), np.float32(0.0)) == 0.0


def test_lobes_of_microfacets_alone_are_made_rougher():
    lobes = np.zeros((4, LOBE), np.float32)
    lobes[:, KIND] = DIFFUSE, METAL, GLASS, METAL
    lobes[:, AX] = lobes[:, AY] = 0.0, 0.4, 0.0, 0.02
    lobes[2, DELTA] = 1.0
    roughen(lobes.reshape(-1), 3, np.float32(0.25))
    assert lobes[:, AX] == pytest.approx([0.0, 0.4, 0.25, 0.02]) and lobes[:, AX] == pytest.approx(lobes[:, AY])
    assert not lobes[:, DELTA].any()


@pytest.mark.parametrize("by_paths", (False, True))
def test_caustics_are_less_noisy_and_those_of_a_rough_ceiling(by_paths):
    """Paint spreads light so far that any ceiling is as one of alpha .46 to .5."""
    free, filtered = (
        np.stack([below_a_mirror(PAINT, by_paths, seed, filter_glossy=g) for seed in range(8)]) for g in (0.0, 2.0)
    )
    assert free.std(axis=0).mean() > 4 * filtered.std(axis=0).mean()
    rough = [
        np.mean([below_a_mirror(PAINT, by_paths, s, ceiling=alpha**0.5) for s in range(8)]) for alpha in (0.46, 0.5)
    ]
    assert min(rough) * 0.97 < filtered.mean() < max(rough) * 1.03


def test_batches_and_paths_filter_alike_however_samples_are_divided():
    def mean(by_paths: bool, **settings) -> float:
        return float(np.mean([below_a_mirror(SATIN, by_paths, seed, **settings) for seed in range(16)]))

    ways = [mean(False, filter_glossy=1.0, strategy_samples=counts) for counts in (None, (48, 8, 8), (8, 48, 8))]
    assert ways == pytest.approx([mean(True, filter_glossy=1.0)] * 3, rel=0.03)
    assert abs(ways[0] - mean(False)) > 0.05 * ways[0]


@pytest.mark.parametrize("by_paths", (False, True))
def test_the_bounce_that_spread_most_counts_for_the_whole_path(by_paths):
    """Paint, a polished ceiling, polished ground that sees the sun; the ceiling, made rough, is narrower than paint."""
    mirror = Material("mirror", (0.9,) * 3, 0.02, 1.0)
    meshes = [card(PAINT), card(mirror, 8.0, 20.0), card(mirror, -2.0, 20.0), *([FAR] if by_paths else [])]
    free, filtered = (
        np.stack(
            [
                picture(meshes, world=low_sun(9), size=4, samples=64, bounces=3, seed=seed, filter_glossy=g)
                for seed in range(12)
            ]
        )
        for g in (0.0, 0.4)
    )
    assert filtered.std(axis=0).mean() < 0.1 * free.std(axis=0).mean()


@pytest.mark.parametrize("by_paths", (False, True))
def test_direct_light_and_sharp_reflections_stay(by_paths):
    """A ceiling of bands, seen in a polished floor, by whose lobe 3 % of the samples are spread."""
    rows = np.where(np.arange(32) // 2 % 2, 2.0, 0.1)[:, None, None]
    world = World(np.broadcast_to(rows, (32, 64, 3)).astype(np.float32))
    meshes = [card(POLISHED), card(POLISHED, 8.0, 20.0), *([FAR] if by_paths else [])]
    free, filtered = (seen(meshes, ("Combined", "GlossDir"), world, bounces=2, filter_glossy=g) for g in (0.0, 1.0))
    np.testing.assert_array_equal(filtered["GlossDir"], free["GlossDir"])
    assert filtered["Combined"].mean() == pytest.approx(free["Combined"].mean(), rel=0.05)


def test_smooth_glass_behind_paint_is_rough():
    """A sun through a smooth pane is found by chance alone; rough, the pane is a surface that samples of it find."""
    pane = card(Material("pane", (1, 1, 1), 0.0, transmission=1.0), 1.0, 3.0)
    sky = np.full((64, 128, 3), 0.02, np.float32)
    sky[4, 30] = 4000.0
    free, filtered = (
        np.stack([picture([card(PAINT), pane], world=World(sky), size=6, seed=s, filter_glossy=g) for s in range(8)])
        for g in (0.0, 1.0)
    )
    assert free.std() > 2 * filtered.std()


@pytest.mark.parametrize("value", (-1.0, float("nan"), float("inf")))
def test_no_density_is_refused(value):
    with pytest.raises(UsageError, match="Filter Glossy"):
        picture([card(PAINT)], size=4, samples=4, filter_glossy=value)
