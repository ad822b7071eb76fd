"""Point caches (PC2, MDD) and the Mesh Cache modifier by which Blender plays them on a DR-GS object.

Layouts after Autodesk's PointCache 2 and NewTek's MDD, as Blender's MOD_meshcache_pc2.c and _mdd.c read them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import bpy

from ..drgs_blender.core.asset import Mesh
from .blend_paths import relative

MODIFIER = "Point Cache"
#: Head of a PC2: magic, version, vertices, first frame, frames per sample, samples; of an MDD: samples, vertices.
PC2, _MDD = struct.Struct("<12s2i2fi"), struct.Struct(">2i")
MAGIC = b"POINTCACHE2\0"


def header_of(path: Path) -> tuple[int, int] | None:
    """(vertices, first frame) of a point cache; None where the file is none or cannot be read."""
    try:
        with open(path, "rb") as file:
            head = file.read(PC2.size)
    except OSError:
        return None
    if head.startswith(MAGIC) and len(head) == PC2.size:
        _, _, points, start, _, _ = PC2.unpack(head)
        return points, round(start) if abs(start) < 1e6 else 1
    if path.suffix.lower() == ".mdd" and len(head) >= _MDD.size:
        return _MDD.unpack(head[: _MDD.size])[1], 1
    return None


def find(obj: bpy.types.Object, name: str) -> bpy.types.Modifier | None:
    """The Mesh Cache modifier of `obj` with this name, or that and a number."""
    return next((m for m in obj.modifiers if m.type == "MESH_CACHE" and m.name.startswith(name)), None)


def play(modifier: bpy.types.Modifier, path: Path, first: int) -> None:
    """Let a Mesh Cache modifier play the file from frame `first` on, in object space, Z up."""
    modifier.cache_format, modifier.filepath = path.suffix[1:].upper(), relative(path)
    modifier.interpolation, modifier.time_mode, modifier.play_mode = "LINEAR", "FRAME", "SCENE"
    modifier.deform_mode, modifier.forward_axis, modifier.up_axis = "OVERWRITE", "POS_Y", "POS_Z"
    modifier.frame_start, modifier.frame_scale = first, 1.0


def attach(obj: bpy.types.Object, path: Path, first: int) -> None:
    """Let `obj` play the file by a Mesh Cache modifier, before all modifiers that it has."""
    modifier = find(obj, MODIFIER)
    if modifier is None:
        modifier = obj.modifiers.new(MODIFIER, "MESH_CACHE")
        obj.modifiers.move(len(obj.modifiers) - 1, 0)
    play(modifier, path, first)


def check(obj: bpy.types.Object, rest: Mesh, warn: Callable[[str], None], *, final: bool) -> None:
    """Warn of point caches that Blender cannot play on `obj` because they have another number of vertices."""
    count = len(obj.original.data.vertices)
    for modifier in obj.original.modifiers:
        if modifier.type != "MESH_CACHE" or not (modifier.show_render if final else modifier.show_viewport):
            continue
        path = Path(bpy.path.abspath(modifier.filepath, library=obj.original.library))
        found = header_of(path)
        if found is None or found[0] == count:
            continue
        way = "choose a cache of this mesh"
        if found[0] == len(rest.vertices):
            way = "undo the edit of its mesh, or make the cache again"
        elif found[0] == rest.source_count:
            way = "those of the mesh that its asset was made from: press Play Point Cache to play it in their order"
        warn(
            f'"{obj.name}" is not moved by modifier "{modifier.name}": {path.name} has {found[0]} vertices, the mesh '
            f"{count}; {way}"
        )
