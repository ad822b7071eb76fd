"""Textures of a file for the mesh of its asset: coordinates and normals of divided faces, images in a budget."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image as Pillow

from ..core.asset.textures import (
    ALBEDO,
    COAT,
    COLOURED,
    EMISSION,
    EXTENSIONS,
    METALLIC,
    NORMAL,
    OPACITY,
    ROUGHNESS,
    SLOTS,
    SPECULAR,
    MeshTextures,
    image_suffix,
    without,
)
from ..core.color import linear_to_srgb, to_unit
from ..formats.files import Image, MaterialFile, MeshFile
from ..geometry.normals import unit
from .surface_detail import CornerFrames
from .topology import Net

Array = np.ndarray

#: Largest side of an image that is kept as it is.
MAX_TEXTURE = 4096
#: Vertex colours nearer to white than this leave textures as they are.
_WHITE = 1e-3
_WRAP = {"repeat": "repeat", "clamp": "extend", "mirror": "mirror"}


def mesh_textures(
    net: Net, file: MeshFile, frames: CornerFrames, divided: bool, largest: int, notes: list[str]
) -> MeshTextures | None:
    """Textures of the faces of `net`; None where the file has none.

    Parameters
    ----------
    net : Net
        Made of the file, divided or not, with tags (material, part, face of `frames`).
    file : MeshFile
    frames : CornerFrames
        Of the faces that were divided.
    divided : bool
        Whether `net` has other faces than those.
    largest : int
        Side in pixels to which larger images are reduced.
    notes : list of str
        Get what is not kept.
    """
    if file.corner_uvs is None or not file.materials:
        return None
    images = _Images(largest, notes)
    shape = len(file.materials), len(SLOTS)
    slots, extensions = np.full(shape, -1, np.int32), np.zeros(shape, np.int32)
    transforms = np.tile(np.eye(2, 3), (*shape, 1, 1))
    for k in np.unique(net.tags[net.tags[:, 0] >= 0, 0]):
        m = file.materials[k]
        for slot, image in _used(m):
            slots[k, slot] = images.number(
                image, slot in COLOURED or image is m.base_colour_image, f"{m.name} {_what(slot)}"
            )
            transforms[k, slot] = image.uv_transform
            extensions[k, slot] = EXTENSIONS.index(_WRAP[image.wrap[0]])
            if slot != METALLIC and image.wrap[0] != image.wrap[1]:
                notes.append(f"{m.name}: the {_what(slot)} image goes on as {image.wrap[0]} along v, too")
    factors = [
        (*m.base_colour, m.roughness, m.metallic, m.normal_strength, m.alpha, *m.emission, m.specular, m.coat)
        for m in file.materials
    ]
    with np.errstate(over="ignore"):
        uvs = np.nan_to_num(net.uvs.astype(np.float32), posinf=0.0, neginf=0.0)
    normals = None
    if divided or file.corner_normals is not None:
        turned = np.einsum("fkj,fjc->fkc", net.inside.astype(np.float64), frames.normal[net.tags[:, 2]])
        normals = unit(turned.reshape(-1, 3)).reshape(-1, 3, 3)
    names = [m.name for m in file.materials]
    textures = MeshTextures(
        uvs, net.tags[:, 0], slots, np.nan_to_num(factors), transforms, extensions, names, images.files, normals
    )
    own = _of_vertices(net)
    shown = own[:, ALBEDO] & (np.append(slots[:, ALBEDO], -1)[net.tags[:, 0]] >= 0)
    if shown.any():
        notes.append(f"textures of {int(shown.sum())} faces with vertex colours are kept at their vertices alone")
    return without(textures, own)


def _used(m: MaterialFile) -> list[tuple[int, Image]]:
    """(slot, image) of a material."""
    surface = m.metallic_roughness_image
    images = (
        (ALBEDO, m.base_colour_image), (ROUGHNESS, surface), (METALLIC, surface), (NORMAL, m.normal_image),
        (OPACITY, _opacity_image(m)), (EMISSION, m.emission_image if any(m.emission) else None),
        (SPECULAR, m.specular_image), (COAT, m.coat_image if m.coat > 0 else None),
    )  # fmt: skip
    return [(slot, image) for slot, image in images if image is not None and image.pixels.size]


def has_opacity_image(m: MaterialFile) -> bool:
    """Whether a material lets light pass by an image."""
    image = m.alpha_image
    return image is not None and bool(image.pixels.size) and to_unit(image.pixels).min() < 1


def _opacity_image(m: MaterialFile) -> Image | None:
    """Image of the opacity of a material: that of its base colour, where the alpha is that one's as it is."""
    if not has_opacity_image(m):
        return None
    colour, alpha = m.base_colour_image, m.alpha_image
    assert alpha is not None
    own = None if colour is None else colour.alpha
    if own is None or own.pixels.shape != alpha.pixels.shape or not (own.pixels == alpha.pixels).all():
        return alpha
    return colour


