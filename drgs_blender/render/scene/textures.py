"""Materials and their images as flat arrays, and what they say at a point of a surface.

Lookups are those of Cycles' Image Texture node, measured in Blender 5.0 (tests/unit/test_textures_cycles.py):

- the four texels around a point are blended **as they are stored**; sRGB bytes are decoded after that;
- "clip" is transparent black beyond the image, and blends into it over half a texel at the border;
- colour channels do not look at alpha. Where Cycles does (alpha mode straight or premultiplied, a colour space other
  than Non-Color, the node's Alpha output not in use), it has multiplied the encoded colours by alpha as it loaded
  the image: whoever describes the frame does the same;
- a point whose coordinates are not finite is transparent black; an image that is missing is magenta.

Texels stay where they are: compiled code reads them at their address, so even large images are not copied. So it reads
the tables too: arrays that are passed on from function to function are counted at each step, by all threads at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...compute.jit import njit
from ...core.arrays import frozen
from ...core.color import LUMINANCE, srgb_to_linear, to_unit
from ...core.errors import UsageError
from ...core.frame import Image, Material, Texture
from ..memory import Place, address, load_float, load_int32, load_int64, load_uint32
from ..sampling import HALF, ONE, TWO, ZERO, F, luminance

Array = np.ndarray

#: Kinds of images.
_BYTE, _BYTE_SRGB, _FLOAT = range(3)
_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3, "luminance": 4, "rgb": 5}
_A, _LUMINANCE, _RGB = 3, 4, 5
_INTERPOLATIONS = {"closest": 0, "linear": 1}
_EXTENSIONS = {"repeat": 0, "extend": 1, "mirror": 2, "clip": 3}
_REPEAT, _, _MIRROR, _CLIP = range(4)
_SLOTS = ("base_colour_texture", "roughness_texture", "metallic_texture", "emission_texture")
#: What Blender shows of an image that is not there.
_MISSING = np.array([[[255, 0, 255, 255]]], np.uint8)
#: Base colours above this are cut: the light of many bounces must stay a float32. So are factors of textures.
_WHITEST = F(1e3)
#: Radiance above this is cut: its square is still a float32.
_BRIGHTEST = F(1e15)
_INFINITE = F(np.inf)
_BYTE_SCALE = F(1.0 / 255.0)


@dataclass(slots=True)
class _Texels:
    """An image made ready: what was given, what compiled code reads instead, and what was wrong."""

    given: Array
    encoding: str
    texels: Array
    kind: int
    warning: str

    def fits(self, image: Image) -> bool:
        """Whether this is still what `image` gives."""
        return self.given is image.pixels and frozen(self.given) and self.encoding == image.encoding

    def mean(self) -> Array:
        """(4,) float64 linear mean, of about a million texels at most."""
        step = max(1, math.isqrt(self.texels.shape[0] * self.texels.shape[1] >> 20))
        some = self.texels[::step, ::step].reshape(-1, 4)
        if self.kind == _FLOAT:
            return np.maximum(some, 0.0).mean(axis=0, dtype=np.float64)
        levels = np.arange(256) / 255.0
        decoded = srgb_to_linear(levels) if self.kind == _BYTE_SRGB else levels
        shares = [np.bincount(some[:, k], minlength=256) / len(some) for k in range(4)]
        return np.array([*(share @ decoded for share in shares[:3]), shares[3] @ levels])

    def row(self, place: Place = address) -> tuple[int, int, int, int]:
        """Address, width, height, kind."""
        height, width = self.texels.shape[:2]
        return place(self.texels), width, height, self.kind


class MaterialTable:
    """All materials of a frame, ready for ``material_at``.

    Parameters
    ----------
    materials : list of Material
        In the order of the indices that ``material_at`` takes.
    images : list of Image
        What their textures refer to by name; only those in use are looked at.
    previous : MaterialTable, optional
        Table of the frame before: what it made of images whose pixels are the same frozen array is taken over.

    Raises
    ------
    UsageError
        When a texture asks for an unknown channel, interpolation or extension.

    Attributes
    ----------
    addresses : tuple of int
        Of the six arrays, for ``material_at``; valid as long as this table lives.
    arrays : tuple of array
        What ``material_at`` reads:
        constants (k, 8) float32, the eight results without textures;
        slots (k, 4) int32, rows of textures for base colour, roughness, metallic and emission, or -1;
        textures (t, 4) int32, image, channel, interpolation, extension;
        transforms (t, 6) float32;
        images (i, 4) int64, address, width, height, kind;
        decode (256,) float32, linear value of each sRGB byte.
    glows : bool
        Whether anything emits light.
    warnings : list of str
        What was wrong and how it was taken, in words.
    """

    def __init__(self, materials: list[Material], images: list[Image], previous: MaterialTable | None = None) -> None:
        self.warnings: list[str] = []
        self._given = {image.name: image for image in images}
        if len(self._given) < len(images):
            self.warnings.append("several images have the same name; the last of each is used")
        self._known = previous._images if previous else {}
        self._rows: dict[str, int] = {}
        self._images: dict[str, _Texels] = {}
        self._textures: list[tuple[int, int, int, int]] = []
        self._transforms: list[Array] = []
        constants = np.zeros((max(len(materials), 1), 8), np.float32)
        slots = np.full((len(constants), len(_SLOTS)), -1, np.int32)
        for i, material in enumerate(materials):
            constants[i] = self._constants(material)
            for j, slot in enumerate(_SLOTS):
                texture = getattr(material, slot)
                if texture is not None:
                    slots[i, j] = self._add_texture(texture, f"{material.name}, {slot.replace('_', ' ')}")
        self.arrays = (
            constants,
            slots,
            np.array(self._textures, np.int32).reshape(-1, 4),
            np.array(self._transforms, np.float32).reshape(-1, 6),
            np.array([texels.row() for texels in self._images.values()], np.int64).reshape(-1, 4),
            srgb_to_linear(np.arange(256) / 255.0),
        )
        self.glows = bool((constants[:, 5:] > 0.0).any())
        self.addresses = self.addresses_at(address)
        # Only needed above; they would keep the pixels of the frame before alive.
        self._given, self._known = {}, {}

    def addresses_at(self, place: Place) -> tuple[int, ...]:
        """`addresses` of arrays and pictures that lie elsewhere."""
        constants, slots, textures, transforms, images, decode = self.arrays
        if place is not address:
            images = np.array([texels.row(place) for texels in self._images.values()], np.int64).reshape(-1, 4)
        return tuple(place(array) for array in (constants, slots, textures, transforms, images, decode))

    def lookup(self, material: Array, uv: Array) -> Array:
        """(n, 8) float32, the results of ``material_at`` for (n,) integers and (n, 2) coordinates."""
        out = np.empty((len(material), 8), np.float32)
        _material_many(
            np.ascontiguousarray(material, np.int32), np.ascontiguousarray(uv, np.float32), self.addresses, out
        )
        return out

    def mean_emission(self, material: int) -> Array:
        """(3,) float64: emitted radiance, with the mean of the texture that it has."""
        constants, slots, textures = self.arrays[:3]
        radiance = constants[material, 5:].astype(np.float64)
        texture = slots[material, 3]
        if texture < 0 or not radiance.any():
            return radiance
        image, channel = textures[texture, :2]
        mean = list(self._images.values())[image].mean()
        if channel == _RGB:
            return radiance * mean[:3]
        return radiance * (mean[:3] @ np.array(LUMINANCE) if channel == _LUMINANCE else mean[channel])

    def _constants(self, material: Material) -> Array:
        given = np.array(
            [*material.base_colour[:3], material.roughness, material.metallic, *material.emission[:3]], np.float64
        )
        factors = [float(_WHITEST) if t else 1.0 for t in (material.roughness_texture, material.metallic_texture)]
        highest = np.array([float(_WHITEST)] * 3 + factors + [float(_BRIGHTEST)] * 3)
        kept = np.clip(np.where(np.isnan(given), 0.0, given), 0.0, highest)
        parts = {"base colour": (0, 3), "roughness": (3, 4), "metallic": (4, 5), "emission": (5, 8)}
        for name, (first, last) in parts.items():
            where = slice(first, last)
            if not np.array_equal(given[where], kept[where]):
                self.warnings.append(f"{material.name}: {name} {given[where]} is out of range, taken as {kept[where]}")
        return kept.astype(np.float32)

    def _add_texture(self, texture: Texture, subject: str) -> int:
        """Row of a new texture."""
        codes = []
        for name, known in (
            ("channel", _CHANNELS),
            ("interpolation", _INTERPOLATIONS),
            ("extension", _EXTENSIONS),
        ):
            value = getattr(texture, name)
            if value not in known:
                raise UsageError(subject, f"{name} {value!r} is unknown", f"Use one of {', '.join(known)}")
            codes.append(known[value])
        transform = np.asarray(texture.transform, np.float64)
        if transform.shape != (2, 3) or not np.isfinite(transform).all():
            self.warnings.append(f"{subject}: its transform is not made of 2 x 3 finite numbers, ignored")
            transform = np.eye(2, 3)
        self._textures.append((self._add_image(texture.image, subject), codes[0], codes[1], codes[2]))
        self._transforms.append(transform.ravel())
        return len(self._textures) - 1

    def _add_image(self, name: str, subject: str) -> int:
        """Row of an image, known or new."""
        if name not in self._rows:
            self._rows[name] = len(self._rows)
            image = self._given.get(name)
            if image is None:
                texels = _Texels(_MISSING, "linear", _MISSING, _BYTE, f"{subject}: image {name!r} is missing")
            else:
                before = self._known.get(name)
                texels = before if before is not None and before.fits(image) else _read(image)
            self._images[name] = texels
            if texels.warning:
                self.warnings.append(texels.warning)
        return self._rows[name]


def _read(image: Image) -> _Texels:
    """Make an image's pixels ready; they are copied only when something is wrong with them."""
    given = image.pixels
    subject = f"image {image.name!r}"
    if image.encoding not in ("linear", "srgb"):
        raise UsageError(subject, f"encoding {image.encoding!r} is unknown", "Use linear or srgb")
    srgb = image.encoding == "srgb"
    pixels = np.asarray(given)
    problem = ""
    if pixels.ndim != 3 or pixels.shape[2] != 4 or pixels.dtype.kind not in "uf":
        problem = f"{subject}: shape {pixels.shape} of {pixels.dtype} is not an RGBA picture, taken as missing"
    elif pixels.size == 0:
        problem = f"{subject}: has no pixels, taken as missing"
    if problem:
        return _Texels(given, image.encoding, _MISSING, _BYTE, problem)
    if pixels.dtype == np.uint8:
        return _Texels(given, image.encoding, np.ascontiguousarray(pixels), _BYTE_SRGB if srgb else _BYTE, "")
    if pixels.dtype != np.float32:
        problem = f"{subject}: {pixels.dtype} pixels are read as float32"
    with np.errstate(over="ignore", invalid="ignore"):
        texels = np.ascontiguousarray(pixels if pixels.dtype == np.float32 else to_unit(pixels), np.float32)
        # The sum is quick, needs no memory, and is not finite when a texel is not.
        suspicious = not np.isfinite(texels.sum())
    if suspicious and (bad := np.count_nonzero(~np.isfinite(texels))):
        problem = f"{subject}: {bad} values that are NaN or infinite set to 0"
        texels = np.nan_to_num(texels, nan=0.0, posinf=0.0, neginf=0.0)
    if srgb:
        # Floats are decoded before they are blended, bytes after: so does Cycles.
        texels = np.concatenate([srgb_to_linear(texels[..., :3]), texels[..., 3:]], axis=2)
    return _Texels(given, image.encoding, texels, _FLOAT, problem)


