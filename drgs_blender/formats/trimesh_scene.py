"""The meshes of a 3MF or COLLADA file as plain arrays in a file.

A program of its own, since a small file may place its objects without end. `scene_mesh` runs it with limits.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..core.errors import AssetError
from .subprocess_reader import limit, write_arrays

Array = np.ndarray

#: Name of the array that holds the rest as JSON.
ABOUT = "about"
#: Limit of all placed meshes, and of a zip's content: bytes, and bytes per byte of the file.
_ROOM, _RATIO = 64 << 20, 64
#: Times that a 3MF file may place an object, some and in proportion to its size.
_MAX_INSTANCES, _PER_BYTE = 1000, 0.1
#: Metres of 3MF's units.
UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
#: COLLADA's up axes, to Z up.
_TURNS = {
    "Z_UP": np.eye(3),
    "Y_UP": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "X_UP": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
}


def main(source: str, target: str, most_bytes: str, most_seconds: str) -> None:
    """Write the meshes of `source` to `target`; exit with a code (see `subprocess_reader`)."""
    limit(int(most_bytes), int(most_seconds))
    write_arrays(source, target, kind_of(source), read_scene)


def kind_of(source: str | Path) -> str:
    """Format of the file at `source`, "3MF" or "COLLADA": 3MF is a zip."""
    with open(source, "rb") as file:
        return "3MF" if file.read(2) == b"PK" else "COLLADA"


def read_scene(subject: str) -> dict[str, Array]:
    """Arrays "0/vertices" (metres, Z up), "0/faces", "0/uvs", "0/normals", "0/colours" of each placed mesh; `ABOUT`.

    Raises
    ------
    AssetError
        The file is damaged, or would be larger than such files can be.
    ImportError
        A package that is needed is not installed.
    """
    import lxml.etree  # noqa: F401 - trimesh needs it for 3MF

    with open(subject, "rb") as file:
        data = file.read()
    room = _ROOM + _RATIO * len(data)
    kind = kind_of(subject)
    metres, turn, found = _of_3mf(data, subject, room) if kind == "3MF" else _of_collada(data, subject)
    instances = found.pop("placed", None)
    scene = _load(data, kind)
    return _arrays(scene, turn, metres, room, instances, found, subject)


def _load(data: bytes, kind: str) -> dict[str, Any]:
    """What trimesh's loader says of the scene: to meshes it would join vertices that differ a little."""
    if kind == "COLLADA":
        import collada
        from trimesh.exchange.dae import load_collada

        try:
            return load_collada(io.BytesIO(data), resolver=_Names(), ignore_broken=False)
        except collada.common.DaeError as error:
            return load_collada(io.BytesIO(data), resolver=_Names()) | {"broken": str(error)[:200]}
    from trimesh.exchange.threemf import load_3MF

    return load_3MF(io.BytesIO(data))


class _Names:
    """Gives trimesh, in place of the files that it asks for, a picture that holds the name: it opens none itself."""

    def get(self, name: str) -> bytes:
        from PIL import Image, PngImagePlugin

        text, out = PngImagePlugin.PngInfo(), io.BytesIO()
        text.add_itxt("name", str(name)[:1000])
        Image.new("RGB", (1, 1)).save(out, "PNG", pnginfo=text)
        return out.getvalue()


def _of_3mf(data: bytes, subject: str, room: int) -> tuple[float, Array, dict[str, Any]]:
    """(Metres of the unit, no turn, what the XML has in numbers).

    Refuses what unpacks, or places objects, without end.
    """
    objects: dict[str, Counter[str]] = defaultdict(Counter)
    found: Counter[str] = Counter()
    unit, current = "millimeter", ""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > room:
            raise AssetError(subject, "unpacks to more than such files hold")
        names = [name for name in archive.namelist() if name.lower().endswith(".model")]
        for name in names:
            with archive.open(name) as model:
                for event, element in ElementTree.iterparse(model, ("start", "end")):
                    tag = element.tag.rpartition("}")[2]
                    if event == "end":
                        element.clear()
                        continue
                    found[tag] += 1
                    if tag == "model" and "3d/3dmodel" in name.lower():
                        unit = element.get("unit", unit)
                    elif tag == "object":
                        current = element.get("id", "")
                    elif tag == "component":
                        objects[current][element.get("objectid", "")] += 1
                    elif tag == "item":
                        objects["world"][element.get("objectid", "")] += 1
    if unit not in UNITS:
        raise AssetError(subject, f"has the unknown unit {unit[:30]!r}")
    if "world" not in objects:
        raise AssetError(subject, "places none of its objects")
    most = _MAX_INSTANCES + _PER_BYTE * len(data)
    if (instances := _instances("world", objects, {}, subject)) > most:
        raise AssetError(subject, f"places its objects {instances} times, more than such a file can")
    return UNITS[unit], np.eye(4), {**found, "placed": instances}


