"""BSDFs of materials: each node with all its inputs, mixed and added, and what is wrong with them."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import mesh_object, sphere
from test_materials import A, B, add, material, output_of, picture, shaded, swatch, texture_node

pytestmark = pytest.mark.blender_api
TINT = (0.3, 0.6, 0.9)
#: Input of the Principled BSDF -> field and a value that is not the default.
PRINCIPLED = {
    "Base Color": ("base_colour", A), "Roughness": ("roughness", 0.3), "Metallic": ("metallic", 0.4),
    "IOR": ("ior", 1.33), "Specular IOR Level": ("specular_level", 0.7), "Specular Tint": ("specular_tint", TINT),
    "Anisotropic": ("anisotropy", 0.6), "Anisotropic Rotation": ("anisotropy_rotation", 0.25),
    "Coat Weight": ("coat", 0.8), "Coat Roughness": ("coat_roughness", 0.15), "Coat IOR": ("coat_ior", 1.7),
    "Coat Tint": ("coat_tint", B), "Sheen Weight": ("sheen", 0.35), "Sheen Roughness": ("sheen_roughness", 0.65),
    "Sheen Tint": ("sheen_tint", A), "Transmission Weight": ("transmission", 0.45),
    "Diffuse Roughness": ("diffuse_roughness", 0.55),
}  # fmt: skip


def inputs_of(node: bpy.types.Node) -> dict[str, tuple[str, object]]:
    """Those of `PRINCIPLED` that this Blender has."""
    return {name: pair for name, pair in PRINCIPLED.items() if name in node.inputs}


def only(frame):
    return frame.meshes[0].materials[0]


def exported(export, data: str = "Material"):
    """The only material of a square with it, and the warnings."""
    swatch(bpy.data.materials[data])
    frame, warnings = export()
    return only(frame), warnings


def test_all_of_the_principled_bsdf_arrives(scene, export):
    _, principled = material()
    for name, (_, value) in inputs_of(principled).items():
        principled.inputs[name].default_value = (*value, 1) if isinstance(value, tuple) else value
    found, warnings = exported(export)
    assert not warnings and found.kind == "principled" and not found.parts and not found.coat_details
    for field, value in inputs_of(principled).values():
        np.testing.assert_allclose(getattr(found, field), value, rtol=1e-6, err_msg=field)


def test_all_of_the_principled_bsdf_takes_an_image(scene, export):
    tree, principled = material()
    node = texture_node(tree, picture())
    for name in inputs_of(principled):
        tree.links.new(node.outputs["Color"], principled.inputs[name])
    found, warnings = exported(export)
    assert not warnings
    for field, value in inputs_of(principled).values():
        texture = found.textures[field] if field in found.textures else getattr(found, f"{field}_texture")
        assert (texture.image, texture.channel) == ("Picture", "rgb" if isinstance(value, tuple) else "luminance"), (
            field
        )
        np.testing.assert_allclose(getattr(found, field), 1, err_msg=field)


def test_a_plain_principled_bsdf_needs_no_more_lobes(scene, export):
    _, principled = material()
    assert not exported(export)[0].has_more_lobes
    for name in ("Coat Roughness", "Sheen Roughness", "Anisotropic Rotation"):
        principled.inputs[name].default_value = 0.2
    assert not exported(export)[0].has_more_lobes


def test_what_metals_have_not_is_not_read(scene, export):
    tree, principled = material()
    principled.distribution = "GGX"  # rough metals with the other one are told
    principled.inputs["Metallic"].default_value = 1.0
    for name in ("IOR", "Specular IOR Level", "Transmission Weight"):
        tree.links.new(add(tree, "Fresnel", 1.2), principled.inputs[name])
    found, warnings = exported(export)
    assert not warnings and not found.has_more_lobes


NODES = {
    "BsdfDiffuse": ("diffuse", {"Color": "base_colour", "Roughness": "diffuse_roughness"}),
    "BsdfAnisotropic": ("glossy", {"Color": "base_colour", "Roughness": "roughness", "Anisotropy": "anisotropy",
                                   "Rotation": "anisotropy_rotation"}),
    "BsdfGlass": ("glass", {"Color": "base_colour", "Roughness": "roughness", "IOR": "ior"}),
    "BsdfRefraction": ("refraction", {"Color": "base_colour", "Roughness": "roughness", "IOR": "ior"}),
    "BsdfTranslucent": ("translucent", {"Color": "base_colour"}),
    "BsdfSheen": ("sheen", {"Color": "base_colour", "Roughness": "sheen_roughness"}),
    "BsdfMetallic": ("principled", {"Base Color": "base_colour", "Edge Tint": "specular_tint", "Roughness": "roughness",
                                    "Anisotropy": "anisotropy", "Rotation": "anisotropy_rotation"}),
}  # fmt: skip


@pytest.mark.parametrize("kind", NODES)
def test_each_bsdf_is_its_own_kind(scene, export, kind):
    if not hasattr(bpy.types, f"ShaderNode{kind}"):
        pytest.skip(f"this Blender has no {kind}")
    tree, _ = material()
    expected, fields = NODES[kind]
    socket = add(tree, kind)
    if kind in ("BsdfGlass", "BsdfRefraction"):
        socket.node.distribution = "GGX"
    if kind == "BsdfMetallic":
        socket.node.fresnel_type = "F82"
    values = {}
    for i, (name, field) in enumerate(fields.items(), 1):
        own = socket.node.inputs[name]
        values[field] = TINT if own.type == "RGBA" else 0.1 * i + (1 if field == "ior" else 0)
        own.default_value = (*TINT, 1) if own.type == "RGBA" else values[field]
    shaded(tree, socket)
    found, warnings = exported(export)
    assert not warnings and (found.kind, found.parts) == (expected, [])
    for field, value in values.items():
        np.testing.assert_allclose(getattr(found, field), value, rtol=1e-6, err_msg=field)
    if kind == "BsdfMetallic":
        assert found.metallic == 1


@pytest.mark.skipif(not hasattr(bpy.types, "ShaderNodeBsdfMetallic"), reason="this Blender has no such node")
def test_gold_by_its_refractive_index(scene, export):
    """Reflectances of gold at normal incidence, from its n and k."""
    tree, _ = material()
    socket = add(tree, "BsdfMetallic")
    socket.node.fresnel_type = "PHYSICAL_CONDUCTOR"
    socket.node.inputs["IOR"].default_value = (0.183, 0.421, 1.373)
    socket.node.inputs["Extinction"].default_value = (3.424, 2.346, 1.770)
    shaded(tree, socket)
    found, warnings = exported(export)
    assert len(warnings) == 1 and "F82" in warnings[0]
    np.testing.assert_allclose(found.base_colour, (0.944, 0.776, 0.373), atol=2e-3)
    assert min(found.specular_tint) > 0.8


def test_shares_of_the_same_bsdf_are_one(scene, export):
    """Only the colour differs, and all light is in proportion to it: the mean colour scatters the same light."""
    tree, _ = material()
    one, two = add(tree, "BsdfGlass", A, 0.2), add(tree, "BsdfGlass", B, 0.2)
    shaded(tree, add(tree, "MixShader", 0.25, one, two))
    found, warnings = exported(export)
    assert not warnings and (found.kind, found.parts) == ("glass", [])
    np.testing.assert_allclose(found.base_colour, 0.75 * np.array(A) + 0.25 * np.array(B), rtol=1e-6)
    tree.nodes.remove(tree.nodes["Mix Shader"])
    shaded(tree, add(tree, "AddShader", one, two))
    np.testing.assert_allclose(exported(export)[0].base_colour, np.array(A) + B, rtol=1e-6)


NONLINEAR = {
    "glossy": ("BsdfAnisotropic", {}, {"Color": (TINT, A)}),
    "rough diffuse": ("BsdfDiffuse", {"Roughness": 0.5}, {"Color": (TINT, A)}),
    "metal": ("BsdfPrincipled", {"Metallic": 0.5}, {"Base Color": (TINT, A)}),
    "tinted coat": ("BsdfPrincipled", {"Coat Tint": (*TINT, 1.0)}, {"Coat Weight": (1.0, 0.5)}),
    "coat below sheen": ("BsdfPrincipled", {"Sheen Weight": 0.5}, {"Coat Weight": (1.0, 0.5)}),
}
LINEAR = {
    "glossy of GGX": ("BsdfAnisotropic", {"distribution": "GGX"}, {"Color": (TINT, A)}),
    "diffuse": ("BsdfDiffuse", {}, {"Color": (TINT, A)}),
    "metallic": ("BsdfPrincipled", {"distribution": "GGX"}, {"Metallic": (1.0, 0.25)}),
    "coat": ("BsdfPrincipled", {}, {"Coat Weight": (1.0, 0.5)}),
    "dielectric": ("BsdfPrincipled", {}, {"Base Color": (TINT, A)}),
}


@pytest.mark.parametrize("case", [*NONLINEAR, *LINEAR])
def test_only_what_is_linear_in_a_value_is_mixed_by_it(scene, export, case):
    """The mean of two colours is no mean of the light where light is coloured several times; both stay parts."""
    tree, _ = material()
    kind, common, varied = (NONLINEAR | LINEAR)[case]
    sockets = [add(tree, kind), add(tree, kind)]
    for i, socket in enumerate(sockets):
        for name, value in common.items():
            if name == "distribution":
                socket.node.distribution = value
            else:
                socket.node.inputs[name].default_value = value
        for name, values in varied.items():
            value = values[i]
            socket.node.inputs[name].default_value = (*value, 1.0) if isinstance(value, tuple) else value
    shaded(tree, add(tree, "MixShader", 0.25, *sockets))
    found, warnings = exported(export)
    assert not warnings and [part.weight[0] for part in found.parts] == ([0.75, 0.25] if case in NONLINEAR else [])


@pytest.mark.parametrize("distribution", ["MULTI_GGX", "GGX"])
def test_half_of_a_glossy_bsdf_is_half_as_dark_only_for_one_reflection(scene, export, distribution):
    tree, _ = material()
    glossy = add(tree, "BsdfAnisotropic", B, 1.0, distribution=distribution)
    shaded(tree, add(tree, "MixShader", 0.5, add(tree, "Emission", A), glossy))
    found, warnings = exported(export)
    assert not warnings
    if distribution == "GGX":
        assert not found.parts
        np.testing.assert_allclose(found.base_colour, np.array(B) / 2, rtol=1e-6)
    else:
        (part,) = found.parts
        assert part.weight == (0.5,) * 3
        np.testing.assert_allclose(part.material.base_colour, B, rtol=1e-6)


def weights_of(found) -> dict[str, float]:
    return {part.material.kind: part.weight[0] for part in found.parts}


def test_unlike_bsdfs_are_parts_with_their_weights(scene, export):
    tree, _ = material()
    inner = add(tree, "MixShader", 0.25, add(tree, "BsdfDiffuse", A, 0.4), add(tree, "BsdfAnisotropic", B, 0.2))
    glowing = add(tree, "MixShader", 0.5, add(tree, "Emission", A, 2.0), inner)
    shaded(tree, add(tree, "AddShader", glowing, add(tree, "BsdfTranslucent", TINT)))
    found, warnings = exported(export)
    assert not warnings and weights_of(found) == {"diffuse": 0.375, "glossy": 0.125, "translucent": 1.0}
    diffuse, glossy, translucent = (part.material for part in found.parts)
    np.testing.assert_allclose((*diffuse.base_colour, diffuse.diffuse_roughness), (*A, 0.4), rtol=1e-6)
    np.testing.assert_allclose((*glossy.base_colour, glossy.roughness), (*B, 0.2), rtol=1e-6)
    np.testing.assert_allclose(translucent.base_colour, TINT, rtol=1e-6)
    np.testing.assert_allclose(found.emission, A, rtol=1e-6)
    assert found.has_more_lobes


def test_half_of_a_bsdf_is_a_part_or_darker(scene, export):
    """Beside light that is given off: what is in proportion to its colour is darker, a Principled BSDF a part."""
    tree, principled = material()
    light, glass = add(tree, "Emission", A, 2.0), add(tree, "BsdfGlass", B, 0.2)
    mix = add(tree, "MixShader", 0.5, light, glass).node
    shaded(tree, mix.outputs[0])
    found, warnings = exported(export)
    assert not warnings and not found.parts
    np.testing.assert_allclose((*found.base_colour, *found.emission), (*np.array(B) / 2, *A), rtol=1e-6)
    tree.links.new(principled.outputs[0], mix.inputs[2])
    found, warnings = exported(export)
    assert not warnings and weights_of(found) == {"principled": 0.5} and not found.parts[0].material.has_more_lobes


@pytest.mark.parametrize("swapped", [False, True])
def test_an_image_as_the_share_of_a_mix(scene, export, swapped):
    tree, _ = material()
    node = texture_node(tree, picture(float_buffer=True))
    shaders = [add(tree, "BsdfDiffuse", A), add(tree, "BsdfSheen", B, 0.2)]
    share = add(tree, "SeparateColor", node.outputs["Color"]).node.outputs["Green"]
    shaded(tree, add(tree, "MixShader", share, *(shaders[::-1] if swapped else shaders)))
    found, warnings = exported(export)
    assert not warnings
    kinds = {part.material.kind: part for part in found.parts}
    assert (kinds["diffuse"].inverted, kinds["sheen"].inverted) == (not swapped, swapped)
    for part in found.parts:
        assert part.weight == (1, 1, 1) and (part.weight_texture.image, part.weight_texture.channel) == ("Picture", "g")


def test_images_between_like_bsdfs_are_one_again(scene, export):
    """The same surface on both sides of an image: all of it, and of its colours the image's blend."""
    tree, _ = material()
    node = texture_node(tree, picture())
    glossy = add(tree, "BsdfAnisotropic", A, 0.2)
    shaded(tree, add(tree, "MixShader", node.outputs["Alpha"], glossy, add(tree, "BsdfAnisotropic", A, 0.2)))
    found, warnings = exported(export)
    assert not warnings and not found.parts and found.base_colour_texture is None
    np.testing.assert_allclose(found.base_colour, A, rtol=1e-6)


