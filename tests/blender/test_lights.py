"""Blender's lights as the engine gets them."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import part

pytestmark = pytest.mark.blender_api


def add_light(scene, kind: str, name: str = "Light", **values) -> bpy.types.Object:
    """A light object in the scene, its data set to `values`."""
    data = bpy.data.lights.new(name, kind)
    for key, value in values.items():
        setattr(data, key, value)
    obj = bpy.data.objects.new(name, data)
    scene.collection.objects.link(obj)
    return obj


KINDS = {
    "POINT": ({"shadow_soft_size": 0.25, "use_soft_falloff": False}, {"radius": 0.25, "soft_falloff": False}),
    "SUN": ({"angle": 0.2}, {"angle": 0.2}),
    "SPOT": (
        {"shadow_soft_size": 0.5, "spot_size": 1.5, "spot_blend": 0.75},
        {"radius": 0.5, "spot_size": 1.5, "spot_blend": 0.75, "soft_falloff": True},
    ),
    "AREA": (
        {"shape": "RECTANGLE", "size": 2.0, "size_y": 3.0, "spread": 1.25},
        {"shape": "rectangle", "size_x": 2.0, "size_y": 3.0, "spread": 1.25},
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_light_is_described_by_blenders_numbers(scene, export, kind):
    values, expected = KINDS[kind]
    obj = add_light(scene, kind, energy=50, color=(0.25, 0.5, 1), **values)
    obj.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.5, 4, "X") @ Matrix.Diagonal((2, 1, 1, 1))
    frame, warnings = export()
    (light,) = frame.lights
    assert not warnings and (light.name, light.kind) == ("Light", kind.lower())
    np.testing.assert_allclose(light.matrix_world, np.array(obj.matrix_world))
    assert light.colour == (0.25, 0.5, 1) and light.power == 50 and light.normalize and light.cast_shadow
    for name, value in expected.items():
        assert getattr(light, name) == pytest.approx(value), name


@pytest.mark.parametrize("shape", ["SQUARE", "DISK", "RECTANGLE", "ELLIPSE"])
def test_area_shapes_have_two_sides(scene, export, shape):
    add_light(scene, "AREA", shape=shape, size=2.0, size_y=3.0)
    (light,) = export()[0].lights
    assert light.shape == shape.lower() and light.size_x == 2
    assert light.size_y == (3 if shape in ("RECTANGLE", "ELLIPSE") else 2)


def test_rays_that_see_a_light_and_shadows(scene, export):
    obj = add_light(scene, "POINT")
    (light,) = export()[0].lights
    assert (light.camera, light.diffuse, light.glossy) == (False, True, True), "as Blender makes lights"
    obj.visible_camera, obj.visible_glossy, obj.data.use_shadow = True, False, False
    (light,) = export()[0].lights
    assert (light.camera, light.diffuse, light.glossy, light.cast_shadow) == (True, True, False, False)


@pytest.mark.skipif(bpy.app.version < (4, 5, 0), reason="Blender's lights have these from 4.5 on")
def test_exposure_temperature_and_size(scene, export):
    obj = add_light(scene, "AREA", energy=10, exposure=2, use_temperature=True, temperature=3000, normalize=False)
    obj.data.color = (1, 0.5, 1)
    (light,) = export()[0].lights
    assert light.power == pytest.approx(40) and light.normalize is False
    np.testing.assert_allclose(light.colour, np.array(obj.data.temperature_color) * (1, 0.5, 1), rtol=1e-6)


@pytest.mark.skipif(bpy.app.version < (4, 5, 0), reason="Blender's own colours are known from 4.5 on")
@pytest.mark.parametrize("kelvin", [1900, 3200, 4500, 6500, 9000, 12000])
def test_mesh_lightsing_bodies_have_blenders_colour(scene, kelvin):
    light = add_light(scene, "POINT", use_temperature=True, temperature=kelvin).data
    theirs = np.array(light.temperature_color)
    ours = part("addon.export.node_math").blackbody(kelvin)
    np.testing.assert_allclose(ours, theirs, rtol=0.02, atol=0.02)


def test_instances_of_lights_are_lights_and_portals_are_not(scene, export):
    obj = add_light(scene, "SPOT")
    group = bpy.data.collections.new("Group")
    group.objects.link(obj)
    empty = bpy.data.objects.new("Instance", None)
    empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", group, (7, 0, 0)
    scene.collection.objects.link(empty)
    add_light(scene, "AREA", "Portal").data.cycles.is_portal = True
    frame, warnings = export()
    assert sorted(light.matrix_world[0, 3] for light in frame.lights) == [0, 7] and not warnings
    obj.hide_render = True  # of no concern to the viewport
    assert len(export()[0].lights) == 2


def emission(light: bpy.types.Light) -> tuple[bpy.types.NodeTree, bpy.types.Node]:
    """A light's tree with its one Emission node."""
    light.use_nodes = True
    return light.node_tree, next(n for n in light.node_tree.nodes if n.type == "EMISSION")


def test_nodes_of_a_light_multiply_it(scene, export):
    light = add_light(scene, "POINT", energy=10, color=(1, 0.5, 1)).data
    tree, node = emission(light)
    node.inputs["Color"].default_value, node.inputs["Strength"].default_value = (0.5, 1, 0.25, 1), 3
    frame, warnings = export()
    np.testing.assert_allclose(frame.lights[0].colour, (1.5, 1.5, 0.75), rtol=1e-6)
    assert frame.lights[0].power == 10 and not warnings
    value = tree.nodes.new("ShaderNodeValue")
    value.outputs[0].default_value = 2
    falloff = tree.nodes.new("ShaderNodeLightFalloff")
    tree.links.new(value.outputs[0], falloff.inputs["Strength"])
    tree.links.new(falloff.outputs["Quadratic"], node.inputs["Strength"])
    frame, warnings = export()
    np.testing.assert_allclose(frame.lights[0].colour, (1, 1, 0.5), rtol=1e-6)
    assert not warnings, "this is how light falls off anyway"
    tree.links.new(falloff.outputs["Constant"], node.inputs["Strength"])
    (warning,) = export()[1]
    assert '"Light"' in warning and "falloff" in warning


@pytest.mark.parametrize("kind", ["ShaderNodeTexIES", "ShaderNodeTexNoise", "ShaderNodeTexImage"])
def test_what_shapes_a_light_is_named_and_never_black(scene, export, kind):
    tree, node = emission(add_light(scene, "SPOT").data)
    odd = tree.nodes.new(kind)
    odd.label = "The Odd One"
    tree.links.new(odd.outputs[0], node.inputs["Strength"])
    frame, warnings = export()
    assert min(frame.lights[0].colour) > 0.1
    assert len(warnings) == 1 and 'Light "Light", node "The Odd One"' in warnings[0]


def test_what_cannot_be_done_to_a_light_is_said(scene, export):
    obj = add_light(scene, "POINT", use_custom_distance=True)
    obj.data.energy = float("nan")
    frame, warnings = export()
    assert len(warnings) == 2 and all('Light "Light"' in w for w in warnings)
    assert any("not finite; it is off. Check" in w for w in warnings), "and what to do"
    assert not frame.lights
