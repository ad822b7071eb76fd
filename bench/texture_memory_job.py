"""Runs inside Blender's Python: a large mesh with large textures, made once, then rendered by one engine.

    .venv-blender/bin/python bench/texture_memory_job.py make FOLDER TRIANGLES TEXTURES SIDE
    .venv-blender/bin/python bench/texture_memory_job.py render FOLDER CYCLES|DRGS [ZIP]

Before and after the render it prints a line and waits for one, so that its memory can be read in between.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.append(str(Path(__file__).resolve().parent))
from composed_job import add_light, camera, world

#: Sockets of the materials, in turn, and the colour space of their images.
SOCKETS = (("Base Color", "sRGB"), ("Roughness", "Non-Color"), ("Normal", "Non-Color"), ("Metallic", "Non-Color"))


def make(folder: Path, triangles: int, textures: int, side: int) -> None:
    """A grid in waves, its faces dealt out to materials of four textures each; every texture a PNG of its own."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    cells = math.ceil(math.sqrt(triangles / 2))
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=cells, y_subdivisions=cells, size=4)
    mesh = bpy.context.active_object.data
    places = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", places.ravel())
    places[:, 2] = 0.1 * np.sin(5 * places[:, 0]) * np.sin(5 * places[:, 1])
    mesh.vertices.foreach_set("co", places.ravel())
    mesh.shade_smooth()
    for first in range(0, textures, len(SOCKETS)):
        mesh.materials.append(_material(folder, first, min(len(SOCKETS), textures - first), side))
    owners = np.arange(len(mesh.polygons)) * len(mesh.materials) // len(mesh.polygons)
    mesh.polygons.foreach_set("material_index", owners.astype(np.int32))
    add_light("SUN", 2.5, (2.5, -2, 3))
    world((0.7, 0.85, 1.0), 0.3)
    camera((0.5, -6, 4), (0, 0, 0))
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))


def _material(folder: Path, first: int, count: int, side: int) -> bpy.types.Material:
    made = bpy.data.materials.new(f"Material {first}")
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    principled = nodes["Principled BSDF"]
    for i, (socket, space) in enumerate(SOCKETS[:count]):
        rng = np.random.default_rng(first + i)
        pixels = np.ones((side, side, 4), np.float32)
        pixels[..., :3] = rng.uniform(0.2, 0.9, (side // 8, side // 8, 3)).repeat(8, 0).repeat(8, 1)
        if socket == "Normal":
            pixels[..., :3] = (0.5, 0.5, 1.0)
            pixels[..., 0] += 0.1 * np.sin(np.arange(side) / 20)
        image = bpy.data.images.new(f"Image {first + i}", side, side)
        image.pixels.foreach_set(pixels.ravel())
        image.filepath_raw, image.file_format = str(folder / f"{first + i}.png"), "PNG"
        image.save()
        bpy.data.images.remove(image)
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = bpy.data.images.load(str(folder / f"{first + i}.png"))
        texture.image.colorspace_settings.name = space
        output = texture.outputs["Color"]
        if socket == "Normal":
            node = nodes.new("ShaderNodeNormalMap")
            links.new(output, node.inputs["Color"])
            output = node.outputs["Normal"]
        links.new(output, principled.inputs[socket])
    return made


def render(folder: Path, engine: str, extension: str) -> None:
    """One small picture of few samples: what it keeps in memory is scene, not film."""
    if engine == "DRGS":
        bpy.ops.extensions.package_install_files(filepath=extension, repo="user_default", enable_on_install=True)
    bpy.ops.wm.open_mainfile(filepath=str(folder / "scene.blend"))
    scene = bpy.context.scene
    scene.render.engine = engine
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 128, 128, 100
    scene.render.filepath = str(folder / f"{engine}.png")
    scene.cycles.device, scene.cycles.samples, scene.cycles.max_bounces = "CPU", 8, 2
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    if engine == "DRGS":
        scene.drgs.use_strategy_samples, scene.drgs.samples, scene.drgs.bounces = False, 8, 2
        scene.drgs.denoise = "none"
    _pause()
    bpy.ops.render.render(write_still=True)
    _pause()
    if engine == "DRGS":
        bpy.ops.preferences.addon_disable(module="bl_ext.user_default.drgs")


def _pause() -> None:
    print("READY", flush=True)
    sys.stdin.readline()


if __name__ == "__main__":
    if sys.argv[1] == "make":
        make(Path(sys.argv[2]), *(int(word) for word in sys.argv[3:6]))
    else:
        render(Path(sys.argv[2]), sys.argv[3], sys.argv[4] if len(sys.argv) > 4 else "")
