"""Runs inside Blender's Python: Cycles renders of one object with known materials, for scenes.py.

The job comes as one line of JSON on stdin; what Blender prints goes to stderr, and this side says on stdout, in
lines that begin with the job's ``word``, which file is ready. Materials are vertex attributes; every file has the
beauty and the true albedo, roughness, metallic, normal and depth. The pose "bend" is made by an armature of two bones
and a shape key, and its evaluated vertices are written once.
"""

from __future__ import annotations

import io
import json
import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

#: Material attribute -> socket of Principled, output of the attribute's node, kind of AOV.
CHANNELS = {
    "albedo": ("Base Color", "Color", "COLOR"),
    "roughness": ("Roughness", "Fac", "VALUE"),
    "metallic": ("Metallic", "Fac", "VALUE"),
}
#: Bend of the upper bone about X and Z, degrees, and how far the shape key pushes the middle out.
BEND, SWELL = (25.0, 0.0, 20.0), 0.15


def main() -> None:
    """Do the job on stdin."""
    sys.stdout.flush()
    say = io.TextIOWrapper(io.FileIO(os.dup(1), "w"), encoding="utf-8", line_buffering=True)
    os.dup2(2, 1)
    job = json.loads(sys.stdin.readline())
    word = job["word"]
    if "mesh" not in job:
        folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
        say.write(f"{word} lights {json.dumps({file.stem: str(file) for file in folder.glob('*.exr')})}\n")
        return
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    with np.load(job["mesh"]) as data:
        subject = add_mesh({name: data[name] for name in data.files})
    show_materials(subject)
    set_up(scene, job)
    camera = add_camera(scene, job)
    pose = deform(subject)
    if job["posed"] and not Path(job["posed"]).exists():
        pose(True)
        save(Path(job["posed"]), evaluated_vertices(subject))
    light = None
    for render in job["renders"]:
        if render["light"] != light:
            light = render["light"]
            add_world(scene, light)
        pose(render["posed"])
        camera.matrix_world = Matrix(render["matrix"])
        out = Path(render["out"])
        scene.render.filepath = str(out.with_name(f"part-{out.name}"))
        bpy.ops.render.render(write_still=True)
        os.replace(scene.render.filepath, out)
        say.write(f"{word} done {render['index']}\n")


def add_mesh(data: Mapping[str, np.ndarray], smooth: bool = True) -> bpy.types.Object:
    """The object, with a Principled material that reads its attributes."""
    mesh = bpy.data.meshes.new("subject")
    mesh.from_pydata(data["vertices"], [], data["faces"], shade_flat=not smooth)
    rgba = np.ones((len(mesh.vertices), 4), np.float32)
    rgba[:, :3] = data["albedo"]
    mesh.attributes.new("albedo", "FLOAT_COLOR", "POINT").data.foreach_set("color", rgba.ravel())
    for name in ("roughness", "metallic"):
        values = np.ascontiguousarray(data[name], np.float32)
        mesh.attributes.new(name, "FLOAT", "POINT").data.foreach_set("value", values)
    subject = bpy.data.objects.new("subject", mesh)
    bpy.context.collection.objects.link(subject)
    material = bpy.data.materials.new("subject")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    principled = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    principled.distribution = "GGX"
    for name, (socket, output, _) in CHANNELS.items():
        attribute = nodes.new("ShaderNodeAttribute")
        attribute.name = attribute.attribute_name = name
        links.new(attribute.outputs[output], principled.inputs[socket])
    mesh.materials.append(material)
    return subject


def show_materials(subject: bpy.types.Object) -> None:
    """The attributes as AOVs of the view layer."""
    tree, layer = subject.active_material.node_tree, bpy.context.view_layer
    for name, (_, output, kind) in CHANNELS.items():
        node = tree.nodes.new("ShaderNodeOutputAOV")
        tree.links.new(tree.nodes[name].outputs[output], node.inputs[kind.capitalize()])
        aov = layer.aovs.add()
        aov.name, aov.type = name, kind
        node.aov_name = name


