"""The shadow terminator of coarse smooth meshes: exported, and softened as in Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from parity import pictures, psnr, set_up
from scenes import mesh_object, new_world, sphere
from test_panorama import _paint

pytestmark = pytest.mark.blender_api


def holder(obj: bpy.types.Object) -> bpy.types.bpy_struct:
    """Whose property the offset is."""
    return obj if hasattr(obj, "shadow_terminator_geometry_offset") else obj.cycles


def coarse(scene, kind):
    """A coarse mesh that is shaded smooth."""
    if kind == "ball":
        obj = mesh_object("ball", *sphere(10, 16))
    else:
        bpy.ops.mesh.primitive_monkey_add()
        obj = bpy.context.object
        obj.rotation_euler = (0.2, 0, 0.4)
    for polygon in obj.data.polygons:
        polygon.use_smooth = True
    _paint(obj, (0.8, 0.7, 0.6, 1), 0.3, 0.0)
    set_up(scene, 96, 64)
    holder(obj).shadow_terminator_geometry_offset = 0.1
    scene.camera.data.lens = 80
    return obj


def light(scene, kind):
    tree, background = new_world(scene)
    background.inputs["Color"].default_value = (0, 0, 0, 1)
    if kind == "picture":
        image = bpy.data.images.new("window", 64, 32, float_buffer=True)
        pixels = np.full((32, 64, 4), 0.15, np.float32)
        pixels[20:25, 6:12] = (40, 36, 30, 1)
        image.pixels.foreach_set(pixels.ravel())
        node = tree.nodes.new("ShaderNodeTexEnvironment")
        node.image = image
        tree.links.new(node.outputs[0], background.inputs["Color"])
        return
    lamp = bpy.data.objects.new(kind, bpy.data.lights.new(kind, kind))
    if kind == "SUN":
        lamp.data.energy, lamp.data.angle, lamp.rotation_euler = 3.0, 0.009, (0.9, 0.5, -0.6)
    else:
        lamp.data.energy, lamp.data.shadow_soft_size, lamp.location = 400, 0.1, (3, -1.5, 2.5)
    scene.collection.objects.link(lamp)


def test_offsets_are_exported(scene, ball, export):
    obj = coarse(scene, "ball")
    frame, warnings = export()
    assert [mesh.terminator_offset for mesh in frame.meshes] == [pytest.approx(0.1)] and not warnings
    assert frame.objects[0].terminator_offset == pytest.approx(holder(ball).shadow_terminator_geometry_offset)
    holder(obj).shadow_terminator_geometry_offset = 0.5
    name = "shadow_terminator_shading_offset"
    setattr(holder(obj), name if hasattr(holder(obj), name) else "shadow_terminator_offset", 0.2)
    frame, warnings = export()
    assert frame.meshes[0].terminator_offset == 0.5
    assert any("Shading Offset is not rendered" in text and obj.name in text for text in warnings)


LEAST = {
    ("ball", "SUN"): 60, ("ball", "POINT"): 55, ("ball", "picture"): 50,
    ("suzanne", "SUN"): 40, ("suzanne", "POINT"): 45, ("suzanne", "picture"): 41,
}  # fmt: skip


@pytest.mark.judged
@pytest.mark.slow
@pytest.mark.parametrize(("kind", "lamp"), LEAST)
def test_pictures_are_those_of_cycles(scene, kind, lamp):
    obj = coarse(scene, kind)
    light(scene, lamp)
    ours, theirs = pictures(scene, "DRGS"), pictures(scene, "CYCLES")
    holder(obj).shadow_terminator_geometry_offset = 0.0
    faceted = pictures(scene, "DRGS")
    found, without = psnr(ours, theirs), psnr(faceted, theirs)
    print(f"{kind}, {lamp}: {found:.1f} dB, without the offset {without:.1f}")
    assert found > LEAST[kind, lamp] and found > without + 6
