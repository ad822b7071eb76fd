"""Filter Glossy against Cycles' setting of the same name: the light that a metal wall throws on the floor."""

from __future__ import annotations

import bpy
import numpy as np
import parity
import pytest
from scenes import mesh_object, new_world
from test_materials import material

pytestmark = [pytest.mark.blender_api, pytest.mark.slow]


def square(name: str, location: tuple, rotation: tuple, **inputs: object) -> None:
    """Of four metres, with a Principled BSDF."""
    obj = mesh_object(name, [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [(0, 1, 2, 3)])
    _, bsdf = material(name)
    for key, value in inputs.items():
        bsdf.inputs[key.replace("_", " ")].default_value = value
    obj.data.materials.append(bpy.data.materials[name])
    obj.location, obj.rotation_euler = location, rotation


@pytest.mark.parametrize("coat", (0.0, 0.2))
def test_caustics_are_filtered_as_by_cycles(scene, coat):
    """With a coat paths are followed one by one, else in batches."""
    square("floor", (0, 0, 0), (0, 0, 0), Base_Color=(0.8, 0.8, 0.8, 1), Roughness=1.0)
    metal = {"Base_Color": (0.9, 0.6, 0.3, 1), "Metallic": 1.0, "Roughness": 0.25, "Coat_Weight": coat}
    square("wall", (0, 1.5, 2), (np.pi / 2, 0, 0), **metal)
    _, background = new_world(scene)
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (1, 1, 1, 1), 0.2
    sun = bpy.data.lights.new("Sun", "SUN")
    sun.energy, sun.angle = 3.0, 0.2
    obj = bpy.data.objects.new("Sun", sun)
    obj.rotation_euler = (0.9, 0, 0)
    scene.collection.objects.link(obj)
    scene.camera.location, scene.camera.rotation_euler = (0, -4, 4), (0.8, 0, 0)
    parity.set_up(scene, 48, samples=512)
    scene.cycles.blur_glossy = 1.0
    theirs = parity.pictures(scene, "CYCLES")
    scene.drgs.filter_glossy = 1.0
    filtered = parity.pictures(scene, "DRGS")
    scene.drgs.filter_glossy = 0.0
    sharp = parity.pictures(scene, "DRGS")
    assert parity.psnr(filtered, theirs) > 42
    assert parity.psnr(sharp, theirs) < 35
