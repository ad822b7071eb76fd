"""Builds the demo's .blend inside Blender, with the operators an artist would click.

    .venv-blender/bin/python examples/demo_scene.py EXTENSION.zip SCENE.blend

Four objects that were reconstructed from photographs, with their materials separated from the light of that day: a
robot dances on a skeleton, a cow is jelly that sways, a cat is painted gold, a fern stands behind them. The sun goes
from noon to evening over 24 frames, and a lamp of Blender's is switched on.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
from blender_scenes import (
    add_camera,
    add_material,
    add_mesh,
    add_world,
    environment,
    import_drgs,
    install,
    select,
    stand,
    turned,
)
from demo_shots import FRAMES

#: Reconstructed from photographs, see `make_captured.py`.
CAPTURED = Path(__file__).resolve().parent / "captured"
SIZE = 640, 360
#: One of Blender's own: soft light from above, which fills the sun's shadows.
WORLD = "courtyard.exr"
#: Degrees above the horizon, azimuth, W/m2 and colour of the sun, and strength and colour of the sky.
NOON = (54.0, -52.0, 2.9, (1.0, 0.95, 0.88), 0.42, (1.0, 1.0, 1.0))
EVENING = (11.0, 40.0, 1.5, (1.0, 0.42, 0.16), 0.13, (0.5, 0.68, 1.0))
#: Frame at which the lamp goes on.
DUSK = 15
#: Where the cat and the lamp stand.
CAT, LAMP = Vector((1.27, 0.2, 0.0)), Vector((0.72, -0.45, 0.0))
#: Bones of the robot in the space of its asset: parent, head and tail; feet stay where they are.
BONES: dict[str, tuple[str | None, tuple[float, float, float], tuple[float, float, float]]] = {
    "hips": (None, (0.0, 0.08, -0.36), (0.0, 0.08, -0.2)),
    "torso": ("hips", (0.0, 0.08, -0.2), (0.0, 0.08, 0.1)),
    "head": ("torso", (0.0, 0.08, 0.1), (-0.05, 0.1, 0.8)),
    "upper arm.L": ("torso", (0.25, 0.14, 0.03), (0.46, 0.12, 0.03)),
    "forearm.L": ("upper arm.L", (0.46, 0.12, 0.03), (0.72, 0.2, -0.5)),
    "upper arm.R": ("torso", (-0.4, 0.12, 0.04), (-0.53, 0.12, -0.1)),
    "forearm.R": ("upper arm.R", (-0.53, 0.12, -0.1), (-0.66, 0.16, -0.55)),
    **{
        f"{name}.{side}": (parent and parent.replace("*", side), (x, *head), (x, *tail))
        for side, x in (("L", 0.24), ("R", -0.22))
        for name, parent, head, tail in (
            ("thigh", "hips", (0.12, -0.32), (0.1, -0.5)),
            ("shin", "thigh.*", (0.1, -0.5), (0.12, -0.74)),
            ("foot", None, (0.12, -0.74), (-0.02, -0.82)),
        )
    },
}
#: Turns of bones in degrees about axes of the asset: how far at most, and the part of a beat by which they lag.
DANCE = {
    "hips": ((6, 0.0), (0, 0), (10, 0.0)), "torso": ((5, 0.25), (9, 0.0), (0, 0)),
    "head": ((8, 0.3), (16, 0.12), (12, 0.1)),
    "upper arm.L": ((0, 0), (28, 0.5), (0, 0)), "forearm.L": ((18, 0.6), (30, 0.62), (0, 0)),
    "upper arm.R": ((0, 0), (28, 0.0), (0, 0)), "forearm.R": ((18, 0.1), (30, 0.12), (0, 0)),
}  # fmt: skip


def add_robot(
    height: float, at: Vector, turn: float, frames: int = FRAMES, beat: int = FRAMES // 2
) -> bpy.types.Object:
    """The robot on a skeleton of its own, with automatic weights, dances; a beat has so many frames."""
    robot = import_drgs(CAPTURED / "robot.drgs")
    stand(robot, height, at, turn)
    data = bpy.data.armatures.new("Skeleton")
    rig = bpy.data.objects.new("Skeleton", data)
    bpy.context.collection.objects.link(rig)
    rig.matrix_world = robot.matrix_world
    select(rig)
    bpy.ops.object.mode_set(mode="EDIT")
    for name, (parent, head, tail) in BONES.items():
        bone = data.edit_bones.new(name)
        bone.head, bone.tail = head, tail
        bone.parent = data.edit_bones[parent] if parent else None
    bpy.ops.object.mode_set(mode="OBJECT")
    select(rig, robot)
    bpy.ops.drgs.bind_to_armature()
    # The brows hang on nothing: heat does not reach them, and what is nearest need not be the head.
    above = [v.index for v in robot.data.vertices if v.co.z > 0.2]
    for group in robot.vertex_groups:
        if group.name == "head":
            group.add(above, 1.0, "REPLACE")
        else:
            group.remove(above)
    for side in "LR":
        follow = rig.pose.bones[f"shin.{side}"].constraints.new("IK")
        follow.target, follow.subtarget, follow.chain_count = rig, f"foot.{side}", 2
    for frame in range(1, frames + 1):
        phase = 2 * math.pi * (frame - 1) / beat
        for name, turns in DANCE.items():
            bone = rig.pose.bones[name]
            angles = [math.radians(most * math.sin(phase - 2 * math.pi * lag)) for most, lag in turns]
            turned = Euler(angles).to_matrix()
            to_bone = bone.bone.matrix_local.to_3x3()
            bone.rotation_quaternion = (to_bone.inverted() @ turned @ to_bone).to_quaternion()
            bone.keyframe_insert("rotation_quaternion", frame=frame)
        hips = rig.pose.bones["hips"]
        sway = Vector((0.05 * math.sin(phase), 0.0, -0.035 - 0.035 * math.cos(2 * phase)))
        hips.location = hips.bone.matrix_local.to_3x3().inverted() @ sway
        hips.keyframe_insert("location", frame=frame)
    return robot


def add_cow(height: float, at: Vector, turn: float, frames: int = FRAMES) -> bpy.types.Object:
    """The cow is jelly, held at its hooves and pushed; particles carry it."""
    cow = import_drgs(CAPTURED / "spot.drgs")
    stand(cow, height, at, turn)
    heights = [(cow.matrix_world @ vertex.co).z for vertex in cow.data.vertices]
    cow.vertex_groups.new(name="hooves").add([i for i, z in enumerate(heights) if z < 0.07], 1.0, "REPLACE")
    physics = cow.drgs.physics
    physics.use = True
    physics.material, physics.youngs_modulus, physics.resolution = "jelly", 2.0e5, 28
    physics.pin_group, physics.velocity, physics.damping = "hooves", (1.5, 0.0, 0.5), 0.4
    physics.use_floor, physics.floor = True, 0.0
    physics.frame_start, physics.frame_end = 1, frames
    select(cow)
    bpy.ops.drgs.bake_physics()
    return cow


def add_stage() -> None:
    """A sheet that curves up behind everything, and a plinth for the cat."""
    depth, bend = 3.2, 2.0
    curve = [(-12.0, 0.0), (depth, 0.0)]
    curve += [(depth + bend * math.sin(a), bend * (1 - math.cos(a))) for a in np.linspace(0, math.pi / 2, 17)[1:]]
    curve.append((depth + bend, 9.0))
    vertices = np.array([(x, y, z) for y, z in curve for x in (-14.0, 14.0)])
    faces = [[2 * k, 2 * k + 1, 2 * k + 3, 2 * k + 2] for k in range(len(curve) - 1)]
    add_mesh("Sheet", vertices, faces, add_material("Paper", (0.62, 0.58, 0.53), roughness=0.7))
    profile = [(0.0, 0.3), (0.31, 0.3), (0.33, 0.28), (0.33, 0.03), (0.36, 0.0)]
    plinth = add_mesh("Plinth", *turned(profile[::-1]), add_material("Stone", (0.09, 0.1, 0.12), roughness=0.25))
    plinth.location = CAT


def add_lamp(at: Vector, dusk: int = DUSK) -> None:
    """A lamp of Blender's: a stem, and a ball of glass that begins to glow at the frame `dusk`."""
    stem = [(0.16, 0.0), (0.16, 0.02), (0.02, 0.04), (0.015, 0.62), (0.05, 0.64), (0.0, 0.64)]
    add_mesh(
        "Stem", *turned(stem), add_material("Brass", (0.8, 0.55, 0.25), metallic=1.0, roughness=0.25)
    ).location = at
    glow = add_material("Bulb", (0.9, 0.9, 0.88), roughness=0.15)
    shader = glow.node_tree.nodes["Principled BSDF"]
    shader.inputs["Emission Color"].default_value = (1.0, 0.62, 0.3, 1)
    strength = shader.inputs["Emission Strength"]
    for frame, value in ((dusk - 3, 0.0), (dusk + 2, 14.0)):
        strength.default_value = value
        strength.keyframe_insert("default_value", frame=frame)
    angles = np.linspace(0, math.pi, 25)
    ball = [(0.13 * math.sin(a), -0.13 * math.cos(a)) for a in angles]
    add_mesh("Bulb", *turned(ball), glow).location = at + Vector((0, 0, 0.75))


