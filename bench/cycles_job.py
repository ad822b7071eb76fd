"""Runs inside Blender's Python: Cycles renders of arrays, the judge of our pictures and times.

    .venv-blender/bin/python bench/cycles_job.py JOB.json

The job lists renders; each names an .npz with `vertices faces albedo roughness metallic`, an environment file,
a camera, samples, bounces. With `deform`, an armature of two bones and a shape key bend the mesh first, and the
evaluated vertices are written beside the picture. `terminator_offset` replaces Blender's shadow terminator geometry
offset of 0.1, which moves the start of shadow rays off the mesh at grazing light. Pictures are written as .npy
(h, w, 4), linear, row 0 on top.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "drgs_blender" / "evaluate"))
from scene_job import add_mesh, evaluated_vertices, two_bones


def reset() -> bpy.types.Scene:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def plain_shading() -> None:
    """Let all materials and objects of the file be what both programs solve alike.

    GGX without multiple scattering, but for materials with the property "multiscatter"; Cycles' shadow terminator
    offsets, which are no physics, off, but for objects with the property "own_terminator".
    """
    for material in bpy.data.materials:
        if "multiscatter" in material:
            continue
        for node in material.node_tree.nodes if material.node_tree else ():
            if getattr(node, "distribution", "") == "MULTI_GGX":
                node.distribution = "GGX"
    for obj in bpy.data.objects:
        if "own_terminator" in obj:
            continue
        obj.shadow_terminator_geometry_offset = obj.shadow_terminator_shading_offset = 0.0


def add_world(scene: bpy.types.Scene, path: str, rotation_z: float, strength: float) -> None:
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    image = nodes.new("ShaderNodeTexEnvironment")
    image.image = bpy.data.images.load(path)
    mapping, coordinate = nodes.new("ShaderNodeMapping"), nodes.new("ShaderNodeTexCoord")
    mapping.inputs["Rotation"].default_value = (0, 0, math.radians(rotation_z))
    links.new(coordinate.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], image.inputs["Vector"])
    links.new(image.outputs["Color"], nodes["Background"].inputs["Color"])
    nodes["Background"].inputs["Strength"].default_value = strength


def add_lamps(scene: bpy.types.Scene, lamps: list[dict]) -> None:
    """Lights, in the words of `core.frame.Light`."""
    for lamp in lamps:
        data = bpy.data.lights.new("lamp", lamp["kind"].upper())
        data.energy, data.color = lamp["power"], lamp.get("colour", (1, 1, 1))
        if lamp["kind"] == "point":
            data.shadow_soft_size = lamp["radius"]
        elif lamp["kind"] == "sun":
            data.angle = lamp["angle"]
        else:
            data.size = lamp["size_x"]
        item = bpy.data.objects.new("lamp", data)
        item.matrix_world = Matrix(lamp["matrix_world"])
        item.visible_camera = False
        scene.collection.objects.link(item)


def add_camera(scene: bpy.types.Scene, camera: dict) -> None:
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.angle_x = math.radians(camera["fov_x"])
    subject = bpy.data.objects.new("camera", data)
    subject.matrix_world = Matrix(camera["matrix_world"])
    bpy.context.collection.objects.link(subject)
    scene.camera = subject
    scene.render.resolution_x, scene.render.resolution_y = camera["width"], camera["height"]
    scene.render.resolution_percentage = 100


def deform(subject: bpy.types.Object) -> None:
    """Bend the upper half by 40 degrees with two bones and swell one side with a shape key."""
    points = np.array([v.co for v in subject.data.vertices])
    low, high = points.min(0), points.max(0)
    middle = (low + high) / 2
    subject.shape_key_add(name="Basis")
    swell = subject.shape_key_add(name="swell")
    bulge = 0.12 * np.exp(-(((points - middle) / (high - low).max() * 4) ** 2).sum(1))[:, None]
    moved = points + bulge * (points - middle)
    swell.data.foreach_set("co", moved.astype(np.float32).ravel())
    swell.value = 1.0
    bone = two_bones(subject, 0.5)
    bone.rotation_euler = (math.radians(25), 0, math.radians(20))
    bpy.context.view_layer.update()


def render(scene: bpy.types.Scene, job: dict) -> tuple[np.ndarray, float]:
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples = "CPU", job["samples"]
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = bool(job.get("denoise"))
    width = job.get("filter_width")
    cycles.pixel_filter_type, cycles.filter_width = ("BLACKMAN_HARRIS", width) if width else ("BOX", 1.0)
    cycles.max_bounces = job["bounces"]
    cycles.diffuse_bounces = cycles.glossy_bounces = job["bounces"]
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = job.get("filter_glossy", 0.0)
    cycles.caustics_reflective = cycles.caustics_refractive = True
    cycles.seed = job.get("seed", 0)
    scene.render.film_transparent = True
    scene.render.use_persistent_data = bool(job.get("repeat", 1) > 1)
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.image_settings.color_mode = "RGBA"
    path = Path(job["out"]).with_suffix(".exr")
    scene.render.filepath = str(path)
    times = []
    for _ in range(job.get("repeat", 1)):
        begin = time.perf_counter()
        bpy.ops.render.render(write_still=True)
        times.append(time.perf_counter() - begin)
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    path.unlink()
    return pixels.reshape(image.size[1], image.size[0], 4)[::-1].copy(), sorted(times)[len(times) // 2]


def main(path: str) -> None:
    results = []
    for job in json.loads(Path(path).read_text()):
        scene = reset()
        with np.load(job["mesh"]) as data:
            subject = add_mesh({k: data[k] for k in data.files}, job.get("smooth", True))
        if "terminator_offset" in job:
            subject.shadow_terminator_geometry_offset = job["terminator_offset"]
        add_world(scene, job["environment"], job.get("rotation_z", 0.0), job.get("strength", 1.0))
        add_camera(scene, job["camera"])
        add_lamps(scene, job.get("lamps", []))
        if job.get("deform"):
            deform(subject)
        if job.get("vertices_out"):
            np.save(job["vertices_out"], evaluated_vertices(subject))
        used = time.process_time()
        pixels, seconds = render(scene, job) if job["samples"] else (None, 0.0)
        used = time.process_time() - used
        if pixels is not None:
            np.save(job["out"], pixels)
        results.append({"out": job["out"], "seconds": seconds, "processor_seconds": used})
        print(f"cycles: {job['out']} {seconds:.2f} s", flush=True)
    Path(path).with_suffix(".result.json").write_text(json.dumps(results))


if __name__ == "__main__":
    main(sys.argv[1])
