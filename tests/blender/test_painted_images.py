"""Painted images of DR-GS objects, wherever Blender keeps them and whatever is in their place."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import bmesh
import bpy
import numpy as np
import parity
import pytest
from scenes import part
from test_asset_textures import ball, image_of, paint, png, read, textured_ball  # noqa: F401 - a fixture

pytestmark = pytest.mark.blender_api

GREEN = (51, 204, 102)
PAINT = tuple(value / 255 for value in GREEN)


def imported(asset, path):
    part("drgs_blender.core.asset.container").write_asset(path, asset)
    bpy.ops.import_scene.drgs(filepath=str(path))
    return bpy.context.active_object


def with_slots(**numbers):
    """The ball whose lower material has other images in some slots."""
    asset, textures = textured_ball(), part("drgs_blender.core.asset.textures")
    slots = asset.mesh.textures.slots.copy()
    for name, number in numbers.items():
        slots[0, textures.SLOTS.index(name)] = number
    asset.mesh.textures = replace(asset.mesh.textures, slots=slots)
    return asset


def decoded(textures, name, folder):
    """Pixels of an image of an asset, (h, w, 4) bytes."""
    path = folder / "decoded.png"
    path.write_bytes(textures.images[name].tobytes())
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name, image.alpha_mode = "Non-Color", "CHANNEL_PACKED"
    pixels = np.rint(255 * np.array(image.pixels[:]).reshape(image.size[1], image.size[0], -1)[::-1])
    bpy.data.images.remove(image)
    return pixels


def save_in_editor(image, path=None):
    """Image > Save, or Save As."""
    window = bpy.context.window_manager.windows[0]
    area = window.screen.areas[0]
    area.type = "IMAGE_EDITOR"
    area.spaces.active.image = image
    with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
        bpy.ops.image.save() if path is None else bpy.ops.image.save_as(filepath=str(path))


@pytest.mark.parametrize("kept", ["Save", "Save As", "unpacked"])
def test_what_is_painted_and_saved_is_rendered_and_saved_with_the_asset(ball, tmp_path, export, kept):  # noqa: F811
    """Packed in the .blend, or in a file beside it."""
    image = image_of("albedo")
    if kept == "unpacked":
        image.unpack(method="WRITE_LOCAL")
        assert image.packed_file is None and not export()[0].objects[0].images
    paint(image, PAINT)
    save_in_editor(image, tmp_path / "painted.png" if kept == "Save As" else None)
    assert not image.is_dirty and (image.packed_file is None) == (kept != "Save")
    frame, warnings = export()
    (sent,) = frame.objects[0].images
    assert sent.name == "albedo" and tuple(sent.pixels[3, 3]) == GREEN and not warnings
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"))
    np.testing.assert_array_equal(decoded(read(tmp_path / "kept.drgs"), "albedo", tmp_path)[3, 3, :3], GREEN)
    assert (image.packed_file is None) == (kept != "Save")


def test_an_image_in_a_file_that_is_painted_and_not_saved_stays_so(ball, tmp_path):  # noqa: F811
    image = image_of("albedo")
    image.unpack(method="WRITE_LOCAL")
    paint(image, PAINT)
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"))
    np.testing.assert_array_equal(decoded(read(tmp_path / "kept.drgs"), "albedo", tmp_path)[3, 3, :3], GREEN)
    assert image.is_dirty and image.packed_file is None


def test_an_image_that_is_generated_in_place_is_sent(ball, export):  # noqa: F811
    image = image_of("albedo")
    image.source, image.generated_color = "GENERATED", (1, 0, 0, 1)
    assert [i.name for i in export()[0].objects[0].images] == ["albedo"]


def _space(obj):
    image_of("albedo").pack()  # else Blender reads it anew, without what is painted
    image_of("albedo").colorspace_settings.name = "Non-Color"
    return "albedo.png", "colour space Non-Color"


def _another(obj):
    image = bpy.data.images.new("mine", 4, 4)
    _nodes(obj, image_of("albedo"))[0].image = image
    return "mine", "none of its asset"


def _removed(obj):
    bpy.data.images.remove(image_of("albedo"))
    return "below", "no image"


def _two(obj):
    copy = image_of("albedo").copy()
    _nodes(obj, image_of("albedo"))[0].image = copy
    paint(copy, (1, 0, 0))
    return copy.name, "stands for the same image"


def _nodes(obj, image):
    nodes = [node for material in obj.data.materials for node in material.node_tree.nodes]
    return [node for node in nodes if node.type == "TEX_IMAGE" and node.image == image]


@pytest.mark.parametrize("change", [_space, _another, _removed, _two])
def test_what_is_in_the_place_of_an_image_and_not_rendered_is_told(ball, export, change):  # noqa: F811
    paint(image_of("albedo"), PAINT)
    name, problem = change(ball)
    assert [text for text in export()[1] if name in text and problem in text]


def _grouped(obj, image, depth):
    """Put the nodes of an image into groups, `depth` within each other; the innermost group."""
    tree = bpy.data.node_groups.new("innermost", "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    end, texture = tree.nodes.new("NodeGroupOutput"), tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    tree.links.new(texture.outputs["Color"], end.inputs[0])
    outer = tree
    for _ in range(depth - 1):
        inner, outer = outer, bpy.data.node_groups.new("outer", "ShaderNodeTree")
        outer.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
        node, end = outer.nodes.new("ShaderNodeGroup"), outer.nodes.new("NodeGroupOutput")
        node.node_tree = inner
        outer.links.new(node.outputs[0], end.inputs[0])
    for material in obj.data.materials:
        nodes, links = material.node_tree.nodes, material.node_tree.links
        for plain in [node for node in nodes if node.type == "TEX_IMAGE" and node.image == image]:
            group = nodes.new("ShaderNodeGroup")
            group.node_tree = outer
            for link in list(plain.outputs["Color"].links):
                links.new(group.outputs[0], link.to_socket)
            nodes.remove(plain)
    return tree


@pytest.mark.parametrize("depth", [1, 2])
def test_what_is_painted_within_node_groups_is_rendered(ball, export, depth):  # noqa: F811
    """And forgotten in viewports once the group shows the image no more."""
    exported = lambda: part("addon.viewport.scenes").exported(bpy.context.evaluated_depsgraph_get())  # noqa: E731
    image = image_of("albedo")
    inner = _grouped(ball, image, depth)
    bpy.context.view_layer.update()
    assert not exported().frame.objects[0].images
    paint(image, PAINT)
    bpy.context.view_layer.update()
    (sent,) = exported().frame.objects[0].images
    assert sent.name == "albedo" and tuple(sent.pixels[3, 3]) == GREEN
    next(node for node in inner.nodes if node.type == "TEX_IMAGE").image = bpy.data.images.new("mine", 4, 4)
    bpy.context.view_layer.update()
    assert not exported().frame.objects[0].images
    assert [text for text in export()[1] if "mine" in text and "none of its asset" in text]


def test_the_header_says_that_splats_show_painted_images_once_they_are_saved(ball, tmp_path):  # noqa: F811
    surfels, views = part("addon.viewport.surfels"), part("addon.viewport.views")
    window = SimpleNamespace(type="WINDOW", as_pointer=lambda: 7)
    context = SimpleNamespace(area=SimpleNamespace(regions=[window]), region=window)

    def told():
        surfels._share(context, bpy.context.evaluated_depsgraph_get())
        surfels.cache.end()
        return surfels.reduction(views.name_of(window))

    assert not told()
    paint(image_of("albedo"), PAINT)
    bpy.context.view_layer.update()
    assert "Save Edited Asset" in told()
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"), use_saved=True)
    bpy.context.view_layer.update()
    assert not told()


@pytest.mark.parametrize("kind", ["WEBP", "TARGA"])
def test_a_packed_file_of_another_kind_is_saved_as_a_png_and_stays(ball, tmp_path, kind):  # noqa: F811
    settings = bpy.context.scene.render.image_settings
    settings.file_format, settings.color_mode = kind, "RGB"
    bpy.context.scene.view_settings.view_transform = "Raw"
    made = bpy.data.images.new("made", 8, 8)
    paint(made, PAINT)
    made.save_render(str(tmp_path / "made"))
    image, data = image_of("albedo"), (tmp_path / "made").read_bytes()
    image.pack(data=data, data_len=len(data))
    image.reload()
    given = np.rint(255 * np.array(image.pixels[:3]))
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"))
    assert image.packed_file is not None and image.packed_file.data == data
    np.testing.assert_array_equal(decoded(read(tmp_path / "kept.drgs"), "albedo", tmp_path)[0, 0, :3], given)


@pytest.mark.parametrize("alpha", [0.5, 1.0])
def test_alpha_of_a_new_file_counts_only_where_that_of_the_assets_does(scene, tmp_path, alpha):
    """Opacity in the red of an image without alpha: packed over it is one with."""
    imported(with_slots(opacity=1), tmp_path / "ball.drgs")
    made = bpy.data.images.new("made", 8, 8, alpha=True)
    made.pixels.foreach_set(np.tile(np.float32((0.2, 0.4, 0.6, alpha)), 64))
    made.pack()
    data = bytes(made.packed_file.data)
    assert part("drgs_blender.core.asset.textures").has_alpha(data)
    image = image_of("surface")
    image.pack(data=data, data_len=len(data))
    image.reload()
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"))
    textures = read(tmp_path / "kept.drgs")
    assert textures.channel(4, textures.slots[0, 4]) == "r"
    np.testing.assert_array_equal(decoded(textures, "surface", tmp_path)[0, 0, :3], (51, 102, 153))


def test_what_is_painted_on_an_image_of_a_library_and_not_saved_is_saved_with_the_asset(ball, tmp_path, export):  # noqa: F811
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    camera = bpy.context.scene.camera.name
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["ball", camera]
    obj, scene = wanted.objects[0], bpy.context.scene
    scene.camera = wanted.objects[1]
    obj = obj.override_create()
    scene.collection.objects.link(obj)
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj
    image = image_of("albedo")
    assert image.library is not None
    paint(image, PAINT)
    assert [i.name for i in export()[0].objects[0].images] == ["albedo"]
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"))
    np.testing.assert_array_equal(decoded(read(tmp_path / "kept.drgs"), "albedo", tmp_path)[3, 3, :3], GREEN)
    assert image.is_dirty, "what is of a library stays as it is"


def test_a_file_that_is_colour_and_data_is_painted_again_after_it_is_saved(scene, tmp_path, export):
    """Of the new file, in which it is two images."""
    obj = imported(with_slots(albedo=0, roughness=0), tmp_path / "ball.drgs")
    image = next(i for i in bpy.data.images if i.get("drgs_image") == "albedo" and i.colorspace_settings.name == "sRGB")
    for value in (0.2, 0.4):
        paint(image, (value, value, value))
        (sent,) = export()[0].objects[0].images
        textures = read(part("addon.assets").file_of(obj))
        assert list(textures.images).index(sent.name) == textures.slots[0, 0]
        bpy.ops.drgs.save_asset(filepath=str(tmp_path / f"kept {value}.drgs"), use_saved=True)
        textures = read(tmp_path / f"kept {value}.drgs")
        name = list(textures.images)[textures.slots[0, 0]]
        assert decoded(textures, name, tmp_path)[0, 0, 0] == round(255 * value)
        name = list(textures.images)[textures.slots[0, 1]]
        assert textures.images[name].tobytes() == textured_ball().mesh.textures.images["albedo"].tobytes()
        assert not export()[0].objects[0].images


def test_objects_that_show_an_image_share_its_pixels(ball, export):  # noqa: F811
    paint(image_of("albedo"), PAINT)
    other = ball.copy()
    bpy.context.scene.collection.objects.link(other)
    first, second = (state.images[0].pixels for state in export()[0].objects)
    assert first is second


def test_an_image_whose_mark_is_lost_has_its_name(ball, export):  # noqa: F811
    image = image_of("albedo")
    image["drgs_textures"] = ""
    paint(image, PAINT)
    image.pack()
    assert [i.name for i in export()[0].objects[0].images] == ["albedo"]


def test_a_damaged_image_of_an_asset_is_painted_over(scene, tmp_path):
    """And what was never looked up in it stays at the vertices, as it is rendered."""
    asset = textured_ball()
    good = asset.mesh.textures.images["albedo"].tobytes()
    imported(asset, tmp_path / "ball.drgs")
    image = image_of("albedo")
    paint(image, PAINT)
    damaged = textured_ball()
    damaged.mesh.textures.images["albedo"] = np.frombuffer(good[:40], np.uint8)
    part("drgs_blender.core.asset.container").write_asset(tmp_path / "damaged.drgs", damaged)
    obj = bpy.context.active_object
    obj.drgs.asset = part("addon.assets").anchor(tmp_path / "damaged.drgs")
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"))
    kept = part("drgs_blender.core.asset.container").read_asset(tmp_path / "kept.drgs")
    np.testing.assert_array_equal(decoded(kept.mesh.textures, "albedo", tmp_path)[3, 3, :3], GREEN)
    np.testing.assert_array_equal(kept.mesh.albedo, damaged.mesh.albedo)


def test_meshes_are_swapped_once_what_is_painted_on_images_is_saved(ball, tmp_path):  # noqa: F811
    """The new mesh has other UVs: its vertices have the colours of the file."""
    bpy.ops.mesh.primitive_uv_sphere_add(radius=1.0)
    other = bpy.context.active_object
    paint(image_of("albedo"), PAINT)
    ball.select_set(True)
    bpy.context.view_layer.objects.active = ball
    with pytest.raises(RuntimeError, match=r"painted and not in its file \(albedo\)"):
        bpy.ops.drgs.swap_mesh(filepath=str(tmp_path / "swapped.drgs"))
    other.select_set(False)
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"), use_saved=True)
    other.select_set(True)
    assert bpy.ops.drgs.swap_mesh(filepath=str(tmp_path / "swapped.drgs")) == {"FINISHED"}
    mesh = part("drgs_blender.core.asset.container").read_asset(tmp_path / "swapped.drgs").mesh
    linear = ((np.array(PAINT) + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(mesh.albedo[mesh.vertices[:, 2].argmax()], linear, atol=0.02)


def test_a_saved_asset_looks_as_the_painted_object_did(scene, ball, tmp_path):  # noqa: F811
    """To the last bit; adjusted, and a part of it deleted."""
    parity.light(scene)
    parity.set_up(scene, 48, samples=8, bounces=1)
    edit = bmesh.new()
    edit.from_mesh(ball.data)
    bmesh.ops.delete(edit, geom=[f for f in edit.faces if f.calc_center_median().x > 0.4], context="FACES")
    edit.to_mesh(ball.data)
    edit.free()
    ball.drgs.adjustment.tint = (0.5, 0.75, 1.0)
    for name in ("albedo", "surface", "bumps"):
        image = image_of(name)
        pixels = np.array(image.pixels[:], np.float32).reshape(image.size[1], -1, 4)
        pixels[2:5, 1:6, :3] = 0.2, 0.6, 0.9
        image.pixels.foreach_set(pixels.ravel())
        image.update()
    before = parity.pictures(scene, "DRGS")
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "kept.drgs"), use_saved=True)
    np.testing.assert_array_equal(parity.pictures(scene, "DRGS"), before)


def test_viewports_read_painted_images_again_for_images_and_materials_alone(ball, monkeypatch):  # noqa: F811
    """Not for the World, of which a slider is dragged; for a node that shows another image."""
    exported = lambda: part("addon.viewport.scenes").exported(bpy.context.evaluated_depsgraph_get())  # noqa: E731
    pixels, reads = part("addon.export.image_pixels"), []
    original = pixels.straight
    monkeypatch.setattr(pixels, "straight", lambda image: (reads.append(image.name), original(image))[1])
    world = bpy.context.scene.world = bpy.data.worlds.new("World")
    if world.node_tree is None:  # before Blender 5.0
        world.use_nodes = True
    image = image_of("albedo")
    paint(image, PAINT)
    bpy.context.view_layer.update()
    assert exported().frame.objects[0].images
    reads.clear()
    strength = next(n for n in world.node_tree.nodes if n.type == "BACKGROUND").inputs["Strength"]
    for value in (0.5, 0.75):
        strength.default_value = value
        bpy.context.view_layer.update()
        assert exported().frame.objects[0].images and not reads
    for node in _nodes(ball, image):
        node.image = image_of("bumps")
    bpy.context.view_layer.update()
    assert not exported().frame.objects[0].images
