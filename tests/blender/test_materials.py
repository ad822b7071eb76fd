"""Node trees of materials: what the engine is told is what Cycles shows, and nothing is black or silent."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
import pytest
from scenes import mesh_object, part, read_exr, sphere

pytestmark = pytest.mark.blender_api


def material(name: str = "Material") -> tuple[bpy.types.NodeTree, bpy.types.Node]:
    """A material; returns its tree and Principled BSDF."""
    data = bpy.data.materials.new(name)
    if data.node_tree is None:
        data.use_nodes = True
    tree = data.node_tree
    return tree, next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")


def output_of(tree: bpy.types.NodeTree) -> bpy.types.Node:
    return next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")


def add(tree: bpy.types.NodeTree, kind: str, *inputs, label: str = "", **settings) -> bpy.types.NodeSocket:
    """A node; `inputs` are values of, or links to, its enabled inputs in order. Returns its first enabled output."""
    node = tree.nodes.new("ShaderNode" + kind)
    node.label = label
    for key, value in settings.items():
        setattr(node, key, value)
    sockets = [s for s in node.inputs if s.enabled]
    for socket, value in zip(sockets, inputs):
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        elif value is not None:
            socket.default_value = (*value, 1) if socket.type == "RGBA" else value
    return next(s for s in node.outputs if s.enabled)


def emitting(tree: bpy.types.NodeTree, socket: bpy.types.NodeSocket) -> None:
    """Make a colour the light that a material gives off."""
    tree.links.new(add(tree, "Emission", socket), output_of(tree).inputs["Surface"])


def swatch(data: bpy.types.Material, x: float = 0.0) -> bpy.types.Object:
    """A square of four metres, one metre wide, with UVs from 0 to 1 and a material."""
    corners = [(x, -2, 0), (x + 1, -2, 0), (x + 1, 2, 0), (x, 2, 0)]
    obj = mesh_object(data.name, corners, [(0, 1, 2, 3)])
    obj.data.uv_layers.new().uv.foreach_set("vector", np.float32((0, 0, 1, 0, 1, 1, 0, 1)))
    obj.data.materials.append(data)
    return obj


def look_down(scene, width: int, height: int, metres: float, x: float, y: float = 0.0) -> None:
    """An orthographic camera above (x, y), `metres` wide."""
    camera = scene.camera
    camera.data.type, camera.data.ortho_scale = "ORTHO", metres
    camera.location, camera.rotation_euler = (x, y, 5), (0, 0, 0)
    scene.render.resolution_x, scene.render.resolution_y = width, height


def cycles_picture(scene) -> np.ndarray:
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, scene.render.resolution_x, scene.render.resolution_y)[..., :3]


A, B = (0.8, 0.3, 0.1), (0.2, 0.6, 0.9)


def curves(tree):
    socket = add(tree, "RGBCurve", 0.7, A)
    mapping = socket.node.mapping
    mapping.curves[0].points.new(0.5, 0.9)
    mapping.curves[3].points.new(0.4, 0.2)
    mapping.update()
    return socket


def ramp(tree):
    socket = add(tree, "ValToRGB", 0.3)
    socket.node.color_ramp.elements[0].color = (*A, 1)
    socket.node.color_ramp.elements[1].color = (*B, 1)
    return socket


def group(tree):
    inner = bpy.data.node_groups.new("Inner", "ShaderNodeTree")
    inner.interface.new_socket("Colour", in_out="INPUT", socket_type="NodeSocketColor")
    inner.interface.new_socket("Power", in_out="INPUT", socket_type="NodeSocketFloat")
    inner.interface.new_socket("Result", in_out="OUTPUT", socket_type="NodeSocketColor")
    entry, leave = inner.nodes.new("NodeGroupInput"), inner.nodes.new("NodeGroupOutput")
    inner.links.new(add(inner, "Gamma", entry.outputs[0], entry.outputs[1]), leave.inputs[0])
    outer = bpy.data.node_groups.new("Outer", "ShaderNodeTree")
    outer.interface.new_socket("Result", in_out="OUTPUT", socket_type="NodeSocketColor")
    nested, leave = outer.nodes.new("ShaderNodeGroup"), outer.nodes.new("NodeGroupOutput")
    nested.node_tree = inner
    nested.inputs[1].default_value = 2
    outer.links.new(add(outer, "RGB"), nested.inputs[0])
    next(n for n in outer.nodes if n.type == "RGB").outputs[0].default_value = (*A, 1)
    outer.links.new(nested.outputs[0], leave.inputs[0])
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = outer
    return node.outputs[0]


def separated(tree, mode):
    split = add(tree, "SeparateColor", A, mode=mode).node
    return add(tree, "CombineColor", split.outputs[2], split.outputs[0], split.outputs[1])


def reroute(tree):
    node = tree.nodes.new("NodeReroute")
    tree.links.new(add(tree, "Gamma", A, 2.0), node.inputs[0])
    return node.outputs[0]


def muted(tree):
    socket = add(tree, "Gamma", add(tree, "Invert", 1.0, A), 3.0)
    socket.node.mute = True
    return socket


BLENDS = ("MIX", "MULTIPLY", "ADD", "SUBTRACT", "DIVIDE", "SCREEN", "OVERLAY", "DIFFERENCE", "EXCLUSION")
MATHS = ("ADD", "SUBTRACT", "MULTIPLY", "DIVIDE", "POWER", "MINIMUM", "MAXIMUM", "LESS_THAN", "GREATER_THAN")
MATHS += ("SQRT", "ABSOLUTE", "MULTIPLY_ADD", "FLOOR", "CEIL", "ROUND", "FRACT", "SINE", "COSINE")

#: Name -> function of a tree that makes nodes whose colour does not vary, and gives the output.
CONSTANT = {
    **{f"mix {b}": lambda t, b=b: add(t, "Mix", 0.4, A, B, data_type="RGBA", blend_type=b) for b in BLENDS},
    "mix darken": lambda t: add(t, "Mix", 1.0, A, B, data_type="RGBA", blend_type="DARKEN"),
    "mix lighten": lambda t: add(t, "Mix", 1.0, A, B, data_type="RGBA", blend_type="LIGHTEN"),
    "mix beyond": lambda t: add(t, "Mix", 1.7, A, B, data_type="RGBA", clamp_factor=False, clamp_result=True),
    "mix float": lambda t: add(t, "Mix", 0.25, 0.2, 0.7, data_type="FLOAT"),
    "mix vector": lambda t: add(t, "Mix", 0.25, A, B, data_type="VECTOR"),
    "mix rgb": lambda t: add(t, "MixRGB", 0.4, A, B, blend_type="MULTIPLY"),
    **{f"math {m}": lambda t, m=m: add(t, "Math", 1.7, 0.6, 0.5, operation=m) for m in MATHS},
    "math clamped": lambda t: add(t, "Math", 1.7, 0.6, operation="MULTIPLY", use_clamp=True),
    "vector scale": lambda t: add(t, "VectorMath", A, 1.5, operation="SCALE"),
    "vector multiply": lambda t: add(t, "VectorMath", A, B, operation="MULTIPLY"),
    "gamma": lambda t: add(t, "Gamma", A, 2.2),
    "invert": lambda t: add(t, "Invert", 0.8, A),
    "contrast": lambda t: add(t, "BrightContrast", A, 0.1, 0.3),
    "hue": lambda t: add(t, "HueSaturation", 0.7, 0.6, 1.2, 0.9, A),
    "curves": curves,
    "ramp": ramp,
    "map range": lambda t: add(t, "MapRange", 0.4, 0.1, 0.9, 2.0, 3.0),
    "map range clamped": lambda t: add(t, "MapRange", 1.4, 0.1, 0.9, 2.0, 3.0, clamp=True),
    "clamp": lambda t: add(t, "Clamp", 1.4, 0.1, 0.9),
    "to grey": lambda t: add(t, "RGBToBW", A),
    "colour as number": lambda t: add(t, "Math", add(t, "Gamma", A, 1.0), 1.0, operation="MULTIPLY"),
    "vector as number": lambda t: add(t, "Math", add(t, "CombineXYZ", *A), 1.0, operation="MULTIPLY"),
    **{f"separate {m}": lambda t, m=m: separated(t, m) for m in ("RGB", "HSV", "HSL")},
    "combine hsv": lambda t: add(t, "CombineColor", 0.3, 0.5, 0.7, mode="HSV"),
    "combine hsl": lambda t: add(t, "CombineColor", 0.3, 0.5, 0.7, mode="HSL"),
    **{f"blackbody {k}": lambda t, k=k: add(t, "Blackbody", k) for k in (1900.0, 3000.0, 9000.0, 20000.0)},
    "group in a group": group,
    "reroute": reroute,
    "muted": muted,
}


def test_constant_nodes_have_the_colour_that_cycles_shows(scene, export):
    for i, (name, build) in enumerate(CONSTANT.items()):
        tree, _ = material(name)
        emitting(tree, build(tree))
        swatch(bpy.data.materials[name], i)
    look_down(scene, len(CONSTANT), 4, len(CONSTANT), len(CONSTANT) / 2, 0.3)
    frame, warnings = export()
    assert not warnings
    found = {m.materials[0].name: m.materials[0].emission for m in frame.meshes}
    theirs = dict(zip(CONSTANT, cycles_picture(scene)[1], strict=True))
    for name in CONSTANT:
        loose = 0.02 if "blackbody" in name else 1e-3
        expected = np.maximum(theirs[name], 0)
        np.testing.assert_allclose(found[name], expected, rtol=loose, atol=loose, err_msg=name)


# Textures


def picture(name: str = "Picture", alpha: bool = False, float_buffer: bool = False) -> bpy.types.Image:
    """8 x 8 pixels, all different."""
    image = bpy.data.images.new(name, 8, 8, alpha=True, float_buffer=float_buffer)
    pixels = np.random.default_rng(7).uniform(0.1, 1, (8, 8, 4)).astype(np.float32)
    if not alpha:
        pixels[..., 3] = 1
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    return image


def texel(frame, texture, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 4) linear: what materials.Texture and materials.Image say of the closest texel, repeated."""
    image = next(i for i in frame.images if i.name == texture.image)
    height, width, _ = image.pixels.shape
    s, t = texture.transform @ np.stack((u, v, np.ones_like(u)))
    x, y = np.floor(s % 1 * width).astype(int), np.floor((1 - t % 1) * height).astype(int)
    found = image.pixels[y.clip(0, height - 1), x.clip(0, width - 1)].astype(np.float64)
    if image.pixels.dtype == np.uint8:
        found /= 255
    if image.encoding == "srgb":
        rgb = found[:, :3]
        found[:, :3] = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return found


