"""Kernels of SVGF on a device, one thread per pixel.

Where the CPU works on runs of pixels for vectors, the same is written here for one pixel; sums are taken in the
same order. The functions here are translated and never run as they stand.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...compute.warp.kernels import ScratchArray, WarpKernel
from ..denoise.demodulation import (
    CERTAINTY,
    LIGHT,
    LUMINANCE,
    NORMAL,
    PAD,
    POSITION,
    ROUGHNESS,
    SOURCE,
    SURFACE,
    VARIANCE,
    WIDTH,
    demodulate_pixel,
    find_span,
    modulate_pixel,
    planes_of,
)
from ..denoise.svgf_reprojection import look_up_pixel
from ..denoise.svgf_residual import (
    DIFFERENCE,
    MEASURED,
    NOISE,
    PAIRS,
    PIXELS,
    PRODUCTS,
    SQUARES,
    SUMS,
    TAKEN,
    noisy_share,
    terms_of,
)
from ..denoise.svgf_spatial import (
    FIREFLY,
    NORMAL_POWER,
    ROUGH_NORMAL_POWER,
    SIGMA_PLANE,
    SIGMA_ROUGHNESS,
    share_of,
    stop,
)
from ..denoise.svgf_temporal import (
    BIAS,
    CHANGES,
    NOW,
    PAST,
    RADIUS,
    SPACING,
    mix_pixel,
)
from ..sampling import ONE, ZERO, F

Array = np.ndarray

#: Planes of a signal whose direct and indirect light are apart.
_PLANES = planes_of(True)


def span_rows(thread: Any, stride: Any, scratch: Any, coverage: Any, out: Any) -> None:
    """`demodulation.find_span`."""
    (spans,) = out
    for y in range(thread, coverage.shape[0], stride):
        find_span(y, coverage, spans)


def demodulate_pixels(
    thread: Any, stride: Any, scratch: Any, components: Any, variance: Any, surface: Any, out: Any
) -> None:  # fmt: skip
    """`demodulation._demodulate`."""
    guide, light = out
    coverage = surface[0]
    h, w = coverage.shape[0], coverage.shape[1]
    for column in range(thread, h * (w + 2 * PAD), stride):
        y, c = column // (w + 2 * PAD), column % (w + 2 * PAD)
        guide[y, SOURCE, c] = F(np.nan)
        guide[y, SURFACE, c] = F(np.nan)
        x = c - PAD
        if x < 0 or x >= w:
            continue
        if coverage[y, x] > ZERO:
            demodulate_pixel(y, x, components, variance, surface, guide, light)


def clamp_pixels(thread: Any, stride: Any, scratch: Any, guide: Any, spans: Any, light: Any, out: Any) -> None:
    """`svgf_spatial._clamp_fireflies`."""
    (clamped,) = out
    h, w, planes = guide.shape[0], guide.shape[2] - 2 * PAD, light.shape[1]
    width = (planes - LIGHT) // 2
    for pixel in range(thread, h * w, stride):
        y, x = pixel // w, pixel % w
        if x < spans[y, 0] or x >= spans[y, 1]:
            continue
        c = x + PAD
        count, diffuse, diffuse2, glossy, glossy2 = ZERO, ZERO, ZERO, ZERO, ZERO
        for yy in range(max(y - 2, 0), min(y + 3, h)):
            for dx in range(5):
                if yy == y and dx == 2:
                    continue
                j = c + dx - 2
                if guide[yy, SOURCE, j] == guide[y, SURFACE, c]:
                    d, g = light[yy, LUMINANCE, j], light[yy, LUMINANCE + 1, j]
                    count += ONE
                    diffuse += d
                    diffuse2 += d * d
                    glossy += g
                    glossy2 += g * g
        inverse = ONE / max(count, ONE)
        for lobe in range(2):
            mean = (diffuse if lobe == 0 else glossy) * inverse
            deviation = F(math.sqrt(max((diffuse2 if lobe == 0 else glossy2) * inverse - mean * mean, ZERO)))
            limit = mean + F(FIREFLY) * deviation
            value, spread = light[y, LUMINANCE + lobe, c], light[y, VARIANCE + lobe, c]
            doubtful = spread > (value - mean) * (value - mean) * F(0.0625)
            scale = limit / value if count >= F(4.0) and value > limit and doubtful else ONE
            clamped[y, LUMINANCE + lobe, c] = value * scale
            clamped[y, VARIANCE + lobe, c] = spread * scale * scale
            for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
                clamped[y, k, c] = light[y, k, c] * scale


def look_up_pixels(
    thread: Any, stride: Any, scratch: Any, guide: Any, spans: Any, vector: Any, expected: Any, other: Any,
    other_light: Any, out: Any,
) -> None:  # fmt: skip
    """`svgf_reprojection._look_up`."""
    past, source = out
    h, w = guide.shape[0], guide.shape[2] - 2 * PAD
    for column in range(thread, h * (w + 2 * PAD), stride):
        y, c = column // (w + 2 * PAD), column % (w + 2 * PAD)
        source[y, c] = F(np.nan)
        x = c - PAD
        if x >= spans[y, 0] and x < spans[y, 1]:
            look_up_pixel(y, x, guide, vector, expected, other, other_light, past, source)


def compare_pixels(
    thread: Any, stride: Any, scratch: Any, still: Any, guide: Any, spans: Any, light: Any, past: Any, source: Any,
    out: Any,
) -> None:  # fmt: skip
    """`svgf_temporal._compare`."""
    (change,) = out
    (sums,) = scratch
    h, w = guide.shape[0], guide.shape[2] - 2 * PAD
    for pixel in range(thread, h * w, stride):
        y, x = pixel // w, pixel % w
        if x < spans[y, 0] or x >= spans[y, 1]:
            continue
        c = x + PAD
        count = ZERO
        for k in range(CHANGES):
            sums[k] = ZERO
        for dy in range(2 * RADIUS + 1):
            yy = y + (dy - RADIUS) * SPACING
            if yy < 0 or yy >= h:
                continue
            for dx in range(2 * RADIUS + 1):
                j = c + (dx - RADIUS) * SPACING
                seen = guide[yy, SOURCE, j]
                if seen == guide[y, SURFACE, c] and seen == source[yy, j]:
                    count += ONE
                    for lobe in range(2):
                        sums[BIAS + lobe] += light[yy, LUMINANCE + lobe, j] - past[yy, LUMINANCE + lobe, j]
                        sums[NOW + lobe] += light[yy, VARIANCE + lobe, j]
                        sums[PAST + lobe] += past[yy, VARIANCE + lobe, j]
        inverse = ONE / max(count, ONE)
        for lobe in range(2):
            difference = sums[BIAS + lobe] * inverse
            now, before = sums[NOW + lobe] * inverse, sums[PAST + lobe] * inverse
            change[y, NOW + lobe, c], change[y, PAST + lobe, c] = now, before
            beyond = max(difference * difference - (now + before) * inverse, ZERO)
            change[y, BIAS + lobe, c] = ZERO if still else beyond


def mix_pixels(
    thread: Any, stride: Any, scratch: Any, rules: Any, spans: Any, light: Any, past: Any, source: Any, change: Any,
    out: Any,
) -> None:  # fmt: skip
    """`svgf_temporal._mix`."""
    guide, mixed = out
    h, w = guide.shape[0], guide.shape[2] - 2 * PAD
    for pixel in range(thread, h * w, stride):
        y, x = pixel // w, pixel % w
        if x >= spans[y, 0] and x < spans[y, 1]:
            mix_pixel(y, x + PAD, rules, light, past, source, change, guide, mixed)


def weigh_pixels(thread: Any, stride: Any, scratch: Any, sigma: Any, guide: Any, spans: Any, out: Any) -> None:
    """`svgf_spatial._weigh`."""
    (light,) = out
    h, w = guide.shape[0], guide.shape[2] - 2 * PAD
    for pixel in range(thread, h * w, stride):
        y, x = pixel // w, pixel % w
        if x < spans[y, 0] or x >= spans[y, 1]:
            continue
        total, diffuse, glossy = ZERO, ZERO, ZERO
        for yy in range(max(y - 1, 0), min(y + 2, h)):
            for dx in range(3):
                c = x + PAD + dx - 1
                source = guide[yy, SOURCE, c]
                share = F((2 - abs(yy - y)) * (2 - abs(dx - 1))) if source == source else ZERO
                total += share
                diffuse += share * light[yy, VARIANCE, c]
                glossy += share * light[yy, VARIANCE + 1, c]
        inverse = ONE / max(total, ONE)
        own = guide[y, SOURCE, x + PAD]
        for k in range(2):
            deviation = sigma * math.sqrt((diffuse if k == 0 else glossy) * inverse) + F(1e-8)
            light[y, CERTAINTY + k, x + PAD] = ONE / deviation if own == own else ZERO


def tap(k: Any) -> Any:
    """Weight of a tap of the B-spline."""
    return F(0.375) if k == 2 else (F(0.25) if k == 1 or k == 3 else F(0.0625))


def a_trous_pixels(
    thread: Any, stride: Any, scratch: Any, step: Any, guide: Any, spans: Any, light: Any, out: Any
) -> None:
    """`svgf_spatial._a_trous`."""
    (filtered,) = out
    (sums,) = scratch
    h, w, planes = guide.shape[0], guide.shape[2] - 2 * PAD, light.shape[1]
    lobe_planes = (planes - LIGHT) // 2
    for pixel in range(thread, h * w, stride):
        y, x = pixel // w, pixel % w
        if x < spans[y, 0] or x >= spans[y, 1]:
            continue
        c = x + PAD
        for k in range(planes):
            sums[k] = ZERO
        weight_d, weight_g = ZERO, ZERO
        nx, ny, nz = guide[y, NORMAL, c], guide[y, NORMAL + 1, c], guide[y, NORMAL + 2, c]
        power = F(NORMAL_POWER) + F(ROUGH_NORMAL_POWER - NORMAL_POWER) * guide[y, ROUGHNESS, c]
        for dy in range(5):
            yy = y + (dy - 2) * step
            if yy < 0 or yy >= h:
                continue
            if spans[yy, 0] >= spans[yy, 1]:
                continue
            for dx in range(5):
                j = c + (dx - 2) * step
                kernel = tap(dy) * tap(dx)
                far = ONE / (F(SIGMA_PLANE) * F(max(1, step * max(abs(dy - 2), abs(dx - 2)))))
                plane = abs(
                    nx * (guide[yy, POSITION, j] - guide[y, POSITION, c])
                    + ny * (guide[yy, POSITION + 1, j] - guide[y, POSITION + 1, c])
                    + nz * (guide[yy, POSITION + 2, j] - guide[y, POSITION + 2, c])
                )
                turn = ONE - (nx * guide[yy, NORMAL, j] + ny * guide[yy, NORMAL + 1, j] + nz * guide[yy, NORMAL + 2, j])
                common = plane * guide[y, WIDTH, c] * far
                rough = abs(guide[yy, ROUGHNESS, j] - guide[y, ROUGHNESS, c]) * F(1.0 / SIGMA_ROUGHNESS)
                sure_d = min(light[yy, CERTAINTY, j], light[y, CERTAINTY, c])
                sure_g = min(light[yy, CERTAINTY + 1, j], light[y, CERTAINTY + 1, c])
                far_d = abs(light[yy, LUMINANCE, j] - light[y, LUMINANCE, c]) * sure_d
                far_g = abs(light[yy, LUMINANCE + 1, j] - light[y, LUMINANCE + 1, c]) * sure_g
                same = kernel if guide[yy, SOURCE, j] == guide[y, SURFACE, c] else ZERO
                share_d = same * stop(common + F(ROUGH_NORMAL_POWER) * turn + far_d)
                share_g = same * stop(common + power * turn + rough + far_g)
                weight_d += share_d
                weight_g += share_g
                sums[VARIANCE] += share_d * share_d * light[yy, VARIANCE, j]
                sums[VARIANCE + 1] += share_g * share_g * light[yy, VARIANCE + 1, j]
                for k in range(lobe_planes):
                    sums[LIGHT + k] += share_d * light[yy, LIGHT + k, j]
                    sums[LIGHT + lobe_planes + k] += share_g * light[yy, LIGHT + lobe_planes + k, j]
        for lobe in range(2):
            scale = ONE / max(weight_d if lobe == 0 else weight_g, F(1e-20))
            filtered[y, VARIANCE + lobe, c] = sums[VARIANCE + lobe] * scale * scale
            luminance = ZERO
            for k in range(LIGHT + lobe * lobe_planes, LIGHT + (lobe + 1) * lobe_planes):
                value = sums[k] * scale
                luminance += share_of((k - LIGHT) % 3) * value
                filtered[y, k, c] = value
            filtered[y, LUMINANCE + lobe, c] = luminance


def residual_pixels(
    thread: Any, stride: Any, scratch: Any, guide: Any, spans: Any, light: Any, smoothed: Any, out: Any
) -> None:  # fmt: skip
    """`svgf_residual._compare`."""
    (terms,) = out
    h, w = guide.shape[0], guide.shape[2] - 2 * PAD
    for pixel in range(thread, h * w, stride):
        y, x = pixel // w, pixel % w
        if x < spans[y, 0] or x >= spans[y, 1]:
            continue
        c = x + PAD
        found, around_d, around_g = ZERO, ZERO, ZERO
        for yy in range(max(y - 1, 0), min(y + 2, h)):
            for dx in range(3):
                j = c + dx - 1
                if guide[yy, SOURCE, j] == guide[y, SURFACE, c]:
                    found += ONE
                    around_d += abs(smoothed[yy, LUMINANCE, j])
                    around_g += abs(smoothed[yy, LUMINANCE + 1, j])
        for lobe in range(2):
            before, after = light[y, LUMINANCE + lobe, c], smoothed[y, LUMINANCE + lobe, c]
            variance = light[y, VARIANCE + lobe, c]
            around, left = around_d if lobe == 0 else around_g, smoothed[y, VARIANCE + lobe, c]
            difference, noise = terms_of(before, after, around, found, variance, left)
            terms[y, DIFFERENCE + lobe, c] = difference
            terms[y, NOISE + lobe, c] = noise


def restore_pixels(
    thread: Any, stride: Any, scratch: Any, guide: Any, spans: Any, light: Any, terms: Any, out: Any
) -> None:  # fmt: skip
    """`svgf_residual._mix`."""
    (smoothed,) = out
    (sums,) = scratch
    h, w, planes = guide.shape[0], guide.shape[2] - 2 * PAD, light.shape[1]
    width = (planes - LIGHT) // 2
    for pixel in range(thread, h * w, stride):
        y, x = pixel // w, pixel % w
        if x < spans[y, 0] or x >= spans[y, 1]:
            continue
        c = x + PAD
        if guide[y, SOURCE, c] != guide[y, SURFACE, c]:
            continue
        for k in range(SUMS):
            sums[k] = ZERO
        for yy in range(max(y - MEASURED, 0), min(y + MEASURED + 1, h)):
            below = min(yy + 1, h - 1)
            for dx in range(2 * MEASURED + 1):
                j = c + dx - MEASURED
                if guide[yy, SOURCE, j] != guide[y, SURFACE, c]:
                    continue
                right = ONE if guide[yy, SOURCE, j + 1] == guide[y, SURFACE, c] else ZERO
                down = ONE if yy + 1 < h and guide[below, SOURCE, j] == guide[y, SURFACE, c] else ZERO
                sums[PIXELS] += ONE
                sums[PAIRS] += right + down
                for lobe in range(2):
                    difference = terms[yy, DIFFERENCE + lobe, j]
                    others = right * terms[yy, DIFFERENCE + lobe, j + 1]
                    others += down * terms[below, DIFFERENCE + lobe, j]
                    sums[SQUARES + lobe] += difference * difference
                    sums[PRODUCTS + lobe] += difference * others
                    sums[TAKEN + lobe] += terms[yy, NOISE + lobe, j]
        for lobe in range(2):
            squares, products, taken = sums[SQUARES + lobe], sums[PRODUCTS + lobe], sums[TAKEN + lobe]
            share = noisy_share(squares, products, taken, sums[PIXELS], sums[PAIRS])
            for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
                after = smoothed[y, k, c]
                smoothed[y, k, c] = after + share * (light[y, k, c] - after)


def modulate_pixels(thread: Any, stride: Any, scratch: Any, light: Any, surface: Any, out: Any) -> None:
    """`demodulation._modulate`."""
    (picture,) = out
    coverage = surface[0]
    h, w = coverage.shape[0], coverage.shape[1]
    for pixel in range(thread, h * w, stride):
        y, x = pixel // w, pixel % w
        if coverage[y, x] > ZERO:
            modulate_pixel(y, x, light, surface, picture)


SPAN, DEMODULATE, CLAMP = (
    WarpKernel(span_rows, (), {}),
    WarpKernel(demodulate_pixels, (), {}),
    WarpKernel(clamp_pixels, (), {}),
)
LOOK_UP, MIX = WarpKernel(look_up_pixels, (), {}), WarpKernel(mix_pixels, (), {})
COMPARE = WarpKernel(compare_pixels, (ScratchArray("float32", (CHANGES,)),), {})
WEIGH, MODULATE = WarpKernel(weigh_pixels, (), {}), WarpKernel(modulate_pixels, (), {})
A_TROUS = WarpKernel(a_trous_pixels, (ScratchArray("float32", (_PLANES,)),), {})
RESIDUAL = WarpKernel(residual_pixels, (), {})
RESTORE = WarpKernel(restore_pixels, (ScratchArray("float32", (SUMS,)),), {})
KERNELS = (SPAN, DEMODULATE, CLAMP, LOOK_UP, COMPARE, MIX, WEIGH, A_TROUS, RESIDUAL, RESTORE, MODULATE)