def test_many_parts_are_cut_off_and_named(scene, export):
    tree, _ = material()
    shader = add(tree, "BsdfDiffuse", A)
    for i in range(12):
        shader = add(tree, "MixShader", 0.5, shader, add(tree, "BsdfAnisotropic", A, 0.05 * i))
    shaded(tree, shader)
    found, warnings = exported(export)
    assert len(found.parts) == 8 and warnings and all("the weakest are left out" in text for text in warnings)
    assert max(part.weight[0] for part in found.parts) == 0.5


@pytest.mark.parametrize("kind", ["Fresnel", "LayerWeight"])
def test_what_depends_on_the_view_is_named(scene, export, kind):
    tree, _ = material()
    weight = add(tree, kind)
    shaded(tree, add(tree, "MixShader", weight, add(tree, "BsdfDiffuse", A), add(tree, "BsdfAnisotropic", B, 0.2)))
    found, warnings = exported(export)
    assert len(warnings) == 1 and "cannot depend on the direction" in warnings[0]
    assert 0 < weights_of(found)["glossy"] < 0.2


def test_what_bsdfs_lack_is_named(scene, export):
    tree, principled = material()
    principled.inputs["Subsurface Weight"].default_value = 0.5
    principled.inputs["Thin Film Thickness"].default_value = 300
    _, (warning,) = exported(export)
    assert 'node "Principled BSDF": not rendered: subsurface scattering (it is diffuse), thin film' in warning
    refraction = add(tree, "BsdfRefraction", A, 0.3, distribution="BECKMANN")
    shaded(tree, refraction)
    _, (warning,) = exported(export)
    assert "Beckmann" in warning and "GGX is used" in warning
    refraction.node.inputs["Roughness"].default_value = 0
    assert not exported(export)[1]


