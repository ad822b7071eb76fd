"""An asset on another mesh: the same surfels, bound to a retopologised surface that takes the materials of the old."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..core.arrays import outside
from ..core.asset.model import MATERIAL_CHANNELS, Array, Asset, Mesh, SourceVertices
from ..core.bare_faces import REACH
from ..core.errors import AssetError
from ..core.floaters import median_size
from ..deform.binding import bind, project
from ..deform.face_frames import Faces, dot
from ..deform.rigid import pose_by_matrix
from ..geometry.distinct_rows import distinct_row_indices
from ..geometry.normals import rotation_matrices
from .export import surfels_of_pose
from .importer import check_overlap
from .reshape import follow
from .transfer import surfels_to_vertices

log = logging.getLogger(__name__)

#: Deviation of a coarser surface that is no fault, as part of the extent of the surfels.
COARSER = 0.02
#: Part of the area of the new mesh without surfels above which that is told.
BARE = 0.01
#: Parts of the surfels whose normals agree with the old mesh, and disagree with a new one that is inside out.
INSIDE_OUT = 0.7


def swap_mesh(
    asset: Asset, vertices: Array, faces: Array, name: str = "the new mesh", source: SourceVertices | None = None
) -> tuple[Asset, dict[str, Any]]:
    """The surfels of an asset, where they are, on another mesh; and the report of `bind`.

    Its vertices have the materials of the nearest place of the old mesh, or of the surfels around where there is none,
    and are in the groups of the nearest vertex. Warnings say what the new mesh lacks.

    Parameters
    ----------
    asset : Asset
    vertices : (n, 3) float array
        Metres, object space of the asset.
    faces : (m, 3) int array
    name : str
        For messages.
    source : SourceVertices, optional
        Vertices of the file that those of the new mesh are.

    Raises
    ------
    AssetError
        The new mesh is no surface, lies elsewhere, or is inside out.
    """
    _check(vertices, faces, name)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.zeros((n, 3)), np.zeros(n), np.zeros(n), source=source)
    check_overlap(asset.surfels, mesh, "the surfels of the asset", name)
    binding, report = bind(mesh, asset.surfels)
    if report["normals_agree"] < 1 - INSIDE_OUT and (agree := _agreement(asset)) is not None and agree > INSIDE_OUT:
        raise AssetError(name, "is inside out: its faces turn away from the surfels", "Flip its normals")
    _tell_of_gaps(asset, mesh, name)
    if asset.binding is None:
        report["vertices_without_surfels"] = surfels_to_vertices(mesh, asset.surfels, binding)
    else:
        _take_materials(mesh, asset.mesh)
    if asset.mesh.textures is not None:
        log.warning("%s has other UVs: textures of the asset stay behind, its vertices have their colours", name)
    return replace(asset, mesh=mesh, binding=binding), report


def transformed(asset: Asset, matrix: Array) -> Asset:
    """An asset moved, turned and scaled by a (4, 4) matrix that does not mirror, with its captured colours."""
    if np.array_equal(matrix, np.eye(4)):
        return asset
    if asset.binding is None:
        surfels = surfels_of_pose(asset.surfels, pose_by_matrix(asset.surfels, matrix))
        return replace(asset, surfels=replace(surfels, extras=asset.surfels.extras | surfels.extras))
    vertices = (asset.mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    surfels, binding = follow(asset, vertices)
    return replace(asset, mesh=replace(asset.mesh, vertices=vertices), surfels=surfels, binding=binding)


def _check(vertices: Array, faces: Array, name: str) -> None:
    if not len(faces):
        raise AssetError(name, "has no faces", "Choose a mesh with a surface")
    if lost := int((~np.isfinite(vertices)).any(axis=1).sum()):
        raise AssetError(name, f"has {lost} vertices that are not finite", "Correct them")
    if (wrong := outside(faces, len(vertices))) is not None:
        raise AssetError(name, f"has faces of vertex {wrong} of {len(vertices)}", "Write it again")


def _agreement(asset: Asset) -> float | None:
    """Part of the surfels whose normals agree with the faces that they hang on; None of unbound ones."""
    if asset.binding is None:
        return None
    normal = rotation_matrices(asset.surfels.rotation.astype(np.float64))[..., 2]
    return float((dot(normal, Faces.of(asset.mesh.vertices, asset.mesh.faces).normal[asset.binding.face]) > 0).mean())


def _tell_of_gaps(asset: Asset, mesh: Mesh, name: str) -> None:
    """Warn of surfels that the new mesh does not reach, of its faces without surfels, and of its open edges."""
    centre, old = asset.surfels.centre, asset.mesh
    extent = float(np.linalg.norm(np.subtract(*np.quantile(centre, (0.98, 0.02), axis=0))))
    faces, typical = Faces.of(mesh.vertices, mesh.faces), median_size(asset.surfels)
    least = max(COARSER * extent, 3 * typical)
    away = project(mesh, faces, centre)[2]
    before = 0.0 if asset.binding is None else project(old, Faces.of(old.vertices, old.faces), centre)[2]
    if lost := int((away > before + least).sum()):
        log.warning(
            "%s does not cover %d of %d surfels: they are more than %.3g m away, and follow what is nearest",
            name, lost, len(centre), least,
        )  # fmt: skip
    middle = faces.corners.mean(axis=1)
    radius = np.linalg.norm(faces.corners - middle[:, None], axis=2).max(axis=1)
    far = cKDTree(centre).query(middle)[0] > REACH * typical + radius
    share = float(faces.area[far].sum() / faces.area.sum())
    if share > BARE:
        log.warning(
            "%s has no surfels on %d faces, %.0f %% of its area: nothing is seen there, and it throws shadows",
            name, int(far.sum()), 100 * share,
        )  # fmt: skip
    if (edges := _open_edges(mesh)) and (asset.binding is None or not _open_edges(old)):
        log.warning("%s is open: %d edges have one face; light gets in there", name, edges)


def _open_edges(mesh: Mesh) -> int:
    """How many edges have one face; vertices at one place count as one."""
    corner = distinct_row_indices(*mesh.vertices.T)[mesh.faces]
    ends = np.sort(np.stack([corner, corner[:, [1, 2, 0]]], axis=-1).reshape(-1, 2), axis=1)
    return int((np.unique(ends[:, 0] * len(mesh.vertices) + ends[:, 1], return_counts=True)[1] == 1).sum())


def _take_materials(mesh: Mesh, old: Mesh) -> None:
    """Give a mesh the channels and groups of the nearest places of another; edit it in place."""
    faces = Faces.of(old.vertices, old.faces)
    face, weights, _ = project(old, faces, mesh.vertices)
    corners = old.faces[face]
    for channel in old.channels:
        values = np.einsum("nk,nk...->n...", weights, getattr(old, channel)[corners])
        setattr(mesh, channel, values.clip(0, MATERIAL_CHANNELS[channel].limit).astype(np.float32))
    nearest = corners[np.arange(len(corners)), weights.argmax(axis=1)]
    mesh.groups = {name: np.flatnonzero(np.isin(nearest, of)).astype(np.int32) for name, of in old.groups.items()}
