"""Several UV maps, attributes and coordinates of ordinary meshes: what is exported, and that Cycles shows the same."""

from __future__ import annotations

import bpy
import numpy as np
import parity
import pytest
from scenes import mesh_object, sphere
from test_materials import A, add, cycles_picture, emitting, look_down, material, picture, swatch, texture_node

pytestmark = pytest.mark.blender_api

KINDS = {
    ("FLOAT_COLOR", "POINT"): "color",
    ("FLOAT_COLOR", "CORNER"): "color",
    ("BYTE_COLOR", "CORNER"): "color",
    ("FLOAT_VECTOR", "POINT"): "vector",
    ("FLOAT", "POINT"): "value",
    ("FLOAT", "FACE"): "value",
}


def paint(obj: bpy.types.Object, name: str, kind: str, domain: str, seed: int = 1) -> None:
    """Random values of an attribute."""
    attribute = obj.data.attributes.new(name, kind, domain)
    prop = KINDS.get((kind, domain), "value")
    width = {"color": 4, "vector": 3, "value": 1}[prop]
    values = np.random.default_rng(seed).uniform(0.05, 1, (len(attribute.data), width)).astype(np.float32)
    attribute.data.foreach_set(prop, values.ravel())


def by_layers(frame, name: str, subdivisions: int = 8) -> np.ndarray:
    """(8, 8, 3) what an emitting square of four metres shows, seen from above: its layers, blended over both faces."""
    (state,) = [mesh for mesh in frame.meshes if mesh.materials[0].name == name]
    found, texture = np.array(state.materials[0].emission), state.materials[0].emission_texture
    y, x = (np.mgrid[0:8, 0:8] + 0.5) / 8
    x, y = x.ravel(), 1 - y.ravel()
    if texture is None:
        return np.tile(found, (8, 8, 1))
    layer = next(layer for layer in state.layers if layer.name == texture.layer)
    out = np.zeros((64, 3))
    for face, values in zip(state.faces, layer.values):
        a, b, c = (state.vertices[face][:, :2] - (0, -2)) / (1, 4)
        w = np.linalg.solve(np.array([[*a, 1], [*b, 1], [*c, 1]]).T, np.stack([x, y, np.ones(64)]))
        inside = (w >= -1e-9).all(axis=0)
        rgba = (w.T @ values)[inside]
        if texture.channel == "luminance":
            rgba[:, :1] = rgba[:, :3] @ np.array([[0.2126], [0.7152], [0.0722]])
        channel = "rgba".find(texture.channel)
        out[inside] = rgba[:, :3] if texture.channel == "rgb" else rgba[:, [max(channel, 0)]]
    return (out * found).reshape(8, 8, 3)


@pytest.mark.parametrize("output", ["Color", "Factor", "Alpha"])
@pytest.mark.parametrize("kind, domain", KINDS)
def test_attributes_are_what_cycles_shows(scene, export, kind, domain, output):
    tree, _ = material()
    node = add(tree, "Attribute", attribute_name="Paint").node
    socket = node.outputs.get(output) or node.outputs["Fac"]  # the latter before 5.0
    emitting(tree, socket)
    obj = swatch(bpy.data.materials["Material"])
    paint(obj, "Paint", kind, domain)
    obj.scale = (4, 1, 1)
    look_down(scene, 8, 8, 4, 2.001, 0.002)
    frame, warnings = export()
    theirs = cycles_picture(scene)
    assert not warnings
    ours = by_layers(frame, "Material")
    off = np.abs(np.subtract.outer(np.arange(8), np.arange(7, -1, -1))) > 0  # pixels on the diagonal are of either face
    np.testing.assert_allclose(ours[off], theirs[off], rtol=2e-3, atol=2e-3)