def encoded(values: np.ndarray) -> np.ndarray:
    """Linear -> sRGB."""
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * np.maximum(values, 0) ** (1 / 2.4) - 0.055)


def texture_node(tree, image, vector=None) -> bpy.types.Node:
    return add(tree, "TexImage", vector, image=image, interpolation="Closest").node


def mapping(kind: str):
    """Nodes between UV map and image."""
    place, turn, scale = (0.3, -0.2, 0.0), (0.0, 0.0, 0.7), (1.5, 0.8, 1.0)

    def build(tree):
        uv = add(tree, "UVMap")
        if kind in ("POINT", "TEXTURE", "VECTOR"):
            operands = [uv, place, turn, scale] if kind != "VECTOR" else [uv, turn, scale]
            return add(tree, "Mapping", *operands, vector_type=kind)
        if kind == "tilted":
            return add(tree, "Mapping", uv, place, (0.4, 0.3, 0.7), scale)
        if kind == "chain":
            moved = add(tree, "VectorMath", uv, (0.25, 0.5, 0), operation="ADD")
            doubled = add(tree, "VectorMath", moved, 2.0, operation="SCALE")
            return add(tree, "VectorMath", doubled, (1, 0.5, 1), operation="MULTIPLY")
        if kind == "rotate":
            return add(tree, "VectorRotate", uv, (0.5, 0.5, 0), 0.6, rotation_type="Z_AXIS")
        return add(tree, "Mapping", uv, add(tree, "CombineXYZ", 0.3, 0.1, 0.0))

    return build


