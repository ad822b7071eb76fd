"""Colour: the sRGB transfer function (IEC 61966-2-1), luminance of linear Rec.709."""

from __future__ import annotations

import numpy as np

Array = np.ndarray

#: Luminance of linear Rec.709 red, green and blue (ITU-R BT.709).
LUMINANCE = (0.2126, 0.7152, 0.0722)


def srgb_to_linear(encoded: Array) -> Array:
    """Decode sRGB values; float32, any shape. Values outside [0, 1] follow the curve's extension.

    Examples
    --------
    >>> srgb_to_linear([0, 0.5, 1]).round(3)
    array([0.   , 0.214, 1.   ], dtype=float32)
    """
    x = np.asarray(encoded, np.float32)
    # In double: powers in single precision have other last digits on other processors, and so would textures.
    power = ((np.maximum(x, 0.04045).astype(np.float64) + 0.055) / 1.055) ** 2.4
    return np.where(x <= 0.04045, x / np.float32(12.92), power).astype(np.float32)


def linear_to_srgb(linear: Array) -> Array:
    """Encode linear values as sRGB; float32, any shape."""
    x = np.asarray(linear, np.float32)
    power = np.float32(1.055) * np.maximum(x, 0.0031308) ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(x <= 0.0031308, x * np.float32(12.92), power).astype(np.float32)


def to_unit(pixels: Array) -> Array:
    """Integers as fractions of their type's maximum, floats as they are; float32."""
    if pixels.dtype.kind == "u":
        return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    return pixels.astype(np.float32)
