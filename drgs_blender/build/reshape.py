"""An asset with another shape: vertices moved, faces deleted or copied, and new faces that get surfels of their own."""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..core.arrays import outside
from ..core.asset.model import (
    BASE_CHANNELS,
    MATERIAL_CHANNELS,
    SURFEL_CHANNELS,
    Array,
    Asset,
    Binding,
    Mesh,
    Surfels,
    neutral_values,
)
from ..core.asset.part import Part, part_of, vertices_of
from ..core.asset.textures import MeshTextures
from ..core.color import linear_to_srgb
from ..core.errors import AssetError
from ..core.floaters import median_size
from ..deform.attach import attach
from ..deform.face_frames import Faces
from ..deform.mesh_driven import MeshDriven
from ..formats.harmonics import SH_C0
from .export import surfels_of_pose

log = logging.getLogger(__name__)

#: Longest edge of the piece of a new face that has a surfel, in medians of the larger deviation of the others.
_PIECE = 2.5
#: Known vertices by which the materials of a new one are interpolated.
_NEAREST = 8
_REMEDY = "Write it again"


@dataclass(slots=True)
class Edit:
    """A mesh that was made of an asset's by hand.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        Metres, object space, at rest.
    source : (n,) int32 array
        The asset's vertex that each is; -1: a new one.
    faces : (m, 3) int32 array
        Its triangles; corner by corner as the asset's where they are of that.
    face : (m,) int32 array
        The asset's face that each is; -1: a new one.
    removed : (k,) int32 array, optional
        Surfels that are left out.
    """

    vertices: Array
    source: Array
    faces: Array
    face: Array
    removed: Array | None = None


def reshape(asset: Asset, edit: Edit, subject: str = "edit") -> tuple[Asset, dict[str, int]]:
    """The asset with the shape of an edited mesh as its shape at rest, and how many faces and surfels are new.

    Surfels follow their faces as in every pose. New vertices have the materials of those around them, new faces surfels
    as large as the others, opaque, in these materials.

    Parameters
    ----------
    asset : Asset
    edit : Edit
    subject : str
        For messages.

    Raises
    ------
    AssetError
        The edit does not fit the asset, or leaves nothing of it.
    """
    _check(edit, subject)
    known, old = edit.source >= 0, edit.face >= 0
    number = np.cumsum(known, dtype=np.int32) - 1
    if not old.any():
        raise AssetError(subject, "has no face of its asset left", "Make an asset of the mesh instead")
    if not known[edit.faces[old]].all():
        raise AssetError(subject, "calls faces with new vertices those of its asset", _REMEDY)
    part = Part(edit.source[known], number[edit.faces[old]], edit.face[old], edit.removed)
    cut = part_of(asset, part, subject)
    surfels, binding = cut.surfels, cut.binding
    if binding is None:
        raise AssetError(subject, "is of an asset whose surfels are bound to no mesh", "Import it with a mesh")
    moved = not np.array_equal(edit.vertices[known], cut.mesh.vertices)
    if moved:
        surfels, binding = follow(cut, edit.vertices[known])
    order = np.r_[np.flatnonzero(old), np.flatnonzero(~old)]
    mesh = _whole(cut.mesh, edit, known, order, int(old.sum()), moved)
    new = edit.faces[~old]
    if len(new):
        more, hung = _new_surfels(mesh, new, surfels)
        hung.face = (hung.face + int(old.sum())).astype(np.int32)
        surfels = _joined(surfels, more)
        binding = Binding(*(np.concatenate([getattr(binding, f.name), getattr(hung, f.name)]) for f in fields(Binding)))
    counts = {"new_faces": len(new), "new_surfels": len(surfels) - len(cut.surfels), "moved": int(moved)}
    return replace(asset, mesh=mesh, surfels=surfels, binding=binding), counts


def _check(edit: Edit, subject: str) -> None:
    n, m = len(edit.vertices), len(edit.faces)
    for name, array, shape, kind in (
        ("vertices", edit.vertices, (n, 3), "f"),
        ("source", edit.source, (n,), "i"),
        ("faces", edit.faces, (m, 3), "i"),
        ("face", edit.face, (m,), "i"),
    ):
        if array.shape != shape or array.dtype.kind != kind:
            raise AssetError(subject, f"{name} have shape {array.shape} and type {array.dtype}", _REMEDY)
    if not np.isfinite(edit.vertices).all():
        raise AssetError(
            subject, f"{int((~np.isfinite(edit.vertices)).any(axis=1).sum())} vertices are not finite", "Correct them"
        )
    if (wrong := outside(edit.faces, n)) is not None:
        raise AssetError(subject, f"faces refer to vertex {wrong} of {n}", _REMEDY)


