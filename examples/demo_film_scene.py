"""Builds the scenes of the film inside Blender: a robot on a turntable, and the demo's stage with a camera per shot.

    .venv-blender/bin/python examples/demo_film_scene.py EXTENSION.zip FOLDER

Writes turntable.blend and stage.blend.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
import demo_scene
from blender_scenes import add_camera, environment
from demo_shots import CAPTURED, ROUND, SHOTS, TURN

#: Of the shots on the stage: lens, and where the camera stands and looks at begin and end.
CAMERAS = {
    "jelly": (66.0, ((-0.25, -3.6, 0.8), (-0.35, -3.3, 0.78)), ((-1.1, -0.2, 0.42), (-1.1, -0.2, 0.42))),
    "bones": (60.0, ((-0.75, -4.4, 1.05), (0.35, -4.4, 1.05)), ((-0.05, 0.35, 0.78), (-0.05, 0.35, 0.78))),
    "gold": (56.0, ((2.1, -3.1, 1.1), (1.5, -2.9, 1.05)), ((1.2, 0.2, 0.72), (1.2, 0.2, 0.74))),
    "night": (64.0, ((0.5, -6.5, 1.45), (0.35, -6.0, 1.35)), ((-0.08, 0.2, 0.66), (-0.08, 0.2, 0.66))),
}
FRAMES = SHOTS["night"][1]
#: As `demo_scene.EVENING`; the lamp is all the light.
NIGHT = (4.0, 62.0, 0.15, (1.0, 0.35, 0.14), 0.07, (0.35, 0.5, 1.0))
#: Frames of a beat of the dance.
BEAT = 16


def turntable(zip_path: Path, blend: Path) -> None:
    """The camera of a photograph goes once around the robot in the light that was learned; then another turns."""
    demo_scene.begin(zip_path, blend, TURN)
    scene = bpy.context.scene
    scene.render.film_transparent = True
    bpy.ops.import_scene.drgs(filepath=str(demo_scene.CAPTURED / "robot.drgs"), use_environment=True)
    go_around("robot")
    other = environment("sunset.exr")
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    image, mapping = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
    coordinate, mix = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMix")
    image.image, mix.data_type = other, "RGBA"
    background = next(node for node in nodes if node.type == "BACKGROUND")
    links.new(background.inputs["Color"].links[0].from_socket, mix.inputs[6])
    links.new(coordinate.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], image.inputs["Vector"])
    links.new(image.outputs["Color"], mix.inputs[7])
    links.new(mix.outputs[2], background.inputs["Color"])
    factor, rotation = mix.inputs["Factor"], mapping.inputs["Rotation"]
    for frame in range(1, TURN + 1):
        factor.default_value = float(frame > CAPTURED)
        factor.keyframe_insert("default_value", frame=frame)
        part = max(frame - CAPTURED, 0) / (TURN - CAPTURED)
        rotation.default_value = (0, 0, math.radians(120 + 420 * part))
        rotation.keyframe_insert("default_value", index=2, frame=frame)
    scene.drgs.samples, scene.drgs.subpixel_samples = 16, 8
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))


def go_around(name: str) -> None:
    """The camera of an object's photograph goes around it once."""
    view = json.loads((demo_scene.CAPTURED / f"{name}.json").read_text(encoding="utf-8"))
    add_camera(Vector(), Vector((0, -1, 0)))
    camera = bpy.context.scene.camera
    camera.data.sensor_fit, camera.data.angle = "VERTICAL", math.radians(view["fov_x"])  # the photograph is square
    start = Matrix(view["matrix_world"])
    for frame in range(1, TURN + 1):
        part = min((frame - 1) / (ROUND - 1), 1.0)
        turn = Matrix.Rotation(2 * math.pi * part * part * (3 - 2 * part), 4, "Z")
        camera.matrix_world = turn @ start
        camera.rotation_mode = "QUATERNION"
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_quaternion", frame=frame)


def turn_to_gold(subject: bpy.types.Object, first: int, last: int) -> None:
    """Adjust a material ever more between two frames, until it is gold everywhere."""
    changed = subject.drgs.adjustment
    names = ("metallic_low", "roughness_high", "contrast", "brightness", "tint")
    for frame, values in (
        (first, (0.0, 1.0, 0.0, 0.0, (1.0, 1.0, 1.0))),
        (last, (1.0, 0.2, -1.0, 0.5, (1.0, 0.78, 0.34))),  # albedo 1, tinted
    ):
        for name, value in zip(names, values):
            setattr(changed, name, value)
            changed.keyframe_insert(name, frame=frame)


def stage(zip_path: Path, blend: Path) -> None:
    """The demo's objects: the cow sways, the robot dances, the cat turns to gold, night falls."""
    demo_scene.begin(zip_path, blend, FRAMES)
    scene = bpy.context.scene
    cat = demo_scene.add_all(FRAMES, BEAT)["cat"]
    first, last = SHOTS["gold"]
    turn_to_gold(cat, first + 3, last - 3)
    first, last = SHOTS["night"]
    demo_scene.add_lamp(demo_scene.LAMP, first + 18)
    demo_scene.add_day(first, last - 6, NIGHT)
    for name, (lens, places, targets) in CAMERAS.items():
        start, end = SHOTS[name]
        add_camera(Vector(targets[0]), Vector(places[0]), lens)
        camera = scene.camera
        camera.name = name
        for frame, place, target in zip((start, end), places, targets):
            camera.location = place
            camera.rotation_euler = (Vector(place) - Vector(target)).to_track_quat("Z", "Y").to_euler()
            camera.keyframe_insert("location", frame=frame)
            camera.keyframe_insert("rotation_euler", frame=frame)
        scene.timeline_markers.new(name, frame=start).camera = camera
    scene.drgs.samples, scene.drgs.subpixel_samples = 8, 4
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))


if __name__ == "__main__":
    extension, folder = (Path(argument).resolve() for argument in sys.argv[-2:])
    turntable(extension, folder / "turntable.blend")
    stage(extension, folder / "stage.blend")
