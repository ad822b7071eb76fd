"""The .drgs file behind an object: where it lies and what its rest mesh is."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Iterable
from pathlib import Path

import bpy
import numpy as np

from ..drgs_blender.core.asset import Asset, Mesh
from ..drgs_blender.core.asset.container import read_asset
from ..drgs_blender.core.asset.part import vertices_of
from ..drgs_blender.core.errors import AssetError, UsageError
from ..drgs_blender.core.frame_sequences import frame_path
from ..drgs_blender.core.system import replace
from . import mesh_arrays
from .blend_paths import relative
from .preferences import ROOT

#: (path, mtime_ns, size) -> asset, arrays memory-mapped. A changed file gets a new key; `forget` empties it.
_open: dict[tuple[str, int, int], Asset] = {}
#: Files that programs are writing, of which there will be objects.
_coming: set[str] = set()


def is_drgs(obj: bpy.types.Object | None) -> bool:
    """Whether `obj` is a mesh object with a DR-GS asset."""
    return obj is not None and obj.type == "MESH" and obj.drgs.asset is not None


def collection(context: bpy.types.Context) -> bpy.types.Collection:
    """The collection for new objects: the active one, or the scene's own where that one is of a library.

    Raises
    ------
    UsageError
        The scene comes from a library as well.
    """
    found = next((c for c in (context.collection, context.scene.collection) if c.is_editable), None)
    if found is None:
        raise UsageError(f'Scene "{context.scene.name}"', "comes from a library", "Choose a scene of this file")
    return found


def anchor(path: Path) -> bpy.types.Volume:
    """The Volume datablock that holds `path`; one per file. The path is relative once the .blend is saved."""
    for volume in bpy.data.volumes:
        if not volume.library and volume.filepath and _key(bpy.path.abspath(volume.filepath)) == _key(path):
            return volume
    volume = bpy.data.volumes.new(path.name)
    volume.filepath = relative(path)
    return volume


def remove_instanced_anchors() -> None:
    """Remove the Volume objects that Blender makes of anchors when it appends or links what uses them.

    It takes them for volumes that no object shows. The anchors stay.
    """
    for obj in list(bpy.data.objects):
        if obj.library is None and shows_anchor(obj):
            bpy.data.objects.remove(obj)


def shows_anchor(obj: bpy.types.Object) -> bool:
    """Whether `obj` is a Volume object of a datablock that holds the path of an asset."""
    return obj.type == "VOLUME" and obj.data is not None and obj.data.filepath.lower().endswith(".drgs")


def file_of(obj: bpy.types.Object) -> Path:
    """Path of the asset on disk; a packed one is written to the extension's folder first.

    Raises
    ------
    AssetError
        The file does not exist; names the object and the path.
    """
    volume = obj.original.drgs.asset
    if volume.packed_file:
        return _unpack(volume)
    path = _path(volume)
    if not os.path.isfile(path):  # Path.is_file raises what names that are too long and closed folders give
        raise AssetError(
            f'Object "{obj.name}"',
            f"the asset {path} does not exist",
            "Choose File > External Data > Find Missing Files, or set the path in Object Data > DR-GS",
        )
    return path


def check_unused(path: Path) -> None:
    """Refuse to write to `path` where an object is made of that file.

    Raises
    ------
    UsageError
        Names the object.
    """
    if (obj := _users().get(_key(path))) is not None:
        raise UsageError(f'Object "{obj.name}"', f"is made of {path}, which would be lost", "Choose another file name")
    if _key(path) in _coming:
        raise UsageError(str(path), "is being written already", "Wait until it is done, or choose another file name")


def unused(path: Path, frames: Iterable[int] = ()) -> Path:
    """`path`, or, where an object is made of it or will be, numbered as Blender numbers names.

    Parameters
    ----------
    path : a pattern with ``#`` where there are frames
    """
    taken, numbers = _users().keys() | _coming, list(frames)

    def files(template: Path) -> list[Path]:
        return [frame_path(str(template), number) for number in numbers] or [template]

    if taken.isdisjoint(map(_key, files(path))):
        return path
    name = path.stem.rstrip("#_-. ") or path.stem
    for number in itertools.count(1):
        other = path.with_name(f"{name}.{number:03}{path.stem[len(name) :]}{path.suffix}")
        if not any(os.path.lexists(file) or _key(file) in taken for file in files(other)):
            return other
    raise AssertionError("numbers do not end")


def chosen(path: Path, named: bool) -> Path:
    """The file to write: `path` where the artist named it, else one that is `unused`.

    Raises
    ------
    UsageError
        An object is made of the one that was named.
    """
    if not named:
        return unused(path)
    check_unused(path)
    return path


def announce(paths: Iterable[Path]) -> None:
    """Have `unused` and `check_unused` heed files that a program begins to write."""
    _coming.update(map(_key, paths))


def renounce(paths: Iterable[Path]) -> None:
    """The program has ended."""
    _coming.difference_update(map(_key, paths))


def load(path: Path) -> Asset:
    """The asset at `path`, memory-mapped and cached until the file changes."""
    stat = path.stat()
    key = (str(path), stat.st_mtime_ns, stat.st_size)
    if key not in _open:
        for stale in [k for k in _open if k[0] == key[0]]:
            del _open[stale]
        _open[key] = read_asset(path, verify=False, faults=[])  # the engine names what is damaged
    return _open[key]


def forget() -> None:
    """Close every asset."""
    _open.clear()


def captured_mesh(obj: bpy.types.Object) -> Mesh:
    """Vertices of the asset, with their channels, for those of the mesh of `obj`; new ones have those of the first.

    Raises
    ------
    AssetError
        The file is absent, or the mesh is not the asset's any more.
    """
    own = load(file_of(obj)).mesh
    if not len(own.vertices):
        problem = "has surfels but no mesh, whose vertices would be changed"
        raise AssetError(f'Object "{obj.name}"', problem, "Use Adjustments, or import it with a mesh")
    rows = mesh_arrays.source_rows(obj.data, own)
    if rows is None:
        raise AssetError(
            f'Object "{obj.name}"',
            f"its mesh has {len(obj.data.vertices)} vertices, the asset {len(own.vertices)}",
            "Undo the edit, or import the asset again",
        )
    return own if np.array_equal(rows, np.arange(len(own.vertices))) else vertices_of(own, rows.clip(0))


def _unpack(volume: bpy.types.Volume) -> Path:
    """Write a packed asset to a file named by its content, once."""
    data = volume.packed_file.data
    folder = Path(bpy.utils.extension_path_user(ROOT, path="packed", create=True))
    path = folder / f"{hashlib.sha256(data).hexdigest()}.drgs"
    if not path.is_file():
        partial = path.with_suffix(f".{os.getpid()}.part")
        partial.write_bytes(data)
        replace(partial, path)
    return path


def _path(volume: bpy.types.Volume) -> Path:
    """Where the file of a datablock lies; relative paths of a library are relative to that."""
    return Path(bpy.path.abspath(volume.filepath, library=volume.library))


def _users() -> dict[str, bpy.types.Object]:
    """An object for each file of which there are any."""
    return {_key(_path(obj.drgs.asset)): obj for obj in filter(is_drgs, bpy.data.objects)}


def _key(path: str | Path) -> str:
    """The same for every way to write the path of a file."""
    return os.path.normcase(os.path.realpath(path))
