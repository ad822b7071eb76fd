"""The order of surfels: any beginning of it stands for all, whatever the surfels are."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.core.asset.model import Surfels
from drgs_blender.core.level_of_detail import Detail, enlarged

COUNT = 20_000


def on_sphere(count: int = COUNT, seed: int = 0, **values: np.ndarray) -> Surfels:
    """Surfels of many sizes and opacities on a sphere, in no order."""
    rng = np.random.default_rng(seed)
    centre = rng.standard_normal((count, 3))
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    given = {
        "centre": centre,
        "scale": 0.02 * rng.lognormal(0, 0.7, (count, 2)),
        "rotation": np.tile([1.0, 0, 0, 0], (count, 1)),
        "opacity": rng.uniform(0.05, 1, count),
        "albedo": rng.uniform(0, 1, (count, 3)),
        "roughness": np.ones(count),
        "metallic": np.zeros(count),
    }
    return Surfels(**given | values)


def weights(surfels: Surfels) -> np.ndarray:
    return surfels.scale.astype(np.float64).prod(axis=1) * surfels.opacity


@pytest.mark.parametrize("count", [256, 1000, 4096, 12_000])
def test_a_beginning_covers_every_part_as_much_as_all(count):
    """By octants of the sphere; what each covers more than all do is the same everywhere."""
    surfels = on_sphere()
    detail, weight = Detail.of(surfels), weights(surfels)
    octant = (surfels.centre > 0) @ [1, 2, 4]
    own = detail.order[:count]
    whole = np.bincount(octant, weight, 8)
    few = np.bincount(octant[own], weight[own] * detail.growth(count), 8)
    assert np.ptp(few / whole) < 0.35 * (few / whole).mean() * np.sqrt(256 / count) + 0.05
    assert (few > whole).all()


def test_what_covers_more_comes_before():
    surfels = on_sphere()
    detail, weight = Detail.of(surfels), weights(surfels)
    few = detail.order[:2000]
    assert np.median(weight[few]) > 2 * np.median(weight)
    surfels.scale[777], surfels.opacity[777] = 0.5, 1.0
    assert 777 in Detail.of(surfels).order[:10]


def test_the_order_is_one_of_all_and_the_same_again():
    surfels = on_sphere()
    detail = Detail.of(surfels)
    assert np.array_equal(np.sort(detail.order), np.arange(COUNT))
    assert np.array_equal(Detail.of(surfels).order, detail.order)
    turned = np.random.default_rng(1).permutation(COUNT)
    names = ("centre", "scale", "rotation", "opacity", "albedo", "roughness", "metallic")
    other = Detail.of(Surfels(**{name: getattr(surfels, name)[turned] for name in names}))
    same = turned[other.order[:5000]] == detail.order[:5000]
    assert same.mean() > 0.99, "it depends on the surfels alone, not on the order in which they came"


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_surfels(count):
    detail = Detail.of(on_sphere(count))
    assert sorted(detail.order) == list(range(count))
    if count:
        assert np.isfinite(detail.growth(1)).all()


@pytest.mark.parametrize("fault", ["places", "sizes", "opacities", "one place", "nothing to see", "far away"])
def test_bad_values_have_an_order_too(fault):
    surfels = on_sphere(3000)
    if fault == "places":
        surfels.centre[::7], surfels.centre[1::7] = np.nan, np.inf
    elif fault == "sizes":
        surfels.scale[::5], surfels.scale[1::5] = np.nan, np.inf
    elif fault == "opacities":
        surfels.opacity[::3] = np.nan
    elif fault == "one place":
        surfels.centre[:] = 1.0
    elif fault == "nothing to see":
        surfels.opacity[:] = 0.0
    else:
        surfels.centre[0] = 3e38
    detail = Detail.of(surfels)
    assert np.array_equal(np.sort(detail.order), np.arange(3000))
    for count in (1, 100, 2999, 3000):
        growth = detail.growth(count)
        assert np.isfinite(growth).all() and (growth >= 1).all()


def test_grown_surfels_cover_what_they_are_to_and_do_not_stick_out():
    rng = np.random.default_rng(3)
    u, v = rng.standard_normal((2, 500, 3)).astype(np.float32)
    v -= u * (np.einsum("ij,ij->i", u, v) / np.einsum("ij,ij->i", u, u))[:, None]
    v *= rng.uniform(0.01, 1, (500, 1)).astype(np.float32)
    growth = rng.uniform(1, 30, 500).astype(np.float32)
    for first, second in ((u, v), (v, u)):
        wide, high = enlarged(first, second, growth)
        area = np.linalg.norm(np.cross(first, second), axis=1)
        np.testing.assert_allclose(np.linalg.norm(np.cross(wide, high), axis=1), growth * area, rtol=1e-3)
        longest = np.maximum(*(np.linalg.norm(t, axis=1) for t in (first, second)))
        after = np.maximum(*(np.linalg.norm(t, axis=1) for t in (wide, high)))
        thin = growth * area < longest**2
        assert thin.any() and not thin.all()
        np.testing.assert_allclose(after[thin], longest[thin], rtol=1e-3)
        np.testing.assert_allclose(after[~thin] ** 2, (growth * area)[~thin], rtol=1e-3)


def test_a_surfel_without_area_stays_finite():
    nothing = np.zeros((1, 3), np.float32)
    for grown in enlarged(nothing, nothing, np.float32([4.0])):
        assert np.isfinite(grown).all()
