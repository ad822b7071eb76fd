"""Which points of a picture keep the light of the one before it, so that no rays are spent on them.

While only the camera moves, light on surfaces stays, but for reflections. Then a picture traces the pixels that have
just come into view, and of the others every second one, as the white squares of a chessboard; the next picture traces
the black ones. The rest have no light of their own, NaN, and `svgf_temporal` gives them their past. Light of few
samples is not kept: a dark one would stay a blotch until the next.
"""

from __future__ import annotations

import math

import numpy as np

from ...compute.jit import njit, plain
from ...compute.threads import ELEMENTS, over_range
from ..film.motion_vectors import project
from ..gbuffer.gbuffer import GBuffer
from ..sampling import F
from ..shading_points import CATCHER, SECOND, UNLIT
from .demodulation import PAD, SOURCE, Signal
from .svgf_reprojection import is_same_surface

Array = np.ndarray

#: Pictures that have to go into a pixel's light before it is kept.
SETTLED = 3


def to_trace(
    buffer: GBuffer,
    numbers: Array,
    past: Signal,
    cameras: tuple[Array, Array],
    turn: int,
    corner: tuple[int, int, int],
    ages: tuple[Array, Array],
) -> Array:
    """Points of a picture with one sample a pixel that need light of their own.

    Parameters
    ----------
    buffer : GBuffer
        Of a scene in which nothing has moved since the last picture but the camera.
    numbers : (objects,) int32 array
        `ObjectNumbers.name`.
    past : Signal
        The last picture's.
    cameras : tuple of (PARAMETERS,) float64 array
        `camera.camera_parameters` of this picture and of the last.
    turn : int
        Odd for every second picture: which half of the pixels is traced.
    corner : tuple of int
        First column and row of the window, and columns of the whole picture.
    ages : tuple of (h, w) uint8 array
        How many pictures have gone into the light of each pixel of the last picture, and of this one, which is written.

    Returns
    -------
    (n,) bool array
    """
    points = buffer.points
    chosen = np.empty(len(points), np.bool_)
    keys = points.pixel, points.flags, buffer.object_index, buffer.position, points.normal
    given = keys, plain(numbers), past.guide, cameras, turn % 2, corner, ages
    over_range(_choose, len(points), *given, chosen, fewest=ELEMENTS)
    return chosen


@njit
def _choose(first, last, keys, numbers, guide, cameras, turn, corner, ages, out):  # type: ignore[no-untyped-def]
    pixel, flags, owner, position, normal = keys
    left, top, width = corner
    now, then = cameras
    before, age = ages
    rows, columns = guide.shape[0], guide.shape[2] - 2 * PAD
    for i in range(first, last):
        out[i] = True
        row, column = pixel[i] // width, pixel[i] % width
        age[row - top, column - left] = 1
        if flags[i] & (CATCHER | SECOND | UNLIT):
            continue
        if (i > 0 and pixel[i - 1] == pixel[i]) or (i + 1 < len(pixel) and pixel[i + 1] == pixel[i]):
            continue
        x, y, z = np.float64(position[i, 0]), np.float64(position[i, 1]), np.float64(position[i, 2])
        ax, ay, _ = project(now, x, y, z)
        bx, by, depth = project(then, x, y, z)
        # The nearest of the four pixels that `look_up_pixel` asks, all of which may be of another surface.
        px, py = column - left + (bx - ax) + 0.5, row - top + (by - ay) + 0.5
        # A comparison that NaN fails too.
        if not (depth > 0.0 and px >= 0.0 and py >= 0.0 and px < columns and py < rows):
            continue
        yy, c = np.int64(math.floor(py)), np.int64(math.floor(px)) + PAD
        if guide[yy, SOURCE, c] != F(numbers[owner[i]]):
            continue
        ox, oy, oz = position[i, 0], position[i, 1], position[i, 2]
        if not is_same_surface(guide, yy, c, ox, oy, oz, normal[i, 0], normal[i, 1], normal[i, 2]):
            continue
        known = before[yy, c - PAD]
        out[i] = (row + column + turn) % 2 == 0 or known < SETTLED
        age[row - top, column - left] = min(known + 1, SETTLED)
