"""Spatial SVGF: an edge-stopping a-trous filter on demodulated light, guided by the light's variance.

Schied et al., "Spatiotemporal Variance-Guided Filtering" (2017); its temporal half is in `svgf_temporal`. Diffuse and
glossy light are filtered apart, each divided by the colour of its surface first and multiplied again afterwards, so
that texture is not blurred. Changes and their reasons:

- Light is divided by coverage too, and pixels without coverage take no part: silhouettes do not bleed.
- Depth is compared as distance from the tangent plane, in pixel widths: exact on slanted planes. SVGF's depth gradient
  is wrong at edges.
- Fireflies are clamped first, to mean + `FIREFLY` deviations of their neighbours, only where the pixel's own variance
  does not vouch for them.
- Rough surfaces reflect smoothly: the power on the normals' cosine falls from 128 to 32 with roughness; 32 for diffuse.
- Differences of luminance are compared with the larger deviation of both pixels, so that either takes as much from the
  other as it gives. With the pixel's own, as in the paper, dark pixels (whose estimated variance is small with their
  light) shut out the bright ones that these would average with: a tenth of the light went in glossy scenes.
- Direct and indirect light share one set of weights, so their sum stays the sum to the last bit.
- Edges are stopped by (1 - x / 8)^8 where the paper has exp(-x): much the same, but exactly zero from x = 8 on.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import ROWS, over_range
from ...core.color import LUMINANCE as REC709
from .bands import filter_in_place
from .demodulation import (
    CERTAINTY,
    LEVELS,
    LIGHT,
    LUMINANCE,
    NORMAL,
    PAD,
    POSITION,
    ROUGHNESS,
    SOURCE,
    SURFACE,
    TILE,
    VARIANCE,
    WIDTH,
    Guides,
    Signal,
    demodulate,
    modulate,
)
from .svgf_residual import restore

Array = np.ndarray

#: Luminance differences that count, in deviations of the estimate: at the first level, and their ratio from level to
#: level. The further apart pixels are, the more alike they must be.
SIGMA_LUMINANCE, SIGMA_DECAY = 2.4, 0.8
#: Distances from the tangent plane that count, in pixel widths per pixel of distance on the screen.
SIGMA_PLANE = 1.0
SIGMA_ROUGHNESS = 0.1
#: B-splines: of the paper, and the next narrower one.
TAPS, FEW_TAPS = np.array([1, 4, 6, 4, 1], np.float32) / 16, np.array([1, 2, 1], np.float32) / 4
NORMAL_POWER, ROUGH_NORMAL_POWER = 128.0, 32.0
FIREFLY = 3.0
#: Rows above and below its own among which a firefly is looked for.
_FIREFLIES = 2


def denoise(
    components: Array, variance: Array, guides: Guides, split: bool = True, check: Callable[[], None] = lambda: None
) -> Array:  # fmt: skip
    """Filter the light of a picture.

    Parameters
    ----------
    components : (h, w, 4, 3) float32 array
        Premultiplied light, see `shading_points.Radiance`; non-finite values are replaced.
    variance : (h, w, 2) float32 array
        Of the luminance of the diffuse and the glossy sum.
    guides : Guides
    split : bool
        Keep direct and indirect light apart; else their sum is returned as direct light and indirect is 0 (faster).
    check : callable
        Called between levels; may raise to stop.

    Returns
    -------
    (h, w, 4, 3) float32 array
    """
    return modulate(_smooth_light(components, variance, guides, split, check), guides)


def _smooth_light(
    components: Array, variance: Array, guides: Guides, split: bool, check: Callable[[], None]
) -> Signal:  # fmt: skip
    """All of `denoise` but the last step, before which its arrays are gone."""
    smoothed = smooth(prepare(components, variance, guides, split), check, overwrite=True)
    check()

    def noisy(first: int, last: int) -> Signal:
        """Made once more, as a copy would be as large as the picture of light."""
        low, high = max(first - _FIREFLIES, 0), last + _FIREFLIES
        near = Guides(*(array[low:high] for array in guides))
        signal, rows = prepare(components[low:high], variance[low:high], near, split), slice(first - low, last - low)
        return Signal(signal.guide[rows], signal.light[rows], signal.spans[rows])

    return restore(smoothed, noisy)


def prepare(components: Array, variance: Array, guides: Guides, split: bool = True) -> Signal:
    """Light to be filtered: demodulated, its fireflies clamped; parameters as of `denoise`."""
    signal = demodulate(components, variance, guides, split)
    filter_in_place(_clamp_fireflies, _FIREFLIES, signal)
    return signal


def smooth(
    signal: Signal,
    check: Callable[[], None] = lambda: None,
    *,
    overwrite: bool = False,
    levels: int = LEVELS,
    taps: Array = TAPS,
) -> Signal:
    """The levels of the a-trous filter.

    Parameters
    ----------
    signal : Signal
    check : callable
        As of `denoise`.
    overwrite : bool
        Write over the light of `signal`; else it stays.
    levels : int
        `LEVELS` at most.
    taps : array
        `TAPS` or `FEW_TAPS`, of each level along each axis.
    """
    smoothed = signal if overwrite else Signal(signal.guide, signal.light.copy(), signal.spans)
    light = smoothed.light
    for level in range(levels):
        check()
        over_range(_weigh, len(light), sigma_of(level), signal.guide, signal.spans, light, fewest=ROWS)
        filter_in_place(_a_trous, len(taps) // 2 << level, smoothed, 1 << level, taps)
    return smoothed


def sigma_of(level: int) -> np.float32:
    """`SIGMA_LUMINANCE` of a level."""
    return np.float32(SIGMA_LUMINANCE * SIGMA_DECAY**level)


@njit
def _clamp_fireflies(y0, y1, guide, spans, light, out):  # type: ignore[no-untyped-def]
    """Scale down outliers among 5 x 5 neighbours of the same object; pixels that hold no number stay as they are."""
    h, planes = light.shape[:2]
    zero, one = np.float32(0.0), np.float32(1.0)
    near = np.empty((3, TILE + 4), np.float32)
    own = np.empty((5, TILE), np.float32)
    sums = np.empty((5, TILE), np.float32)
    for y in range(y0, y1):
        for x0 in range(spans[y, 0] + PAD, spans[y, 1] + PAD, TILE):
            n = min(TILE, spans[y, 1] + PAD - x0)
            for i in range(n):
                own[0, i] = guide[y, SURFACE, x0 + i]
                for k in range(5):
                    sums[k, i] = zero
            for k in range(4):
                for i in range(n):
                    own[1 + k, i] = light[y, k, x0 + i]
            for yy in range(max(y - 2, 0), min(y + 3, h)):
                for i in range(n + 4):
                    near[0, i] = guide[yy, SOURCE, x0 - 2 + i]
                for k in range(2):
                    for i in range(n + 4):
                        near[1 + k, i] = light[yy, k, x0 - 2 + i]
                for dx in range(5):
                    if yy == y and dx == 2:
                        continue
                    off = np.uint64(dx)
                    for i in range(np.uint64(n)):
                        j = i + off
                        same = one if near[0, j] == own[0, i] else zero
                        d, g = same * near[1, j], same * near[2, j]
                        sums[0, i] += same
                        sums[1, i] += d
                        sums[2, i] += d * near[1, j]
                        sums[3, i] += g
                        sums[4, i] += g * near[2, j]
            for lobe in range(2):
                for i in range(n):
                    inverse = one / max(sums[0, i], one)
                    mean = sums[1 + 2 * lobe, i] * inverse
                    deviation = np.sqrt(max(sums[2 + 2 * lobe, i] * inverse - mean * mean, zero))
                    limit = mean + np.float32(FIREFLY) * deviation
                    value, spread = own[1 + lobe, i], own[3 + lobe, i]
                    doubtful = spread > (value - mean) * (value - mean) * np.float32(0.0625)
                    scale = limit / value if sums[0, i] >= np.float32(4.0) and value > limit and doubtful else one
                    sums[1 + 2 * lobe, i] = scale
                for i in range(n):
                    scale = sums[1 + 2 * lobe, i]
                    out[y, LUMINANCE + lobe, x0 + i] = own[1 + lobe, i] * scale
                    out[y, VARIANCE + lobe, x0 + i] = own[3 + lobe, i] * scale * scale
                width = (planes - LIGHT) // 2
                for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
                    for i in range(n):
                        out[y, k, x0 + i] = light[y, k, x0 + i] * sums[1 + 2 * lobe, i]


@inlined
def stop(x):  # type: ignore[no-untyped-def]
    """Edge-stopping function: (1 - x / 8)^8 for x in [0, 8], beyond it 0.

    Parameters
    ----------
    x : float32
        Sum of the differences, each in units of those that count.

    Returns
    -------
    float32
        In [0, 1].
    """
    u = max(np.float32(1.0) - np.float32(0.125) * x, np.float32(0.0))
    u *= u
    u *= u
    return u * u


@njit
def _weigh(y0, y1, sigma, guide, spans, light):  # type: ignore[no-untyped-def]
    """Inverse deviations of luminance that edges are compared with, from the variance of 3 x 3 pixels (Gaussian)."""
    h = len(light)
    zero, one, tiny = np.float32(0.0), np.float32(1.0), np.float32(1e-8)
    near = np.empty((3, TILE + 2), np.float32)
    sums = np.empty((3, TILE), np.float32)
    for y in range(y0, y1):
        for x0 in range(spans[y, 0] + PAD, spans[y, 1] + PAD, TILE):
            n = min(TILE, spans[y, 1] + PAD - x0)
            for i in range(n):
                sums[0, i] = sums[1, i] = sums[2, i] = zero
            for yy in range(max(y - 1, 0), min(y + 2, h)):
                for i in range(n + 2):
                    near[0, i] = guide[yy, SOURCE, x0 - 1 + i]
                    near[1, i] = light[yy, VARIANCE, x0 - 1 + i]
                    near[2, i] = light[yy, VARIANCE + 1, x0 - 1 + i]
                for dx in range(3):
                    tap = np.float32((2 - abs(yy - y)) * (2 - abs(dx - 1)))
                    off = np.uint64(dx)
                    for i in range(np.uint64(n)):
                        share = tap if near[0, i + off] == near[0, i + off] else zero
                        sums[0, i] += share
                        sums[1, i] += share * near[1, i + off]
                        sums[2, i] += share * near[2, i + off]
            for k in range(2):
                for i in range(n):
                    inverse = one / max(sums[0, i], one)
                    deviation = sigma * np.sqrt(sums[1 + k, i] * inverse) + tiny
                    # A pixel that holds no number has nothing to compare with.
                    source = guide[y, SOURCE, x0 + i]
                    light[y, CERTAINTY + k, x0 + i] = one / deviation if source == source else zero


@njit
def _a_trous(y0, y1, step, taps, guide, spans, light, out):  # type: ignore[no-untyped-def]
    """One level: B-spline `taps`, 5 or 3 along each axis, `step` pixels apart."""
    h, planes = light.shape[:2]
    radius = len(taps) // 2
    zero, one = np.float32(0.0), np.float32(1.0)
    diffuse_power = np.float32(ROUGH_NORMAL_POWER)
    power_slope = np.float32(ROUGH_NORMAL_POWER - NORMAL_POWER)
    lobe_planes = (planes - LIGHT) // 2
    first_glossy = LIGHT + lobe_planes
    # What is read at a tap (guide, then signal), at the pixel itself, and what is summed.
    near = np.empty((SURFACE + LIGHT + 12, TILE + 2 * PAD), np.float32)
    own = np.empty((SURFACE + 7, TILE), np.float32)
    weight = np.empty((2, TILE), np.float32)
    sums = np.empty((2 + LIGHT + 12, TILE), np.float32)
    for y in range(y0, y1):
        for x0 in range(spans[y, 0] + PAD, spans[y, 1] + PAD, TILE):
            n = min(TILE, spans[y, 1] + PAD - x0)
            for k in range(SURFACE + 2):
                for i in range(n):
                    own[k, i] = guide[y, k, x0 + i]
            for k in range(2):
                for i in range(n):
                    own[SURFACE + 2 + k, i] = light[y, LUMINANCE + k, x0 + i]
                    own[SURFACE + 4 + k, i] = light[y, CERTAINTY + k, x0 + i]
            for i in range(n):
                own[SURFACE + 6, i] = np.float32(NORMAL_POWER) + power_slope * own[ROUGHNESS, i]
            for k in range(2 + planes):
                for i in range(n):
                    sums[k, i] = zero
            for dy in range(len(taps)):
                yy = y + (dy - radius) * step
                if yy < 0 or yy >= h or spans[yy, 0] >= spans[yy, 1]:
                    continue
                start, reach = x0 - radius * step, n + 2 * radius * step
                for k in range(SURFACE):
                    for i in range(reach):
                        near[k, i] = guide[yy, k, start + i]
                for k in range(planes):
                    for i in range(reach):
                        near[SURFACE + k, i] = light[yy, k, start + i]
                for dx in range(len(taps)):
                    kernel = taps[dy] * taps[dx]
                    off = np.uint64(dx * step)
                    far = one / (
                        np.float32(SIGMA_PLANE) * np.float32(max(1, step * max(abs(dy - radius), abs(dx - radius))))
                    )
                    for i in range(np.uint64(n)):
                        j = i + off
                        nx, ny, nz = own[NORMAL, i], own[NORMAL + 1, i], own[NORMAL + 2, i]
                        plane = abs(
                            nx * (near[POSITION, j] - own[POSITION, i])
                            + ny * (near[POSITION + 1, j] - own[POSITION + 1, i])
                            + nz * (near[POSITION + 2, j] - own[POSITION + 2, i])
                        )
                        turn = one - (nx * near[NORMAL, j] + ny * near[NORMAL + 1, j] + nz * near[NORMAL + 2, j])
                        common = plane * own[WIDTH, i] * far
                        rough = abs(near[ROUGHNESS, j] - own[ROUGHNESS, i]) * np.float32(1.0 / SIGMA_ROUGHNESS)
                        sure_d = min(near[SURFACE + CERTAINTY, j], own[SURFACE + 4, i])
                        sure_g = min(near[SURFACE + CERTAINTY + 1, j], own[SURFACE + 5, i])
                        far_d = abs(near[SURFACE + LUMINANCE, j] - own[SURFACE + 2, i]) * sure_d
                        far_g = abs(near[SURFACE + LUMINANCE + 1, j] - own[SURFACE + 3, i]) * sure_g
                        same = kernel if near[SOURCE, j] == own[SURFACE, i] else zero
                        weight[0, i] = same * stop(common + diffuse_power * turn + far_d)
                        weight[1, i] = same * stop(common + own[SURFACE + 6, i] * turn + rough + far_g)
                    for lobe in range(2):
                        for i in range(np.uint64(n)):
                            w = weight[lobe, i]
                            sums[lobe, i] += w
                            sums[2 + VARIANCE + lobe, i] += w * w * near[SURFACE + VARIANCE + lobe, i + off]
                        for k in range(LIGHT + lobe * lobe_planes, LIGHT + (lobe + 1) * lobe_planes):
                            for i in range(np.uint64(n)):
                                sums[2 + k, i] += weight[lobe, i] * near[SURFACE + k, i + off]
            for lobe in range(2):
                for i in range(n):
                    sums[lobe, i] = one / max(sums[lobe, i], np.float32(1e-20))
                    sums[2 + LUMINANCE + lobe, i] = zero
                    out[y, VARIANCE + lobe, x0 + i] = sums[2 + VARIANCE + lobe, i] * sums[lobe, i] * sums[lobe, i]
            for k in range(LIGHT, planes):
                lobe = 1 if k >= first_glossy else 0
                share = share_of((k - LIGHT) % 3)
                for i in range(n):
                    value = sums[2 + k, i] * sums[lobe, i]
                    sums[2 + LUMINANCE + lobe, i] += share * value
                    out[y, k, x0 + i] = value
            for lobe in range(2):
                for i in range(n):
                    out[y, LUMINANCE + lobe, x0 + i] = sums[2 + LUMINANCE + lobe, i]


@inlined
def share_of(k):  # type: ignore[no-untyped-def]
    """Share of a colour channel in luminance, linear Rec.709.

    Parameters
    ----------
    k : int64
        Channel, 0 to 2.

    Returns
    -------
    float32
    """
    return np.float32(REC709[0]) if k == 0 else np.float32(REC709[1]) if k == 1 else np.float32(REC709[2])
