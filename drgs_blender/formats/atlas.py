"""The materials of a mesh as pictures that every engine knows: a place in them for each triangle."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image as Pillow

from ..core.asset import MATERIAL_CHANNELS, Mesh
from ..core.color import linear_to_srgb
from ..core.errors import AssetError, UsageError
from .mesh import check_extent

Array = np.ndarray

#: Texels along the side of a square that two triangles share. The corners of each lie on the centres of texels one
#: apart, and all texels that filtering can touch from inside a triangle are its own.
CELL = 4
#: The three texels of a triangle and the others that it touches, from its first corner; the other triangle of the
#: square is turned by half a turn.
_OFFSETS = np.array([(i, j) for i in range(CELL - 1) for j in range(CELL - 1 - i)])
#: Largest side of a texture that everything reads.
_LARGEST = 16384
#: Materials that differ by less than this are one.
SAME = 1 / 512


@dataclass(slots=True)
class UniformMaterial:
    """One material for all of some faces; linear Rec.709, see `core.asset.model.MATERIAL_CHANNELS`."""

    colour: tuple[float, float, float]
    roughness: float
    metallic: float
    opacity: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    specular: float = 0.5
    coat: float = 0.0


@dataclass(slots=True)
class TexturedMaterial:
    """Materials in pictures.

    Attributes
    ----------
    colour : bytes
        PNG of the base colour, sRGB; with alpha where the mesh has opacity.
    surface : bytes
        PNG whose green is the roughness and whose blue is the metallic (glTF).
    uvs : (m, 3, 2) float32 array
        Of the corners of the triangles, the origin at the upper left (glTF).
    translucent : bool
        Whether `colour` has alpha.
    emission : bytes, optional
        PNG of the radiance over `strength`, sRGB.
    strength : float
        The largest radiance.
    layers : bytes, optional
        PNG whose red is the coat, and whose alpha is the specular level over `level`.
    level : float
        The largest specular level.
    """

    colour: bytes
    surface: bytes
    uvs: Array
    translucent: bool = False
    emission: bytes | None = None
    strength: float = 0.0
    layers: bytes | None = None
    level: float = 0.5


def mesh_material(mesh: Mesh, subject: str) -> UniformMaterial | TexturedMaterial:
    """Material of the surface of `mesh` for other programs.

    Each triangle has a place of its own in the pictures, where they hold the interpolation of its corners' materials;
    without mip maps that is what is shown.

    Raises
    ------
    UsageError
        The mesh has no faces, or more than a picture has room for; names `subject`.
    AssetError
        It has values that are not finite, or a size that no reader takes.
    """
    check_mesh(mesh, subject)
    values, columns = vertex_channels(mesh)
    if not np.isfinite(values).all():
        raise AssetError(subject, "would hold materials that are NaN", "Make the asset again")
    if _is_uniform(values, mesh.faces):
        middle = np.median(values[np.unique(mesh.faces)], axis=0)
        return UniformMaterial(**uniform_channels(middle, columns))
    strength = {name: max(float(values[:, own].max()), 1e-12) for name, own in columns.items()}
    for name in ("emission", "specular"):
        if name in columns:
            values[:, columns[name]] /= strength[name]
    texels, uvs = bake_atlas(values[mesh.faces], subject)
    found = {name: texels[..., own] for name, own in columns.items()}
    surface = np.concatenate([np.zeros_like(found["roughness"]), found["roughness"], found["metallic"]], axis=2)
    colour = linear_to_srgb(found["albedo"])
    if "opacity" in found:
        colour = np.concatenate([colour, found["opacity"]], axis=2)
    made = TexturedMaterial(_png(colour), _png(surface), uvs, "opacity" in found)
    if "emission" in found:
        made.emission, made.strength = _png(linear_to_srgb(found["emission"])), strength["emission"]
    if "specular" in found or "coat" in found:
        layers = np.ones((*texels.shape[:2], 4), np.float32)
        layers[..., :1] = found.get("coat", np.float32(0.0))
        if "specular" in found:
            layers[..., 3:], made.level = found["specular"], strength["specular"]
        made.layers = _png(layers)
    return made


def vertex_channels(mesh: Mesh) -> tuple[Array, dict[str, slice]]:
    """Material channels of the vertices side by side, (n, c) float32, and where each is; albedo first."""
    columns, parts, width = {}, [], 0
    for name in mesh.channels:
        limit = MATERIAL_CHANNELS[name].limit
        part = getattr(mesh, name).reshape(len(mesh.vertices), -1).clip(0, limit)
        columns[name] = slice(width, width + part.shape[1])
        parts.append(part)
        width += part.shape[1]
    return np.concatenate(parts, axis=1), columns


def uniform_channels(values: Array, columns: dict[str, slice]) -> dict[str, Any]:
    """Fields of a `UniformMaterial` with (c,) `values` in `columns` as `vertex_channels` has them."""
    given = {name: tuple(values[own].tolist()) for name, own in columns.items()}
    found: dict[str, Any] = {name: value if len(value) > 1 else value[0] for name, value in given.items()}
    return {"colour": found.pop("albedo"), **found}


def check_mesh(mesh: Mesh, subject: str) -> None:
    """Raise UsageError where `mesh` has no faces, AssetError where it has a size that no reader takes."""
    if not len(mesh.faces):
        raise UsageError(subject, "would hold a mesh without faces", "Choose an asset that has a mesh, or --as splats")
    check_extent(mesh.vertices, subject)


def material_loss(mesh: Mesh) -> str:
    """What becomes of the materials of a mesh that `mesh_material` takes, in a sentence for the user."""
    if _is_uniform(vertex_channels(mesh)[0], mesh.faces):
        return "one material of one colour, without UV map or textures: those of the source are lost"
    size = _side(len(mesh.faces))
    return (
        f"all materials joined into one, with a new UV map and textures of {size} x {size}: materials, UV maps and "
        "textures of the source are lost"
    )


def _is_uniform(values: Array, faces: Array) -> bool:
    """Whether the materials of the vertices of `faces` are one."""
    return bool(np.ptp(values[np.unique(faces)], axis=0).max() < SAME)


def _side(count: int) -> int:
    """Texels along the side of the texture of a number of triangles."""
    return CELL * int(np.ceil(np.sqrt(-(-count // 2))))


def bake_atlas(corner_values: Array, subject: str) -> tuple[Array, Array]:
    """Textures in which each triangle has a place of its own.

    Parameters
    ----------
    corner_values : (m, 3, c) array
        Values at the corners of triangles.
    subject : str
        Named in errors.

    Returns
    -------
    texels : (s, s, c) float32 array
        Row 0 at the top; filtered linearly they are the interpolation of the corners' values.
    uvs : (m, 3, 2) float32 array
        The origin at the upper left (glTF).
    """
    m, _, channels = corner_values.shape
    size = _side(m)
    across = size // CELL
    if size > _LARGEST:
        raise UsageError(subject, f"would need a texture {size} texels wide for {m} triangles", "Reduce the mesh first")
    square = np.arange(m) // 2
    second = np.arange(m) % 2 == 1
    origin = np.stack([square % across, square // across], axis=1) * CELL
    direction = np.where(second, -1, 1)
    start = origin + np.where(second, CELL - 1, 0)[:, None]
    # What filtering inside a triangle never meets, mip maps of other programs do: no other colour may be there.
    middle = corner_values.mean(axis=1, dtype=np.float32)
    texels = np.empty((size, size, channels), np.float32)
    texels[:] = middle.mean(axis=0)
    for i in range(CELL):
        place = start + direction[:, None] * [i, CELL - 1 - i]
        texels[place[:, 1], place[:, 0]] = middle
    a, b, c = (corner_values[:, k].astype(np.float32) for k in range(3))
    for i, j in _OFFSETS.tolist():
        place = start + direction[:, None] * [i, j]
        texels[place[:, 1], place[:, 0]] = np.clip(a + i * (b - a) + j * (c - a), 0, 1)
    steps = np.array([[0, 0], [1, 0], [0, 1]])
    centres = start[:, None] + direction[:, None, None] * steps + 0.5
    return texels, (centres / size).astype(np.float32)


def _png(picture: Array) -> bytes:
    data = io.BytesIO()
    Pillow.fromarray(np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)).save(data, "PNG", compress_level=4)
    return data.getvalue()
