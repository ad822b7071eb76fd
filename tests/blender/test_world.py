"""World nodes: what the engine is told is what Cycles shows, and nothing turns black in silence."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import new_world, part, read_exr, write_exr

pytestmark = pytest.mark.blender_api


@pytest.fixture
def sky(tmp_path):
    """A float image file with a smooth colour for every direction."""
    height, width = 64, 128
    v, u = np.mgrid[0:height, 0:width]
    pixels = np.empty((height, width, 3), np.float32)
    pixels[..., 0] = 1.2 + np.sin(2 * np.pi * (u + 0.5) / width)
    pixels[..., 1] = 1.5 + np.cos(2 * np.pi * (u + 0.5) / width) * np.sin(np.pi * (v + 0.5) / height)
    pixels[..., 2] = 0.2 + (v + 0.5) / height
    write_exr(tmp_path / "sky.exr", pixels)
    return str(tmp_path / "sky.exr"), pixels


def link_sky(scene, path: str):
    """World with Mapping and Environment Texture; returns (tree, background, texture, mapping)."""
    tree, background = new_world(scene)
    texture, mapping = tree.nodes.new("ShaderNodeTexEnvironment"), tree.nodes.new("ShaderNodeMapping")
    coordinate = tree.nodes.new("ShaderNodeTexCoord")
    texture.image = bpy.data.images.load(path)
    tree.links.new(coordinate.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    return tree, background, texture, mapping


def picture_of(world, camera) -> np.ndarray:
    """(h, w, 3): the world as frame.World and frame.Camera define it, bilinear as Blender looks it up."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    local = np.stack(((x - camera.cx) / camera.fx, -(y - camera.cy) / camera.fy, -np.ones_like(x)), -1)
    d = local @ camera.matrix_world[:3, :3].T
    d = d / np.linalg.norm(d, axis=-1, keepdims=True) @ np.array(world.rotation).T
    scale = np.array(world.colour) * world.strength
    if world.environment is None:
        return np.broadcast_to(scale, d.shape)
    height, width, _ = world.environment.shape
    u = (0.5 - np.arctan2(d[..., 1], d[..., 0]) / (2 * np.pi)) * width - 0.5
    v = np.arccos(np.clip(d[..., 2], -1, 1)) / np.pi * height - 0.5
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    fu, fv = (u - i)[..., None], (v - j)[..., None]

    def at(row, column):
        return world.environment[np.clip(row, 0, height - 1), column % width]

    top = at(j, i) * (1 - fu) + at(j, i + 1) * fu
    return (top * (1 - fv) + (at(j + 1, i) * (1 - fu) + at(j + 1, i + 1) * fu) * fv) * scale


def cycles_picture(scene) -> np.ndarray:
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    if scene.world is not None:
        scene.world.cycles.sampling_method = "NONE"  # the camera looks at it, nothing is lit by it
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, scene.render.resolution_x, scene.render.resolution_y)[..., :3]


ROTATIONS = [(0, 0, 0), (0, 0, 1.0), (0.4, 0, 0), (0.3, -0.7, 2.1)]


@pytest.mark.parametrize("kind", ["POINT", "TEXTURE", "VECTOR"])
@pytest.mark.parametrize("rotation", ROTATIONS)
def test_rotated_environment_is_what_cycles_shows(scene, export, sky, rotation, kind):
    _, background, _, mapping = link_sky(scene, sky[0])
    mapping.vector_type = kind
    mapping.inputs["Rotation"].default_value = rotation
    background.inputs["Strength"].default_value = 1.7
    scene.camera.data.lens = 14
    frame, warnings = export()
    assert not warnings
    np.testing.assert_array_equal(frame.world.environment, sky[1])
    ours, theirs = picture_of(frame.world, frame.camera), cycles_picture(scene)
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.9995
    np.testing.assert_allclose(ours, theirs, rtol=0.03, atol=0.01)


def test_byte_image_is_decoded_as_cycles_does(scene, export, tmp_path):
    image = bpy.data.images.new("Byte", 32, 16)
    ramp = np.ones((16, 32, 4), np.float32)
    ramp[..., :3] = np.linspace(0.05, 0.95, 16)[:, None, None]
    image.pixels.foreach_set(ramp.ravel())
    image.filepath_raw, image.file_format = str(tmp_path / "sky.png"), "PNG"
    image.save()
    link_sky(scene, str(tmp_path / "sky.png"))
    scene.camera.data.lens = 14
    frame, warnings = export()
    assert not warnings
    np.testing.assert_allclose(picture_of(frame.world, frame.camera), cycles_picture(scene), rtol=0.02, atol=5e-3)


