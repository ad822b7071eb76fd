"""SVGF's filter on a device, on Warp's device "cpu": the processor's light."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from test_denoise import H, W, light_of, wall

from drgs_blender.errors import Cancelled
from drgs_blender.render.device.on_device import OnDevice
from drgs_blender.render.picture.denoise import denoise


def picture() -> tuple:
    """Bent surfaces of three objects with holes between, some light that is no number, fireflies."""
    rng = np.random.default_rng(3)
    x, z = np.meshgrid(np.arange(W) * 1e-3, np.arange(H) * 1e-3)
    normal = np.stack([0.3 * np.sin(200 * x), -np.ones((H, W)), 0.3 * np.cos(150 * z)], -1)
    guides = wall(
        position=np.stack([x, 2e-3 * np.sin(100 * x), z], -1),
        normal=normal / np.linalg.norm(normal, axis=2, keepdims=True),
        albedo=rng.uniform(0.05, 1, (H, W, 3)), roughness=rng.random((H, W)), metallic=rng.random((H, W)),
        index=np.arange(W)[None, :] // 20 + np.zeros((H, 1)), coverage=(rng.random((H, W)) < 0.9) * rng.random((H, W)),
    )  # fmt: skip
    guides.coverage[5:8] = 0.0
    components, variance = light_of(1.0 + np.sin(300 * x) ** 2, guides, noise=0.5)
    components[20, 30, 0, 1], components[11, 12] = np.nan, 50.0
    return components, variance, guides


@pytest.mark.parametrize("split", [True, False])
def test_a_device_filters_as_the_processor_does(device: OnDevice, split: bool) -> None:
    here = denoise(*picture(), split)
    there = denoise(*picture(), split, by=device.smooth)
    assert np.isfinite(there).all() and np.abs(here - picture()[0])[:3].max() > 0.05
    np.testing.assert_allclose(there, here, rtol=1e-4, atol=1e-6)


def test_nothing_seen_and_a_caller_who_stops(device: OnDevice) -> None:
    guides = wall(coverage=np.zeros((H, W)))
    assert not denoise(*light_of(np.ones((H, W)), guides), guides, by=device.smooth).any()

    def stop() -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        device.smooth(signal(), stop)


def signal():  # type: ignore[no-untyped-def]
    from drgs_blender.render.picture.denoise import demodulate

    return demodulate(*picture())
