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


def reset() -> bpy.types.Scene:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def add_mesh(data: dict[str, np.ndarray], smooth: bool) -> bpy.types.Object:
    mesh = bpy.data.meshes.new("subject")
    mesh.from_pydata(data["vertices"], [], data["faces"], shade_flat=not smooth)
    n = len(mesh.vertices)
    rgba = np.ones((n, 4), np.float32)
    rgba[:, :3] = data["albedo"]
    mesh.attributes.new("albedo", "FLOAT_COLOR", "POINT").data.foreach_set("color", rgba.ravel())
    for name in ("roughness", "metallic"):
        mesh.attributes.new(name, "FLOAT", "POINT").data.foreach_set("value", np.ascontiguousarray(data[name]))
    subject = bpy.data.objects.new("subject", mesh)
    bpy.context.collection.objects.link(subject)
    material = bpy.data.materials.new("subject")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    principled = nodes["Principled BSDF"]
    principled.distribution = "GGX"
    for name, socket in (("albedo", "Base Color"), ("roughness", "Roughness"), ("metallic", "Metallic")):
        node = nodes.new("ShaderNodeAttribute")
        node.attribute_name = name
        links.new(node.outputs["Color" if name == "albedo" else "Fac"], principled.inputs[socket])
    mesh.materials.append(material)
    return subject


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
    middle, height = (low + high) / 2, float(high[2] - low[2])
    subject.shape_key_add(name="Basis")
    swell = subject.shape_key_add(name="swell")
    bulge = 0.12 * np.exp(-(((points - middle) / (high - low).max() * 4) ** 2).sum(1))[:, None]
    moved = points + bulge * (points - middle)
    swell.data.foreach_set("co", moved.astype(np.float32).ravel())
    swell.value = 1.0
    armature = bpy.data.armatures.new("rig")
    rig = bpy.data.objects.new("rig", armature)
    bpy.context.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    lower, upper = armature.edit_bones.new("lower"), armature.edit_bones.new("upper")
    lower.head, lower.tail = (middle[0], middle[1], low[2]), tuple(middle)
    upper.head, upper.tail = tuple(middle), (middle[0], middle[1], high[2])
    upper.parent = lower
    bpy.ops.object.mode_set(mode="OBJECT")
    blend = np.clip((points[:, 2] - middle[2]) / (0.5 * height) + 0.5, 0, 1)
    blend = blend * blend * (3 - 2 * blend)
    for name, weights in (("lower", 1 - blend), ("upper", blend)):
        group = subject.vertex_groups.new(name=name)
        for i, w in enumerate(weights):
            group.add([i], float(w), "REPLACE")
    subject.modifiers.new("rig", "ARMATURE").object = rig
    bone = rig.pose.bones["upper"]
    bone.rotation_mode = "XYZ"
    bone.rotation_euler = (math.radians(25), 0, math.radians(20))
    bpy.context.view_layer.update()


def evaluated_vertices(subject: bpy.types.Object) -> np.ndarray:
    mesh = subject.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    out = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.attributes["position"].data.foreach_get("vector", out)
    return out.reshape(-1, 3)


def render(scene: bpy.types.Scene, job: dict) -> tuple[np.ndarray, float]:
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples = "CPU", job["samples"]
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = bool(job.get("denoise"))
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.max_bounces = job["bounces"]
    cycles.diffuse_bounces = cycles.glossy_bounces = job["bounces"]
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = 0.0
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
        if job.get("deform"):
            deform(subject)
        if job.get("vertices_out"):
            np.save(job["vertices_out"], evaluated_vertices(subject))
        pixels, seconds = render(scene, job) if job["samples"] else (None, 0.0)
        if pixels is not None:
            np.save(job["out"], pixels)
        results.append({"out": job["out"], "seconds": seconds})
        print(f"cycles: {job['out']} {seconds:.2f} s", flush=True)
    Path(path).with_suffix(".result.json").write_text(json.dumps(results))


if __name__ == "__main__":
    main(sys.argv[1])
