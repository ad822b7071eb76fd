"""Point caches of other programs (PC2, MDD) that Blender's Mesh Cache modifier plays on a DR-GS object."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import bpy

from ..drgs_blender.core.asset import Mesh

MODIFIER = "Point Cache"
SUFFIXES = (".pc2", ".mdd")
_MAGIC = b"POINTCACHE2\0"


def header_of(path: Path) -> tuple[int, int] | None:
    """(vertices, first frame) of a point cache; None where the file is none or cannot be read."""
    try:
        with open(path, "rb") as file:
            head = file.read(32)
    except OSError:
        return None
    if head.startswith(_MAGIC) and len(head) == 32:
        _, points, start, _, _ = struct.unpack("<2i2fi", head[12:])
        return points, round(start) if abs(start) < 1e6 else 1
    if path.suffix.lower() == ".mdd" and len(head) >= 8:
        return struct.unpack(">2i", head[:8])[1], 1
    return None


def attach(obj: bpy.types.Object, path: Path, first: int) -> bpy.types.Modifier:
    """Let `obj` play the file by a Mesh Cache modifier, before all modifiers that it has."""
    modifier = next((m for m in obj.modifiers if m.type == "MESH_CACHE" and m.name.startswith(MODIFIER)), None)
    if modifier is None:
        modifier = obj.modifiers.new(MODIFIER, "MESH_CACHE")
        obj.modifiers.move(len(obj.modifiers) - 1, 0)
    modifier.cache_format, modifier.filepath = path.suffix[1:].upper(), str(path)
    modifier.interpolation, modifier.time_mode, modifier.play_mode = "LINEAR", "FRAME", "SCENE"
    modifier.deform_mode, modifier.forward_axis, modifier.up_axis = "OVERWRITE", "POS_Y", "POS_Z"
    modifier.frame_start, modifier.frame_scale = first, 1.0
    return modifier


def check(obj: bpy.types.Object, rest: Mesh, warn: Callable[[str], None], *, final: bool) -> None:
    """Warn of point caches that Blender cannot play on `obj` because they have another number of vertices."""
    for modifier in obj.original.modifiers:
        if modifier.type != "MESH_CACHE" or not (modifier.show_render if final else modifier.show_viewport):
            continue
        path = Path(bpy.path.abspath(modifier.filepath, library=obj.original.library))
        found = header_of(path)
        if found is None or found[0] == len(rest.vertices):
            continue
        way = "choose a cache of this mesh"
        if found[0] == rest.source_count:
            way = "those of the mesh that its asset was made from: press Play Point Cache to play it in their order"
        warn(
            f'"{obj.name}" is not moved by modifier "{modifier.name}": {path.name} has {found[0]} vertices, the mesh '
            f"{len(rest.vertices)}; {way}"
        )
