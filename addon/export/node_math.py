"""Math of shader nodes on arrays: blends, operations, colour systems, physics. No bpy."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np

Array = np.ndarray


def rgb(colour: Array) -> tuple[float, float, float]:
    """A colour as frames hold it."""
    red, green, blue = map(float, colour)
    return red, green, blue


def by_row(function: Callable[..., Array]) -> Callable[..., Array]:
    """A function of (3,) arrays as one of (..., 3) arrays."""

    def many(*values: Array) -> Array:
        shape = np.broadcast_shapes(*(np.shape(v) for v in values))
        rows = zip(*(np.broadcast_to(v, shape).reshape(-1, 3) for v in values))
        return np.array([function(*row) for row in rows]).reshape(shape)

    return many


def divide(a: Array, b: Array) -> Array:
    return np.divide(a, b, out=np.zeros(np.broadcast_shapes(np.shape(a), np.shape(b))), where=b != 0)


def _overlay(a: Array, b: Array) -> Array:
    return np.where(a < 0.5, 2 * a * b, 1 - 2 * (1 - a) * (1 - b))


def in_system(convert: Callable[..., tuple[float, float, float]], values: Array) -> Array:
    """(3,) in another colour system; NaN, which `convert` refuses, where a value is not finite."""
    return np.array(convert(*values)) if np.isfinite(values).all() else np.full(3, np.nan)


def hsv(colour: Array) -> Array:
    return in_system(colorsys.rgb_to_hsv, np.maximum(colour, 0))


def hsl(colour: Array) -> Array:
    return in_system(colorsys.rgb_to_hls, np.maximum(colour, 0))[[0, 2, 1]]


@by_row
def hue_saturation(hue: Array, saturation: Array, value: Array, factor: Array, colour: Array) -> Array:
    h, s, v = hsv(colour)
    turned = np.array(((h + hue[0] + 0.5) % 1, np.clip(s * saturation[0], 0, 1), v * value[0]))
    return colour + factor * (np.maximum(in_system(colorsys.hsv_to_rgb, turned), 0) - colour)


#: Blend type -> what the second colour does to the first at factor 1.
BLENDS: dict[str, Callable[[Array, Array], Array]] = {
    "MIX": lambda a, b: b,
    "MULTIPLY": np.multiply,
    "ADD": np.add,
    "SUBTRACT": np.subtract,
    "DIVIDE": divide,
    "SCREEN": lambda a, b: 1 - (1 - a) * (1 - b),
    "OVERLAY": _overlay,
    "DIFFERENCE": lambda a, b: np.abs(a - b),
    "EXCLUSION": lambda a, b: a + b - 2 * a * b,
    "DARKEN": np.minimum,
    "LIGHTEN": np.maximum,
}

#: Operation -> number of operands, function.
OPERATIONS: dict[str, tuple[int, Callable[..., Array]]] = {
    "ADD": (2, np.add),
    "SUBTRACT": (2, np.subtract),
    "MULTIPLY": (2, np.multiply),
    "DIVIDE": (2, divide),
    "MULTIPLY_ADD": (3, lambda a, b, c: a * b + c),
    "POWER": (2, lambda a, b: np.abs(a) ** b),
    "SQRT": (1, lambda a: np.sqrt(np.maximum(a, 0))),
    "ABSOLUTE": (1, np.abs),
    "MINIMUM": (2, np.minimum),
    "MAXIMUM": (2, np.maximum),
    "LESS_THAN": (2, lambda a, b: np.where(a < b, 1.0, 0.0)),
    "GREATER_THAN": (2, lambda a, b: np.where(a > b, 1.0, 0.0)),
    "ROUND": (1, lambda a: np.floor(a + 0.5)),
    "FLOOR": (1, np.floor),
    "CEIL": (1, np.ceil),
    "FRACT": (1, lambda a: a - np.floor(a)),
    "SINE": (1, np.sin),
    "COSINE": (1, np.cos),
}


def blackbody(kelvin: float) -> Array:
    """(3,) linear Rec.709 colour of a glowing body, luminance 1, as Blender's Blackbody node.

    Planck's law under the CIE 1931 observer, whose functions are the fits of Wyman, Sloan and Shirley, "Simple analytic
    approximations to the CIE XYZ color matching functions", JCGT 2 (2013); within 2 % from 1900 K on. Below 800 and
    above 12000 K as at these.
    """
    wave = np.arange(380.0, 781.0, 5.0)
    light = wave**-5 / np.expm1(1.4387769e7 / (wave * np.clip(kelvin, 800, 12000)))

    def lobe(peak: float, below: float, above: float) -> Array:
        return np.exp(-0.5 * ((wave - peak) * np.where(wave < peak, below, above)) ** 2)

    x = 1.056 * lobe(599.8, 0.0264, 0.0323) + 0.362 * lobe(442.0, 0.0624, 0.0374) - 0.065 * lobe(501.1, 0.0490, 0.0382)
    y = 0.821 * lobe(568.8, 0.0213, 0.0247) + 0.286 * lobe(530.9, 0.0613, 0.0322)
    z = 1.217 * lobe(437.0, 0.0845, 0.0278) + 0.681 * lobe(459.0, 0.0385, 0.0725)
    to_rec709 = np.array(((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570)))
    return np.maximum(to_rec709 @ (light @ np.stack((x, y, z), 1)), 0) / (light @ y)


def reflectance(ior: float) -> float:
    """Fresnel reflectance of a dielectric in air at normal incidence; below 0 as at 0."""
    ior = max(ior, 0.0)
    return ((ior - 1) / (ior + 1)) ** 2


def conductor(ior: Array, extinction: Array) -> tuple[Array, Array]:
    """Base colour and edge tint by which the F82 model (Kutz, Hasan and Edmondson 2021) shows a conductor.

    Parameters
    ----------
    ior, extinction : (3,)
        Real and imaginary part of the refractive index for red, green and blue.
    """
    n, k = np.maximum(ior, 0.0), np.maximum(extinction, 0.0)
    normal = _conductor_at(n, k, 1.0)
    falloff = (1 - 1 / 7) ** 5
    schlick = normal + (1 - normal) * falloff
    return normal, np.clip(divide(_conductor_at(n, k, 1 / 7), schlick), 0, 1)


def _conductor_at(n: Array, k: Array, cosine: float) -> Array:
    """(3,) unpolarised Fresnel reflectance of a conductor in air."""
    square = cosine * cosine
    sine = 1 - square
    t = n * n - k * k - sine
    length = np.sqrt(t * t + 4 * n * n * k * k)
    a = np.sqrt(np.maximum((length + t) / 2, 0))
    s = (length + square - 2 * a * cosine) / (length + square + 2 * a * cosine)
    p = s * (square * length + sine * sine - 2 * a * cosine * sine)
    return (s + p / (square * length + sine * sine + 2 * a * cosine * sine)) / 2


def _roughness_factor(rough: Array) -> Array:
    """Chiang et al. 2016, equation 9, in the radial roughness."""
    x = np.clip(rough, 0, 1)
    return (((((0.245 * x) + 5.574) * x - 10.73) * x + 2.532) * x - 0.215) * x + 5.969


def hair_colour(absorption: Array, rough: Array) -> Array:
    """Colour of many hairs together by what one absorbs per radius (Chiang et al. 2016)."""
    return np.exp(-np.sqrt(np.maximum(absorption, 0)) * _roughness_factor(rough))


def strand_albedo(colour: Array) -> Array:
    """Albedo of opaque strands, many of which have a colour together, as light that one reflects meets others.

    For isotropic scatterers in a deep layer it is 1 - s^2 with s = (1 - colour) / (1 + colour); strands are not deep
    everywhere. 1 - s is what gives tufts of brown hair the brightness that Cycles gives them.
    """
    return 2 * colour / (1 + colour)


def melanin_colour(melanin: Array, redness: Array, tint: Array, rough: Array) -> Array:
    """Colour of many hairs together by their pigment, as Cycles' Principled Hair BSDF reads it."""
    amount = -np.log(np.maximum(1 - np.clip(melanin, 0, 1), 1e-4))
    red = np.clip(redness, 0, 1)
    pigment = (1 - red) * np.array((0.506, 0.841, 1.653)) + red * np.array((0.343, 0.733, 1.924))
    dye = (np.log(np.clip(tint, 1e-5, 1)) / _roughness_factor(rough)) ** 2
    return hair_colour(amount * pigment + dye, rough)