def set_up(scene: bpy.types.Scene, job: dict[str, Any]) -> None:
    """Cycles on the CPU, one pixel wide box filter, nothing clamped, all that is needed in one multi-layer file."""
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", job["samples"], 0
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = True
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = job["bounces"]
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.caustics_reflective = cycles.caustics_refractive = True
    scene.render.film_transparent = True
    scene.render.use_persistent_data = True
    scene.view_settings.view_transform = "Raw"
    layer = bpy.context.view_layer
    layer.use_pass_z = layer.use_pass_normal = True
    image = scene.render.image_settings
    if hasattr(image, "media_type"):  # from Blender 5.0 on
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth = "OPEN_EXR_MULTILAYER", "32"
    scene.render.use_file_extension = False
    if job["threads"]:
        scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]


def add_camera(scene: bpy.types.Scene, job: dict[str, Any]) -> bpy.types.Object:
    """A camera of the job's field of view, square pictures."""
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.angle_x = "HORIZONTAL", job["angle"]
    data.clip_start, data.clip_end = 0.01, 100.0
    camera = bpy.data.objects.new("camera", data)
    bpy.context.collection.objects.link(camera)
    scene.camera = camera
    scene.render.resolution_x = scene.render.resolution_y = job["size"]
    scene.render.resolution_percentage = 100
    return camera


def add_world(scene: bpy.types.Scene, path: str) -> None:
    """Light the scene by a lat-long picture."""
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    background = next(node for node in nodes if node.type == "BACKGROUND")
    image = nodes.new("ShaderNodeTexEnvironment")
    image.image = bpy.data.images.load(path)
    links.new(image.outputs["Color"], background.inputs["Color"])


def deform(subject: bpy.types.Object) -> Any:
    """Rig the object; returns a function that poses it, or puts it at rest."""
    points = np.array([vertex.co for vertex in subject.data.vertices])
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    subject.shape_key_add(name="Basis")
    swell = subject.shape_key_add(name="swell")
    bump = np.exp(-(((points - middle) / (0.35 * (high - low).max())) ** 2).sum(axis=1))
    swell.data.foreach_set("co", (points + SWELL * bump[:, None] * (points - middle)).astype(np.float32).ravel())
    bone = two_bones(subject, 0.6)

    def pose(on: bool) -> None:
        swell.value = 1.0 if on else 0.0
        bone.rotation_euler = [math.radians(angle) if on else 0.0 for angle in BEND]
        bpy.context.view_layer.update()

    return pose


def two_bones(subject: bpy.types.Object, soft: float) -> bpy.types.PoseBone:
    """Rig the object with two bones that meet in its middle; returns the upper one.

    Parameters
    ----------
    subject : bpy.types.Object
    soft : float
        Part of the height within which the weights go over from one bone to the other.
    """
    points = np.array([vertex.co for vertex in subject.data.vertices])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, height = (low + high) / 2, float(high[2] - low[2])
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
    part = np.clip((points[:, 2] - middle[2]) / (soft * height) + 0.5, 0, 1)
    part = part * part * (3 - 2 * part)
    for name, weights in (("lower", 1 - part), ("upper", part)):
        group = subject.vertex_groups.new(name=name)
        for index, weight in enumerate(weights):
            group.add([index], float(weight), "REPLACE")
    subject.modifiers.new("rig", "ARMATURE").object = rig
    bone = rig.pose.bones["upper"]
    bone.rotation_mode = "XYZ"
    return bone


def evaluated_vertices(subject: bpy.types.Object) -> np.ndarray:
    """(n, 3) float32 world-space vertices after all modifiers."""
    mesh = subject.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    out = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.attributes["position"].data.foreach_get("vector", out)
    return out.reshape(-1, 3)


def save(path: Path, array: np.ndarray) -> None:
    """Write an array so that `path` is whole or absent."""
    part = path.with_name(f"part-{path.name}")
    np.save(part, array)
    os.replace(part, path)


if __name__ == "__main__":
    main()
    sys.stderr.flush()
    os._exit(0)  # nothing of Blender's own way out is needed, and some builds crash on it
