"""3MF and COLLADA: placed meshes, in metres and Z up, read with trimesh by a process of its own (`trimesh_scene`)."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from ..core.asset.tensors import parse_json
from ..core.color import srgb_to_linear
from ..core.errors import AssetError
from ..core.own_python import install_remedy
from . import trimesh_scene
from .files import Image, MaterialFile, MeshFile
from .obj import beside, load_texture
from .subprocess_reader import read_in_subprocess
from .triangle_soup import join_equal
from .trimesh_scene import ABOUT

Array = np.ndarray

_REMEDY = "Import it in another program and export glTF (.glb), which is read whole"
#: What of a file is left out: elements of its XML, and what they are called.
_LEFT_OUT = {
    "3MF": {("base", "color", "tex2coord"): "colours and materials", ("beam",): "beams"},
    "COLLADA": {
        ("instance_controller",): "skinned and morphed meshes",
        ("bump", "normalmap"): "normal maps",
        ("lines", "linestrips"): "lines",
        ("animation",): "animation",
    },
}
_COLLADA = re.compile(rb"<(?:\w+:)?COLLADA\b")


def sniff_3mf(head: bytes, path: Path) -> bool:
    """Whether a file is a zip with a 3D model."""
    if not head.startswith(b"PK\x03\x04"):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(re.search(r"(^|/)3d/[^/]*\.model$", name.lower()) for name in archive.namelist())
    except (zipfile.BadZipFile, ValueError, OverflowError, NotImplementedError, OSError):
        return path.suffix.lower() == ".3mf"


def sniff_collada(head: bytes, path: Path) -> bool:
    """Whether a file is COLLADA."""
    return _COLLADA.search(head[:4096]) is not None


def read_scene_mesh(path: Path) -> MeshFile:
    """Read all meshes of a 3MF or COLLADA file where it places them, in metres, Z up.

    Raises
    ------
    AssetError
        The file is damaged, or has nothing that is read.
    DeviceError
        lxml or pycollada is not installed.
    """
    kind = trimesh_scene.kind_of(path)
    remedy = f"Install them: {install_remedy('lxml pycollada', 'USD, 3MF and COLLADA')}"
    missing = "needs the packages lxml and pycollada", remedy
    arrays = read_in_subprocess(path, trimesh_scene.__name__, kind, missing)
    about = parse_json(arrays[ABOUT].tobytes(), str(path))
    found, pieces = about["found"], about["pieces"]
    left_out = [name for tags, name in _LEFT_OUT[kind].items() if any(found.get(tag) for tag in tags)]
    notes = [f"{', '.join(left_out)} left out"] if left_out else []
    if about["broken"]:
        notes.append(f"broken or unknown elements left out ({about['broken']})")
    if not pieces:
        more = f" but {', '.join(left_out)}" if left_out else ""
        raise AssetError(str(path), f"places no mesh that is read{more}", _REMEDY)
    if about["metres"] != 1:
        notes.append(f"lengths converted from {about['metres']:g} m to metres")
    if kind == "COLLADA":
        notes.append("materials of COLLADA have no metallic: 0")
    mesh = _joined([_piece(arrays, i) for i in range(len(pieces))], pieces)
    mesh.notes += notes
    if mesh.vertex_colours is not None:
        mesh.notes.append("vertex colours decoded from sRGB")
    _paint(mesh, pieces, path)
    return mesh


def _piece(arrays: dict[str, Array], i: int) -> dict[str, Array]:
    return {name: arrays[f"{i}/{name}"] for name in ("vertices", "faces", "normals", "uvs", "colours")
            if f"{i}/{name}" in arrays}  # fmt: skip


def _joined(meshes: list[dict[str, Array]], about: list[dict[str, Any]]) -> MeshFile:
    """One mesh of all: corners at the same place of the same piece, with the same colour, are one vertex."""
    coloured, mapped = (any(name in mesh for mesh in meshes) for name in ("colours", "uvs"))
    smooth = all("normals" in mesh for mesh in meshes)
    columns: dict[str, list[Array]] = {
        name: [] for name in ("vertices", "faces", "colours", "normals", "uvs", "numbers")
    }
    parts, faces, vertices, read = [], 0, 0, 0
    for mesh, of in zip(meshes, about):
        corners, n = mesh["faces"], len(mesh["vertices"])
        colours = mesh.get("colours", np.ones((n, 3), np.float32)) if coloured else np.zeros((n, 0), np.float32)
        first, number = join_equal(mesh["vertices"], colours)
        columns["vertices"].append(mesh["vertices"][first])
        columns["colours"].append(colours[first])
        columns["numbers"].append(first + read)
        columns["faces"].append(number[corners] + vertices)
        columns["uvs"].append(mesh.get("uvs", np.zeros((n, 2), np.float32))[corners])
        columns["normals"].append(mesh.get("normals", np.zeros((n, 3), np.float32))[corners])
        parts.append((of["name"], faces, faces + len(corners)))
        faces, vertices, read = faces + len(corners), vertices + len(first), read + n
    whole = {name: np.concatenate(values) for name, values in columns.items()}
    numbers = None if vertices == read else whole["numbers"]
    joined = MeshFile(whole["vertices"], whole["faces"], parts=parts, up_axis="Z", numbers=numbers, file_count=read)
    joined.corner_uvs = whole["uvs"] if mapped else None
    with np.errstate(all="ignore"):
        length = np.linalg.norm(whole["normals"], axis=2, keepdims=True)
        if smooth and np.isfinite(length).all() and (length > 0).all():
            joined.corner_normals = (whole["normals"] / length).astype(np.float32)
    if coloured:
        joined.vertex_colours = srgb_to_linear(np.clip(np.nan_to_num(whole["colours"]), 0, 1))
    return joined


def _paint(mesh: MeshFile, pieces: list[dict[str, Any]], path: Path) -> None:
    """Materials of the pieces, each once, with the pictures that lie beside the file."""
    numbers: dict[str, int] = {}
    pictures: dict[str, Image | None] = {}
    mesh.face_material = np.full(len(mesh.faces), -1, np.int32)
    for piece, (_, first, end) in zip(pieces, mesh.parts):
        arguments = piece["material"]
        if arguments is None:
            continue
        key = repr(sorted(arguments.items()))
        if key not in numbers:
            numbers[key] = len(mesh.materials)
            name = arguments["picture"]
            if name is not None and name not in pictures:
                pictures[name] = load_texture(beside(path, unquote(name.removeprefix("file://"))), name, mesh.notes)
            r, g, b = arguments["colour"]
            label = arguments["name"] or f"Material {len(mesh.materials)}"
            mesh.materials.append(
                MaterialFile(label, (r, g, b), arguments["roughness"], base_colour_image=pictures.get(name))
            )
        mesh.face_material[first:end] = numbers[key]
