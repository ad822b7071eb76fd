"""Images and their halvings, looked up trilinearly in linear values: textures without aliasing."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from .color import srgb_to_linear, to_unit

Array = np.ndarray

#: Rows of an image that are made linear at a time.
_ROWS = 64


class TextureImage(Protocol):
    """An image, and how it lies in texture coordinates; as `formats.files.Image`."""

    @property
    def pixels(self) -> Array:
        """(h, w) or (h, w, c) integers, fractions of their maximum, or float32; row 0 at the top."""

    @property
    def srgb(self) -> bool:
        """Whether integers are sRGB-encoded."""

    @property
    def uv_transform(self) -> Array:
        """(2, 3): maps (u, v, 1) to coordinates of the image, v up."""

    @property
    def wrap(self) -> tuple[str, str]:
        """Along u and v, each "repeat", "clamp" or "mirror"."""


class TrilinearTaps(NamedTuple):
    """Pixels between which points are interpolated, in pyramids of one layout.

    Attributes
    ----------
    fine, coarse : Corners
        In the level whose pixels are as large as the footprint, or smaller; in the next one, of some points.
    blended : (k,) int64 array
        The points of `coarse`.
    share : (k,) float32 array
        How much of the coarse level they take.
    """

    fine: Corners
    coarse: Corners
    blended: Array
    share: Array


class Corners(NamedTuple):
    """Four pixels around each of n points, and how far the point is from the first to the last.

    Attributes
    ----------
    pixel : (4, n) int64 array
        Number of the top left, top right, bottom left and bottom right pixel.
    x, y : (n,) float32 array
    """

    pixel: Array
    x: Array
    y: Array


class Pyramid:
    """An image and its halvings, float32 linear.

    Parameters
    ----------
    image : TextureImage

    Attributes
    ----------
    levels : list of (h, w, 3) array
        Level 0 is the image, each next one the mean of 2 x 2 pixels.
    layout : tuple
        Equal for images whose points are found at the same `taps`.
    """

    def __init__(self, image: TextureImage) -> None:
        pixels = image.pixels[..., None] if image.pixels.ndim == 2 else image.pixels
        self.image = image
        levels = [
            _linear(np.repeat(pixels[..., :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[..., :3], image.srgb)
        ]
        while max(levels[-1].shape[:2]) > 1:
            levels.append(_halve(levels[-1]))
        self._sizes = np.array([level.shape[1::-1] for level in levels])  # width and height
        self._starts = np.concatenate([[0], np.cumsum(self._sizes.prod(axis=1))])
        # All pixels of all levels, channel by channel: numpy is slow at rows of three numbers.
        self._planes = np.empty((3, self._starts[-1]), np.float32)
        self.levels = []
        for level, start, stop in zip(levels, self._starts, self._starts[1:]):
            self._planes[:, start:stop] = level.reshape(-1, 3).T
            self.levels.append(self._planes[:, start:stop].T.reshape(level.shape))
        self.layout = (levels[0].shape[:2], tuple(image.wrap), np.asarray(image.uv_transform, np.float64).tobytes())

    def texels(self, uvs: Array) -> Array:
        """Texture coordinates (..., 2), v up -> positions in pixels of level 0, row 0 at the top."""
        transform = np.asarray(self.image.uv_transform, np.float64)
        moved = uvs @ transform[:, :2].T + transform[:, 2]
        width, height = self._sizes[0]
        return np.stack([moved[..., 0] * width, (1 - moved[..., 1]) * height], -1)

    def sample(self, texels: Array, footprint: Array) -> Array:
        """Mean colour (n, 3) around positions; parameters are those of `taps`."""
        return self.look_up(self.taps(texels, footprint)).T

    def taps(self, texels: Array, footprint: Array) -> TrilinearTaps:
        """Find the pixels around positions.

        Parameters
        ----------
        texels : (n, 2) array
            From `texels`.
        footprint : (n,) array
            Width of the area to average, in pixels of level 0.
        """
        level = np.clip(np.log2(np.maximum(footprint, 1)), 0, len(self.levels) - 1)
        low = np.minimum(level.astype(np.int64), max(len(self.levels) - 2, 0))
        share = (level - low).astype(np.float32)
        x, y = np.ascontiguousarray(texels.T)
        blended = np.flatnonzero(share)
        coarse = self._corners(low[blended] + 1, x[blended], y[blended])
        return TrilinearTaps(self._corners(low, x, y), coarse, blended, share[blended])

    def taps_at(self, uvs: Array, scale: Array) -> TrilinearTaps:
        """Find the pixels around texture coordinates (n, 2), v up, to average over areas of width `scale` (n, 2)."""
        footprint = np.abs(scale) * self.levels[0].shape[1::-1] * magnification(self.image)
        return self.taps(self.texels(uvs.astype(np.float64)), np.maximum(footprint[:, 0], footprint[:, 1]))

    def look_up(self, taps: TrilinearTaps, channels: slice = slice(0, 3)) -> Array:
        """Colours (channels, n) at `taps`, those of a pyramid of the same layout."""
        planes = self._planes[channels]
        result = np.empty((len(planes), len(taps.fine.x)), np.float32)
        for plane, colour in zip(planes, result):
            colour[:] = _bilinear(plane, taps.fine)
            if len(taps.blended):
                fine, coarse = colour[taps.blended], _bilinear(plane, taps.coarse)
                colour[taps.blended] = (1 - taps.share) * fine + taps.share * coarse
        return result

    def _corners(self, level: Array, x: Array, y: Array) -> Corners:
        """The pixels around positions in pixels of level 0, each in a level of its own."""
        scale = self._sizes / self._sizes[0]
        width, height = self._sizes[:, 0][level], self._sizes[:, 1][level]
        x, y = x * scale[:, 0][level] - 0.5, y * scale[:, 1][level] - 0.5
        left, top = np.floor(x), np.floor(y)
        part_x, part_y = (x - left).astype(np.float32), (y - top).astype(np.float32)
        columns = [_wrap(left.astype(np.int64) + k, width, self.image.wrap[0]) for k in (0, 1)]
        rows = [_wrap(top.astype(np.int64) + k, height, self.image.wrap[1]) for k in (0, 1)]
        pixel = np.empty((4, len(x)), np.int64)
        for k, row in enumerate(rows):
            first = self._starts[level] + row * width
            np.add(first, columns[0], out=pixel[2 * k])
            np.add(first, columns[1], out=pixel[2 * k + 1])
        return Corners(pixel, part_x, part_y)


def magnification(image: TextureImage) -> Array:
    """How much the texture transform magnifies u and v, (2,)."""
    return np.linalg.norm(np.asarray(image.uv_transform, np.float64)[:, :2], axis=1)


def _linear(pixels: Array, srgb: bool) -> Array:
    """Values of pixels, float32; integers in sRGB from a table, for large images have more pixels than values."""
    if not srgb or pixels.dtype.kind != "u":
        return to_unit(pixels)
    values = np.arange(np.iinfo(pixels.dtype).max + 1, dtype=pixels.dtype)
    table, found = srgb_to_linear(to_unit(values)), np.empty(pixels.shape, np.float32)
    for first in range(0, len(pixels), _ROWS):  # numpy makes 8 bytes of each index, and checks them twice
        rows = slice(first, first + _ROWS)
        table.take(pixels[rows], out=found[rows], mode="clip")
    return found


def _halve(pixels: Array) -> Array:
    """Mean of 2 x 2 pixels; an odd last row or column counts twice."""
    h, w = pixels.shape[:2]
    padded = np.pad(pixels, ((0, h % 2 if h > 1 else 1), (0, w % 2 if w > 1 else 1), (0, 0)), mode="edge")
    return 0.25 * (padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2])


def _bilinear(plane: Array, corners: Corners) -> Array:
    """One channel at each point, between its four pixels."""
    pixel, x, y = corners
    other_x = 1 - x
    top = other_x * plane.take(pixel[0]) + x * plane.take(pixel[1])
    bottom = other_x * plane.take(pixel[2]) + x * plane.take(pixel[3])
    return (1 - y) * top + y * bottom


def _wrap(index: Array, size: Array, mode: str) -> Array:
    """Bring indices back into an image; each has a size of its own."""
    outside = np.flatnonzero((index < 0) | (index >= size))
    if not len(outside):
        return index
    out, size = index[outside], size[outside]
    if mode == "clamp":
        index[outside] = np.clip(out, 0, size - 1)
    elif mode == "mirror":
        out = np.mod(out, 2 * size)
        index[outside] = np.where(out < size, out, 2 * size - 1 - out)
    else:
        index[outside] = np.mod(out, size)
    return index
