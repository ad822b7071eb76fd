"""Shader AOVs of meshes: what materials give to Blender's AOV Output nodes, looked up at points of a surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...compute.jit import njit
from ...core.materials import Material, Texture
from .texture_lookup import BRIGHTEST, colour_at

if TYPE_CHECKING:
    from .mesh_materials import MeshMaterials

Array = np.ndarray


def aov_tables(
    materials: Sequence[Material], add_texture: Callable[[Texture, str, int], int], warnings: list[str]
) -> dict[str, tuple[Array, Array]]:
    """Pass name -> (k, 4) float32 colours and (k,) int64 rows of textures, or -1, of k materials.

    The fourth number is 1 where a material gives something, else 0.

    Parameters
    ----------
    materials : sequence of Material
    add_texture : callable
        Gives the row of a texture, which messages call by a name, of the i-th material.
    warnings : list of str
        Values that cannot be used are added.
    """
    found: dict[str, tuple[Array, Array]] = {}
    for i, material in enumerate(materials):
        for aov in material.aovs:
            blank = np.zeros((len(materials), 4), np.float32), np.full(len(materials), -1)
            colours, rows = found.setdefault(aov.name, blank)
            given = np.array(aov.colour, np.float64)
            if not (np.abs(given) <= BRIGHTEST).all():
                warnings.append(f"{material.name}: {aov.name} {given} is out of range, taken as 0")
                given[:] = 0.0
            colours[i] = *given, 1.0
            if aov.texture is not None:
                rows[i] = add_texture(aov.texture, f"{material.name}, {aov.name}", i)
    return found


def aov_at(name: str, materials: MeshMaterials, face: Array, where: Array) -> Array:
    """(n, 4) float32: what the materials of faces give to the AOV of a pass, and 1; 0 where they give nothing.

    Parameters
    ----------
    name : str
    materials : MeshMaterials
    face : (n,) array
        Integers, from the first face that is of a mesh.
    where : (n, 2) float32 array
        Barycentric coordinates of the face's second and third corner.
    """
    out = np.zeros((len(face), 4), np.float32)
    if name not in materials.table.aovs or not len(face):
        return out
    u, v = where[:, 0, None], where[:, 1, None]
    uv = np.zeros((len(face), 2), np.float32)
    if len(materials.uvs):
        a, b, c = np.moveaxis(materials.uvs[face], 1, 0)
        uv = (1 - u - v) * a + u * b + v * c
    given = np.ascontiguousarray(materials.index[face], np.int32), np.ascontiguousarray(uv, np.float32)
    places = np.ascontiguousarray(face, np.int64), np.ascontiguousarray(where, np.float32)
    _look_up(*given, *places, *materials.table.aovs[name], materials.table.addresses, out)
    return np.nan_to_num(out)


@njit
def _look_up(material, uv, face, where, colours, rows, addresses, out):  # type: ignore[no-untyped-def]
    for i in range(len(material)):
        k = material[i]
        r, g, b = colours[k, 0], colours[k, 1], colours[k, 2]
        if rows[k] >= 0:
            place = uv[i, 0], uv[i, 1], face[i], where[i, 0], where[i, 1]
            x, y, z = colour_at(rows[k], place, addresses)
            r, g, b = r * x, g * y, b * z
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = r, g, b, colours[k, 3]
