"""FLIP: how different two pictures look when they are flipped back and forth.

After Andersson et al., "FLIP: A Difference Evaluator for Alternating Images" (HPG 2020), for pictures of display range.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import correlate1d

from ..core.color import srgb_to_linear

Array = np.ndarray

#: Pixels a degree of the paper's set-up: a 0.7 m wide screen of 3840 pixels, seen from 0.7 m.
PIXELS_A_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
#: Linear Rec.709 to XYZ and the white point, as the paper has them.
_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_WHITE = _TO_XYZ.sum(axis=1)
#: Contrast sensitivity of luminance, red-green, blue-yellow: sums of Gaussians (a1, b1, a2, b2).
_SENSITIVITY = ((1.0, 0.0047, 0.0, 1e-5), (1.0, 0.0053, 0.0, 1e-5), (34.1, 0.04, 13.5, 0.025))
_COLOUR_POWER, _FEATURE_POWER, _FEATURE_DEGREES = 0.7, 0.5, 0.082
#: Where large colour differences begin to be compressed, and to which value.
_KNEE, _KNEE_VALUE = 0.4, 0.95


def flip_map(picture: Array, reference: Array, pixels_a_degree: float = PIXELS_A_DEGREE) -> Array:
    """(h, w) differences in [0, 1] of two (h, w, 3) sRGB-encoded pictures in [0, 1]."""
    pair = [_opponents(np.clip(image, 0, 1)) for image in (picture, reference)]
    colour = _colour_difference(*(_seen(image, pixels_a_degree) for image in pair))
    bright, wanted = ((image[..., 0] + 16) / 116 for image in pair)
    feature = _feature_difference(bright, wanted, pixels_a_degree)
    return colour ** (1 - feature)


def flip(picture: Array, reference: Array, pixels_a_degree: float = PIXELS_A_DEGREE) -> float:
    """Mean of `flip_map`."""
    return float(flip_map(picture, reference, pixels_a_degree).mean())


def _opponents(srgb: Array) -> Array:
    """YCxCz: luminance, red-green, blue-yellow, each linear in light."""
    x, y, z = np.moveaxis(srgb_to_linear(srgb).astype(np.float64) @ _TO_XYZ.T / _WHITE, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def _seen(opponents: Array, pixels_a_degree: float) -> Array:
    """What the eye resolves, as Lab whose chroma fades with darkness (Hunt)."""
    longest = max(max(b1, b2) for _, b1, _, b2 in _SENSITIVITY)
    radius = math.ceil(3 * math.sqrt(longest / (2 * math.pi**2)) * pixels_a_degree)
    degrees = np.arange(-radius, radius + 1) / pixels_a_degree
    blurred = np.empty_like(opponents)
    for channel, (a1, b1, a2, b2) in enumerate(_SENSITIVITY):
        total, weight = 0.0, 0.0
        for a, b in ((a1, b1), (a2, b2)):
            if a:
                kernel = np.exp(-(math.pi**2) / b * degrees**2)
                height = a * math.sqrt(math.pi / b)
                plane = correlate1d(opponents[..., channel], kernel, axis=0, mode="nearest")
                total = total + height * correlate1d(plane, kernel, axis=1, mode="nearest")
                weight += height * kernel.sum() ** 2
        blurred[..., channel] = total / weight
    y = (blurred[..., 0] + 16) / 116
    xyz = np.stack([y + blurred[..., 1] / 500, y, y - blurred[..., 2] / 200], axis=-1) * _WHITE
    return _lab(np.clip(xyz @ np.linalg.inv(_TO_XYZ).T, 0, 1))


def _lab(linear: Array) -> Array:
    share = linear @ _TO_XYZ.T / _WHITE
    knee = 6 / 29
    f = np.where(share > knee**3, np.cbrt(share), share / (3 * knee**2) + 4 / 29)
    lightness = 116 * f[..., 1] - 16
    chroma = 0.01 * lightness
    a, b = 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])
    return np.stack([lightness, chroma * a, chroma * b], axis=-1)


def _hyab(a: Array, b: Array) -> Array:
    """City-block distance of lightness plus Euclidean distance of chroma."""
    difference = a - b
    return np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2])


def _colour_difference(a: Array, b: Array) -> Array:
    green, blue = _lab(np.array([0.0, 1.0, 0.0])), _lab(np.array([0.0, 0.0, 1.0]))
    largest = float(_hyab(green, blue)) ** _COLOUR_POWER
    difference = _hyab(a, b) ** _COLOUR_POWER
    knee = _KNEE * largest
    above = _KNEE_VALUE + (difference - knee) / (largest - knee) * (1 - _KNEE_VALUE)
    return np.where(difference < knee, difference * _KNEE_VALUE / knee, above)


def _feature_difference(a: Array, b: Array, pixels_a_degree: float) -> Array:
    """Of edges and of points, whichever differ more."""
    deviation = 0.5 * _FEATURE_DEGREES * pixels_a_degree
    x = np.arange(-math.ceil(3 * deviation), math.ceil(3 * deviation) + 1, dtype=np.float64)
    gaussian = np.exp(-(x**2) / (2 * deviation**2))
    found = []
    for kernel in (-x * gaussian, (x**2 / deviation**2 - 1) * gaussian):
        kernel = np.where(kernel > 0, kernel / kernel[kernel > 0].sum(), kernel / -kernel[kernel < 0].sum())
        strength = []
        for plane in (a, b):
            smooth = [correlate1d(plane, gaussian / gaussian.sum(), axis=1 - axis, mode="nearest") for axis in (0, 1)]
            strength.append(
                np.hypot(*(correlate1d(s, kernel, axis=axis, mode="nearest") for axis, s in enumerate(smooth)))
            )
        found.append(np.abs(strength[0] - strength[1]))
    return (np.maximum(*found) / math.sqrt(2)) ** _FEATURE_POWER
