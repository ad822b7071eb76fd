"""glTF and GLB files as one triangle mesh, Z up, with materials."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import AssetError
from .axes import vectors_to_z_up
from .files import MaterialFile, MeshFile
from .gltf_document import Document
from .gltf_materials import GltfMaterials
from .gltf_nodes import INSTANCES, NodeTree, Pose

Array = np.ndarray
logger = logging.getLogger(__name__)

#: How many times as large as viewers show it a rest pose may be.
_ALIKE = 2.0
#: Required extensions that change nothing of what is read here, or that are read.
_UNDERSTOOD = {
    INSTANCES,
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    "KHR_lights_punctual",
    "KHR_animation_pointer",
    "KHR_xmp_json_ld",
    "EXT_texture_webp",
}


@np.errstate(all="ignore")
def read_gltf(path: Path, pose: Pose = "rest") -> MeshFile:
    """Read the default scene of a glTF 2.0 file.

    Vertices are in the scene's space turned to Z up as Blender's importer does. Skinned meshes are posed, see
    `gltf_nodes`; shape keys (morph targets) are left at rest. Vertices that the file splits at seams stay split.

    Raises
    ------
    AssetError
        The file is damaged, or compressed (Draco, meshopt).
    """
    document = Document(path)
    notes: list[str] = []
    _check_extensions(document, notes)
    tree = NodeTree(document, pose)
    materials = GltfMaterials(document, notes)
    pieces = []
    for node_index in tree.order:
        node = document.items("nodes")[node_index]
        mesh_index = document.index(node, "mesh")
        if mesh_index is None:
            continue
        mesh = document.item("meshes", mesh_index)
        name = str(node.get("name") or mesh.get("name") or f"mesh {mesh_index}")
        for primitive in document.get(mesh, "primitives", list, []):
            if not isinstance(primitive, dict):
                raise AssetError(document.subject, "has a primitive of the wrong type")
            piece = _primitive(document, primitive, tree, node, node_index, materials, notes)
            if piece is not None:
                pieces.append((name, piece))
    if tree.skins and pose == "rest":
        _compare_poses(document, tree)
    if tree.skins:
        notes.append(f"skinned: the mesh is in its {'rest' if pose == 'rest' else 'default'} pose")
    if document.items("animations"):
        notes.append("animations ignored")
    return _join(pieces, materials.used, list(dict.fromkeys(notes)))


def _compare_poses(document: Document, rest: NodeTree) -> None:
    """Warn where what is skinned has another size at rest than viewers show: such a rest pose is broken."""
    sizes = [_skinned_size(document, tree) for tree in (rest, NodeTree(document, "default"))]
    own, shown = (float(np.linalg.norm(size)) for size in sizes)
    if shown > 0 and not 1 / _ALIKE < own / shown < _ALIKE:
        text = [" x ".join(f"{x:.3g}" for x in size) for size in sizes]
        logger.warning(
            "%s: its rest pose is %s large, %s as viewers show it: it is broken, in Blender as well. The pose that "
            "viewers show (--pose default) is whole, but takes no rig", document.subject, *text,
        )  # fmt: skip


def _skinned_size(document: Document, tree: NodeTree) -> Array:
    """(3,) size of the box around all skinned vertices, Z up."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for node_index in tree.order:
        node = document.items("nodes")[node_index]
        mesh_index, skin = document.index(node, "mesh"), document.index(node, "skin")
        if mesh_index is None or skin is None:
            continue
        for primitive in document.get(document.item("meshes", mesh_index), "primitives", list, []):
            attributes = document.get(primitive, "attributes", dict, {})
            vertices = _float(document, attributes, "POSITION", ("VEC3",))
            if vertices is None or not len(vertices) or "JOINTS_0" not in attributes or "WEIGHTS_0" not in attributes:
                continue
            blend = _blend_matrices(document, attributes, tree.skin_matrices(skin), len(vertices))
            moved = vertices_up(np.einsum("nij,nj->ni", blend[:, :, :3], vertices) + blend[:, :, 3])
            low, high = np.minimum(low, moved.min(axis=0)), np.maximum(high, moved.max(axis=0))
    return np.nan_to_num(np.maximum(high - low, 0), posinf=0.0)


def _check_extensions(document: Document, notes: list[str]) -> None:
    for name in document.get(document.json, "extensionsRequired", list, []):
        if not isinstance(name, str):
            raise AssetError(document.subject, "has a required extension of the wrong type")
        if "draco" in name or "meshopt" in name:
            raise AssetError(document.subject, f"is compressed ({name})", "Export it without mesh compression")
        if name not in _UNDERSTOOD and not name.startswith("KHR_materials_"):
            notes.append(f"required extension {name} is not understood and ignored")


