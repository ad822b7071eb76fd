"""Materials and their images as flat arrays; `texture_lookup` reads them at points of a surface.

Images are those of Cycles' Image Texture node, measured in Blender 5.0 (tests/unit/test_textures_cycles.py):

- colour channels do not look at alpha. Where Cycles does (alpha mode straight or premultiplied, a colour space other
  than Non-Color, the node's Alpha output not in use), it has multiplied the encoded colours by alpha as it loaded
  the image: whoever describes the frame does the same;
- an image that is missing is magenta.

Texels stay where they are: compiled code reads them at their address, so even large images are not copied. So it reads
the tables too: arrays that are passed on from function to function are counted at each step, by all threads at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...compute.jit import njit
from ...core.arrays import frozen
from ...core.color import LUMINANCE, srgb_to_linear, to_unit
from ...core.errors import UsageError
from ...core.materials import Image, Material, SurfaceDetail, Texture
from ..memory import AddressOf, address
from .detailed_normal import (
    COLOUR,
    DISTANCE,
    FIRST_STEP,
    FRAME,
    KIND,
    KINDS,
    SLOTS,
    STEP_FLOATS,
    STEP_INTS,
    STEPS,
    STRENGTH,
    TANGENTS,
    TEXTURE,
)
from .material_rows import material_rows
from .shader_aovs import aov_tables
from .texture_lookup import (
    BRIGHTEST,
    BYTE,
    BYTE_SRGB,
    CHANNELS,
    EXTENSIONS,
    FEWER,
    FLOAT,
    INTERPOLATIONS,
    WHITEST,
    material_at,
)

Array = np.ndarray
#: Function of a material's index, a layer's name and whether tangents are meant, to the row of `MeshLayers`; or None.
LayerRow = Callable[[int, str, bool], int | None]

_SLOTS = ("base_colour_texture", "roughness_texture", "metallic_texture", "emission_texture", "alpha_texture")
#: Strengths, distances and colours of normal and bump maps above this are no use.
_STRONGEST = 1e12
#: What Blender shows of an image that is not there.
_MISSING = np.array([[[255, 0, 255, 255]]], np.uint8)


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
        count = self.texels.shape[2]
        some = self.texels[::step, ::step].reshape(-1, count)
        if self.kind == FLOAT:
            return np.maximum(some, 0.0).mean(axis=0, dtype=np.float64)
        levels = np.arange(256) / 255.0
        decoded = srgb_to_linear(levels) if self.kind == BYTE_SRGB else levels
        shares = [np.bincount(some[:, k], minlength=256) / len(some) for k in range(count)]
        colour = [share @ decoded for share in shares[:3]]
        return np.array([*(colour if count >= 3 else 3 * colour), shares[3] @ levels if count == 4 else 1.0])

    def row(self, address_of: AddressOf = address) -> tuple[int, int, int, int]:
        """Address, width, height, kind."""
        height, width, channels = self.texels.shape
        return address_of(self.texels), width, height, self.kind + (4 - channels << FEWER)


class MaterialTable:
    """All materials of a frame, ready for ``material_at``.

    Parameters
    ----------
    materials : list of Material
        In the order of the indices that ``material_at`` takes.
    images : list of Image
        Images that their textures name; only those in use are read.
    previous : MaterialTable, optional
        Table of the frame before: what it made of images whose pixels are the same frozen array is taken over.
    layer_row : callable, optional
        Says where layers of the material's mesh are found; None: there are none.
    frames : sequence of int, optional
        Of each material, the row of its mesh among the frames that its details need; see `mesh_layers`.

    Raises
    ------
    UsageError
        When a texture asks for an unknown channel, interpolation or extension.

    Attributes
    ----------
    addresses : tuple of int
        Of the first seven arrays, for ``material_at``; valid as long as this table lives.
    arrays : tuple of array
        Arrays that ``material_at`` reads:
        constants (k, 8) float32, the eight results without textures;
        slots (k, 8) int32, rows of textures for base colour, roughness, metallic, emission and alpha, or -1; first
        step and number of steps of its details, row of its mesh's frame;
        textures (t, 5) int32, image or -1, channel, interpolation, extension, layer or -1;
        transforms (t, 6) float32;
        images (i, 4) int64, address, width, height, kind;
        decode (256,) float32, linear value of each sRGB byte;
        layers (l, 2) int64, see `mesh_layers.MeshLayers`, which fills it;
        steps (d, 4) int32, kind, texture or -1, layer of the tangents or -1, nothing;
        numbers (d, 8) float32, strength, distance, colour;
        alphas (k,) float32, without texture;
        multiscatter (k,) int32, whether they have Multiscatter GGX.
    clear : bool
        Whether light may pass anything.
    detailed : bool
        Whether anything has a normal or a bump map.
    emissive : bool
        Whether anything emits light.
    multiscatter : bool
        Whether anything has Multiscatter GGX.
    aovs : dict of str to (tuple of array)
        Of `shader_aovs.aov_tables`.
    rows : MaterialRows or None
        Materials with more lobes than two; None: there are none.
    warnings : list of str
        Problems and their substitutes, in words.
    """

    def __init__(
        self,
        materials: list[Material],
        images: list[Image],
        previous: MaterialTable | None = None,
        layer_row: LayerRow = lambda material, name, tangents: None,
        frames: Sequence[int] = (),
    ) -> None:
        self.warnings: list[str] = []
        self._given = {image.name: image for image in images}
        if len(self._given) < len(images):
            self.warnings.append("several images have the same name; the last of each is used")
        self._known = previous._images if previous else {}
        self._rows: dict[str, int] = {}
        self._images: dict[str, _Texels] = {}
        self._textures: list[tuple[int, int, int, int, int]] = []
        self._transforms: list[Array] = []
        self._steps: list[tuple[Array, Array]] = []
        self._layer_row = layer_row
        constants = np.zeros((max(len(materials), 1), 8), np.float32)
        slots = np.full((len(constants), SLOTS), -1, np.int32)
        for i, material in enumerate(materials):
            constants[i] = self._constants(material)
            for j, slot in enumerate(_SLOTS):
                texture = getattr(material, slot)
                if texture is not None:
                    slots[i, j] = self._add_texture(texture, f"{material.name}, {slot.replace('_', ' ')}", i)
            slots[i, FIRST_STEP] = len(self._steps)
            self._steps += [self._step(detail, material.name, i) for detail in material.details]
            slots[i, STEPS] = len(self._steps) - slots[i, FIRST_STEP]
            slots[i, FRAME] = frames[i] if len(frames) else 0
        self.aovs = aov_tables(materials, self._add_texture, self.warnings)
        self.rows = material_rows(materials, self._add_texture, layer_row, self.warnings)
        self.detailed = bool(self._steps)
        self.arrays = (
            constants,
            slots,
            np.array(self._textures, np.int32).reshape(-1, 5),
            np.array(self._transforms, np.float32).reshape(-1, 6),
            np.array([texels.row() for texels in self._images.values()], np.int64).reshape(-1, 4),
            srgb_to_linear(np.arange(256) / 255.0),
            np.empty((0, 2), np.int64),
            np.array([step for step, _ in self._steps], np.int32).reshape(-1, STEP_INTS),
            np.array([numbers for _, numbers in self._steps], np.float32).reshape(-1, STEP_FLOATS),
            np.array([self._alpha(material) for material in materials] or [1.0], np.float32),
            np.array([material.multiscatter for material in materials] or [False], np.int32),
        )
        self.multiscatter = any(material.multiscatter for material in materials)
        self.clear = any(material.clear for material in materials)
        self.emissive = bool((constants[:, 5:] > 0.0).any())
        self.addresses = self.addresses_at(address)[:7]
        # Only needed above; they would keep the pixels of the frame before alive.
        self._given, self._known = {}, {}

    def take_layers(self, layers: Array) -> None:
        """Take the (l, 2) int64 table of the layers that textures refer to."""
        self.arrays = (*self.arrays[:6], layers, *self.arrays[7:])
        self.addresses = (*self.addresses[:6], address(layers))

    def addresses_at(self, address_of: AddressOf, layers: Array | None = None) -> tuple[int, ...]:
        """Addresses of all arrays, of arrays and pictures that lie elsewhere, with the table of `layers` there."""
        arrays: list[Array] = list(self.arrays)
        if address_of is not address:
            arrays[4] = np.array([t.row(address_of) for t in self._images.values()], np.int64).reshape(-1, 4)
        if layers is not None:
            arrays[6] = layers
        return tuple(address_of(array) for array in arrays)

    def lookup(self, material: Array, uv: Array, face: Array | None = None, where: Array | None = None) -> Array:
        """(n, 8) float32, the results of ``material_at``.

        Parameters
        ----------
        material : (n,) array
            Integers.
        uv : (n, 2) array
            Coordinates by the mesh's own UVs.
        face : (n,) array, optional
            Integers; with `where`, for textures that refer to layers.
        where : (n, 2) array, optional
            Barycentric coordinates of the face's second and third corner.
        """
        out = np.empty((len(material), 8), np.float32)
        face = np.zeros(len(out), np.int64) if face is None else np.ascontiguousarray(face, np.int64)
        where = np.zeros((len(out), 2), np.float32) if where is None else np.ascontiguousarray(where, np.float32)
        given = np.ascontiguousarray(material, np.int32), np.ascontiguousarray(uv, np.float32), face, where
        _material_many(*given, self.addresses, out)
        return out

    def mean_emission(self, material: int) -> Array:
        """(3,) float64: emitted radiance, with the mean of the texture that it has."""
        constants, slots, textures = self.arrays[:3]
        radiance = constants[material, 5:].astype(np.float64)
        texture = slots[material, 3]
        if texture < 0 or not radiance.any():
            return radiance
        image, channel = textures[texture, :2]
        # Values of a layer are not averaged: half of the estimate is of each face itself.
        mean = list(self._images.values())[image].mean() if image >= 0 else np.ones(4)
        if channel == CHANNELS["rgb"]:
            return radiance * mean[:3]
        return radiance * (mean[:3] @ np.array(LUMINANCE) if channel == CHANNELS["luminance"] else mean[channel])

    def _constants(self, material: Material) -> Array:
        given = np.array(
            [*material.base_colour[:3], material.roughness, material.metallic, *material.emission[:3]], np.float64
        )
        factors = [float(WHITEST) if t else 1.0 for t in (material.roughness_texture, material.metallic_texture)]
        highest = np.array([float(WHITEST)] * 3 + factors + [float(BRIGHTEST)] * 3)
        kept = np.clip(np.where(np.isnan(given), 0.0, given), 0.0, highest)
        parts = {"base colour": (0, 3), "roughness": (3, 4), "metallic": (4, 5), "emission": (5, 8)}
        for name, (first, last) in parts.items():
            where = slice(first, last)
            if not np.array_equal(given[where], kept[where]):
                self.warnings.append(f"{material.name}: {name} {given[where]} is out of range, taken as {kept[where]}")
        return kept.astype(np.float32)

    def _alpha(self, material: Material) -> float:
        alpha = float(material.alpha)
        highest = float(WHITEST) if material.alpha_texture else 1.0
        kept = min(max(alpha, 0.0), highest) if alpha == alpha else 1.0
        if kept != alpha:
            self.warnings.append(f"{material.name}: alpha {alpha} is out of range, taken as {kept}")
        return kept

    def _step(self, detail: SurfaceDetail, name: str, material: int) -> tuple[Array, Array]:
        """A normal or bump map as a row of integers and one of numbers."""
        subject = f"{name}, {'bump' if detail.kind == 'bump' else 'normal'} map"
        if detail.kind not in KINDS:
            raise UsageError(subject, f"kind {detail.kind!r} is unknown", f"Use one of {', '.join(KINDS)}")
        step, numbers = np.full(STEP_INTS, -1, np.int32), np.zeros(STEP_FLOATS)
        step[KIND] = KINDS[detail.kind]
        if detail.texture is not None:
            step[TEXTURE] = self._add_texture(detail.texture, subject, material)
        numbers[STRENGTH], numbers[DISTANCE] = detail.strength, detail.distance
        numbers[COLOUR : COLOUR + 3] = detail.colour
        if not np.isfinite(numbers).all() or np.abs(numbers).max() > _STRONGEST:
            self.warnings.append(f"{subject}: its strength, distance or colour is no usable number; it is left out")
            numbers[STRENGTH] = numbers[DISTANCE] = 0.0
            numbers[COLOUR : COLOUR + 3] = 0.5, 0.5, 1.0
            step[TEXTURE] = -1
        if detail.kind == "tangent":
            row = self._layer_row(material, detail.tangents, True)
            if row is None:
                self.warnings.append(f"{subject}: {_lacks(detail.tangents)}; it is left out")
                return self._step(replace(detail, kind="bump", texture=None), name, material)
            step[TANGENTS] = row
        return step, numbers.astype(np.float32)

    def _add_texture(self, texture: Texture, subject: str, material: int) -> int:
        """Row of a new texture."""
        codes = []
        for name, known in (
            ("channel", CHANNELS),
            ("interpolation", INTERPOLATIONS),
            ("extension", EXTENSIONS),
        ):
            value = getattr(texture, name)
            if value not in known:
                raise UsageError(subject, f"{name} {value!r} is unknown", f"Use one of {', '.join(known)}")
            codes.append(known[value])
        transform = np.asarray(texture.transform, np.float64)
        if transform.shape != (2, 3) or not np.isfinite(transform).all():
            self.warnings.append(f"{subject}: its transform is not made of 2 x 3 finite numbers, ignored")
            transform = np.eye(2, 3)
        layer, image = -1, -1
        if texture.layer or not texture.image:
            found = self._layer_row(material, texture.layer, False)
            if found is None:
                self.warnings.append(f"{subject}: {_lacks(texture.layer)}")
            layer = -1 if found is None else found
        if texture.image or layer < 0:
            image = self._add_image(texture.image, subject)
        self._textures.append((image, codes[0], codes[1], codes[2], layer))
        self._transforms.append(transform.ravel())
        return len(self._textures) - 1

    def _add_image(self, name: str, subject: str) -> int:
        """Row of an image, known or new."""
        if name not in self._rows:
            self._rows[name] = len(self._rows)
            image = self._given.get(name)
            if image is None:
                problem = f"{subject}: image {name!r} is missing" if name else ""
                texels = _Texels(_MISSING, "linear", _MISSING, BYTE, problem)
            else:
                before = self._known.get(name)
                texels = before if before is not None and before.fits(image) else _read(image)
            self._images[name] = texels
            if texels.warning:
                self.warnings.append(texels.warning)
        return self._rows[name]


def _lacks(layer: str) -> str:
    return f"its mesh has no layer {layer!r}" if layer else "its mesh has no texture coordinates"


def _read(image: Image) -> _Texels:
    """Make an image's pixels ready; they are copied only when something is wrong with them."""
    given = image.pixels
    subject = f"image {image.name!r}"
    if image.encoding not in ("linear", "srgb"):
        raise UsageError(subject, f"encoding {image.encoding!r} is unknown", "Use linear or srgb")
    srgb = image.encoding == "srgb"
    pixels = np.asarray(given)
    problem = ""
    known = (1, 3, 4) if pixels.dtype == np.uint8 else (4,)
    if pixels.ndim != 3 or pixels.shape[2] not in known or pixels.dtype.kind not in "uf":
        problem = f"{subject}: shape {pixels.shape} of {pixels.dtype} is not an RGBA picture, taken as missing"
    elif pixels.size == 0:
        problem = f"{subject}: has no pixels, taken as missing"
    if problem:
        return _Texels(given, image.encoding, _MISSING, BYTE, problem)
    if pixels.dtype == np.uint8:
        return _Texels(given, image.encoding, np.ascontiguousarray(pixels), BYTE_SRGB if srgb else BYTE, "")
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
    return _Texels(given, image.encoding, texels, FLOAT, problem)


@njit
def _material_many(material, uv, face, where, addresses, out):  # type: ignore[no-untyped-def]
    for i in range(len(material)):
        place = uv[i, 0], uv[i, 1], face[i], where[i, 0], where[i, 1]
        r, g, b, roughness, metallic, er, eg, eb = material_at(material[i], place, addresses)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = r, g, b, roughness, metallic
        out[i, 5], out[i, 6], out[i, 7] = er, eg, eb
