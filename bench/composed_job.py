"""Runs inside Blender's Python: whole scenes, rendered by Cycles and through the extension.

    .venv-blender/bin/python bench/composed_job.py JOB.json

The job names the extension's zip, a .drgs, the module with the scene in its `SCENES` (this one or another), a folder
of HDRIs, the .blend to write, size and bounces, and pictures: engine, seed, samples and the .npy they go to, (h, w, 4),
linear, row 0 on top. Where it names passes, each picture is left as the multilayer EXR file of that name instead.
"""

from __future__ import annotations

import importlib
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

sys.path.append(str(Path(__file__).resolve().parent))
from cycles_job import plain_shading

UP = (0, 0, 1)


def material(name: str, colour=(0.8, 0.8, 0.8), roughness=0.5, metallic=0.0, emission=0.0) -> bpy.types.Material:
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    inputs = made.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value = (*colour, 1)
    inputs["Roughness"].default_value, inputs["Metallic"].default_value = roughness, metallic
    inputs["Emission Color"].default_value, inputs["Emission Strength"].default_value = (1, 0.8, 0.6, 1), emission
    return made


def finish(name: str, look: bpy.types.Material | None = None, smooth: bool = False) -> bpy.types.Object:
    """Name the mesh that an operator just made, and give it a material."""
    obj = bpy.context.active_object
    obj.name = name
    obj.data.polygons.foreach_set("use_smooth", [smooth] * len(obj.data.polygons))
    if look is not None:
        obj.data.materials.append(look)
    return obj


def floor(look: bpy.types.Material, size: float = 8) -> bpy.types.Object:
    bpy.ops.mesh.primitive_plane_add(size=size)
    return finish("Floor", look)


def ball(look: bpy.types.Material, radius: float, at: tuple[float, float, float]) -> bpy.types.Object:
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=radius, location=at)
    return finish("Ball", look, smooth=True)


def cube(look: bpy.types.Material, size: float, at: tuple[float, float, float], turn: float = 0) -> bpy.types.Object:
    bpy.ops.mesh.primitive_cube_add(size=size, location=at, rotation=(0, 0, turn))
    return finish("Cube", look)


def monkey(
    name: str, tree_of: str, at: tuple[float, float, float] = (0, 0, 0.6), turn: float = 0.0
) -> bpy.types.Object:
    """Suzanne, smooth, twice subdivided, with a UV map and the material `tree_of`."""
    bpy.ops.mesh.primitive_monkey_add(size=1.1, location=at, rotation=(0, 0, turn))
    obj = bpy.context.active_object
    obj.modifiers.new("Smooth", "SUBSURF").levels = 2
    bpy.ops.object.modifier_apply(modifier="Smooth")
    return finish(name, bpy.data.materials[tree_of], smooth=True)


def subject(path: str, turn: float = 0.0) -> bpy.types.Object:
    """The DR-GS object, a metre and a half tall, on the ground at the origin."""
    bpy.ops.import_scene.drgs(filepath=path)
    obj = bpy.context.view_layer.objects.active
    corners = np.array(obj.bound_box)
    low, high = corners.min(0), corners.max(0)
    scale = 1.5 / (high[2] - low[2])
    obj.scale = (scale,) * 3
    obj.rotation_euler = (0, 0, turn)
    obj.location = (0, 0, -scale * low[2])
    return obj


def add_light(kind: str, energy: float, at: tuple, target: tuple = (0, 0, 0.7), **values: object) -> bpy.types.Object:
    light = bpy.data.lights.new(kind.title(), kind)
    light.energy = energy
    for key, value in values.items():
        setattr(light, key, value)
    obj = bpy.data.objects.new(kind.title(), light)
    obj.location = at
    obj.rotation_euler = (Vector(at) - Vector(target)).to_track_quat("Z", "Y").to_euler()
    bpy.context.collection.objects.link(obj)
    return obj


def world(colour: tuple[float, float, float] = (0, 0, 0), strength: float = 1.0, image: Path | None = None) -> None:
    made = bpy.data.worlds.new("World")
    bpy.context.scene.world = made
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    background = nodes["Background"]
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (*colour, 1), strength
    if image is not None:
        texture = nodes.new("ShaderNodeTexEnvironment")
        texture.image = bpy.data.images.load(str(image))
        links.new(texture.outputs["Color"], background.inputs["Color"])


