"""Demodulation: light as SVGF filters it, divided by surface colour and coverage, in planes, beside the guides.

Pictures are planar here, (rows, planes, columns), with `PAD` empty columns on either side: kernels work on runs of
`TILE` pixels, plane by plane, with scratch arrays whose strides the compiler knows, so that all of it is SIMD.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import ROWS, over_range
from ...core.memory import sparse_zeros
from ..film.guides import Guides
from ..sampling import ONE, ZERO, F, luminance

Array = np.ndarray

#: Surface colours below this are not divided out, they would amplify noise.
COLOUR_FLOOR = 0.02
DIELECTRIC_F0 = 0.04

LEVELS = 5
#: Pixels a kernel works on at once; empty columns left and right of a picture (twice the last level's step).
TILE, PAD = 128, 2 << (LEVELS - 1)
#: Planes of a guide. ``SURFACE`` is the object's number, NaN where nothing is covered; ``SOURCE`` the same, and NaN
#: where the light is no number, too. ``WIDTH`` is the inverse width of a pixel, 1/m.
POSITION, NORMAL, ROUGHNESS, SOURCE, SURFACE, WIDTH, GUIDES = 0, 3, 6, 7, 8, 9, 10
#: Planes of a signal, two lobes each: luminance; its variance; the inverse of the difference that counts, but of light
#: warped from another picture the part of it that counts; the light.
LUMINANCE, VARIANCE, CERTAINTY, LIGHT = 0, 2, 4, 6


@dataclass(slots=True)
class Signal:
    """Demodulated light of a picture and what guides its filters.

    Attributes
    ----------
    guide : (h, GUIDES, w + 2 PAD) float32 array
    light : (h, LIGHT + 6 parts, w + 2 PAD) float32 array
        After ``LIGHT``: diffuse direct, (indirect,) glossy direct, (indirect), three colours each, divided by surface
        colour and coverage.
    spans : (h, 2) int32 array
        First and last + 1 column of each row that is covered, `PAD` not counted.
    """

    guide: Array
    light: Array
    spans: Array

    def to_cpu(self) -> Signal | None:
        """A copy in this process's memory; None where it is lost with the device that had it."""
        return self


def demodulate(components: Array, variance: Array, guides: Guides, split: bool = True) -> Signal:
    """Divide light by surface colour and coverage; parameters as of `svgf_spatial.denoise`."""
    h, w = guides.coverage.shape
    guide = sparse_zeros((h, GUIDES, w + 2 * PAD))
    light = sparse_zeros((h, planes_of(split), w + 2 * PAD))
    spans = np.zeros((h, 2), np.int32)
    over_range(_demodulate, len(light), components, variance, guides.plain(), guide, light, spans, fewest=ROWS)
    return Signal(guide, light, spans)


def planes_of(split: bool) -> int:
    """Number of planes of a signal."""
    return LIGHT + (12 if split else 6)


def modulate(signal: Signal, guides: Guides) -> Array:
    """(h, w, 4, 3) float32: light multiplied by surface colour and coverage again."""
    out = sparse_zeros((*guides.coverage.shape, 4, 3))
    over_range(_modulate, len(signal.spans), signal.light, signal.spans, guides.plain(), out, fewest=ROWS)
    return out


@inlined
def _colour(lobe, albedo, metallic, y, x):  # type: ignore[no-untyped-def]
    """Surface colour of a lobe's light, at least COLOUR_FLOOR: diffuse a (1 - m), glossy Fresnel's F0."""
    m = metallic[y, x]
    k = ONE - m
    if lobe == 0:
        base, share = ZERO, k
    else:
        base, share = F(DIELECTRIC_F0) * k, m
    floor = F(COLOUR_FLOOR)
    red, green, blue = base + share * albedo[y, x, 0], base + share * albedo[y, x, 1], base + share * albedo[y, x, 2]
    return max(red, floor), max(green, floor), max(blue, floor)


@inlined
def _channel(k, red, green, blue):  # type: ignore[no-untyped-def]
    return red if k == 0 else green if k == 1 else blue


