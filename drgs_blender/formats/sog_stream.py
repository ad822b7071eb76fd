"""Streamed SOG, PlayCanvas's large splats, version 1: a lod-meta.json beside folders that hold a SOG each.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/. The leaves of a tree name, for
each level of detail, rows of those files; level 0 is the finest, and each level is the whole scene. One level is read.
"""

from __future__ import annotations

import json
import posixpath
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import AssetError
from .files import SurfelFile
from .gltf_document import below, is_name
from .packed_splats import decode_arrays, log_scale
from .sog import sog_splats
from .splats import Splats, join_splats

Array = np.ndarray

NAME = "lod-meta.json"
#: A leaf takes some 200 bytes and stands for many thousand splats.
_LARGEST = 64 << 20
_REMEDY = "Export it again, or restore it from a copy"


def sniff_streamed_sog(head: bytes, path: Path) -> bool:
    """Whether a file is the index of a streamed SOG: by its name, or by what it says."""
    if not head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        return False
    return path.name.lower() == NAME or (b'"lodLevels"' in head and b'"filenames"' in head)


def read_streamed_sog(path: Path) -> SurfelFile:
    """Read the finest level of detail of a streamed SOG. Its environment, splats far around it, is left out.

    Raises
    ------
    AssetError
        The index or one of the files that the level needs is missing or damaged.
    """
    subject = str(path)
    meta = _index(path, subject)
    levels = _levels(meta, subject)
    level = min(levels, default=None)
    parts = [] if level is None else [_chunk(path, name, rows, subject) for name, rows in levels[level].items()]
    if not parts:
        raise AssetError(subject, "names no splats", _REMEDY)
    whole = join_splats(parts)
    scale = log_scale(whole.scale)
    file = decode_arrays(whole.centre, scale, whole.rotation, whole.opacity, whole.sh, path, "streamed SOG")
    file.notes.append(f"level of detail {level} of {meta['lodLevels']}, the finest there is, from {len(parts)} files")
    if isinstance(meta.get("environment"), str):
        file.notes.append(f"the environment is left out; {meta['environment'][:60]} can be imported by itself")
    return file


def _index(path: Path, subject: str) -> dict[str, Any]:
    """The JSON, whose entries are of the types they should have."""
    if path.stat().st_size > _LARGEST:
        raise AssetError(subject, f"is an index of more than {_LARGEST >> 20} MiB", _REMEDY)
    try:
        meta = json.loads(path.read_bytes().decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise AssetError(subject, f"is a damaged index ({error})", _REMEDY) from error
    if not isinstance(meta, dict):
        raise AssetError(subject, "is no object", _REMEDY)
    if meta.get("version", 1) != 1:  # older ones say no version
        raise AssetError(subject, f"is streamed SOG of version {str(meta['version'])[:20]}; 1 is read", _REMEDY)
    if not _whole(meta.get("lodLevels")) or meta["lodLevels"] < 1:
        raise AssetError(subject, f"has {str(meta.get('lodLevels'))[:20]} levels of detail", _REMEDY)
    names = meta.get("filenames")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise AssetError(subject, "has no list of filenames", _REMEDY)
    return meta


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _levels(meta: dict[str, Any], subject: str) -> dict[int, dict[str, list[tuple[int, int]]]]:
    """Per level that has splats, the rows (first, count) of each file that the leaves of the tree name."""
    levels: dict[int, dict[str, list[tuple[int, int]]]] = {}
    names, waiting = meta["filenames"], [meta.get("tree")]
    while waiting:  # trees may be as deep as they like
        node = waiting.pop()
        children, lods = (node.get("children", []), node.get("lods", {})) if isinstance(node, dict) else (None, None)
        if not isinstance(children, list) or not isinstance(lods, dict):
            raise AssetError(subject, "has a damaged tree", _REMEDY)
        waiting += reversed(children)
        for key, entry in lods.items():
            fields = ("file", "offset", "count")
            numbers: list[Any] = [entry.get(name) for name in fields] if isinstance(entry, dict) else [None]
            good = all(_whole(number) for number in numbers) and numbers[0] < len(names)
            if not good or not (key.isascii() and key.isdigit() and len(key) < 10 and int(key) < meta["lodLevels"]):
                raise AssetError(subject, f"has a leaf whose level {key[:20]!r} names no rows of a file", _REMEDY)
            if numbers[2]:
                # One file by several names would be read as often.
                name = posixpath.normpath(names[numbers[0]].replace("\\", "/"))
                rows = levels.setdefault(int(key), {}).setdefault(name, [])
                rows.append((numbers[1], numbers[2]))
    for level, files in levels.items():
        said, found = meta.get("counts"), sum(count for rows in files.values() for _, count in rows)
        if isinstance(said, list) and (level >= len(said) or said[level] != found):  # older ones say no counts
            raise AssetError(subject, f"has a tree with {found} splats of level {level}, other than it says", _REMEDY)
    return levels


def _chunk(path: Path, name: str, rows: list[tuple[int, int]], subject: str) -> Splats:
    """The rows of a file that a level consists of, in the order they have there."""
    if not is_name(name) or ":" in name or not below(name):
        raise AssetError(subject, f"refers to {name[:60]!r}, which is no file below it", _REMEDY)
    splats = sog_splats(path.parent / name, f"{subject}, {name[:60]}")
    rows = sorted(rows)
    ends = [0, *(first + count for first, count in rows)]
    if ends[-1] > len(splats) or any(first < end for (first, _), end in zip(rows, ends, strict=False)):
        problem = f"names rows of {name[:60]} that overlap, or that its {len(splats)} splats do not have"
        raise AssetError(subject, problem, _REMEDY)
    if sum(count for _, count in rows) == len(splats):
        return splats
    index = np.concatenate([np.arange(first, first + count) for first, count in rows])
    arrays = {field: getattr(splats, field)[index] for field in ("centre", "scale", "rotation", "opacity", "sh")}
    return replace(splats, **arrays)
