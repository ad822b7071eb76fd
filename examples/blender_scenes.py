"""What the scripts of the demos do in Blender alike: objects on the ground, materials, worlds, a camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector


def install(zip_path: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=str(zip_path), repo="user_default", enable_on_install=True)


def import_drgs(path: Path) -> bpy.types.Object:
    bpy.ops.import_scene.drgs(filepath=str(path))
    return bpy.context.view_layer.objects.active


def select(*objects: bpy.types.Object) -> None:
    """Select objects, the last one active."""
    bpy.ops.object.select_all(action="DESELECT")
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objects[-1]


def stand(subject: bpy.types.Object, height: float, at: Vector, turn: float = 0.0) -> None:
    """Scale `subject` to `height` metres and stand it on the ground at `at`."""
    corners = [Vector(c) for c in subject.bound_box]
    low, high = min(c.z for c in corners), max(c.z for c in corners)
    subject.scale = (height / (high - low),) * 3
    middle = sum(corners, Vector()) / 8
    subject.rotation_euler = (0, 0, turn)
    bpy.context.view_layer.update()
    foot = subject.matrix_world @ Vector((middle.x, middle.y, low))
    subject.location += at - foot
    bpy.context.view_layer.update()


def add_material(name: str, colour: Sequence[float], **values: float) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # before Blender 5.0
        material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1)
    for value, number in values.items():
        shader.inputs[value.replace("_", " ").title()].default_value = number
    return material


def add_mesh(name: str, vertices: np.ndarray, faces: list[list[int]], material: bpy.types.Material) -> bpy.types.Object:
    """An ordinary smooth mesh of Blender's."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces)
    mesh.polygons.foreach_set("use_smooth", [True] * len(mesh.polygons))
    mesh.materials.append(material)
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(obj)
    return obj


def turned(profile: Sequence[tuple[float, float]], around: int = 64) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices and faces of a profile (radius, height) turned about the vertical; on it, a ring is one vertex."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    vertices, rings, count = [], [], 0
    for radius, height in profile:
        points = 1 if radius < 1e-9 else around
        vertices.append(np.c_[radius * circle[:points], np.full(points, height)])
        rings.append([count + k % points for k in range(around + 1)])
        count += points
    faces = []
    for low, high in pairwise(rings):
        corners = ([low[k], low[k + 1], high[k + 1], high[k]] for k in range(around))
        faces += [list(dict.fromkeys(face)) for face in corners]  # three corners beside a pole
    return np.concatenate(vertices), faces


def add_world() -> bpy.types.World:
    """A World with nodes for the scene."""
    world = bpy.data.worlds.new("World")
    bpy.context.scene.world = world
    if world.node_tree is None:  # before Blender 5.0
        world.use_nodes = True
    return world


def environment(name: str) -> bpy.types.Image:
    """One of the environments that Blender brings."""
    folder = Path(bpy.utils.system_resource("DATAFILES")) / "studiolights" / "world"
    return bpy.data.images.load(str(folder / name))


def add_turning_world(name: str, frames: int) -> None:
    """One of Blender's own environments, which turns once."""
    world = add_world()
    nodes, links = world.node_tree.nodes, world.node_tree.links
    image, mapping = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
    coordinate = nodes.new("ShaderNodeTexCoord")
    image.image = environment(name)
    links.new(coordinate.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], image.inputs["Vector"])
    links.new(image.outputs["Color"], nodes["Background"].inputs["Color"])
    rotation = mapping.inputs["Rotation"]
    for frame, degrees in ((1, 0), (frames + 1, 360)):
        rotation.default_value = (0, 0, math.radians(degrees))
        rotation.keyframe_insert("default_value", index=2, frame=frame)


def add_camera(target: Vector, place: Vector, lens: float = 50.0) -> None:
    data = bpy.data.cameras.new("Camera")
    data.lens = lens
    camera = bpy.data.objects.new("Camera", data)
    bpy.context.collection.objects.link(camera)
    camera.location = place
    camera.rotation_euler = (place - target).to_track_quat("Z", "Y").to_euler()
    bpy.context.scene.camera = camera