def _what(slot: int) -> str:
    return "surface" if slot in (ROUGHNESS, METALLIC) else SLOTS[slot]


def _of_vertices(net: Net) -> Array:
    """(m, 8) bool: slots of faces whose vertices have values of their own."""
    own, corners = np.zeros((len(net.faces), len(SLOTS)), bool), net.values[net.faces]
    own[:, ALBEDO] = (np.abs(corners[..., :3] - 1) > _WHITE).any(axis=(1, 2))
    own[:, [ROUGHNESS, METALLIC]] = np.isfinite(corners[..., 3:5]).any(axis=1)
    return own


class _Images:
    """Images as files, each once."""

    def __init__(self, largest: int, notes: list[str]) -> None:
        self.files: dict[str, Array] = {}
        self._largest, self._notes = largest, notes
        self._known: dict[tuple[int, bool], int] = {}

    def number(self, image: Image, coloured: bool, name: str) -> int:
        """Number of an image, with the name if it is new."""
        key = id(image.pixels), coloured
        if key not in self._known:
            self._known[key] = len(self.files)
            unique = next(
                n for i in range(len(self.files) + 1) if (n := f"{name} {i}" if i else name) not in self.files
            )
            self.files[unique] = np.frombuffer(self._encoded(image, coloured, unique), np.uint8)
        return self._known[key]

    def _encoded(self, image: Image, coloured: bool, name: str) -> bytes:
        """PNG of an image, or its own file where that will do."""
        pixels = image.pixels
        height, width = pixels.shape[:2]
        step = -(-max(height, width) // self._largest)
        encoded = pixels.dtype.kind == "u" and image.srgb == coloured
        if step == 1 and pixels.dtype == np.uint8 and encoded and image.file and image_suffix(image.file):
            return image.file
        if pixels.dtype != np.uint8 and not _is_8_bits(pixels):
            self._notes.append(f"{name}: kept with 8 bits of {8 * pixels.dtype.itemsize}")
        grey = pixels.ndim == 2 or pixels.shape[2] < 3
        kept = np.repeat(pixels.reshape(height, width, -1)[..., :1], 3, axis=2) if grey else pixels[..., :4]
        if kept.dtype != np.uint8 or not encoded:
            values = to_unit(kept).copy()
            if coloured and not encoded:
                values[..., :3] = linear_to_srgb(values[..., :3])
            kept = np.rint(np.clip(np.nan_to_num(values), 0, 1) * 255).astype(np.uint8)
        picture = Pillow.fromarray(np.ascontiguousarray(kept))
        if step > 1:
            picture = picture.reduce(step)
            self._notes.append(f"{name}: {width} x {height} pixels reduced to {picture.width} x {picture.height}")
        data = io.BytesIO()
        picture.save(data, "PNG", compress_level=6)
        return data.getvalue()


def _is_8_bits(pixels: Array) -> bool:
    """Whether floats are those of bytes, or of nothing and all."""
    values = pixels * np.float32(255) if pixels.dtype.kind == "f" else np.full(1, 0.5)
    return bool((np.abs(values - np.rint(values)) < 1e-3).all() and values.min() >= 0 and values.max() <= 255.001)