@njit
def _texel(address, kind, index, weight, red, green, blue, alpha):  # type: ignore[no-untyped-def]
    """Add `weight` times a texel, as stored."""
    if kind == _FLOAT:
        index *= 4
        return (
            red + weight * load_float(address, index),
            green + weight * load_float(address, index + 1),
            blue + weight * load_float(address, index + 2),
            alpha + weight * load_float(address, index + 3),
        )
    word = np.int64(load_uint32(address, index))
    return (
        red + weight * F(word & 255),
        green + weight * F((word >> 8) & 255),
        blue + weight * F((word >> 16) & 255),
        alpha + weight * F(word >> 24),
    )


@njit
def _axis(u, n, interpolation, extension):  # type: ignore[no-untyped-def]
    """The two texels next to coordinate u along an axis of n texels, and their weights."""
    if extension == _REPEAT:
        u -= np.floor(u)
    elif extension == _MIRROR:
        u -= TWO * np.floor(u * HALF)
        u = min(u, TWO - u)
    else:
        # Far enough outside to be clipped, near enough to count in integers.
        u = min(max(u, -ONE), TWO)
    x = u * F(n)
    if interpolation == 1:
        x -= HALF
    low = np.floor(x)
    i = np.int64(low)
    j, b = i, ZERO
    if interpolation == 1:
        j, b = i + 1, x - low
    a = ONE - b
    if extension == _REPEAT:
        i = i + n if i < 0 else (i - n if i >= n else i)
        j = j - n if j >= n else j
        return i, j, a, b
    if extension == _CLIP:
        a = a if 0 <= i < n else ZERO
        b = b if 0 <= j < n else ZERO
    return min(max(i, 0), n - 1), min(max(j, 0), n - 1), a, b


