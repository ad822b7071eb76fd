"""The tiles of a tiled (UDIM) image side by side in one picture, and where that lies.

Tile 1001 + c + 10 r covers [c, c + 1] x [r, r + 1]. As in Cycles, places without a tile are magenta. Around the grid is
a ring of one texel that continues each tile by the extension, so that a lookup at its very edge blends with what Cycles
blends it with, and one of magenta. Between neighbours, Cycles blends each tile with itself over the last half texel; in
the grid they blend with each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from ...drgs_blender.core.color import srgb_to_linear
from ...drgs_blender.core.materials import Image

Array = np.ndarray

#: Bytes of the picture at most: eight tiles of 4096 x 4096 in 8 bits.
BUDGET = 1 << 29
RING = 2
MAGENTA = (1.0, 0.0, 1.0, 1.0)


def cells(numbers: list[int]) -> tuple[int, int, int, int]:
    """First column, first row, columns and rows of the grid that holds the tiles `numbers`."""
    columns, rows = [(n - 1001) % 10 for n in numbers], [(n - 1001) // 10 for n in numbers]
    return min(columns), min(rows), max(columns) - min(columns) + 1, max(rows) - min(rows) + 1


def grid(pictures: Mapping[int, Image], extension: str, closest: bool) -> tuple[Image, float]:
    """All tiles in one picture, and by what their longer sides were divided to stay within `BUDGET` (1: none were).

    Parameters
    ----------
    pictures : by number of the tile, one at least; the grid has the resolution of the largest
    extension : of the Image Texture node
    closest : repeat texels of smaller tiles, instead of blending them
    """
    first_column, first_row, columns, rows = cells(list(pictures))
    all_bytes = all(p.pixels.dtype == np.uint8 for p in pictures.values())
    encoding: Literal["linear", "srgb"] = (
        "srgb" if all_bytes and any(p.encoding == "srgb" for p in pictures.values()) else "linear"
    )
    kind: type[np.generic] = np.uint8 if all_bytes else np.float32
    height = max(p.pixels.shape[0] for p in pictures.values())
    width = max(p.pixels.shape[1] for p in pictures.values())
    texel = 4 if all_bytes else 16
    share = np.sqrt(min(1.0, BUDGET / (columns * rows * height * width * texel)))
    size = max(1, int(height * share)), max(1, int(width * share))
    magenta = np.array(MAGENTA) * (255 if all_bytes else 1)
    inner = np.empty((rows * size[0], columns * size[1], 4), kind)
    inner[:] = magenta.astype(kind)
    for number, picture in pictures.items():
        row, column = rows - 1 - ((number - 1001) // 10 - first_row), (number - 1001) % 10 - first_column
        pixels = picture.rgba if all_bytes else _floats(picture)
        y, x = row * size[0], column * size[1]
        inner[y : y + size[0], x : x + size[1]] = resized(pixels, size, closest)
    edge = np.pad(inner, ((1, 1), (1, 1), (0, 0)), "edge" if extension != "CLIP" else "constant")
    if extension == "REPEAT":
        edge[0, 1:-1], edge[-1, 1:-1] = inner[size[0] - 1], inner[-size[0]]
        edge[1:-1, 0], edge[1:-1, -1] = inner[:, size[1] - 1], inner[:, -size[1]]
    made = np.empty((edge.shape[0] + 2, edge.shape[1] + 2, 4), kind)
    made[:] = magenta.astype(kind)
    made[1:-1, 1:-1] = edge
    made.flags.writeable = False
    return Image("", made, encoding), max(height / size[0], width / size[1])


def placement(numbers: list[int], picture: Image) -> Array:
    """(4, 4): from coordinates of tiles to those of the picture of them."""
    column, row, columns, rows = cells(numbers)
    matrix = np.eye(4)
    for axis, (first, count, texels) in enumerate(
        ((column, columns, picture.pixels.shape[1]), (row, rows, picture.pixels.shape[0]))
    ):
        tile = (texels - 2 * RING) / count
        matrix[axis, axis] = tile / texels
        matrix[axis, 3] = (RING - first * tile) / texels
    return matrix


def resized(pixels: Array, size: tuple[int, int], closest: bool) -> Array:
    """(h, w, 4) in another size: means of blocks where it is smaller, blended or repeated texels where larger."""
    if pixels.shape[:2] == size:
        return pixels
    made = pixels.astype(np.float32)
    for axis, n in enumerate(size):
        if (block := -(-made.shape[axis] // n)) > 1 and made.shape[axis] % n == 0:
            shape = *made.shape[:axis], n, block, *made.shape[axis + 1 :]
            made = made.reshape(shape).mean(axis=axis + 1)
            continue
        place = (np.arange(n) + 0.5) * made.shape[axis] / n
        if closest:
            made = made.take(place.astype(int), axis=axis)
            continue
        place = np.clip(place - 0.5, 0, made.shape[axis] - 1)
        low = np.minimum(place.astype(int), max(made.shape[axis] - 2, 0))
        weight = (place - low).astype(np.float32).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        high = np.minimum(low + 1, made.shape[axis] - 1)
        made = made.take(low, axis=axis) * (1 - weight) + made.take(high, axis=axis) * weight
    return np.rint(made).astype(np.uint8) if pixels.dtype == np.uint8 else made


def _floats(picture: Image) -> Array:
    """(h, w, 4) float32 linear."""
    if picture.pixels.dtype != np.uint8:
        return picture.pixels
    values = picture.rgba.astype(np.float32) / 255
    if picture.encoding == "srgb":
        values[..., :3] = srgb_to_linear(values[..., :3])
    return values