def _instances(name: str, objects: dict[str, Counter[str]], known: dict[str, int], subject: str, depth: int = 0) -> int:
    """How many objects without components the object `name` places."""
    if depth > 50:
        raise AssetError(subject, "has objects that contain themselves")
    if name not in known:
        inner = objects.get(name, Counter())
        count = sum(n * _instances(other, objects, known, subject, depth + 1) for other, n in inner.items())
        known[name] = count if inner else 1
    return known[name]


def _of_collada(data: bytes, subject: str) -> tuple[float, Array, dict[str, Any]]:
    """(Metres of the unit, (4, 4) turn to Z up, what the XML has in numbers)."""
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise AssetError(subject, "defines entities, which COLLADA needs not and which may grow without end")
    found: Counter[str] = Counter()
    metres, up = 1.0, "Y_UP"
    for event, element in ElementTree.iterparse(io.BytesIO(data), ("start", "end")):
        tag = element.tag.rpartition("}")[2]
        if event == "start":
            found[tag] += 1
            if tag == "input":
                found[element.get("semantic", "")] += 1
        elif tag == "unit" and found["unit"] == 1:
            metres = float(element.get("meter", "1"))
        elif tag == "up_axis" and found["up_axis"] == 1:
            up = (element.text or up).strip()
    if up not in _TURNS or not 1e-9 < metres < 1e9:
        raise AssetError(subject, f"has the up axis {up[:20]!r} and a unit of {metres:g} m")
    turn = np.eye(4)
    turn[:3, :3] = _TURNS[up]
    return metres, turn, dict(found)


def _arrays(
    scene: dict[str, Any],
    turn: Array,
    metres: float,
    room: int,
    instances: int | None,
    found: dict[str, Any],
    subject: str,
) -> dict[str, Array]:
    arrays: dict[str, Array] = {}
    pieces = []
    if instances is not None and len(scene["graph"]) != instances:
        raise AssetError(subject, f"places objects {instances} times, of which {len(scene['graph'])} can be followed")
    for i, node in enumerate(scene["graph"]):
        mesh = scene["geometry"][node["geometry"]]
        matrix = turn @ np.asarray(node["matrix"], np.float64)
        linear = matrix[:3, :3]
        vertices, faces = np.asarray(mesh["vertices"], np.float64), np.asarray(mesh["faces"], np.int64).reshape(-1, 3)
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
            raise AssetError(subject, "has faces of vertices that are not there")
        with np.errstate(all="ignore"):
            piece: dict[str, Array] = {"vertices": (vertices @ linear.T + matrix[:3, 3]) * metres}
            piece["faces"] = faces[:, ::-1] if np.linalg.det(linear) < 0 else faces
            visual = mesh.get("visual")
            attributes = {"normals": mesh.get("vertex_normals"), "colours": mesh.get("vertex_colors"),
                     "uvs": getattr(visual, "uv", None)}  # fmt: skip
            for name, values in attributes.items():
                width = 2 if name == "uvs" else 3
                if values is not None and np.ndim(values) == 2 and len(values) == len(vertices):
                    piece[name] = np.asarray(values, np.float64)[:, :width]
            if "normals" in piece:
                piece["normals"] = piece["normals"] @ np.linalg.pinv(linear)
            piece = {k: np.ascontiguousarray(v, np.int32 if k == "faces" else np.float32) for k, v in piece.items()}
        room -= sum(array.nbytes for array in piece.values())
        if room < 0:
            raise AssetError(subject, "places its meshes so often that they are more than such files hold")
        arrays |= {f"{i}/{name}": array for name, array in piece.items()}
        name = str(node.get("frame_to") or node["geometry"])
        pieces.append({"name": name, "material": _material(getattr(visual, "material", None))})
    about = {"broken": scene.get("broken"), "found": found, "metres": metres, "pieces": pieces}
    return {ABOUT: np.frombuffer(json.dumps(about).encode(), np.uint8), **arrays}


def _material(material: Any) -> dict[str, Any] | None:
    """What a MaterialFile takes of trimesh's material."""
    if material is None or not hasattr(material, "baseColorFactor"):
        return None
    colour = material.baseColorFactor
    picture = material.baseColorTexture
    rough = material.roughnessFactor
    return {
        "name": str(material.name or ""),
        "colour": [1.0, 1.0, 1.0] if colour is None else [float(c) / 255 for c in colour[:3]],
        "roughness": 0.5 if rough is None else min(max(float(rough), 0.0), 1.0),
        "picture": None if picture is None else picture.info.get("name"),
    }