@njit
def _decoded(x, decode):  # type: ignore[no-untyped-def]
    """Linear value of an sRGB value in [0, 255], to 6e-6."""
    i = min(np.int64(x), 254)
    below = load_float(decode, i)
    return below + (x - F(i)) * (load_float(decode, i + 1) - below)


@njit
def _lookup(row, u, v, addresses):  # type: ignore[no-untyped-def]
    """Red, green, blue, alpha of a texture."""
    _, _, textures, transforms, images, decode = addresses
    i = 6 * row
    s = load_float(transforms, i) * u + load_float(transforms, i + 1) * v + load_float(transforms, i + 2)
    t = load_float(transforms, i + 3) * u + load_float(transforms, i + 4) * v + load_float(transforms, i + 5)
    if not (abs(s) < _INFINITE and abs(t) < _INFINITE):
        return ZERO, ZERO, ZERO, ZERO
    i = 4 * row
    interpolation, extension = load_int32(textures, i + 2), load_int32(textures, i + 3)
    i = 4 * np.int64(load_int32(textures, i))
    address, width, height, kind = (
        load_int64(images, i),
        load_int64(images, i + 1),
        load_int64(images, i + 2),
        load_int64(images, i + 3),
    )
    left, right, a, b = _axis(s, width, interpolation, extension)
    low, high, c, d = _axis(t, height, interpolation, extension)
    # Row 0 is at the top, v = 0 at the bottom.
    low, high = (height - 1 - low) * width, (height - 1 - high) * width
    red, green, blue, alpha = _texel(address, kind, low + left, a * c, ZERO, ZERO, ZERO, ZERO)
    if interpolation == 1:
        red, green, blue, alpha = _texel(address, kind, low + right, b * c, red, green, blue, alpha)
        red, green, blue, alpha = _texel(address, kind, high + left, a * d, red, green, blue, alpha)
        red, green, blue, alpha = _texel(address, kind, high + right, b * d, red, green, blue, alpha)
    if kind == _BYTE_SRGB:
        return _decoded(red, decode), _decoded(green, decode), _decoded(blue, decode), alpha * _BYTE_SCALE
    if kind == _BYTE:
        return red * _BYTE_SCALE, green * _BYTE_SCALE, blue * _BYTE_SCALE, alpha * _BYTE_SCALE
    return red, green, blue, alpha


