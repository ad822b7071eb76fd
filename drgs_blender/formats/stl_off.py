"""STL and OFF, read with trimesh; what it would pass over in silence is checked here."""

from __future__ import annotations

import io
import re
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset.archive import first_reason
from ..core.color import srgb_to_linear
from ..core.errors import AssetError
from .files import MeshFile
from .triangle_soup import join_equal

Array = np.ndarray

_DAMAGED = "Export the file again, or restore it from a copy"
#: Bytes of binary STL: the text and the count at its beginning, a triangle.
_START, _TRIANGLE = 84, 50
_SOLID = re.compile(rb"^[ \t]*(end)?solid\b[ \t]*([^\n]*)", re.IGNORECASE | re.MULTILINE)
_FACET = re.compile(rb"^[ \t]*facet\b[^\n]*", re.IGNORECASE | re.MULTILINE)
_OFF = re.compile(rb"\s*(?:#[^\n]*\n\s*)*((?:ST)?(C?)(N?)4?n?OFF)\b(?:[ \t]+BINARY\b)?")


def sniff_stl(head: bytes, path: Path) -> bool:
    """Whether a file is STL: text with facets, or a count that fits its size."""
    text = head.lstrip()[:5].lower() == b"solid" and _FACET.search(head) is not None
    if text or (path.suffix.lower() == ".stl" and head):
        return True
    return _count(head) > 0 and path.stat().st_size == _START + _TRIANGLE * _count(head)


def sniff_off(head: bytes, path: Path) -> bool:
    """Whether a file is OFF."""
    return _OFF.match(head) is not None


def _count(head: bytes) -> int:
    """The number of triangles that binary STL gives; -1 where it is too short."""
    return struct.unpack_from("<I", head, 80)[0] if len(head) >= _START else -1


def read_stl(path: Path) -> MeshFile:
    """Read binary or text STL; corners at exactly the same place become one vertex. Axes are as in the file.

    Raises
    ------
    AssetError
        The file is truncated or damaged.
    """
    data = path.read_bytes()
    notes: list[str] = []
    count = _count(data)
    binary = count >= 0 and len(data) == _START + _TRIANGLE * count
    if not binary and (data.lstrip()[:5].lower() != b"solid" or _FACET.search(data) is None):
        if count == 0 or (data.lstrip()[:5].lower() == b"solid" and b"endsolid" in data[-1000:].lower()):
            raise AssetError(str(path), "has no triangles", "Choose a file with a surface")
        held = max(len(data) - _START, 0) // _TRIANGLE
        if held < count or count < 0:
            problem = f"says that it has {max(count, 0)} triangles, and has the bytes of {held}"
            raise AssetError(str(path), problem, _DAMAGED)
        notes.append(f"{len(data) - _START - _TRIANGLE * count} bytes behind the last triangle ignored")
        data, binary = data[: _START + _TRIANGLE * count], True
    names: list[str] = []
    wanted = count
    if not binary:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        named = [found for found in _SOLID.finditer(data) if not found[1]]
        names = [found[2].strip().decode(errors="replace") for found in named]
        # The library looks for its words in names, too: these get none.
        numbers = iter(range(len(named)))
        data = _SOLID.sub(lambda found: b"endsolid" if found[1] else b"solid %d" % next(numbers), data)
        data, wanted = _FACET.subn(b"facet", data)  # without normals, which follow from the corners
    corners: list[Array] = []
    parts: list[tuple[str, int, int]] = []
    done = 0
    for mesh in _load(data, "stl", path):
        corners.append(np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)].reshape(-1, 3))
        name = str(mesh.metadata.get("name", ""))
        first, done = done, done + len(mesh.faces)
        if name.isdigit() and int(name) < len(names) and names[int(name)]:
            parts.append((names[int(name)], first, done))
    if done != wanted:
        raise AssetError(str(path), f"has {wanted} triangles, of which {done} are whole", _DAMAGED)
    if binary and (coloured := _coloured(data)):
        notes.append(f"colours of {coloured} faces left out")
    with np.errstate(over="ignore"):
        soup = np.concatenate(corners or [np.zeros((0, 3))]).astype(np.float32)
    first_of, number = join_equal(soup)
    notes.append(f"{len(soup)} corners of separate triangles joined to {len(first_of)} vertices, where exactly equal")
    faces = number.reshape(-1, 3)
    return MeshFile(soup[first_of], faces, parts=parts, notes=notes, numbers=first_of, file_count=len(soup))


