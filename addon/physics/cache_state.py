"""What there is on disk of an object's bake, and its end."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass

import bpy

from ...drgs_blender.core.particle_cache import ParticleCache
from .. import cache_playback
from . import coupling, scene_export
from .settings_export import INPUT, describe, folder_of, owner_of, played_elsewhere, subject_of
from .simulate_process import ending


@dataclass(frozen=True, slots=True)
class Cached:
    """Content of an object's particle cache.

    Attributes
    ----------
    frames : how many, from the first on
    expected : frames that a bake makes
    changed : settings are not those of the frames, so that a bake starts over
    missing : names of objects that have no frames where those that they are baked with have some
    """

    frames: int
    expected: int
    changed: bool
    missing: tuple[str, ...] = ()


def cached(obj: bpy.types.Object, scene: bpy.types.Scene) -> Cached:
    """Content of the caches of an object and those that it is baked with: frames, expected frames, changed settings.

    Raises
    ------
    DrgsError
        A folder is unknown or cannot be read.
    """
    together = coupling.members(obj)
    counts = [len(ParticleCache(folder_of(other)).frames()) for other in together]
    changed = any(_changed(other, scene) for other, count in zip(together, counts) if count)
    missing = tuple(other.name for other, count in zip(together, counts) if not count) if any(counts) else ()
    physics = obj.drgs.physics
    return Cached(min(counts), physics.frame_end - physics.frame_start + 1, changed, missing)


def _changed(obj: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether its settings are not those of its frames."""
    known = scene_export.stored(folder_of(obj) / INPUT)
    # Values that are animated are those of the first frame, so that only there a change of them shows.
    if known is None or not (obj.animation_data is None or scene.frame_current == obj.drgs.physics.frame_start):
        return False
    now = describe(obj, scene) | coupling.describe(obj)
    before = [{k: v for k, v in row.items() if k not in ("mesh", "vertices")} for row in known.get("colliders", [])]
    keys = {*now, "floor", "domain", *coupling.KEYS} - {"last"}
    contacts = scene_export.contacts(obj, coupling.members(obj))
    return before != contacts or any(known.get(key) != now.get(key) for key in keys)


def free(obj: bpy.types.Object) -> list[str]:
    """Remove all files of the caches of an object and those that it is baked with, and what plays them.

    Returns
    -------
    list of str
        What stays, since it is not theirs, in words.

    Raises
    ------
    DrgsError
        Naming the file that stays, or why a folder is unknown.
    """
    together = coupling.members(obj)
    while ending():
        time.sleep(0.02)
    told = []
    for other in together:
        folder = folder_of(other)
        kept, owner = played_elsewhere(other), owner_of(folder)
        cache_playback.detach(other)
        if kept is not None and kept.is_dir():
            told.append(f"{subject_of(other)}: the frames in {kept} stay; they may be another file's")
        if owner:
            told.append(f"{subject_of(other)}: the frames in {folder} stay; they are those of {owner}")
            continue
        ParticleCache(folder).clear()
        scene_export.clear(folder / INPUT)
        with suppress(OSError):
            (folder / cache_playback.FILE).unlink(missing_ok=True)
            (os.rmdir if other.drgs.physics.folder else os.removedirs)(folder)
    return told
