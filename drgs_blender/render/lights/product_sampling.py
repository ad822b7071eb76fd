"""Product sampling: the environment times the cosine, tabulated for some hundred normals.

For each of them a table holds the power of each block of cells times the mean cosine towards it (Clarberg et al. 2005),
less what other samples of the surface find anyway (MIS compensation, Karlik et al. 2019), mixed with the power alone,
so that whatever shines can be drawn. Surfaces use the table of the nearest normal; its pdf is exact whatever their own
normal is. Blocks are runs of the cells' Morton order: a random number is first moved to the block's run, then inverted
as without the tables.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ...compute.threads import over_range
from ..memory import load_float, load_int32, load_uint32
from .environment_cdf import Cells

Array = np.ndarray

#: Normals along a side of the octahedral map.
SIDE = 24
#: Equal slices of the random numbers, each of 2^_SLICE of them, for which the first block is known.
_SLICES, _SLICE = 256, 24
#: Part of the random numbers that keeps to the power alone.
_KEPT = 0.05
#: Part of what a surface would get of an even sky that is left to its other samples.
_COVERED = 0.15


def normals() -> Array:
    """(SIDE^2, 3) float32 unit normals of the tables, see `product_row`."""
    v, u = np.meshgrid(*[(np.arange(SIDE) + 0.5) / SIDE * 2 - 1] * 2, indexing="ij")
    z = 1 - abs(u) - abs(v)
    fold = np.maximum(-z, 0)
    n = np.stack([u - np.copysign(fold, u), v - np.copysign(fold, v), z], axis=-1).reshape(-1, 3)
    return (n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)


@njit
def product_row(nx, ny, nz, envmap):  # type: ignore[no-untyped-def]
    """Row of the tables whose normal is nearest in the octahedral map.

    Parameters
    ----------
    nx, ny, nz : float32
        Shading normal, unit, world.
    envmap : EnvMap

    Returns
    -------
    int32
        0 to SIDE^2 - 1.
    """
    x = envmap.xx * nx + envmap.xy * ny + envmap.xz * nz
    y = envmap.yx * nx + envmap.yy * ny + envmap.yz * nz
    z = envmap.zx * nx + envmap.zy * ny + envmap.zz * nz
    one = np.float32(1.0)
    scale = one / max(abs(x) + abs(y) + abs(z), np.float32(1e-20))
    x, y, z = x * scale, y * scale, z * scale
    fold = max(-z, np.float32(0.0))
    x, y = x + (fold if x >= 0 else -fold), y + (fold if y >= 0 else -fold)
    half = np.float32(0.5 * SIDE)
    column = np.int32(min(max(x + one, np.float32(0.0)) * half, np.float32(SIDE - 1)))
    row = np.int32(min(max(y + one, np.float32(0.0)) * half, np.float32(SIDE - 1)))
    return row * np.int32(SIDE) + column


class ProductTables:
    """The tables.

    Attributes
    ----------
    starts : (SIDE^2 + 1, 2^b) uint32 array
        First random number of each block as each normal has it, the last row without regard to a normal; filled up with
        the largest number.
    slices : (SIDE^2 + 1, _SLICES) int32 array
        Block of the first number of each slice of the random numbers.
    ratio : (SIDE^2 + 1, 2^b) float32 array
        Density of a block's cells over that without regard to the normal.
    first : (2^b,) uint32 array
        First random number of each block in the cells' own order.

    Parameters
    ----------
    cells : Cells
        Sampling cells that the tables reweight.
    """

    def __init__(self, cells: Cells) -> None:
        blocks = len(cells.first)
        size = 1 << (blocks - 1).bit_length()
        self.first = np.zeros(size, np.uint32)
        self.first[:blocks] = cells.first
        self.starts = np.full((SIDE * SIDE + 1, size), 2**32 - 1, np.uint32)
        self.ratio = np.ones((SIDE * SIDE + 1, size), np.float32)
        power = np.diff(cells.first.astype(np.int64), append=1 << 32) * 2.0**-32
        share = cells.parts.astype(np.float32) if cells.power > 0.0 else np.zeros_like(cells.parts, np.float32)
        rows = normals()
        over_range(_fill, len(rows), rows, cells.part_directions(), share, power, self.starts, self.ratio)
        self.starts[-1, :blocks] = cells.first
        self.slices = np.empty((SIDE * SIDE + 1, _SLICES), np.int32)
        over_range(_find_slices, len(self.starts), self.starts, blocks, self.slices)


@njit
def _fill(first, last, normals, directions, share, power, starts, ratio):  # type: ignore[no-untyped-def]
    """Write all rows but the last."""
    parts, blocks = share.shape
    x, y, z, solid = directions[0], directions[1], directions[2], directions[3]
    for row in range(first, last):
        weight, covered = np.zeros(blocks, np.float32), np.zeros(blocks, np.float32)
        nx, ny, nz = normals[row, 0], normals[row, 1], normals[row, 2]
        for p in range(parts):
            for b in range(blocks):
                cosine = nx * x[p, b] + ny * y[p, b] + nz * z[p, b]
                weight[b] += share[p, b] * max(cosine, np.float32(0.0))
                covered[b] += solid[p, b] * max(cosine, np.float32(0.0))
        facing, total = 0.0, 0.0
        for b in range(blocks):
            facing += weight[b]
        for b in range(blocks):
            weight[b] = max(weight[b] - np.float32(_COVERED * facing / np.pi) * covered[b], np.float32(0.0))
            total += weight[b]
        kept = _KEPT if total > 0.0 else 1.0
        scale = (1.0 - kept) / total if total > 0.0 else 0.0
        # Every block gets one random number, and its share of the others.
        spare = 2.0**32 - blocks
        reached, start = 0.0, np.int64(0)
        for b in range(blocks):
            reached += kept * power[b] + scale * weight[b]
            end = np.int64(min(reached, 1.0) * spare) + b + 1 if b + 1 < blocks else np.int64(1 << 32)
            starts[row, b] = np.uint32(start)
            ratio[row, b] = (end - start) / (power[b] * 2.0**32)
            start = end


@njit
def _find_slices(first, last, starts, blocks, slices):  # type: ignore[no-untyped-def]
    for row in range(first, last):
        block = 0
        for k in range(_SLICES):
            while block + 1 < blocks and np.int64(starts[row, block + 1]) <= k << _SLICE:
                block += 1
            slices[row, k] = block


@njit
def block_of(row, n, envmap):  # type: ignore[no-untyped-def]
    """Block of cells on which a random number falls: the CDF of one row of the tables, inverted.

    Parameters
    ----------
    row : int
        `product_row`.
    n : uint32
        Random number.
    envmap : EnvMap

    Returns
    -------
    int64
    """
    n = min(np.uint32(n), np.uint32(2**32 - 2))  # the largest number fills the rows up
    base = np.int64(row) * np.int64(envmap.blocks)
    place = np.int64(load_int32(envmap.slices, np.int64(row) * _SLICES + (np.int64(n) >> _SLICE)))
    while place + 1 < envmap.blocks and load_uint32(envmap.starts, base + place + 1) <= n:
        place += 1
    return place


@njit
def in_cells_order(row, block, n, below, envmap):  # type: ignore[no-untyped-def]
    """Random number n, which fell on a block, among those of the block's cells; and the row's ratio there.

    `below` (uint32) stands behind n's last digit: where a block's run grows, all its cells stay reachable.

    Parameters
    ----------
    row : int
        `product_row`.
    block : int64
        `block_of` the two.
    n, below : uint32
        Random numbers.
    envmap : EnvMap

    Returns
    -------
    number : uint32
        For `environment.first_cell`.
    ratio : float32
        Factor of the pdf, see `product_ratio`.
    """
    place = np.int64(row) * np.int64(envmap.blocks) + block
    ratio = load_float(envmap.ratio, place)
    into = np.float64(n - load_uint32(envmap.starts, place)) + np.float64(below) * 2.0**-32
    start = np.int64(load_uint32(envmap.first, block))
    end = np.int64(load_uint32(envmap.first, block + 1)) if block + 1 < envmap.blocks else np.int64(1 << 32)
    end = end if end > start else np.int64(1 << 32)
    return np.uint32(min(start + np.int64(into / np.float64(ratio)), end - 1)), ratio


@njit
def product_ratio(row, cell_row, cell_column, envmap):  # type: ignore[no-untyped-def]
    """Pdf of product sampling over that without a normal, in a cell.

    Parameters
    ----------
    row : int
        `product_row`.
    cell_row, cell_column : int64
        Of the cell among cells.
    envmap : EnvMap

    Returns
    -------
    float32
    """
    place = (np.int64(cell_row) >> envmap.shift) * envmap.block_columns + (np.int64(cell_column) >> envmap.shift)
    return load_float(envmap.ratio, np.int64(row) * np.int64(envmap.blocks) + np.int64(load_int32(envmap.block, place)))
