"""Runs inside Blender with a window, for window_pictures.py: what the guide has pictures of."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples"))
sys.path.insert(0, str(Path(__file__).parent))

import hands
from blender_scenes import add_material, import_drgs, stand
from hands import found, move, photograph, settled, where

CAPTURED = Path(__file__).resolve().parents[2] / "examples" / "captured"
found["boxes"] = {}


def boxed(name: str, *regions: tuple[str, str]) -> Iterator[float]:
    """A photograph, and what of it is to be kept: all, or the regions of editors."""
    boxes = []
    for kind, region in regions:
        window, _, r = where(kind, region)
        boxes.append([r.x, window.height - r.y - r.height, r.x + r.width, window.height - r.y])
    found["boxes"][name] = boxes and [f(side) for f, side in zip((min, min, max, max), zip(*boxes))]
    yield from photograph(name)


def work() -> Iterator[float]:
    with hands.context_of():
        for obj in list(bpy.data.objects):
            bpy.data.objects.remove(obj)
        bpy.ops.mesh.primitive_plane_add(size=14)
        bpy.context.object.data.materials.append(add_material("Ground", (0.5, 0.47, 0.43), roughness=0.6))
        for name, height, x, turn in (("robot", 1.5, 0.0, 8), ("cat", 1.0, 1.25, -25), ("spot", 0.85, -1.25, -35)):
            stand(import_drgs(CAPTURED / f"{name}.drgs"), height, Vector((x, 0, 0)), math.radians(turn))
        cow = bpy.context.view_layer.objects.active
        lights = {s.name: s.path for s in bpy.context.preferences.studio_lights if s.type == "WORLD"}
        bpy.ops.drgs.choose_light(filepath=lights["courtyard.exr"])
    space = where()[1].spaces.active
    space.overlay.show_floor, space.overlay.show_axis_x, space.overlay.show_axis_y = False, False, False
    space.region_3d.view_perspective = "PERSP"
    space.lens = 60
    view = space.region_3d
    view.view_rotation = Vector((0.12, -1.0, 0.24)).to_track_quat("Z", "Y")
    view.view_location, view.view_distance = (0.05, 0, 0.62), 6.2
    yield from hands.show_tab()
    yield 1.0
    yield from boxed("guide-sidebar", ("VIEW_3D", "UI"))
    with hands.context_of():
        bpy.ops.drgs.show_rendered()
    yield from settled()
    yield from boxed("guide-window")
    cow.drgs.physics.use = True
    yield from hands.key("N")
    with hands.context_of():
        bpy.ops.screen.area_split(direction="VERTICAL", factor=0.38)
    yield 1.0
    wide = max(
        (a for a in bpy.context.window_manager.windows[0].screen.areas if a.type == "VIEW_3D"), key=lambda a: -a.x
    )
    wide.type = "PROPERTIES"
    yield 0.5
    for name, context in (("guide-physics", "PHYSICS"), ("guide-render", "RENDER")):
        wide.spaces.active.context = context
        yield from move((5, 5))  # where no tooltip covers it
        yield 1.0
        r = next(r for r in wide.regions if r.type == "WINDOW")
        height = bpy.context.window_manager.windows[0].height
        found["boxes"][name] = [r.x, height - r.y - r.height, r.x + r.width, height - r.y]
        yield from photograph(name)


hands.run(work())
