"""Splats in glTF: the extension KHR_gaussian_splatting, read and written.

Khronos, KHR_gaussian_splatting: points with rotation (xyzw), linear scale, opacity and harmonics as attributes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core.color import srgb_to_linear
from ..core.errors import AssetError, UsageError
from .files import SurfelFile, plain_name
from .gaussian_ply import SH_C0
from .glb import Glb
from .gltf_document import Document
from .gltf_nodes import NodeTree
from .splat_scene import Piece, join_pieces
from .splats import SplatMaterials, Splats, normals, writable

Array = np.ndarray

EXTENSION = "KHR_gaussian_splatting"
#: Attributes of our own, as glTF names what no specification does; docs/relightable-splats.md.
ALBEDO, ROUGHNESS, METALLIC = "_ALBEDO", "_ROUGHNESS", "_METALLIC"
_WIDTHS = (1, 3, 5, 7)
_LINEAR = "lin_rec709_display"
#: Bytes that any instance counts for: each costs time, however small it is.
_LEAST = 1 << 14


def has_splats(head: bytes) -> bool:
    """Whether the start of a glTF file, whose JSON comes first, speaks of splats."""
    return f'"{EXTENSION}"'.encode() in head


def read_gltf_splats(path: Path) -> SurfelFile:
    """Read all splats of the default scene of a glTF file; Y up.

    Raises
    ------
    AssetError
        The file is damaged, or its splats are compressed.
    """
    document = Document(path)
    tree = NodeTree(document, "default")
    pieces: list[Piece] = []
    for index in tree.order:
        node = document.items("nodes")[index]
        mesh = document.index(node, "mesh")
        if mesh is None:
            continue
        for primitive in document.get(document.item("meshes", mesh), "primitives", list, []):
            extensions = document.get(primitive, "extensions", dict, {}) if isinstance(primitive, dict) else {}
            settings = document.get(extensions, EXTENSION, dict)
            if settings is not None:
                splats, places = _primitive(document, primitive, settings), tree.mesh_worlds(index)
                document.reserve(max(len(places) - 1, 0) * max(splats.sh.nbytes, _LEAST))
                pieces += [Piece(splats, place, settings.get("colorSpace") == _LINEAR) for place in places]
    if not pieces:
        raise AssetError(document.subject, "has no splats in its scene", "Export it again")
    notes = []
    if any((piece.splats.scale < 0).any() for piece in pieces):
        notes.append("negative scales: taken for the logarithms that drafts of the extension had")
        with np.errstate(over="ignore", invalid="ignore"):
            for splats in {id(piece.splats): piece.splats for piece in pieces}.values():
                splats.scale = np.exp(splats.scale)
    file = join_pieces(pieces, path, EXTENSION, "y")
    file.notes += notes
    return file


def _primitive(document: Document, primitive: dict[str, Any], settings: dict[str, Any]) -> Splats:
    """The attributes of a primitive as they are stored."""
    if compressed := document.get(settings, "extensions", dict, {}):
        raise AssetError(document.subject, f"has splats with {', '.join(compressed)}", "Export it without compression")
    attributes = document.get(primitive, "attributes", dict, {})

    def read(name: str, kind: str, count: int | None = None) -> Array:
        if name not in attributes:
            raise AssetError(document.subject, f"has splats without {name}", "Export it again")
        with np.errstate(over="ignore", invalid="ignore"):
            values = document.accessor(attributes[name], (kind,)).astype(np.float32)
        if count is not None and len(values) != count:
            raise AssetError(document.subject, f"has {len(values)} {name} for {count} splats", "Export it again")
        return values

    centre = read("POSITION", "VEC3")
    n = len(centre)
    degree = 0
    while degree < 3 and f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in attributes:
        degree += 1
    names = [f"{EXTENSION}:SH_DEGREE_{l}_COEF_{i}" for l in range(degree + 1) for i in range(_WIDTHS[l])]
    return Splats(
        centre,
        read(f"{EXTENSION}:SCALE", "VEC3", n),
        read(f"{EXTENSION}:ROTATION", "VEC4", n)[:, [3, 0, 1, 2]],
        read(f"{EXTENSION}:OPACITY", "SCALAR", n)[:, 0],
        np.stack([read(name, "VEC3", n) for name in names], axis=1),
        None
        if ALBEDO not in attributes
        else SplatMaterials(
            read(ALBEDO, "VEC3", n), read(ROUGHNESS, "SCALAR", n)[:, 0], read(METALLIC, "SCALAR", n)[:, 0]
        ),
    )


def write_gltf_splats(path: Path, splats: Splats, materials: bool = False) -> None:
    """Write a GLB with `splats`, which are Y up; viewers that do not know the extension show coloured points.

    With `materials`, normals, albedo, roughness and metallic are attributes, too.

    Raises UsageError (nothing to write, or too much for a GLB), AssetError (see `splats.writable`) or WriteError.
    """
    if not len(splats):
        raise UsageError(str(path), "would hold no splats, which glTF does not allow", "Choose another input")
    splats = writable(splats, str(path))
    glb = Glb()
    shown = srgb_to_linear(np.clip(0.5 + SH_C0 * splats.sh[:, 0], 0, 1))
    colour = np.rint(np.concatenate([shown, splats.opacity[:, None]], axis=1) * 65535).astype(np.uint16)
    attributes = {
        "POSITION": glb.accessor(splats.centre, bounds=True),
        "COLOR_0": glb.accessor(colour, normalized=True),
        f"{EXTENSION}:ROTATION": glb.accessor(splats.rotation[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": glb.accessor(splats.scale),
        f"{EXTENSION}:OPACITY": glb.accessor(splats.opacity),
    }
    if materials and splats.materials is not None:
        values = (normals(splats.rotation), *splats.materials.arrays())
        names = ("NORMAL", ALBEDO, ROUGHNESS, METALLIC)
        attributes |= {name: glb.accessor(array) for name, array in zip(names, values, strict=True)}
    first = 0
    for degree, width in enumerate(_WIDTHS):
        for i in range(width if first + width <= splats.sh.shape[1] else 0):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"] = glb.accessor(splats.sh[:, first + i])
        first += width
    settings = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: settings}}
    glb.json |= {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": plain_name(path.stem)}],
        "meshes": [{"primitives": [primitive]}],
    }
    glb.write(path)
