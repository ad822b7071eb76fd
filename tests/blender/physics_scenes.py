"""Simulated objects and what there is of them, for several test files."""

from __future__ import annotations

import re
import time

import bpy
import numpy as np
from scenes import mesh_object, part

bake_job, bake_time, cache_state, settings_export, scene_export = (
    part(f"addon.physics.{name}")
    for name in ("bake_job", "bake_time", "cache_state", "settings_export", "scene_export")
)
particle_cache = part("drgs_blender.core.particle_cache")
FRAMES = 6
#: Seconds after which something hangs, also where kernels are compiled and the machine has other work.
PATIENCE = 1800


def vertices(obj, frame, between=0.0):
    """(n, 3) evaluated vertices, object space."""
    bpy.context.scene.frame_set(frame, subframe=between)
    return part("addon.mesh_arrays").read_vertices(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data)


def world(obj, frame):
    """(n, 3) evaluated vertices, world."""
    local = vertices(obj, frame)
    matrix = np.array(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world)
    return local @ matrix[:3, :3].T + matrix[:3, 3]


def cache_of(obj):
    return particle_cache.ParticleCache(settings_export.folder_of(obj))


def begin_of(bake, count):
    """A bake of which so many frames can be played."""
    until = time.monotonic() + PATIENCE
    while bake.count < count:
        assert not bake.step(0.05) and time.monotonic() < until
        time.sleep(0.01)
    return bake


def computed_last(obj) -> int:
    """Frames that the last bake did not find in the cache."""
    reported = (settings_export.folder_of(obj) / bake_job.INPUT / scene_export.STDOUT).read_text()
    return int(re.search(r"(\d+) of them computed now", reported)[1])


def box_object(name, low, high):
    """A box, world."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh_object(name, np.add(low, corners * np.subtract(high, low)), faces)
