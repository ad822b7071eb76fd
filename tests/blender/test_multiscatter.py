"""Multiscatter GGX, the default distribution of Blender's shaders: rough metals are as bright as in Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from parity import pictures, psnr, set_up
from scenes import mesh_object, new_world, sphere
from test_panorama import _paint

ROUGHNESS, METALLIC = (0.1, 0.3, 0.5, 0.75, 1.0), (0.0, 0.5, 1.0)


def balls(scene) -> None:
    """A smooth ball for each roughness and metallic, in rows."""
    for i, roughness in enumerate(ROUGHNESS):
        for k, metallic in enumerate(METALLIC):
            obj = mesh_object(f"{metallic} {roughness}", *sphere(32, 48))
            obj.data.shade_smooth()
            _paint(obj, (0.9, 0.6, 0.25, 1), roughness, metallic)
            obj.location, obj.scale = (i - 2, 0, k - 1), (0.47, 0.47, 0.47)
            shader = next(n for n in obj.data.materials[0].node_tree.nodes if n.type == "BSDF_PRINCIPLED")
            shader.distribution = "MULTI_GGX"
    set_up(scene, 160, 128, bounces=0, multiscatter=True)
    scene.render.resolution_y = 96
    camera = scene.camera.data
    camera.type, camera.ortho_scale = "ORTHO", 5.0


def light(scene, kind: str) -> None:
    tree, background = new_world(scene)
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1)
    if kind == "picture":
        image = bpy.data.images.new("window", 64, 32, float_buffer=True)
        pixels = np.full((32, 64, 4), 0.3, np.float32)
        pixels[16:26, 4:14] = (8, 7, 6, 1)
        pixels[16:, :, 2] += 0.3
        image.pixels.foreach_set(pixels.ravel())
        node = tree.nodes.new("ShaderNodeTexEnvironment")
        node.image = image
        tree.links.new(node.outputs[0], background.inputs["Color"])
        return
    lamp = bpy.data.objects.new(kind, bpy.data.lights.new(kind, kind))
    if kind == "SUN":
        lamp.data.energy, lamp.data.angle, lamp.rotation_euler = 3.0, 0.2, (0.9, 0.3, -0.6)
    else:
        lamp.data.energy, lamp.data.size, lamp.location = 400, 2.0, (2.0, -4.0, 2.5)
        lamp.rotation_euler = (1.0, 0.0, 0.46)
    scene.collection.objects.link(lamp)


@pytest.mark.judged
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["picture", "SUN", "AREA"])
def test_balls_are_those_of_cycles(scene, export, kind):
    balls(scene)
    light(scene, kind)
    assert not export()[1]
    ours, theirs = pictures(scene, "DRGS"), pictures(scene, "CYCLES")
    inside = (theirs[..., 3] > 0.999).all(axis=0)
    found = {}
    for k, metallic in enumerate(METALLIC):
        for i, roughness in enumerate(ROUGHNESS):
            ball = np.zeros_like(inside)
            ball[(2 - k) * 32 : (3 - k) * 32, i * 32 : (i + 1) * 32] = True
            ball &= inside
            ratio = ours[:, ball, :3].mean() / theirs[:, ball, :3].mean()
            found[metallic, roughness] = psnr(ours, theirs, ball), ratio
    print(kind, "\n".join(f"{key}: {decibels:.1f} dB, {ratio:.4f}" for key, (decibels, ratio) in found.items()))
    assert psnr(ours, theirs, inside) > 45
    assert min(decibels for decibels, _ in found.values()) > 42
    for (_, roughness), (_, ratio) in found.items():
        assert ratio == pytest.approx(1, abs=0.005 if roughness >= 0.5 else 0.03)  # bright dots are noisy


@pytest.mark.blender_api
@pytest.mark.parametrize(("distribution", "expected"), [("GGX", False), ("MULTI_GGX", True)])
def test_only_the_default_distribution_has_it(scene, export, distribution, expected):
    obj = mesh_object("metal", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    _paint(obj, (0.8, 0.8, 0.8, 1), 0.9, 1.0)
    tree = obj.data.materials[0].node_tree
    shader = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
    shader.distribution = distribution
    frame, warnings = export()
    (material,) = frame.meshes[0].materials
    assert material.multiscatter is expected and not material.has_more_lobes and not warnings
