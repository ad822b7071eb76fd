"""Splats in glTF: the extension KHR_gaussian_splatting, read and written.

Khronos, KHR_gaussian_splatting: points with rotation (xyzw), linear scale, opacity and harmonics as attributes,
or packed (`gltf_spz`).
"""

from __future__ import annotations

from dataclasses import replace
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
from .gltf_spz import EXTENSION as COMPRESSION
from .gltf_spz import VERSIONS, Packed, packed
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
        The file is damaged, or its splats are compressed otherwise than `gltf_spz` reads.
    DeviceError
        See `spz.read_spz`.
    """
    document = Document(path)
    unpacked = Packed(document)
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
                splats, places = _primitive(document, primitive, settings, unpacked), tree.mesh_worlds(index)
                document.reserve(max(len(places) - 1, 0) * max(splats.sh.nbytes, _LEAST))
                pieces += [Piece(splats, place, settings.get("colorSpace") == _LINEAR) for place in places]
    if not pieces:
        raise AssetError(document.subject, "has no splats in its scene", "Export it again")
    notes = unpacked.notes
    if any((piece.splats.scale < 0).any() for piece in pieces):
        notes.append("negative scales: taken for the logarithms that drafts of the extension had")
        with np.errstate(over="ignore", invalid="ignore"):
            for splats in {id(piece.splats): piece.splats for piece in pieces}.values():
                splats.scale = np.exp(splats.scale)
    file = join_pieces(pieces, path, EXTENSION, "y")
    file.notes += notes
    return file


def _primitive(document: Document, primitive: dict[str, Any], settings: dict[str, Any], unpacked: Packed) -> Splats:
    """The splats of a primitive, their numbers as they are stored."""
    attributes = document.get(primitive, "attributes", dict, {})

    def read(name: str, kind: str, count: int | None = None) -> Array:
        if name not in attributes:
            raise AssetError(document.subject, f"has splats without {name}", "Export it again")
        with np.errstate(over="ignore", invalid="ignore"):
            values = document.accessor(attributes[name], (kind,)).astype(np.float32)
        if count is not None and len(values) != count:
            raise AssetError(document.subject, f"has {len(values)} {name} for {count} splats", "Export it again")
        return values

    def materials(n: int) -> SplatMaterials | None:
        if ALBEDO not in attributes:
            return None
        numbers = (read(name, "SCALAR", n)[:, 0] for name in (ROUGHNESS, METALLIC))
        return SplatMaterials(read(ALBEDO, "VEC3", n), *numbers)

    if compressed := document.get(settings, "extensions", dict, {}):
        said = None
        if "POSITION" in attributes:
            said = document.index(document.item("accessors", attributes["POSITION"]), "count")
        splats = unpacked.splats(compressed, settings, said)
        return replace(splats, materials=materials(len(splats)))
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
        materials(n),
    )


def write_gltf_splats(
    path: Path, splats: Splats, materials: bool = False, compress: bool = False, spz_version: int | None = None
) -> None:
    """Write a GLB with `splats`, which are Y up.

    Parameters
    ----------
    path : Path
    splats : Splats
    materials : bool
        Normals, albedo, roughness and metallic are attributes, too.
    compress : bool
        Everything else is packed as SPZ, see `gltf_spz`. Otherwise viewers that do not know the extension show coloured
        points.
    spz_version : int, optional
        Of `gltf_spz.VERSIONS`, of which the first one is taken without it.

    Raises
    ------
    AssetError
        See `splats.writable`, and with `compress` `spz_writer.write_spz`.
    UsageError
        There is nothing to write, or too much for a GLB; or `spz_version` does not fit.
    WriteError
        The file cannot be written.
    """
    subject = str(path)
    if not len(splats):
        raise UsageError(subject, "would hold no splats, which glTF does not allow", "Choose another input")
    if spz_version is not None and (not compress or spz_version not in VERSIONS):
        remedy = f"Choose one of {VERSIONS}" if compress else "Give --compress with it, or leave it out"
        problem = f"is {spz_version}, which {'SPZ in glTF cannot be' if compress else 'says nothing of this glTF'}"
        raise UsageError("--spz-version", problem, remedy)
    splats = writable(splats, subject)
    glb = Glb()
    settings: dict[str, Any] = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    used = [EXTENSION]
    if compress:
        used.append(COMPRESSION)
        glb.json["extensionsRequired"] = used
        data, centre = packed(splats, spz_version or VERSIONS[0], subject)
        settings["extensions"] = {COMPRESSION: {"bufferView": glb.view(data)}}
        attributes = _placeholders(glb, centre, splats.sh.shape[1])
    else:
        attributes = _attributes(glb, splats)
    if materials and splats.materials is not None:
        values = (normals(splats.rotation), *splats.materials.arrays())
        names = ("NORMAL", ALBEDO, ROUGHNESS, METALLIC)
        attributes |= {name: glb.accessor(array) for name, array in zip(names, values, strict=True)}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: settings}}
    glb.json |= {
        "extensionsUsed": used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": plain_name(path.stem)}],
        "meshes": [{"primitives": [primitive]}],
    }
    glb.write(path)


def _harmonics(count: int) -> list[str]:
    """Names of the attributes of so many harmonics."""
    names = [f"{EXTENSION}:SH_DEGREE_{l}_COEF_{i}" for l, width in enumerate(_WIDTHS) for i in range(width)]
    return names[:count]


def _attributes(glb: Glb, splats: Splats) -> dict[str, int]:
    """Accessors of everything."""
    shown = srgb_to_linear(np.clip(0.5 + SH_C0 * splats.sh[:, 0], 0, 1))
    colour = np.rint(np.concatenate([shown, splats.opacity[:, None]], axis=1) * 65535).astype(np.uint16)
    attributes = {
        "POSITION": glb.accessor(splats.centre, bounds=True),
        "COLOR_0": glb.accessor(colour, normalized=True),
        f"{EXTENSION}:ROTATION": glb.accessor(splats.rotation[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": glb.accessor(splats.scale),
        f"{EXTENSION}:OPACITY": glb.accessor(splats.opacity),
    }
    return attributes | {name: glb.accessor(splats.sh[:, k]) for k, name in enumerate(_harmonics(splats.sh.shape[1]))}


def _placeholders(glb: Glb, centre: Array, coefficients: int) -> dict[str, int]:
    """Accessors without data of what is packed: those of the base extension, and the colour that the draft has."""
    n = len(centre)
    widths = {"COLOR_0": 4, f"{EXTENSION}:ROTATION": 4, f"{EXTENSION}:SCALE": 3, f"{EXTENSION}:OPACITY": 1}
    widths |= dict.fromkeys(_harmonics(coefficients), 3)
    first = {"POSITION": glb.placeholder(n, 3, (centre.min(axis=0), centre.max(axis=0)))}
    return first | {name: glb.placeholder(n, width) for name, width in widths.items()}
