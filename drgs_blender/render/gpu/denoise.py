"""SVGF on a device; what one picture leaves to the next stays there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher
from ..denoise.demodulation import GUIDES, LEVELS, PAD, Signal, planes_of
from ..denoise.svgf_residual import TERMS
from ..denoise.svgf_spatial import sigma_of
from ..denoise.svgf_temporal import CHANGES, NoisyPicture, mixture_rules
from .svgf_kernels import (
    A_TROUS,
    CLAMP,
    COMPARE,
    DEMODULATE,
    LOOK_UP,
    MIX,
    MODULATE,
    RESIDUAL,
    RESTORE,
    SPAN,
    WEIGH,
)

Array = np.ndarray


class DeviceSignal(Signal):
    """A signal whose arrays are on a device."""

    guide: Any
    light: Any
    spans: Any

    def to_cpu(self) -> Signal | None:
        try:
            return Signal(self.guide.numpy(), self.light.numpy(), self.spans.numpy())
        except Exception:  # whatever Warp raises for a device that is no more
            return None


def denoise(
    launcher: Launcher,
    picture: NoisyPicture,
    history: Signal | None,
    split: bool,
    still: bool,
    check: Callable[[], None],
) -> tuple[Array, Signal]:
    """`svgf_temporal.denoise_next` on a device; without a history and a motion, `svgf_spatial.denoise`."""
    with launcher.failures("copying the picture"):
        surface = tuple(launcher.array(array) for array in picture.guides)
        signal = _prepare(launcher, picture, surface, split)
    check()
    if history is not None and picture.motion is not None and history.light.shape == signal.light.shape:
        _accumulate(launcher, history, signal, picture, still)
    out = np.zeros((*picture.guides.coverage.shape, 4, 3), np.float32)
    light = _smooth(launcher, signal, check)
    launcher.launch(MODULATE, out[..., 0, 0].size, (light, surface), (out,))
    return out, signal


def _prepare(launcher: Launcher, picture: NoisyPicture, surface: tuple[Any, ...], split: bool) -> DeviceSignal:
    """`denoise.svgf_spatial.prepare`."""
    h, w = picture.guides.coverage.shape
    padded = w + 2 * PAD
    guide, spans = launcher.zeros((h, GUIDES, padded)), launcher.zeros((h, 2), "int32")
    light, clamped = (launcher.zeros((h, planes_of(split), padded)) for _ in range(2))
    launcher.launch(SPAN, h, (surface[0],), (spans,))
    launcher.launch(DEMODULATE, h * padded, (picture.components, picture.variance, surface), (guide, light))
    launcher.launch(CLAMP, h * w, (guide, spans, light), (clamped,))
    return DeviceSignal(guide, clamped, spans)


def _accumulate(launcher: Launcher, history: Signal, signal: DeviceSignal, picture: NoisyPicture, still: bool) -> None:
    """`svgf_temporal.accumulate`; changes `signal`."""
    assert picture.motion is not None
    h, planes, padded = signal.light.shape
    pixels = h * (padded - 2 * PAD)
    with launcher.failures("denoising"):
        past, mixed = (launcher.zeros((h, planes, padded)) for _ in range(2))
        source, change = launcher.zeros((h, padded)), launcher.zeros((h, CHANGES, padded))
    moved = picture.motion.vector, picture.motion.previous, history.guide, history.light
    launcher.launch(LOOK_UP, h * padded, (signal.guide, signal.spans, *moved), (past, source))
    now = signal.guide, signal.spans, signal.light
    launcher.launch(COMPARE, pixels, (still, *now, past, source), (change,))
    seen = signal.spans, signal.light, past, source, change
    rules = mixture_rules(still, picture.world_turn)
    launcher.launch(MIX, pixels, (rules, *seen), (signal.guide, mixed))
    signal.light = mixed


def _smooth(launcher: Launcher, signal: DeviceSignal, check: Callable[[], None]) -> Any:
    """Light after `svgf_spatial.smooth` and `svgf_residual.restore`; of the signal, `CERTAINTY` alone changes."""
    h, _, padded = shape = signal.light.shape
    pixels = h * (padded - 2 * PAD)
    with launcher.failures("denoising"):
        light, pair = signal.light, [launcher.zeros(shape), launcher.zeros(shape)]
    for level in range(LEVELS):
        check()
        launcher.launch(WEIGH, pixels, (sigma_of(level), signal.guide, signal.spans), (light,))
        out = pair[level % 2]
        launcher.launch(A_TROUS, pixels, (1 << level, signal.guide, signal.spans, light), (out,))
        light = out
    with launcher.failures("denoising"):
        terms = launcher.zeros((h, TERMS, padded))
    launcher.launch(RESIDUAL, pixels, (signal.guide, signal.spans, signal.light, light), (terms,))
    launcher.launch(RESTORE, pixels, (signal.guide, signal.spans, signal.light, terms), (light,))
    return light
