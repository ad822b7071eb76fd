"""A textured mesh made into an asset: materials at vertices, surfels on the faces."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset.model import Asset, Environment, Mesh, SourceVertices, Surfels
from ..core.errors import AssetError, first_of
from ..deform.attach import attach
from ..deform.face_frames import Faces
from ..formats.axes import UP_AXES, mesh_to_z_up
from ..formats.files import MeshFile, plain_name
from ..formats.gltf_nodes import Pose
from ..formats.mesh import check_extent
from .mesh_textures import MAX_TEXTURE, has_opacity_image, mesh_textures
from .refine import MAX_TRIANGLES, TOLERANCE, refine
from .surface_detail import MAX_SURFELS, CornerFrames, SurfaceDetail
from .texture import CUT, CUT_OUT, Materials
from .topology import Net, weld

Array = np.ndarray
#: Surfels along the mesh's diagonal, at least.
DENSITY = 140.0
#: Alpha below which a corner of a face shows nothing.
_SEEN = 1 / 255
log = logging.getLogger(__name__)


def make_asset(
    source: str | Path | MeshFile,
    *,
    up: str | None = None,
    max_triangles: int = MAX_TRIANGLES,
    density: float | None = None,
    pretrained: Surfels | None = None,
    environment: Environment | str | Path | None = None,
    pose: Pose = "rest",
    scale: float = 1.0,
    max_surfels: int | None = None,
    max_texture: int = MAX_TEXTURE,
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
    density : float, optional
        See `deform.attach.attach`; None: 140.
    pretrained : Surfels, optional
        Surfels whose place and opacity the attached ones take over (Algorithm 1).
    environment : Environment, str or Path, optional
        Light kept in the asset.
    pose : {"rest", "default"}
        Of a skinned glTF file, "rest" as Blender's importer rests it or "default" as viewers show the file.
    scale : float
        Factor on all lengths.
    max_surfels : int, optional
        Surfels that pieces of faces cut for detail of textures and normal maps may reach; None: 400000.
    max_texture : int
        Largest side in pixels of the textures that the mesh keeps; 0: it keeps none.

    Returns
    -------
    Asset
        What was merged, removed, divided and attached is in ``provenance["report"]``.
    """
    name = "mesh" if isinstance(source, MeshFile) else str(source)
    file = read_mesh_file(source, pose)
    mesh, report, detail = detailed_mesh(
        file, name, up=up, max_triangles=max_triangles, tolerance=TOLERANCE, max_texture=max_texture
    )
    report["notes"] += _assumed(file, up)
    scale_mesh(mesh, scale, name)
    is_chosen = density is not None or max_surfels is not None
    density = DENSITY if density is None else density
    max_surfels = MAX_SURFELS if max_surfels is None else max_surfels
    surfels, binding, report["surfels"] = attach(
        mesh, pretrained, density=density, detail=detail if detail.any else None, most=max_surfels
    )
    left = report["surfels"].get("hidden_pieces", 0)
    # Where two defaults meet, which the user did not choose, there is nothing to say.
    if len(surfels) >= max_surfels and (left > 0 or (left < 0 and is_chosen)):
        report["surfels"]["notes"] = [_surfel_note(len(surfels), left, max_surfels, density)]
    provenance = {"mesh": plain_name(name), "made": "surfels attached to the mesh", "report": report}
    return Asset(surfels, mesh, binding, read_environment_of(environment), provenance)


def _surfel_note(count: int, left: int, most: int, density: float) -> str:
    """Why `left` surfels of `count` show less than is known of the surface; -1: none was made smaller for it."""
    if left < 0:
        return (
            f"no surfels are made smaller for textures and normal maps: --density {density:g} alone makes {count} of "
            f"them, --max-surfels is {most}. For more detail give more than {count}, or a smaller --density"
        )
    return (
        f"{left} of {count} surfels are coarser than the textures and normal maps: --max-surfels {most} is reached. "
        "For more detail give a larger number"
    )