def test_nodes_work_on_attributes(scene, export):
    """Scaled, tinted and turned round exactly; what is no straight line is named."""
    for i, (name, build, exact) in enumerate(
        [
            ("scaled", lambda t, c: add(t, "Mix", 1.0, c, A, data_type="RGBA", blend_type="MULTIPLY"), True),
            ("inverted", lambda t, c: add(t, "Invert", 1.0, c), True),
            ("green", lambda t, c: add(t, "SeparateColor", c).node.outputs[1], True),
            ("grey", lambda t, c: add(t, "RGBToBW", c), True),
            ("squared", lambda t, c: add(t, "Gamma", c, 2.0), False),
        ]
    ):
        tree, _ = material(name)
        emitting(tree, build(tree, add(tree, "VertexColor", layer_name="Paint")))
        obj = swatch(bpy.data.materials[name])
        paint(obj, "Paint", "FLOAT_COLOR", "CORNER", i)
        obj.scale = (4, 1, 1)
        look_down(scene, 8, 8, 4, 2.001, 0.002)
        frame, warnings = export()
        assert len(warnings) == (not exact) and all(f'Material "{name}"' in w and '"Paint"' in w for w in warnings)
        theirs = cycles_picture(scene)
        off = np.abs(np.subtract.outer(np.arange(8), np.arange(7, -1, -1))) > 0
        error = np.abs(by_layers(frame, name)[off] - theirs[off]).max()
        assert error < (2e-3 if exact else 0.25), name
        bpy.data.objects.remove(obj)


def test_one_material_on_meshes_with_other_colours(scene, export):
    tree, principled = material()
    tree.links.new(add(tree, "VertexColor", layer_name="Paint"), principled.inputs["Base Color"])
    data = bpy.data.materials["Material"]
    for i in range(2):
        paint(swatch(data, 2.0 * i), "Paint", "FLOAT_COLOR", "POINT", i)
    swatch(data, 4.0).data.name = "Bare"
    frame, warnings = export()
    assert len(warnings) == 1 and '"Bare"' in warnings[0] and '"Paint"' in warnings[0]
    layers = [mesh.layers for mesh in frame.meshes]
    assert sorted(map(len, layers)) == [0, 1, 1]
    first, second = (found[0].values for found in layers if found)
    assert first.shape == (2, 3, 4) and not np.array_equal(first, second)


def test_values_that_are_the_same_everywhere_are_a_colour(scene, export):
    tree, principled = material()
    tree.links.new(add(tree, "VertexColor", layer_name="Paint"), principled.inputs["Base Color"])
    obj = swatch(bpy.data.materials["Material"])
    colours = obj.data.attributes.new("Paint", "FLOAT_COLOR", "POINT")
    colours.data.foreach_set("color", np.tile(np.float32((0.2, 0.4, 0.6, 1)), 4))
    frame, warnings = export()
    assert not warnings and not frame.meshes[0].layers
    np.testing.assert_allclose(frame.meshes[0].materials[0].base_colour, (0.2, 0.4, 0.6), rtol=1e-6)


def test_every_texture_has_its_own_uv_map(scene, export):
    tree, principled = material()
    for socket, uv_map in (("Base Color", "First"), ("Roughness", "Second"), ("Metallic", "Gone")):
        node = texture_node(tree, picture(), add(tree, "UVMap", uv_map=uv_map))
        tree.links.new(node.outputs["Color"], principled.inputs[socket])
    obj = swatch(bpy.data.materials["Material"])
    obj.data.uv_layers[0].name = "First"
    second = np.random.default_rng(3).uniform(0, 1, 8).astype(np.float32)
    obj.data.uv_layers.new(name="Second").uv.foreach_set("vector", second)
    frame, warnings = export()
    (state,) = frame.meshes
    found = state.materials[0]
    assert len(warnings) == 1 and '"Gone"' in warnings[0]
    assert found.base_colour_texture.layer == ""
    layers = {layer.name: layer.values for layer in state.layers}
    obj.data.calc_loop_triangles()
    corners = np.array([triangle.loops[:] for triangle in obj.data.loop_triangles])
    np.testing.assert_array_equal(layers[found.roughness_texture.layer], second.reshape(-1, 2)[corners])
    assert not layers[found.metallic_texture.layer].any()