def camera(eye: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, 0.6), lens: float = 40) -> None:
    data = bpy.data.cameras.new("Camera")
    data.lens = lens
    obj = bpy.data.objects.new("Camera", data)
    obj.location = eye
    obj.rotation_euler = (Vector(eye) - Vector(target)).to_track_quat("Z", "Y").to_euler()
    bpy.context.collection.objects.link(obj)
    bpy.context.scene.camera = obj


def painted() -> bpy.types.Material:
    """A floor of coloured tiles, whose roughness is in an image as well."""
    look = material("Tiles")
    nodes, links = look.node_tree.nodes, look.node_tree.links
    principled = nodes["Principled BSDF"]
    rng = np.random.default_rng(5)
    for socket, space in (("Base Color", "sRGB"), ("Roughness", "Non-Color")):
        image = bpy.data.images.new(socket, 64, 64)
        image.colorspace_settings.name = space
        values = np.ones((64, 64, 4), np.float32)
        tiles = rng.uniform(0.25, 0.95, (8, 8, 3))
        values[..., :3] = np.kron(tiles, np.ones((8, 8, 1)))
        image.pixels.foreach_set(values.ravel())
        image.update()
        image.pack()
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = image
        links.new(texture.outputs["Color"], principled.inputs[socket])
    return look


def outdoors(job: dict) -> None:
    """A DR-GS object on a textured floor; sun with an angle, and an HDRI."""
    subject(job["asset"], 0.6)
    floor(painted())
    add_light("SUN", 1.5, (3, -2, 4), angle=math.radians(4))
    world(strength=0.3, image=Path(job["hdris"]) / "city.exr")
    camera((2.2, -3.2, 1.8))


def studio(job: dict) -> None:
    """Two DR-GS objects, one a mirrored linked duplicate; polished ball, cube; soft point, spot and area light.

    A small light is seen by the camera.
    """
    first = subject(job["asset"], 0.6)
    first.location.x -= 0.9
    second = first.copy()
    bpy.context.collection.objects.link(second)
    second.location.x, second.location.y = 1.1, 0.4
    second.scale.x *= -1.2
    floor(material("Floor", (0.5, 0.55, 0.6), 0.6))
    ball(material("Metal", (0.9, 0.7, 0.4), 0.3, 1.0), 0.4, (0.2, -0.9, 0.4))
    cube(material("Paint", (0.7, 0.15, 0.1), 0.4), 0.6, (0.1, 0.9, 0.3), 0.5)
    add_light("POINT", 60, (-2, -2, 2.5), shadow_soft_size=0.3)
    add_light("SPOT", 150, (2.5, -1.5, 3), shadow_soft_size=0.1, spot_size=math.radians(50), spot_blend=0.4)
    add_light("AREA", 50, (0.5, 2.5, 2.5), shape="RECTANGLE", size=1.5, size_y=0.6)
    add_light("POINT", 0.15, (0.75, -0.5, 1.0), shadow_soft_size=0.08, color=(1, 0.6, 0.4)).visible_camera = True
    world((0.3, 0.35, 0.5), 0.1)
    camera((0.6, -4.6, 2.2), (0.1, 0, 0.55))


def scattered(job: dict) -> None:
    """A mesh in twenty places by an instanced collection; disk light with spread, a large panel that glows."""
    subject(job["asset"], 0.6)
    floor(material("Floor", (0.6, 0.6, 0.6), 0.7))
    bpy.ops.mesh.primitive_monkey_add(size=0.5)
    shape = finish("Shape", material("Shape", (0.2, 0.5, 0.25), 0.35), smooth=True)
    group = bpy.data.collections.new("Group")
    group.objects.link(shape)
    bpy.context.collection.objects.unlink(shape)
    rng = np.random.default_rng(2)
    for i in range(20):
        place = bpy.data.objects.new(f"Place {i}", None)
        place.instance_type, place.instance_collection = "COLLECTION", group
        a, r = i * 2 * math.pi / 20, 1.4 if i % 2 else 2.0
        place.location = (r * math.cos(a), r * math.sin(a), 0.25)
        place.rotation_euler = rng.uniform(-0.5, 0.5, 3) + np.array((0, 0, a))
        place.scale = rng.uniform(0.7, 1.3, 3) * (-1 if i % 3 == 0 else 1, 1, 1)
        bpy.context.collection.objects.link(place)
    add_light("AREA", 40, (-1.5, -2, 3), shape="DISK", size=0.8, spread=math.radians(100))
    bpy.ops.mesh.primitive_plane_add(size=3, location=(3, 0.5, 1.6), rotation=(0, -math.pi / 2, 0))
    finish("Panel", material("Panel", emission=2.0))
    world()
    camera((0.4, -5, 2.6), (0, 0, 0.5))


