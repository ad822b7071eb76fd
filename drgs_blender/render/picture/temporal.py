"""Light of neighbouring frames, brought to this frame's surfaces: SVGF's temporal half, and a window for final frames.

Pictures are compared on demodulated light, so texture moves with its surface and never ghosts. Every pixel looks up
where its surface was (`motion`); of the four pixels around that place those count that show the same object, lie on the
tangent plane there and are turned alike. Where none does, a surface has just come into view and starts anew.

`accumulate` is recursive, for a picture that follows the user. Its weight is not a count of frames but Kalman's gain:
with v the variance of this frame and h that of the past, both known from the integrator, the best mixture takes
(h + b) / (h + b + v) of this frame, b being the square by which the past is wrong. As long as the light stands still,
b = 0 and this is 1 / N in frame N. b is measured as what the difference of both, averaged over the neighbourhood, has
beyond its own noise. Changes that hide in the noise are bounded by a least weight of the present.

`window` is for final frames: the mean over the frames k - 2 .. k + 2, weighted by v / (v + b). It looks ahead as far
as back, so a steady change cancels, and depends on these frames alone, so that it does not matter in which runs and on
which machines a sequence is made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...jit import njit
from .denoise import (
    LIGHT,
    LUMINANCE,
    NORMAL,
    PAD,
    POSITION,
    SOURCE,
    SURFACE,
    TILE,
    VARIANCE,
    WIDTH,
    Guides,
    Signal,
    Smooth,
    demodulate,
    modulate,
    smooth,
)
from .motion import Instant, Motion
from .rows import over_rows

Array = np.ndarray

#: Least weight of the present where anything moves, diffuse and glossy, since small changes hide in the noise. Glossy
#: reflections do not even move with the surface.
LEAST_GAIN = (0.2, 0.6)
#: Most weight in a window of the frames next to the middle one, diffuse and glossy; its square for those after them.
MOST_WEIGHT = (1.0, 0.4)
#: Distance from the tangent plane, in pixel widths, up to which a pixel of another frame shows the same surface.
SAME_PLANE = 2.0
#: Cosine of the angle by which its normal may differ; surfaces turn between frames.
SAME_NORMAL = 0.7
#: Frames before and after that `window` looks at.
REACH = 2
#: Rounds in which the next frame is searched for a surface point.
SEARCHES = 4
#: Taps of the neighbourhood in which change is looked for: (2 R + 1)^2, `SPACING` pixels apart.
RADIUS, SPACING = 2, 2
#: Planes of what `_change` returns, two lobes each: mean variance now and before, square of the change.
_NOW, _PAST, _BIAS, _CHANGES = 0, 2, 4, 6


@dataclass(slots=True)
class Shot:
    """One noisy picture as a frame file holds it; see `denoise.denoise` for the arrays.

    ``motion`` leads to the frame before; None where there is none.
    """

    components: Array
    variance: Array
    guides: Guides
    motion: Motion | None = None


@dataclass(slots=True)
class History:
    """What the pictures of a sequence leave for the next one.

    Attributes
    ----------
    signal : what `denoise_next` returned for the last picture; None before the first
    instant : the scene as it was in that picture
    still : nothing has changed since then, save the noise
    """

    signal: Signal | None = None
    instant: Instant | None = None
    still: bool = False


def denoise_next(
    shot: Shot,
    history: Signal | None,
    split: bool = True,
    still: bool = False,
    check: Callable[[], None] = lambda: None,
    by: Smooth | None = None,
) -> tuple[Array, Signal]:
    """Denoise a picture with the help of those before it.

    Parameters
    ----------
    history : what this function returned for the frame before; None starts anew
    still : nothing in the scene has changed since then (camera, objects, light), only the noise: pictures are then
        gathered without end, with equal weights
    split, check, by : see `denoise.denoise`; a history made with another `split` or size is not used

    Returns
    -------
    (h, w, 4, 3) float32 light, and the history for the next frame
    """
    signal = demodulate(shot.components, shot.variance, shot.guides, split)
    check()
    if history is not None and shot.motion is not None and history.light.shape == signal.light.shape:
        signal = accumulate(history, signal, shot.motion, still)
    return modulate((by or smooth)(signal, check), shot.guides), signal


def accumulate(history: Signal, signal: Signal, motion: Motion, still: bool = False) -> Signal:
    """Mix what earlier frames saw of the same surfaces into a frame's light; see `denoise_next`."""
    past, source = _warp(history, signal, motion.vector, motion.previous)
    change = _change(signal, past, source)
    if still:
        change[:, _BIAS : _BIAS + 2] = 0.0
    least = np.zeros(2, np.float32) if still else np.array(LEAST_GAIN, np.float32)
    guide, light = signal.guide.copy(), np.zeros_like(signal.light)
    over_rows(_mix, len(light), least, signal.spans, signal.light, past, source, change, guide, light)
    return Signal(guide, light, signal.spans)


