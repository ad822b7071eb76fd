"""Runs inside Blender with a window, for test_physics.py: two objects are baked by a click, stopped by Esc, undone."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))

import hands
from hands import found, key, part, photograph, press, until

FRAMES = 5
PANEL = ("PROPERTIES", "WINDOW")


def frames() -> list[int]:
    """How many frames there are of each object."""
    cache = part("drgs_blender.core.particle_cache").ParticleCache
    folder_of = part("addon.physics.settings_export").folder_of
    return [len(cache(folder_of(obj)).frames()) for obj in subjects()]


def subjects() -> list[bpy.types.Object]:
    return sorted((obj for obj in bpy.data.objects if obj.drgs.is_drgs), key=lambda obj: obj.name)


def at_work() -> tuple[int, int]:
    """How many bakes run, and how many wait."""
    bake_job = part("addon.physics.bake_job")
    return len(bake_job.running), len(bake_job.waiting)


def steps() -> Iterator[float]:
    scene = bpy.context.scene
    for obj in list(scene.objects):
        bpy.data.objects.remove(obj)
    scene.frame_start, scene.frame_end = 1, FRAMES
    bpy.ops.wm.save_as_mainfile(filepath=str(hands.FOLDER / "physics.blend"))
    bpy.ops.import_scene.drgs(filepath=hands.ASSET)
    first = bpy.context.active_object
    second = first.copy()
    scene.collection.objects.link(second)
    second.location.x = 4
    second.select_set(True)
    for obj in (first, second):
        obj.drgs.physics.use = True
        obj.drgs.physics.resolution, obj.drgs.physics.youngs_modulus = 12, 2e4
        # It turns where it is: what falls leaves its domain one day, and then the next bake begins.
        obj.drgs.physics.gravity, obj.drgs.physics.spin = 0.0, (0, 0, 1)
    found["range"] = [obj.drgs.physics.frame_end for obj in subjects()]
    yield 1.0
    _, area, _ = hands.where("PROPERTIES")
    area.spaces.active.context = "PHYSICS"
    with hands.context_of("PROPERTIES"):
        bpy.ops.screen.screen_full_area()
    yield 1.0
    yield from press("drgs.bake_physics", *PANEL)
    yield from until(lambda: at_work() == (1, 1), "the first bake", 60)
    yield from photograph("physics-1-baking")
    yield from until(lambda: at_work() == (0, 0), "the end of the bakes")
    found["baked"] = frames()
    yield from photograph("physics-2-baked")
    for obj in subjects():
        obj.drgs.physics.frame_end = 100_000
    yield 0.5
    yield from press("drgs.bake_physics", *PANEL)
    yield from until(lambda: max(frames()) > FRAMES, "the bake that goes on")
    yield from photograph("physics-3-going-on")
    yield from key("ESC")
    yield from until(lambda: at_work() == (0, 0), "the end of the bake that goes on", 60)
    found["stopped"] = frames()
    yield from photograph("physics-4-stopped")
    with hands.context_of("PROPERTIES"):
        bpy.ops.screen.back_to_previous()
    yield 1.0
    scene.frame_set(FRAMES)
    yield from photograph("physics-5-played")
    found["modifiers"] = [[m.type for m in obj.modifiers] for obj in subjects()]
    found["messages"] = [m.text for m in part("addon.messages").history]
    yield from undone()


def undone() -> Iterator[float]:
    """Undo while a bake goes on, until what is baked was never there, then redo."""
    part("addon.messages").clear()
    bpy.context.view_layer.objects.active.location.y = 1
    bpy.ops.ed.undo_push(message="Move")
    yield from hands.move(hands.middle())
    with hands.context_of():
        bpy.ops.drgs.bake_physics("INVOKE_DEFAULT")
    yield from until(lambda: at_work()[0] == 1, "the bake that is undone", 60)
    undos = 0
    while subjects():
        yield from key("Z", ctrl=True)
        undos += 1
    yield from until(lambda: at_work() == (0, 0), "the end of the bake without an object", 60)
    yield from photograph("physics-6-undone")
    for _ in range(undos):
        yield from key("Z", ctrl=True, shift=True)
    found["redone"] = [obj.location.y for obj in subjects()]
    found["undone"] = [[m.level, m.text] for m in part("addon.messages").history]


hands.run(steps())