def add_day(first: int = 1, last: int = FRAMES, evening: tuple = EVENING) -> None:
    """The sun and the sky, from noon at the frame `first` to evening at `last`."""
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.angle = math.radians(2.5)
    bpy.context.collection.objects.link(sun)
    world = add_world()
    nodes, links = world.node_tree.nodes, world.node_tree.links
    image, tint = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMix")
    tint.data_type, tint.blend_type = "RGBA", "MULTIPLY"
    tint.inputs["Factor"].default_value = 1.0
    image.image = environment(WORLD)
    links.new(image.outputs["Color"], tint.inputs[6])
    links.new(tint.outputs[2], nodes["Background"].inputs["Color"])
    for frame in range(first, last + 1):
        part = (frame - first) / (last - first)
        part = part * part * (3 - 2 * part)
        height, azimuth, power, colour, sky, sky_colour = (mix(a, b, part) for a, b in zip(NOON, evening))
        sun.rotation_euler = (math.radians(90 - height), 0, math.radians(azimuth))
        sun.data.energy, sun.data.color = power, colour
        tint.inputs[7].default_value = (*sky_colour, 1)
        nodes["Background"].inputs["Strength"].default_value = sky
        sun.keyframe_insert("rotation_euler", frame=frame)
        sun.data.keyframe_insert("energy", frame=frame)
        sun.data.keyframe_insert("color", frame=frame)
        tint.inputs[7].keyframe_insert("default_value", frame=frame)
        nodes["Background"].inputs["Strength"].keyframe_insert("default_value", frame=frame)