@pytest.mark.parametrize("name", [None, "/nowhere/sky.exr"])
def test_a_world_without_its_picture_is_magenta_as_in_cycles(scene, export, name):
    tree, background = new_world(scene)
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    if name:
        texture.image = bpy.data.images.new("sky", 4, 4)
        texture.image.source, texture.image.filepath = "FILE", name
    tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    background.inputs["Strength"].default_value = 0.5
    frame, (warning,) = export()
    assert '"World"' in warning and "magenta" in warning and ("cannot be read" if name else "has no image") in warning
    np.testing.assert_allclose(picture_of(frame.world, frame.camera), cycles_picture(scene), atol=1e-3)


def test_strength_and_colour_chains(scene, export, sky):
    tree, background, texture, _ = link_sky(scene, sky[0])
    tint, math, value = (tree.nodes.new(n) for n in ("ShaderNodeMix", "ShaderNodeMath", "ShaderNodeValue"))
    tint.data_type, tint.blend_type, math.operation = "RGBA", "MULTIPLY", "MULTIPLY"
    colours = {s.identifier: s for s in tint.inputs}
    colours["Factor_Float"].default_value, colours["B_Color"].default_value = 0.5, (1, 0.5, 0, 1)
    tree.links.new(texture.outputs["Color"], colours["A_Color"])
    tree.links.new(next(s for s in tint.outputs if s.type == "RGBA"), background.inputs["Color"])
    value.outputs[0].default_value, math.inputs[1].default_value = 2, 1.5
    tree.links.new(value.outputs[0], math.inputs[0])
    tree.links.new(math.outputs[0], background.inputs["Strength"])
    frame, warnings = export()
    assert not warnings
    np.testing.assert_allclose(np.array(frame.world.colour) * frame.world.strength, (3, 2.25, 1.5))
    np.testing.assert_allclose(picture_of(frame.world, frame.camera), cycles_picture(scene), rtol=0.03, atol=0.01)


def test_plain_colour_and_no_world(scene, export):
    _, background = new_world(scene)
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (0.1, 0.2, 0.3, 1), 2
    world = export()[0].world
    assert world.environment is None
    np.testing.assert_allclose(np.array(world.colour) * world.strength, (0.2, 0.4, 0.6), rtol=1e-6)
    scene.world = None
    assert export()[0].world.colour == (0, 0, 0)


def test_rotation_of_the_world_can_be_animated(scene, export, sky):
    *_, mapping = link_sky(scene, sky[0])
    for number, angle in ((1, 0.0), (11, 1.0)):
        mapping.inputs["Rotation"].default_value = (0, 0, angle)
        mapping.inputs["Rotation"].keyframe_insert("default_value", index=2, frame=number)
    pixels = set()
    for number, angle in ((1, 0.0), (11, 1.0)):
        scene.frame_set(number)
        world = export()[0].world
        np.testing.assert_allclose(world.rotation[0], (np.cos(angle), -np.sin(angle), 0), atol=1e-6)
        pixels.add(id(world.environment))
    assert len(pixels) == 1, "unchanged pixels are not read again"


def test_painted_image_is_read_again(scene, export, sky):
    *_, texture, _ = link_sky(scene, sky[0])
    export()
    texture.image.pixels.foreach_set(np.full(64 * 128 * 4, 0.25, np.float32))
    assert (export()[0].world.environment == 0.25).all()


UNSUPPORTED = ["ShaderNodeTexSky", "ShaderNodeTexNoise", "ShaderNodeTexGradient", "ShaderNodeObjectInfo"]


@pytest.mark.parametrize("kind", UNSUPPORTED)
def test_unsupported_texture_is_named_and_never_black(scene, export, kind):
    tree, background = new_world(scene)
    node = tree.nodes.new(kind)
    node.label = "The Odd One"
    tree.links.new(next(s for s in node.outputs if s.type == "RGBA"), background.inputs["Color"])
    frame, warnings = export()
    assert len(warnings) == 1 and '"The Odd One"' in warnings[0]
    assert max(frame.world.colour) > 0.01


def test_unsupported_node_between_image_and_background_keeps_the_image(scene, export, sky):
    tree, background, texture, _ = link_sky(scene, sky[0])
    node = tree.nodes.new("ShaderNodeHueSaturation")
    node.inputs["Saturation"].default_value = 0.5
    tree.links.new(texture.outputs["Color"], node.inputs["Color"])
    tree.links.new(node.outputs["Color"], background.inputs["Color"])
    frame, warnings = export()
    assert frame.world.environment is not None and len(warnings) == 1


