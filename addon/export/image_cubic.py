"""Cubic interpolation of images: the B-spline of Cycles' Cubic and Smart at finer texels, between them linear."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...drgs_blender.core.materials import Image

Array = np.ndarray

#: Bytes of a finer picture at most.
BUDGET = 1 << 27
#: How many times as many texels a picture gets along each axis, the first that stays within `BUDGET`.
_FINER = (4, 3, 2)
#: Texels that a picture which ends is continued by: as far as the spline reaches beyond it.
BORDER = 2
#: Extension -> how numpy continues the texels.
_BEYOND = {"REPEAT": "wrap", "MIRROR": "symmetric", "EXTEND": "edge", "CLIP": "constant"}


def finer(picture: Image, extension: str) -> Image | None:
    """The spline through a picture at finer texels; None where that would be too large."""
    height, width = picture.pixels.shape[:2]
    border = border_of(extension)
    area = (height + 2 * border) * (width + 2 * border) * 4 * picture.pixels.itemsize
    factor = next((f for f in _FINER if f * f * area <= BUDGET), 0)
    if factor == 0:
        return None
    pixels = picture.rgba.astype(np.float32)
    for axis in (0, 1):
        pixels = _axis(pixels, axis, factor, border, _BEYOND[extension])
    made = np.rint(pixels).astype(np.uint8) if picture.pixels.dtype == np.uint8 else pixels
    made.flags.writeable = False
    return Image(picture.name, made, picture.encoding)


def border_of(extension: str) -> int:
    """Texels around a picture."""
    return BORDER if extension in ("EXTEND", "CLIP") else 0


def placement(size: tuple[int, int], extension: str) -> Array:
    """(4, 4): from coordinates of an image of `size` (width, height) to those of the finer picture."""
    border, matrix = border_of(extension), np.eye(4)
    for axis, texels in enumerate(size):
        matrix[axis, axis] = texels / (texels + 2 * border)
        matrix[axis, 3] = border / (texels + 2 * border)
    return matrix


def _axis(pixels: Array, axis: int, factor: int, border: int, beyond: Any) -> Array:
    """The spline at `factor` places per texel along an axis."""
    count, pad = pixels.shape[axis], border + BORDER
    padding = [(0, 0)] * 3
    padding[axis] = (pad, pad)
    wide = np.pad(pixels, padding, beyond)
    place = (np.arange((count + 2 * border) * factor) + 0.5) / factor - 0.5 - border
    low = np.floor(place)
    t = (place - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1)).astype(np.float32)
    weights = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    start = low.astype(int) + pad - 1
    parts = [wide.take(start + i, axis=axis) * (weight / 6) for i, weight in enumerate(weights)]
    return parts[0] + parts[1] + parts[2] + parts[3]