class _Piece:
    """Arrays of one primitive in one place: per vertex, with faces into them."""

    __slots__ = ("colours", "faces", "material", "normals", "uvs", "vertices")

    def __init__(self, vertices: Array, faces: Array, material: int) -> None:
        self.vertices, self.faces, self.material = vertices, faces, material
        self.normals: Array | None = None
        self.uvs: Array | None = None
        self.colours: Array | None = None


def _primitive(
    document: Document,
    primitive: dict[str, Any],
    tree: NodeTree,
    node: dict[str, Any],
    node_index: int,
    materials: GltfMaterials,
    notes: list[str],
) -> _Piece | None:
    """One primitive of a mesh node, placed in the scene; None where it has no triangles."""
    extensions = document.get(primitive, "extensions", dict, {})
    if "KHR_draco_mesh_compression" in extensions:
        raise AssetError(document.subject, "is compressed with Draco", "Export it without mesh compression")
    attributes = document.get(primitive, "attributes", dict, {})
    mode = document.index(primitive, "mode")
    if "POSITION" not in attributes or mode in (0, 1, 2, 3):
        notes.append("points, lines and primitives without positions ignored")
        return None
    vertices = _float(document, attributes, "POSITION", ("VEC3",))
    assert vertices is not None
    faces = _triangles(document, primitive, mode, len(vertices))
    if "targets" in primitive:
        notes.append("shape keys (morph targets) left at rest")
    material, uv_set = materials.use(document.index(primitive, "material"))

    def beside(name: str, *kinds: str) -> Array | None:
        values = _float(document, attributes, name, kinds)
        if values is not None and len(values) != len(vertices):
            raise AssetError(document.subject, f"has {len(values)} {name} for {len(vertices)} vertices")
        return values

    normals, uvs = beside("NORMAL", "VEC3"), beside(f"TEXCOORD_{uv_set}", "VEC2")
    colours = beside("COLOR_0", "VEC3", "VEC4")
    skin = document.index(node, "skin")
    if skin is not None and "JOINTS_0" in attributes and "WEIGHTS_0" in attributes:
        blend = _blend_matrices(document, attributes, tree.skin_matrices(skin), len(vertices))
        piece = _Piece(np.einsum("nij,nj->ni", blend[:, :, :3], vertices) + blend[:, :, 3], faces, material)
        if normals is not None:
            piece.normals = np.einsum("nij,nj->ni", blend[:, :, :3], normals)
    else:
        matrices = tree.mesh_worlds(node_index)
        document.reserve(max(len(matrices) - 1, 0) * (vertices.nbytes + faces.nbytes))
        piece = _instances(vertices, faces, normals, matrices, material)
        uvs, colours = (None if a is None else np.tile(a, (len(matrices), 1)) for a in (uvs, colours))
    piece.vertices = vertices_up(piece.vertices)
    if piece.normals is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            piece.normals = vertices_up(piece.normals / np.linalg.norm(piece.normals, axis=1, keepdims=True))
    piece.uvs = None if uvs is None else np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1)
    piece.colours = None if colours is None else colours[:, :3]
    return piece


def _instances(vertices: Array, faces: Array, normals: Array | None, matrices: Array, material: int) -> _Piece:
    """A copy of a primitive for each of the matrices `matrices` (n, 4, 4), as one."""
    with np.errstate(all="ignore"):  # values that overflow are refused when all is joined
        linear = matrices[:, :3, :3]
        moved = vertices @ linear.transpose(0, 2, 1) + matrices[:, None, :3, 3]
        mirrored = np.linalg.det(linear) < 0  # the outside stays outside
        corners = np.where(mirrored[:, None, None], faces[:, ::-1], faces)
        corners += len(vertices) * np.arange(len(matrices))[:, None, None]
        piece = _Piece(moved.reshape(-1, 3), corners.reshape(-1, 3), material)
        if normals is not None:
            cofactors = np.stack([np.cross(linear[:, (i + 1) % 3], linear[:, (i + 2) % 3]) for i in range(3)], axis=1)
            cofactors[mirrored] *= -1
            piece.normals = (normals @ cofactors.transpose(0, 2, 1)).reshape(-1, 3)
    return piece


def vertices_up(vectors: Array) -> Array:
    """Y up to Z up, float32."""
    with np.errstate(over="ignore"):
        return vectors_to_z_up(vectors).astype(np.float32)


def _float(document: Document, attributes: dict[str, Any], name: str, kinds: tuple[str, ...]) -> Array | None:
    if name not in attributes:
        return None
    return document.accessor(attributes[name], kinds).astype(np.float64)