def window(shots: Sequence[Shot | None], split: bool = True, check: Callable[[], None] = lambda: None) -> Array:
    """Denoise the middle one of 2 `REACH` + 1 pictures.

    Parameters
    ----------
    shots : frames k - 2 .. k + 2, of one size; None where the sequence has ended. Nothing else enters the result.
    split, check : see `denoise.denoise`

    Returns
    -------
    (h, w, 4, 3) float32

    Raises
    ------
    ValueError: the middle picture is None.
    """
    shot = shots[len(shots) // 2]
    if shot is None:
        raise ValueError("the middle picture is missing")
    signal = demodulate(shot.components, shot.variance, shot.guides, split)
    total, weights = np.zeros_like(signal.light), np.zeros((len(signal.light), 2, signal.light.shape[2]), np.float32)
    still = np.zeros((len(signal.light), _CHANGES, signal.light.shape[2]), np.float32)
    over_rows(
        _add,
        len(total),
        np.ones(2, np.float32),
        signal.spans,
        signal.light,
        signal.guide[:, SOURCE],
        still,
        total,
        weights,
    )
    for distance, neighbour, vector, expected in _neighbours(shots):
        check()
        most = np.array(MOST_WEIGHT, np.float32) ** np.float32(distance)
        other = demodulate(neighbour.components, neighbour.variance, neighbour.guides, split)
        seen, source = _warp(other, signal, vector, expected)
        over_rows(_add, len(total), most, signal.spans, seen, source, _change(signal, seen, source), total, weights)
    guide = signal.guide.copy()
    over_rows(_divide, len(total), signal.spans, weights, guide, total)
    return modulate(smooth(Signal(guide, total, signal.spans), check), shot.guides)


def _neighbours(shots: Sequence[Shot | None]) -> Iterator[tuple[int, Shot, Array, Array]]:
    """The other pictures that can be reached: how many frames away, the picture, and for each pixel of the middle one
    (h, w) the vector to its place there (pixels) and the world position it has there."""
    middle = len(shots) // 2
    centre = shots[middle]
    for direction in (-1, 1):
        here = centre
        for k in range(middle + direction, middle + direction * (middle + 1), direction):
            there = shots[k]
            if here is None or there is None or centre is None:
                break
            if here is centre:
                h, w = centre.guides.coverage.shape
                vector, expected = np.zeros((h, w, 2), np.float32), centre.guides.position.copy()
            motion, kernel = (here.motion, _step_back) if direction < 0 else (there.motion, _step_ahead)
            if motion is None:
                break
            # The picture that the motion belongs to, in both directions the later one.
            g = here.guides if direction < 0 else there.guides
            over_rows(
                kernel, len(vector), motion.vector, motion.previous, g.position, g.normal, g.footprint, g.index,
                centre.guides.index, vector, expected,
            )  # fmt: skip
            yield abs(k - middle), there, vector, expected
            here = there


def _warp(other: Signal, signal: Signal, vector: Array, expected: Array) -> tuple[Array, Array]:
    """Light of another picture on the surfaces of `signal`, and its ``SOURCE`` (h, w + 2 PAD), NaN where it has none.

    Parameters
    ----------
    vector, expected : see `_neighbours`
    """
    light = np.zeros_like(signal.light)
    source = np.full((len(light), light.shape[2]), np.nan, np.float32)
    over_rows(
        _look_up, len(light), signal.guide, signal.spans, vector, expected, other.guide, other.light, light, source
    )
    return light, source


def _change(signal: Signal, past: Array, source: Array) -> Array:
    """How two pictures differ beyond their noise, (h, _CHANGES, w + 2 PAD) float32."""
    out = np.zeros((len(past), _CHANGES, past.shape[2]), np.float32)
    over_rows(_compare, len(past), signal.guide, signal.spans, signal.light, past, source, out)
    return out


@njit
def _look_up(
    y0: Any, y1: Any, guide: Any, spans: Any, vector: Any, expected: Any, other: Any, other_light: Any, out: Any,
    source: Any,
) -> None:  # fmt: skip
    """Bilinear interpolation over those of four pixels that show the same surface."""
    h, planes = out.shape[:2]
    w = out.shape[2] - 2 * PAD
    zero, one = np.float32(0.0), np.float32(1.0)
    for y in range(y0, y1):
        for x in range(spans[y, 0], spans[y, 1]):
            c = x + PAD
            surface = guide[y, SURFACE, c]
            px, py = np.float32(x) + vector[y, x, 0], np.float32(y) + vector[y, x, 1]
            # A comparison that NaN fails too.
            if not (px > -one and py > -one and px < np.float32(w) and py < np.float32(h)) or surface != surface:
                continue
            left, top = np.int64(np.floor(px)), np.int64(np.floor(py))
            fx, fy = px - np.float32(left), py - np.float32(top)
            total = zero
            for j in range(2):
                for i in range(2):
                    share = (fx if i else one - fx) * (fy if j else one - fy)
                    yy, cc = top + j, left + i + PAD
                    if share <= np.float32(1e-3) or yy < 0 or yy >= h or other[yy, SOURCE, cc] != surface:
                        continue
                    nx, ny, nz = other[yy, NORMAL, cc], other[yy, NORMAL + 1, cc], other[yy, NORMAL + 2, cc]
                    away = (
                        nx * (expected[y, x, 0] - other[yy, POSITION, cc])
                        + ny * (expected[y, x, 1] - other[yy, POSITION + 1, cc])
                        + nz * (expected[y, x, 2] - other[yy, POSITION + 2, cc])
                    )
                    alike = nx * guide[y, NORMAL, c] + ny * guide[y, NORMAL + 1, c] + nz * guide[y, NORMAL + 2, c]
                    if not (abs(away) * other[yy, WIDTH, cc] < np.float32(SAME_PLANE)) or alike < SAME_NORMAL:
                        continue
                    total += share
                    for k in range(planes):
                        out[y, k, c] += share * other_light[yy, k, cc]
            if total > zero:
                source[y, c] = surface
                inverse = one / total
                for k in range(planes):
                    out[y, k, c] *= inverse


@njit
def _compare(y0: Any, y1: Any, guide: Any, spans: Any, light: Any, past: Any, source: Any, out: Any) -> None:
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
                    out[y, _NOW + lobe, x0 + i], out[y, _PAST + lobe, x0 + i] = now, before
                    out[y, _BIAS + lobe, x0 + i] = max(difference * difference - (now + before) * inverse, zero)


@njit
def _mix(
    y0: Any, y1: Any, least: Any, spans: Any, light: Any, past: Any, source: Any, change: Any, guide: Any, out: Any
) -> None:  # fmt: skip
    """Kalman's update; a pixel that holds no number takes over the past."""
    planes = light.shape[1]
    width = (planes - LIGHT) // 2
    zero, one = np.float32(0.0), np.float32(1.0)
    for y in range(y0, y1):
        for c in range(spans[y, 0] + PAD, spans[y, 1] + PAD):
            known, usable = source[y, c] == source[y, c], guide[y, SOURCE, c] == guide[y, SOURCE, c]
            if known and not usable:
                guide[y, SOURCE, c] = guide[y, SURFACE, c]
            for lobe in range(2):
                gain = one
                if known and usable:
                    error = change[y, _PAST + lobe, c] + change[y, _BIAS + lobe, c]
                    whole = error + change[y, _NOW + lobe, c]
                    gain = max(error / whole, least[lobe]) if whole > zero else one
                elif known:
                    gain = zero
                rest = one - gain
                k = VARIANCE + lobe
                out[y, k, c] = rest * rest * past[y, k, c] + gain * gain * light[y, k, c]
                k = LUMINANCE + lobe
                out[y, k, c] = rest * past[y, k, c] + gain * light[y, k, c]
                for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
                    out[y, k, c] = rest * past[y, k, c] + gain * light[y, k, c]


@njit
def _add(
    y0: Any, y1: Any, most: Any, spans: Any, light: Any, source: Any, change: Any, total: Any, weights: Any
) -> None:  # fmt: skip
    """Add a picture to the window's sums, by the variance of the present against that plus the error."""
    width = (light.shape[1] - LIGHT) // 2
    zero, one = np.float32(0.0), np.float32(1.0)
    for y in range(y0, y1):
        for c in range(spans[y, 0] + PAD, spans[y, 1] + PAD):
            if source[y, c] != source[y, c]:
                continue
            for lobe in range(2):
                noise, bias = change[y, _NOW + lobe, c], change[y, _BIAS + lobe, c]
                weight = most[lobe] * (noise / (noise + bias) if bias > zero else one)
                weights[y, lobe, c] += weight
                total[y, VARIANCE + lobe, c] += weight * weight * light[y, VARIANCE + lobe, c]
                total[y, LUMINANCE + lobe, c] += weight * light[y, LUMINANCE + lobe, c]
                for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
                    total[y, k, c] += weight * light[y, k, c]


@njit
def _divide(y0: Any, y1: Any, spans: Any, weights: Any, guide: Any, total: Any) -> None:
    """From sums to means."""
    width = (total.shape[1] - LIGHT) // 2
    for y in range(y0, y1):
        for c in range(spans[y, 0] + PAD, spans[y, 1] + PAD):
            if not (weights[y, 0, c] > np.float32(0.0) and weights[y, 1, c] > np.float32(0.0)):
                continue
            guide[y, SOURCE, c] = guide[y, SURFACE, c]
            for lobe in range(2):
                inverse = np.float32(1.0) / weights[y, lobe, c]
                total[y, VARIANCE + lobe, c] *= inverse * inverse
                total[y, LUMINANCE + lobe, c] *= inverse
                for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
                    total[y, k, c] *= inverse


@njit(inline="always")
def _nearest(x: Any, y: Any, w: Any, h: Any) -> Any:
    """Column and row of the pixel nearest to a position that counts from the first pixel's centre; -1 outside."""
    half = np.float32(0.5)
    if not (x > -half and y > -half and x < np.float32(w) - half and y < np.float32(h) - half):
        return -1, -1
    return np.int64(np.floor(x + half)), np.int64(np.floor(y + half))


@njit(inline="always")
def _away(seen: Any, normal: Any, footprint: Any, y: Any, x: Any, px: Any, py: Any, pz: Any) -> Any:
    """Distance of (px, py, pz) from the plane through ``seen[y, x]``, in pixel widths."""
    return (
        abs(
            normal[y, x, 0] * (px - seen[y, x, 0])
            + normal[y, x, 1] * (py - seen[y, x, 1])
            + normal[y, x, 2] * (pz - seen[y, x, 2])
        )
        / footprint[y, x]
    )


@njit
def _step_back(
    y0: Any, y1: Any, motion: Any, previous: Any, position: Any, normal: Any, footprint: Any, index: Any, centre: Any,
    vector: Any, expected: Any,
) -> None:  # fmt: skip
    """Follow the motion of the picture that `vector` leads to, one frame further back."""
    h, w = index.shape
    for y in range(y0, y1):
        for x in range(w):
            i, j = _nearest(np.float32(x) + vector[y, x, 0], np.float32(y) + vector[y, x, 1], w, h)
            px, py, pz = expected[y, x, 0], expected[y, x, 1], expected[y, x, 2]
            if (
                i < 0
                or index[j, i] != centre[y, x]
                or not _away(position, normal, footprint, j, i, px, py, pz) < np.float32(SAME_PLANE)
            ):
                vector[y, x, 0] = np.float32(np.nan)
                continue
            for k in range(2):
                vector[y, x, k] += motion[j, i, k]
            for k in range(3):
                expected[y, x, k] += previous[j, i, k] - position[j, i, k]


@njit
def _step_ahead(
    y0: Any, y1: Any, motion: Any, previous: Any, position: Any, normal: Any, footprint: Any, index: Any, centre: Any,
    vector: Any, expected: Any,
) -> None:  # fmt: skip
    """Search the picture after that which `vector` leads to for the pixel whose motion leads back there."""
    h, w = index.shape
    for y in range(y0, y1):
        for x in range(w):
            tx, ty = np.float32(x) + vector[y, x, 0], np.float32(y) + vector[y, x, 1]
            px, py, pz = expected[y, x, 0], expected[y, x, 1], expected[y, x, 2]
            qx, qy = tx, ty
            found = False
            for _ in range(SEARCHES):
                i, j = _nearest(qx, qy, w, h)
                if i < 0 or not abs(motion[j, i, 0]) + abs(motion[j, i, 1]) < np.float32(1e6):
                    break
                qx, qy = tx - motion[j, i, 0], ty - motion[j, i, 1]
                ii, jj = _nearest(qx, qy, w, h)
                found = ii == i and jj == j
                if found:
                    break
            if (
                not found
                or index[j, i] != centre[y, x]
                or not _away(previous, normal, footprint, j, i, px, py, pz) < np.float32(SAME_PLANE)
            ):
                vector[y, x, 0] = np.float32(np.nan)
                continue
            vector[y, x, 0], vector[y, x, 1] = qx - np.float32(x), qy - np.float32(y)
            for k in range(3):
                expected[y, x, k] += position[j, i, k] - previous[j, i, k]