@inlined
def demodulate_pixel(y, x, components, variance, surface, guide, light):  # type: ignore[no-untyped-def]
    """Fill the planes of a covered pixel, which are 0, and NaN in `SOURCE` and `SURFACE`.

    Parameters
    ----------
    y, x : int64
        Pixel.
    components : (h, w, 4, 3) float32 array
        Premultiplied light, linear Rec.709, see ``Radiance.components``.
    variance : (h, w, 2) float32 array
        Of the luminance of the diffuse and the glossy sum.
    surface : Guides
        Or a tuple in its order.
    guide, light : (h, planes, w + 2 PAD) float32 array
        See `Signal`; written.
    """
    coverage, position, normal, albedo, roughness, metallic, index, footprint = surface
    parts = (light.shape[1] - LIGHT) // 6
    usable = F(1e30)
    cover, c = coverage[y, x], x + PAD
    for k in range(3):
        guide[y, POSITION + k, c], guide[y, NORMAL + k, c] = position[y, x, k], normal[y, x, k]
    guide[y, ROUGHNESS, c] = roughness[y, x]
    guide[y, WIDTH, c] = ONE / footprint[y, x]
    guide[y, SURFACE, c] = index[y, x]
    valid = True
    for lobe in range(2):
        red, green, blue = _colour(lobe, albedo, metallic, y, x)
        shade = cover * luminance(red, green, blue)
        base = LIGHT + 3 * parts * lobe
        for k in range(3):
            scale = ONE / (cover * _channel(k, red, green, blue))
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
        light[y, VARIANCE + lobe, c] = max(spread, ZERO)
    if valid:
        guide[y, SOURCE, c] = index[y, x]
        for lobe in range(2):
            light[y, LUMINANCE + lobe, c] = _lobe_luminance(light, y, c, lobe, parts)
    else:
        for k in range(light.shape[1]):
            light[y, k, c] = ZERO


@inlined
def _lobe_luminance(light, y, c, lobe, parts):  # type: ignore[no-untyped-def]
    total = ZERO
    for part in range(parts):
        k = LIGHT + 3 * (parts * lobe + part)
        total += luminance(light[y, k, c], light[y, k + 1, c], light[y, k + 2, c])
    return total


@njit
def _demodulate(first, last, components, variance, surface, guide, light, spans):  # type: ignore[no-untyped-def]
    coverage = surface.coverage
    w = coverage.shape[1]
    for y in range(first, last):
        guide[y, SOURCE] = F(np.nan)
        guide[y, SURFACE] = F(np.nan)
        for x in range(w):
            if coverage[y, x] > ZERO:
                demodulate_pixel(y, x, components, variance, surface, guide, light)
        find_span(y, coverage, spans)


@inlined
def find_span(y, coverage, spans):  # type: ignore[no-untyped-def]
    """Span of the covered columns of a row.

    Parameters
    ----------
    y : int64
        Row.
    coverage : (h, w) float32 array
    spans : (h, 2) int32 array
        Row `y` is written: first and last + 1 column.
    """
    first, last = coverage.shape[1], 0
    for x in range(coverage.shape[1]):
        if coverage[y, x] > ZERO:
            first, last = min(first, x), x + 1
    spans[y, 0], spans[y, 1] = first, max(last, first)


@inlined
def modulate_pixel(y, x, light, surface, out):  # type: ignore[no-untyped-def]
    """Modulation: multiply a covered pixel's light by surface colour and coverage again.

    Parameters
    ----------
    y, x : int64
        Pixel.
    light : (h, planes, w + 2 PAD) float32 array
        See `Signal`.
    surface : Guides
        Or a tuple in its order.
    out : (h, w, 4, 3) float32 array
        Premultiplied light, linear Rec.709; the pixel is written.
    """
    coverage, _, _, albedo, _, metallic, _, _ = surface
    parts = (light.shape[1] - LIGHT) // 6
    for lobe in range(2):
        red, green, blue = _colour(lobe, albedo, metallic, y, x)
        for part in range(parts):
            for k in range(3):
                value = light[y, LIGHT + 3 * (parts * lobe + part) + k, x + PAD]
                out[y, x, 2 * lobe + part, k] = value * _channel(k, red, green, blue) * coverage[y, x]


@njit
def _modulate(first, last, light, spans, surface, out):  # type: ignore[no-untyped-def]
    coverage = surface.coverage
    for y in range(first, last):
        for x in range(spans[y, 0], spans[y, 1]):
            if coverage[y, x] > ZERO:
                modulate_pixel(y, x, light, surface, out)
