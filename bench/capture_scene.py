"""Runs inside Blender's Python: photographs of an object on a textured table, with the cameras they were taken with.

    .venv-blender/bin/python bench/capture_scene.py FOLDER --world SKY.hdr [--size 800] [--sheet SHEET.png]

Cycles renders the cat of the examples from two rings of hand-held cameras. `FOLDER/images` has the pictures without
cameras or masks, `FOLDER/truth.json` the true ones: camera to world, Blender's axes, metres. With `--sheet`, the
picture of a marker sheet on A4 lies under the object.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "bench"))
from cycles_job import add_world, reset  # noqa: E402

#: Metres.
HEIGHT, TABLE, DISTANCE = 0.16, 1.2, 0.55
A4 = (0.210, 0.297)


def picture_material(name: str, image: bpy.types.Image) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    links.new(texture.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.6
    return material


def table_picture(seed: int, side: int = 2048) -> bpy.types.Image:
    """Noise of many scales: a texture that looks alike nowhere."""
    random = np.random.default_rng(seed)
    pixels = np.zeros((side, side, 3))
    for cells in (16, 32, 64, 128, 256, 512, 1024):
        noise = random.random((cells, cells, 3)).repeat(side // cells, 0).repeat(side // cells, 1)
        pixels += (noise - 0.5) * 0.5
    image = bpy.data.images.new("table", side, side)
    colour = np.clip(0.4 + pixels, 0.02, 0.98)
    image.pixels.foreach_set(np.dstack([colour, np.ones((side, side, 1))]).astype(np.float32).ravel())
    return image


def plane(name: str, width: float, height: float, z: float, image: bpy.types.Image) -> None:
    """A rectangle whose picture has its bottom at -Y."""
    mesh = bpy.data.meshes.new(name)
    x, y = width / 2, height / 2
    mesh.from_pydata([(-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z)], [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new()
    for loop, uv in zip(layer.data, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
        loop.uv = uv
    mesh.materials.append(picture_material(name, image))
    bpy.context.collection.objects.link(bpy.data.objects.new(name, mesh))


def stand(path: Path) -> None:
    """Import the object, `HEIGHT` high, its feet at the origin."""
    bpy.ops.import_scene.gltf(filepath=str(path))
    meshes = [obj for obj in bpy.data.objects if obj.type == "MESH" and obj.name not in ("table", "sheet")]
    corners = np.array([obj.matrix_world @ Vector(corner) for obj in meshes for corner in obj.bound_box])
    low, high = corners.min(0), corners.max(0)
    scale = HEIGHT / (high[2] - low[2])
    foot = Vector((*((low + high) / 2)[:2], low[2]))
    for obj in (obj for obj in bpy.data.objects if obj.parent is None and obj.name not in ("table", "sheet")):
        obj.matrix_world = Matrix.Scale(scale, 4) @ Matrix.Translation(-foot) @ obj.matrix_world


def cameras(count: int, seed: int) -> list[Matrix]:
    """Two rings around the object, held about level."""
    random = np.random.default_rng(seed)
    found = []
    for k in range(count):
        ring = k % 2
        angle = 2 * math.pi * (k + 0.3 * random.random()) / count
        height = (0.45, 0.95)[ring] + 0.1 * (random.random() - 0.5)
        distance = DISTANCE * (1 + 0.15 * (random.random() - 0.5))
        place = Vector((math.cos(angle) * math.cos(height), math.sin(angle) * math.cos(height), math.sin(height)))
        target = Vector((*(0.02 * (random.random(2) - 0.5)), 0.4 * HEIGHT))
        look = (target - place * distance).to_track_quat("-Z", "Y").to_matrix().to_4x4()
        roll = Matrix.Rotation(0.06 * (random.random() - 0.5), 4, "Z")
        found.append(Matrix.Translation(place * distance) @ look @ roll)
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pictures", type=int, default=36)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--sheet", type=Path)
    parser.add_argument("--world", type=Path, required=True)
    args = parser.parse_args()
    scene = reset()
    plane("table", TABLE, TABLE, -0.0005, table_picture(1))
    if args.sheet:
        plane("sheet", *A4, 0.0, bpy.data.images.load(str(args.sheet.resolve())))
    stand(ROOT / "examples" / "cat" / "egyptian_cat.glb")
    add_world(scene, str(args.world.resolve()), 0.0, 1.0)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = args.samples, False
    scene.cycles.max_bounces, scene.render.use_persistent_data = 2, True
    scene.render.resolution_x, scene.render.resolution_y = args.size, args.size * 3 // 4
    scene.render.image_settings.file_format = "JPEG"
    scene.render.image_settings.quality = 95
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens, camera.data.sensor_width, camera.data.clip_start = 40.0, 36.0, 0.01
    scene.collection.objects.link(camera)
    scene.camera = camera
    images = args.folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    places = {f"photo_{k:03d}.jpg": matrix for k, matrix in enumerate(cameras(args.pictures, 5))}
    truth = {
        "focal": args.size * camera.data.lens / camera.data.sensor_width,
        "frames": {name: [list(row) for row in matrix] for name, matrix in places.items()},
    }
    (args.folder / "truth.json").write_text(json.dumps(truth))
    for name, matrix in places.items():
        if not (images / name).exists():
            camera.matrix_world = matrix
            scene.render.filepath = str(images / name)
            bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
