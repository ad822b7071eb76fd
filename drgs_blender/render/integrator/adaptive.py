"""Adaptive sampling: a frame in parts of equal sample counts; a pixel goes on while its error is too large."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ...core.frame import RenderSettings
from ..shading_points import Radiance, ShadingPoints

Array = np.ndarray
#: Light of some points from the i-th of n parts of their samples.
Trace = Callable[[ShadingPoints, tuple[int, int]], Radiance]

_MOST_PARTS = 32
#: Samples of a pixel before its error estimate is used, and of one that is partly covered.
_FEWEST, _LEAST = 16, 4
#: Mean absolute deviation of a normal variable, in standard deviations.
_MEAN_DEVIATION = 0.7979
_CHANNELS = 3.0
_DARK = 1e-4


def part_count(settings: RenderSettings) -> int:
    """Number of equal parts in which the samples can be drawn; 1 when nothing is gained by it."""
    if settings.noise_threshold <= 0.0:
        return 1
    if settings.strategy_samples is None:
        return min(1 << max(settings.samples // _FEWEST, 1).bit_length() - 1, _MOST_PARTS)
    # Parts do not differ where every count is a multiple of their number.
    common = math.gcd(*settings.strategy_samples)
    return max(1, min(common & -common, _MOST_PARTS))


def sample_adaptively(points: ShadingPoints, samples: int, parts: int, threshold: float, trace: Trace) -> Radiance:
    """Draw part after part until the error of every pixel is below `threshold`, or all parts are drawn.

    Parameters
    ----------
    points : ShadingPoints
        Ordered by pixel.
    samples : int
        Of a pixel, all parts together.
    parts : int
        Power of two, see `part_count`.
    threshold : float
    trace : callable
    """
    found = Sampling(len(points), samples, parts, threshold)
    while len(found.going):
        radiance = trace(points[found.going], (found.part, parts))
        found.add(found.going, radiance)
        found.decide(points.pixel, points.weight, radiance.variance)
    return found.radiance()


class Sampling:
    """Light of points that grows part by part, and which of them need the next one.

    The error is the one Cycles compares with its noise threshold: the expected deviation of a pixel, summed over the
    channels, over the square root of their sum. Each pixel decides for itself, whatever strip or region it lies in, and
    not before it has had `_FEWEST` samples. A pixel whose samples all missed a small bright light stops too early: what
    is so found too rarely is lost, as in every renderer that stops by its own estimate.

    Parameters
    ----------
    count : int
        Points.
    samples, parts : int
        As of `sample_adaptively`.
    threshold : float
        As of `sample_adaptively`.

    Attributes
    ----------
    going : (m,) array
        Indices of the points that need part number ``part``; none when all is done.
    light : (n, 4, 3) array
        Sums over the parts drawn, of which there are ``drawn`` (n,).
    """

    def __init__(self, count: int, samples: int, parts: int, threshold: float) -> None:
        self._samples, self._parts, self._threshold = samples, parts, threshold
        self.part = 0
        self.going = np.arange(count)
        self.light, self.drawn = np.zeros((count, 4, 3), np.float32), np.zeros(count, np.int32)
        self._variance, self._unshadowed = np.zeros((count, 2), np.float32), np.zeros(count, np.float32)
        self._counted, self._caught = np.zeros(count, np.float32), False
        self._groups: Array | None = None
        self._transmitted: Array | None = None

    def add(self, chosen: Array, found: Radiance) -> None:
        """Take the light of this part for `chosen` of the points that need it; each comes once."""
        self.light[chosen] += found.components
        self.drawn[chosen] += 1
        self._counted[chosen] += found.moments[:, 0] if len(found.moments) else np.inf
        if found.groups is not None:
            if self._groups is None:
                self._groups = np.zeros((len(self.drawn), *found.groups.shape[1:]), np.float32)
            self._groups[chosen] += found.groups
        if found.transmitted is not None:
            if self._transmitted is None:
                self._transmitted = np.zeros((len(self.drawn), 2, 3), np.float32)
            self._transmitted[chosen] += found.transmitted
        if found.unshadowed is not None:
            self._unshadowed[chosen] += found.unshadowed
            self._caught = True

    def decide(self, pixel: Array, weight: Array, variance: Array) -> None:
        """End the part, which all points that need it have had.

        Parameters
        ----------
        pixel, weight : (n,) array
            Of all points.
        variance : (m, 2) array
            Of the light that it gave those that needed it.
        """
        self._variance[self.going] += variance
        self.part += 1
        if self.part == self._parts:
            self.going = self.going[:0]
        elif self._threshold > 0.0 and self.part * self._samples >= _FEWEST * self._parts and len(self.going):
            first = np.flatnonzero(np.diff(pixel, prepend=pixel[0] - 1))
            of_point = np.repeat(np.arange(len(first)), np.diff(first, append=len(pixel)))
            share = weight / np.maximum(self.drawn, 1)
            spread = np.bincount(of_point, share**2 * self._variance.sum(axis=1), len(first))
            colour = np.bincount(of_point, share * self.light.sum(axis=(1, 2)), len(first))
            error = _CHANNELS * _MEAN_DEVIATION * np.sqrt(spread) / (_DARK + np.sqrt(colour))
            few = np.bincount(of_point, self._counted, len(first)) < _LEAST
            self.going = self.going[((error >= self._threshold) | few)[of_point[self.going]]]

    def radiance(self) -> Radiance:
        """The mean of the parts drawn."""
        scale = 1.0 / np.maximum(self.drawn, 1).astype(np.float32)
        return Radiance(
            self.light * scale[:, None, None],
            self._variance * (scale**2)[:, None],
            self._unshadowed * scale if self._caught else None,
            groups=None if self._groups is None else self._groups * scale[:, None, None],
            transmitted=None if self._transmitted is None else self._transmitted * scale[:, None, None],
        )
