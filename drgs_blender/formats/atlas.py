"""The materials of a mesh as pictures that every engine knows: a place in them for each triangle."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image as Pillow

from ..core.asset import Mesh
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
    """One material for the whole mesh; linear Rec.709."""

    colour: tuple[float, float, float]
    roughness: float
    metallic: float


@dataclass(slots=True)
class TexturedMaterial:
    """Materials in pictures.

    Attributes
    ----------
    colour : bytes
        PNG of the base colour, sRGB.
    surface : bytes
        PNG whose green is the roughness and whose blue is the metallic (glTF).
    uvs : (m, 3, 2) float32 array
        Of the corners of the triangles, the origin at the upper left (glTF).
    """

    colour: bytes
    surface: bytes
    uvs: Array


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
    values = vertex_materials(mesh)
    if not np.isfinite(values).all():
        raise AssetError(subject, "would hold materials that are NaN", "Make the asset again")
    if _is_uniform(values, mesh.faces):
        red, green, blue, roughness, metallic = np.median(values[np.unique(mesh.faces)], axis=0).tolist()
        return UniformMaterial((red, green, blue), roughness, metallic)
    texels, uvs = bake_atlas(values[mesh.faces], subject)
    surface = np.insert(texels[..., 3:], 0, 0.0, axis=2)
    return TexturedMaterial(_png(linear_to_srgb(texels[..., :3])), _png(surface), uvs)


def check_mesh(mesh: Mesh, subject: str) -> None:
    """Raise UsageError where `mesh` has no faces, AssetError where it has a size that no reader takes."""
    if not len(mesh.faces):
        raise UsageError(subject, "would hold a mesh without faces", "Choose an asset that has a mesh, or --as splats")
    check_extent(mesh.vertices, subject)


def vertex_materials(mesh: Mesh) -> Array:
    """(n, 5) albedo, roughness and metallic of the vertices of `mesh`, within [0, 1]."""
    return np.concatenate([mesh.albedo, mesh.roughness[:, None], mesh.metallic[:, None]], axis=1).clip(0, 1)


def material_loss(mesh: Mesh) -> str:
    """What becomes of the materials of a mesh that `mesh_material` takes, in a sentence for the user."""
    if _is_uniform(vertex_materials(mesh), mesh.faces):
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
