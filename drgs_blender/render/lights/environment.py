"""The environment light (environment map): radiance from a direction, and directions in proportion to radiance.

The density is the luminance of the bilinear lookup over the power: small suns, which are slopes between few texels,
bring the same whichever direction towards them is drawn. Only in the height above a texel's centre both differ by a
trifle, as the lookup is linear in the angle and the density in z, which makes it finite at the poles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit, plain
from ...compute.threads import ROWS, over_range
from ...core.asset.model import as_float
from ...core.errors import UsageError
from ...core.frame import World
from ..memory import AddressOf, address, load_float, load_int32, load_uint32
from ..sampling import fast_acos, fast_atan2_turns, sincos_turns, unit
from .environment_cdf import Cells
from .product_sampling import ProductTables, block_of, in_cells_order, product_ratio, product_row

Array = np.ndarray

#: Radiance above this is cut: its square is still a float32.
BRIGHTEST = np.float32(1e15)
#: An environment of less power, integrated over all directions, is black: one over it is no float32, or hardly.
_DARKEST = 1e-30
#: Largest strength of an environment, that of Blender's Background node.
STRONGEST = 1e6

#: A constant world as a picture: fine enough to be sampled as a surface faces it.
_CONSTANT = (16, 32, 3)
#: Negative light, as a part of all light, up to which it is the ringing of a picture's filter.
_RINGING = 1e-5


@njit
def _clean(first, last, image, tint, rings, texels, found):  # type: ignore[no-untyped-def]
    """Write the tinted picture: black where a texel is no light, but for its negative part if the picture `rings`.

    Writes for each row how many texels are no light, and how much of them is negative and positive.
    """
    zero = np.float32(0.0)
    for row in range(first, last):
        bad, dark, bright = 0, 0.0, 0.0
        for column in range(image.shape[1]):
            r, g, b = image[row, column, 0] * tint[0], image[row, column, 1] * tint[1], image[row, column, 2] * tint[2]
            if not (abs(r) < np.inf and abs(g) < np.inf and abs(b) < np.inf):
                bad += 1
                dark = -np.inf
                continue
            dark += min(r, zero) + min(g, zero) + min(b, zero)
            bright += max(r, zero) + max(g, zero) + max(b, zero)
            if min(r, g, b) >= zero or rings:
                texels[row, column, 0] = min(max(r, zero), BRIGHTEST)
                texels[row, column, 1] = min(max(g, zero), BRIGHTEST)
                texels[row, column, 2] = min(max(b, zero), BRIGHTEST)
            else:
                bad += 1
        found[row, 0], found[row, 1], found[row, 2] = bad, dark, bright


class EnvMap(NamedTuple):
    """An `EnvironmentLight` for compiled code: addresses of its arrays, their sizes, and its rotation row by row."""

    texels: int
    height: int
    width: int
    cells: int
    guide: int
    guide_size: int
    row_z: int
    grid: int
    stride: int
    rows: int
    columns: int
    scale: np.float32
    starts: int
    slices: int
    ratio: int
    first: int
    block: int
    blocks: int
    block_columns: int
    shift: int
    xx: np.float32
    xy: np.float32
    xz: np.float32
    yx: np.float32
    yy: np.float32
    yz: np.float32
    zx: np.float32
    zy: np.float32
    zz: np.float32


#: The fields of an `EnvMap` that are its rotation: they may change while its arrays stay where they are.
ROTATION = ("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz")


class EnvironmentLight:
    """A `World` made ready for lookups and sampling by compiled code.

    Attributes
    ----------
    texels : (h, w, 4) float32 array
        Lat-long radiance times colour and strength, linear Rec.709, and in the last place its luminance, if that is the
        grid of the cells: one cache line serves both.
    cells : Cells
        The cells in which it is sampled.
    row_z : (rows + 1,) float32 array
        z at the upper edge of each row of cells, from 1 to -1.
    product : ProductTables
        The cells weighed by the cosine at a surface.
    rotation : (3, 3) float32 array
        World direction to environment direction.
    bad_texels : int
        NaN, infinite or negative texels, taken as black; not those of filters that ring, whose negative values are 0.
    negative_colour : bool
        Whether a part of the world's colour is negative, taken as 0.
    """

    def __init__(self, world: World) -> None:
        if world.environment is None:
            image = np.ones(_CONSTANT, np.float32)
        else:
            image = as_float(world.environment, (-1, -1, 3), "environment")
            if image.size == 0:
                raise UsageError("environment", "has no pixels", "Choose another picture or a colour")
        rotation = np.asarray(world.rotation, np.float64).reshape(3, 3)
        tint = np.asarray(world.colour, np.float64) * float(world.strength)
        if not (np.isfinite(rotation).all() and np.isfinite(tint).all()):
            raise UsageError("world", "has a colour, strength or rotation that is not finite", "Check its settings")
        if not 0.0 <= world.strength <= STRONGEST:
            raise UsageError(
                "environment", f"its strength is {world.strength:g}", f"The strength must be from 0 to {STRONGEST:g}"
            )
        self.texels = np.zeros((*image.shape[:2], 4), np.float32)
        found = np.zeros((len(image), 3))
        self.negative_colour = bool((tint < 0).any())
        with np.errstate(over="ignore"):
            tinted = np.maximum(tint, 0.0).astype(np.float32)
        over_range(_clean, len(self.texels), plain(image), tinted, False, self.texels, found, fewest=ROWS)
        bad, dark, bright = found.sum(axis=0)
        if bad and dark > -_RINGING * bright:
            over_range(_clean, len(self.texels), plain(image), tinted, True, self.texels, found, fewest=ROWS)
            bad = 0
        self.bad_texels = int(bad)
        self.rotation = np.ascontiguousarray(rotation, np.float32)
        self.cells = Cells(self.texels)
        if 0.0 < self.cells.power < _DARKEST:
            self.texels[:] = 0.0
            self.cells = Cells(self.texels)
        self.row_z = self.cells.edges.astype(np.float32)
        self.product = ProductTables(self.cells)

    @property
    def black(self) -> bool:
        """No light at all."""
        return not self.cells.power > 0.0

    @property
    def envmap(self) -> EnvMap:
        """Environment map for compiled code; valid while this light lives and its rotation is not replaced."""
        return self.envmap_at(address)

    def envmap_at(self, address_of: AddressOf) -> EnvMap:
        """`envmap` of arrays that lie elsewhere."""
        height, width = self.texels.shape[:2]
        cells, product = self.cells, self.product
        texels = address_of(self.texels)
        one = cells.step == 1
        return EnvMap(
            texels,
            height,
            width,
            address_of(cells.runs),
            address_of(cells.guide),
            len(cells.guide),
            address_of(self.row_z),
            texels + 3 * self.texels.itemsize if one else address_of(cells.grid),
            4 if one else 1,
            cells.grid.shape[0],
            cells.grid.shape[1],
            np.float32(1.0 / cells.power if cells.power > 0.0 else 0.0),
            address_of(product.starts),
            address_of(product.slices),
            address_of(product.ratio),
            address_of(product.first),
            address_of(cells.block),
            len(product.first),
            cells.block.shape[1],
            cells.shift,
            *self.rotation.ravel(),
        )

    @property
    def power(self) -> float:
        """Luminance integrated over all directions."""
        return self.cells.power

    def lookup(self, directions: Array) -> Array:
        """(n, 3) radiance from (n, 3) unit world directions."""
        return _lookup_many(np.ascontiguousarray(directions, np.float32), self.envmap)

    def pdf(self, directions: Array, normal: Array | None = None) -> Array:
        """(n,) density per solid angle with which ``sample`` draws (n, 3) unit world directions."""
        directions = np.ascontiguousarray(directions, np.float32)
        return _pdf_many(directions, self._rows(normal, len(directions)), self.envmap)

    def sample(self, numbers: Array, normal: Array | None = None) -> tuple[Array, Array]:
        """World directions (n, 3) and densities (n,) from (n, 3) uint32 random numbers.

        `normal`, unit world vectors (3,) or (n, 3), is that of the surface which is to be lit; None is of no surface.
        """
        return _sample_many(np.ascontiguousarray(numbers, np.uint32), self._rows(normal, len(numbers)), self.envmap)

    def _rows(self, normal: Array | None, count: int) -> Array:
        if normal is None:
            return np.full(count, len(self.product.ratio) - 1, np.int32)
        return _rows_many(np.broadcast_to(np.asarray(normal, np.float32), (count, 3)), self.envmap)


@njit
def map_at(dx, dy, dz, envmap):  # type: ignore[no-untyped-def]
    """Lat-long coordinates in the environment map of a world direction; row 0 at +Z, +X at u = 1/2.

    Parameters
    ----------
    dx, dy, dz : float32
        Unit, world.
    envmap : EnvMap

    Returns
    -------
    u, v : float32
        In [0, 1].
    """
    x = envmap.xx * dx + envmap.xy * dy + envmap.xz * dz
    y = envmap.yx * dx + envmap.yy * dy + envmap.yz * dz
    z = envmap.zx * dx + envmap.zy * dy + envmap.zz * dz
    return np.float32(0.5) - fast_atan2_turns(y, x), fast_acos(z) * np.float32(1.0 / math.pi)


@njit
def height_in_map(dx, dy, dz, envmap):  # type: ignore[no-untyped-def]
    """z of a world direction in the environment's frame, for `envmap_pdf`.

    Parameters
    ----------
    dx, dy, dz : float32
        Unit, world.
    envmap : EnvMap

    Returns
    -------
    float32
    """
    return envmap.zx * dx + envmap.zy * dy + envmap.zz * dz


@njit
def envmap_pdf(u, v, z, product, envmap):  # type: ignore[no-untyped-def]
    """The pdf per solid angle of environment sampling (PBRT 12.5), at a surface.

    Parameters
    ----------
    u, v, z : float32
        Lat-long coordinates of the direction, in [0, 1], and `height_in_map`.
    product : int32
        `product_row` of the surface's normal.
    envmap : EnvMap

    Returns
    -------
    float32
        sr^-1.
    """
    one, half = np.float32(1.0), np.float32(0.5)
    x = u * np.float32(envmap.columns) + half
    row = min(np.int64(v * np.float32(envmap.rows) + half), np.int64(envmap.rows))
    column = np.int64(x)
    upper, lower = load_float(envmap.row_z, row), load_float(envmap.row_z, row + 1)
    t = min(max((upper - z) / (upper - lower), np.float32(0.0)), one)
    s = min(x - np.float32(column), one)
    column = column if column < envmap.columns else 0
    a, b, c, d = _corners(row, column, envmap)
    upper, lower = (one - s) * a + s * b, (one - s) * c + s * d
    return ((one - t) * upper + t * lower) * envmap.scale * product_ratio(product, row, column, envmap)


@njit
def _corners(row, column, envmap):  # type: ignore[no-untyped-def]
    """Luminance at the corners of a cell: upper left, upper right, lower left, lower right."""
    upper, lower = max(row - 1, 0) * envmap.columns, min(row, envmap.rows - 1) * envmap.columns
    left = column - 1 if column > 0 else envmap.columns - 1
    grid, stride = envmap.grid, envmap.stride
    return (
        load_float(grid, stride * (upper + left)),
        load_float(grid, stride * (upper + column)),
        load_float(grid, stride * (lower + left)),
        load_float(grid, stride * (lower + column)),
    )


@njit
def envmap_radiance(u, v, envmap):  # type: ignore[no-untyped-def]
    """Radiance of the environment: bilinear lookup, wrapped in u and clamped in v.

    Parameters
    ----------
    u, v : float32
        Lat-long coordinates of the direction, in [0, 1].
    envmap : EnvMap

    Returns
    -------
    r, g, b : float32
        Linear Rec.709.
    """
    h, w = envmap.height, envmap.width
    x, y = u * np.float32(w) - np.float32(0.5), v * np.float32(h) - np.float32(0.5)
    y = min(max(y, np.float32(0.0)), np.float32(h - 1))
    c0, r0 = np.int64(x + np.float32(1.0)) - 1, np.int64(y)
    a, b = x - np.float32(c0), y - np.float32(r0)
    c1 = c0 + 1 if c0 + 1 < w else 0
    c0 = w - 1 if c0 < 0 else c0
    r1 = min(r0 + 1, h - 1)
    one = np.float32(1.0)
    p00, p01, p10, p11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
    i00, i01, i10, i11 = 4 * (r0 * w + c0), 4 * (r0 * w + c1), 4 * (r1 * w + c0), 4 * (r1 * w + c1)
    t = envmap.texels
    red = p00 * load_float(t, i00) + p01 * load_float(t, i01) + p10 * load_float(t, i10) + p11 * load_float(t, i11)
    i00, i01, i10, i11 = i00 + 1, i01 + 1, i10 + 1, i11 + 1
    green = p00 * load_float(t, i00) + p01 * load_float(t, i01) + p10 * load_float(t, i10) + p11 * load_float(t, i11)
    i00, i01, i10, i11 = i00 + 1, i01 + 1, i10 + 1, i11 + 1
    blue = p00 * load_float(t, i00) + p01 * load_float(t, i01) + p10 * load_float(t, i10) + p11 * load_float(t, i11)
    return red, green, blue


@njit
def envmap_touch(u, v, envmap):  # type: ignore[no-untyped-def]
    """Prefetch: a value from both rows of texels that `envmap_radiance` will read, to bring them into the cache.

    Parameters
    ----------
    u, v : float32
        Lat-long coordinates of the direction, in [0, 1].
    envmap : EnvMap

    Returns
    -------
    float32
        Of no meaning; to be stored, so that the reads take place.
    """
    h, w = envmap.height, envmap.width
    y = min(max(v * np.float32(h) - np.float32(0.5), np.float32(0.0)), np.float32(h - 1))
    column, row = min(np.int64(u * np.float32(w)), w - 1), np.int64(y)
    upper, lower = 4 * (row * w + column), 4 * (min(row + 1, h - 1) * w + column)
    return load_float(envmap.texels, upper) + load_float(envmap.texels, lower)


@njit
def first_cell(n, envmap):  # type: ignore[no-untyped-def]
    """Sampling cell where the search for a random number in the CDF starts.

    Parameters
    ----------
    n : uint32
        Random number, from `in_cells_order`.
    envmap : EnvMap

    Returns
    -------
    int32
        Place of the cell in their Morton order.
    """
    return load_int32(envmap.guide, np.int64((np.uint64(n) * np.uint64(envmap.guide_size)) >> np.uint64(32)))


@njit
def cell_end(cell_index, envmap):  # type: ignore[no-untyped-def]
    """CDF of the sampling cells: the last random number that falls on a cell.

    Parameters
    ----------
    cell_index : int
        Place of the cell in their Morton order.
    envmap : EnvMap

    Returns
    -------
    uint32
    """
    return load_uint32(envmap.cells, 2 * np.int64(cell_index))


@njit
def cell_at(cell_index, envmap):  # type: ignore[no-untyped-def]
    """A sampling cell, for `direction_in_cell`.

    Parameters
    ----------
    cell_index : int
        Place of the cell in their Morton order.
    envmap : EnvMap

    Returns
    -------
    column : int64
        Of the cell among cells.
    upper, lower : float32
        z of the upper and lower edge of its row, in the environment's frame.
    a, b, c, d : float32
        Luminance at its corners: upper left, upper right, lower left, lower right.
    """
    cell = np.int64(load_uint32(envmap.cells, 2 * np.int64(cell_index) + 1))
    row, column = cell // envmap.columns, cell % envmap.columns
    a, b, c, d = _corners(row, column, envmap)
    return column, load_float(envmap.row_z, row), load_float(envmap.row_z, row + 1), a, b, c, d


@inlined
def _on_slope(number, start, end):  # type: ignore[no-untyped-def]
    """Place in [0, 1] of a random number, in proportion to what goes from `start` to `end` there (PBRT A.5.1)."""
    root = math.sqrt(start * start + number * (end * end - start * start))
    return min(number * (start + end) / max(start + root, np.float32(1e-37)), np.float32(1.0))


@njit
def direction_in_cell(column, upper, lower, corners, n0, n1, envmap):  # type: ignore[no-untyped-def]
    """Direction in the solid angle of a cell, in proportion to the blend of its corners' luminance.

    Parameters
    ----------
    column : int
        Of the cell.
    upper, lower : float32
        z of its edges, see `cell_at`.
    corners : tuple of float32
        Luminance, see `cell_at`.
    n0, n1 : uint32
        Random numbers: azimuth, z.
    envmap : EnvMap

    Returns
    -------
    dx, dy, dz : float32
        Unit, world.
    u, v : float32
        Lat-long coordinates, in [0, 1].
    density : float32
        Pdf per solid angle without regard to a normal, sr^-1.
    """
    a, b, c, d = corners
    one = np.float32(1.0)
    t = _on_slope(unit(n1), a + b, c + d)
    left, right = (one - t) * a + t * c, (one - t) * b + t * d
    s = _on_slope(unit(n0), left, right)
    u = (np.float32(column) + s - np.float32(0.5)) / np.float32(envmap.columns)
    u = u if u >= np.float32(0.0) else u + one
    z = upper + t * (lower - upper)
    sine, cosine = sincos_turns(np.float32(0.5) - u)
    ring = math.sqrt(max(np.float32(0.0), one - z * z))
    x, y = ring * cosine, ring * sine
    dx = envmap.xx * x + envmap.yx * y + envmap.zx * z
    dy = envmap.xy * x + envmap.yy * y + envmap.zy * z
    dz = envmap.xz * x + envmap.yz * y + envmap.zz * z
    density = ((one - s) * left + s * right) * envmap.scale
    return dx, dy, dz, u, fast_acos(z) * np.float32(1.0 / math.pi), density


@njit
def _lookup_many(directions, envmap):  # type: ignore[no-untyped-def]
    out = np.empty((len(directions), 3), np.float32)
    for i in range(len(directions)):
        u, v = map_at(directions[i, 0], directions[i, 1], directions[i, 2], envmap)
        out[i, 0], out[i, 1], out[i, 2] = envmap_radiance(u, v, envmap)
    return out


@njit
def _rows_many(normals, envmap):  # type: ignore[no-untyped-def]
    out = np.empty(len(normals), np.int32)
    for i in range(len(normals)):
        out[i] = product_row(normals[i, 0], normals[i, 1], normals[i, 2], envmap)
    return out


@njit
def _pdf_many(directions, product, envmap):  # type: ignore[no-untyped-def]
    out = np.empty(len(directions), np.float32)
    for i in range(len(directions)):
        u, v = map_at(directions[i, 0], directions[i, 1], directions[i, 2], envmap)
        z = height_in_map(directions[i, 0], directions[i, 1], directions[i, 2], envmap)
        out[i] = envmap_pdf(u, v, z, product[i], envmap)
    return out


@njit
def _sample_many(numbers, product, envmap):  # type: ignore[no-untyped-def]
    n = len(numbers)
    directions, pdf = np.empty((n, 3), np.float32), np.empty(n, np.float32)
    for i in range(n):
        number, ratio = in_cells_order(
            product[i], block_of(product[i], numbers[i, 0], envmap), numbers[i, 0], numbers[i, 1], envmap
        )
        cell_index = first_cell(number, envmap)
        while number > cell_end(cell_index, envmap):
            cell_index += 1
        column, upper, lower, a, b, c, d = cell_at(cell_index, envmap)
        dx, dy, dz, _, _, density = direction_in_cell(
            column, upper, lower, (a, b, c, d), numbers[i, 1], numbers[i, 2], envmap
        )
        directions[i, 0], directions[i, 1], directions[i, 2] = dx, dy, dz
        pdf[i] = density * ratio
    return directions, pdf
