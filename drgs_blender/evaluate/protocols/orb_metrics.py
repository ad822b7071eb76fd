"""Metrics of Stanford-ORB: PSNR-H, PSNR-L, SSIM, LPIPS, normals, depth and albedo inside of eroded masks.

After `orb/utils/metrics.py` and `test.py` of the benchmark (Kuang et al. 2023), its peculiarities included: a figure is
never lower than that of grey; squared errors are divided by all pixels, those outside of the mask count as right; LPIPS
is of pictures that are encoded twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion, correlate1d

from ...core.color import srgb_to_linear
from ..metrics import decibels

Array = np.ndarray
Distance = Callable[[Array, Array], float]

#: What PSNR-H is clipped to.
BRIGHTEST = 4.0


@dataclass(frozen=True, slots=True)
class Compared:
    """Scores of two pictures.

    Attributes
    ----------
    figures : dict of str to float or None
        "psnr_h", "psnr_l", "ssim", "flip", "lpips".
    ours, true : (h, w, 3) array
        Encoded, black outside of the mask.
    """

    figures: dict[str, float | None]
    ours: Array
    true: Array


def eroded(mask: Array) -> Array:
    """(h, w) bool mask without its two outermost pixels."""
    return binary_erosion(mask, np.ones((5, 5), bool), border_value=1)


def encoded(linear: Array) -> Array:
    """SRGB encoding, not clipped."""
    return np.where(linear > 0.0031308, np.maximum(linear, 0.0031308) ** (1 / 2.4) * 1.055 - 0.055, 12.92 * linear)


def picture_scores(
    ours: Array, true: Array, mask: Array, scaled: bool, flip: Distance | None, lpips: Distance | None
) -> Compared:
    """Compare two linear pictures, (h, w, 3) and not negative, inside of a (h, w) bool mask; `scaled`: per channel."""
    inside = eroded(mask)[..., None]
    high, low = ours * inside, np.maximum(true, 0) * inside
    psnr_h, _, _ = _psnr(high, low, inside, scaled, BRIGHTEST, encode=False, brighten=True)
    psnr_l, a, b = _psnr(high, low, inside, scaled, 1.0, encode=True, brighten=False)
    a, b = a * inside, b * inside
    figures = {
        "psnr_h": psnr_h,
        "psnr_l": psnr_l,
        "ssim": _ssim(a, b),
        "flip": None if flip is None else flip(a, b),
        "lpips": None if lpips is None else lpips(encoded(a) * inside, encoded(b) * inside),
    }
    return Compared(figures, a, b)


def albedo_psnr(ours: Array, true: Array, mask: Array) -> float:
    """PSNR of linear albedo, scaled by one factor a channel; `ours` is linear, `true` sRGB-encoded."""
    inside = eroded(mask)[..., None]
    return _psnr(ours * inside, srgb_to_linear(true) * inside, inside, True, 1.0, encode=False, brighten=False)[0]


def _psnr(
    ours: Array, true: Array, inside: Array, scaled: bool, brightest: float, encode: bool, brighten: bool
) -> tuple[float, Array, Array]:
    """(dB, ours and the true picture as they were compared)."""
    if brighten and (mean := float(np.clip(true, 0, 1).mean())) > 1e-8:
        factor = float(encoded(np.clip(true, 0, 1)).mean()) / mean
        ours, true = ours * factor, true * factor
    if scaled:
        a, b = ours[inside[..., 0]].astype(np.float64), true[inside[..., 0]].astype(np.float64)
        a = np.where((a**2).sum(axis=0) <= 1e-6, 1.0, a)
        ours = ours * ((a * b).sum(axis=0) / np.maximum((a**2).sum(axis=0), 1e-12))
    ours, true = np.clip(ours, 0, brightest), np.clip(true, 0, brightest)
    if encode:
        ours, true = encoded(ours), encoded(true)
    error, of_grey = float(((ours - true) ** 2).mean()), float(((0.5 * inside - true) ** 2).mean())
    return decibels(min(error, of_grey)), ours, true


def _ssim(ours: Array, true: Array) -> float:
    """Mean over all pixels and channels, with a Gaussian of 1.5 in a window of three pixels, as kornia's."""
    weights = np.exp(-0.5 * (np.arange(-1, 2) / 1.5) ** 2)
    weights /= weights.sum()

    def blurred(image: Array) -> Array:
        return correlate1d(correlate1d(image, weights, axis=0, mode="mirror"), weights, axis=1, mode="mirror")

    a, b = ours.astype(np.float64), true.astype(np.float64)
    mean_a, mean_b = blurred(a), blurred(b)
    variances = blurred(a * a) - mean_a**2 + blurred(b * b) - mean_b**2
    covariance = blurred(a * b) - mean_a * mean_b
    value = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
    value /= (mean_a**2 + mean_b**2 + 1e-4) * (variances + 9e-4)
    return float(1 - 2 * np.clip((1 - value) / 2, 0, 1).mean())


def normal_distance(ours: Array, true: Array, inside: Array) -> float:
    """Mean of 1 - cosine over the pixels inside; one without a normal counts 1."""
    lengths = np.linalg.norm(ours, axis=-1) * np.linalg.norm(true, axis=-1)
    distance = 1 - (ours * true).sum(axis=-1) / np.maximum(lengths, 1e-6)
    return float(np.maximum(distance[inside], 0).mean()) if inside.any() else float("nan")


def depth_error(depths: list[tuple[Array, Array, int]]) -> float | None:
    """Mean squared error of depths with one scale for all views, over all pixels of each.

    Parameters
    ----------
    depths : list of tuple of (array, array, int)
        Of each view: ours and the true depths of the pixels inside (n,), and how many pixels it has.
    """
    if not depths:
        return None
    above = sum(float((ours.astype(np.float64) * true).sum()) for ours, true, _ in depths)
    below = sum(float((ours.astype(np.float64) ** 2).sum()) for ours, _, _ in depths)
    scale = above / max(below, 1e-12)
    return float(np.mean([((scale * ours - true) ** 2).sum() / pixels for ours, true, pixels in depths]))