def visibility(job: dict) -> None:
    """What only some rays meet: an object that only throws a shadow, one without, a holdout; a floor that catches."""
    seen = subject(job["asset"], 0.6)
    world((0.7, 0.8, 1.0), 0.25)
    add_light("SUN", 2.0, (2, -2, 4), angle=math.radians(6))
    add_light("POINT", 60, (-1.5, -2, 2), shadow_soft_size=0.2)
    unseen = seen.copy()
    bpy.context.collection.objects.link(unseen)
    unseen.location, unseen.scale, unseen.visible_camera = (1.0, -0.8, 0.6), seen.scale / 2, False
    lit = cube(material("No shadow", (0.8, 0.6, 0.1)), 0.5, (-1.1, 0.2, 0.25), 0.4)
    lit.visible_shadow = False
    matte = ball(material("Matte"), 0.3, (0.35, -1.0, 0.4))
    matte.visible_glossy = False
    hole = cube(material("Hole"), 0.4, (-0.6, -0.9, 0.2), 0.2)
    hole.is_holdout = True
    floor(material("Floor", (0.5, 0.5, 0.5), 0.8)).visible_diffuse = False
    camera((0.3, -4.2, 1.9), (0, 0, 0.6))


def catcher(job: dict) -> None:
    """The same, and of the floor only the shadows."""
    visibility(job)
    bpy.data.objects["Floor"].is_shadow_catcher = True


SCENES: dict[str, Callable[[dict], None]] = {
    "outdoors": outdoors, "studio": studio, "scattered": scattered, "visibility": visibility, "catcher": catcher,
}  # fmt: skip


def build(job: dict) -> bpy.types.Scene:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    bpy.ops.wm.save_as_mainfile(filepath=job["blend"])
    importlib.import_module(job["module"]).SCENES[job["scene"]](job)
    plain_shading()
    render = scene.render
    render.resolution_x = render.resolution_y = job["size"]
    render.film_transparent = True
    scene.view_settings.view_transform = "Raw"
    image = render.image_settings
    if job["passes"]:
        image.media_type = "MULTI_LAYER_IMAGE"
    else:
        image.file_format, image.color_mode = "OPEN_EXR", "RGBA"
    image.color_depth = "32"
    cycles = scene.cycles
    cycles.device, cycles.use_adaptive_sampling, cycles.use_denoising = "CPU", False, False
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.diffuse_bounces = cycles.glossy_bounces = job["bounces"]
    # Surfaces that light passes count apart here, and in Cycles among all: without them its limit would be another.
    passed = job.get("passed", 0)
    cycles.max_bounces, cycles.transmission_bounces = job["bounces"] + passed, passed or job["bounces"]
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.caustics_reflective = cycles.caustics_refractive = True
    cycles.light_sampling_threshold = 0.0
    settings = scene.drgs
    settings.subpixel_samples, settings.camera_sees = job.get("subpixels", 16), "mesh"
    settings.bounces = job["bounces"]
    settings.denoise, settings.filter_width = "none", 0.0  # the box of Cycles above
    bpy.ops.wm.save_as_mainfile(filepath=job["blend"])
    return scene


def picture(scene: bpy.types.Scene, engine: str, seed: int, samples: int, path: Path) -> None:
    scene.render.engine = engine
    scene.cycles.seed, scene.cycles.samples = seed, samples
    scene.drgs.seed, scene.drgs.samples = seed, samples
    scene.render.filepath = str(path.with_suffix(".exr"))
    bpy.ops.render.render(write_still=True)
    if scene.render.image_settings.file_format == "OPEN_EXR_MULTILAYER":
        return
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    np.save(path, pixels.reshape(image.size[1], image.size[0], 4)[::-1])
    path.with_suffix(".exr").unlink()


def main(path: str) -> None:
    job = json.loads(Path(path).read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=job["zip"], repo="user_default", enable_on_install=True)
    scene = build(job)
    for wanted in job["pictures"]:
        picture(scene, wanted["engine"], wanted["seed"], wanted["samples"], Path(wanted["out"]))
    bpy.ops.drgs.engine_stop()


if __name__ == "__main__":
    main(sys.argv[1])
