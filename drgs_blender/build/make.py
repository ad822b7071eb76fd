"""A textured mesh made into an asset: materials at vertices, surfels on the faces."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset.model import Asset, Environment, Mesh, Surfels
from ..core.errors import AssetError
from ..deform.attach import attach
from ..deform.face_frames import Faces
from ..formats.axes import mesh_to_z_up
from ..formats.files import MeshFile, plain_name
from ..formats.gltf_nodes import Pose
from ..formats.mesh import check_extent
from .texture import CHANNELS, Materials
from .topology import Net, close_marks, edge_lengths, edges, subdivide, survivors, weld

Array = np.ndarray
log = logging.getLogger(__name__)

#: Triangles that subdivision for texture detail may reach.
MAX_TRIANGLES = 150_000
#: Largest error of the interpolated materials, of square-root albedo, roughness and metallic, before an edge is split.
TOLERANCE = 0.05
#: Edges are not split below this part of the mesh's diagonal.
FINEST = 1 / 1500
#: A vertex averages its texture over this part of its mean edge.
FOOTPRINT = 0.7
#: Texture compared with the interpolation is averaged over this part of an edge, so that finer detail is noticed.
LOOK = 0.1
#: Rounds of subdivision at most.
ROUNDS = 16


def make_asset(
    source: str | Path | MeshFile,
    *,
    up: str | None = None,
    max_triangles: int = MAX_TRIANGLES,
    tolerance: float = TOLERANCE,
    density: float = 140.0,
    pretrained: Surfels | None = None,
    environment: Environment | str | Path | None = None,
    pose: Pose = "rest",
    scale: float = 1.0,
) -> Asset:
    """Make an asset from a mesh with textures: glTF, GLB, OBJ, PLY, DAE and whatever else `formats` reads.

    Parameters
    ----------
    source : str, Path or MeshFile
        Path, or a mesh file already read.
    up : str, optional
        "z", "y", "-z" or "-y", the up axis of the file; None is what its format says, and Z where it says nothing.
    max_triangles : int
        Budget of the subdivision that gives texture detail its vertices; a finer mesh is left as it is.
    tolerance : float
        Error of interpolated materials at which edges are split.
    density : float
        See `deform.attach.attach`.
    pretrained : Surfels, optional
        Surfels whose place and opacity the attached ones take over (Algorithm 1).
    environment : Environment, str or Path, optional
        Light kept in the asset.
    pose : {"rest", "default"}
        Of a skinned glTF file, "rest" as Blender's importer rests it or "default" as viewers show the file.
    scale : float
        Factor on all lengths.

    Returns
    -------
    Asset
        What was merged, removed, divided and attached is in ``provenance["report"]``.
    """
    name = "mesh" if isinstance(source, MeshFile) else str(source)
    file = read_mesh_file(source, pose)
    mesh, report = mesh_with_materials(file, name, up=up, max_triangles=max_triangles, tolerance=tolerance)
    scale_mesh(mesh, scale, name)
    surfels, binding, report["surfels"] = attach(mesh, pretrained, density=density)
    provenance = {"mesh": plain_name(name), "made": "surfels attached to the mesh", "report": report}
    return Asset(surfels, mesh, binding, read_environment_of(environment), provenance)


def scale_mesh(mesh: Mesh, scale: float, name: str) -> None:
    """Multiply all lengths of `mesh` by `scale`. Raises UsageError where no mesh can be as small or large."""
    with np.errstate(all="ignore"):
        mesh.vertices = mesh.vertices * np.float32(scale)
    check_extent(mesh.vertices, name, scale)


def read_mesh_file(source: str | Path | MeshFile, pose: Pose = "rest") -> MeshFile:
    """The mesh of a path, skinned glTF in that `pose`; or `source` itself when it is one."""
    if isinstance(source, MeshFile):
        return source
    from ..formats.registry import read_mesh

    return read_mesh(source, pose)


def read_environment_of(source: Environment | str | Path | None) -> Environment | None:
    """The environment of a path, or `source` itself."""
    if source is None or isinstance(source, Environment):
        return source
    from ..formats.registry import read_environment_file

    file = read_environment_file(source)
    for note in file.notes:
        log.warning("%s: %s", source, note)
    return file.environment


def mesh_with_materials(
    file: MeshFile,
    name: str,
    *,
    up: str | None = None,
    max_triangles: int = MAX_TRIANGLES,
    tolerance: float = TOLERANCE,
) -> tuple[Mesh, dict[str, Any]]:
    """Weld a mesh file, divide it where its textures need it and sample them at the vertices.

    Returns
    -------
    mesh : Mesh
        Z up; one group a material and one a part.
    report : dict
        "source_vertices", "source_faces", "not_finite_faces", "degenerate_faces" (removed), "vertices", "faces",
        "rounds" of subdivision, "unresolved_edges" (detail left out by the budget or the finest edge), "notes".
    """
    if up and file.up_axis == "unknown":
        file = mesh_to_z_up(file, up)
    report: dict[str, Any] = {"source_vertices": len(file.vertices), "source_faces": len(file.faces)}
    report["notes"] = list(file.notes)
    net = _net(file, name, report)
    materials = Materials(file.materials, coloured=file.vertex_colours is not None)
    net, report["rounds"], report["unresolved_edges"] = refine(net, materials, tolerance, max_triangles)
    values = bake(net, materials)
    report["vertices"], report["faces"] = len(net.vertices), len(net.faces)
    mesh = Mesh(net.vertices, net.faces, values[:, :3], values[:, 3], values[:, 4], _groups(net, file))
    log.info("mesh of %s: %s", name, report)
    return mesh, report


def _net(file: MeshFile, name: str, report: dict[str, Any]) -> Net:
    """Proper faces of the file, welded; tags are (material, part)."""
    m = len(file.faces)
    if not m:
        lost = [note for note in file.notes if "NaN" in note]
        problem = f"has no faces that are left ({'; '.join(lost)})" if lost else "has no faces"
        raise AssetError(name, problem, "Choose a file with a surface")
    finite = np.isfinite(file.vertices).all(axis=1)[file.faces].all(axis=1)
    part = np.full(m, -1, np.int64)
    for index, (_, start, stop) in enumerate(file.parts):
        part[start:stop] = index
    with np.errstate(invalid="ignore"):
        proper = finite & ~Faces.of(file.vertices, file.faces).degenerate
    if not proper.any():
        raise AssetError(name, f"has {m} faces, none with an area", "Export the mesh again")
    check_extent(file.vertices[file.faces[proper]], name)
    faces = file.faces[proper].astype(np.int64)
    material = np.asarray(file.face_material, np.int64)[proper]
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    normals = None if file.corner_normals is None else file.corner_normals[proper].astype(np.float64)
    source, point, welded = weld(file.vertices[used].astype(np.float64), faces, material, normals)
    source = used[source]
    n = len(source)
    values = np.full((n, CHANNELS), np.nan)
    values[:, :3] = 1 if file.vertex_colours is None else file.vertex_colours[source]
    if file.vertex_roughness is not None:
        values[:, 3] = file.vertex_roughness[source]
    if file.vertex_metallic is not None:
        values[:, 4] = file.vertex_metallic[source]
    uvs = np.zeros((len(faces), 3, 2)) if file.corner_uvs is None else file.corner_uvs[proper].astype(np.float64)
    net = Net(
        file.vertices[source].astype(np.float64), point, values, welded, np.nan_to_num(uvs),
        np.stack([material, part[proper]], -1),
    )  # fmt: skip
    # Welding may collapse faces that were thinner than its grid.
    keep = ~Faces.of(net.vertices, net.faces).degenerate
    net.faces, net.uvs, net.tags = net.faces[keep], net.uvs[keep], net.tags[keep]
    report["not_finite_faces"] = int((~finite).sum())
    report["degenerate_faces"] = removed = int((finite & ~proper).sum() + (~keep).sum())
    if removed:
        report["notes"].append(f"{removed} faces without area removed")
    return net


def bake(net: Net, materials: Materials) -> Array:
    """Values (n, CHANNELS) float32 of the vertices: the mean over their corners of the textures around them."""
    return _at_vertices(net, _at_corners(net, materials, np.arange(len(net.faces))))


def _at_corners(net: Net, materials: Materials, some: Array) -> Array:
    """Values (s, 3, CHANNELS) of the textures around the corners of the faces `some`."""
    uvs = net.uvs[some]
    size = _corner_size(uvs)
    material = np.repeat(net.tags[some, 0], 3)
    found = materials.sample(material, uvs.reshape(-1, 2), FOOTPRINT * size.reshape(-1, 2))
    return found.reshape(len(some), 3, CHANNELS)


def _at_vertices(net: Net, corners: Array) -> Array:
    """Values (n, CHANNELS) float32 of the vertices, from those of all corners."""
    corner = corners.reshape(-1, CHANNELS)
    flat = net.faces.reshape(-1)
    count = np.maximum(np.bincount(flat, minlength=len(net.vertices)), 1)
    values = np.stack([np.bincount(flat, corner[:, c], len(net.vertices)) / count for c in range(CHANNELS)], -1)
    values[:, :3] *= net.values[:, :3]
    own = np.isfinite(net.values[:, 3:])
    values[:, 3:] = np.where(own, net.values[:, 3:], values[:, 3:])
    return np.clip(values, 0, 1).astype(np.float32)


def _corner_size(uvs: Array) -> Array:
    """Mean extent (m, 3, 2) in u and v of the two edges at each corner."""
    to_next = np.abs(np.roll(uvs, -1, axis=1) - uvs)
    return 0.5 * (to_next + np.roll(to_next, 1, axis=1))


def refine(net: Net, materials: Materials, tolerance: float, max_triangles: int) -> tuple[Net, int, int]:
    """Divide edges until interpolated vertex materials follow the textures, or the budget is reached.

    Returns
    -------
    net : Net
        The divided mesh.
    rounds : int
        Rounds done.
    unresolved : int
        Edges still above the tolerance.
    """
    finest = FINEST * float(np.linalg.norm(np.ptp(net.vertices, axis=0)))
    unresolved, looked = 0, _Looked(net, materials)
    for done in range(ROUNDS + 1):
        edge, count = edges(net)
        lengths = edge_lengths(net)
        error = np.zeros(count)
        np.maximum.at(error, edge.reshape(-1), looked.errors.reshape(-1))
        length = np.zeros(count)
        np.maximum.at(length, edge.reshape(-1), lengths.reshape(-1))
        wanted = (error > tolerance) & (length > 2 * finest)
        unresolved = int((error > tolerance).sum())
        if not wanted.any() or done == ROUNDS:
            return net, done, unresolved
        marked = _within_budget(edge, lengths, np.where(wanted, error * length, 0), max_triangles)
        if not marked.any():
            return net, done, unresolved
        kept = survivors(net, edge, marked)
        net = subdivide(net, edge, marked)
        looked = _Looked(net, materials, looked, kept)
    return net, ROUNDS, unresolved


class _Looked:
    """How well a net follows its textures; of what a division left as it was, nothing is looked up again.

    Parameters
    ----------
    net : Net
    materials : Materials
    before : _Looked, optional
        Of the net that was divided.
    kept : array, optional
        `survivors` of the division.

    Attributes
    ----------
    errors : (m, 3) array
        See `_edge_errors`.
    """

    def __init__(
        self, net: Net, materials: Materials, before: _Looked | None = None, kept: Array | None = None
    ) -> None:
        if before is None or kept is None:
            kept = np.full(len(net.faces), -1)
        new = np.flatnonzero(kept < 0)
        self._corners = np.empty((len(kept), 3, CHANNELS), np.float32)
        self.errors = np.zeros(net.faces.shape)
        if before is not None:
            old = np.flatnonzero(kept >= 0)
            self._corners[old], self.errors[old] = before._corners[kept[old]], before.errors[kept[old]]
        self._corners[new] = _at_corners(net, materials, new)
        moved = np.zeros(len(net.vertices), bool)  # their values are others than before
        moved[net.faces[new]] = True
        again = np.flatnonzero(moved[net.faces].any(axis=1))
        self.errors[again] = _edge_errors(net, materials, _at_vertices(net, self._corners), again)


def _within_budget(edge: Array, lengths: Array, priority: Array, max_triangles: int) -> Array:
    """Closed marks of as many of the most urgent edges as the budget allows."""
    order = np.argsort(-priority, kind="stable")[: int((priority > 0).sum())]
    take = len(order)
    while take:
        marked = np.zeros(len(priority), bool)
        marked[order[:take]] = True
        marked = close_marks(edge, lengths, marked)
        if len(edge) + int(marked[edge].sum()) <= max_triangles:
            return marked
        take //= 2
    return np.zeros(len(priority), bool)


def _edge_errors(net: Net, materials: Materials, values: Array, some_faces: Array) -> Array:
    """Largest difference (s, 3) between textures and interpolated vertex values along each edge of each face.

    The middle of a face counts for its longest edge. Edges about as long as a texel have none.

    Parameters
    ----------
    net : Net
    materials : Materials
    values : array
        Of all vertices, see `bake`.
    some_faces : (s,) array
        The faces that are meant.
    """
    result = np.zeros((len(some_faces), 3))
    places = np.flatnonzero(materials.textured[net.tags[some_faces, 0]])
    rows = some_faces[places]
    if not len(rows):
        return result
    net_values = _perceived(values)
    faces, uvs, material = net.faces[rows], net.uvs[rows], net.tags[rows, 0]
    extent = np.abs(np.roll(uvs, -1, axis=1) - uvs)
    coarse = extent.max(axis=-1) > 1.5 * materials.texel_size()[material][:, None]
    own = np.where(np.isfinite(net.values), net.values, 1)

    def error(weights: Array, some: Array, scale: Array) -> Array:
        """Error at the point with barycentric `weights` of the faces `some`."""
        uv = np.einsum("k,nkc->nc", weights, uvs[some])
        factor = np.einsum("k,nkc->nc", weights, own[faces[some]])
        texture = materials.sample(material[some], uv, scale)
        texture[:, :3] *= factor[:, :3]
        interpolated = np.einsum("k,nkc->nc", weights, net_values[faces[some]])
        fixed = np.isfinite(net.values[faces[some][:, 0]])  # channels the file gives at its vertices
        fixed[:, :3] = False
        return np.where(fixed, 0, np.abs(_perceived(texture) - interpolated)).max(axis=1)

    for k in range(3):
        some = np.flatnonzero(coarse[:, k])
        for t in (0.25, 0.5, 0.75):
            weights = np.zeros(3)
            weights[k], weights[(k + 1) % 3] = 1 - t, t
            found = error(weights, some, LOOK * extent[some, k])
            result[places[some], k] = np.maximum(result[places[some], k], found)
    some = np.flatnonzero(coarse.any(axis=1))
    longest = edge_lengths(net)[rows[some]].argmax(axis=1)
    centre = error(np.full(3, 1 / 3), some, LOOK * extent[some].mean(axis=1))
    result[places[some], longest] = np.maximum(result[places[some], longest], centre)
    return result


def _perceived(values: Array) -> Array:
    """Values with the square root of albedo, in which equal steps look about equal."""
    result = values.copy()
    result[:, :3] = np.sqrt(np.maximum(values[:, :3], 0))
    return result


def _groups(net: Net, file: MeshFile) -> dict[str, Array]:
    """Vertices of each material and each part that has any, by name."""
    groups: dict[str, list[Array]] = {}
    names = ([m.name or f"Material {k}" for k, m in enumerate(file.materials)], [part for part, _, _ in file.parts])
    for column, labels in enumerate(names):
        for k, label in enumerate(labels):
            used = net.faces[net.tags[:, column] == k]
            if used.size:
                groups.setdefault(label, []).append(used.reshape(-1))
    return {label: np.unique(np.concatenate(found)).astype(np.int32) for label, found in groups.items()}
