"""Surfaces that light may pass: what is exported, and that they hide, shade and shine as in Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import parity
import pytest
from scenes import mesh_object, sphere
from test_materials import A, B, add, material, picture, shaded, swatch, texture_node

pytestmark = pytest.mark.blender_api


def only(frame):
    return frame.meshes[0].materials[0]


@pytest.mark.parametrize("alpha", [0.8, 0.2, 0.0])
@pytest.mark.parametrize("mixed", [False, True])
def test_constant_alpha(scene, export, alpha, mixed):
    tree, principled = material()
    principled.inputs["Base Color"].default_value = (*A, 1)
    principled.inputs["Emission Color"].default_value = (*B, 1)
    principled.inputs["Emission Strength"].default_value = 2
    if mixed:
        shaded(tree, add(tree, "MixShader", alpha, add(tree, "BsdfTransparent"), principled.outputs[0]))
    else:
        principled.inputs["Alpha"].default_value = alpha
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert not warnings and len(frame.meshes) == (alpha > 0)
    if alpha > 0:
        found = only(frame)
        np.testing.assert_allclose((*found.base_colour, *found.emission), (*A, *(2 * b for b in B)), rtol=1e-5)
        assert found.alpha == pytest.approx(alpha) and found.alpha_texture is None


def test_an_image_as_alpha_and_its_negative(scene, export):
    tree, principled = material()
    node = texture_node(tree, picture(alpha=True))
    tree.links.new(node.outputs["Color"], principled.inputs["Base Color"])
    tree.links.new(node.outputs["Alpha"], principled.inputs["Alpha"])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert not warnings and (only(frame).alpha, only(frame).alpha_texture.channel) == (1, "a")
    tree.links.remove(principled.inputs["Alpha"].links[0])
    shaded(tree, add(tree, "MixShader", node.outputs["Alpha"], principled.outputs[0], add(tree, "BsdfTransparent")))
    frame, warnings = export()
    assert not warnings
    sent = next(i for i in frame.images if i.name == only(frame).alpha_texture.image)
    plain = next(i for i in frame.images if i.name == only(frame).base_colour_texture.image)
    np.testing.assert_array_equal(sent.pixels[..., 0], 255 - plain.pixels[..., 3])


def test_layers_of_transparency_multiply(scene, export):
    """Half of what is half there, and half of each of two that are there in other shares."""
    tree, principled = material()
    principled.inputs["Base Color"].default_value, principled.inputs["Alpha"].default_value = (*A, 1), 0.5
    half = add(tree, "MixShader", 0.5, add(tree, "BsdfTransparent"), principled.outputs[0])
    shaded(tree, half)
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert not warnings and only(frame).alpha == pytest.approx(0.25)
    shaded(tree, add(tree, "MixShader", 0.4, half, add(tree, "BsdfDiffuse", B)))
    frame, warnings = export()
    alpha = 0.6 * 0.25 + 0.4
    assert not warnings and only(frame).alpha == pytest.approx(alpha)
    np.testing.assert_allclose(only(frame).base_colour, (0.15 * np.array(A) + 0.4 * np.array(B)) / alpha, rtol=1e-5)


@pytest.mark.parametrize("kind", ["coloured", "glow", "nan"])
def test_what_no_alpha_says_is_named(scene, export, kind):
    tree, principled = material()
    clear = add(tree, "BsdfTransparent", A if kind == "coloured" else None)
    if kind == "glow":
        shaded(tree, add(tree, "AddShader", clear, add(tree, "Emission", A, 1.0)))
    elif kind == "coloured":
        shaded(tree, add(tree, "MixShader", 0.5, clear, principled.outputs[0]))
    else:
        value = add(tree, "Value")
        value.default_value = float("nan")
        tree.links.new(value, principled.inputs["Alpha"])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert len(warnings) == (kind != "nan") and all('Material "Material"' in w for w in warnings)
    expected = {"coloured": 0.5, "glow": 0.25, "nan": 1.0}[kind]
    assert only(frame).alpha == pytest.approx(expected)
    if kind == "glow":
        np.testing.assert_allclose(np.array(only(frame).emission) * 0.25, A, rtol=1e-5)


def leaf(name: str, build, at: tuple, size: float = 1.0) -> bpy.types.Object:
    """A square card that faces -Y, with a material made by `build`."""
    tree, principled = material(name)
    principled.inputs["Roughness"].default_value = 0.6
    build(tree, principled)
    obj = swatch(bpy.data.materials[name])
    obj.data.vertices.foreach_set("co", np.float32([-1, 0, -1, 1, 0, -1, 1, 0, 1, -1, 0, 1]))
    obj.location, obj.scale = at, (size, size, size)
    return obj


def cutout(tree, principled):
    image = bpy.data.images.new("Holes", 32, 32, alpha=True)
    y, x = (np.mgrid[0:32, 0:32] + 0.5) / 32
    pixels = np.ones((32, 32, 4), np.float32)
    pixels[..., 0], pixels[..., 1], pixels[..., 2] = 0.2 + 0.6 * x, 0.5, 0.2
    pixels[..., 3] = np.hypot(x - 0.5, y - 0.5) > 0.3
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    node = add(tree, "TexImage", image=image).node
    tree.links.new(node.outputs["Color"], principled.inputs["Base Color"])
    tree.links.new(node.outputs["Alpha"], principled.inputs["Alpha"])


def veil(colour, alpha, glow=0.0):
    def build(tree, principled):
        principled.inputs["Base Color"].default_value = (*colour, 1)
        principled.inputs["Alpha"].default_value = alpha
        principled.inputs["Emission Color"].default_value = (1, 0.6, 0.3, 1)
        principled.inputs["Emission Strength"].default_value = glow

    return build


def painted_veil(tree, principled):
    node = add(tree, "VertexColor", layer_name="Paint").node
    tree.links.new(node.outputs["Color"], principled.inputs["Base Color"])
    tree.links.new(node.outputs["Alpha"], principled.inputs["Alpha"])


def furnish(scene) -> None:
    """Cards one behind the other before a wall and above a floor: shadows, reflections and light through them."""
    wall = mesh_object("Wall", [(-3, 2, -1), (3, 2, -1), (3, 2, 3), (-3, 2, 3)], [(0, 1, 2, 3)])
    floor = mesh_object("Floor", [(-3, -3, -1), (3, -3, -1), (3, 2, -1), (-3, 2, -1)], [(0, 1, 2, 3)])
    for obj, colour, roughness, metallic in ((wall, B, 0.5, 0), (floor, (0.6, 0.6, 0.6), 0.25, 1)):
        _, principled = material(obj.name)
        principled.inputs["Base Color"].default_value = (*colour, 1)
        principled.inputs["Roughness"].default_value, principled.inputs["Metallic"].default_value = roughness, metallic
        obj.data.materials.append(bpy.data.materials[obj.name])
    leaf("Cutout", cutout, (-1.1, 0, 0.1), 0.9)
    leaf("Veil", veil((0.8, 0.2, 0.2), 0.35), (0.7, 0.3, 0.2), 0.9)
    leaf("Behind", veil((0.1, 0.3, 0.8), 0.6), (1.2, 0.9, 0.5), 0.8)
    leaf("Glow", veil((0.1, 0.1, 0.1), 0.5, 0.8), (0, 1.3, 1.5), 0.5)
    painted = leaf("Painted", painted_veil, (-1.5, 1.0, 1.6), 0.7)
    colours = np.random.default_rng(1).uniform(0.1, 1, (4, 4)).astype(np.float32)
    colours[:, 3] = 0.1, 0.9, 0.3, 0.7
    painted.data.attributes.new("Paint", "FLOAT_COLOR", "POINT").data.foreach_set("color", colours.ravel())
    ball = mesh_object("Ball", *sphere(16, 24))
    ball.data.shade_smooth()
    _, principled = material("Ball")
    veil((0.9, 0.8, 0.3), 0.5)(None, principled)
    ball.data.materials.append(bpy.data.materials["Ball"])
    ball.location, ball.scale = (0, -0.6, -0.6), (0.4, 0.4, 0.4)
    copy = ball.copy()
    copy.location = (1.6, -0.8, -0.5)
    scene.collection.objects.link(copy)
    scene.camera.location, scene.camera.rotation_euler = (0, -7, 1.2), (np.pi / 2 - 0.1, 0, 0)
    scene.camera.data.angle = 0.75
    parity.light(scene)


@pytest.mark.slow
@pytest.mark.judged
def test_see_through_things_look_as_in_cycles(scene, export):
    furnish(scene)
    parity.set_up(scene, 96, samples=512, bounces=2, subpixels=64)
    _, warnings = export()
    assert not warnings
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")

    np.testing.assert_allclose(ours[..., 3].mean(0), theirs[..., 3].mean(0), atol=0.2)
    assert parity.psnr(ours, theirs) > 40