def scale_mesh(mesh: Mesh, scale: float, name: str) -> None:
    """Multiply all lengths of `mesh` by `scale`. Raises UsageError where no mesh can be as small or large."""
    with np.errstate(all="ignore"):
        mesh.vertices = mesh.vertices * np.float32(scale)
    check_extent(mesh.vertices, name, scale)
    if scale != 1:
        source = mesh.source or SourceVertices.identity(len(mesh.vertices))
        mesh.source = source.turned(np.eye(3) * np.float32(scale))


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
    max_texture: int = 0,
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
    budgets = max_triangles, tolerance, max_texture
    return detailed_mesh(file, name, up, *budgets)[:2]


def detailed_mesh(
    file: MeshFile, name: str, up: str | None, max_triangles: int, tolerance: float, max_texture: int
) -> tuple[Mesh, dict[str, Any], SurfaceDetail]:
    """As `mesh_with_materials`, with what the file shows between the vertices."""
    turned = up if file.up_axis == "unknown" else None
    if turned:
        file = mesh_to_z_up(file, turned)
    report: dict[str, Any] = {"source_vertices": len(file.vertices), "source_faces": len(file.faces)}
    report["notes"] = list(file.notes)
    materials = Materials(file.materials, coloured=file.vertex_colours is not None)
    net, (source, corners), frames = _net(file, name, report, materials.width)
    faces = len(net.faces)
    if file.corner_uvs is None and (lost := [m.name for m, has in zip(file.materials, materials.textured) if has]):
        report["notes"].append(
            f"no texture coordinates: images of {first_of(lost)} show a single texel. Unwrap the mesh"
        )
    net, values, report["rounds"], report["unresolved_edges"] = refine(net, materials, tolerance, max_triangles)
    columns: dict[str, Any] = {
        n: values[:, own] if own.stop - own.start > 1 else values[:, own.start] for n, own in materials.columns.items()
    }
    alpha = columns.pop(CUT, None)
    count = file.file_count or len(file.vertices)
    origin = _source(net, file.vertex_numbers[source], file.vertex_numbers[corners], count)
    divided = len(net.faces) > faces
    if divided:
        report["notes"].append(
            f"the mesh is divided where its textures need more vertices: {faces} triangles became {len(net.faces)}, of "
            f"at most {max_triangles} (--max-triangles of drgs make and drgs import; {faces} keeps the file's)"
        )
    if alpha is not None:
        kept = max_texture > 0 and file.corner_uvs is not None
        pictured = np.array([kept and has_opacity_image(m) for m in file.materials] + [False])
        _cut_out(net, alpha, materials.cut_out, pictured, name, report)
        if (pictured & materials.cut_out).any():
            columns["opacity"] = columns.get("opacity", 1) * alpha
    report["vertices"], report["faces"] = len(net.vertices), len(net.faces)
    mesh = Mesh(net.vertices, net.faces, **columns, groups=_groups(net, file), source=origin)
    if max_texture > 0:
        mesh.textures = mesh_textures(net, file, frames, divided, max_texture, report["notes"])
    if turned not in (None, "z"):
        mesh.source = (mesh.source or SourceVertices.identity(count)).turned(UP_AXES[turned])
    log.info("mesh of %s: %s", name, report)
    return mesh, report, SurfaceDetail(net, materials, frames, divided)


def _assumed(file: MeshFile, up: str | None) -> list[str]:
    """What is taken for granted where a mesh file does not say it."""
    notes = []
    if file.up_axis == "unknown" and up is None:
        notes.append(
            "the file does not say which axis is up, so Z is assumed; --up y (or Up) turns what lies on its nose"
        )
    bare = file.vertex_colours is None and file.vertex_roughness is None and file.vertex_metallic is None
    if not file.materials and bare:
        unused = ", though it has texture coordinates" if file.corner_uvs is not None else ""
        notes.append(f"the file has no material{unused}: it is grey")
    return notes


