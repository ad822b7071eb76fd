"""What smoothing took away that is no noise, given back: the best mixture of noisy and smoothed light.

Nothing guides the spatial filter along what a surface reflects. It blurs sharp reflections, and light of a bright,
noisy pixel leaks into dark ones beside it, whose own samples know better: the more samples there are, the more of the
error is this. Of all mixtures n + w (s - n) of the noisy light n and the smoothed s, the one of the least squared error
takes w = E[(n - t)(n - s)] / E[(n - s)^2], t being the true light. The denominator is measured around each pixel. The
numerator is the variance of n less its covariance with s, by the pixel's own weight in the filter; and at most what
n - s has not in common with neighbouring pixels, as noise is independent there, and what leaks or is blurred is often
wider. Where smoothing is right, all of the difference is noise: w is 1. James and Stein ("Estimation with quadratic
loss", 1961) shrink an estimate to a known target alike.

Differences are taken relative to the light, as they are seen beside the light around them, and to the pixel's noise,
so that few pixels do not decide for all. All of these are estimates: above all, the integrator's variance does not know
what stratification gains, so that with hundreds of samples noisy light can still be a little better than the mixture.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import ROWS, over_range
from ...core.memory import sparse_zeros
from ..sampling import ONE, ZERO, F
from .bands import over_rows
from .demodulation import LIGHT, LUMINANCE, PAD, SOURCE, SURFACE, TILE, VARIANCE, Signal

Array = np.ndarray

#: The difference is measured over (2 R + 1)^2 pixels.
MEASURED = 4
#: Rows above and below its own that a pixel depends on: those, one for pairs, one for the light around.
REACH = MEASURED + 2
#: Differences are relative to the light of the pixel, this part of the light around it, and its noise.
AROUND = 0.3
#: Planes of what `_compare` finds, two lobes each: the difference and the variance that smoothing took away, relative.
DIFFERENCE, NOISE, TERMS = 0, 2, 4
#: What is summed around a pixel: pixels and pairs of neighbours; of two lobes squares and products of pairs, and noise.
PIXELS, PAIRS, SQUARES, PRODUCTS, TAKEN, SUMS = 0, 1, 2, 4, 6, 8
#: Rows that are compared at once: their memory is small beside a picture.
_BAND = 32


def restore(smoothed: Signal, noisy: Callable[[int, int], Signal]) -> Signal:
    """Mix noisy light into smoothed light where that lacks more than noise.

    Parameters
    ----------
    smoothed : Signal
        Its light is changed, but for the planes before ``LIGHT``.
    noisy : callable
        Rows from the first to the last + 1 -> the light before it was smoothed, with its guide.

    Returns
    -------
    Signal
        `smoothed`.
    """
    light, spans = smoothed.light, smoothed.spans
    height = len(light)
    for y0 in range(0, height, _BAND):
        y1 = min(y0 + _BAND, height)
        low, high = max(y0 - REACH, 0), min(y1 + REACH, height)
        before = noisy(low, high)
        terms = sparse_zeros((high - low, TERMS, light.shape[2]))
        near = before.guide, spans[low:high], before.light, light[low:high]
        over_range(_compare, high - low, *near, terms, fewest=ROWS)

        over_rows(_mix, y0 - low, y1 - low, *near, terms)
    return smoothed


def rows_of(signal: Signal) -> Callable[[int, int], Signal]:
    """What `restore` takes, of a signal that smoothing has left as it was."""
    return lambda low, high: Signal(signal.guide[low:high], signal.light[low:high], signal.spans[low:high])


@njit
def _compare(y0, y1, guide, spans, light, smoothed, terms):  # type: ignore[no-untyped-def]
    """Terms of each pixel, relative to the light of 3 x 3 of its surface."""
    h = len(light)
    zero, one = np.float32(0.0), np.float32(1.0)
    near = np.empty((3, TILE + 2), np.float32)
    own = np.empty(TILE, np.float32)
    sums = np.empty((3, TILE), np.float32)
    for y in range(y0, y1):
        for x0 in range(spans[y, 0] + PAD, spans[y, 1] + PAD, TILE):
            n = min(TILE, spans[y, 1] + PAD - x0)
            for i in range(n):
                own[i] = guide[y, SURFACE, x0 + i]
            for k in range(3):
                for i in range(n):
                    sums[k, i] = zero
            for yy in range(max(y - 1, 0), min(y + 2, h)):
                for i in range(n + 2):
                    near[0, i] = guide[yy, SOURCE, x0 - 1 + i]
                    near[1, i] = abs(smoothed[yy, LUMINANCE, x0 - 1 + i])
                    near[2, i] = abs(smoothed[yy, LUMINANCE + 1, x0 - 1 + i])
                for dx in range(3):
                    off = np.uint64(dx)
                    for i in range(np.uint64(n)):
                        same = one if near[0, i + off] == own[i] else zero
                        sums[0, i] += same
                        sums[1, i] += same * near[1, i + off]
                        sums[2, i] += same * near[2, i + off]
            for lobe in range(2):
                for i in range(n):
                    x = x0 + i
                    before, after = light[y, LUMINANCE + lobe, x], smoothed[y, LUMINANCE + lobe, x]
                    variance = light[y, VARIANCE + lobe, x]
                    terms[y, DIFFERENCE + lobe, x], terms[y, NOISE + lobe, x] = terms_of(
                        before, after, sums[1 + lobe, i], sums[0, i], variance, smoothed[y, VARIANCE + lobe, x]
                    )


@inlined
def terms_of(before, after, around, count, variance, left):  # type: ignore[no-untyped-def]
    """Terms of a pixel and lobe.

    Parameters
    ----------
    before, after : float32
        Luminance of the noisy and of the smoothed light.
    around : float32
        Sum of that of the smoothed light over some pixels of the surface.
    count : float32
        Number of these pixels.
    variance, left : float32
        Of `before` and of `after`.

    Returns
    -------
    float32
        `DIFFERENCE`, and `NOISE`.
    """
    level = abs(after) + F(AROUND) * around / max(count, ONE) + F(1e-8)
    square = level * level + variance
    # where variances are alike, the sum of squared weights, whose root is no less than the pixel's own weight; beside
    # noisier light it is more, and 1 at most
    weights = min(left / max(variance, F(1e-30)), ONE)
    return (before - after) / F(math.sqrt(square)), variance * (ONE - F(math.sqrt(weights))) / square


@inlined
def noisy_share(squares, products, taken, pixels, pairs):  # type: ignore[no-untyped-def]
    """Share of the noisy light in the mixture, by the sums around a pixel of one lobe.

    Parameters
    ----------
    squares, products, taken, pixels, pairs : float32
        See `SQUARES`.

    Returns
    -------
    float32
        1 - w, in [0, 1].
    """
    # of noise, neighbours have nothing in common
    common = products * (pixels / max(pairs, ONE))
    noise = max(min(squares - common, taken), ZERO)
    return ONE - noise / squares if noise < squares else ZERO


@njit
def _mix(y0, y1, guide, spans, light, smoothed, terms):  # type: ignore[no-untyped-def]
    """Mix the light of each pixel, by the terms around it."""
    h, planes = light.shape[:2]
    zero, one = np.float32(0.0), np.float32(1.0)
    width = (planes - LIGHT) // 2
    near = np.empty((1 + SUMS, TILE + 2 * MEASURED), np.float32)
    own = np.empty(TILE, np.float32)
    sums = np.empty((SUMS, TILE), np.float32)
    for y in range(y0, y1):
        for x0 in range(spans[y, 0] + PAD, spans[y, 1] + PAD, TILE):
            n = min(TILE, spans[y, 1] + PAD - x0)
            for i in range(n):
                own[i] = guide[y, SURFACE, x0 + i]
            for k in range(SUMS):
                for i in range(n):
                    sums[k, i] = zero
            start, reach = x0 - MEASURED, n + 2 * MEASURED
            for yy in range(max(y - MEASURED, 0), min(y + MEASURED + 1, h)):
                below, beneath = min(yy + 1, h - 1), one if yy + 1 < h else zero
                for i in range(reach):
                    x = start + i
                    source = guide[yy, SOURCE, x]
                    right = one if source == guide[yy, SOURCE, x + 1] else zero
                    down = beneath if source == guide[below, SOURCE, x] else zero
                    near[SUMS, i] = source
                    near[PIXELS, i] = one
                    near[PAIRS, i] = right + down
                    for lobe in range(2):
                        difference = terms[yy, DIFFERENCE + lobe, x]
                        others = right * terms[yy, DIFFERENCE + lobe, x + 1]
                        others += down * terms[below, DIFFERENCE + lobe, x]
                        near[SQUARES + lobe, i] = difference * difference
                        near[PRODUCTS + lobe, i] = difference * others
                        near[TAKEN + lobe, i] = terms[yy, NOISE + lobe, x]
                for dx in range(2 * MEASURED + 1):
                    off = np.uint64(dx)
                    for i in range(np.uint64(n)):
                        same = one if near[SUMS, i + off] == own[i] else zero
                        for k in range(SUMS):
                            sums[k, i] += same * near[k, i + off]
            for lobe in range(2):
                for i in range(n):
                    share = noisy_share(
                        sums[SQUARES + lobe, i],
                        sums[PRODUCTS + lobe, i],
                        sums[TAKEN + lobe, i],
                        sums[PIXELS, i],
                        sums[PAIRS, i],
                    )
                    # a pixel without a number has nothing to give
                    usable = guide[y, SOURCE, x0 + i] == own[i]
                    sums[SQUARES + lobe, i] = share if usable else zero
                for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
                    for i in range(n):
                        after = smoothed[y, k, x0 + i]
                        smoothed[y, k, x0 + i] = after + sums[SQUARES + lobe, i] * (light[y, k, x0 + i] - after)
