"""Temporal SVGF: reprojection of the last frame's light to this frame's surfaces, and its mixture with the new light.

Pictures are compared on demodulated light, so texture moves with its surface and never ghosts. The past is looked up
where the surface was (`svgf_reprojection`); where it has none, a surface has just come into view and starts over.

This half is recursive, for a picture that follows the user; `svgf_window` has another for final frames. The present's
weight is not a count of frames but Kalman's gain: with v the variance of this frame and h that of the past, both known
from the integrator, the best mixture takes (h + b) / (h + b + v) of this frame, b being the square by which the past is
wrong. As long as the light stands still, b = 0 and this is 1 / N in frame N. b is measured as what the difference of
both, averaged over the neighbourhood, has beyond its own noise. Changes that hide in the noise are bounded by a least
weight of the present.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ROWS, over_range
from ..film.motion_vectors import Motion, SceneState
from ..sampling import ONE, ZERO
from .demodulation import (
    CERTAINTY,
    LEVELS,
    LIGHT,
    LUMINANCE,
    PAD,
    ROUGHNESS,
    SOURCE,
    SURFACE,
    TILE,
    VARIANCE,
    Guides,
    Signal,
    modulate,
)
from .svgf_reprojection import part_kept, warp
from .svgf_residual import restore, rows_of
from .svgf_spatial import FEW_TAPS, TAPS, prepare, smooth

Array = np.ndarray

#: Least weight of the present where anything moves, diffuse and glossy, since small changes hide in the noise. Glossy
#: reflections do not even move with the surface.
LEAST_GAIN = (0.2, 0.6)
#: Levels of the spatial filter where only the camera moves: the past has averaged enough.
TURNED_LEVELS = 3
#: Taps of the neighbourhood in which change is looked for: (2 R + 1)^2, `SPACING` pixels apart.
RADIUS, SPACING = 2, 2
#: Planes of what `find_change` returns, two lobes each: mean variance now and before, square of the change.
NOW, PAST, BIAS, CHANGES = 0, 2, 4, 6


@dataclass(slots=True)
class NoisyPicture:
    """One noisy picture as a frame file holds it; see `svgf_spatial.denoise` for the arrays.

    ``motion`` leads to the frame before, None where there is none; ``world_turn`` is the angle by which the environment
    turned since then, radians, which `svgf_window` does not use: frame files do not hold it.
    """

    components: Array
    variance: Array
    guides: Guides
    motion: Motion | None = None
    world_turn: float = 0.0


@dataclass(slots=True)
class History:
    """Temporal history: data of the last pictures of a sequence for the next one.

    Attributes
    ----------
    signal : Signal, optional
        Result of `denoise_next` for the last picture; None before the first.
    scene_state : SceneState, optional
        The scene as it was in that picture.
    still : bool
        Nothing has changed since then, save the noise.
    turned : bool
        Nothing but the camera, and the noise.
    pictures : int
        How many have gone into it.
    ages : (h, w) uint8 array, optional
        How many into each pixel, see `kept_light.to_trace`; None: not known.
    world_turn : float
        See `NoisyPicture`.
    """

    signal: Signal | None = None
    scene_state: SceneState | None = None
    still: bool = False
    turned: bool = False
    pictures: int = 0
    ages: Array | None = None
    world_turn: float = 0.0


def denoise_next(
    picture: NoisyPicture,
    history: Signal | None,
    split: bool = True,
    still: bool = False,
    check: Callable[[], None] = lambda: None,
    turned: bool = False,
) -> tuple[Array, Signal]:
    """Denoise a picture with the help of those before it.

    Parameters
    ----------
    picture : NoisyPicture
    history : Signal or None
        Result of this function for the frame before; None starts over.
    still : bool
        Nothing in the scene has changed since then (camera, objects, light), only the noise: pictures are then gathered
        without end, with equal weights.
    split : bool
        See `svgf_spatial.denoise`; a history made with another `split` or size is not used.
    check : callable
        See `svgf_spatial.denoise`.
    turned : bool
        Nothing in the scene has changed since then but the camera: fewer levels of the spatial filter are enough.

    Returns
    -------
    (h, w, 4, 3) float32 array
        Light, and the history for the next frame.
    """
    signal = prepare(picture.components, picture.variance, picture.guides, split)
    check()
    past = None if history is None else history.to_cpu()
    levels, taps = LEVELS, TAPS
    if past is not None and picture.motion is not None and past.light.shape == signal.light.shape:
        signal = accumulate(past, signal, picture.motion, still, picture.world_turn)
        if turned:
            levels, taps = TURNED_LEVELS, FEW_TAPS
    smoothed = restore(smooth(signal, check, levels=levels, taps=taps), rows_of(signal))
    return modulate(smoothed, picture.guides), signal


def mixture_rules(still: bool, world_turn: float) -> Array:
    """(3,) float32: least weight of the present, diffuse and glossy; square of `NoisyPicture.world_turn`."""
    return np.array([0.0, 0.0, 0.0] if still else [*LEAST_GAIN, world_turn * world_turn], np.float32)


def accumulate(history: Signal, signal: Signal, motion: Motion, still: bool = False, world_turn: float = 0.0) -> Signal:
    """Mix what earlier frames saw of the same surfaces into a frame's light; see `denoise_next`."""
    past, source = warp(history, signal, motion.vector, motion.previous)
    change = find_change(signal, past, source)
    if still:
        change[:, BIAS : BIAS + 2] = 0.0
    rules = mixture_rules(still, world_turn)
    guide, light = signal.guide.copy(), np.zeros_like(signal.light)
    over_range(_mix, len(light), rules, signal.spans, signal.light, past, source, change, guide, light, fewest=ROWS)
    return Signal(guide, light, signal.spans)


