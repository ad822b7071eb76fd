"""How far a picture is from converged, and how long a renderer takes to come equally close."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

Array = np.ndarray

#: Added to the squared reference, so that black pixels do not decide.
EPSILON = 1e-2


def relative_mse(picture: Array, reference: Array, mask: Array, trim: float = 0.0) -> float:
    """Relative mean squared error of linear pictures, (x - r)^2 / (r^2 + EPSILON).

    Parameters
    ----------
    picture, reference : (h, w, >=3) linear
    mask : (h, w) bool
    trim : part of the pixels, those with the largest errors, that is left out: 0.001 forgives fireflies
    """
    x, r = (np.asarray(a[mask][:, :3], np.float64) for a in (picture, reference))
    errors = np.sort(((x - r) ** 2 / (r**2 + EPSILON)).mean(axis=1))
    return float(errors[: len(errors) - int(np.floor(trim * len(errors)))].mean())


def time_at(seconds: Sequence[float], decibels: Sequence[float], target: float) -> float:
    """Time at which a renderer reaches `target` dB: log(time) interpolated linearly over dB.

    Parameters
    ----------
    seconds, decibels : of the same pictures; any order; those without seconds (NaN) do not count, nor do those that
        took longer than a better one

    Returns
    -------
    seconds; NaN where the measured pictures do not enclose the target
    """
    t, q = np.asarray(seconds, float), np.asarray(decibels, float)
    best = [i for i in range(len(t)) if np.isfinite(t[i]) and not np.any((t < t[i]) & (q >= q[i]))]
    order = sorted(best, key=lambda i: (t[i], q[i]))
    t, q = np.log(t[order]), q[order]
    for i in range(len(t) - 1):
        if q[i] <= target <= q[i + 1]:
            part = (target - q[i]) / (q[i + 1] - q[i]) if q[i + 1] > q[i] else 0.0
            return float(np.exp(t[i] + part * (t[i + 1] - t[i])))
    return float("nan")


def time_ratios(
    ours: tuple[Sequence[float], Sequence[float]],
    theirs: tuple[Sequence[float], Sequence[float]],
    levels: Iterable[float],
) -> dict[float, float]:
    """Their time over ours at each dB of `levels` that both reach; the curves are (seconds, decibels)."""
    ratios = {level: time_at(*theirs, level) / time_at(*ours, level) for level in levels}
    return {level: ratio for level, ratio in ratios.items() if np.isfinite(ratio)}


@dataclass
class Noise:
    """What pictures of one number of samples are worth: dB, relative errors, and seconds (median)."""

    decibels: float
    untrimmed: float
    trimmed: float
    seconds: float

    @property
    def shown(self) -> float:
        """Mean squared error in sRGB."""
        return float(10 ** (-self.decibels / 10))


@dataclass
class Series:
    """All that was measured of one renderer on one case."""

    counts: tuple[int, ...]
    noise: list[Noise]
    setup: float  # seconds of a picture of hardly any pixels

    def at(self, count: int) -> Noise:
        return self.noise[self.counts.index(count)]

    @property
    def gain(self) -> float:
        """dB by four times the samples, over the whole series."""
        return float(np.polyfit(np.log(self.counts) / np.log(4), [n.decibels for n in self.noise], 1)[0])

    def seconds(self, count: float) -> float:
        """Seconds without the setup of a number of samples, linear between those that were measured.

        A sample costs more where there are few: sub-pixel positions do not grow as fast. So below the least number it
        costs as much as there, and beyond the largest as much as between the last two.
        """
        counts, spent = self.counts, [noise.seconds - self.setup for noise in self.noise]
        if count > counts[-1]:
            return spent[-1] + (spent[-1] - spent[-2]) / (counts[-1] - counts[-2]) * (count - counts[-1])
        return float(np.interp(count, [0, *counts], [0.0, *spent]))

    def time_to(self, error: float, of: str = "untrimmed") -> float:
        """Seconds of sampling alone until that error of `Noise` is `error`: log over log, linear."""
        e = [getattr(n, of) for n in self.noise]
        slope, start = np.polyfit(np.log(e), np.log(self.counts), 1)
        return self.seconds(float(np.exp(start + slope * np.log(error))))
