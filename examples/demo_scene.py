"""Builds the demo's .blend inside Blender, with the operators an artist would click.

    .venv-blender/bin/python examples/demo_scene.py EXTENSION.zip ASSET_FOLDER SCENE.blend

A robot with its skeleton, dance and facial shape keys; a flight helmet that turns; a captured toy; an HDRI of
Blender's own that turns once around them in 24 frames.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
from mathutils import Vector

EXAMPLES = Path(__file__).resolve().parent
FRAMES = 24
SIZE = 480
#: One of Blender's own, of which the camera sees nothing that is blown out: edges before it would be jagged.
WORLD = "forest.exr"


def install(zip_path: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=str(zip_path), repo="user_default", enable_on_install=True)


def import_drgs(path: Path) -> bpy.types.Object:
    bpy.ops.import_scene.drgs(filepath=str(path))
    return bpy.context.view_layer.objects.active


def add_robot(assets: Path) -> bpy.types.Object:
    """The robot: Blender's importer brings the rig, DR-GS the relightable object; binding joins them."""
    bpy.ops.import_scene.gltf(filepath=str(EXAMPLES / "robot" / "RobotExpressive.glb"))
    rig = next(o for o in bpy.context.selected_objects if o.type == "ARMATURE")
    sources = [o for o in rig.children_recursive if o.type == "MESH"]
    robot = import_drgs(assets / "robot.drgs")
    bpy.ops.object.select_all(action="DESELECT")
    for source in sources:
        source.select_set(True)
    robot.select_set(True)
    bpy.context.view_layer.objects.active = robot
    bpy.ops.drgs.bind_to_rig()
    put_rigid_parts_back(robot, rig)
    for source in sources:
        bpy.data.objects.remove(source)
    # Materials are attributes like any other: this robot gets a coat of metallic paint.
    count = len(robot.data.vertices)
    for name, value in (("metallic", 0.85), ("roughness", 0.28)):
        robot.data.attributes[name].data.foreach_set("value", [value] * count)
    rig.animation_data.action = next(a for a in bpy.data.actions if a.name.startswith("Dance"))
    for track in rig.animation_data.nla_tracks:
        track.mute = True
    keys = robot.data.shape_keys
    if keys:
        surprised = keys.key_blocks.get("Surprised") or keys.key_blocks[-1]
        for frame, value in ((1, 0.0), (12, 1.0), (FRAMES, 0.0)):
            surprised.value = value
            surprised.keyframe_insert("value", frame=frame)
    return robot


def put_rigid_parts_back(robot: bpy.types.Object, rig: bpy.types.Object) -> None:
    """Move the robot's rigid parts to where their file has them.

    The armature is scaled by 100, and Blender's glTF importer then sets objects that hang on bones one bone too low.
    The parts are vertex groups by now: moving vertices is an edit like any other, the surfels follow.
    """
    scale = rig.matrix_world.to_scale().y
    to_robot = robot.matrix_world.inverted().to_3x3() @ rig.matrix_world.to_3x3()
    moves = {}
    parts = [c for c in rig.children if any(o.type == "MESH" for o in (c, *c.children_recursive))]
    for name in {part.parent_bone for part in parts if part.parent_type == "BONE"}:
        bone, group = rig.data.bones[name], robot.vertex_groups.get(name)
        if group:
            moves[group.index] = to_robot @ bone.matrix_local.to_3x3() @ Vector((0, bone.length * (scale - 1), 0))
    keys = robot.data.shape_keys
    shapes = [robot.data.vertices, *([block.data for block in keys.key_blocks] if keys else [])]
    for vertex in robot.data.vertices:
        move = next((moves[g.group] for g in vertex.groups if g.group in moves and g.weight > 0.99), None)
        if move:
            for points in shapes:
                points[vertex.index].co += move


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


def add_turning_world(name: str) -> None:
    scene = bpy.context.scene
    world = bpy.data.worlds.new("World")
    scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    image, mapping = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
    coordinate = nodes.new("ShaderNodeTexCoord")
    folder = Path(bpy.utils.system_resource("DATAFILES")) / "studiolights" / "world"
    image.image = bpy.data.images.load(str(folder / name))
    links.new(coordinate.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], image.inputs["Vector"])
    links.new(image.outputs["Color"], nodes["Background"].inputs["Color"])
    rotation = mapping.inputs["Rotation"]
    for frame, degrees in ((1, 0), (FRAMES + 1, 360)):
        rotation.default_value = (0, 0, math.radians(degrees))
        rotation.keyframe_insert("default_value", index=2, frame=frame)


def add_camera(target: Vector, distance: float, height: float = 0.28) -> None:
    data = bpy.data.cameras.new("Camera")
    data.lens = 50
    camera = bpy.data.objects.new("Camera", data)
    bpy.context.collection.objects.link(camera)
    direction = Vector((0.25, -1.0, height)).normalized()
    camera.location = target + direction * distance
    camera.rotation_euler = direction.to_track_quat("Z", "Y").to_euler()
    bpy.context.scene.camera = camera


def main(zip_path: Path, assets: Path, blend: Path) -> None:
    install(zip_path)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    add_robot(assets)
    helmet = import_drgs(assets / "helmet.drgs")
    stand(helmet, 3.2, Vector((4.3, 0.5, 0.0)))
    for frame, degrees in ((1, -30), (FRAMES, 60)):
        helmet.rotation_euler = (0, 0, math.radians(degrees))
        helmet.keyframe_insert("rotation_euler", frame=frame)
    stand(import_drgs(assets / "playbot.drgs"), 2.4, Vector((-4.4, 0.8, 0.0)), math.radians(-15))
    add_turning_world(WORLD)
    add_camera(Vector((0.25, 0.0, 1.9)), 16.5)
    scene.render.engine = "DRGS"
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.drgs.subpixel_samples = 8
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))


if __name__ == "__main__":
    main(*(Path(argument).resolve() for argument in sys.argv[-3:]))