def find_change(signal: Signal, past: Array, source: Array) -> Array:
    """Difference of two pictures beyond their noise, (h, CHANGES, w + 2 PAD) float32."""
    out = np.zeros((len(past), CHANGES, past.shape[2]), np.float32)
    over_range(_compare, len(past), signal.guide, signal.spans, signal.light, past, source, out, fewest=ROWS)
    return out


@njit
def _compare(y0, y1, guide, spans, light, past, source, out):  # type: ignore[no-untyped-def]
    """Mean variance of the present and of the past, and square of what differs, around every pixel."""
    h = len(light)
    zero, one = np.float32(0.0), np.float32(1.0)
    near = np.empty((7, TILE + 2 * PAD), np.float32)
    sums = np.empty((7, TILE), np.float32)
    surface = np.empty(TILE, np.float32)
    for y in range(y0, y1):
        for x0 in range(spans[y, 0] + PAD, spans[y, 1] + PAD, TILE):
            n = min(TILE, spans[y, 1] + PAD - x0)
            for i in range(n):
                surface[i] = guide[y, SURFACE, x0 + i]
                for k in range(7):
                    sums[k, i] = zero
            start, reach = x0 - RADIUS * SPACING, n + 2 * RADIUS * SPACING
            for dy in range(-RADIUS, RADIUS + 1):
                yy = y + dy * SPACING
                if yy < 0 or yy >= h:
                    continue
                for i in range(reach):
                    same = guide[yy, SOURCE, start + i] == source[yy, start + i]
                    near[0, i] = guide[yy, SOURCE, start + i] if same else np.float32(np.nan)
                for lobe in range(2):
                    for i in range(reach):
                        a = start + i
                        near[1 + 3 * lobe, i] = light[yy, LUMINANCE + lobe, a] - past[yy, LUMINANCE + lobe, a]
                        near[2 + 3 * lobe, i] = light[yy, VARIANCE + lobe, a]
                        near[3 + 3 * lobe, i] = past[yy, VARIANCE + lobe, a]
                for dx in range(2 * RADIUS + 1):
                    off = np.uint64(dx * SPACING)
                    for i in range(np.uint64(n)):
                        same = one if near[0, i + off] == surface[i] else zero
                        sums[0, i] += same
                        for k in range(1, 7):
                            sums[k, i] += same * near[k, i + off]
            for lobe in range(2):
                for i in range(n):
                    inverse = one / max(sums[0, i], one)
                    difference = sums[1 + 3 * lobe, i] * inverse
                    now, before = sums[2 + 3 * lobe, i] * inverse, sums[3 + 3 * lobe, i] * inverse
                    out[y, NOW + lobe, x0 + i], out[y, PAST + lobe, x0 + i] = now, before
                    out[y, BIAS + lobe, x0 + i] = max(difference * difference - (now + before) * inverse, zero)


@njit
def _mix(y0, y1, rules, spans, light, past, source, change, guide, out):  # type: ignore[no-untyped-def]
    for y in range(y0, y1):
        for c in range(spans[y, 0] + PAD, spans[y, 1] + PAD):
            mix_pixel(y, c, rules, light, past, source, change, guide, out)


@njit
def mix_pixel(y, c, rules, light, past, source, change, guide, out):  # type: ignore[no-untyped-def]
    """Kalman's update of a pixel: its light mixed with the reprojected past; one that holds no number takes the past.

    Parameters
    ----------
    y, c : int64
        Row, and column, `PAD` counted.
    rules : (3,) float32 array
        `mixture_rules`.
    light, past : (h, planes, w + 2 PAD) float32 array
        Light of this frame and of the past, see `Signal` and `warp`.
    source : (h, w + 2 PAD) float32 array
        As of `warp`.
    change : (h, CHANGES, w + 2 PAD) float32 array
        `find_change`.
    guide : (h, GUIDES, w + 2 PAD) float32 array
        `SOURCE` is written where the past replaces what is no number.
    out : (h, planes, w + 2 PAD) float32 array
        The pixel is written.
    """
    width = (light.shape[1] - LIGHT) // 2
    known, usable = source[y, c] == source[y, c], guide[y, SOURCE, c] == guide[y, SOURCE, c]
    if known and not usable:
        guide[y, SOURCE, c] = guide[y, SURFACE, c]
    for lobe in range(2):
        gain = ONE
        if known and usable:
            error = change[y, PAST + lobe, c] + change[y, BIAS + lobe, c]
            whole = error + change[y, NOW + lobe, c]
            gain = max(error / whole, rules[lobe]) if whole > ZERO else ONE
            kept = past[y, CERTAINTY + lobe, c]
            if lobe == 1:
                kept *= part_kept(rules[2], guide[y, ROUGHNESS, c])
            gain = ONE - (ONE - gain) * kept
        elif known:
            gain = ZERO
        rest = ONE - gain
        k = VARIANCE + lobe
        out[y, k, c] = rest * rest * past[y, k, c] + gain * gain * light[y, k, c]
        k = LUMINANCE + lobe
        out[y, k, c] = rest * past[y, k, c] + gain * light[y, k, c]
        for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
            out[y, k, c] = rest * past[y, k, c] + gain * light[y, k, c]