@pytest.mark.parametrize("kind", ["Generated", "Object", "Attribute"])
def test_other_coordinates_place_images(scene, export, kind):
    """Of a bent, turned thing, through a Mapping node: as Cycles looks the image up, pixel by pixel."""
    tree, _ = material()
    if kind == "Attribute":
        socket = add(tree, "Attribute", attribute_name="Places").node.outputs["Vector"]
    else:
        socket = add(tree, "TexCoord").node.outputs[kind]
    moved = add(tree, "Mapping", socket, (0.1, 0.2, 0.3), (0.4, 0.3, 0.7), (0.9, 1.2, 0.7))
    node = add(tree, "TexImage", moved, image=picture()).node
    emitting(tree, node.outputs["Color"])
    obj = mesh_object("Ball", *sphere(12, 16))
    obj.data.materials.append(bpy.data.materials["Material"])
    obj.scale = (0.9, 0.7, 0.8)
    if kind == "Attribute":
        paint(obj, "Places", "FLOAT_VECTOR", "POINT")
    scene.camera.location, scene.camera.data.type, scene.camera.data.ortho_scale = (0, -5, 0), "ORTHO", 2
    parity.set_up(scene, 64, samples=64, bounces=0)
    _, warnings = export()
    assert not warnings
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    assert parity.psnr(ours, theirs) > 44


def test_coordinates_that_cannot_be_are_named(scene, export):
    for name, build in {
        "window": lambda t: add(t, "TexCoord", label="The Odd One").node.outputs["Window"],
        "another": lambda t: add(t, "TexCoord", label="The Odd One", object=scene.camera).node.outputs["Object"],
    }.items():
        tree, _ = material(name)
        emitting(tree, texture_node(tree, picture(), build(tree)).outputs["Color"])
        obj = swatch(bpy.data.materials[name])
        frame, warnings = export()
        assert len(warnings) == 1 and "The Odd One" in warnings[0] and frame.meshes[0].uvs is not None
        bpy.data.objects.remove(obj)


@pytest.mark.slow
@parity.needs_current_normals
def test_painted_things_look_as_in_cycles(scene, export):
    """Colour, roughness and glow by attributes, a bump by one, two UV maps: on balls, one of them in several places."""
    tree, principled = material("Painted")
    tree.links.new(add(tree, "VertexColor", layer_name="Paint"), principled.inputs["Base Color"])
    rough = add(tree, "Attribute", attribute_name="Rough").node
    tree.links.new(rough.outputs.get("Factor") or rough.outputs["Fac"], principled.inputs["Roughness"])
    uv = add(tree, "UVMap", uv_map="Second")
    glow = add(tree, "Mix", 1.0, add(tree, "TexImage", uv, image=picture()), A, data_type="RGBA", blend_type="MULTIPLY")
    tree.links.new(glow, principled.inputs["Emission Color"])
    principled.inputs["Emission Strength"].default_value = 0.2
    node = add(tree, "Bump").node
    node.inputs["Distance"].default_value = 0.15
    tree.links.new(rough.outputs.get("Factor") or rough.outputs["Fac"], node.inputs["Height"])
    tree.links.new(node.outputs[0], principled.inputs["Normal"])
    obj = mesh_object("Ball", *sphere(16, 24))
    obj.data.shade_smooth()
    for layer in ("First", "Second"):
        flat = obj.data.uv_layers.new(name=layer)
        where = np.array([obj.data.vertices[loop.vertex_index].co[:] for loop in obj.data.loops])
        flat.uv.foreach_set("vector", (where[:, :2] * (0.5 if layer == "Second" else 3)).astype(np.float32).ravel())
    paint(obj, "Paint", "BYTE_COLOR", "CORNER")
    paint(obj, "Rough", "FLOAT", "POINT")
    obj.data.materials.append(bpy.data.materials["Painted"])
    obj.location, copy = (-1.1, 0, 0), obj.copy()
    copy.location, copy.scale = (1.1, 0, 0), (-1, 0.8, 0.9)
    scene.collection.objects.link(copy)
    scene.camera.location, scene.camera.data.type, scene.camera.data.ortho_scale = (0, -9, 0), "ORTHO", 4.6
    parity.light(scene)
    parity.set_up(scene, 80)
    _, warnings = export()
    assert not warnings
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    assert parity.psnr(ours, theirs) > 40
