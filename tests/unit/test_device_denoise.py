"""SVGF's filter on a device, on Warp's device "cpu": the processor's light."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from test_denoise import H, W, light_of, wall

from drgs_blender.core.errors import Cancelled, DeviceError
from drgs_blender.render.backend import CPU
from drgs_blender.render.denoise.demodulation import CERTAINTY, LIGHT, Signal
from drgs_blender.render.denoise.svgf_spatial import denoise
from drgs_blender.render.denoise.svgf_temporal import NoisyPicture, denoise_next
from drgs_blender.render.film.motion_vectors import Motion
from drgs_blender.render.gpu.denoise import DeviceSignal
from drgs_blender.render.gpu.warp_backend import WarpRenderBackend


def picture() -> tuple:
    """Bent surfaces of three objects with holes between, some light that is no number, fireflies."""
    rng = np.random.default_rng(3)
    x, z = np.meshgrid(np.arange(W) * 1e-3, np.arange(H) * 1e-3)
    normal = np.stack([0.3 * np.sin(200 * x), -np.ones((H, W)), 0.3 * np.cos(150 * z)], -1)
    guides = wall(
        position=np.stack([x, 2e-3 * np.sin(100 * x), z], -1),
        normal=normal / np.linalg.norm(normal, axis=2, keepdims=True),
        albedo=rng.uniform(0.05, 1, (H, W, 3)), roughness=rng.random((H, W)), metallic=rng.random((H, W)),
        object=np.arange(W)[None, :] // 20 + np.zeros((H, 1)),
        coverage=(rng.random((H, W)) < 0.9) * rng.random((H, W)),
    )  # fmt: skip
    guides.coverage[5:8] = 0.0
    components, variance = light_of(1.0 + np.sin(300 * x) ** 2, guides, noise=0.5)
    components[20, 30, 0, 1], components[11, 12] = np.nan, 50.0
    return components, variance, guides


def nothing() -> None:
    """A caller who lets it go on."""


def pictures(count: int) -> list[NoisyPicture]:
    """The same surfaces under light that changes, in a world that turns; the camera moves; some light is no number."""
    components, variance, guides = picture()
    found = []
    for k in range(count):
        rng = np.random.default_rng(k)
        light = (components * rng.uniform(0.7, 1.3, components.shape)).astype(np.float32)
        light[3 + k, 7] = np.nan
        vector = np.full((H, W, 2), (1.3, -0.6), np.float32)
        vector[10, :5] = np.nan
        previous = (guides.position + np.array([1.3e-3, 0, -0.6e-3])).astype(np.float32)
        found.append(NoisyPicture(light, variance, guides, Motion(vector, previous), world_turn=0.1 * k))
    return found


@pytest.mark.parametrize("split", [True, False])
def test_a_device_filters_as_the_processor_does(device: WarpRenderBackend, split: bool) -> None:
    here = denoise(*picture(), split)
    there = device.denoise(*picture(), split, nothing)
    assert np.isfinite(there).all() and np.abs(here - picture()[0])[:3].max() > 0.05
    np.testing.assert_allclose(there, here, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("still", [True, False])
@pytest.mark.parametrize("split", [True, False])
def test_pictures_are_gathered_over_time_as_the_processor_does(
    device: WarpRenderBackend, split: bool, still: bool
) -> None:
    here = there = None
    for k, picture in enumerate(pictures(3)):
        expected, here = denoise_next(picture, here, split, still)
        found, there = device.denoise_next(picture, there, split, still, nothing)
        np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-6)
        alone = denoise(picture.components, picture.variance, picture.guides, split)
        assert (np.abs(expected - alone).max() > 0.05) == (k > 0)
    assert isinstance(there, DeviceSignal)
    kept = [*range(CERTAINTY), *range(LIGHT, here.light.shape[1])]  # the others are made again where they are needed
    np.testing.assert_allclose(there.light.numpy()[:, kept], here.light[:, kept], rtol=2e-4, atol=1e-6)
    np.testing.assert_array_equal(there.guide.numpy(), here.guide)


def test_a_sequence_goes_on_where_the_device_fails_and_where_it_is_back(
    device: WarpRenderBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, third = pictures(3)
    expected = None
    for picture in (first, second, third):
        picture, expected = denoise_next(picture, expected)
    _, history = device.denoise_next(first, None, True, False, nothing)
    with monkeypatch.context() as broken:
        broken.setattr(device.launcher, "launch", failing)
        _, history = device.denoise_next(second, history, True, False, nothing)
        assert "no memory" in device.failed and type(history) is Signal
    device.failed = ""
    found, _ = device.denoise_next(third, history, True, False, nothing)
    np.testing.assert_allclose(found, picture, rtol=2e-4, atol=1e-6)


def test_a_history_that_is_lost_with_its_device_starts_anew(device: WarpRenderBackend) -> None:
    first, second, _ = pictures(3)
    _, history = device.denoise_next(first, None, True, False, nothing)
    history.guide = None
    found, _ = CPU.denoise_next(second, history, True, False, nothing)
    np.testing.assert_array_equal(found, denoise(second.components, second.variance, second.guides))


def failing(*_: object) -> None:
    """A device that has gone."""
    raise DeviceError("device cuda", "has no memory left", "Use the CPU")


def test_nothing_seen_and_a_caller_who_stops(device: WarpRenderBackend) -> None:
    guides = wall(coverage=np.zeros((H, W)))
    assert not device.denoise(*light_of(np.ones((H, W)), guides), guides, True, nothing).any()

    def stop() -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        device.denoise(*picture(), True, stop)