def follow(cut: Asset, vertices: Array) -> tuple[Surfels, Binding]:
    """Surfels and binding of an asset whose mesh has other (n, 3) vertices at rest."""
    assert cut.binding is not None
    posed = surfels_of_pose(cut.surfels, MeshDriven(cut.mesh, cut.surfels, cut.binding).pose(vertices))
    extras = cut.surfels.extras | posed.extras
    surfels = replace(
        cut.surfels, centre=posed.centre, scale=posed.scale, rotation=posed.rotation, sh=posed.sh, extras=extras
    )
    edge = Faces.of(cut.mesh.vertices, cut.mesh.faces).mean_edge
    new = np.maximum(Faces.of(vertices, cut.mesh.faces).mean_edge, 1e-12)
    return surfels, replace(cut.binding, offset=cut.binding.offset * (edge / new)[cut.binding.face])


def _whole(cut: Mesh, edit: Edit, known: Array, order: Array, old: int, moved: bool) -> Mesh:
    """The mesh of all vertices and faces, those of the asset first."""
    nearest, weight = _blends(edit, known)

    def all_of(values: Array) -> Array:
        found = np.empty((len(known), *values.shape[1:]), np.float32)
        found[known] = values
        found[~known] = np.einsum("nk,nk...->n...", weight, values[nearest])
        return found

    channels: dict[str, Any] = {
        name: None if (values := getattr(cut, name)) is None else all_of(values) for name in MATERIAL_CHANNELS
    }
    rows = np.flatnonzero(known)
    groups = {name: rows[members].astype(np.int32) for name, members in cut.groups.items()}
    textures = None if cut.textures is None else _textures(cut.textures, len(order) - old, moved)
    return Mesh(edit.vertices, edit.faces[order], groups=groups, textures=textures, **channels)


def _blends(edit: Edit, known: Array) -> tuple[Array, Array]:
    """Numbers (k, 8) among the known vertices of those nearest to each new one, and their (k, 8) weights.

    Vertices that no face of the asset is left of do not count.
    """
    used = np.zeros(len(known), bool)
    used[edit.faces[edit.face >= 0]] = True
    rows = np.flatnonzero(used[known])
    places = edit.vertices[known][rows].astype(np.float64)
    count = min(_NEAREST, len(places))
    away, nearest = cKDTree(places).query(edit.vertices[~known], k=count)
    away, nearest = away.reshape(-1, count), nearest.reshape(-1, count)
    weight = 1 / np.maximum(away, 1e-9) ** 2
    return rows[nearest], weight / weight.sum(axis=1, keepdims=True)


def _textures(textures: MeshTextures, new: int, moved: bool) -> MeshTextures:
    """Textures with `new` more faces, which show their vertices; normals of the file do not fit another shape."""
    normals = textures.normals
    if normals is not None and (moved or new):
        log.warning("normals of the file do not fit the new shape: it is shaded smooth")
        normals = None
    uvs = np.concatenate([textures.uvs, np.zeros((new, 3, 2), np.float32)])
    return replace(
        textures, uvs=uvs, material=np.append(textures.material, np.full(new, -1, np.int32)), normals=normals
    )


def _new_surfels(mesh: Mesh, faces: Array, others: Surfels) -> tuple[Surfels, Binding]:
    """Surfels on new faces, with the materials of the mesh; as large as the `others`."""
    rows, local = np.unique(faces, return_inverse=True)
    patch = replace(vertices_of(mesh, rows), faces=local.reshape(-1, 3))
    diagonal = float(np.linalg.norm(np.ptp(patch.vertices, axis=0)))
    typical = median_size(others) if len(others) else diagonal / 100
    surfels, binding, _ = attach(patch, density=max(1.0, diagonal / max(_PIECE * typical, 1e-12)))
    return surfels, binding


def _joined(first: Surfels, more: Surfels) -> Surfels:
    """Surfels of an asset, then new ones; captured colours of these are their albedo, as displayed."""
    n, k = len(first), len(more)
    found: dict[str, Any] = {
        name: np.concatenate([getattr(first, name), getattr(more, name)])
        for name in ("centre", "scale", "rotation", "opacity", *BASE_CHANNELS)
    }
    for name in SURFEL_CHANNELS:
        pair = [getattr(first, name), getattr(more, name)]
        if any(values is not None for values in pair):
            filled = [neutral_values(name, c) if v is None else v for v, c in zip(pair, (n, k), strict=True)]
            found[name] = np.concatenate(filled)
    if first.sh is not None:
        sh = np.zeros((k, *first.sh.shape[1:]), np.float32)
        sh[:, 0] = (linear_to_srgb(more.albedo) - 0.5) / SH_C0
        found["sh"] = np.concatenate([first.sh, sh])
    extras = {
        name: np.concatenate([values, np.broadcast_to(np.median(values, axis=0), (k, *values.shape[1:]))])
        for name, values in first.extras.items()
    }
    return Surfels(**found, extras=extras)