def _triangles(document: Document, primitive: dict[str, Any], mode: int | None, count: int) -> Array:
    """(m, 3) int32 faces of a primitive of triangles, a strip or a fan."""
    if "indices" in primitive:
        raw = document.accessor(primitive["indices"], ("SCALAR",))
        if raw.dtype.kind != "u":
            raise AssetError(document.subject, "has indices that are not unsigned integers")
        indices = raw[:, 0].astype(np.int64)
    else:
        indices = np.arange(count)
    if len(indices) and int(indices.max()) >= count:
        raise AssetError(document.subject, f"has faces that refer to vertex {int(indices.max())} of {count}")
    if mode == 5:
        strip = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1) if len(indices) > 2 else indices[:0]
        strip = strip.reshape(-1, 3)
        strip[1::2] = strip[1::2, ::-1]
        return strip
    if mode == 6:
        fan = [np.full(max(len(indices) - 2, 0), indices[0] if len(indices) else 0), indices[1:-1], indices[2:]]
        return np.stack([f[: len(fan[0])] for f in fan], axis=1)
    if mode not in (None, 4) or len(indices) % 3:
        raise AssetError(document.subject, f"has {len(indices)} indices in a primitive of mode {mode}, not triangles")
    return indices.reshape(-1, 3)


def _blend_matrices(document: Document, attributes: dict[str, Any], joints: Array, count: int) -> Array:
    """(n, 3, 4) matrix of each vertex: joint matrices blended by weights that are made to sum to 1."""
    blend = np.zeros((count, 3, 4))
    total = np.zeros(count)
    number = 0
    while f"JOINTS_{number}" in attributes and f"WEIGHTS_{number}" in attributes:
        which = document.accessor(attributes[f"JOINTS_{number}"], ("VEC4",))
        weights = document.accessor(attributes[f"WEIGHTS_{number}"], ("VEC4",)).astype(np.float64)
        if (
            which.dtype.kind != "u"
            or len(which) != count
            or len(weights) != count
            or which.max(initial=0) >= len(joints)
        ):
            raise AssetError(document.subject, "has joints or weights that do not fit its skin")
        for k in range(4):
            blend += weights[:, k, None, None] * joints[which[:, k], :3]
        total += weights.sum(axis=1)
        number += 1
    loose = ~(total > 0)  # vertices without weights follow the first joint, as in Blender
    blend[loose], total[loose] = joints[0, :3], 1.0
    return blend / total[:, None, None]


def _join(pieces: list[tuple[str, _Piece]], materials: list[MaterialFile], notes: list[str]) -> MeshFile:
    """All pieces as one mesh; what only some pieces have is filled in for the others."""
    if not pieces:
        return MeshFile(np.zeros((0, 3)), np.zeros((0, 3)), up_axis="Z", notes=[*notes, "no triangles"])
    starts = np.cumsum([0, *(len(p.vertices) for _, p in pieces)])
    ends = np.cumsum([len(p.faces) for _, p in pieces])
    parts: list[tuple[str, int, int]] = []
    for (name, piece), end in zip(pieces, ends.tolist(), strict=True):
        if parts and parts[-1][0] == name:
            parts[-1] = (name, parts[-1][1], end)
        else:
            parts.append((name, end - len(piece.faces), end))
    each = [p for _, p in pieces]
    mesh = MeshFile(
        vertices=np.concatenate([p.vertices for p in each]),
        faces=np.concatenate([p.faces + start for p, start in zip(each, starts, strict=False)]),
        face_material=np.concatenate([np.full(len(p.faces), p.material, np.int32) for p in each]),
        materials=materials,
        parts=parts,
        up_axis="Z",
        notes=notes,
    )
    if any(p.normals is not None for p in each):
        mesh.corner_normals = np.concatenate(
            [_flat_normals(p) if p.normals is None else p.normals[p.faces] for p in each]
        ).astype(np.float32)
    if any(p.uvs is not None for p in each):
        uvs = [np.zeros((len(p.faces), 3, 2)) if p.uvs is None else p.uvs[p.faces] for p in each]
        mesh.corner_uvs = np.concatenate(uvs).astype(np.float32)
    if any(p.colours is not None for p in each):
        colours = [np.ones_like(p.vertices) if p.colours is None else p.colours for p in each]
        mesh.vertex_colours = np.concatenate(colours).astype(np.float32)
    return mesh


def _flat_normals(piece: _Piece) -> Array:
    """Face normals at the corners, which is what glTF prescribes without NORMAL."""
    a, b, c = (piece.vertices[piece.faces[:, k]] for k in range(3))
    with np.errstate(all="ignore"):
        normals = np.cross(b - a, c - a)
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.repeat(np.nan_to_num(normals)[:, None], 3, axis=1)
