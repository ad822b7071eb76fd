"""Samples where the noise is: the samples of a picture in parts, each part only where the last ones were not enough."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...frame import RenderSettings
from ..points import Radiance, ShadingPoints

Array = np.ndarray
#: Light of some points from the i-th of n parts of their samples.
Trace = Callable[[ShadingPoints, tuple[int, int]], Radiance]

_MOST_PARTS = 32
#: Samples of a pixel before its error is believed.
_FEWEST = 16
#: Mean absolute deviation of a normal variable, in standard deviations.
_MEAN_DEVIATION = 0.7979
_CHANNELS = 3.0
_DARK = 1e-4


def part_count(settings: RenderSettings) -> int:
    """In how many equal parts the samples can be drawn; 1 when nothing is gained by it."""
    counts = [n for n in (settings.cosine, settings.ggx, settings.environment) if n]
    if settings.noise_threshold <= 0.0 or not counts or any(n % settings.aa for n in counts):
        return 1
    common = int(np.gcd.reduce([n // settings.aa for n in counts]))
    return min(common & -common, _MOST_PARTS)


def sample_adaptively(points: ShadingPoints, samples: int, parts: int, threshold: float, trace: Trace) -> Radiance:
    """Draw part after part until the error of every pixel is below `threshold`, or all parts are drawn.

    The error is the one Cycles compares with its noise threshold: the expected deviation of a pixel, summed over the
    channels, over the square root of their sum. Each pixel decides for itself, whatever strip or region it lies in, and
    not before it has had `_FEWEST` samples. A pixel whose samples all missed a small bright light stops too early: what
    is so found too rarely is lost, as in every renderer that stops by its own estimate.

    Parameters
    ----------
    points : ordered by pixel
    samples : of a pixel, all parts together
    parts : power of two, see `part_count`
    """
    n = len(points)
    light, variance = np.zeros((n, 4, 3), np.float32), np.zeros((n, 2), np.float32)
    unshadowed = np.zeros(n, np.float32)
    drawn = np.zeros(n, np.int32)
    pixels, first = np.unique(points.pixel, return_index=True)
    of_point = np.repeat(np.arange(len(pixels)), np.diff(first, append=n))
    going = np.arange(n)
    caught = False
    for part in range(parts):
        found = trace(points[going], (part, parts))
        light[going] += found.components
        variance[going] += found.variance
        drawn[going] += 1
        if found.unshadowed is not None:
            unshadowed[going] += found.unshadowed
            caught = True
        if part + 1 == parts:
            break
        if (part + 1) * samples < _FEWEST * parts:
            continue
        share = points.weight / np.maximum(drawn, 1)
        spread = np.bincount(of_point, share**2 * variance.sum(axis=1), len(pixels))
        colour = np.bincount(of_point, share * light.sum(axis=(1, 2)), len(pixels))
        error = _CHANNELS * _MEAN_DEVIATION * np.sqrt(spread) / (_DARK + np.sqrt(colour))
        going = going[error[of_point[going]] >= threshold]
        if not len(going):
            break
    scale = 1.0 / np.maximum(drawn, 1).astype(np.float32)
    return Radiance(
        light * scale[:, None, None], variance * (scale**2)[:, None], unshadowed * scale if caught else None
    )