# Directions and normals


def tangents(frame, found) -> np.ndarray:
    return {layer.name: layer.values for layer in frame.meshes[0].layers}[found.tangent]


@pytest.mark.parametrize("axis", [None, "X", "Y", "Z"])
def test_highlights_run_around_an_axis_of_the_object(scene, export, axis):
    """Without a Tangent node, around Z, as in Cycles."""
    tree, principled = material()
    principled.inputs["Anisotropic"].default_value = 0.5
    if axis is not None:
        tree.links.new(add(tree, "Tangent", axis=axis, direction_type="RADIAL"), principled.inputs["Tangent"])
    obj = mesh_object("Ball", *sphere(8, 12))
    obj.data.materials.append(bpy.data.materials["Material"])
    frame, warnings = export()
    (state,) = frame.meshes
    assert not warnings
    values = tangents(frame, only(frame))
    places = state.vertices[state.faces].reshape(-1, 3)
    low, high = places.min(axis=0), places.max(axis=0)
    generated = (places - low) / (high - low) - 0.5
    around = np.cross(np.eye(3)["XYZ".index(axis or "Z")], generated)
    around *= -1 if axis == "Y" else 1  # so has Cycles
    assert values.shape == (len(state.faces), 3, 4) and values.dtype == np.float32
    np.testing.assert_allclose(values.reshape(-1, 4)[:, :3], around, atol=1e-5)