@njit
def _number(row, u, v, addresses):  # type: ignore[no-untyped-def]
    """One number of a texture; of a colour its luminance, as where Blender plugs a colour into a number."""
    red, green, blue, alpha = _lookup(row, u, v, addresses)
    channel = load_int32(addresses[2], 4 * row + 1)
    if channel >= _LUMINANCE:
        return luminance(red, green, blue)
    if channel == _A:
        return alpha
    return red if channel == 0 else (green if channel == 1 else blue)


@njit
def _colour(row, u, v, addresses):  # type: ignore[no-untyped-def]
    """Colour of a texture; of one channel a grey."""
    if load_int32(addresses[2], 4 * row + 1) == _RGB:
        red, green, blue, _ = _lookup(row, u, v, addresses)
        return red, green, blue
    grey = _number(row, u, v, addresses)
    return grey, grey, grey


@njit
def _within(x, highest):  # type: ignore[no-untyped-def]
    """`x` in [0, highest]; NaN is 0."""
    return min(x, highest) if x > ZERO else ZERO


@njit
def material_at(material, u, v, addresses):  # type: ignore[no-untyped-def]
    """What a material is at texture coordinates (u, v).

    Parameters
    ----------
    material : int
        Index into the materials of the table; not checked.
    u, v : float
        v upwards.
    addresses : tuple of int
        ``MaterialTable.addresses``.

    Returns
    -------
    r, g, b, roughness, metallic, er, eg, eb : float
        Base colour, linear Rec.709, above 1 where it was given so; roughness and metallic in [0, 1]; emitted radiance,
        linear Rec.709, finite, >= 0.
    """
    constants, slots = addresses[0], addresses[1]
    i = 8 * np.int64(material)
    r, g, b = load_float(constants, i), load_float(constants, i + 1), load_float(constants, i + 2)
    roughness, metallic = load_float(constants, i + 3), load_float(constants, i + 4)
    er, eg, eb = load_float(constants, i + 5), load_float(constants, i + 6), load_float(constants, i + 7)
    i = 4 * np.int64(material)
    first, second = np.int64(load_int32(slots, i)), np.int64(load_int32(slots, i + 1))
    third, last = np.int64(load_int32(slots, i + 2)), np.int64(load_int32(slots, i + 3))
    # Only if all are -1 are all bits set.
    if (first & second & third & last) == -1:
        return r, g, b, roughness, metallic, er, eg, eb
    if first >= 0:
        x, y, z = _colour(first, u, v, addresses)
        r, g, b = _within(r * x, _WHITEST), _within(g * y, _WHITEST), _within(b * z, _WHITEST)
    if second >= 0:
        roughness = _within(roughness * _number(second, u, v, addresses), ONE)
    if third >= 0:
        metallic = _within(metallic * _number(third, u, v, addresses), ONE)
    er, eg, eb = _emission(last, er, eg, eb, u, v, addresses)
    return r, g, b, roughness, metallic, er, eg, eb