def test_camera_only_background_is_seen_and_does_not_light(scene, export, sky):
    tree, background, *_ = link_sky(scene, sky[0])
    plate, mix, path = (
        tree.nodes.new(n) for n in ("ShaderNodeBackground", "ShaderNodeMixShader", "ShaderNodeLightPath")
    )
    output = next(n for n in tree.nodes if n.type == "OUTPUT_WORLD")
    tree.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    tree.links.new(background.outputs[0], mix.inputs[1])
    tree.links.new(plate.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    frame, warnings = export()
    assert frame.world.environment is not None and not warnings
    assert frame.background.environment is None and max(frame.background.colour) > 0


def test_missing_image_is_named_and_not_black(scene, export, sky, tmp_path):
    *_, texture, _ = link_sky(scene, sky[0])
    texture.image.filepath = str(tmp_path / "gone.exr")
    texture.image.reload()
    frame, warnings = export()
    assert len(warnings) == 1 and texture.image.name in warnings[0] and "Find Missing Files" in warnings[0]
    assert f'World "{scene.world.name}"' in warnings[0]
    assert frame.world.environment is None and max(frame.world.colour) > 0


def test_loading_another_file_drops_remembered_pixels(scene, export, sky):
    link_sky(scene, sky[0])
    export()
    images = part("addon.export.images")
    assert images._known
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert not images._known and not part("addon.assets")._open


@pytest.mark.parametrize("socket", ["Strength", "Color"])
def test_light_that_is_no_number_is_refused_by_the_name_of_its_world(scene, export, socket):
    _, background = new_world(scene)
    bad = float("nan")
    background.inputs[socket].default_value = bad if socket == "Strength" else (bad, 0, 0, 1)
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match=r'^World "World": .*not finite'):
        export()


def test_negative_light_is_black_and_said(scene, export):
    _, background = new_world(scene)
    background.inputs["Color"].default_value = (1, 0.5, 0.25, 1)
    background.inputs["Strength"].default_value = -2
    frame, warnings = export()
    assert frame.world.colour == (0, 0, 0)
    assert len(warnings) == 1 and '"World"' in warnings[0] and "negative" in warnings[0]


def test_texels_that_are_no_light_are_black_with_one_counted_warning(scene, sky, tmp_path):
    """The same rule as for an environment that the command line reads."""
    pixels = sky[1].copy()
    pixels[3, 5], pixels[10, 20, 1], pixels[40, 7, 0] = np.nan, np.inf, -1
    write_exr(tmp_path / "bad.exr", pixels)
    link_sky(scene, str(tmp_path / "bad.exr"))
    scene.render.image_settings.file_format = "OPEN_EXR"
    messages = part("addon.messages")
    for _ in range(2):  # the second frame has the picture from memory
        messages.history.clear()
        bpy.ops.render.render(write_still=True)
        texts = [m.text for m in messages.history if m.level == "WARNING" and m.text.startswith("world:")]
        assert len(texts) == 1 and texts[0].startswith("world: 3 pixels of the environment are negative, infinite or")
    assert np.isfinite(read_exr(scene.render.filepath, 64, 48)).all()
    assert [m for m in messages.history if "no DR-GS object" in m.text], "the empty scene is said as well"


@pytest.mark.skipif("world_override" not in bpy.types.ViewLayer.bl_rna.properties, reason="this Blender has none")
def test_a_view_layer_may_have_a_world_of_its_own(scene, export):
    new_world(scene)[1].inputs["Color"].default_value = (1, 0, 0, 1)
    other = scene.world.copy()
    next(n for n in other.node_tree.nodes if n.type == "BACKGROUND").inputs["Color"].default_value = (0, 0, 1, 1)
    assert export()[0].world.colour == (1, 0, 0)
    bpy.context.view_layer.world_override = other
    assert export()[0].world.colour == (0, 0, 1)


def test_rays_that_are_not_to_see_the_world_are_named(scene, export):
    new_world(scene)
    assert not export()[1]
    scene.world.cycles_visibility.camera = scene.world.cycles_visibility.glossy = False
    (warning,) = export()[1]
    assert '"World"' in warning and "camera and glossy rays" in warning and "Film > Transparent" in warning


def test_another_interpolation_of_the_picture_is_named(scene, export, sky):
    texture = link_sky(scene, sky[0])[2]
    assert not export()[1]
    texture.interpolation = "Closest"
    (warning,) = export()[1]
    assert '"World"' in warning and "Closest interpolation is read as Linear" in warning
