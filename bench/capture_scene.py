"""Runs inside Blender's Python: photographs of an object on a textured table, with their cameras and masks.

    .venv-blender/bin/python bench/capture_scene.py FOLDER --world SKY.hdr [--object MESH.glb] [--sheet SHEET.png]

Cycles renders an object, the cat of the examples unless another is named, from two rings of hand-held cameras.
`FOLDER/images` has the pictures without cameras or masks; `FOLDER/truth.json` the true cameras: camera to world,
Blender's axes, metres; `FOLDER/truth` the true masks, the object's coverage. With `--sheet`, the picture of a marker
sheet on A4 lies under the object; with `--camouflage` the object has the table's picture; with `--clutter` other
things stand around it. With `--turntable` it turns before one camera, while table and sky stand still, and the true
cameras are as it sees them. With `--relit` the object alone is rendered under another sky, from cameras of its own,
into `FOLDER/relit`: a capture with masks, whose `transforms.json` has true cameras.
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
HEIGHT, TABLE, DISTANCE, NEAR = 0.16, 1.2, 0.55, 0.4
A4 = (0.210, 0.297)
GROUND = ("table", "sheet")
#: Things around the object: distance and side, metres, and colour.
CLUTTER = ((0.24, 0.07, (0.6, 0.1, 0.08)), (0.27, 0.1, (0.1, 0.3, 0.6)), (0.22, 0.05, (0.7, 0.6, 0.2)),
           (0.29, 0.08, (0.2, 0.5, 0.2)), (0.25, 0.06, (0.8, 0.8, 0.8)))  # fmt: skip


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


def clutter() -> None:
    """Boxes around the object, turned anyhow."""
    for k, (distance, side, colour) in enumerate(CLUTTER):
        angle = 2 * math.pi * (k + 0.3) / len(CLUTTER)
        place = (distance * math.cos(angle), distance * math.sin(angle), side / 2)
        bpy.ops.mesh.primitive_cube_add(size=side, location=place, rotation=(0, 0, 2.1 * k))
        box = bpy.context.object
        box.name = f"clutter {k}"
        material = bpy.data.materials.new(box.name)
        material.use_nodes = True
        material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1.0)
        box.data.materials.append(material)


def is_subject(obj: bpy.types.Object) -> bool:
    """Whether an object belongs to what is photographed, not to what it stands on or among."""
    return obj.name not in GROUND and not obj.name.startswith("clutter")


def stand(path: Path, turned: bpy.types.Object) -> list[bpy.types.Object]:
    """Import the object, `HEIGHT` high, its feet at the origin, to turn with `turned`; its meshes."""
    if path.suffix.lower() == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    else:
        bpy.ops.import_scene.gltf(filepath=str(path))
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    meshes = [obj for obj in bpy.data.objects if obj.type == "MESH" and is_subject(obj) and not obj.hide_render]
    parts = []
    for obj in meshes:
        posed = obj.evaluated_get(graph)
        parts.append(np.array([posed.matrix_world @ vertex.co for vertex in posed.data.vertices]))
    vertices = np.concatenate(parts)
    low, high = vertices.min(0), vertices.max(0)
    scale = HEIGHT / (high[2] - low[2])
    foot = Vector((*((low + high) / 2)[:2], low[2]))
    for obj in [obj for obj in bpy.data.objects if obj.parent is None and is_subject(obj) and obj != turned]:
        obj.matrix_world = Matrix.Scale(scale, 4) @ Matrix.Translation(-foot) @ obj.matrix_world
        obj.parent = turned
    return meshes


def cover(meshes: list[bpy.types.Object], image: bpy.types.Image, whole: bool) -> None:
    """Give meshes a picture, on their UV map or, `whole`, from all sides as on a box."""
    material = picture_material("cover", image)
    if whole:
        nodes, links = material.node_tree.nodes, material.node_tree.links
        texture = next(node for node in nodes if node.type == "TEX_IMAGE")
        texture.projection, texture.projection_blend = "BOX", 0.2
        coordinate, mapping = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeMapping")
        mapping.inputs["Scale"].default_value = (1 / TABLE,) * 3
        links.new(coordinate.outputs["Position"], mapping.inputs["Vector"])
        links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    for obj in meshes:
        obj.data.materials.clear()
        obj.data.materials.append(material)


def cameras(count: int, seed: int, elevations: tuple[float, float]) -> list[Matrix]:
    """Two rings around the object at elevations in radians, held about level."""
    random = np.random.default_rng(seed)
    found = []
    for k in range(count):
        ring = k % 2
        angle = 2 * math.pi * (k + 0.3 * random.random()) / count
        height = elevations[ring] + 0.1 * (random.random() - 0.5)
        distance = DISTANCE * (1 + 0.15 * (random.random() - 0.5))
        place = Vector((math.cos(angle) * math.cos(height), math.sin(angle) * math.cos(height), math.sin(height)))
        target = Vector((*(0.02 * (random.random(2) - 0.5)), 0.4 * HEIGHT))
        look = (target - place * distance).to_track_quat("-Z", "Y").to_matrix().to_4x4()
        roll = Matrix.Rotation(0.06 * (random.random() - 0.5), 4, "Z")
        found.append(Matrix.Translation(place * distance) @ look @ roll)
    return found


def turns(count: int, elevation: float) -> list[Matrix]:
    """Cameras around the object as one that stands still sees it turn."""
    height = np.array([math.cos(elevation), 0.0, math.sin(elevation)])
    look = (Vector((0.0, 0.0, 0.45 * HEIGHT)) - Vector(NEAR * height)).to_track_quat("-Z", "Y").to_matrix().to_4x4()
    still = Matrix.Translation(NEAR * height) @ look
    return [Matrix.Rotation(2 * math.pi * k / count, 4, "Z") @ still for k in range(count)]


def show_alone(scene: bpy.types.Scene) -> None:
    """Of all, leave the object, which nothing stands before, on a transparent film."""
    for obj in bpy.data.objects:
        if obj.type == "MESH" and not is_subject(obj):
            obj.hide_render = True
    scene.render.film_transparent = True
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"


def render_all(
    scene: bpy.types.Scene, places: dict[str, Matrix], folder: Path, turned: bpy.types.Object | None = None
) -> None:
    """What is not there yet of pictures from each camera, or from the first, with the object `turned` to look alike."""
    folder.mkdir(parents=True, exist_ok=True)
    first = next(iter(places.values()))
    for name, matrix in places.items():
        if not (folder / name).exists():
            scene.camera.matrix_world = matrix
            if turned is not None:
                scene.camera.matrix_world, turned.matrix_world = first, first @ matrix.inverted()
            scene.render.filepath = str(folder / name)
            bpy.ops.render.render(write_still=True)


def render_relit(scene: bpy.types.Scene, args: argparse.Namespace, focal: float) -> None:
    """The object under the other sky, from a third of as many cameras as photographs are of."""
    add_world(scene, str(args.relit.resolve()), 0.0, 1.0)
    scene.cycles.max_bounces, scene.cycles.use_denoising = 4, True
    scene.cycles.samples = 4 * args.samples
    views = cameras(max(args.pictures // 3, 2), 9, args.elevations)
    places = {f"view_{k:03d}.png": matrix for k, matrix in enumerate(views)}
    render_all(scene, places, args.folder / "relit")
    width, height = scene.render.resolution_x, scene.render.resolution_y
    lens = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    frames = [{"file_path": name, "transform_matrix": [list(row) for row in matrix]} for name, matrix in places.items()]
    data = lens | {"camera_model": "PINHOLE", "applied_transform": np.eye(4)[:3].tolist(), "frames": frames}
    (args.folder / "relit" / "transforms.json").write_text(json.dumps(data))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--object", type=Path, default=ROOT / "examples" / "cat" / "egyptian_cat.glb")
    parser.add_argument("--texture", type=Path, help="picture on the object's UV map")
    parser.add_argument("--camouflage", action="store_true", help="the object has the table's picture")
    parser.add_argument("--seed", type=int, default=1, help="of the table's picture")
    parser.add_argument("--elevations", type=float, nargs=2, default=(0.45, 0.95), help="of the rings, radians")
    parser.add_argument("--pictures", type=int, default=36)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--denoise", action="store_true")
    parser.add_argument("--sheet", type=Path)
    parser.add_argument("--clutter", action="store_true", help="other things stand around the object")
    parser.add_argument("--turntable", action="store_true", help="the object turns before a camera that stands still")
    parser.add_argument("--world", type=Path, required=True)
    parser.add_argument("--relit", type=Path, help="another sky, under which the object alone is rendered")
    args = parser.parse_args()
    scene = reset()
    table = table_picture(args.seed)
    plane("table", TABLE, TABLE, -0.0005, table)
    if args.sheet:
        plane("sheet", *A4, 0.0, bpy.data.images.load(str(args.sheet.resolve())))
    if args.clutter:
        clutter()
    turned = bpy.data.objects.new("turntable", None)
    scene.collection.objects.link(turned)
    meshes = stand(args.object.resolve(), turned)
    if args.camouflage:
        cover(meshes, table, whole=True)
    elif args.texture:
        cover(meshes, bpy.data.images.load(str(args.texture.resolve())), whole=False)
    add_world(scene, str(args.world.resolve()), 0.0, 1.0)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = args.samples, args.denoise
    scene.cycles.max_bounces, scene.render.use_persistent_data = 2, True
    scene.render.resolution_x, scene.render.resolution_y = args.size, args.size * 3 // 4
    if args.relit:  # what is judged in linear light must not have passed through a film's curve
        scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "JPEG"
    scene.render.image_settings.quality = 95
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens, camera.data.sensor_width, camera.data.clip_start = 40.0, 36.0, 0.01
    scene.collection.objects.link(camera)
    scene.camera = camera
    views = turns(args.pictures, args.elevations[0]) if args.turntable else cameras(args.pictures, 5, args.elevations)
    places = {f"photo_{k:03d}.jpg": matrix for k, matrix in enumerate(views)}
    focal = args.size * camera.data.lens / camera.data.sensor_width
    args.folder.mkdir(parents=True, exist_ok=True)
    truth = {"focal": focal, "frames": {name: [list(row) for row in matrix] for name, matrix in places.items()}}
    (args.folder / "truth.json").write_text(json.dumps(truth))
    render_all(scene, places, args.folder / "images", turned if args.turntable else None)
    turned.matrix_world = Matrix()
    show_alone(scene)
    scene.cycles.max_bounces, scene.cycles.use_denoising = 0, False
    render_all(scene, {f"{Path(name).stem}.png": matrix for name, matrix in places.items()}, args.folder / "truth")
    if args.relit:
        render_relit(scene, args, focal)


if __name__ == "__main__":
    main()