@pytest.mark.parametrize("kind", ["POINT", "TEXTURE", "VECTOR", "tilted", "chain", "rotate", "linked"])
def test_texture_lies_on_the_surface_as_cycles_shows_it(scene, export, kind):
    tree, _ = material()
    vector = mapping(kind)(tree)
    emitting(tree, texture_node(tree, picture(), vector).outputs["Color"])
    obj = swatch(bpy.data.materials["Material"])
    obj.scale = (4, 1, 1)  # four metres square
    look_down(scene, 48, 48, 4, 2.003, 0.002)
    frame, warnings = export()
    (state,) = frame.meshes
    assert not warnings and state.uvs.shape == (2, 3, 2)
    y, x = np.mgrid[0:48, 0:48]
    u, v = (x.ravel() + 0.5) / 48 + 0.003 / 4, 1 - (y.ravel() + 0.5) / 48 + 0.002 / 4
    ours = texel(frame, state.materials[0].emission_texture, u, v)[:, :3]
    theirs = cycles_picture(scene).reshape(-1, 3)
    inside = (np.minimum(u, v) > 0) & (np.maximum(u, v) < 1)
    same = np.isclose(ours, theirs, atol=2e-3).all(1)[inside]
    assert same.mean() > 0.99, "all but where a pixel falls on the border of a texel"


@pytest.mark.parametrize("data", [False, True])
@pytest.mark.parametrize("use_alpha", [False, True])
@pytest.mark.parametrize("float_buffer", [False, True])
def test_pixels_are_those_of_cycles(scene, export, tmp_path, data, use_alpha, float_buffer):
    """Encodings, and what alpha does to colours: Cycles looks whether it is used."""
    image = picture(alpha=True, float_buffer=float_buffer)
    image.filepath_raw = str(tmp_path / ("picture.exr" if float_buffer else "picture.png"))
    image.file_format = "OPEN_EXR" if float_buffer else "PNG"
    image.save()
    image = bpy.data.images.load(image.filepath_raw)
    if data or float_buffer:
        image.colorspace_settings.name = "Non-Color" if data else "Linear Rec.709"
    tree, _ = material()
    node = texture_node(tree, image)
    glow = add(tree, "Emission", node.outputs["Color"])
    if use_alpha:
        glow = add(tree, "MixShader", node.outputs["Alpha"], add(tree, "BsdfTransparent"), glow)
    tree.links.new(glow, output_of(tree).inputs["Surface"])
    swatch(bpy.data.materials["Material"]).scale = (4, 1, 1)
    look_down(scene, 8, 8, 4, 2.001, 0.001)
    frame, warnings = export()
    assert not warnings
    (state,), (pixels,) = frame.meshes, frame.images
    assert pixels.pixels.dtype == (np.float32 if float_buffer else np.uint8)
    assert pixels.encoding == ("linear" if float_buffer or data else "srgb")
    y, x = np.mgrid[0:8, 0:8] + 0.5
    ours = texel(frame, state.materials[0].emission_texture, x.ravel() / 8, 1 - y.ravel() / 8)
    theirs, alpha = cycles_picture(scene).reshape(-1, 3), ours[:, 3:]
    if not use_alpha or float_buffer or data:
        shown = ours[:, :3] * (alpha if use_alpha else 1)  # over a black world
        np.testing.assert_allclose(shown, theirs, rtol=1e-4, atol=1e-5)
    else:  # Cycles multiplies the bytes by alpha and divides again: it loses up to one step of the product
        steps = [255 * encoded(colours) * alpha for colours in (ours[:, :3], theirs / alpha)]
        assert (steps[0] - steps[1] > -0.01).all() and (steps[0] - steps[1] < 1.01).all()


