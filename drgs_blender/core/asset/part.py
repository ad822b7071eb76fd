"""Parts of an asset: what an edited mesh has left of it, with the surfels that hang on that; copies, too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import outside
from ..errors import AssetError
from .model import OPTIONAL_CHANNELS, SURFEL_CHANNELS, Array, Asset, Binding, Mesh, Surfels

_MATERIALS = ("albedo", "roughness", "metallic")
_REMEDY = "Undo the edit, or import the asset again"


@dataclass(slots=True)
class Part:
    """Vertices and faces of an asset that an edited mesh has: without those deleted, with those duplicated.

    Attributes
    ----------
    vertices : (n,) int32 array
        The asset's vertex that each vertex of the mesh is.
    faces : (m, 3) int32 array
        Vertices of the mesh, corner by corner those of the asset's face.
    face : (m,) int32 array
        The asset's face that each is.
    removed : (k,) int32 array, optional
        Surfels of the asset that are left out though their face is there.
    """

    vertices: Array
    faces: Array
    face: Array
    removed: Array | None = None


def part_of(asset: Asset, part: Part, subject: str = "part") -> Asset:
    """The asset of the vertices, faces and surfels in a part; environment and provenance are kept.

    Surfels are in the order of the asset; where a face is there several times, so are its surfels. Where the vertices
    come from (`Mesh.source`) is not known any more.

    Parameters
    ----------
    asset : Asset
    part : Part
    subject : str
        For messages.

    Raises
    ------
    AssetError
        The part refers to what the asset does not have.
    """
    mesh = asset.mesh
    _check(asset, part, subject)
    textures = mesh.textures
    if textures is not None:
        normals = None if textures.normals is None else textures.normals[part.face]
        textures = replace(
            textures, uvs=textures.uvs[part.face], material=textures.material[part.face], normals=normals
        )
    cut = replace(vertices_of(mesh, part.vertices), faces=part.faces, textures=textures)
    surfels, binding = asset.surfels, asset.binding
    if binding is not None:
        rows, faces = _surfels_of(binding.face, part, len(mesh.faces))
        surfels = taken(surfels, rows)
        binding = Binding(faces, binding.barycentric[rows], binding.offset[rows], binding.normal[rows])
    elif part.removed is not None:
        surfels = taken(surfels, np.delete(np.arange(len(surfels)), part.removed))
    return replace(asset, mesh=cut, surfels=surfels, binding=binding)


def has_surfels(asset: Asset, part: Part) -> bool:
    """Whether a part of an asset has any surfel."""
    kept = np.ones(len(asset.surfels), bool)
    if part.removed is not None:
        kept[part.removed] = False
    if asset.binding is None:
        return bool(kept.any())
    there = np.zeros(len(asset.mesh.faces), bool)
    there[part.face] = True
    return bool((there[asset.binding.face] & kept).any())


def whole_of(mesh: Mesh) -> Part:
    """The part that is all of a mesh, in its order."""
    return Part(np.arange(len(mesh.vertices), dtype=np.int32), mesh.faces, np.arange(len(mesh.faces), dtype=np.int32))


def part_of_faces(mesh: Mesh, faces: Array) -> Part:
    """The part of some faces of a mesh, (m,) bool, with the vertices that they use."""
    rows = np.unique(mesh.faces[faces])
    number = np.full(len(mesh.vertices), -1, np.int32)
    number[rows] = np.arange(len(rows))
    return Part(rows.astype(np.int32), number[mesh.faces[faces]], np.flatnonzero(faces).astype(np.int32))


def vertices_of(mesh: Mesh, rows: Array) -> Mesh:
    """A mesh without faces of the vertices `rows`, (n,) int32, with their channels and groups."""
    values: dict[str, Any] = {name: getattr(mesh, name) for name in ("vertices", *_MATERIALS, *OPTIONAL_CHANNELS)}
    chosen: dict[str, Any] = {name: None if value is None else value[rows] for name, value in values.items()}
    groups = {name: np.flatnonzero(np.isin(rows, of)).astype(np.int32) for name, of in mesh.groups.items()}
    return Mesh(faces=np.empty((0, 3), np.int32), groups=groups, **chosen)


def _check(asset: Asset, part: Part, subject: str) -> None:
    """AssetError where arrays of a part do not fit each other or its asset."""
    for name, rows, shape, count in (
        ("vertices", part.vertices, (-1,), len(asset.mesh.vertices)),
        ("faces", part.faces, (-1, 3), len(part.vertices)),
        ("face", part.face, (len(part.faces),), len(asset.mesh.faces)),
        ("removed", part.removed, (-1,), len(asset.surfels)),
    ):
        if rows is None:
            continue
        fits = rows.dtype.kind == "i" and rows.ndim == len(shape)
        if not fits or any(wanted not in (-1, found) for wanted, found in zip(shape, rows.shape, strict=True)):
            raise AssetError(subject, f"{name} of its part have shape {rows.shape} and type {rows.dtype}", _REMEDY)
        if (wrong := outside(rows, count)) is not None:
            raise AssetError(subject, f"{name} of its part refer to number {wrong} of {count}", _REMEDY)


def _surfels_of(face: Array, part: Part, faces: int) -> tuple[Array, Array]:
    """(k,) surfels that hang on the faces of a part, in order, and the (k,) face of the part that each hangs on.

    Parameters
    ----------
    face : (n,) int32 array
        The asset's face of each surfel.
    part : Part
    faces : int
        Of the asset.
    """
    kept = np.ones(len(face), bool)
    if part.removed is not None:
        kept[part.removed] = False
    by_face = np.flatnonzero(kept)[np.argsort(face[kept], kind="stable")]
    count = np.bincount(face[kept], minlength=faces)
    first = np.cumsum(count) - count
    of_part = count[part.face]
    within = np.arange(of_part.sum()) - np.repeat(np.cumsum(of_part) - of_part, of_part)
    rows = by_face[np.repeat(first[part.face], of_part) + within]
    hangs_on = np.repeat(np.arange(len(part.face), dtype=np.int32), of_part)
    order = np.argsort(rows, kind="stable")
    return rows[order], hangs_on[order]


def taken(surfels: Surfels, rows: Array | slice) -> Surfels:
    """The surfels `rows`, (k,) int array or a slice."""
    names = ("centre", "scale", "rotation", "opacity", *_MATERIALS, "sh", *SURFEL_CHANNELS)
    values: dict[str, Any] = {name: getattr(surfels, name) for name in names}
    chosen: dict[str, Any] = {name: None if value is None else value[rows] for name, value in values.items()}
    return Surfels(**chosen, extras={name: values[rows] for name, values in surfels.extras.items()})


def taken_binding(binding: Binding, rows: Array | slice) -> Binding:
    """The binding of the surfels `rows`, (k,) int array or a slice."""
    return Binding(binding.face[rows], binding.barycentric[rows], binding.offset[rows], binding.normal[rows])


def with_surfels(asset: Asset, rows: Array | slice) -> Asset:
    """The asset with the surfels `rows` alone, (k,) int array or a slice, in that order."""
    binding = None if asset.binding is None else taken_binding(asset.binding, rows)
    return replace(asset, surfels=taken(asset.surfels, rows), binding=binding)
