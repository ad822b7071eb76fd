"""Temporal SVGF for final frames: the light of a window of frames that looks ahead as far as back.

The mean over the frames k - 2 .. k + 2, weighted by v / (v + b), see `svgf_temporal`: a steady change cancels, and what
comes of it depends on these frames alone, so that it does not matter in which runs and on which machines they are made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import ROWS, over_range
from .demodulation import (
    CERTAINTY,
    LIGHT,
    LUMINANCE,
    PAD,
    SOURCE,
    SURFACE,
    VARIANCE,
    Signal,
    modulate,
)
from .svgf_reprojection import SAME_PLANE, warp
from .svgf_residual import restore, rows_of
from .svgf_spatial import prepare, smooth
from .svgf_temporal import BIAS, CHANGES, NOW, NoisyPicture, find_change

Array = np.ndarray

#: Most weight in a window of the frames next to the middle one, diffuse and glossy; its square for those after them.
MOST_WEIGHT = (1.0, 0.4)
#: Frames before and after that `window` looks at.
REACH = 2
#: Rounds in which the next frame is searched for a surface point.
SEARCHES = 4


def window(
    pictures: Sequence[NoisyPicture | None], split: bool = True, check: Callable[[], None] = lambda: None
) -> Array:
    """Denoise the middle one of 2 `REACH` + 1 pictures.

    Parameters
    ----------
    pictures : sequence of (NoisyPicture or None)
        Frames k - 2 .. k + 2, of one size; None where the sequence has ended. Nothing else enters the result.
    split : bool
        See `svgf_spatial.denoise`.
    check : callable
        See `svgf_spatial.denoise`.

    Returns
    -------
    (h, w, 4, 3) float32 array

    Raises
    ------
    ValueError: the middle picture is None.
    """
    picture = pictures[len(pictures) // 2]
    if picture is None:
        raise ValueError("the middle picture is missing")
    signal = prepare(picture.components, picture.variance, picture.guides, split)
    total, weights = np.zeros_like(signal.light), np.zeros((len(signal.light), 2, signal.light.shape[2]), np.float32)
    signal.light[:, CERTAINTY : CERTAINTY + 2] = 1.0
    still = np.zeros((len(signal.light), CHANGES, signal.light.shape[2]), np.float32)
    over_range(
        _add,
        len(total),
        np.ones(2, np.float32),
        signal.spans,
        signal.light,
        signal.guide[:, SOURCE],
        still,
        total,
        weights,
        fewest=ROWS,
    )
    for distance, neighbour, vector, expected in _neighbours(pictures):
        check()
        most = np.array(MOST_WEIGHT, np.float32) ** np.float32(distance)
        other = prepare(neighbour.components, neighbour.variance, neighbour.guides, split)
        seen, source = warp(other, signal, vector, expected)
        over_range(
            _add,
            len(total),
            most,
            signal.spans,
            seen,
            source,
            find_change(signal, seen, source),
            total,
            weights,
            fewest=ROWS,
        )
    guide = signal.guide.copy()
    over_range(_divide, len(total), signal.spans, weights, guide, total, fewest=ROWS)
    gathered = Signal(guide, total, signal.spans)
    return modulate(restore(smooth(gathered, check), rows_of(gathered)), picture.guides)


def _neighbours(pictures: Sequence[NoisyPicture | None]) -> Iterator[tuple[int, NoisyPicture, Array, Array]]:
    """The other pictures that can be reached from the middle one.

    Each with how many frames away it is, and for each pixel of the middle one (h, w) the vector to its place there
    (pixels) and the world position it has there.
    """
    middle = len(pictures) // 2
    centre = pictures[middle]
    for direction in (-1, 1):
        here = centre
        for k in range(middle + direction, middle + direction * (middle + 1), direction):
            there = pictures[k]
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
            index = centre.guides.object
            over_range(kernel, len(vector), motion, g, index, vector, expected, fewest=ROWS)
            yield abs(k - middle), there, vector, expected
            here = there


@njit
def _add(y0, y1, most, spans, light, source, change, total, weights):  # type: ignore[no-untyped-def]
    """Add a picture to the window's sums, by its ``CERTAINTY`` and the present's variance, against that plus bias."""
    width = (light.shape[1] - LIGHT) // 2
    zero, one = np.float32(0.0), np.float32(1.0)
    for y in range(y0, y1):
        for c in range(spans[y, 0] + PAD, spans[y, 1] + PAD):
            if source[y, c] != source[y, c]:
                continue
            for lobe in range(2):
                noise, bias = change[y, NOW + lobe, c], change[y, BIAS + lobe, c]
                weight = most[lobe] * (noise / (noise + bias) if bias > zero else one)
                weight *= light[y, CERTAINTY + lobe, c]
                weights[y, lobe, c] += weight
                total[y, VARIANCE + lobe, c] += weight * weight * light[y, VARIANCE + lobe, c]
                total[y, LUMINANCE + lobe, c] += weight * light[y, LUMINANCE + lobe, c]
                for k in range(LIGHT + lobe * width, LIGHT + (lobe + 1) * width):
                    total[y, k, c] += weight * light[y, k, c]


@njit
def _divide(y0, y1, spans, weights, guide, total):  # type: ignore[no-untyped-def]
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


@inlined
def _nearest(x, y, w, h):  # type: ignore[no-untyped-def]
    """Column and row of the pixel nearest to a position that counts from the first pixel's centre; -1 outside."""
    half = np.float32(0.5)
    if not (x > -half and y > -half and x < np.float32(w) - half and y < np.float32(h) - half):
        return -1, -1
    return np.int64(np.floor(x + half)), np.int64(np.floor(y + half))


