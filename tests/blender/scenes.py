"""Assets, rigs and pictures that several test files use."""

from __future__ import annotations

import importlib
import struct
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "bl_ext.user_default.drgs"


def part(name: str):
    """A module of the installed extension."""
    return importlib.import_module(f"{PACKAGE}.{name}")


def sphere(rings: int = 8, segments: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and outward triangles (m, 3) of a unit sphere."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1]
    azimuth = np.arange(segments) * 2 * np.pi / segments
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    body = np.stack((np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)), axis=-1).reshape(-1, 3)
    vertices = np.vstack((body, [[0, 0, 1], [0, 0, -1]]))
    north, south = len(vertices) - 2, len(vertices) - 1
    faces = []
    for s in range(segments):
        t = (s + 1) % segments
        faces.append((north, s, t))
        faces.append((south, (rings - 2) * segments + t, (rings - 2) * segments + s))
        for r in range(rings - 2):
            i, j = r * segments, (r + 1) * segments
            faces += [(i + s, j + s, j + t), (i + s, j + t, i + t)]
    return vertices.astype(np.float32), np.array(faces, np.int32)


def asset_of(vertices: np.ndarray, faces: np.ndarray, environment: np.ndarray | None = None):
    """An asset with one flat surfel on every face and materials that vary over the mesh."""
    model = part("drgs_blender.core.asset")
    n, m = len(vertices), len(faces)
    unit = np.linspace(0, 1, n, dtype=np.float32)
    mesh = model.Mesh(
        vertices,
        faces,
        np.stack((0.2 + 0.6 * unit, 0.8 - 0.6 * unit, np.full(n, 0.4)), 1),
        0.3 + 0.4 * unit,
        0.5 * unit,
    )
    corners = vertices[faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # The shortest turn from +Z to the normal, as a quaternion.
    turn = np.column_stack((1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(m)))
    turn[turn[:, 0] < 1e-6] = (0, 1, 0, 0)
    surfels = model.Surfels(
        centre=corners.mean(1),
        scale=np.repeat(0.7 * np.sqrt(area)[:, None], 2, 1),
        rotation=turn / np.linalg.norm(turn, axis=1, keepdims=True),
        opacity=np.full(m, 0.95),
        albedo=mesh.albedo[faces].mean(1),
        roughness=mesh.roughness[faces].mean(1),
        metallic=mesh.metallic[faces].mean(1),
    )
    binding = model.Binding(np.arange(m), np.full((m, 3), 1 / 3), np.zeros(m), np.tile((0, 0, 1), (m, 1)))
    light = None if environment is None else model.Environment(environment)
    return model.Asset(surfels, mesh, binding, light)


def import_surfels_alone(folder):
    """An object of the ball's surfels, without a mesh, whose file is in a folder."""
    container, model = (part(f"drgs_blender.core.asset.{name}") for name in ("container", "model"))
    path = folder / "cloud.drgs"
    container.write_asset(path, model.Asset(asset_of(*sphere()).surfels, model.Mesh.empty()))
    bpy.ops.import_scene.drgs(filepath=str(path))
    return bpy.context.object


def write_ball(path: Path, environment: np.ndarray | None = None) -> Path:
    """Write the sphere as an asset."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part("drgs_blender.core.asset.container").write_asset(path, asset_of(*sphere(), environment))
    return path


def read_exr(path: str | Path, width: int, height: int) -> np.ndarray:
    """(h, w, 4) float32 of a one-layer EXR, row 0 at the top."""
    image = bpy.data.images.load(str(path))
    assert tuple(image.size) == (width, height)
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1].copy()


def write_exr(path: str | Path, pixels: np.ndarray) -> None:
    """Write (h, w, 3) float32 as an uncompressed EXR; what Blender itself writes depends on its version's views."""
    height, width, _ = pixels.shape

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    channels = b"".join(c + b"\0" + struct.pack("<iB3xii", 2, 0, 1, 1) for c in (b"B", b"G", b"R")) + b"\0"
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    header += attribute("channels", "chlist", channels) + attribute("compression", "compression", b"\0")
    header += attribute("dataWindow", "box2i", box) + attribute("displayWindow", "box2i", box)
    header += attribute("lineOrder", "lineOrder", b"\0")
    header += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    header += attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0))
    header += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    line = 8 + 12 * width
    offsets = len(header) + 8 * height + line * np.arange(height, dtype="<u8")
    rows = (struct.pack("<ii", y, 12 * width) + pixels[y, :, ::-1].T.astype("<f4").tobytes() for y in range(height))
    Path(path).write_bytes(header + offsets.tobytes() + b"".join(rows))


def mesh_object(name: str, vertices, faces) -> bpy.types.Object:
    """A plain mesh object in the scene."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, v)) for v in vertices], [], [tuple(map(int, f)) for f in faces])
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def armature_object(bones: dict[str, tuple]) -> bpy.types.Object:
    """An armature of unconnected bones, name -> (head, tail)."""
    data = bpy.data.armatures.new("Rig")
    obj = bpy.data.objects.new("Rig", data)
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="EDIT")
    for name, (head, tail) in bones.items():
        bone = data.edit_bones.new(name)
        bone.head, bone.tail = head, tail
    bpy.ops.object.mode_set(mode="OBJECT")
    return obj


def shine_as_position(wall: bpy.types.Object, offset: float) -> None:
    """Give a wall a material that shines as its position; `offset` is added, because light is not negative."""
    material = bpy.data.materials.new("Position")
    if material.node_tree is None:
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    place, moved = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeVectorMath")
    shine, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    moved.inputs[1].default_value = (offset,) * 3
    links.new(place.outputs["Position"], moved.inputs[0])
    links.new(moved.outputs[0], shine.inputs["Color"])
    links.new(shine.outputs[0], output.inputs["Surface"])
    wall.data.materials.append(material)


def select(*objects: bpy.types.Object) -> None:
    """Select exactly these; the last one is active."""
    for obj in bpy.context.scene.objects:
        obj.select_set(obj in objects)
    bpy.context.view_layer.objects.active = objects[-1]


def new_world(scene: bpy.types.Scene) -> tuple[bpy.types.NodeTree, bpy.types.Node]:
    """A World with the default nodes; returns its tree and Background node."""
    world = bpy.data.worlds.new("World")
    if world.node_tree is None:
        world.use_nodes = True
    scene.world = world
    tree = world.node_tree
    return tree, next(n for n in tree.nodes if n.type == "BACKGROUND")
