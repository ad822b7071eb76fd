"""Runs inside Blender's Python: Cycles' own texture lookups, for test_textures_cycles.py.

    .venv-blender/bin/python tests/unit/cycles_textures.py FOLDER

FOLDER/job.json lists tiles (image, colour space, extension, interpolation, mapping, output); each becomes a unit
square that shines with its texture, and all are rendered into FOLDER/picture.exr, row by row from the top left.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy
import numpy as np


def load_image(folder: Path, name: str, colour_space: str, alpha_mode: str) -> bpy.types.Image:
    """NAME.png from disk, as most textures are, or NAME.npy: float32 (h, w, 4), row 0 at the top; else a lost file."""
    if (folder / f"{name}.png").exists():
        image = bpy.data.images.load(str(folder / f"{name}.png"))
    elif not (folder / f"{name}.npy").exists():
        image = bpy.data.images.new(name, 1, 1)
        image.source, image.filepath = "FILE", str(folder / name)
    else:
        pixels = np.load(folder / f"{name}.npy")
        image = bpy.data.images.new(name, pixels.shape[1], pixels.shape[0], alpha=True, float_buffer=True)
    image.colorspace_settings.name = colour_space
    image.alpha_mode = alpha_mode
    if image.is_float:
        image.pixels.foreach_set(np.ascontiguousarray(pixels[::-1]).ravel())
        image.update()
    return image


def shining(tile: dict, image: bpy.types.Image) -> bpy.types.Material:
    """Emission whose colour is one output of an Image Texture node behind a Mapping node."""
    material = bpy.data.materials.new("tile")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output, emission = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeEmission")
    texture, mapping, coordinate = (nodes.new(f"ShaderNode{n}") for n in ("TexImage", "Mapping", "TexCoord"))
    texture.image, texture.extension = image, tile["extension"]
    texture.interpolation = tile["interpolation"]
    for name in ("Location", "Rotation", "Scale"):
        mapping.inputs[name].default_value = tile.get(name.lower(), [float(name == "Scale")] * 3)
    links.new(coordinate.outputs["UV"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    links.new(emission.outputs[0], output.inputs["Surface"])
    wanted = tile.get("output", "rgb")
    if wanted == "rgb":
        links.new(texture.outputs["Color"], emission.inputs["Color"])
    elif wanted == "luminance":
        links.new(texture.outputs["Color"], emission.inputs["Strength"])
    elif wanted == "a":
        links.new(texture.outputs["Alpha"], emission.inputs["Strength"])
    elif wanted == "straight":
        # The Alpha output in use makes the Color output straight; multiplied by 0 it changes nothing else.
        zero, one = nodes.new("ShaderNodeMath"), nodes.new("ShaderNodeMath")
        zero.operation, one.operation = "MULTIPLY", "ADD"
        zero.inputs[1].default_value, one.inputs[1].default_value = 1e-20, 1.0
        links.new(texture.outputs["Alpha"], zero.inputs[0])
        links.new(zero.outputs[0], one.inputs[0])
        links.new(one.outputs[0], emission.inputs["Strength"])
        links.new(texture.outputs["Color"], emission.inputs["Color"])
    else:
        separate = nodes.new("ShaderNodeSeparateColor")
        links.new(texture.outputs["Color"], separate.inputs[0])
        links.new(separate.outputs["rgb".index(wanted)], emission.inputs["Strength"])
    return material


def main(folder: Path) -> None:
    job = json.loads((folder / "job.json").read_text())
    tiles, columns, size = job["tiles"], job["columns"], job["size"]
    rows = -(-len(tiles) // columns)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    images: dict[tuple, bpy.types.Image] = {}
    for k, tile in enumerate(tiles):
        key = tile["image"], tile["colour_space"], tile.get("alpha_mode", "STRAIGHT")
        if key not in images:
            images[key] = load_image(folder, *key)
        x, y = k % columns, rows - 1 - k // columns
        mesh = bpy.data.meshes.new("tile")
        mesh.from_pydata([(x, y, 0), (x + 1, y, 0), (x + 1, y + 1, 0), (x, y + 1, 0)], [], [(0, 1, 2, 3)])
        (u0, u1), (v0, v1) = job["u"], job["v"]
        mesh.uv_layers.new().data.foreach_set("uv", [u0, v0, u1, v0, u1, v1, u0, v1])
        mesh.materials.append(shining(tile, images[key]))
        scene.collection.objects.link(bpy.data.objects.new("tile", mesh))
    camera = bpy.data.cameras.new("camera")
    camera.type, camera.sensor_fit, camera.ortho_scale = "ORTHO", "HORIZONTAL", columns
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.camera.location = (columns / 2, rows / 2, 5)
    scene.collection.objects.link(scene.camera)
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = columns * size, rows * size
    scene.render.resolution_percentage = 100
    # One sample at the very centre of each pixel.
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BLACKMAN_HARRIS", 0.01
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 1, False, False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(folder / "picture.exr")
    bpy.ops.render.render(write_still=True)


main(Path(sys.argv[1]))