def test_highlights_follow_a_uv_map(scene, export):
    tree, principled = material()
    principled.inputs["Anisotropic"].default_value = 0.5
    node = add(tree, "Tangent", direction_type="UV_MAP", uv_map="Second").node
    tree.links.new(node.outputs[0], principled.inputs["Tangent"])
    image = texture_node(tree, picture())
    tree.links.new(image.outputs["Color"], principled.inputs["Base Color"])
    obj = swatch(bpy.data.materials["Material"])
    second = obj.data.uv_layers.new(name="Second")
    second.uv.foreach_set("vector", np.float32((0, 1, 0, 0, 1, 0, 1, 1)))
    frame, warnings = export()
    assert not warnings and tangents(frame, only(frame)).shape == (2, 3, 2)
    node.uv_map = ""
    frame, warnings = export()
    assert not warnings and only(frame).tangent == "" and frame.meshes[0].uvs is not None


def test_the_coat_is_smooth_or_as_what_is_below(scene, export):
    tree, principled = material()
    principled.inputs["Coat Weight"].default_value = 1.0
    bump = add(tree, "Bump").node
    tree.links.new(add(tree, "TexImage", image=picture()), bump.inputs["Height"])
    tree.links.new(bump.outputs[0], principled.inputs["Normal"])
    found, warnings = exported(export)
    assert not warnings and len(found.details) == 1 and not found.coat_details
    tree.links.new(bump.outputs[0], principled.inputs["Coat Normal"])
    found, warnings = exported(export)
    assert not warnings and found.coat_details
    tree.links.remove(principled.inputs["Normal"].links[0])
    found, warnings = exported(export)
    assert len(warnings) == 1 and "the coat has a normal of its own" in warnings[0]


