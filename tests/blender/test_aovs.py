"""Shader AOVs: what materials give to AOV Output nodes, as passes like those of Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from test_motion import layers_of
from test_panorama import room  # noqa: F401  a fixture

pytestmark = pytest.mark.blender_api


def tree_of(name: str) -> bpy.types.NodeTree:
    return bpy.data.materials[name].node_tree


def output(tree: bpy.types.NodeTree, aov: str, **values) -> bpy.types.Node:
    """A new AOV Output node."""
    node = tree.nodes.new("ShaderNodeOutputAOV")
    node.aov_name = aov
    for name, value in values.items():
        node.inputs[name].default_value = value
    return node


@pytest.fixture
def painted(room):  # noqa: F811
    """The room, whose materials give constants, a texture, an attribute, and a constant from within a group."""
    layer = room.view_layers[0]
    for name, kind in (("tone", "COLOR"), ("wetness", "VALUE")):
        aov = layer.aovs.add()
        aov.name, aov.type = name, kind
    output(tree_of("floor"), "tone", Color=(0.2, 3.0, -1.0, 1))
    output(tree_of("floor"), "wetness", Value=-2.5)
    back = bpy.data.objects["back"].data
    back.uv_layers.new(name="map").data.foreach_set("uv", np.float32([0, 0, 2, 0, 2, 1, 0, 1]))
    image = tree_of("back").nodes.new("ShaderNodeTexImage")
    image.image = bpy.data.images.new("pattern", 4, 4, float_buffer=True)
    image.image.pixels.foreach_set(np.random.default_rng(1).random(64, np.float32))
    tree_of("back").links.new(image.outputs["Color"], output(tree_of("back"), "tone").inputs["Color"])
    left = bpy.data.objects["left"].data
    wet = left.attributes.new("wet", "FLOAT", "POINT")
    wet.data.foreach_set("value", np.linspace(-1, 2, len(left.vertices), dtype=np.float32))
    attribute = tree_of("left").nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = "wet"
    tree_of("left").links.new(attribute.outputs["Fac"], output(tree_of("left"), "wetness").inputs["Value"])
    group = bpy.data.node_groups.new("Group", "ShaderNodeTree")
    output(group, "wetness", Value=0.75)
    tree_of("ball").nodes.new("ShaderNodeGroup").node_tree = group
    cycles, settings = room.cycles, room.drgs
    cycles.device, cycles.samples, cycles.pixel_filter_type, cycles.filter_width = "CPU", 256, "BOX", 1.0
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    settings.use_strategy_samples, settings.samples, settings.bounces = False, 64, 0
    settings.subpixel_samples, settings.filter_width = 64, 0.0
    room.camera.location, room.camera.rotation_euler = (-0.4, -2.6, 0.1), (1.5, 0.0, -0.1)
    room.camera.data.lens = 18
    return room


@pytest.mark.slow
@pytest.mark.judged
def test_passes_are_those_of_cycles(painted, tmp_path):
    theirs, ours = layers_of(painted, "CYCLES", tmp_path), layers_of(painted, "DRGS", tmp_path)
    for name, channels in (("tone", 4), ("wetness", 1)):
        a, b = ours[name].astype(float), theirs[name].astype(float)
        assert a.shape == b.shape and a.shape[2] == channels
        error = np.abs(a - b)
        print(name, error.mean(), np.quantile(error, 0.99), b.min(), b.max())
        assert error.mean() < 0.01 and np.quantile(error, 0.9) < 0.01 and b.max() > 0.7
    assert theirs["wetness"].min() < -2 and ours["tone"].min() >= 0


def test_frame_has_the_aovs_that_passes_ask_for(painted, export):
    frame, warnings = export()
    assert frame.passes[-2:] == ("AOV colour tone", "AOV value wetness") and not any("AOV" in w for w in warnings)
    values = {mesh.name: {aov.name: aov for aov in mesh.materials[0].aovs} for mesh in frame.meshes}
    assert values["floor"]["AOV value wetness"].colour[0] == -2.5 and not values["right"]
    assert values["ball"]["AOV value wetness"].colour[0] == 0.75
    assert values["back"]["AOV colour tone"].texture is not None
    names = {image.name for image in frame.images}
    assert values["back"]["AOV colour tone"].texture.image in names
    painted.view_layers[0].aovs.remove(painted.view_layers[0].aovs[0])
    frame, _ = export()
    assert all(aov.name == "AOV value wetness" for mesh in frame.meshes for aov in mesh.materials[0].aovs)
    assert not frame.images


@pytest.mark.slow
def test_procedural_aovs_are_baked(painted, tmp_path):
    """Noise on the ball, by a channel of its own: as Cycles' own."""
    nodes, links = tree_of("ball").nodes, tree_of("ball").links
    noise = nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = 1.5
    links.new(noise.outputs["Color"], output(tree_of("ball"), "tone").inputs["Color"])
    theirs, ours = layers_of(painted, "CYCLES", tmp_path), layers_of(painted, "DRGS", tmp_path)
    a, b = ours["tone"].astype(float), theirs["tone"].astype(float)
    ball = theirs["wetness"][..., 0] == 0.75
    assert ball.sum() > 200 and np.ptp(b[ball][:, :3]) > 0.2
    assert np.abs(a - b)[ball].mean() < 0.01


def test_what_cannot_be_is_told(painted, ball, export):
    layer = painted.view_layers[0]
    for name in ("Combined", "Roughness"):
        layer.aovs.add().name = name
    output(tree_of("ball"), "wetness", Value=9.0)
    shader = next(n for n in tree_of("floor").nodes if n.type == "BSDF_PRINCIPLED")
    shader.inputs["Alpha"].default_value = 0.4
    material = ball.material_slots[0].material
    output(material.node_tree, "wetness", Value=0.5)
    frame, warnings = export()
    text = "\n".join(warnings)
    for said in ('Shader AOV "Combined"', 'Shader AOV "Roughness"', "has another output", "count by its alpha"):
        assert said in text, said
    assert frame.objects[0].aovs[0].colour[0] == 0.5
    assert not any("Combined" in name for name in frame.passes[1:])
