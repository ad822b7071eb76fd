"""DR-GS objects that emit and let light pass, by what is painted on them, as Cycles shows the same attributes."""

from __future__ import annotations

import bpy
import numpy as np
import parity
import pytest
from scenes import mesh_object, part, select
from test_materials import material


def paint(obj: bpy.types.Object, channel: str, values: np.ndarray) -> None:
    """Have an attribute as the Paint operator makes it."""
    select(obj)
    bpy.ops.drgs.paint(channel=channel)
    bpy.ops.object.mode_set(mode="OBJECT")
    part("addon.mesh_arrays").write_channel(obj.data, channel, values)
    part("addon.viewport_material").update_viewport_material(obj.data)


@pytest.mark.slow
@pytest.mark.parametrize("channels", [("emission",), ("emission", "opacity")], ids=str)
def test_what_is_painted_looks_as_in_cycles(scene, ball, channels):
    wall = mesh_object("Wall", [(-3, 2, -1), (3, 2, -1), (3, 2, 3), (-3, 2, 3)], [(0, 1, 2, 3)])
    floor = mesh_object("Floor", [(-3, -3, -1), (3, -3, -1), (3, 2, -1), (-3, 2, -1)], [(0, 1, 2, 3)])
    for obj, colour in ((wall, (0.7, 0.2, 0.2, 1)), (floor, (0.6, 0.6, 0.6, 1))):
        _, principled = material(obj.name)
        principled.inputs["Base Color"].default_value = colour
        obj.data.materials.append(bpy.data.materials[obj.name])
    places = np.array([v.co for v in ball.data.vertices], np.float32)
    glow = np.clip(places[:, 2:] * 3, 0, None) * np.float32([3, 1.5, 0.5])
    paint(ball, "emission", glow)
    if "opacity" in channels:
        paint(ball, "opacity", np.clip(0.5 + 0.45 * places[:, 0] / np.abs(places).max(), 0, 1).astype(np.float32))
    scene.camera.location, scene.camera.rotation_euler = (0, -7, 1.2), (np.pi / 2 - 0.1, 0, 0)
    scene.camera.data.angle = 0.6
    parity.light(scene)
    parity.set_up(scene, 96, samples=256, bounces=2, subpixels=64)
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    assert parity.psnr(ours, theirs) > 40


@pytest.mark.slow
@pytest.mark.parametrize("sees", ["mesh", "surfels"])
def test_painted_specular_and_coat_look_as_in_cycles(scene, ball, sees):
    """A ball half of which is varnished and of which another half reflects nothing, on a floor that shows it.

    Surfels, which blur, have the lobes of their mesh: they are as far from Cycles as without.
    """
    floor = mesh_object("Floor", [(-3, -3, -1), (3, -3, -1), (3, 3, -1), (-3, 3, -1)], [(0, 1, 2, 3)])
    _, principled = material(floor.name)
    principled.inputs["Roughness"].default_value = 0.1
    floor.data.materials.append(bpy.data.materials[floor.name])
    scene.camera.location, scene.camera.rotation_euler = (0, -5, 0.6), (np.pi / 2 - 0.1, 0, 0)
    parity.light(scene)
    parity.set_up(scene, 64, samples=1024 if sees == "surfels" else 256, bounces=2, subpixels=64)
    scene.drgs.camera_sees = sees
    limit = 40.0
    if sees == "surfels":
        limit = parity.psnr(parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")) - 1
    places = np.array([v.co for v in ball.data.vertices], np.float32)
    paint(ball, "coat", np.clip(0.5 + 2 * places[:, 0], 0, 1).astype(np.float32))
    paint(ball, "specular", np.clip(0.5 + 1.5 * places[:, 2], 0, 1).astype(np.float32))
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    print("PSNR", sees, limit, parity.psnr(ours, theirs))
    assert parity.psnr(ours, theirs) > limit
