"""The environment map CDF: the power of each sampling cell, and the random numbers that are inverted to it.

A cell lies between the centres of four neighbouring texels, so that a lookup in it is one bilinear blend, by which
directions in the cell are drawn. Cells follow each other in Morton order, so that equal strata of a random number are
compact regions of equal power, which an alias table would scatter. That order goes through square blocks one after
another, which is how the work is divided among threads: results do not depend on their number.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ELEMENTS, over_range
from ...core.color import LUMINANCE

Array = np.ndarray

#: Cells at most; larger pictures are averaged down for sampling (never for the lookup).
_MOST_CELLS = 1 << 22
#: Blocks at most, and parts along a side of a block of which the power is known.
_MOST_BLOCKS, _PARTS = 512, 4
#: Texel rows that one thread filters at a time.
_STRIP = 32


class Cells:
    """Cells of a lat-long picture.

    Attributes
    ----------
    step : int
        Texels along a side of a place of `grid`.
    grid : (h / step, w / step) float32 array
        Luminance: of the texels, or means over step x step of them. Cells lie between its places' centres, in one row
        more, as those of the first and the last row end at the poles.
    edges : (rows + 1,) array
        z at the upper edge of each row of cells, from 1 to -1.
    runs : (k, 2) uint32 array
        Last random number that falls on a cell, and the cell; the lit cells in Morton order.
    guide : (2^b,) int32 array
        Where to start looking in `runs`, for equal slices of the random numbers.
    power : float
        Luminance integrated over all directions.
    shift : int
        Cells along a side of a block are 2^shift.
    block : (height, width) int32 array
        The block at a coarse place of the map.
    first : (n,) uint32 array
        First random number of each block that has light.
    parts : (p, n) float64 array
        Power of the parts of each block, row by row; all of them together 1.
    corners : (n, 2) int32 array
        Row and column of each block's first cell.

    Parameters
    ----------
    texels : (h, w, 4) float32 array
        Finite linear Rec.709 radiance; with a `step` of 1, `grid` is in the last place.
    """

    def __init__(self, texels: Array) -> None:
        h, w = texels.shape[:2]
        self.step = _step(h, w)
        height, columns = h // self.step, w // self.step
        self.grid = texels[:, :, 3] if self.step == 1 else np.zeros((height, columns), np.float32)
        red, green, blue = (float(weight) for weight in LUMINANCE)
        over_range(_measure, -(-height // _STRIP), texels, (red, green, blue), self.step, self.grid)
        rows = height + 1
        self.edges = np.cos(np.pi * np.clip((np.arange(rows + 1) - 0.5) / height, 0.0, 1.0))
        self.edges[0], self.edges[-1] = 1.0, -1.0
        self._solid = -np.diff(self.edges) * (2.0 * math.pi / columns)
        weights = np.zeros((rows, columns))
        over_range(_weigh, rows, self.grid, self._solid, weights, fewest=_STRIP)

        self.shift = 0
        while -(-height >> self.shift) * -(-columns >> self.shift) > _MOST_BLOCKS:
            self.shift += 1
        down, across = -(-rows >> self.shift), -(-columns >> self.shift)
        places = _morton_order(down, across)
        corners = (np.stack(np.divmod(places, across), axis=1) << self.shift).astype(np.int32)
        side = 1 << self.shift
        inner = np.stack(np.divmod(_morton_order(side, side), side), axis=1).astype(np.int32)
        coarse = max(0, self.shift - _PARTS.bit_length() + 1)
        parts = np.zeros((1 << 2 * (self.shift - coarse), len(places)))
        lit = np.zeros(len(places), np.int64)
        few = -(-ELEMENTS // len(inner))
        blocks = weights, corners, inner, coarse, self.shift - coarse, lit, parts
        over_range(_sum_blocks, len(corners), *blocks, fewest=few)
        self.power = float(parts.sum())
        if not self.power > 0.0:  # black: all alike, but for the density
            weights[:] = 1.0
            over_range(_sum_blocks, len(corners), *blocks, fewest=few)

        with_light = lit > 0
        self.corners, lit = corners[with_light], lit[with_light]
        self.parts = parts[:, with_light] / parts.sum()
        self.block = np.zeros((down, across), np.int32)
        self.block.ravel()[places[with_light]] = np.arange(len(lit))
        # Every cell gets one random number, and its share of the others.
        reached = np.append(0.0, np.cumsum(self.parts.sum(axis=0)))
        reached[-1] = 1.0
        before = np.append(0, np.cumsum(lit))
        spare = 2**32 - int(before[-1])
        starts = np.floor(reached * spare).astype(np.int64) + before
        self.first = starts[:-1].astype(np.uint32)
        self.runs = np.empty((int(before[-1]), 2), np.uint32)
        self.guide = np.zeros(1 << (rows * columns - 1).bit_length(), np.int32)
        dealt = _Blocks(self.corners, inner, before, reached, starts)
        scale = 1.0 / parts.sum()
        over_range(_deal, len(lit), weights, scale, spare, dealt, self.runs, self.guide, fewest=few)

    @property
    def density(self) -> Array:
        """(rows, columns) float64 probability of each cell by its solid angle; 0 everywhere when black."""
        found = np.zeros((len(self._solid), self.grid.shape[1]))
        if self.power > 0.0:
            found.ravel()[self.runs[:, 1]] = np.diff(self.runs[:, 0].astype(np.int64), prepend=-1) * 2.0**-32
        return found / self._solid[:, None]

    def part_directions(self) -> Array:
        """(4, p, n) float32 unit directions to the middles of `parts`, in the environment's frame, and solid angles."""
        rows, columns = len(self.edges) - 1, self.grid.shape[1]
        along = math.isqrt(len(self.parts))
        side = (1 << self.shift) // along
        row, column = np.stack(np.divmod(np.arange(len(self.parts)), along))[:, :, None] * side
        top, left = np.minimum(self.corners[:, 0] + row, rows), np.minimum(self.corners[:, 1] + column, columns)
        bottom, right = np.minimum(top + side, rows), np.minimum(left + side, columns)
        z = 0.5 * (self.edges[top] + self.edges[bottom])
        solid = (self.edges[top] - self.edges[bottom]) * (right - left) * (2 * np.pi / columns)
        turn = 0.5 - 0.5 * (left + right - 1) / columns
        ring = np.sqrt(np.maximum(0, 1 - z * z))
        return np.stack([ring * np.cos(2 * np.pi * turn), ring * np.sin(2 * np.pi * turn), z, solid]).astype(np.float32)


