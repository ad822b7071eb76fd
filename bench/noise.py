"""How far a picture is from converged, and how long a renderer takes to come equally close."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

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
    seconds, decibels : of the same pictures; any order; those without seconds (NaN) do not count

    Returns
    -------
    seconds; NaN where the measured pictures do not enclose the target
    """
    t, q = np.asarray(seconds, float), np.asarray(decibels, float)
    order = np.argsort(t)[: np.isfinite(t).sum()]
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
