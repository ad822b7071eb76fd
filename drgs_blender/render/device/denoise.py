"""SVGF's filter on a device, one lane a pixel: `picture.denoise.smooth` without its runs of pixels for vectors.

The functions here are translated and never run as they stand; sums are taken in the order of the processor's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ...device.kernels import Launcher, Room, Work
from ..picture.denoise import (
    CERTAINTY,
    LEVELS,
    LIGHT,
    LUMINANCE,
    NORMAL,
    NORMAL_POWER,
    PAD,
    POSITION,
    ROUGH_NORMAL_POWER,
    ROUGHNESS,
    SIGMA_DECAY,
    SIGMA_LUMINANCE,
    SIGMA_PLANE,
    SIGMA_ROUGHNESS,
    SOURCE,
    SURFACE,
    VARIANCE,
    WIDTH,
    Signal,
    share_of,
    stop,
)
from ..sampling import ONE, ZERO, F

Array = np.ndarray

#: Planes of a signal whose direct and indirect light are apart.
_PLANES = LIGHT + 12


def weigh_pixels(lane: Any, lanes: Any, room: Any, sigma: Any, guide: Any, spans: Any, out: Any) -> None:
    """`denoise._weigh`."""
    (light,) = out
    h, w = guide.shape[0], guide.shape[2] - 2 * PAD
    for pixel in range(lane, h * w, lanes):
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


def a_trous_pixels(lane: Any, lanes: Any, room: Any, step: Any, guide: Any, spans: Any, light: Any, out: Any) -> None:
    """`denoise._a_trous`."""
    (filtered,) = out
    (sums,) = room
    h, w, planes = guide.shape[0], guide.shape[2] - 2 * PAD, light.shape[1]
    lobe_planes = (planes - LIGHT) // 2
    for pixel in range(lane, h * w, lanes):
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


WEIGH = Work(weigh_pixels, (), {})
A_TROUS = Work(a_trous_pixels, (Room("float32", (_PLANES,)),), {})


def smooth(launcher: Launcher, signal: Signal, check: Callable[[], None] = lambda: None) -> Signal:
    """`picture.denoise.smooth` on a device."""
    pixels = signal.guide.shape[0] * (signal.guide.shape[2] - 2 * PAD)
    with launcher.failures("copying the picture"):
        guide, spans = launcher.array(signal.guide), launcher.array(signal.spans)
        light, other = launcher.array(signal.light, copy=True), launcher.zeros(signal.light.shape)
    for level in range(LEVELS):
        check()
        sigma = np.float32(SIGMA_LUMINANCE * SIGMA_DECAY**level)
        launcher.launch(WEIGH, pixels, (sigma, guide, spans), (light,))
        launcher.launch(A_TROUS, pixels, (1 << level, guide, spans, light), (other,))
        light, other = other, light
    with launcher.failures("denoising"):
        return Signal(signal.guide, light.numpy(), signal.spans)