def mix(a: float | Sequence[float], b: float | Sequence[float], part: float) -> float | tuple[float, ...]:
    """`a` and `b` blended, numbers or colours."""
    if isinstance(a, Sequence) and isinstance(b, Sequence):
        return tuple((1 - part) * x + part * y for x, y in zip(a, b))
    return (1 - part) * a + part * b


def add_all(frames: int = FRAMES, beat: int = FRAMES // 2) -> dict[str, bpy.types.Object]:
    """Stage and objects; they move for so many frames."""
    add_stage()
    robot = add_robot(1.5, Vector((-0.05, 0.35, 0.0)), math.radians(8), frames, beat)
    cat = import_drgs(CAPTURED / "cat.drgs")
    stand(cat, 0.95, CAT + Vector((0, 0, 0.3)), math.radians(-25))
    fern = import_drgs(CAPTURED / "fern.drgs")
    stand(fern, 0.75, Vector((-1.5, 1.25, 0.0)), math.radians(20))
    cow = add_cow(0.8, Vector((-1.2, -0.3, 0.0)), math.radians(-40), frames)
    return {"robot": robot, "cat": cat, "fern": fern, "cow": cow}


def begin(zip_path: Path, blend: Path, frames: int = FRAMES) -> None:
    """An empty scene for the engine, in the file `blend`: caches lie beside it."""
    install(zip_path)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, frames
    scene.render.engine = "DRGS"
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))


def main(zip_path: Path, blend: Path) -> None:
    begin(zip_path, blend)
    select(add_all()["cat"])
    bpy.ops.drgs.set_material(preset="GOLD")
    add_lamp(LAMP)
    add_day()
    add_camera(Vector((-0.08, 0.2, 0.66)), Vector((0.5, -6.5, 1.45)), 64.0)
    scene = bpy.context.scene
    scene.drgs.samples, scene.drgs.subpixel_samples = 24, 4
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))


if __name__ == "__main__":
    main(*(Path(argument).resolve() for argument in sys.argv[-2:]))
