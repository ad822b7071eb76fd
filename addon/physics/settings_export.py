"""Simulation settings as JSON for the engine (docs/simulation.md), and the cache folder of an object."""

from __future__ import annotations

import json
import math
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.asset.archive import replace_file
from ...drgs_blender.core.errors import UsageError
from ...drgs_blender.core.particle_cache import ParticleCache
from ...drgs_blender.core.sim_materials import MATERIALS
from .. import cache_playback
from ..physics_materials import ANGLES, numbers_of
from ..physics_settings import DrgsPhysicsSettings

#: Where to look for the settings, in messages.
PANEL = "Physics > DR-GS Physics"
#: Where a capture lies inside the cache.
INPUT = "drgs_input"
#: Where caches lie that the artist has chosen no folder for, in a folder of each .blend.
_CACHES = "//drgs_cache"
#: Whose frames a cache has, beside the capture.
OWNER = "owner.json"


class Removed(UsageError):
    """The object was removed while it was simulated."""


def subject_of(obj: bpy.types.Object) -> str:
    """Name of an object in messages."""
    return f'Object "{obj.name}"'


def folder_of(obj: bpy.types.Object) -> Path:
    """The cache of an object.

    Raises
    ------
    UsageError
        Its path is relative to a .blend that was never saved.
    """
    path = _path_of(obj)
    if path.startswith("//") and not bpy.data.filepath:
        raise UsageError(
            subject_of(obj),
            "its cache lies beside the .blend, which is not saved",
            f"Save the file, or choose a folder in {PANEL} > Domain and Cache",
        )
    return Path(os.path.normpath(bpy.path.abspath(path, library=obj.library)))


def _path_of(obj: bpy.types.Object) -> str:
    """The cache of an object as the artist wrote it, or the one that it has by itself, also after it was renamed."""
    written = obj.drgs.physics.folder.rstrip("/\\")
    return written or _played_alone(obj) or f"{_own_caches(obj)}/{bpy.path.clean_name(obj.name)}"


def _own_caches(obj: bpy.types.Object) -> str:
    """The folder in `_CACHES` that is the .blend's alone: another in its folder, also a copy of it, has another."""
    return f"{_CACHES}/{Path(obj.library.filepath if obj.library else bpy.data.filepath).name.removesuffix('.blend')}"


def _played_alone(obj: bpy.types.Object) -> str:
    """The cache with a name of its own making that this object plays and no other, which a duplicate would; "" else."""
    played = _played(obj)
    others = (other for other in bpy.data.objects if other != obj and other.library == obj.library)
    return "" if played and any(_played(other) == played for other in others) else played


def _played(obj: bpy.types.Object) -> str:
    """The cache in `_own_caches` that an object plays, "" for none."""
    modifier = cache_playback.modifier_of(obj) if obj.type == "MESH" and obj.users_scene else None
    folder, _, file = modifier.filepath.replace("\\", "/").rpartition("/") if modifier is not None else ("", "", "")
    return folder if file == cache_playback.FILE and folder.startswith(f"{_own_caches(obj)}/") else ""


def played_elsewhere(obj: bpy.types.Object) -> Path | None:
    """The folder whose frames an object plays where that is not its cache, as in a copy of a .blend."""
    modifier = cache_playback.modifier_of(obj)
    played = cache_playback.path_of(obj, modifier).parent if modifier is not None else None
    return None if played is None or _same_folder(obj, played) else played


def owner_of(folder: Path) -> str:
    """Another .blend that is still there, and its object, whose frames a cache has, in words; "" for none.

    Parameters
    ----------
    folder : of the cache
    """
    try:
        owner = json.loads((folder / INPUT / OWNER).read_text(encoding="utf-8"))
        name, blend = owner["object"], Path(os.path.normpath(folder / owner["blend"]))
    except (OSError, ValueError, TypeError, KeyError):
        return ""
    own = bpy.data.filepath
    if not blend.is_file() or (own and os.path.exists(own) and os.path.samefile(own, blend)):
        return ""
    return f'"{name}" of {blend}' if ParticleCache(folder).frames() else ""


def claim(folder: Path, name: str) -> None:
    """Record that a cache has the frames of an object of this .blend.

    Raises
    ------
    WriteError
        Naming file and reason.
    """
    if bpy.data.filepath:
        blend = bpy.data.filepath
        with suppress(ValueError):  # on another drive of Windows
            blend = os.path.relpath(blend, folder)
        replace_file(folder / INPUT / OWNER, [json.dumps({"object": name, "blend": blend}).encode()])


