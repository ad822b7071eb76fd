"""Textures of an asset's mesh: coordinates at its corners, images as files, and the materials that use them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..errors import AssetError

Array = np.ndarray

#: What images of a material are for. Of the roughness the green channel counts, of the metallic the blue one (glTF);
#: normals are in tangent space (MikkTSpace), 2 RGB - 1, green upwards.
SLOTS = ("albedo", "roughness", "metallic", "normal")
ALBEDO, ROUGHNESS, METALLIC, NORMAL = range(4)
#: How images go on outside [0, 1], in the words of `core.materials.Texture`.
EXTENSIONS = ("repeat", "extend", "mirror")
#: First bytes of the files that images may be.
_MAGIC = {".png": b"\x89PNG\r\n\x1a\n", ".jpg": b"\xff\xd8\xff"}
_REMEDY = "Make the asset again"


@dataclass(slots=True)
class MeshTextures:
    """Images on the faces of a mesh of m faces, in k materials.

    Attributes
    ----------
    uvs : (m, 3, 2) float32 array
        Coordinates at the corners; v = 0 is the bottom edge of an image.
    material : (m,) int32 array
        Of each face; -1: its materials are those of its vertices.
    slots : (k, 4) int32 array
        Images for `SLOTS`, by their order in `images`; -1: values of the vertices, or no normal map.
    factors : (k, 6) float32 array
        Times the images: albedo (linear Rec.709), roughness, metallic, strength of the normal map.
    transforms : (k, 4, 2, 3) float32 array
        Map (u, v, 1) to coordinates of each slot's image.
    extensions : (k, 4) int32 array
        Rows of `EXTENSIONS`.
    names : list of str
        Of the materials.
    images : dict of str to (bytes,) uint8 array
        PNG or JPEG files by name: albedo in sRGB, others linear; alpha is not looked at.
    normals : (m, 3, 3) float32 array, optional
        Unit shading normals at the corners, object space, at rest; None: smooth ones of the vertices.
    """

    uvs: Array
    material: Array
    slots: Array
    factors: Array
    transforms: Array
    extensions: Array
    names: list[str]
    images: dict[str, Array] = field(default_factory=dict)
    normals: Array | None = None

    def __post_init__(self) -> None:
        self.material = _as(self.material, np.int32, (-1,), "material")
        m, k = len(self.material), len(self.names)
        self.uvs = _as(self.uvs, np.float32, (m, 3, 2), "uvs")
        self.slots = _as(self.slots, np.int32, (k, 4), "slots")
        self.factors = _as(self.factors, np.float32, (k, 6), "factors")
        self.transforms = _as(self.transforms, np.float32, (k, 4, 2, 3), "transforms")
        self.extensions = _as(self.extensions, np.int32, (k, 4), "extensions")
        self.images = {name: _as(data, np.uint8, (-1,), f"images/{name}") for name, data in self.images.items()}
        if self.normals is not None:
            self.normals = _as(self.normals, np.float32, (m, 3, 3), "normals")
        for name, values, low, high in (
            ("material", self.material, -1, k),
            ("slots", self.slots, -1, len(self.images)),
            ("extensions", self.extensions, 0, len(EXTENSIONS)),
        ):
            if values.size and (values.min() < low or values.max() >= high):
                worst = values.min() if values.min() < low else values.max()
                raise AssetError(f"textures {name}", f"refer to number {int(worst)} of {high}", _REMEDY)

    @property
    def files(self) -> list[tuple[str, Array]]:
        """Name with suffix and content of each image."""
        return [(f"{name}{image_suffix(data)}", data) for name, data in self.images.items()]


def check_textures(textures: MeshTextures, faces: int, where: str) -> None:
    """Raise AssetError where textures do not fit a mesh of a number of `faces`, or have what cannot be used."""
    if len(textures.material) != faces:
        raise AssetError(where, f"has materials of {len(textures.material)} faces for {faces}", _REMEDY)
    for name, data in textures.images.items():
        if not image_suffix(data):
            raise AssetError(f"{where}, images/{name}", "is neither a PNG nor a JPEG file", _REMEDY)
    for name, array in tensors_of(textures).items():
        if array.dtype.kind == "f" and array.size and not np.isfinite(array.sum(dtype=np.float64)):
            bad = int(np.count_nonzero(~np.isfinite(array)))
            raise AssetError(f"{where}, {name}", f"has {bad} values that are NaN or infinite", _REMEDY)


def tensors_of(textures: MeshTextures) -> dict[str, Array]:
    """All arrays by the names they have in a file."""
    numbers = {name: getattr(textures, name) for name in MeshTextures.__slots__ if name not in ("names", "images")}
    names = "\n".join(name.replace("\n", " ") for name in textures.names).encode()
    fields = {name: array for name, array in numbers.items() if array is not None}
    fields |= {"names": np.frombuffer(names, np.uint8)}
    return fields | {f"images/{name}": data for name, data in textures.images.items()}


def textures_of(tensors: dict[str, Array], faces: int, where: str) -> MeshTextures:
    """The inverse of `tensors_of`, for a mesh of `faces`. Raises AssetError where they do not fit."""
    numbers = {name: array for name, array in tensors.items() if "/" not in name and name != "names"}
    images = {name.removeprefix("images/"): data for name, data in tensors.items() if name.startswith("images/")}
    names = tensors["names"].tobytes().decode(errors="replace").split("\n") if len(tensors["slots"]) else []
    try:
        textures = MeshTextures(**numbers, names=names, images=images)
    except AssetError as error:
        raise AssetError(f"{where}, {error.subject}", error.problem, error.remedy) from error
    check_textures(textures, faces, where)
    return textures


def image_suffix(data: Array | bytes) -> str:
    """Suffix of an image file by its content, ".png" or ".jpg"; "" of anything else."""
    return next((suffix for suffix, magic in _MAGIC.items() if bytes(data[: len(magic)]) == magic), "")


def without(textures: MeshTextures, faces: Array) -> MeshTextures | None:
    """Textures with values of the vertices in some slots of some faces; None where no face has an image left.

    Parameters
    ----------
    textures : MeshTextures
    faces : (m, 4) bool array
        Which slots of which faces.
    """
    kept, number = split(textures, faces @ (1 << np.arange(4)))
    parted = (number[:, None] >> np.arange(4)) & 1 > 0
    slots = np.where(parted, -1, kept.slots)
    return _used(replace(kept, slots=slots.astype(np.int32)))


def split(textures: MeshTextures, number: Array) -> tuple[MeshTextures, Array]:
    """Textures whose faces of different (m,) `number` have materials of their own, and the number of each material."""
    there = textures.material >= 0
    keys = np.stack([textures.material, np.where(there, number, 0)], axis=1)
    kinds, index = np.unique(keys, axis=0, return_inverse=True)
    first = int((kinds[:, 0] < 0).sum())
    own = kinds[first:, 0]
    parted = replace(
        textures,
        material=(index.reshape(-1) - first).clip(-1).astype(np.int32),
        names=[textures.names[i] for i in own],
        **{name: getattr(textures, name)[own] for name in ("slots", "factors", "transforms", "extensions")},
    )
    return parted, kinds[first:, 1]


def _used(textures: MeshTextures) -> MeshTextures | None:
    """Textures without materials that have no image; None where there are no others."""
    met = np.bincount(textures.material[textures.material >= 0], minlength=len(textures.names)) > 0
    used: Array = (textures.slots >= 0).any(axis=1) & met
    if not used.any():
        return None
    number = np.append(np.where(used, np.cumsum(used) - 1, -1), -1)
    return replace(
        textures,
        material=number[textures.material].astype(np.int32),
        names=[name for name, keep in zip(textures.names, used, strict=True) if keep],
        **{name: getattr(textures, name)[used] for name in ("slots", "factors", "transforms", "extensions")},
    )


def _as(values: Any, dtype: type, shape: tuple[int, ...], name: str) -> Array:
    """`values` as a C-contiguous array of `shape` (-1 is free); AssetError else."""
    array: Array = np.ascontiguousarray(values, dtype)
    if array.ndim != len(shape) or any(w not in (-1, g) for w, g in zip(shape, array.shape, strict=True)):
        raise AssetError(f"textures {name}", f"have shape {array.shape}, expected {shape}", _REMEDY)
    return array
