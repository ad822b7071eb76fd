"""Paths as a .blend keeps them."""

from __future__ import annotations

from pathlib import Path

import bpy


def relative(path: Path) -> str:
    """The path, relative to the .blend once that is saved, where it can be."""
    if not bpy.data.filepath:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive on Windows
        return str(path)
