"""SVGF gives back what it took away that is no noise."""

from __future__ import annotations

import numpy as np
import pytest
from test_denoise import H, W, light_of, wall

from drgs_blender.render.denoise import svgf_residual, svgf_spatial
from drgs_blender.render.denoise.demodulation import LIGHT, PAD, VARIANCE, Signal, demodulate
from drgs_blender.render.denoise.svgf_residual import restore, rows_of
from drgs_blender.render.denoise.svgf_spatial import denoise

INSIDE = np.s_[6:-6, 6:-6]


def filter_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """From here on, nothing is given back."""
    monkeypatch.setattr(svgf_spatial, "restore", lambda smoothed, noisy: smoothed)


def reflected() -> np.ndarray:
    """Light of a scene that a surface mirrors: spots of 2 pixels, of which no guide knows."""
    coarse = np.random.default_rng(5).random((H // 2, W // 2))
    return 1.0 + 0.5 * (np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1) - 0.5)


def error(found: np.ndarray, true: np.ndarray) -> float:
    """Root mean square, relative to the light."""
    lit = found.sum(axis=2)[..., 0] / true.sum(axis=2)[..., 0] - 1
    return float(np.sqrt(np.mean(lit[INSIDE] ** 2)))


def stripes(noise: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Light of what a surface mirrors, 6 pixels wide, and its relative noise."""
    bright = np.broadcast_to(np.arange(W) // 6 % 3 == 0, (H, W))
    return np.where(bright, 3.0, 0.1), np.where(bright, noise, 0.1)


COLUMNS = np.broadcast_to(np.arange(W) % 2, (H, W))


def mixture(bias: np.ndarray, noise: float, told: float = 1.0, own: float = 0.0, **guide: np.ndarray) -> np.ndarray:
    """Relative error of the mixture of noisy light, and of light that was smoothed: `own` of it the noisy light, the
    rest without noise but with a bias (h, w). The variance is `told` times too large.
    """
    guides = wall(**guide)
    noisy = demodulate(*light_of(np.ones((H, W)), guides, noise, seed=3), guides)
    smoothed = demodulate(*light_of(1 + bias, guides), guides)
    true = demodulate(*light_of(np.ones((H, W)), guides), guides)
    noisy.light[:, VARIANCE : VARIANCE + 2] *= told
    smoothed.light[:] = own * noisy.light + (1 - own) * smoothed.light
    smoothed.light[:, VARIANCE : VARIANCE + 2] = own**2 * noisy.light[:, VARIANCE : VARIANCE + 2]
    lit = restore(smoothed, rows_of(noisy)).light / np.maximum(true.light, 1e-9) - 1
    return lit[:, LIGHT, PAD:-PAD][INSIDE]


@pytest.mark.parametrize("sharp", [False, True], ids=["wide", "sharp"])
@pytest.mark.parametrize("own", [0.0, 0.4, 0.8])
@pytest.mark.parametrize("bias", [0.0, 0.05, 0.1, 0.2, 0.4])
def test_the_mixture_has_the_least_error_there_is(bias: float, own: float, sharp: bool) -> None:
    """Of noise v and a bias b, independent of each other: (1 - w)^2 v + w^2 b^2, w at most that of smoothed light."""
    noise = 0.1
    pattern = np.sign(np.sin(np.arange(W) / 5.0))[None] * np.sign(np.cos(np.arange(H) / 5.0))[:, None]
    if sharp:
        pattern = np.random.default_rng(6).choice((-1.0, 1.0), (H, W))
    found = np.mean(mixture(bias * pattern, noise, own=own) ** 2)
    weight = min(noise**2 / (noise**2 + bias**2), 1 - own)
    best = (1 - weight) ** 2 * noise**2 + weight**2 * bias**2
    assert found <= 1.15 * best + 0.05 * noise**2


@pytest.mark.parametrize("guide", [{}, {"object": COLUMNS}], ids=["", "thin"])
def test_a_variance_that_is_too_large_costs_little_where_the_bias_is_wide(guide: dict[str, np.ndarray]) -> None:
    """What does not change from pixel to pixel is no noise, whatever the variance says."""
    pattern = 0.2 * np.sign(np.sin(np.arange(W) / 5.0))[None] * np.ones((H, 1))
    told, more = (np.mean(mixture(pattern, 0.1, times, **guide) ** 2) for times in (1.0, 4.0))
    assert more < 1.5 * told


@pytest.mark.parametrize(("noise", "part"), [(0.2, 0.6), (0.4, 0.5)])
def test_bright_light_does_not_leak_into_dark(noise: float, part: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stripes of what a surface mirrors, 6 pixels wide: a pixel that is sure of its light keeps it."""
    guides, (light, noisy) = wall(roughness=np.full((H, W), 0.1)), stripes(noise)
    true, _ = light_of(light, guides)
    picture, variance = light_of(light, guides, noisy, seed=1)
    found = error(denoise(picture, variance, guides), true)
    assert found < error(picture, true) or noise > 0.2
    filter_alone(monkeypatch)
    assert found < part * error(denoise(picture, variance, guides), true)


def test_even_light_stays_smooth(monkeypatch: pytest.MonkeyPatch) -> None:
    guides = wall()
    true, _ = light_of(np.ones((H, W)), guides)
    picture, variance = light_of(np.ones((H, W)), guides, 0.3, seed=2)
    found = error(denoise(picture, variance, guides), true)
    filter_alone(monkeypatch)
    assert found < 1.15 * error(denoise(picture, variance, guides), true)


def test_bands_do_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    guides = wall()
    picture, variance = light_of(reflected(), guides, 0.1)
    whole = denoise(picture, variance, guides)
    monkeypatch.setattr(svgf_residual, "_BAND", 7)
    np.testing.assert_array_equal(denoise(picture, variance, guides), whole)


def test_a_pixel_without_a_number_stays_smoothed(monkeypatch: pytest.MonkeyPatch) -> None:
    guides = wall()
    light, noise = stripes()
    picture, variance = light_of(light, guides, noise)
    holes = [20, 20], [21, 25]
    picture[holes] = np.nan
    found = denoise(picture, variance, guides)[holes]
    filter_alone(monkeypatch)
    np.testing.assert_array_equal(found, denoise(picture, variance, guides)[holes])


def test_diffuse_and_glossy_light_do_not_know_of_each_other() -> None:
    guides = wall()
    light, noise = stripes()
    even, striped = light_of(np.ones((H, W)), guides, 0.1), light_of(light, guides, noise)
    picture, variance = even[0].copy(), even[1].copy()
    picture[:, :, 2:], variance[..., 1] = striped[0][:, :, 2:], striped[1][..., 1]
    for lobe, alone in enumerate((even, striped)):
        part = np.s_[:, :, 2 * lobe : 2 * lobe + 2]
        np.testing.assert_array_equal(denoise(picture, variance, guides)[part], denoise(*alone, guides)[part])


@pytest.mark.parametrize("way", ["lattice", "leaves"])
def test_pixels_without_neighbours_stay_smooth(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of leaves, and of what is seen through a fence."""
    seen = np.zeros((H, W), bool)
    if way == "lattice":
        seen[::2, ::2] = True
    else:
        seen = np.random.default_rng(4).random((H, W)) < 0.1
    guides = wall(coverage=seen.astype(float))
    true, _ = light_of(np.ones((H, W)), guides)
    picture, variance = light_of(np.ones((H, W)), guides, 0.3, seed=2)

    def missed() -> float:
        return float(np.sqrt(np.mean((denoise(picture, variance, guides)[seen] / true[seen].clip(1e-9) - 1) ** 2)))

    found = missed()
    filter_alone(monkeypatch)
    assert found < 1.1 * missed()


def test_objects_do_not_know_of_each_other() -> None:
    """What was blurred on one leaves no noise on its neighbour."""
    halves = np.zeros((H, W))
    halves[:, W // 2 :] = 1
    guides = wall(object=halves)
    noisy = demodulate(*light_of(np.ones((H, W)), guides, 0.1), guides)
    even = demodulate(*light_of(np.ones((H, W)), guides), guides).light
    blurred = even.copy()
    blurred[:, :, PAD + W // 2 :] *= 1.5
    found = [restore(Signal(noisy.guide, light, noisy.spans), rows_of(noisy)).light for light in (even, blurred)]
    np.testing.assert_array_equal(found[0][:, :, : PAD + W // 2], found[1][:, :, : PAD + W // 2])
    there = np.s_[:, LIGHT, PAD + W // 2 : -PAD]
    assert np.mean(found[1][there]) < 1.1 * np.mean(noisy.light[there])