@njit
def _emission(row, er, eg, eb, u, v, addresses):  # type: ignore[no-untyped-def]
    """Radiance times a texture, if there is one."""
    if row < 0:
        return er, eg, eb
    x, y, z = _colour(row, u, v, addresses)
    return _within(er * x, _BRIGHTEST), _within(eg * y, _BRIGHTEST), _within(eb * z, _BRIGHTEST)


@njit
def emits(material, addresses):  # type: ignore[no-untyped-def]
    """Whether a material emits light, its texture apart."""
    i = 8 * np.int64(material)
    return (
        max(load_float(addresses[0], i + 5), max(load_float(addresses[0], i + 6), load_float(addresses[0], i + 7))) > 0
    )


@njit
def emission_at(material, u, v, addresses):  # type: ignore[no-untyped-def]
    """(er, eg, eb) of `material_at`."""
    i, row = 8 * np.int64(material), np.int64(load_int32(addresses[1], 4 * np.int64(material) + 3))
    er, eg, eb = load_float(addresses[0], i + 5), load_float(addresses[0], i + 6), load_float(addresses[0], i + 7)
    return _emission(row, er, eg, eb, u, v, addresses)


@njit
def _material_many(material, uv, addresses, out):  # type: ignore[no-untyped-def]
    for i in range(len(material)):
        r, g, b, roughness, metallic, er, eg, eb = material_at(material[i], uv[i, 0], uv[i, 1], addresses)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = r, g, b, roughness, metallic
        out[i, 5], out[i, 6], out[i, 7] = er, eg, eb
