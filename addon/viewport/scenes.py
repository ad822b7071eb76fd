"""The scene of every viewport as a Frame, exported again when it changes, and then only what changed."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ...drgs_blender.core.errors import DrgsError
from ...drgs_blender.core.frame import Frame
from ...drgs_blender.ipc.change_detection import reuse_equal
from .. import bakes, messages
from ..bakes.requests import Wanted
from ..export import export_frame
from ..export.camera import NO_CAMERA
from ..export.export_cache import ExportCache
from ..export.instances import Keys

#: Numbers of changes, no two of them the same.
_versions: Iterator[int] = itertools.count(1)
#: Scene, view layer, and the local view of a viewport ("" for none).
Key = tuple[str, str, str]


@dataclass(slots=True)
class Exported:
    """A scene as it was exported last.

    Attributes
    ----------
    frame : without a camera of its own; None where it cannot be rendered
    assets : of its objects, see `worker.Request`
    error : why there is no frame
    """

    frame: Frame | None = None
    assets: tuple[tuple[str, tuple[int, int]], ...] = ()
    error: str = ""


@dataclass(frozen=True, slots=True)
class Parts:
    """Which instances an exported frame is made of, and the number of the scene's last change.

    Both may be others without another frame.
    """

    keys: Keys
    version: int


@dataclass(slots=True)
class _Scene:
    cache: ExportCache = field(default_factory=ExportCache)
    exported: Exported | None = None
    version: int = field(default_factory=lambda: next(_versions))
    current: bool = False


_scenes: dict[Key, _Scene] = {}


def exported(
    depsgraph: bpy.types.Depsgraph, local: str = "", is_visible: Callable[[bpy.types.Object], bool] | None = None
) -> Exported:
    """The scene of an evaluated viewport `depsgraph`; the same object for as long as nothing changes.

    Parameters
    ----------
    local : name of the local view that `is_visible` is of
    """
    key = depsgraph.scene.name_full, depsgraph.view_layer.name, local
    scene = _scenes.setdefault(key, _Scene())
    if not scene.current or scene.exported is None:
        made = _export(depsgraph, scene.cache, is_visible, key)
        scene.exported, scene.current = reuse_equal(made, scene.exported), True
    return scene.exported


def parts(depsgraph: bpy.types.Depsgraph, local: str = "") -> Parts:
    """Of what the frame consists that `exported` gave last."""
    scene = _scenes.setdefault((depsgraph.scene.name_full, depsgraph.view_layer.name, local), _Scene())
    return Parts(scene.cache.keys, scene.version)


def _export(
    depsgraph: bpy.types.Depsgraph,
    cache: ExportCache,
    is_visible: Callable[[bpy.types.Object], bool] | None,
    key: Key = ("", "", ""),
) -> Exported:
    wanted = Wanted.of(depsgraph.scene)
    assets: dict[str, tuple[int, int]] = {}
    texts: list[str] = []

    def key_of(path: Path) -> str:
        return os.path.realpath(path)  # as the engine makes it; it is asked later, by the worker

    try:
        frame = export_frame(
            depsgraph,
            key_of,
            texts.append,
            camera=NO_CAMERA,
            cache=cache,
            is_visible=is_visible,
            wanted=wanted,
        )
    except DrgsError as error:
        bakes.manager.drop(key)
        messages.note("ERROR", str(error))
        return Exported(error=str(error))
    messages.own(("viewport", *key), dict.fromkeys(texts))
    bakes.manager.want(key, wanted.requests)
    for state in frame.objects:
        status = os.stat(state.asset)
        assets[state.asset] = status.st_mtime_ns, status.st_size
    return Exported(frame, tuple(assets.items()))


def changed(depsgraph: bpy.types.Depsgraph) -> None:
    """Take note of what the depsgraph of a viewport was updated for."""
    names = depsgraph.scene.name_full, depsgraph.view_layer.name
    for key, scene in _scenes.items():
        if key[:2] == names:
            scene.cache.note(depsgraph)
            scene.current, scene.version = False, next(_versions)


def renew() -> None:
    """Something was baked: export what is shaded by it again."""
    for scene in _scenes.values():
        scene.cache.forget_shading()
        scene.current = False


def forget() -> None:
    """Drop all exported scenes."""
    for key in _scenes:
        bakes.manager.drop(key)
        messages.own(("viewport", *key), ())
    _scenes.clear()