# What is wrong


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf"), -1.0, 0.0, 1e30])
def test_senseless_numbers_everywhere_leave_a_surface(scene, export, number):
    tree, principled = material()
    value = add(tree, "Value")
    value.default_value = number
    for name in inputs_of(principled):
        tree.links.new(value, principled.inputs[name])
    shaded(tree, add(tree, "MixShader", value, principled.outputs[0], add(tree, "BsdfGlass", None, value, value)))
    swatch(bpy.data.materials["Material"])
    material("Sound")
    swatch(bpy.data.materials["Sound"], 2.0)
    frame, warnings = export()
    assert {m.materials[0].name for m in frame.meshes} == {"Material", "Sound"}
    found = next(m for m in frame.meshes if m.materials[0].name == "Material").materials[0]
    for one in (found, *(part.material for part in found.parts)):
        for field, _ in inputs_of(principled).values():
            assert np.isfinite(getattr(one, field)).all(), field
        assert one.ior > 0 and one.coat_ior >= 1 and 0 <= one.transmission <= 1 and 0 <= one.roughness <= 1
    assert all('Material "Material"' in text for text in warnings)
    assert any("not finite" in text for text in warnings) == np.isnan(number)
    assert any("IOR of 0 or less" in text for text in warnings) == (number <= 0)


def test_nodes_of_a_missing_kind_are_named(scene, export):
    """Of an add-on that is not installed: a shader, and what goes into one."""

    class Odd(bpy.types.ShaderNode):
        bl_idname, bl_label = "DrgsTestOddNode", "Odd"

        def init(self, context):
            self.outputs.new("NodeSocketFloat", "Value")
            self.outputs.new("NodeSocketShader", "BSDF")

    bpy.utils.register_class(Odd)
    tree, principled = material()
    odd = tree.nodes.new("DrgsTestOddNode")
    tree.links.new(odd.outputs["Value"], principled.inputs["Transmission Weight"])
    shaded(tree, add(tree, "MixShader", 0.5, odd.outputs["BSDF"], principled.outputs[0]))
    bpy.utils.unregister_class(Odd)
    found, warnings = exported(export)
    assert warnings and all('Material "Material", node "Odd"' in text for text in warnings)
    assert min(found.base_colour) > 0.1


def test_loops_through_groups_of_shaders_end(scene, export):
    tree, principled = material()
    group = bpy.data.node_groups.new("Loop", "ShaderNodeTree")
    group.interface.new_socket("In", in_out="INPUT", socket_type="NodeSocketShader")
    group.interface.new_socket("Out", in_out="OUTPUT", socket_type="NodeSocketShader")
    entry, leave = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    inner = add(group, "MixShader", 0.5, entry.outputs[0], add(group, "BsdfGlass", A))
    group.links.new(inner, leave.inputs[0])
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = group
    mix = add(tree, "MixShader", 0.5, node.outputs[0], principled.outputs[0])
    tree.links.new(mix, node.inputs[0])
    shaded(tree, mix)
    found, _ = exported(export)
    assert output_of(tree) is not None and {part.material.kind for part in found.parts} >= {"glass"}