@pytest.mark.parametrize("use_alpha", [False, True])
@pytest.mark.parametrize("alpha_mode", ["STRAIGHT", "PREMUL", "CHANNEL_PACKED"])
@pytest.mark.parametrize("kind", ["generated", "packed", "generated bytes"])
def test_pixels_that_blender_holds_are_those_of_cycles(scene, export, kind, alpha_mode, use_alpha):
    """What alpha does to them depends on the mode, which Cycles reads otherwise from Blender 5.2 on."""
    image = picture(alpha=True, float_buffer=kind != "generated bytes")
    pixels = np.array(image.pixels[:], np.float32).reshape(-1, 4)
    pixels[:, 3] = 0.5 + pixels[:, 3] / 2
    pixels[:, :3] *= 0.5  # as premultiplied ones are
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    if kind == "packed":
        image.pack()
    image.alpha_mode = alpha_mode
    tree, _ = material()
    node = texture_node(tree, image)
    strength = add(tree, "Math", node.outputs["Alpha"], 2.0, operation="MULTIPLY") if use_alpha else 2.0
    glow = add(tree, "Emission", node.outputs["Color"], strength)
    tree.links.new(glow, output_of(tree).inputs["Surface"])
    swatch(bpy.data.materials["Material"]).scale = (4, 1, 1)
    look_down(scene, 8, 8, 4, 2.001, 0.001)
    frame, _ = export()
    (state,) = frame.meshes
    y, x = np.mgrid[0:8, 0:8] + 0.5
    found = state.materials[0]
    ours = texel(frame, found.emission_texture, x.ravel() / 8, 1 - y.ravel() / 8)
    theirs = cycles_picture(scene).reshape(-1, 3)
    shown = 2 * ours[:, :3] * (ours[:, 3:] if use_alpha else 1)
    np.testing.assert_allclose(shown, theirs, rtol=0.02, atol=4 / 255)


def textured(frame, field: str):
    """(value, texture) of a field of the only material."""
    found = frame.meshes[0].materials[0]
    return getattr(found, field), getattr(found, f"{field}_texture")


def test_every_quantity_takes_an_image_times_a_number(scene, export):
    tree, principled = material()
    node = texture_node(tree, picture())
    split = add(tree, "SeparateColor", node.outputs["Color"]).node
    tint = add(tree, "Mix", 1.0, node.outputs["Color"], (0.5, 1, 0.25), data_type="RGBA", blend_type="MULTIPLY")
    half = add(tree, "Math", split.outputs["Green"], 0.5, operation="MULTIPLY")
    tree.links.new(tint, principled.inputs["Base Color"])
    tree.links.new(half, principled.inputs["Roughness"])
    tree.links.new(split.outputs["Blue"], principled.inputs["Metallic"])
    tree.links.new(node.outputs["Color"], principled.inputs["Emission Color"])
    principled.inputs["Emission Strength"].default_value = 3
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert not warnings and [i.name for i in frame.images] == ["Picture"]
    expected = {
        "base_colour": ((0.5, 1, 0.25), "rgb"),
        "roughness": (0.5, "g"),
        "metallic": (1, "b"),
        "emission": ((3, 3, 3), "rgb"),
    }
    for field, (value, channel) in expected.items():
        found, texture = textured(frame, field)
        np.testing.assert_allclose(found, value, rtol=1e-6, err_msg=field)
        assert (texture.image, texture.channel, texture.interpolation) == ("Picture", channel, "closest")


def test_colour_of_an_image_as_a_number_is_its_luminance(scene, export):
    tree, principled = material()
    node = texture_node(tree, picture())
    tree.links.new(node.outputs["Color"], principled.inputs["Roughness"])
    swatch(bpy.data.materials["Material"])
    assert textured(export()[0], "roughness")[1].channel == "luminance"
    tree.links.new(node.outputs["Alpha"], principled.inputs["Roughness"])
    assert textured(export()[0], "roughness")[1].channel == "a"


def mean_of(frame, field: str) -> np.ndarray:
    """Mean over the texels of a field."""
    value, texture = textured(frame, field)
    if texture is None:
        return np.broadcast_to(value, 3)
    y, x = (np.mgrid[0:8, 0:8] + 0.5) / 8
    rgb = texel(frame, texture, x.ravel(), y.ravel())[:, :3]
    return (rgb * value).mean(0)


def stepped(tree, factor):
    socket = add(tree, "ValToRGB", factor)
    elements = socket.node.color_ramp.elements
    elements[0].color, elements[1].color = (*A, 1), (*B, 1)
    elements.new(0.4).color = (0.9, 0.9, 0.1, 1)
    return socket


