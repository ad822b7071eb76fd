"""Runs inside Blender's Python: what Cycles makes of Blender's lights, for test_lights_cycles.py.

    .venv-blender/bin/python tests/unit/cycles_lights.py JOB.json

The job lists lights by the fields of drgs_blender.core.frame.Light. With ``look`` = [origin, direction], the result is
the radiance of the light seen from there; without it, the irradiance at the origin on a plane that faces +Z, from a
white diffuse plane under an orthographic camera. One RGB triple per light goes into JOB.result.json.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

PIXELS = 8


def add_light(entry: dict) -> None:
    kind = entry["kind"]
    light = bpy.data.lights.new("light", kind.upper())
    light.color, light.energy, light.normalize = entry["colour"], entry["power"], entry["normalize"]
    if kind in ("point", "spot"):
        light.shadow_soft_size, light.use_soft_falloff = entry["radius"], entry.get("soft_falloff", True)
    if kind == "sun":
        light.angle = entry["angle"]
    if kind == "spot":
        light.spot_size, light.spot_blend = entry["spot_size"], entry["spot_blend"]
    if kind == "area":
        light.shape, light.size, light.size_y = entry["shape"].upper(), entry["size_x"], entry["size_y"]
        light.spread = entry["spread"]
    obj = bpy.data.objects.new("light", light)
    obj.matrix_world = Matrix(entry["matrix_world"])
    obj.visible_camera, obj.visible_diffuse, obj.visible_glossy = entry["camera"], entry["diffuse"], entry["glossy"]
    bpy.context.collection.objects.link(obj)


def add_receiver(roughness: float | None) -> None:
    """White plane around the origin; diffuse, or a rough mirror."""
    mesh = bpy.data.meshes.new("plane")
    mesh.from_pydata([(-1e-2, -1e-2, 0), (1e-2, -1e-2, 0), (1e-2, 1e-2, 0), (-1e-2, 1e-2, 0)], [], [(0, 1, 2, 3)])
    material = bpy.data.materials.new("white")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    shader = nodes.new("ShaderNodeBsdfDiffuse" if roughness is None else "ShaderNodeBsdfAnisotropic")
    shader.inputs["Color"].default_value = (1, 1, 1, 1)
    shader.inputs["Roughness"].default_value = roughness or 0.0
    material.node_tree.links.new(shader.outputs[0], nodes["Material Output"].inputs[0])
    mesh.materials.append(material)
    bpy.context.collection.objects.link(bpy.data.objects.new("plane", mesh))


def render(entry: dict, path: Path) -> list[float]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    add_light(entry)
    look = entry.get("look")
    if look is None:
        add_receiver(entry.get("glossy_roughness"))
        origin, direction = Vector((0, 0, 1e-2)), Vector((0, 0, -1))
    else:
        origin, direction = Vector(look[0]), Vector(look[1])
    data = bpy.data.cameras.new("camera")
    data.type, data.ortho_scale, data.clip_start = "ORTHO", 1e-5, 1e-4
    camera = bpy.data.objects.new("camera", data)
    camera.matrix_world = Matrix.Translation(origin) @ direction.to_track_quat("-Z", "Y").to_matrix().to_4x4()
    bpy.context.collection.objects.link(camera)
    scene.camera = camera
    scene.render.resolution_x = scene.render.resolution_y = PIXELS
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples = "CPU", entry.get("samples", 1024) if look is None else 1
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.pixel_filter_type = "BOX"
    cycles.light_sampling_threshold = cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy, cycles.max_bounces = 0.0, 0
    scene.view_settings.view_transform = "Raw"
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(PIXELS * PIXELS * 4, np.float32)
    image.pixels.foreach_get(pixels)
    mean = pixels.reshape(-1, 4)[:, :3].astype(float).mean(0)
    return (mean if look is not None or "glossy_roughness" in entry else mean * np.pi).tolist()


def main(job: Path) -> None:
    entries = json.loads(job.read_text())
    results = [render(entry, job.with_suffix(".exr")) for entry in entries]
    job.with_suffix(".result.json").write_text(json.dumps(results))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