@inlined
def _away(seen, guides, y, x, px, py, pz):  # type: ignore[no-untyped-def]
    """Distance of (px, py, pz) from the plane through ``seen[y, x]``, in pixel widths."""
    return (
        abs(
            guides.normal[y, x, 0] * (px - seen[y, x, 0])
            + guides.normal[y, x, 1] * (py - seen[y, x, 1])
            + guides.normal[y, x, 2] * (pz - seen[y, x, 2])
        )
        / guides.footprint[y, x]
    )


@njit
def _step_back(y0, y1, motion, guides, centre, vector, expected):  # type: ignore[no-untyped-def]
    """Follow the motion of the picture that `vector` leads to, one frame further back."""
    h, w = guides.object.shape
    for y in range(y0, y1):
        for x in range(w):
            i, j = _nearest(np.float32(x) + vector[y, x, 0], np.float32(y) + vector[y, x, 1], w, h)
            px, py, pz = expected[y, x, 0], expected[y, x, 1], expected[y, x, 2]
            if (
                i < 0
                or guides.object[j, i] != centre[y, x]
                or not _away(guides.position, guides, j, i, px, py, pz) < np.float32(SAME_PLANE)
            ):
                vector[y, x, 0] = np.float32(np.nan)
                continue
            for k in range(2):
                vector[y, x, k] += motion.vector[j, i, k]
            for k in range(3):
                expected[y, x, k] += motion.previous[j, i, k] - guides.position[j, i, k]


@njit
def _step_ahead(y0, y1, motion, guides, centre, vector, expected):  # type: ignore[no-untyped-def]
    """Search the picture after that which `vector` leads to for the pixel whose motion leads back there."""
    h, w = guides.object.shape
    for y in range(y0, y1):
        for x in range(w):
            tx, ty = np.float32(x) + vector[y, x, 0], np.float32(y) + vector[y, x, 1]
            px, py, pz = expected[y, x, 0], expected[y, x, 1], expected[y, x, 2]
            qx, qy = tx, ty
            found = False
            for _ in range(SEARCHES):
                i, j = _nearest(qx, qy, w, h)
                if i < 0 or not abs(motion.vector[j, i, 0]) + abs(motion.vector[j, i, 1]) < np.float32(1e6):
                    break
                qx, qy = tx - motion.vector[j, i, 0], ty - motion.vector[j, i, 1]
                ii, jj = _nearest(qx, qy, w, h)
                found = ii == i and jj == j
                if found:
                    break
            if (
                not found
                or guides.object[j, i] != centre[y, x]
                or not _away(motion.previous, guides, j, i, px, py, pz) < np.float32(SAME_PLANE)
            ):
                vector[y, x, 0] = np.float32(np.nan)
                continue
            vector[y, x, 0], vector[y, x, 1] = qx - np.float32(x), qy - np.float32(y)
            for k in range(3):
                expected[y, x, k] += guides.position[j, i, k] - motion.previous[j, i, k]
