"""Spatial SVGF: an edge-stopping a-trous filter on demodulated light, guided by the light's variance.

Schied et al., "Spatiotemporal Variance-Guided Filtering" (2017), without its temporal half, so that a frame does not
depend on other frames. Diffuse and glossy light are filtered apart, each divided by the colour of its surface first and
multiplied again afterwards, so that texture is not blurred. Changes and their reasons:

- Light is divided by coverage too, and pixels without coverage take no part: silhouettes do not bleed.
- Depth is compared as distance from the tangent plane, in pixel widths: exact on slanted planes, no depth gradient that
  breaks at edges.
- Fireflies are clamped first, to mean + `FIREFLY` deviations of their neighbours, only where the pixel's own variance
  does not vouch for them.
- Rough surfaces reflect smoothly: the power on the normals' cosine falls from 128 to 32 with roughness; 32 for diffuse.
- Direct and indirect light share one set of weights, so their sum stays the sum to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..jit import njit, prange

Array = np.ndarray

LEVELS = 5
#: Luminance differences that count, in deviations of the filtered estimate; 2 beat the paper's 4.
SIGMA_LUMINANCE = 2.0
#: Distances from the tangent plane that count, in pixel widths per pixel of distance on the screen.
SIGMA_PLANE = 1.0
SIGMA_ROUGHNESS = 0.1
NORMAL_POWER, ROUGH_NORMAL_POWER = 128.0, 32.0
FIREFLY = 3.0
#: Surface colours below this are not divided out, they would amplify noise.
COLOUR_FLOOR = 0.02
DIELECTRIC_F0 = 0.04

# Columns of the guide of a pixel.
_POSITION, _NORMAL, _POWER, _ROUGHNESS, _INDEX, _FOOTPRINT, _VALID, _GUIDE = 0, 3, 6, 7, 8, 9, 10, 12


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


def denoise(
    components: Array, variance: Array, guides: Guides, split: bool = True, check: Callable[[], None] = lambda: None
) -> Array:
    """Filter the light of a picture.

    Parameters
    ----------
    components : (h, w, 4, 3) float32 premultiplied light, see `points.Radiance`; non-finite values are replaced
    variance : (h, w, 2) float32 of the luminance of the diffuse and the glossy sum
    split : keep direct and indirect light apart; else their sum is returned as direct light and indirect is 0 (faster)
    check : called between levels; may raise to stop

    Returns
    -------
    (h, w, 4, 3) float32
    """
    h, w = guides.coverage.shape
    guide = np.zeros((h, w, _GUIDE), np.float32)
    parts = 2 if split else 1
    light = np.zeros((h, w, 2, parts, 3), np.float32)
    spread = np.zeros((h, w, 4), np.float32)  # variance, then luminance, of diffuse and glossy
    _demodulate(
        components,
        variance,
        guides.coverage,
        guides.position,
        guides.normal,
        guides.albedo,
        guides.roughness,
        guides.metallic,
        guides.index,
        guides.footprint,
        guide,
        light,
        spread,
    )
    check()
    other = np.zeros_like(light)
    other_spread = np.zeros_like(spread)
    _clamp_fireflies(guide, light, spread, other, other_spread)
    light, other, spread, other_spread = other, light, other_spread, spread
    for level in range(LEVELS):
        check()
        _a_trous(1 << level, guide, light, spread, other, other_spread)
        light, other, spread, other_spread = other, light, other_spread, spread
    out = np.zeros((h, w, 4, 3), np.float32)
    _modulate(light, guide, guides.coverage, guides.albedo, guides.metallic, out)
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


@njit(inline="always")
def _luminance(r: Any, g: Any, b: Any) -> Any:
    return np.float32(0.2126) * r + np.float32(0.7152) * g + np.float32(0.0722) * b


@njit(inline="always")
def _lobe_luminance(light: Any, y: Any, x: Any, lobe: Any) -> Any:
    total = np.float32(0.0)
    for part in range(light.shape[3]):
        total += _luminance(light[y, x, lobe, part, 0], light[y, x, lobe, part, 1], light[y, x, lobe, part, 2])
    return total


@njit(parallel=True)
def _demodulate(
    components: Any,
    variance: Any,
    coverage: Any,
    position: Any,
    normal: Any,
    albedo: Any,
    roughness: Any,
    metallic: Any,
    index: Any,
    footprint: Any,
    guide: Any,
    light: Any,
    spread: Any,
) -> None:
    """Divide light by surface colour and coverage; gather the guides of a pixel side by side."""
    h, w = coverage.shape
    parts = light.shape[3]
    usable = np.float32(1e30)
    for y in prange(h):
        for x in range(w):
            cover = coverage[y, x]
            if not cover > np.float32(0.0):
                continue
            g = guide[y, x]
            for k in range(3):
                g[_POSITION + k], g[_NORMAL + k] = position[y, x, k], normal[y, x, k]
            r = roughness[y, x]
            g[_POWER] = np.float32(NORMAL_POWER) + r * np.float32(ROUGH_NORMAL_POWER - NORMAL_POWER)
            g[_ROUGHNESS], g[_INDEX], g[_FOOTPRINT] = r, index[y, x], footprint[y, x]
            valid = np.float32(1.0)
            for lobe in range(2):
                c = _colour(lobe, albedo, metallic, y, x)
                shade = cover * _luminance(c[0], c[1], c[2])
                for k in range(3):
                    scale = np.float32(1.0) / (cover * c[k])
                    direct, indirect = components[y, x, 2 * lobe, k], components[y, x, 2 * lobe + 1, k]
                    if not (abs(direct) < usable and abs(indirect) < usable):
                        valid = np.float32(0.0)
                    if parts == 2:
                        light[y, x, lobe, 0, k], light[y, x, lobe, 1, k] = direct * scale, indirect * scale
                    else:
                        light[y, x, lobe, 0, k] = (direct + indirect) * scale
                v = variance[y, x, lobe] / (shade * shade)
                if not v < usable:
                    valid = np.float32(0.0)
                spread[y, x, lobe] = max(v, np.float32(0.0))
            if valid == np.float32(0.0):
                light[y, x] = np.float32(0.0)
                spread[y, x] = np.float32(0.0)
                valid = np.float32(-1.0)
            spread[y, x, 2], spread[y, x, 3] = _lobe_luminance(light, y, x, 0), _lobe_luminance(light, y, x, 1)
            g[_VALID] = valid


@njit(parallel=True)
def _clamp_fireflies(guide: Any, light: Any, spread: Any, out: Any, out_spread: Any) -> None:
    """Scale down outliers among 5 x 5 neighbours of the same object, and fill in pixels that hold no number."""
    h, w = guide.shape[:2]
    parts = light.shape[3]
    for y in prange(h):
        for x in range(w):
            if guide[y, x, _VALID] == np.float32(0.0):
                continue
            index = guide[y, x, _INDEX]
            for lobe in range(2):
                total = square = np.float32(0.0)
                n = 0
                for yy in range(max(y - 2, 0), min(y + 3, h)):
                    for xx in range(max(x - 2, 0), min(x + 3, w)):
                        if yy == y and xx == x:
                            continue
                        if not guide[yy, xx, _VALID] > np.float32(0.0) or guide[yy, xx, _INDEX] != index:
                            continue
                        value = spread[yy, xx, 2 + lobe]
                        total += value
                        square += value * value
                        n += 1
                own = spread[y, x, 2 + lobe]
                scale = np.float32(1.0)
                if n >= 4:
                    inverse = np.float32(1.0) / np.float32(n)
                    mean = total * inverse
                    deviation = np.sqrt(max(square * inverse - mean * mean, np.float32(0.0)))
                    limit = mean + np.float32(FIREFLY) * deviation
                    doubtful = spread[y, x, lobe] > (own - mean) * (own - mean) * np.float32(0.0625)
                    if own > limit and doubtful:
                        scale = limit / own
                for part in range(parts):
                    for k in range(3):
                        out[y, x, lobe, part, k] = light[y, x, lobe, part, k] * scale
                out_spread[y, x, lobe] = spread[y, x, lobe] * scale * scale
                out_spread[y, x, 2 + lobe] = own * scale


@njit(inline="always")
def _exp(x: Any) -> Any:
    """exp(x) for x <= 0, relative error below 2e-4: (1 + r)^256 would lose bits, so 2^n times a cubic of 2^f."""
    t = max(x * np.float32(1.4426950408889634), np.float32(-30.0))
    n = np.floor(t)
    f = t - n
    y = np.float32(0.07944154) * f + np.float32(0.22441137)
    y = y * f + np.float32(0.69611657)
    y = y * f + np.float32(1.0)
    return y / np.float32(1 << np.int64(-n))


@njit(parallel=True)
def _a_trous(step: Any, guide: Any, light: Any, spread: Any, out: Any, out_spread: Any) -> None:
    """One level: 5 x 5 B-spline taps `step` pixels apart."""
    h, w = guide.shape[:2]
    parts = light.shape[3]
    taps = (np.float32(0.375), np.float32(0.25), np.float32(0.0625))
    zero, tiny = np.float32(0.0), np.float32(1e-8)
    diffuse_power = np.float32(ROUGH_NORMAL_POWER)
    for y in prange(h):
        sums = np.empty((2, parts, 3), np.float32)
        for x in range(w):
            if guide[y, x, _VALID] == zero:
                continue
            # Scalars, not a view of the row: a view costs two atomic reference counts each time.
            px, py, pz = guide[y, x, _POSITION], guide[y, x, _POSITION + 1], guide[y, x, _POSITION + 2]
            nx, ny, nz = guide[y, x, _NORMAL], guide[y, x, _NORMAL + 1], guide[y, x, _NORMAL + 2]
            power, roughness, index = guide[y, x, _POWER], guide[y, x, _ROUGHNESS], guide[y, x, _INDEX]
            own_d, own_g = spread[y, x, 2], spread[y, x, 3]
            # Variance of the neighbourhood: 3 x 3 Gaussian.
            var_d = var_g = norm = zero
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    yy, xx = y + dy, x + dx
                    if yy < 0 or xx < 0 or yy >= h or xx >= w or not guide[yy, xx, _VALID] > zero:
                        continue
                    tap = np.float32((2 - abs(dy)) * (2 - abs(dx)))
                    norm += tap
                    var_d += tap * spread[yy, xx, 0]
                    var_g += tap * spread[yy, xx, 1]
            norm = np.float32(1.0) / max(norm, np.float32(1.0))
            inv_d = np.float32(1.0) / (np.float32(SIGMA_LUMINANCE) * np.sqrt(var_d * norm) + tiny)
            inv_g = np.float32(1.0) / (np.float32(SIGMA_LUMINANCE) * np.sqrt(var_g * norm) + tiny)
            if guide[y, x, _VALID] < zero:
                inv_d = inv_g = zero  # nothing to compare with
            inv_plane = np.float32(1.0) / (np.float32(SIGMA_PLANE) * guide[y, x, _FOOTPRINT])
            sums[:] = zero
            sum_d = sum_g = spread_d = spread_g = zero
            for dy in range(-2, 3):
                yy = y + dy * step
                if yy < 0 or yy >= h:
                    continue
                for dx in range(-2, 3):
                    xx = x + dx * step
                    if xx < 0 or xx >= w:
                        continue
                    if not guide[yy, xx, _VALID] > zero or guide[yy, xx, _INDEX] != index:
                        continue
                    kernel = taps[abs(dy)] * taps[abs(dx)]
                    if dy == 0 and dx == 0:
                        weight_d, weight_g = kernel, kernel
                    else:
                        plane = abs(
                            nx * (guide[yy, xx, _POSITION] - px)
                            + ny * (guide[yy, xx, _POSITION + 1] - py)
                            + nz * (guide[yy, xx, _POSITION + 2] - pz)
                        )
                        turn = np.float32(1.0) - (
                            nx * guide[yy, xx, _NORMAL]
                            + ny * guide[yy, xx, _NORMAL + 1]
                            + nz * guide[yy, xx, _NORMAL + 2]
                        )
                        common = plane * inv_plane / np.float32(step * max(abs(dy), abs(dx)))
                        if common > np.float32(12.0):
                            continue
                        rough = abs(guide[yy, xx, _ROUGHNESS] - roughness) * np.float32(1.0 / SIGMA_ROUGHNESS)
                        far_d = abs(spread[yy, xx, 2] - own_d) * inv_d
                        far_g = abs(spread[yy, xx, 3] - own_g) * inv_g
                        weight_d = kernel * _exp(-common - diffuse_power * turn - far_d)
                        weight_g = kernel * _exp(-common - power * turn - rough - far_g)
                    sum_d += weight_d
                    sum_g += weight_g
                    spread_d += weight_d * weight_d * spread[yy, xx, 0]
                    spread_g += weight_g * weight_g * spread[yy, xx, 1]
                    for part in range(parts):
                        for k in range(3):
                            sums[0, part, k] += weight_d * light[yy, xx, 0, part, k]
                            sums[1, part, k] += weight_g * light[yy, xx, 1, part, k]
            inverse_d = np.float32(1.0) / max(sum_d, np.float32(1e-20))
            inverse_g = np.float32(1.0) / max(sum_g, np.float32(1e-20))
            for part in range(parts):
                for k in range(3):
                    out[y, x, 0, part, k] = sums[0, part, k] * inverse_d
                    out[y, x, 1, part, k] = sums[1, part, k] * inverse_g
            out_spread[y, x, 0] = spread_d * inverse_d * inverse_d
            out_spread[y, x, 1] = spread_g * inverse_g * inverse_g
            out_spread[y, x, 2], out_spread[y, x, 3] = _lobe_luminance(out, y, x, 0), _lobe_luminance(out, y, x, 1)


@njit(parallel=True)
def _modulate(light: Any, guide: Any, coverage: Any, albedo: Any, metallic: Any, out: Any) -> None:
    """Multiply by surface colour and coverage again."""
    h, w = coverage.shape
    for y in prange(h):
        for x in range(w):
            if guide[y, x, _VALID] == np.float32(0.0):
                continue
            for lobe in range(2):
                c = _colour(lobe, albedo, metallic, y, x)
                for part in range(light.shape[3]):
                    for k in range(3):
                        out[y, x, 2 * lobe + part, k] = light[y, x, lobe, part, k] * c[k] * coverage[y, x]
