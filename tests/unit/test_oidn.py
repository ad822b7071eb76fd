"""Open Image Denoise as an option: what it gains where it is installed, what is said where it is not."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from drgs_blender.core.errors import DeviceError
from drgs_blender.render.denoise.oidn import available, denoise_oidn
from drgs_blender.render.film.guides import Guides

SIZE = 64


def noisy() -> tuple[np.ndarray, np.ndarray, Guides]:
    """Truth, truth with noise, guides of a painted wall that covers the left three quarters."""
    rng = np.random.default_rng(0)
    x = np.broadcast_to(np.arange(SIZE), (SIZE, SIZE))
    coverage = (x < 48).astype(np.float32)
    albedo = np.repeat((0.2 + 0.6 * (x // 8 % 2))[..., None], 3, 2).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, -1, 0]), (SIZE, SIZE, 3))
    flat = np.zeros((SIZE, SIZE), np.float32)
    truth = np.zeros((SIZE, SIZE, 4, 3), np.float32)
    truth[:, :, 0], truth[:, :, 1] = (albedo * coverage[..., None]), 0.5 * (albedo * coverage[..., None])
    light = truth * (1 + 0.3 * rng.normal(size=(SIZE, SIZE, 4, 1))).astype(np.float32)
    return truth, light, Guides(coverage, np.zeros_like(albedo), normal, albedo, flat, flat, flat, flat + 1)


@pytest.mark.skipif(not available(), reason="the wheel pyoidn is not installed")
def test_noise_goes_and_each_component_stays_itself() -> None:
    truth, light, guides = noisy()
    light[3, 4, 0, 1] = np.nan
    split, whole = denoise_oidn(light, guides), denoise_oidn(light, guides, split=False)
    light[3, 4, 0, 1] = 0
    for k in (0, 1):
        before, after = np.abs(light - truth)[:, :, k].mean(), np.abs(split - truth)[:, :, k].mean()
        assert after < before / 3
    assert np.abs(whole.sum(2) - truth.sum(2)).mean() < np.abs(light.sum(2) - truth.sum(2)).mean() / 3
    assert (whole[:, :, 1:] == 0).all() and np.isfinite(split).all()


@pytest.mark.skipif(not available(), reason="the wheel pyoidn is not installed")
def test_a_texture_of_single_pixels_stays() -> None:
    """Guides are free of noise: what they show is texture, however much it looks like noise."""
    _, _, guides = noisy()
    rng = np.random.default_rng(2)
    guides.albedo[:] = rng.uniform(0.05, 0.9, (SIZE, SIZE, 1))
    truth = (guides.albedo * guides.coverage[..., None])[:, :, None] * np.float32([1, 0, 0, 0])[:, None]
    light = truth * (1 + 0.3 * rng.normal(size=(SIZE, SIZE, 1, 1))).astype(np.float32)
    before, after = (np.abs(a - truth).mean() for a in (light, denoise_oidn(light, guides)))
    assert after < 0.6 * before


@pytest.mark.skipif(not available(), reason="the wheel pyoidn is not installed")
def test_it_gives_the_same_bits_again() -> None:
    _, light, guides = noisy()
    assert (denoise_oidn(light, guides, split=False) == denoise_oidn(light, guides, split=False)).all()


def test_absence_is_an_error_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    _, light, guides = noisy()
    assert not available()
    with pytest.raises(DeviceError, match="pip install pyoidn"):
        denoise_oidn(light, guides)


def test_the_pipeline_says_so_before_it_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    from drgs_blender.core.frame import Camera, Frame, RenderSettings
    from drgs_blender.render.pipeline import render
    from drgs_blender.render.prepared_scene import PreparedScene

    monkeypatch.setitem(sys.modules, "pyoidn", None)
    camera = Camera(np.eye(4), 8, 8, 8.0, 8.0, 4.0, 4.0)
    frame = Frame(1, camera, [], settings=RenderSettings(denoise="oidn"))
    with pytest.raises(DeviceError, match="OIDN"):
        render(PreparedScene(None, None, None), frame)  # type: ignore[arg-type]


@pytest.mark.skipif(not available(), reason="the wheel pyoidn is not installed")
def test_no_light_is_put_where_nothing_is_covered() -> None:
    """It would shine in a transparent film, over whatever is laid behind."""
    _, light, guides = noisy()
    for split in (True, False):
        found = denoise_oidn(light, guides, split)
        assert found[:, 46:48].sum() > 0 and not found[guides.coverage == 0].any()


@pytest.mark.skipif(not available(), reason="the wheel pyoidn is not installed")
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (90, 1), (2, 3), (17, 30), (64, 64)])
def test_even_light_stays_even_up_to_the_borders(shape: tuple[int, int]) -> None:
    grey, flat = np.full((*shape, 3), 0.5, np.float32), np.zeros(shape, np.float32)
    normal = np.broadcast_to(np.float32([0, -1, 0]), (*shape, 3))
    guides = Guides(flat + 1, 0 * grey, normal, grey, flat, flat, flat, flat + 1)
    light = np.full((*shape, 4, 3), 0.25, np.float32)
    np.testing.assert_allclose(denoise_oidn(light, guides), light, rtol=0.01)
