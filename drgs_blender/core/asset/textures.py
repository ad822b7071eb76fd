"""Textures of an asset's mesh: coordinates at its corners, images as files, and the materials that use them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import Any

import numpy as np

from ..arrays import outside
from ..errors import AssetError

Array = np.ndarray

#: What images of a material are for. Of the roughness the green channel counts, of the metallic the blue one (glTF);
#: normals are in tangent space (MikkTSpace), 2 RGB - 1, green upwards; of opacity and specular the alpha counts where
#: an image has any, else the red channel; of the coat the red one.
SLOTS = ("albedo", "roughness", "metallic", "normal", "opacity", "emission", "specular", "coat")
ALBEDO, ROUGHNESS, METALLIC, NORMAL, OPACITY, EMISSION, SPECULAR, COAT = range(len(SLOTS))
#: Those whose images are colours, in sRGB; others are linear.
COLOURED = (ALBEDO, EMISSION)
#: Columns of the factors of each slot.
FACTORS = (
    slice(0, 3), slice(3, 4), slice(4, 5), slice(5, 6), slice(6, 7), slice(7, 10), slice(10, 11), slice(11, 12),
)  # fmt: skip
FACTOR_COUNT = FACTORS[-1].stop
#: Arrays with a column a slot or factor: how many there are of the first four slots, which files had before others.
_FIRST = {"slots": 4, "factors": 6, "transforms": 4, "extensions": 4}
#: Before the name of such an array of the other slots in a file, which has them where any material has one.
OPTIONAL = "optional_"
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
    slots : (k, 8) int32 array
        Images for `SLOTS`, by their order in `images`; -1: values of the vertices, or no normal map.
    factors : (k, 12) float32 array
        Times the images: albedo (linear Rec.709), roughness, metallic, strength of the normal map, opacity, emission
        (linear Rec.709 radiance), specular level, coat.
    transforms : (k, 8, 2, 3) float32 array
        Map (u, v, 1) to coordinates of each slot's image.
    extensions : (k, 8) int32 array
        Rows of `EXTENSIONS`. These four arrays may be given of the first four slots alone.
    names : list of str
        Of the materials.
    images : dict of str to (bytes,) uint8 array
        PNG or JPEG files by name: albedo and emission in sRGB, others linear; alpha counts where `SLOTS` says so.
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
        n = len(SLOTS)
        for name, width, neutral, dtype in (
            ("slots", n, np.array(-1), np.int32),
            ("factors", FACTOR_COUNT, np.array(1), np.float32),
            ("transforms", n, np.eye(2, 3), np.float32),
            ("extensions", n, np.array(0), np.int32),
        ):
            array = _whole(np.asarray(getattr(self, name)), _FIRST[name], width, neutral)
            setattr(self, name, _as(array, dtype, (k, width, *neutral.shape), name))
        self.images = {name: _as(data, np.uint8, (-1,), f"images/{name}") for name, data in self.images.items()}
        if self.normals is not None:
            self.normals = _as(self.normals, np.float32, (m, 3, 3), "normals")
        for name, values, low, high in (
            ("material", self.material, -1, k),
            ("slots", self.slots, -1, len(self.images)),
            ("extensions", self.extensions, 0, len(EXTENSIONS)),
        ):
            if (wrong := outside(values, high, low)) is not None:
                raise AssetError(f"textures {name}", f"refer to number {wrong} of {high}", _REMEDY)

    @property
    def optional(self) -> tuple[str, ...]:
        """Optional channels of which a material has an image."""
        return tuple(SLOTS[slot] for slot in range(OPACITY, len(SLOTS)) if (self.slots[:, slot] >= 0).any())

    def channel(self, slot: int, number: int) -> str:
        """Channel that counts of image `number` in a slot: "rgb", "r", "g", "b" or "a"."""
        if slot in (OPACITY, SPECULAR):
            return "a" if has_alpha(self.files[number][1].tobytes()) else "r"
        return {ROUGHNESS: "g", METALLIC: "b", COAT: "r"}.get(slot, "rgb")

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
    others = {OPTIONAL + name: numbers[name][:, first:] for name, first in _FIRST.items()}
    numbers |= {name: numbers[name][:, :first] for name, first in _FIRST.items()}
    if (others[f"{OPTIONAL}slots"] >= 0).any():
        numbers |= others
    names = "\n".join(name.replace("\n", " ") for name in textures.names).encode()
    fields = {name: array for name, array in numbers.items() if array is not None}
    fields |= {"names": np.frombuffer(names, np.uint8)}
    return fields | {f"images/{name}": data for name, data in textures.images.items()}


def textures_of(tensors: dict[str, Array], faces: int, where: str) -> MeshTextures:
    """The inverse of `tensors_of`, for a mesh of `faces`. Raises AssetError where they do not fit."""
    numbers = {name: array for name, array in tensors.items() if "/" not in name and name != "names"}
    images = {name.removeprefix("images/"): data for name, data in tensors.items() if name.startswith("images/")}
    others = {name: numbers.pop(OPTIONAL + name, None) for name in _FIRST}
    if any(other is not None for other in others.values()):
        for name, other in others.items():
            first = numbers[name]
            if (
                other is None
                or other.ndim < 2
                or other.shape[:1] + other.shape[2:] != first.shape[:1] + first.shape[2:]
            ):
                raise AssetError(f"{where}, {OPTIONAL}{name}", f"does not fit its {name}", _REMEDY)
            numbers[name] = np.concatenate([first, other], axis=1)
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


def has_alpha(data: bytes) -> bool:
    """Whether an image file has alpha: of PNG (RFC 2083) the type of its colours says it, or a chunk before these."""
    if not data.startswith(_MAGIC[".png"]) or len(data) < 26:
        return False
    return data[25] in (4, 6) or b"tRNS" in data[: data.find(b"IDAT")]


def without(textures: MeshTextures, faces: Array) -> MeshTextures | None:
    """Textures with values of the vertices in some slots of some faces; None where no face has an image left.

    Parameters
    ----------
    textures : MeshTextures
    faces : (m, 8) bool array
        Which slots of which faces.
    """
    bits = np.arange(len(SLOTS))
    kept, number = split(textures, faces @ (1 << bits))
    parted = (number[:, None] >> bits) & 1 > 0
    slots = np.where(parted, -1, kept.slots)
    return _used(replace(kept, slots=slots.astype(np.int32)))


def join_textures(parts: Sequence[MeshTextures], normals: Array | None) -> MeshTextures:
    """Textures of several meshes as those of one with all their faces; `normals` (m, 3, 3) at its corners."""
    columns: dict[str, list[Array]] = {name: [] for name in ("uvs", "material", "slots", *_FIRST)}
    names: list[str] = []
    images: dict[str, Array] = {}
    for part in parts:
        for name in ("uvs", "factors", "transforms", "extensions"):
            columns[name].append(getattr(part, name))
        for name, first in (("material", len(names)), ("slots", len(images))):
            numbers = getattr(part, name)
            columns[name].append(np.where(numbers < 0, -1, numbers + first).astype(np.int32))
        names += part.names
        for name, data in part.images.items():
            free = chain([name], (f"{name}.{i:03d}" for i in count(1)))
            images[next(n for n in free if n not in images)] = data
    return MeshTextures(
        **{name: np.concatenate(arrays) for name, arrays in columns.items()},
        names=names,
        images=images,
        normals=normals,
    )


def no_textures(faces: int) -> MeshTextures:
    """Those of a mesh of a number of `faces` that has only values of its vertices."""
    return MeshTextures(
        np.zeros((faces, 3, 2), np.float32), np.full(faces, -1), np.empty((0, 8)), np.empty((0, FACTOR_COUNT)),
        np.empty((0, 8, 2, 3)), np.empty((0, 8)), [],
    )  # fmt: skip


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


def _whole(array: Array, first: int, count: int, neutral: Array) -> Array:
    """An array of the `first` columns with neutral ones of the others; any other as it is."""
    if array.ndim < 2 or array.shape[1] != first or array.shape[2:] != neutral.shape:
        return array
    return np.concatenate([array, np.broadcast_to(neutral, (len(array), count - first, *neutral.shape))], axis=1)


def _as(values: Any, dtype: type, shape: tuple[int, ...], name: str) -> Array:
    """`values` as a C-contiguous array of `shape` (-1 is free); AssetError else."""
    array: Array = np.ascontiguousarray(values, dtype)
    if array.ndim != len(shape) or any(w not in (-1, g) for w, g in zip(shape, array.shape, strict=True)):
        raise AssetError(f"textures {name}", f"have shape {array.shape}, expected {shape}", _REMEDY)
    return array