#: Nodes after an image that work on each channel alone.
CURVES = {
    "brighter": lambda t, c: add(t, "Mix", 0.5, c, (0.9, 0.8, 0.7), data_type="RGBA"),
    "gamma": lambda t, c: add(t, "Gamma", c, 1.5),
    "invert": lambda t, c: add(t, "Invert", 1.0, c),
    "twice": lambda t, c: add(t, "BrightContrast", add(t, "Invert", 1.0, c), 0.1, 0.2),
    "beyond one": lambda t, c: add(t, "Mix", 1.0, c, (0.9, 0.9, 0.9), data_type="RGBA", blend_type="ADD"),
    "screen with itself": lambda t, c: add(t, "Mix", 1.0, c, c, data_type="RGBA", blend_type="SCREEN"),
    "ramp of a channel": lambda t, c: stepped(t, add(t, "SeparateColor", c).node.outputs[1]),
    "number": lambda t, c: add(t, "MapRange", add(t, "SeparateColor", c).node.outputs[2], 0.2, 0.7, 0.9, 0.1),
    "channel of a curve": lambda t, c: add(t, "SeparateColor", add(t, "Invert", 1.0, c)).node.outputs[1],
}


@pytest.mark.parametrize("kind", CURVES)
def test_curves_of_an_image_are_what_cycles_shows(scene, export, kind):
    tree, _ = material()
    emitting(tree, CURVES[kind](tree, texture_node(tree, picture()).outputs["Color"]))
    swatch(bpy.data.materials["Material"]).scale = (4, 1, 1)
    look_down(scene, 8, 8, 4, 2.001, 0.001)
    frame, warnings = export()
    value, texture = textured(frame, "emission")
    assert not warnings and len(frame.images) == 1
    y, x = (np.mgrid[0:8, 0:8] + 0.5) / 8
    ours = texel(frame, texture, x.ravel(), 1 - y.ravel())[:, :3]
    if texture.channel != "rgb":
        ours = np.repeat(ours[:, ["rgb".index(texture.channel)]], 3, axis=1)
    theirs = cycles_picture(scene).reshape(-1, 3)
    # Values are rounded to bytes: at most half a step, of the encoded value for colours.
    code = encoded if frame.images[0].encoding == "srgb" else np.asarray
    steps = code(ours) - code(theirs / max(value))
    assert np.abs(steps).max() < 0.55 / 255


def test_curves_of_numbers_keep_one_channel(scene, export):
    """Gloss maps: roughness is one minus a channel."""
    tree, principled = material()
    split = add(tree, "SeparateColor", texture_node(tree, picture()).outputs["Color"]).node
    tree.links.new(add(tree, "Math", 1.0, split.outputs[0], operation="SUBTRACT"), principled.inputs["Roughness"])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    value, texture = textured(frame, "roughness")
    (image,) = frame.images
    plain = part("addon.export.images").export_image(bpy.data.images["Picture"], False, warnings.append)
    uv = (np.mgrid[0:8, 0:8].reshape(2, -1) + 0.5) / 8
    linear = texel(replace(frame, images=[plain]), replace(texture, image=plain.name), *uv)
    ours = texel(frame, texture, *uv)
    assert not warnings and texture.channel == "r" and image.encoding == "linear" and value == 1
    np.testing.assert_allclose(ours[:, 0], 1 - linear[:, 0], atol=0.51 / 255)


INEXACT = {
    "saturation": lambda t, c: add(t, "HueSaturation", 0.5, 0.3, 1.0, 1.0, c),
    "gamma": lambda t, c: add(t, "Gamma", c, 1.5),
    "invert": lambda t, c: add(t, "Invert", 1.0, c),
}


@pytest.mark.parametrize("kind", INEXACT)
def test_what_cannot_be_done_to_an_image_keeps_its_mean(scene, export, kind):
    """Channels that work upon each other, and curves of float images."""
    tree, principled = material()
    image = picture(float_buffer=kind != "saturation")
    odd = INEXACT[kind](tree, texture_node(tree, image).outputs["Color"])
    odd.node.label = "The Odd One"
    tree.links.new(odd, principled.inputs["Base Color"])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert len(warnings) == 1 and 'Material "Material", node "The Odd One"' in warnings[0]
    assert (textured(frame, "base_colour")[1] is None) == (kind == "invert"), "a negative is no scaled image"
    plain = part("addon.export.images").export_image(image, False, warnings.append)
    mean = part("addon.export.images").mean_colour(plain)[:3]
    expected = {"gamma": mean**1.5, "invert": 1 - mean, "saturation": mean.max() - 0.3 * (mean.max() - mean)}
    np.testing.assert_allclose(mean_of(frame, "base_colour"), expected[kind], rtol=1e-5)