def adopt(obj: bpy.types.Object, own: Path) -> None:
    """Have an empty cache begin with the frames that its object plays elsewhere, so that a bake may go on from them.

    They are linked, which takes neither time nor space; a bake that starts over removes the links. Where the drive has
    no links, it starts over.
    """
    played = played_elsewhere(obj)
    if played is None or ParticleCache(own).header() is not None or ParticleCache(played).header() is None:
        return
    with suppress(OSError):
        own.mkdir(parents=True, exist_ok=True)
        for path in ParticleCache(played).files():
            (own / path.name).unlink(missing_ok=True)
            os.link(path, own / path.name)


def check(obj: bpy.types.Object) -> None:
    """Refuse what cannot be simulated.

    Raises
    ------
    UsageError
        Naming object and remedy.
    """
    physics = obj.drgs.physics
    if obj.library or (obj.override_library and obj.override_library.is_system_override):
        raise UsageError(subject_of(obj), "is linked from another file", "Make it local, or bake it there")
    if obj.mode == "EDIT":
        raise UsageError(subject_of(obj), "is being edited", "Leave Edit Mode")
    if physics.frame_end <= physics.frame_start:
        raise UsageError(
            subject_of(obj),
            f"ends at frame {physics.frame_end}, not after its first, {physics.frame_start}",
            f"Change the frames in {PANEL} > Domain and Cache",
        )


def exclusive_folder(obj: bpy.types.Object) -> Path:
    """The cache of an object, which no other object of any scene, or of another .blend, may have.

    Raises
    ------
    UsageError
        Naming both, or what `folder_of` says.
    """
    own = folder_of(obj)
    for other in bpy.data.objects:
        if other != obj and _has_physics(other) and _same_folder(other, own):
            raise UsageError(
                subject_of(obj),
                f'has the same cache as "{other.name}", {own}',
                f"Choose another in {PANEL} > Domain and Cache",
            )
    if owner := owner_of(own):
        raise UsageError(
            subject_of(obj),
            f"would replace the frames of {owner}, in {own}",
            f"Choose another folder in {PANEL} > Domain and Cache, or delete that bake there",
        )
    return own


def _has_physics(obj: bpy.types.Object) -> bool:
    return obj.type == "MESH" and obj.drgs.physics.use and not obj.library and bool(obj.users_scene)


def _same_folder(obj: bpy.types.Object, folder: Path) -> bool:
    with suppress(UsageError):  # it has no place yet
        return os.path.normcase(os.path.realpath(folder_of(obj))) == os.path.normcase(os.path.realpath(folder))
    return False


def describe(obj: bpy.types.Object, scene: bpy.types.Scene) -> dict[str, Any]:
    """Settings for the engine but for what is captured from the scene: meshes, matrices and motion.

    Values are those of the current frame.
    """
    physics = obj.drgs.physics
    wind = _numbers(physics.wind)
    data: dict[str, Any] = {
        "material": _material(physics),
        "regions": [{"group": region.group, "material": _material(region)} for region in physics.regions],
        "solver": physics.solver,
        "resolution": physics.resolution,
        "seed": physics.seed,
        "gravity": _numbers(physics.gravity * g for g in scene.gravity) if scene.use_gravity else [0.0] * 3,
        "wind": wind,
        "drag": _number(physics.drag) if any(wind) else 0.0,
        "damping": _number(physics.damping),
        "velocity": _numbers(physics.velocity),
        "spin": _numbers(physics.spin),
        "pins": [{"group": physics.pin_group}] if physics.pin_group else [],
        "walls": physics.walls,
        "first": physics.frame_start,
        "last": physics.frame_end,
        "fps": scene.render.fps / _number(scene.render.fps_base),
    }
    if physics.use_floor:
        data["floor"] = _number(physics.floor)
        data["floor_contact"] = physics.floor_contact
        data["floor_friction"] = _number(physics.floor_friction)
    if physics.domain is not None:
        corners = np.array(physics.domain.bound_box, np.float64)
        matrix = np.array(physics.domain.matrix_world, np.float64)
        world = corners @ matrix[:3, :3].T + matrix[:3, 3]
        low, high = world.min(axis=0), world.max(axis=0)
        if (high - low).min() <= 0:
            raise UsageError(
                f'Object "{physics.domain.name}"', "has no volume, so it is no domain", "Choose a box, or none"
            )
        data["domain"] = [_numbers(low), _numbers(high)]
    return data


def _material(physics: DrgsPhysicsSettings) -> dict[str, Any]:
    """The row of the table, and the numbers that differ from it."""
    row = MATERIALS[physics.material]
    found: dict[str, Any] = {"name": physics.material}
    for name in numbers_of(physics.material):
        value = _number(math.degrees(getattr(physics, name)) if name in ANGLES else getattr(physics, name))
        if value != _number(getattr(row, name)):
            found[name] = value
    return found


def _number(value: float) -> float:
    """What the artist wrote: Blender keeps six or seven digits of it."""
    return float(f"{value:.6g}")


def _numbers(values: Any) -> list[float]:
    return [_number(value) for value in values]
