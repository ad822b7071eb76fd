"""A video as of a phone, for want of one: Cycles walks around a cow on a patterned floor. For Blender's Python.

    blender -b --python examples/phone_video.py -- walk.mp4
    .venv-blender/bin/python examples/phone_video.py walk.mp4

Once around and up, 36 frames of 320 x 240 pixels, a minute or two on two cores. Nothing is known of the
cameras afterwards.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

EXAMPLES = Path(__file__).resolve().parent
sys.path.insert(0, str(EXAMPLES))
from blender_scenes import add_world, environment  # noqa: E402

FRAMES, SIZE, SAMPLES = 36, (320, 240), 12
#: Metres: the cow, the floor, how far the phone is away.
HEIGHT, FLOOR, DISTANCE = 0.2, 3.0, 0.62
#: Degrees above the floor, at the beginning and at the end.
LOW, HIGH = 32.0, 58.0


def add_material(name: str, image: bpy.types.Image, roughness: float) -> None:
    """Give the active object a picture by its UV map."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    shader.inputs["Roughness"].default_value = roughness
    mesh = bpy.context.object.data
    mesh.materials.clear()
    mesh.materials.append(material)


def add_floor() -> None:
    """A floor whose picture is noise of many scales, which looks alike nowhere."""
    random, side = np.random.default_rng(1), 960
    colour = np.full((side, side, 3), 0.4)
    for cells in (30, 60, 120, 240, 480):
        colour += 0.5 * (random.random((cells, cells, 3)).repeat(side // cells, 0).repeat(side // cells, 1) - 0.5)
    image = bpy.data.images.new("floor", side, side)
    pixels = np.dstack([np.clip(colour, 0.02, 0.98), np.ones((side, side, 1))])
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    bpy.ops.mesh.primitive_plane_add(size=FLOOR)
    add_material("floor", image, 0.6)


def add_cow() -> None:
    """Spot the cow, `HEIGHT` high, her feet on the floor."""
    bpy.ops.wm.obj_import(filepath=str(EXAMPLES / "spot" / "spot_triangulated.obj"))
    cow = bpy.context.object
    bpy.ops.object.transform_apply()
    corners = np.array(cow.bound_box)
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = HEIGHT / (high[2] - low[2])
    cow.scale, cow.location = (scale,) * 3, -scale * np.array([*(low + high)[:2] / 2, low[2]])
    add_material("cow", bpy.data.images.load(str(EXAMPLES / "spot" / "spot_texture.png")), 0.4)


def add_light() -> None:
    """One of Blender's own skies."""
    world = add_world()
    texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = environment("forest.exr")
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    world.node_tree.links.new(texture.outputs["Color"], background.inputs["Color"])


def add_walk(scene: bpy.types.Scene) -> None:
    """A camera that goes around once and up, held by hand."""
    random = np.random.default_rng(2)
    camera = scene.camera = bpy.data.objects.new("phone", bpy.data.cameras.new("phone"))
    scene.collection.objects.link(camera)
    for frame in range(FRAMES):
        part = frame / FRAMES
        around, above = 2 * math.pi * part, math.radians(LOW + (HIGH - LOW) * part)
        away = np.array([math.cos(around) * math.cos(above), math.sin(around) * math.cos(above), math.sin(above)])
        camera.location = DISTANCE * away + 0.004 * random.standard_normal(3)
        target = Vector((0, 0, 0.45 * HEIGHT)) + Vector(0.004 * random.standard_normal(3))
        camera.rotation_euler = (target - camera.location).to_track_quat("-Z", "Y").to_euler()
        for channel in ("location", "rotation_euler"):
            camera.keyframe_insert(channel, frame=frame + 1)


def main() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    add_floor()
    add_cow()
    add_light()
    add_walk(scene)
    scene.frame_start, scene.frame_end = 1, FRAMES
    render = scene.render
    render.engine, render.fps = "CYCLES", 30
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = SAMPLES, False, 2
    scene.cycles.use_animated_seed = render.use_persistent_data = True
    render.resolution_x, render.resolution_y = SIZE
    scene.view_settings.view_transform = "Standard"
    if bpy.app.version >= (5, 0, 0):
        render.image_settings.media_type = "VIDEO"
    render.image_settings.file_format = "FFMPEG"
    render.ffmpeg.format, render.ffmpeg.codec, render.ffmpeg.constant_rate_factor = "MPEG4", "H264", "HIGH"
    render.use_file_extension, render.filepath = False, str(Path(sys.argv[-1]).resolve())
    bpy.ops.render.render(animation=True)


if __name__ == "__main__":
    main()