def test_of_two_images_the_one_with_more_influence_stays(scene, export):
    tree, principled = material()
    colours = [texture_node(tree, picture(name)).outputs["Color"] for name in ("Weak", "Strong")]
    mix = add(tree, "Mix", 0.8, *colours, data_type="RGBA")
    tree.links.new(mix, principled.inputs["Base Color"])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    (image,) = frame.images  # what is not used is not sent
    assert len(warnings) == 1 and image.name.startswith("Strong")
    assert textured(frame, "base_colour")[1].image == image.name
    mix.node.inputs["Factor"].default_value = 1
    frame, warnings = export()
    assert not warnings and textured(frame, "base_colour")[0] == pytest.approx((1, 1, 1))


PROCEDURAL = ["TexNoise", "TexVoronoi", "TexChecker", "TexBrick", "TexWave", "TexMagic", "TexGradient", "ObjectInfo"]


@pytest.mark.parametrize("socket", ["Base Color", "Roughness"])
@pytest.mark.parametrize("kind", PROCEDURAL)
def test_procedural_textures_are_named_and_never_black(scene, export, kind, socket):
    tree, principled = material()
    node = add(tree, kind, label="The Odd One").node
    source = next(s for s in node.outputs if s.enabled and s.type in ("RGBA", "VALUE"))
    tree.links.new(source, principled.inputs[socket])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert len(warnings) == 1 and 'Material "Material", node "The Odd One"' in warnings[0]
    found = frame.meshes[0].materials[0]
    assert min(found.base_colour) > 0.1 and 0.1 < found.roughness < 1


def test_loops_of_nodes_end(scene, export):
    tree, principled = material()
    first, second = (tree.nodes.new("NodeReroute") for _ in range(2))
    gammas = [add(tree, "Gamma", A, 2.0).node for _ in range(2)]
    for a, b in ((first, second), (second, first), gammas, gammas[::-1]):
        tree.links.new(a.outputs[0], b.inputs[0])
    tree.links.new(first.outputs[0], principled.inputs["Base Color"])
    tree.links.new(gammas[0].outputs[0], principled.inputs["Emission Color"])
    principled.inputs["Emission Strength"].default_value = 1
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    found = frame.meshes[0].materials[0]
    assert min(found.base_colour) > 0 and min(found.emission) > 0
    assert any('node "Gamma' in w and "part of a loop" in w for w in warnings), warnings


def test_nodes_that_share_a_source_are_worked_out_once(scene, export):
    """40 nodes in a row, each of which takes the one before twice: 2^40 ways from the first to the last."""
    tree, principled = material()
    value, shader = add(tree, "Value"), principled.outputs[0]
    value.default_value = 2.0**-41
    for _ in range(40):
        value = add(tree, "Math", value, value, operation="ADD")
        shader = add(tree, "MixShader", 0.5, shader, shader)
    tree.links.new(value, principled.inputs["Roughness"])
    tree.links.new(shader, output_of(tree).inputs["Surface"])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert not warnings
    assert frame.meshes[0].materials[0].roughness == pytest.approx(0.5)


@pytest.mark.slow
def test_very_long_rows_of_nodes_are_cut_off_and_named(scene, export):
    tree, principled = material()
    value, shader = add(tree, "Value"), principled.outputs[0]
    for i in range(400):
        value = add(tree, "Math", value, 0.0, operation="ADD", label=f"Sum {i}")
        shader = add(tree, "AddShader", shader, None)
    tree.links.new(value, principled.inputs["Roughness"])
    swatch(bpy.data.materials["Material"])
    frame, (warning,) = export()
    assert 'node "Sum 3' in warning and "left out" in warning
    assert frame.meshes[0].materials[0].roughness == 0.5
    tree.links.new(shader, output_of(tree).inputs["Surface"])
    _, warnings = export()
    assert any('node "Add Shader' in w and "left out" in w for w in warnings)


def test_senseless_numbers_are_named_and_stop_nothing(scene, export):
    tree, principled = material()
    principled.inputs["IOR"].default_value = -1
    hue = add(tree, "HueSaturation")
    hue.node.inputs["Color"].default_value = (np.nan, -1, 0, 1)
    split = add(tree, "SeparateColor", (-1.0, -2.0, 0.0), mode="HSV")
    split.node.inputs[0].default_value = (-1, -2, 0, 1)
    tree.links.new(hue, principled.inputs["Base Color"])
    tree.links.new(split.node.outputs[1], principled.inputs["Metallic"])
    tree.links.new(add(tree, "Fresnel", -1.0), principled.inputs["Roughness"])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert any("IOR" in w for w in warnings) and any("base colour is not finite" in w for w in warnings)
    found = frame.meshes[0].materials[0]
    assert found.base_colour == pytest.approx((0.8, 0.8, 0.8)) and found.metallic == 0 and 0 <= found.roughness <= 1


def shaded(tree, socket: bpy.types.NodeSocket) -> None:
    tree.links.new(socket, output_of(tree).inputs["Surface"])


