"""The flicker measure of bench/flicker.py."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.color import linear_to_srgb

N, H, W = 6, 20, 40


@pytest.fixture
def flicker(monkeypatch: pytest.MonkeyPatch) -> Callable[..., float]:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "bench"))
    from flicker import flicker as measure

    return measure


def to_linear(shown: np.ndarray) -> np.ndarray:
    """Inverse of the sRGB curve by table."""
    linear = np.linspace(0, 1, 20001)
    return np.interp(shown, linear_to_srgb(linear), linear)


def grey(shown: np.ndarray) -> np.ndarray:
    return np.repeat(to_linear(np.broadcast_to(shown, (N, H, W)))[..., None], 3, -1)


ALL = np.ones((N, H, W), bool)


def test_steady_change_is_no_flicker(flicker: Callable[..., float]) -> None:
    assert flicker(grey(0.2 + 0.1 * np.arange(N)[:, None, None]), ALL) < 1e-4


def test_noise_counts_in_full(flicker: Callable[..., float]) -> None:
    noise = np.random.default_rng(0).normal(size=(N, H, W)) * 0.02
    expected = 0.02 * np.sqrt(6) * np.sqrt(2 / np.pi)  # of x - 2 y + z
    assert abs(flicker(grey(0.5 + noise), ALL) / expected - 1) < 0.05


def test_texture_that_moves_is_no_flicker_once_it_is_followed(flicker: Callable[..., float]) -> None:
    x = np.arange(W)[None, None, :] - 2.0 * np.arange(N)[:, None, None]
    pictures = grey(0.5 + 0.3 * np.sin(x))
    vectors = np.zeros((N, H, W, 2))
    vectors[..., 0] = -2.0
    assert flicker(pictures, ALL, vectors) < 1e-4 < 0.1 < flicker(pictures, ALL)


def test_only_the_mask_counts(flicker: Callable[..., float]) -> None:
    noise = np.random.default_rng(0).normal(size=(N, H, W)) * 0.02
    mask = ALL.copy()
    mask[:, :, : W // 2] = False
    noise[:, :, W // 2 :] = 0
    assert flicker(grey(0.5 + noise), mask) < 1e-4
    assert flicker(grey(0.5 + noise), ALL & False) == 0.0


def test_blur_in_time_has_no_flicker_but_its_error_has(flicker: Callable[..., float]) -> None:
    there = grey(0.5 + 0.1 * np.cos(np.pi * np.arange(N))[:, None, None])
    blurred = grey(np.full((1, 1, 1), 0.5))
    assert flicker(blurred, ALL) < 1e-4
    assert abs(flicker(blurred, ALL, converged=there) - 0.4) < 1e-3
    assert flicker(there, ALL, converged=there) == 0.0
