"""Builds and bakes the two shots of the matter demo inside Blender, with the operators an artist would click.

    .venv-blender/bin/python examples/demo_simulation_scene.py EXTENSION.zip ASSET_FOLDER

Writes droop.blend (a cow of soft and one of firm jelly, held at its hooves, under an HDRI that turns) and fall.blend
(a cat of sand, one of metal and one of jelly that fall into dishes) beside the assets, their caches next to them.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
from blender_scenes import add_camera, add_material, add_mesh, add_turning_world, import_drgs, install, stand
from demo_shots import SIMULATED as FRAMES

#: Young's moduli of the two cows, Pa.
SOFT, FIRM = 2e5, 8e5


def add_ground(grey: float = 0.25) -> bpy.types.Object:
    corners = np.array([[-40, -40, 0], [40, -40, 0], [40, 40, 0], [-40, 40, 0]], float)
    return add_mesh("Ground", corners, [[0, 1, 2, 3]], add_material("Ground", (grey,) * 3, roughness=0.6))


def add_dishes(
    centres: Sequence[float], radius: float = 1.5, depth: float = 0.4, wall: float = 0.16
) -> bpy.types.Object:
    """One mesh of round dishes that stand on the ground, their middles at `centres` along x."""
    turn, around = np.linspace(0, np.pi / 2, 13), 64
    inner = np.stack([radius * np.sin(turn), wall + depth * (1 - np.cos(turn))], -1)
    rim, outside = [[radius + wall, wall + depth]], [[radius + wall, 0.0], [0.0, 0.0]]
    profile = np.concatenate([inner, rim, outside])
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    vertices, faces = [], []
    for centre in centres:
        start = sum(map(len, vertices))
        middle = profile[1:-1]
        circles = np.concatenate([np.c_[r * ring + [centre, 0], np.full(around, z)] for r, z in middle])
        vertices.append(np.concatenate([circles, [[centre, 0, profile[0, 1]], [centre, 0, 0]]]))
        low, high = start + len(circles), start + len(circles) + 1
        for k in range(around):
            n = (k + 1) % around
            faces.append([low, start + k, start + n])
            for c in range(len(middle) - 1):
                a, b = start + c * around, start + (c + 1) * around
                faces.append([a + k, b + k, b + n, a + n])
            last = start + (len(middle) - 1) * around
            faces.append([last + k, high, last + n])
    return add_mesh("Dishes", np.concatenate(vertices), faces, add_material("Dishes", (0.35,) * 3, roughness=0.6))


def seen_from(target: Vector, distance: float, height: float = 0.28) -> tuple[Vector, Vector]:
    """What a camera looks at, and where it stands."""
    return target, target + Vector((0.25, -1.0, height)).normalized() * distance


def paint(obj: bpy.types.Object, colour: Sequence[float] | None = None, **values: float) -> None:
    """Give an asset a colour and numbers all over: materials are attributes of its vertices like any other."""
    count = len(obj.data.vertices)
    if colour is not None:
        albedo = obj.data.attributes["albedo"]
        albedo.data.foreach_set("color", np.tile([*colour, 1.0], count))
    for name, value in values.items():
        obj.data.attributes[name].data.foreach_set("value", [value] * count)


def bake(obj: bpy.types.Object, material: str, collider: bpy.types.Object | None = None, **numbers: object) -> None:
    physics = obj.drgs.physics
    physics.use, physics.material, physics.frame_end = True, material, FRAMES
    for name, value in numbers.items():
        setattr(physics, name, value)
    bpy.context.view_layer.objects.active = obj
    if collider is not None:
        bpy.ops.drgs.physics_row(rows="colliders")
        physics.colliders[0].object = collider
    bpy.ops.drgs.bake_physics()


def start(blend: Path) -> None:
    """An empty scene with the extension, saved, as caches lie beside the file."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    scene.render.engine = "DRGS"
    scene.render.resolution_x, scene.render.resolution_y = 480, 270
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))


def droop(assets: Path) -> None:
    """Two cows, alike but for their stiffness."""
    start(assets / "droop.blend")
    add_ground()
    for name, x, youngs_modulus in (("soft", -1.35, SOFT), ("firm", 1.35, FIRM)):
        cow = import_drgs(assets / "cow.drgs")
        cow.name = name
        stand(cow, 1.8, Vector((x, 0, 0)), math.radians(-60))
        paint(cow, roughness=0.25)
        bpy.context.view_layer.update()
        height = np.array([(cow.matrix_world @ v.co).z for v in cow.data.vertices])
        cow.vertex_groups.new(name="hooves").add(np.flatnonzero(height < 0.12).tolist(), 1.0, "REPLACE")
        bake(
            cow, "jelly", youngs_modulus=youngs_modulus, pin_group="hooves", damping=1.5, resolution=32, use_floor=True
        )
    add_turning_world("courtyard.exr", FRAMES)
    add_camera(*seen_from(Vector((0.2, 0, 0.8)), 8.5))
    bpy.ops.wm.save_mainfile()


def fall(assets: Path) -> None:
    """Three cats, alike but for what they are made of."""
    start(assets / "fall.blend")
    add_ground()
    places = (-3.5, 0.0, 3.5)
    dishes = add_dishes(places)
    looks = {
        "sand": {"colour": (0.55, 0.38, 0.2), "roughness": 0.9, "metallic": 0.0},
        "metal": {"colour": (0.8, 0.75, 0.7), "roughness": 0.25, "metallic": 1.0},
        "jelly": {"colour": (0.6, 0.05, 0.08), "roughness": 0.2, "metallic": 0.0},
    }
    for (name, look), x in zip(looks.items(), places):
        more = {"youngs_modulus": 4e5} if name == "jelly" else {}
        cat = import_drgs(assets / "cat.drgs")
        cat.name = name
        stand(cat, 2.2, Vector((x, 0, 0.9)), math.radians(-25))
        paint(cat, **look)
        bake(cat, name, dishes, resolution=32, use_floor=True, **more)
    add_turning_world("courtyard.exr", FRAMES)
    add_camera(*seen_from(Vector((0.4, 0, 0.6)), 15.5, height=0.6))
    bpy.ops.wm.save_mainfile()


def main(zip_path: Path, assets: Path) -> None:
    install(zip_path)
    droop(assets)
    fall(assets)


if __name__ == "__main__":
    main(*(Path(argument).resolve() for argument in sys.argv[-2:]))
