"""Paths as a .blend keeps them."""

from __future__ import annotations

from pathlib import Path

import bpy

#: Options of a StringProperty for a path that may start with "//": newer Blenders want it said, older ones refuse it.
RELATIVE: set[str] = (
    {"PATH_SUPPORTS_BLEND_RELATIVE"}
    if "is_path_supports_blend_relative" in bpy.types.StringProperty.bl_rna.properties
    else set()
)


def relative(path: Path) -> str:
    """The path, relative to the .blend once that is saved, where it can be."""
    if not bpy.data.filepath:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive on Windows
        return str(path)