SHADERS = {
    "diffuse": (lambda t: add(t, "BsdfDiffuse", A), (A, 1, 0, (0, 0, 0))),
    "glossy": (lambda t: add(t, "BsdfAnisotropic", A, 0.3), (A, 0.3, 1, (0, 0, 0))),
    "emission": (lambda t: add(t, "Emission", A, 2.0), ((0, 0, 0), 1, 0, (1.6, 0.6, 0.2))),
    "mix": (
        lambda t: add(t, "MixShader", 0.25, add(t, "BsdfDiffuse", A), add(t, "BsdfAnisotropic", B, 0.2)),
        ((0.65, 0.375, 0.3), 0.8, 0.25, (0, 0, 0)),
    ),
    "glowing": (
        lambda t: add(
            t, "MixShader", 0.25, add(t, "Emission", A, 4.0), add(t, "BsdfAnisotropic", B, 0.2, distribution="GGX")
        ),
        ((0.05, 0.15, 0.225), 0.2, 1, (2.4, 0.9, 0.3)),
    ),
    "sum": (
        lambda t: add(t, "AddShader", add(t, "Emission", A, 2.0), add(t, "BsdfDiffuse", B)),
        (B, 1, 0, (1.6, 0.6, 0.2)),
    ),
}


@pytest.mark.parametrize("kind", SHADERS)
def test_shaders_become_the_nearest_surface(scene, export, kind):
    tree, _ = material()
    build, expected = SHADERS[kind]
    shaded(tree, build(tree))
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    found = frame.meshes[0].materials[0]
    assert not warnings
    for value, wanted in zip((found.base_colour, found.roughness, found.metallic, found.emission), expected):
        np.testing.assert_allclose(value, wanted, rtol=1e-5, atol=1e-7)


def test_principled_values_and_those_out_of_range(scene, export):
    tree, principled = material()
    principled.distribution = "GGX"  # rough metals with the other one are told
    for name, value in {"Base Color": (*A, 1), "Roughness": 0.2, "Metallic": 0.7}.items():
        principled.inputs[name].default_value = value
    principled.inputs["Emission Color"].default_value = (1, 0.5, 0, 1)
    principled.inputs["Emission Strength"].default_value = 10
    swatch(bpy.data.materials["Material"])
    found = export()[0].meshes[0].materials[0]
    np.testing.assert_allclose(found.base_colour, A, rtol=1e-6)
    np.testing.assert_allclose((found.roughness, found.metallic), (0.2, 0.7), rtol=1e-6)
    np.testing.assert_allclose(found.emission, (10, 5, 0), rtol=1e-6)
    tree.links.new(add(tree, "Value"), principled.inputs["Roughness"])
    value = next(n for n in tree.nodes if n.type == "VALUE").outputs[0]
    for given, expected, count in ((-1, 0, 0), (7, 1, 0), (float("nan"), 0.5, 1)):
        value.default_value = given
        frame, warnings = export()
        assert frame.meshes[0].materials[0].roughness == expected and len(warnings) == count


def test_smoke_without_a_surface_is_not_a_solid_block(scene, export):
    tree, _ = material()
    output = output_of(tree)
    tree.links.remove(output.inputs["Surface"].links[0])
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert len(warnings) == 1 and "has no surface" in warnings[0]
    assert min(frame.meshes[0].materials[0].base_colour) > 0.1
    tree.links.new(add(tree, "VolumePrincipled"), output.inputs["Volume"])
    frame, warnings = export()
    assert frame.meshes == [] and len(warnings) == 1 and "volume" in warnings[0]


def test_unknown_shader_is_a_surface_of_its_colour(scene, export):
    tree, _ = material()
    shaded(tree, add(tree, "BsdfToon", A))
    swatch(bpy.data.materials["Material"])
    frame, warnings = export()
    assert len(warnings) == 1 and "Toon BSDF" in warnings[0]
    np.testing.assert_allclose(frame.meshes[0].materials[0].base_colour, A, rtol=1e-6)


@pytest.mark.skipif(bpy.app.version >= (5, 0, 0), reason="from Blender 5.0 on every material has nodes")
def test_material_without_nodes_has_its_viewport_values(scene, export):
    data = bpy.data.materials.new("Plain")
    data.diffuse_color, data.roughness, data.metallic = (*A, 1), 0.25, 0.75
    swatch(data)
    found = export()[0].meshes[0].materials[0]
    np.testing.assert_allclose(found.base_colour, A, rtol=1e-6)
    assert (found.roughness, found.metallic) == (0.25, 0.75)


def test_missing_image_is_magenta_as_in_cycles_and_named(scene, export, tmp_path):
    image = picture("Gone")
    image.source, image.filepath = "FILE", str(tmp_path / "gone.png")
    for name, picked in (("Gone", image), ("None", None)):
        tree, _ = material(name)
        emitting(tree, texture_node(tree, picked).outputs["Color"])
        swatch(bpy.data.materials[name], 2.0 * (name == "None"))
    frame, warnings = export()
    assert sorted("Gone" in w for w in warnings) == [False, True] and not frame.images
    look_down(scene, 4, 4, 4, 1.9, 0.1)
    theirs = cycles_picture(scene)[2]
    for state, pixel in zip(sorted(frame.meshes, key=lambda s: s.vertices[:, 0].min()), (theirs[0], theirs[2])):
        np.testing.assert_allclose(state.materials[0].emission, (1, 0, 1))
        np.testing.assert_allclose(pixel, (1, 0, 1), atol=1e-6)