def _step(h: int, w: int) -> int:
    """Texels along a side of a cell: few enough cells, in whole numbers of texels; 1 where that cannot be."""
    for step in range(1, min(h, w) + 1):
        if (h // step) * (w // step) <= _MOST_CELLS and h % step == 0 and w % step == 0:
            return step
    return 1


@njit
def _morton_order(rows, columns):  # type: ignore[no-untyped-def]
    """Cells of a grid in the order of their interleaved index bits: neighbours in the grid stay near each other."""
    order = np.empty(rows * columns, np.int64)
    side = 1
    while side < max(rows, columns):
        side *= 2
    found = 0
    for code in range(side * side):
        row, column = np.uint32(code >> 1), np.uint32(code)
        row, column = row & np.uint32(0x55555555), column & np.uint32(0x55555555)
        row, column = (row | row >> np.uint32(1)), (column | column >> np.uint32(1))
        row, column = row & np.uint32(0x33333333), column & np.uint32(0x33333333)
        row, column = (row | row >> np.uint32(2)), (column | column >> np.uint32(2))
        row, column = row & np.uint32(0x0F0F0F0F), column & np.uint32(0x0F0F0F0F)
        row, column = (row | row >> np.uint32(4)), (column | column >> np.uint32(4))
        row, column = row & np.uint32(0x00FF00FF), column & np.uint32(0x00FF00FF)
        row, column = (
            (row | row >> np.uint32(8)) & np.uint32(0xFFFF),
            (column | column >> np.uint32(8)) & np.uint32(0xFFFF),
        )
        if row < rows and column < columns:
            order[found] = np.int64(row) * columns + np.int64(column)
            found += 1
    return order


@njit
def _luminance(texels, row, red, green, blue, out):  # type: ignore[no-untyped-def]
    for c in range(len(out)):
        out[c] = red * texels[row, c, 0] + green * texels[row, c, 1] + blue * texels[row, c, 2]


@njit
def _measure(first, last, texels, luminance, step, grid):  # type: ignore[no-untyped-def]
    """Write the luminance of strips of the grid.

    Of several texels it is their mean as the bilinear lookup has them, so that it is positive wherever a lookup is:
    over a texel, the mean of the interpolant is three quarters of itself and an eighth of either neighbour, along both
    axes; columns wrap, rows clamp.
    """
    h, w = texels.shape[:2]
    red, green, blue = luminance
    upper, here, lower = np.empty(w), np.empty(w), np.empty(w)
    total = np.empty(grid.shape[1])
    for row in range(first * _STRIP, min(last * _STRIP, len(grid))):
        total[:] = 0.0
        for y in range(row * step, (row + 1) * step):
            _luminance(texels, y, red, green, blue, here)
            if step > 1:
                _luminance(texels, max(y - 1, 0), red, green, blue, upper)
                _luminance(texels, min(y + 1, h - 1), red, green, blue, lower)
                for x in range(w):
                    upper[x] = 0.75 * here[x] + 0.125 * (upper[x] + lower[x])
                for x in range(w):
                    before, after = upper[x - 1 if x else w - 1], upper[x + 1 if x + 1 < w else 0]
                    here[x] = 0.75 * upper[x] + 0.125 * (before + after)
            for x in range(len(total) * step):
                total[x // step] += here[x]
        for column in range(len(total)):
            grid[row, column] = total[column] / (step * step)


@njit
def _weigh(first, last, grid, solid, weights):  # type: ignore[no-untyped-def]
    """Write to each cell its solid angle times the mean of the luminance at its corners."""
    height, columns = grid.shape
    for row in range(first, last):
        upper, lower = max(row - 1, 0), min(row, height - 1)
        for c in range(columns):
            b = c - 1 if c else columns - 1
            left = np.float64(grid[upper, b]) + np.float64(grid[lower, b])
            right = np.float64(grid[upper, c]) + np.float64(grid[lower, c])
            weights[row, c] = 0.25 * (left + right) * solid[row]


@njit
def _sum_blocks(first, last, weights, corners, inner, coarse, bits, lit, parts):  # type: ignore[no-untyped-def]
    """Count the lit cells of each block and sum the power of its parts, which are 2^coarse cells wide."""
    rows, columns = weights.shape
    for b in range(first, last):
        lit[b] = 0
        parts[:, b] = 0.0
        for k in range(len(inner)):
            row, column = corners[b, 0] + inner[k, 0], corners[b, 1] + inner[k, 1]
            if row < rows and column < columns and weights[row, column] > 0.0:
                lit[b] += 1
                parts[((inner[k, 0] >> coarse) << bits) + (inner[k, 1] >> coarse), b] += weights[row, column]


class _Blocks(NamedTuple):
    """The blocks that have light, in their order.

    Attributes
    ----------
    corners : (n, 2) int32 array
        `Cells.corners`.
    inner : (k, 2) int32 array
        Cells of a block by row and column from there, in their order.
    before : (n + 1,) int64 array
        Lit cells before each block, and in all.
    reached : (n + 1,) float64 array
        Power of all blocks before each one; at last 1.
    starts : (n + 1,) int64 array
        First random number of each block; at last 2^32.
    """

    corners: Array
    inner: Array
    before: Array
    reached: Array
    starts: Array


@njit
def _deal(first, last, weights, scale, spare, blocks, runs, guide):  # type: ignore[no-untyped-def]
    """Divide the random numbers of each block among its lit cells.

    Parameters
    ----------
    weights : array
        Power of each cell, `scale` times which all are 1 together.
    spare : int
        Random numbers beyond one for each lit cell.
    blocks : _Blocks
    runs, guide : array
        Of `Cells`; written.
    """
    corners, inner, before, reached, starts = blocks
    rows, columns = weights.shape
    width = (np.int64(1) << 32) // len(guide)
    for b in range(first, last):
        i, start, sum_ = before[b], starts[b], reached[b]
        for k in range(len(inner)):
            row, column = corners[b, 0] + inner[k, 0], corners[b, 1] + inner[k, 1]
            if row < rows and column < columns and weights[row, column] > 0.0:
                sum_ = min(sum_ + weights[row, column] * scale, reached[b + 1])
                i += 1
                end = starts[b + 1] if i == before[b + 1] else np.int64(sum_ * spare) + i
                runs[i - 1, 0] = np.uint32(end - 1)
                runs[i - 1, 1] = np.uint32(row * columns + column)
                for slice_ in range((start + width - 1) // width, (end - 1) // width + 1):
                    guide[slice_] = i - 1
                start = end
