"""Checks of every mesh reader's result: nothing that is not finite reaches the rest of the program."""

from __future__ import annotations

import numpy as np

from ..core.errors import AssetError, UsageError
from .files import MeshFile

Array = np.ndarray

#: Sizes of a mesh in metres: the squared areas of its faces stay within the range of 32-bit floats.
SMALLEST, LARGEST = 1e-6, 1e9


def check_extent(vertices: Array, subject: str, scale: float = 1.0) -> None:
    """Refuse a mesh that is too small or too large to be worked with; `vertices` are those of its faces.

    Raises
    ------
    UsageError
        It is the factor `scale`, by which it has been multiplied, that makes it so.
    AssetError
        It is so of itself, or has vertices that are not finite.
    """
    with np.errstate(all="ignore"):
        extent = float(np.ptp(vertices.reshape(-1, 3).astype(np.float64), axis=0).max()) if vertices.size else 1.0
    if SMALLEST <= extent <= LARGEST:
        return
    held = "at which 32-bit numbers cannot hold the areas of its faces"
    if not np.isfinite(extent):
        raise AssetError(subject, "has vertices that are NaN or infinite", "Export it, or its pose, again")
    if scale != 1.0:
        raise UsageError(f"--scale {scale:g}", f"makes {subject} measure {extent:.3g} m, {held}", "Choose another")
    raise AssetError(subject, f"measures {extent:.3g} m, {held}", "Export it at its true size")


def sanitise(mesh: MeshFile) -> MeshFile:
    """Remove faces with vertices that are NaN or infinite, and these vertices.

    Other values that are not finite are replaced. What was changed is counted in ``notes``. Returns `mesh` itself,
    changed.
    """
    finite = np.isfinite(mesh.vertices).all(axis=1)
    if not finite.all():
        keep = finite[mesh.faces].all(axis=1)
        number = np.cumsum(finite) - 1
        mesh.notes.append(
            f"{int((~finite).sum())} vertices that are NaN or infinite removed, with {int((~keep).sum())} faces"
        )
        faces_before = np.cumsum([0, *keep])
        mesh.parts = [(n, int(faces_before[a]), int(faces_before[b])) for n, a, b in mesh.parts]
        mesh.file_count = mesh.file_count or len(mesh.vertices)
        mesh.numbers = mesh.vertex_numbers[finite]
        mesh.vertices = mesh.vertices[finite]
        mesh.faces = number[mesh.faces[keep]].astype(np.int32)
        for name in ("corner_normals", "corner_uvs", "face_material"):
            if (values := getattr(mesh, name)) is not None:
                setattr(mesh, name, values[keep])
        for name in ("vertex_colours", "vertex_roughness", "vertex_metallic"):
            if (values := getattr(mesh, name)) is not None:
                setattr(mesh, name, values[finite])
    if mesh.corner_normals is not None and not np.isfinite(mesh.corner_normals).all():
        mesh.notes.append("normals ignored: some are NaN or infinite")
        mesh.corner_normals = None
    if mesh.corner_uvs is not None and not np.isfinite(mesh.corner_uvs).all():
        mesh.notes.append("texture coordinates that are NaN or infinite set to 0")
        mesh.corner_uvs = np.nan_to_num(mesh.corner_uvs, posinf=0.0, neginf=0.0)
    if mesh.vertex_colours is not None:
        mesh.vertex_colours = np.clip(np.nan_to_num(mesh.vertex_colours), 0.0, 1.0).astype(np.float32)
    return mesh
