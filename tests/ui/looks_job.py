"""Runs inside Blender with a window, for test_looks.py: what viewports show, in every shading and while time runs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))

import hands
from bpy_extras.view3d_utils import location_3d_to_region_2d
from hands import found, key, move, part, settled, where
from mathutils import Vector

#: Cubes before and behind the object's head, seen from the front.
CUBES = {"front": (-0.5, -4.0, 1.1), "behind": (0.5, 4.0, 1.1)}


def subject() -> bpy.types.Object:
    return next(o for o in bpy.context.scene.objects if part("addon.assets").is_drgs(o))


def place_of(point: tuple[float, float, float]) -> list[int]:
    """Where a point is in the window's picture, y downwards."""
    window, area, r = where()
    seen = location_3d_to_region_2d(r, area.spaces.active.region_3d, Vector(point))
    return [round(r.x + seen.x), round(window.height - r.y - seen.y)]


def blue() -> bpy.types.Material:
    """A material that shines blue, in every shading."""
    material = bpy.data.materials.new("Blue")
    material.diffuse_color = (0, 0, 1, 1)
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    emission, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value = (0, 0, 1, 1)
    material.node_tree.links.new(emission.outputs[0], output.inputs[0])
    return material


def build() -> Iterator[float]:
    with hands.context_of():
        for obj in list(bpy.data.objects):
            bpy.data.objects.remove(obj)
        bpy.ops.import_scene.drgs(filepath=hands.ASSET)
        lights = {s.name: s.path for s in bpy.context.preferences.studio_lights if s.type == "WORLD"}
        bpy.ops.drgs.choose_light(filepath=lights["city.exr"])
        material = blue()
        for name, place in CUBES.items():
            bpy.ops.mesh.primitive_cube_add(size=0.4, location=place)
            bpy.context.object.name = name
            bpy.context.object.data.materials.append(material)
        bpy.ops.object.select_all(action="DESELECT")
    space = where()[1].spaces.active
    space.overlay.show_overlays, space.show_gizmo = False, False
    space.shading.use_scene_world = True
    yield from move(hands.middle())
    yield from key("NUMPAD_1")
    yield 1.0
    space.region_3d.view_location, space.region_3d.view_distance = (0, 0, 0), 8
    yield 0.5
    window, _, r = where()
    found["viewport"] = [r.x, window.height - r.y - r.height + 120, r.x + r.width, window.height - r.y]


def work() -> Iterator[float]:
    yield from build()
    found["places"] = {name: place_of(place) for name, place in CUBES.items()}
    yield from overlays()
    yield from region()
    yield from camera()
    yield from time_runs()
    found["messages"] = [m.text for m in part("addon.messages").history if m.level == "ERROR"]


def overlays() -> Iterator[float]:
    """The relit object among Blender's own, in each of its shadings."""
    scene, shading = bpy.context.scene, where()[1].spaces.active.shading
    scene.render.engine = next(e for e in ("BLENDER_EEVEE", "BLENDER_EEVEE_NEXT") if has_engine(e))
    overlay = where()[1].spaces.active.overlay
    for kind in ("SOLID", "MATERIAL", "RENDERED"):
        scene.drgs.overlay = "OFF"
        shading.type = kind
        yield from blue_is_seen()  # Blender compiles its own shaders, and shows nothing meanwhile
        scene.drgs.overlay = "LIT"
        for clean in (False, True):
            overlay.show_overlays = not clean
            yield from settled()
            yield from hands.photograph(f"looks-1-{kind.lower()}{'-clean' * clean}")
    scene.drgs.overlay = "OFF"
    scene.render.engine = "DRGS"
    yield from settled()
    yield from hands.photograph("looks-2-rendered")


def blue_is_seen() -> Iterator[float]:
    """Until Blender draws the cube in front."""
    for _ in range(hands.PATIENCE // 5):
        yield from hands.photograph("looks-waiting")
        red, _, colour = hands.colour_in("looks-waiting", place_of(CUBES["front"]))
        if colour > red + 0.2:
            return
        yield 4.0
    raise TimeoutError("Blender does not draw a blue cube")


def has_engine(name: str) -> bool:
    try:
        bpy.context.scene.render.engine = name
    except TypeError:
        return False
    return True


def region() -> Iterator[float]:
    """A part of the view, drawn with Ctrl+B."""
    window = where()[0]
    x, y = hands.middle()
    yield from move((x, y))
    yield from key("B", ctrl=True)
    yield from hands.drag((x - 150, y - 150), (x, y + 150))
    yield from settled()
    found["border"] = where()[1].spaces.active.use_render_border
    found["line"] = x, window.height - y
    yield from hands.photograph("looks-3-region")
    yield from key("B", ctrl=True, alt=True)
    yield from settled()
    yield from hands.photograph("looks-4-whole")


def camera() -> Iterator[float]:
    """Through the camera that the step adds where the view stands."""
    with hands.context_of():
        bpy.ops.drgs.add_camera()
    yield from move(hands.middle())
    if where()[1].spaces.active.region_3d.view_perspective != "CAMERA":
        yield from key("NUMPAD_0")
    yield from settled()
    found["perspective"] = where()[1].spaces.active.region_3d.view_perspective
    found["head"] = place_of((0, -1, 1.2))  # between its bands
    yield from hands.photograph("looks-5-camera")


def time_runs() -> Iterator[float]:
    """Played, stopped, and back at the first frame."""
    scene, obj = bpy.context.scene, subject()
    for frame, x in ((1, 0.0), (20, 1.5)):
        obj.location.x = x
        obj.keyframe_insert("location", frame=frame)
    scene.frame_end = 20
    scene.frame_set(1)
    yield from settled()
    yield from hands.photograph("looks-6-first")
    views = part("addon.viewport.views")
    yield from move(hands.middle())
    yield from key("SPACE")
    views.redraws.clear()
    frames = set()
    for _ in range(40):
        frames.add(scene.frame_current)
        yield 0.1
    found["frames"], found["redraws"] = len(frames), len(views.redraws)
    yield from hands.photograph("looks-7-playing")
    yield from key("SPACE")
    scene.frame_set(20)
    yield from settled()
    yield from hands.photograph("looks-8-last")
    scene.frame_set(1)
    yield from settled()
    yield from hands.photograph("looks-9-first-again")


hands.run(work())