def test_images_that_are_missing_are_named_and_nothing_is_baked_for_them(scene, export, tmp_path):
    export_frame, wanted = part("addon.export").export_frame, part("addon.bakes.requests").Wanted(64, 64)
    image = picture("Gone")
    image.source, image.filepath = "FILE", str(tmp_path / "gone.png")
    for name, picked in (("Gone", image), ("None", None)):
        tree, principled = material(name)
        tree.links.new(texture_node(tree, picked).outputs["Color"], principled.inputs["Base Color"])
        swatch(bpy.data.materials[name])
    warnings: list[str] = []
    frame = export_frame(bpy.context.evaluated_depsgraph_get(), str, warnings.append, wanted=wanted)
    assert sorted('image "Gone" cannot be read' in w for w in warnings) == [False, True] and not wanted.requests
    assert all(state.materials[0].base_colour == (1, 0, 1) for state in frame.meshes)
    (tmp_path / "gone.png").write_bytes(b"no picture")  # Cycles may read part of it
    warnings.clear()
    export_frame(bpy.context.evaluated_depsgraph_get(), str, warnings.append, wanted=wanted)
    assert sum('image "Gone" cannot be read' in w for w in warnings) == 1 and len(wanted.requests) == 1


def test_attributes_that_are_missing_are_named_where_they_are_baked(scene, export):
    export_frame, wanted = part("addon.export").export_frame, part("addon.bakes.requests").Wanted(64, 64)
    tree, principled = material()
    tree.links.new(add(tree, "Attribute", attribute_name="typo"), principled.inputs["Base Color"])
    swatch(bpy.data.materials["Material"])
    warnings: list[str] = []
    export_frame(bpy.context.evaluated_depsgraph_get(), str, warnings.append, wanted=wanted)
    assert len(wanted.requests) == 1 and sum('has no values "typo"' in text for text in warnings) == 1


def test_shaders_that_are_clear_everywhere_may_be_added(scene, export):
    tree, first = material("Clear")
    second, added = tree.nodes.new("ShaderNodeBsdfPrincipled"), tree.nodes.new("ShaderNodeAddShader")
    image = bpy.data.images.new("Black", 4, 4)
    for i, node in enumerate((first, second)):
        tree.links.new(texture_node(tree, image).outputs["Color"], node.inputs["Alpha"])
        tree.links.new(node.outputs[0], added.inputs[i])
    tree.links.new(added.outputs[0], output_of(tree).inputs["Surface"])
    swatch(bpy.data.materials["Clear"])
    assert not export()[0].meshes


def test_unchanged_images_are_not_read_again(scene, export, tmp_path):
    image = picture()
    image.filepath_raw, image.file_format = str(tmp_path / "picture.png"), "PNG"
    image.save()
    tree, principled = material()
    loaded = bpy.data.images.load(image.filepath_raw)
    tree.links.new(texture_node(tree, loaded).outputs["Color"], principled.inputs["Base Color"])
    swatch(bpy.data.materials["Material"])
    first = export()[0].images[0].pixels
    assert export()[0].images[0].pixels is first
    assert part("drgs_blender.core.arrays").frozen(first)
    loaded.pixels.foreach_set(np.tile(np.float32((0.5, 0.5, 0.5, 1)), 64))
    again = export()[0].images[0].pixels
    assert again is not first and np.unique(again[..., :3]).tolist() == [128]


def test_images_that_no_export_uses_are_let_go(scene, export, tmp_path):
    images = part("addon.export.images")
    image = picture()
    image.filepath_raw, image.file_format = str(tmp_path / "picture.png"), "PNG"
    image.save()
    tree, principled = material()
    loaded = bpy.data.images.load(image.filepath_raw)
    tree.links.new(texture_node(tree, loaded).outputs["Color"], principled.inputs["Base Color"])
    obj = swatch(bpy.data.materials["Material"])
    export()
    assert images._known
    obj.hide_viewport = True
    for _ in range(images.KEPT_EXPORTS + 2):
        export()
    assert not images._known


def test_a_view_layers_override_replaces_all_materials(scene, export, ball):
    """As in Cycles: of meshes with and without materials of their own, of every slot."""
    plain, slots = mesh_object("Plain", *sphere(4, 4)), mesh_object("Slots", *sphere(4, 4))
    for name in ("One", "Two"):
        slots.data.materials.append(bpy.data.materials.new(name))
    slots.data.polygons.foreach_set("material_index", np.arange(len(slots.data.polygons)) % 2)
    export()
    material("Clay")[1].inputs["Base Color"].default_value = (0.9, 0.1, 0.2, 1)
    bpy.context.view_layer.material_override = bpy.data.materials["Clay"]
    frame, warnings = export()
    assert {mesh.name for mesh in frame.meshes} == {plain.name, slots.name}
    assert {m.name for mesh in frame.meshes for m in mesh.materials} == {"Clay"}
    np.testing.assert_allclose(frame.meshes[0].materials[0].base_colour, (0.9, 0.1, 0.2), rtol=1e-6)
    assert len(warnings) == 1 and "Material Override" in warnings[0] and "DR-GS objects" in warnings[0]