def _cut_out(net: Net, alpha: Array, which: Array, pictured: Array, name: str, report: dict[str, Any]) -> None:
    """Leave out the transparent faces of `net`; their vertices stay, so that poses of the source fit.

    Parameters
    ----------
    net : Net
    alpha : (n,) array
        Of the vertices.
    which : (materials + 1,) bool array
        Materials that are cut out.
    pictured : (materials + 1,) bool array
        Those whose image the mesh keeps: of these, only what is transparent all over.
    name : str
        Of the file, in errors.
    report : dict
        Its notes get how many faces that were.
    """
    corners, material = alpha[net.faces], net.tags[:, 0]
    there = np.where(pictured[material], corners.max(axis=1) >= _SEEN, corners.mean(axis=1) >= CUT_OUT)
    keep = there | ~which[material]
    if not keep.any():
        raise AssetError(name, "is transparent everywhere", "Make its materials opaque")
    if cut := int((~keep).sum()):
        report["notes"].append(f"{cut} transparent faces of {len(keep)} are cut out")
    net.faces, net.uvs, net.tags, net.inside = (
        net.faces[keep], net.uvs[keep], net.tags[keep], net.inside[keep],
    )  # fmt: skip


def _net(
    file: MeshFile, name: str, report: dict[str, Any], width: int
) -> tuple[Net, tuple[Array, Array], CornerFrames]:
    """Proper faces of the file, welded, with tags (material, part, number).

    Returns
    -------
    net : Net
    source, corners : array
        The vertex (n,) of `file` of each vertex of `net`, and those (f, 3) at the corners of the numbered faces.
    frames : CornerFrames
        At these corners.
    """
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
    values = np.full((n, width), np.nan)
    values[:, :3] = 1 if file.vertex_colours is None else file.vertex_colours[source]
    if file.vertex_roughness is not None:
        values[:, 3] = file.vertex_roughness[source]
    if file.vertex_metallic is not None:
        values[:, 4] = file.vertex_metallic[source]
    uvs = np.zeros((len(faces), 3, 2)) if file.corner_uvs is None else file.corner_uvs[proper].astype(np.float64)
    net = Net(
        file.vertices[source].astype(np.float64), point, values, welded, np.nan_to_num(uvs),
        np.stack([material, part[proper], np.arange(len(faces))], -1),
        np.broadcast_to(np.eye(3, dtype=np.float32), (len(faces), 3, 3)),
    )  # fmt: skip
    frames = CornerFrames.of(net.vertices, welded, net.uvs, normals)
    # Welding may collapse faces that were thinner than its grid.
    keep = ~Faces.of(net.vertices, net.faces).degenerate
    net.faces, net.uvs, net.tags, net.inside = net.faces[keep], net.uvs[keep], net.tags[keep], net.inside[keep]
    report["not_finite_faces"] = int((~finite).sum())
    report["degenerate_faces"] = removed = int((finite & ~proper).sum() + (~keep).sum())
    if removed:
        report["notes"].append(f"{removed} faces without area removed")
    return net, (source, source[welded]), frames


def _source(net: Net, source: Array, corners: Array, count: int) -> SourceVertices | None:
    """Where the vertices of `net` come from; None where they are the file's own.

    Parameters
    ----------
    net : Net
        Divided.
    source, corners : array
        Of `_net`, numbered as in the file.
    count : int
        Of the file's vertices.
    """
    n, first = len(net.vertices), len(source)
    if n == first:
        own = n == count and (source == np.arange(n)).all()
        return None if own else SourceVertices(source[:, None], np.ones((n, 1)), np.array([count]))
    index, weights = np.zeros((n, 3), np.int32), np.zeros((n, 3), np.float32)
    index[:first, 0], weights[:first, 0] = source, 1
    flat = net.faces.reshape(-1)
    corner = np.empty(n, np.int64)  # any one of each vertex
    corner[flat] = np.arange(len(flat))
    new = corner[first:]
    index[first:] = corners[net.tags[new // 3, 2]]
    weights[first:] = net.inside.reshape(-1, 3)[new]
    return SourceVertices(index, weights, np.array([count]))


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
