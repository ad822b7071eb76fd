"""Spatial SVGF: an edge-stopping a-trous filter on demodulated light, guided by the light's variance.

Schied et al., "Spatiotemporal Variance-Guided Filtering" (2017); its temporal half is in `temporal`. Diffuse and glossy
light are filtered apart, each divided by the colour of its surface first and multiplied again afterwards, so that
texture is not blurred. Changes and their reasons:

- Light is divided by coverage too, and pixels without coverage take no part: silhouettes do not bleed.
- Depth is compared as distance from the tangent plane, in pixel widths: exact on slanted planes, no depth gradient that
  breaks at edges.
- Fireflies are clamped first, to mean + `FIREFLY` deviations of their neighbours, only where the pixel's own variance
  does not vouch for them.
- Rough surfaces reflect smoothly: the power on the normals' cosine falls from 128 to 32 with roughness; 32 for diffuse.
- Differences of luminance are compared with the larger deviation of both pixels, so that either takes as much from the
  other as it gives. With the pixel's own, as in the paper, dark pixels (whose estimated variance is small with their
  light) shut out the bright ones that these would average with: a tenth of the light went in glossy scenes.
- Direct and indirect light share one set of weights, so their sum stays the sum to the last bit.
- Edges are stopped by (1 - x / 8)^8 where the paper has exp(-x): much the same, but exactly zero from x = 8 on.

Pictures are planar here, (rows, planes, columns), with `PAD` empty columns on either side: kernels work on runs of
`TILE` pixels, plane by plane, with scratch arrays whose strides the compiler knows, so that all of it is SIMD.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...colour import LUMINANCE as REC709
from ...jit import njit, prange
from ..sampling import luminance
from .rows import over_rows

Array = np.ndarray

LEVELS = 5
#: Luminance differences that count, in deviations of the estimate: at the first level, and their ratio from level to
#: level. The further apart pixels are, the more alike they must be.
SIGMA_LUMINANCE, SIGMA_DECAY = 2.4, 0.8
#: Distances from the tangent plane that count, in pixel widths per pixel of distance on the screen.
SIGMA_PLANE = 1.0
SIGMA_ROUGHNESS = 0.1
NORMAL_POWER, ROUGH_NORMAL_POWER = 128.0, 32.0
FIREFLY = 3.0
#: Surface colours below this are not divided out, they would amplify noise.
COLOUR_FLOOR = 0.02
DIELECTRIC_F0 = 0.04

#: Pixels a kernel works on at once; empty columns left and right of a picture (twice the last level's step).
TILE, PAD = 128, 2 << (LEVELS - 1)
#: Planes of a guide. ``SURFACE`` is the object's index, NaN where nothing is covered; ``SOURCE`` the same, NaN also
#: where the light is no number. ``WIDTH`` is the inverse width of a pixel.
POSITION, NORMAL, ROUGHNESS, SOURCE, SURFACE, WIDTH, GUIDES = 0, 3, 6, 7, 8, 9, 10
#: Planes of a signal, two lobes each: luminance, its variance, the inverse of the difference that counts; the light.
LUMINANCE, VARIANCE, CERTAINTY, LIGHT = 0, 2, 4, 6


@dataclass(slots=True)
class Guides:
    """What tells surfaces apart, (h, w) or (h, w, 3) float32; see `film.Film`.

    ``footprint`` (h, w) is the width of a pixel at the surface, metres.
    """

    coverage: Array
    position: Array
    normal: Array
    albedo: Array
    roughness: Array
    metallic: Array
    index: Array
    footprint: Array


@dataclass(slots=True)
class Signal:
    """Demodulated light of a picture and what guides its filters.

    Attributes
    ----------
    guide : (h, GUIDES, w + 2 PAD) float32
    light : (h, LIGHT + 6 parts, w + 2 PAD) float32; after ``LIGHT``: diffuse direct, (indirect,) glossy direct,
        (indirect), three colours each, divided by surface colour and coverage
    spans : (h, 2) int32: first and last + 1 column of each row that is covered, `PAD` not counted
    """

    guide: Array
    light: Array
    spans: Array


#: Filters a signal: `smooth`, or the same on a device.
Smooth = Callable[[Signal, Callable[[], None]], Signal]


def denoise(
    components: Array, variance: Array, guides: Guides, split: bool = True, check: Callable[[], None] = lambda: None,
    by: Smooth | None = None,
) -> Array:  # fmt: skip
    """Filter the light of a picture.

    Parameters
    ----------
    components : (h, w, 4, 3) float32 premultiplied light, see `points.Radiance`; non-finite values are replaced
    variance : (h, w, 2) float32 of the luminance of the diffuse and the glossy sum
    split : keep direct and indirect light apart; else their sum is returned as direct light and indirect is 0 (faster)
    check : called between levels; may raise to stop
    by : does the work of `smooth`

    Returns
    -------
    (h, w, 4, 3) float32
    """
    signal = demodulate(components, variance, guides, split)
    check()
    return modulate((by or smooth)(signal, check), guides)


def demodulate(components: Array, variance: Array, guides: Guides, split: bool = True) -> Signal:
    """Divide light by surface colour and coverage, and clamp its fireflies; parameters as of `denoise`."""
    h, w = guides.coverage.shape
    planes = LIGHT + (12 if split else 6)
    guide = np.zeros((h, GUIDES, w + 2 * PAD), np.float32)
    light = np.zeros((h, planes, w + 2 * PAD), np.float32)
    spans = np.zeros((h, 2), np.int32)
    g = guides
    _demodulate(
        components, variance, g.coverage, g.position, g.normal, g.albedo, g.roughness, g.metallic, g.index,
        g.footprint, guide, light, spans,
    )  # fmt: skip
    clamped = np.zeros_like(light)
    over_rows(_clamp_fireflies, h, guide, spans, light, clamped)
    return Signal(guide, clamped, spans)


def smooth(signal: Signal, check: Callable[[], None] = lambda: None) -> Signal:
    """All levels of the a-trous filter."""
    light, out, other = signal.light, np.zeros_like(signal.light), np.zeros_like(signal.light)
    for level in range(LEVELS):
        check()
        over_rows(
            _weigh, len(light), np.float32(SIGMA_LUMINANCE * SIGMA_DECAY**level), signal.guide, signal.spans, light
        )
        over_rows(_a_trous, len(light), 1 << level, signal.guide, signal.spans, light, out)
        light, out, other = out, other, out
    return Signal(signal.guide, light, signal.spans)


def modulate(signal: Signal, guides: Guides) -> Array:
    """(h, w, 4, 3) float32: light multiplied by surface colour and coverage again."""
    out = np.zeros((*guides.coverage.shape, 4, 3), np.float32)
    _modulate(signal.light, signal.spans, guides.coverage, guides.albedo, guides.metallic, out)
    return out


@njit(inline="always")
def _colour(lobe: Any, albedo: Any, metallic: Any, y: Any, x: Any) -> Any:
    """Surface colour of a lobe's light, at least COLOUR_FLOOR: diffuse a (1 - m), glossy Fresnel's F0."""
    floor = np.float32(COLOUR_FLOOR)
    m, r, g, b = metallic[y, x], albedo[y, x, 0], albedo[y, x, 1], albedo[y, x, 2]
    k = np.float32(1.0) - m
    if lobe == 0:
        return max(k * r, floor), max(k * g, floor), max(k * b, floor)
    base = np.float32(DIELECTRIC_F0) * k
    return max(base + m * r, floor), max(base + m * g, floor), max(base + m * b, floor)


@njit(parallel=True)
def _demodulate(
    components: Any, variance: Any, coverage: Any, position: Any, normal: Any, albedo: Any, roughness: Any,
    metallic: Any, index: Any, footprint: Any, guide: Any, light: Any, spans: Any,
) -> None:  # fmt: skip
    """Fill the planes of all covered pixels."""
    h, w = coverage.shape
    parts = (light.shape[1] - LIGHT) // 6
    usable = np.float32(1e30)
    nothing = np.float32(np.nan)
    for y in prange(h):
        guide[y, SOURCE] = nothing
        guide[y, SURFACE] = nothing
        first, last = w, 0
        for x in range(w):
            cover = coverage[y, x]
            if not cover > np.float32(0.0):
                continue
            first, last = min(first, x), x + 1
            c = x + PAD
            for k in range(3):
                guide[y, POSITION + k, c], guide[y, NORMAL + k, c] = position[y, x, k], normal[y, x, k]
            guide[y, ROUGHNESS, c] = roughness[y, x]
            guide[y, WIDTH, c] = np.float32(1.0) / footprint[y, x]
            guide[y, SURFACE, c] = index[y, x]
            valid = True
            for lobe in range(2):
                colour = _colour(lobe, albedo, metallic, y, x)
                shade = cover * luminance(colour[0], colour[1], colour[2])
                base = LIGHT + 3 * parts * lobe
                for k in range(3):
                    scale = np.float32(1.0) / (cover * colour[k])
                    direct, indirect = components[y, x, 2 * lobe, k], components[y, x, 2 * lobe + 1, k]
                    if not (abs(direct) < usable and abs(indirect) < usable):
                        valid = False
                    if parts == 2:
                        light[y, base + k, c], light[y, base + 3 + k, c] = direct * scale, indirect * scale
                    else:
                        light[y, base + k, c] = (direct + indirect) * scale
                spread = variance[y, x, lobe] / (shade * shade)
                if not spread < usable:
                    valid = False
                light[y, VARIANCE + lobe, c] = max(spread, np.float32(0.0))
            if valid:
                guide[y, SOURCE, c] = index[y, x]
                for lobe in range(2):
                    light[y, LUMINANCE + lobe, c] = _lobe_luminance(light, y, c, lobe, parts)
            else:
                for k in range(light.shape[1]):
                    light[y, k, c] = np.float32(0.0)
        spans[y, 0], spans[y, 1] = first, max(last, first)


@njit(inline="always")
def _lobe_luminance(light: Any, y: Any, c: Any, lobe: Any, parts: Any) -> Any:
    total = np.float32(0.0)
    for part in range(parts):
        k = LIGHT + 3 * (parts * lobe + part)
        total += luminance(light[y, k, c], light[y, k + 1, c], light[y, k + 2, c])
    return total


@njit
def _clamp_fireflies(y0: Any, y1: Any, guide: Any, spans: Any, light: Any, out: Any) -> None:
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


@njit(inline="always")
def stop(x: Any) -> Any:
    """(1 - x / 8)^8 for x in [0, 8], beyond it 0."""
    u = max(np.float32(1.0) - np.float32(0.125) * x, np.float32(0.0))
    u *= u
    u *= u
    return u * u


@njit
def _weigh(y0: Any, y1: Any, sigma: Any, guide: Any, spans: Any, light: Any) -> None:
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
def _a_trous(y0: Any, y1: Any, step: Any, guide: Any, spans: Any, light: Any, out: Any) -> None:
    """One level: 5 x 5 B-spline taps `step` pixels apart."""
    h, planes = light.shape[:2]
    taps = (np.float32(0.0625), np.float32(0.25), np.float32(0.375), np.float32(0.25), np.float32(0.0625))
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
            for dy in range(5):
                yy = y + (dy - 2) * step
                if yy < 0 or yy >= h or spans[yy, 0] >= spans[yy, 1]:
                    continue
                start, reach = x0 - 2 * step, n + 4 * step
                for k in range(SURFACE):
                    for i in range(reach):
                        near[k, i] = guide[yy, k, start + i]
                for k in range(planes):
                    for i in range(reach):
                        near[SURFACE + k, i] = light[yy, k, start + i]
                for dx in range(5):
                    kernel = taps[dy] * taps[dx]
                    off = np.uint64(dx * step)
                    far = one / (np.float32(SIGMA_PLANE) * np.float32(max(1, step * max(abs(dy - 2), abs(dx - 2)))))
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


@njit(inline="always")
def share_of(k: Any) -> Any:
    """Share of colour channel `k` in luminance."""
    return np.float32(REC709[0]) if k == 0 else np.float32(REC709[1]) if k == 1 else np.float32(REC709[2])


@njit(parallel=True)
def _modulate(light: Any, spans: Any, coverage: Any, albedo: Any, metallic: Any, out: Any) -> None:
    """Multiply by surface colour and coverage again."""
    parts = (light.shape[1] - LIGHT) // 6
    for y in prange(len(spans)):
        for x in range(spans[y, 0], spans[y, 1]):
            if not coverage[y, x] > np.float32(0.0):
                continue
            for lobe in range(2):
                colour = _colour(lobe, albedo, metallic, y, x)
                for part in range(parts):
                    for k in range(3):
                        value = light[y, LIGHT + 3 * (parts * lobe + part) + k, x + PAD]
                        out[y, x, 2 * lobe + part, k] = value * colour[k] * coverage[y, x]
