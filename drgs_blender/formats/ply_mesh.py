"""Meshes and point clouds in PLY files: polygons, triangle strips, colours, and our own material channels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..compute.jit import njit
from ..core.arrays import outside
from ..core.color import srgb_to_linear, to_unit
from ..core.errors import AssetError
from .files import MeshFile
from .ply import Rows, read_ply
from .ply_columns import stack

Array = np.ndarray

_DAMAGED = "Export the file again, or restore it from a copy"
#: Names of the texture coordinates of a vertex in the wild.
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


def read_ply_mesh(path: Path) -> MeshFile:
    """Read a mesh (or points: no faces) from the PLY file at `path`.

    Polygons become triangle fans. ``red green blue`` are sRGB-encoded colours; ``albedo_r albedo_g albedo_b roughness
    metallic`` are DR-GS's own channels, linear.

    Raises
    ------
    AssetError
        The file is damaged or its faces refer to vertices that are not there.
    """
    subject = str(path)
    _, elements = read_ply(path)
    vertex = elements.get("vertex")
    if vertex is None or not all(axis in vertex.columns for axis in "xyz"):
        raise AssetError(subject, "has no vertices with x, y and z", _DAMAGED)
    vertices = _floats(vertex, ("x", "y", "z"))
    notes: list[str] = []
    faces, corner_uvs = _faces(elements, notes, subject)
    if (wrong := outside(faces, len(vertices))) is not None:
        raise AssetError(subject, f"has faces that refer to vertex {wrong} of {len(vertices)}", _DAMAGED)
    mesh = MeshFile(vertices, faces, corner_uvs=corner_uvs, notes=notes)
    columns = vertex.columns
    if all(n in columns for n in ("nx", "ny", "nz")):
        normals = _floats(vertex, ("nx", "ny", "nz"))
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        if np.isfinite(length).all() and (length > 0).all():
            mesh.corner_normals = (normals / length)[mesh.faces]
    for names in _UV_NAMES:
        if mesh.corner_uvs is None and all(n in columns for n in names):
            mesh.corner_uvs = _floats(vertex, names)[mesh.faces]
    _materials(mesh, vertex, notes)
    if not len(faces):
        notes.append("points without faces")
    return mesh


def _materials(mesh: MeshFile, vertex: Rows, notes: list[str]) -> None:
    """Set the vertex channels of `mesh`."""
    columns = vertex.columns
    if all(f"albedo_{c}" in columns for c in "rgb"):
        mesh.vertex_colours = _unit(_floats(vertex, ("albedo_r", "albedo_g", "albedo_b")), "albedo", notes)
        for channel in ("roughness", "metallic"):
            if channel in columns:
                setattr(mesh, f"vertex_{channel}", _unit(_floats(vertex, (channel,))[:, 0], channel, notes))
        return
    for names in (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")):
        if all(n in columns for n in names):
            encoded = np.stack([to_unit(np.asarray(columns[n])) for n in names], axis=1)
            mesh.vertex_colours = srgb_to_linear(_unit(encoded, "colour", notes))
            notes.append("vertex colours decoded from sRGB")
            return


def _unit(values: Array, name: str, notes: list[str]) -> Array:
    """Values clipped to [0, 1], NaN to 0, and said so."""
    outside = int(np.count_nonzero(~((values >= 0) & (values <= 1))))
    if outside:
        notes.append(f"{outside} values of {name} outside [0, 1] clipped")
    return np.clip(np.nan_to_num(values), 0.0, 1.0)


def _floats(rows: Rows, names: tuple[str, ...]) -> Array:
    with np.errstate(over="ignore"):
        return stack(rows.columns, names)


def _faces(elements: dict[str, Rows], notes: list[str], subject: str) -> tuple[Array, Array | None]:
    """((m, 3) int32 triangles, (m, 3, 2) texture coordinates or None)."""
    face, strips = elements.get("face"), elements.get("tristrips")
    if face is not None:
        for name in ("vertex_indices", "vertex_index"):
            if name in face.lists:
                return _fans(face, name, notes, subject)
        if face.element.count:
            raise AssetError(subject, "has faces without a list of vertices", _DAMAGED)
    if strips is not None and strips.lists:
        values, _ = strips.lists.get("vertex_indices") or next(iter(strips.lists.values()))
        return _unroll(_indices(values, subject)), None
    return np.zeros((0, 3), np.int32), None


def _fans(face: Rows, name: str, notes: list[str], subject: str) -> tuple[Array, Array | None]:
    """Triangle fans of polygons, with their texture coordinates where a list of them fits."""
    values, lengths = face.lists[name]
    indices = _indices(values, subject)
    count = np.maximum(lengths - 2, 0)
    if skipped := int(np.count_nonzero(lengths < 3)):
        notes.append(f"{skipped} faces of fewer than three corners ignored")
    if int(lengths.max(initial=3)) > 3:
        notes.append("polygons triangulated")
    polygon = np.repeat(np.arange(len(lengths)), count)
    first = (np.cumsum(lengths) - lengths)[polygon]
    step = np.arange(len(polygon)) - (np.cumsum(count) - count)[polygon]
    corners = np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)
    triangles = indices[first[:, None] + corners]
    uvs = face.lists.get("texcoord")
    if uvs is None:
        return triangles, None
    if not np.array_equal(uvs[1], 2 * lengths):
        notes.append("texture coordinates ignored: not two for each corner")
        return triangles, None
    pairs = uvs[0].reshape(-1, 2).astype(np.float32)
    return triangles, pairs[first[:, None] + corners]


def _indices(values: Array, subject: str) -> Array:
    """Vertex numbers as int32; floats are refused (some writers use them, rounded beyond 2^24)."""
    if values.dtype.kind == "f":
        raise AssetError(subject, "has vertex numbers that are not integers", _DAMAGED)
    if values.size and int(values.max()) > np.iinfo(np.int32).max:
        raise AssetError(subject, f"has faces that refer to vertex {int(values.max())}", _DAMAGED)
    return values.astype(np.int32)


@njit
def _unroll(strip: Array) -> Array:
    """Triangles of strips joined by negative numbers; every second one of a strip is turned round."""
    triangles = np.empty((len(strip), 3), np.int32)
    count = start = 0
    for i in range(len(strip)):
        if strip[i] < 0:
            start = i + 1
        elif i - start >= 2:
            a, b, c = strip[i - 2], strip[i - 1], strip[i]
            if (i - start) % 2:
                a, b = b, a
            if a != b and b != c and a != c:  # strips are stitched with degenerate triangles
                triangles[count] = a, b, c
                count += 1
    return triangles[:count].copy()
