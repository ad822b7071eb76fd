"""Objects that push each other: which are baked together, what keeps them from it, and their settings in one file."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from ...drgs_blender.core.asset.archive import replace_file
from ...drgs_blender.core.errors import DrgsError, UsageError
from .. import assets
from . import scene_export
from .settings_export import PANEL, check, folder_of, subject_of

#: Keys of `describe`.
KEYS = ("coupled", "contact", "friction")


def _simulated(obj: bpy.types.Object) -> bool:
    return assets.is_drgs(obj) and obj.drgs.physics.use and bool(obj.users_scene)


def collections_of(obj: bpy.types.Object) -> list[bpy.types.Collection]:
    """Collections whose objects it is coupled with: the one it names, and those that others name and that hold it."""
    own = obj.drgs.physics.coupling
    found = [own] if own else []
    for other in bpy.data.objects:
        named = other.drgs.physics.coupling if other.type == "MESH" else None
        if named and named not in found and _simulated(other) and named.all_objects.get(obj.name) == obj:
            found.append(named)
    return found


def members(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """Objects that are baked together with one, and that itself: in the collection's order, then those that name it.

    Raises
    ------
    UsageError
        It belongs to two collections.
    """
    found = collections_of(obj)
    if not found:
        return [obj]
    if len(found) > 1:
        names = " and ".join(f'"{collection.name}"' for collection in found[:2])
        problem = f"is coupled with two collections, {names}"
        raise UsageError(subject_of(obj), problem, f"Choose one in {PANEL} > Coupled Bodies, or take it out of one")
    together = [*found[0].all_objects, *(o for o in bpy.data.objects if o.type == "MESH" and _names(o, found[0])), obj]
    return list(dict.fromkeys(other for other in together if other == obj or _simulated(other)))


def _names(obj: bpy.types.Object, collection: bpy.types.Collection) -> bool:
    return obj.drgs.physics.coupling == collection


def idle(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """Meshes of its collections that are no bodies."""
    others = [other for collection in collections_of(obj) for other in collection.all_objects]
    return [other for other in others if other.type == "MESH" and not _simulated(other)]


def check_together(objects: list[bpy.types.Object]) -> None:
    """Refuse objects that cannot be baked together.

    Raises
    ------
    UsageError
        Naming the object and the remedy.
    """
    first = objects[0]
    frames = first.drgs.physics.frame_start, first.drgs.physics.frame_end
    for obj in objects:
        check(obj)
        members(obj)
        physics = obj.drgs.physics
        if len(objects) == 1:
            continue
        if not obj.visible_get():
            problem = "is hidden or in no collection of this view layer, and others are baked together with it"
            raise UsageError(subject_of(obj), problem, f"Show it, or take it out of {PANEL} > Coupled Bodies")
        if physics.solver != "mpm":
            problem = "has another solver than MPM, which pushes no other body"
            raise UsageError(subject_of(obj), problem, "Choose MPM, or bake it alone and make it a collider")
        if (physics.frame_start, physics.frame_end) != frames:
            problem = f'has other frames than "{first.name}", with which it is baked: {frames[0]} to {frames[1]}'
            raise UsageError(subject_of(obj), problem, f"Make them the same in {PANEL} > Domain and Cache")


def problem_of(obj: bpy.types.Object) -> str:
    """What keeps an object and those that it is coupled with from being baked; "" for nothing."""
    try:
        check_together(members(obj))
    except DrgsError as error:
        return str(error)
    return ""


def apart(objects: Iterable[bpy.types.Object]) -> list[bpy.types.Object]:
    """Those of some objects that are not baked together with a later one."""
    found: list[bpy.types.Object] = []
    for obj in objects:
        try:
            together = members(obj)
        except DrgsError:  # its own bake says it
            together = [obj]
        found = [*(other for other in found if other not in together), obj]
    return found


def count_of(obj: bpy.types.Object) -> int:
    """How many objects are baked together with one, and itself."""
    try:
        return len(members(obj))
    except DrgsError:
        return 1


def describe(obj: bpy.types.Object) -> dict[str, Any]:
    """Settings of an object that is baked with others: names of the folders of all, contact, friction; {} alone."""
    together = members(obj)
    if len(together) == 1:
        return {}
    physics = obj.drgs.physics
    return {
        "coupled": [folder_of(other).name for other in together],
        "contact": physics.contact,
        "friction": float(f"{physics.friction:.6g}"),
    }


def write_bodies(path: Path, bodies: Iterable[tuple[str, Path, Path]], device: str) -> None:
    """The settings of all bodies for the engine, of what `export_scene` wrote.

    Parameters
    ----------
    bodies : name in messages, folder of the capture and of the cache
    device : "cpu" or "cuda"
    """
    rows = []
    for name, inputs, folder in bodies:
        data = {key: value for key, value in (scene_export.stored(inputs) or {}).items() if key != "coupled"}
        if "motion" in data:
            data["motion"] = str(inputs / data["motion"])
        for collider in data.get("colliders", []):
            collider |= {key: str(inputs / collider[key]) for key in ("mesh", "vertices") if key in collider}
        rows.append({"name": name, "asset": str(inputs / scene_export.BODY), "out": str(folder)} | data)
    text = json.dumps({"device": device, "bodies": rows}, indent=1)
    replace_file(path, [text.encode()])