def _coloured(data: bytes) -> int:
    """Faces of binary STL that use the two bytes in which some programs keep colours."""
    bytes_ = np.frombuffer(data, np.uint8, offset=_START).reshape(-1, _TRIANGLE)
    return int(np.count_nonzero(bytes_[:, 48:].any(axis=1)))


def read_off(path: Path) -> MeshFile:
    """Read OFF with or without colours of vertices, which are taken as sRGB. Axes are as in the file.

    Raises
    ------
    AssetError
        The file is truncated, damaged, binary or not of three dimensions.
    """
    data = path.read_bytes()
    match = _OFF.match(data)
    if match is None or match[0].endswith(b"BINARY") or match[1][-4:-3] in (b"4", b"n"):
        problem = "is OFF that is binary or not of three dimensions"
        raise AssetError(str(path), problem, "Export it as text with three coordinates a vertex")
    text = data[match.end() :].decode("latin-1")
    lines = [line for row in text.splitlines() if (line := row.partition("#")[0].strip())]
    counts = lines[0].split()[:2] if lines else []
    if len(counts) < 2 or not all(count.isdecimal() and len(count) < 12 for count in counts):
        raise AssetError(str(path), "does not say how many vertices and faces it has", _DAMAGED)
    vertices, faces = map(int, counts)
    if len(lines) < 1 + vertices + faces:
        problem = f"says that it has {vertices} vertices and {faces} faces, and has {len(lines) - 1} lines of them"
        raise AssetError(str(path), problem, _DAMAGED)
    meshes = _load("\n".join(["OFF", *lines]).encode(), "off", path)
    notes: list[str] = []
    if any(len(words) > 1 + int(words[0]) for words in map(str.split, lines[1 + vertices : 1 + vertices + faces])):
        notes.append("colours of faces left out")
    if not meshes:
        return MeshFile(np.zeros((0, 3)), np.zeros((0, 3)), notes=notes)
    corners = np.asarray(meshes[0].faces)
    if corners.size and not 0 <= corners.min() <= corners.max() < vertices:
        raise AssetError(str(path), f"has faces of other vertices than its {vertices}", _DAMAGED)
    with np.errstate(over="ignore"):
        mesh = MeshFile(np.asarray(meshes[0].vertices).astype(np.float32), corners, notes=notes)
    if match[2] and len(mesh.vertices) == vertices:
        mesh.vertex_colours = _colours([line.split() for line in lines[1 : 1 + vertices]], 6 if match[3] else 3)
        notes.append("vertex colours left out: not three numbers each" if mesh.vertex_colours is None else
                     "vertex colours decoded from sRGB")  # fmt: skip
    return mesh


def _colours(rows: list[list[str]], start: int) -> Array | None:
    """(n, 3) linear colours of vertices from the numbers at `start`; None where they are none.

    Whole numbers are of 255, others of 1.
    """
    words = [row[start : start + 3] for row in rows]
    try:
        values = np.array(words, np.float64).reshape(len(rows), 3)
    except ValueError:
        return None
    whole = all(word.isdigit() for row in words for word in row)
    return srgb_to_linear(np.clip(np.nan_to_num(values / 255 if whole else values), 0, 1))


def _load(data: bytes, kind: str, path: Path) -> list[Any]:
    """The meshes that trimesh finds, as they are in the file."""
    import trimesh

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # by which older numpy says that text is no number
            return list(trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False).geometry.values())
    except MemoryError:
        raise
    except Exception as error:  # what is wrong with damaged files shows wherever the library stumbles over it
        said = first_reason(str(error) or type(error).__name__)
        raise AssetError(str(path), f"is no {kind.upper()} that can be read ({said})", _DAMAGED) from error
