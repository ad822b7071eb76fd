"""What is bad is named: an image, a node, a lamp, an object. Nothing crashes, and everything beside it is exported."""

from __future__ import annotations

import builtins
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from scenes import mesh_object, new_world, part
from test_materials import add, material, output_of, swatch

NAN, INF = float("nan"), float("inf")


def picture(path: Path, kind: str, share: float = 1.0) -> bpy.types.Image:
    """An image of noise, of which the file has only a share of its bytes."""
    made = bpy.data.images.new("made", 64, 64, alpha=False, float_buffer=kind == "OPEN_EXR")
    made.pixels.foreach_set(np.random.default_rng(0).random(64 * 64 * 4).astype(np.float32))
    made.filepath_raw, made.file_format = str(path), kind
    made.save()
    bpy.data.images.remove(made)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return bpy.data.images.load(str(path))


def textured(image: bpy.types.Image, *vector) -> None:
    """A square whose base colour is an image."""
    tree, principled = material("Bad")
    tree.links.new(add(tree, "TexImage", *vector, image=image), principled.inputs["Base Color"])
    swatch(tree.id_data if tree.id_data.name == "Bad" else bpy.data.materials["Bad"])


def around(scene, image: bpy.types.Image | None) -> bpy.types.Node:
    """A World that is an image; returns its texture node."""
    tree, background = new_world(scene)
    colour = add(tree, "TexEnvironment", image=image)
    tree.links.new(colour, background.inputs["Color"])
    return colour.node


def loop(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """The output of two Mapping nodes that feed each other."""
    first, second = add(tree, "Mapping"), add(tree, "Mapping")
    tree.links.new(first, second.node.inputs["Vector"])
    tree.links.new(second, first.node.inputs["Vector"])
    return second


def surface_exr(scene, folder: Path, drgs) -> None:
    textured(picture(folder / "a.exr", "OPEN_EXR", 0.5))


def world_exr(scene, folder: Path, drgs) -> None:
    around(scene, picture(folder / "a.exr", "OPEN_EXR", 0.5))


def odd_exr(scene, folder: Path, drgs) -> None:
    image = picture(folder / "a.exr", "OPEN_EXR", 0.5)
    image.colorspace_settings.name = "ACEScg"
    textured(image)


def sequence_exr(scene, folder: Path, drgs) -> None:
    image = picture(folder / "a.0001.exr", "OPEN_EXR", 0.5)
    image.source = "SEQUENCE"
    textured(image)
    bpy.data.materials["Bad"].node_tree.nodes["Image Texture"].image_user.frame_duration = 1


def tile_exr(scene, folder: Path, drgs) -> None:
    picture(folder / "a.1001.exr", "OPEN_EXR")
    picture(folder / "a.1002.exr", "OPEN_EXR", 0.5)
    image = bpy.data.images["a.1001.exr"]
    image.source, image.filepath = "TILED", str(folder / "a.<UDIM>.exr")
    if len(image.tiles) == 1:
        image.tiles.new(1002)
    textured(image)


def cut_jpeg(scene, folder: Path, drgs) -> None:
    textured(picture(folder / "a.jpg", "JPEG", 0.5))


def packed_jpeg(scene, folder: Path, drgs) -> None:
    image = picture(folder / "a.jpg", "JPEG", 0.5)
    image.pack()
    textured(image)


def cut_webp(scene, folder: Path, drgs) -> None:
    textured(picture(folder / "a.webp", "WEBP", 0.5))


def cut_tiff(scene, folder: Path, drgs) -> None:
    textured(picture(folder / "a.tif", "TIFF", 0.5))


def surface_loop(scene, folder: Path, drgs) -> None:
    textured(picture(folder / "a.png", "PNG"))
    tree = bpy.data.materials["Bad"].node_tree
    tree.links.new(loop(tree), tree.nodes["Image Texture"].inputs["Vector"])


def world_loop(scene, folder: Path, drgs) -> None:
    node = around(scene, picture(folder / "a.exr", "OPEN_EXR"))
    node.id_data.links.new(loop(node.id_data), node.inputs["Vector"])


def normal_loop(scene, folder: Path, drgs) -> None:
    tree, principled = material("Bad")
    first, second = add(tree, "Bump"), add(tree, "Bump")
    tree.links.new(first, second.node.inputs["Normal"])
    tree.links.new(second, first.node.inputs["Normal"])
    tree.links.new(second, principled.inputs["Normal"])
    swatch(bpy.data.materials["Bad"])


def group(kind: str) -> tuple[bpy.types.NodeTree, bpy.types.Node, bpy.types.Node]:
    """A material with a node group of one output, without an output node: its tree, the group node, its shader."""
    tree, principled = material("Bad")
    made = bpy.data.node_groups.new("Hollow", "ShaderNodeTree")
    made.interface.new_socket("Out", in_out="OUTPUT", socket_type=kind)
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = made
    swatch(bpy.data.materials["Bad"])
    return tree, node, principled


def hollow_colour(scene, folder: Path, drgs) -> None:
    tree, node, principled = group("NodeSocketColor")
    tree.links.new(node.outputs[0], principled.inputs["Base Color"])


def hollow_shader(scene, folder: Path, drgs) -> None:
    tree, node, _ = group("NodeSocketShader")
    tree.links.new(node.outputs[0], output_of(tree).inputs["Surface"])


def removed_group(scene, folder: Path, drgs) -> None:
    hollow_colour(scene, folder, drgs)
    bpy.data.node_groups.remove(bpy.data.node_groups["Hollow"])


def lost_group(tree: bpy.types.NodeTree, kind: str = "NodeSocketColor") -> bpy.types.Node:
    """A node of a group that holds a node of a group that is gone."""
    made = bpy.data.node_groups.new("Outer", "ShaderNodeTree")
    made.interface.new_socket("Out", in_out="OUTPUT", socket_type=kind)
    made.nodes.new("NodeGroupOutput")
    made.nodes.new("ShaderNodeGroup").name = "Lost"
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = made
    return node


def hollow_group(tree: bpy.types.NodeTree) -> bpy.types.Node:
    """A node of a group of shaders that is empty."""
    node = lost_group(tree, "NodeSocketShader")
    node.node_tree.nodes.clear()
    return node


def light_tree() -> bpy.types.NodeTree:
    light = bpy.data.objects["Bad"].data
    light.use_nodes = True
    return light.node_tree


def nested_group(scene, folder: Path, drgs) -> None:
    tree, principled = material("Bad")
    tree.links.new(lost_group(tree).outputs[0], principled.inputs["Base Color"])
    swatch(bpy.data.materials["Bad"])


def world_group(scene, folder: Path, drgs) -> None:
    tree, background = new_world(scene)
    tree.links.new(lost_group(tree).outputs[0], background.inputs["Color"])


def world_shader_group(scene, folder: Path, drgs) -> None:
    tree, _ = new_world(scene)
    tree.links.new(hollow_group(tree).outputs[0], tree.get_output_node("ALL").inputs["Surface"])


def light_group(scene, folder: Path, drgs) -> None:
    lamp(scene, "POINT")
    tree = light_tree()
    (emission,) = (node for node in tree.nodes if node.type == "EMISSION")
    tree.links.new(lost_group(tree).outputs[0], emission.inputs["Color"])


def light_shader_group(scene, folder: Path, drgs) -> None:
    lamp(scene, "POINT")
    tree = light_tree()
    tree.links.new(hollow_group(tree).outputs[0], tree.get_output_node("ALL").inputs["Surface"])


def lamp(scene, kind: str, **values: float) -> None:
    light = bpy.data.lights.new("Bad", kind)
    for name, value in values.items():
        setattr(light, name, value)
    scene.collection.objects.link(bpy.data.objects.new("Bad", light))


def point(scene, folder: Path, drgs) -> None:
    lamp(scene, "POINT", shadow_soft_size=NAN)


def area(scene, folder: Path, drgs) -> None:
    lamp(scene, "AREA", size=NAN)


def sun(scene, folder: Path, drgs) -> None:
    lamp(scene, "SUN", angle=NAN)


def nowhere(scene, folder: Path, drgs) -> None:
    drgs().scale.x = NAN


def infinite_paint(scene, folder: Path, drgs) -> None:
    drgs().data.attributes["roughness"].data[0].value = INF


def lost_mask(scene, folder: Path, drgs) -> None:
    obj = drgs()
    values = np.full(len(obj.data.vertices), NAN, np.float32)
    obj.data.attributes.new("Mask", "FLOAT", "POINT").data.foreach_set("value", values)
    obj.drgs.adjustment.mask, obj.drgs.adjustment.tint = "Mask", (0.5, 0.5, 0.5)


def lost_normals(scene, folder: Path, drgs) -> None:
    if bpy.app.version < (5, 0, 0):
        pytest.skip("before Blender 5.0 custom normals are angles")
    obj = mesh_object("Bad", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    corners = obj.data.attributes.new("custom_normal", "FLOAT_VECTOR", "CORNER")
    corners.data.foreach_set("vector", np.full(9, NAN, np.float32))


CUT_OFF = "its file is cut off; as much of it is shown as can be read. Copy or export it again"
LOOP = 'the link to "{}" is part of a loop; it is left out'
OFF = 'Light "Bad": its colour, power or size is not finite; it is off. Check its values and their drivers'
HOLLOW = 'Material "Bad", node "Group": its node group "Hollow" has no output; '
LOST = 'node "Lost": has no node group (in "Outer"); what it fed is as if unlinked. Choose one'
EMPTY = 'node "Group": its node group "Outer" has no output'
CASES = {
    surface_exr: f'Image "a.exr": {CUT_OFF}',
    odd_exr: f'Image "a.exr": {CUT_OFF}',
    world_exr: 'World "World", node "Environment Texture": image "a.exr" cannot be read; what Cycles makes of it is',
    sequence_exr: f'Image "a.0001.exr": {CUT_OFF}',
    tile_exr: f'Image "a.1001.exr": tile 1002: {CUT_OFF}',
    cut_jpeg: f'Image "a.jpg": {CUT_OFF}',
    packed_jpeg: f'Image "a.jpg": {CUT_OFF}',
    cut_tiff: f'Image "a.tif": {CUT_OFF}',
    cut_webp: f'Image "a.webp": {CUT_OFF}',
    surface_loop: f'Material "Bad", node "Mapping": {LOOP.format("Vector")}',
    world_loop: f'World "World", node "Mapping": {LOOP.format("Vector")}',
    normal_loop: f'Material "Bad", node "Bump": {LOOP.format("Normal")}',
    hollow_colour: f"{HOLLOW}it is black in Cycles. Mend or replace it",
    hollow_shader: f"{HOLLOW}a surface of its colour is used",
    removed_group: 'Material "Bad", node "Group": has no node group; what it fed is as if unlinked. Choose one',
    nested_group: f'Material "Bad", {LOST}',
    world_group: f'World "World", {LOST}',
    world_shader_group: f'World "World", {EMPTY}; it is black in Cycles, here a dim grey. Mend or replace it',
    light_group: f'Light "Bad", {LOST}',
    light_shader_group: f'Light "Bad", {EMPTY}; its own colour is used',
    point: OFF,
    area: OFF,
    sun: OFF,
    nowhere: '"ball": its transform is not finite; it is left out. Check its drivers and constraints',
    infinite_paint: '"ball": 1 values of attribute roughness are not finite; the asset\'s are used there',
    lost_mask: '"ball": 86 values of the mask "Mask" are not finite; 0 is used there',
    lost_normals: '"Bad": 3 of its custom normals are not finite; its faces\' own are used there. Clear them',
}  # fmt: skip


@pytest.mark.parametrize("make", CASES, ids=lambda make: make.__name__)
def test_it_is_named_and_the_rest_is_exported(scene, export, tmp_path, request, make):
    mesh_object("Good", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    make(scene, tmp_path, lambda: request.getfixturevalue("ball"))
    for _ in range(2):  # from memory, too
        frame, warnings = export()
        assert any(text.startswith(CASES[make]) for text in warnings), warnings
        assert "Good" in {mesh.name for mesh in frame.meshes}
        assert np.isfinite([light.power for light in frame.lights]).all()


def test_a_node_group_whose_library_is_gone_is_named_with_it(scene, export, tmp_path):
    hollow_shader(scene, tmp_path, None)
    made, library = bpy.data.node_groups["Hollow"], str(tmp_path / "lib.blend")
    bpy.data.libraries.write(library, {made})
    node = bpy.data.materials["Bad"].node_tree.nodes["Group"]
    with bpy.data.libraries.load(library, link=True) as (_, wanted):
        wanted.node_groups = ["Hollow"]
    (node.node_tree,) = wanted.node_groups
    bpy.data.node_groups.remove(made)
    bpy.ops.wm.save_mainfile()
    Path(library).unlink()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    (text,) = set(export()[1])
    assert text.startswith('Material "Bad", node "Group": its node group "Hollow" is missing from ') and library in text


@pytest.mark.parametrize("kind", ["OPEN_EXR", "HDR", "PNG", "JPEG", "WEBP", "TIFF", "TARGA", "BMP", "JPEG2000"])
def test_a_whole_file_is_nothing_to_speak_of(scene, export, tmp_path, kind):
    textured(picture(tmp_path / "a", kind))
    frame, warnings = export()
    assert not warnings and len(frame.images) == 1


def test_a_cut_off_exr_is_no_light(scene, tmp_path):
    """Blender 5.0 crashes where it is asked for its size."""
    picture(tmp_path / "a.exr", "OPEN_EXR", 0.5)
    errors, choose = part("drgs_blender.core.errors"), part("addon.world_setup").choose_light
    with pytest.raises(errors.AssetError, match="is cut off"):
        choose(scene, tmp_path / "a.exr")


@pytest.mark.parametrize("make", [around, lambda scene, image: textured(image)], ids=["world", "surface"])
def test_a_file_that_did_not_change_is_not_opened_again(scene, export, tmp_path, monkeypatch, make):
    make(scene, picture(tmp_path / "a.exr", "OPEN_EXR"))
    opened: list[str] = []
    given = builtins.open

    def spy(file, *args, **options):
        opened.append(str(file))
        return given(file, *args, **options)

    monkeypatch.setattr(builtins, "open", spy)
    for count in (True, False):
        assert not export()[1]
        assert (str(tmp_path / "a.exr") in opened) == count
        opened.clear()
    path = tmp_path / "a.exr"
    path.write_bytes(path.read_bytes()[:-100])
    assert any("cut off" in text or "cannot be read" in text for text in export()[1])


@pytest.mark.parametrize("packed", [False, True])
def test_an_image_larger_than_blender_gives_away_is_made_smaller(scene, export, tmp_path, monkeypatch, packed):
    """It counts numbers in 32 bits: 30000 x 30000 pixels have more."""
    image = picture(tmp_path / "a.png", "PNG")
    if packed:
        image.pack()
    textured(image)
    (whole,) = export()[0].images
    image.name = "b.png"  # which is another
    monkeypatch.setattr(part("addon.bakes.node_trees"), "MOST_NUMBERS", 64 * 64)
    frame, warnings = export()
    assert set(warnings) == {
        'Image "b.png": its 64 x 64 pixels are more than Blender gives away; it is reduced 2 times. Use a smaller one'
    }
    (made,) = frame.images
    assert made.pixels.shape[:2] == (32, 32)
    blocks = whole.pixels.reshape(32, 2, 32, 2, -1).mean(axis=(1, 3))
    assert np.abs(made.pixels - blocks).mean() < 3
    assert tuple(image.size) == (64, 64), "the user's own is as it was"
    assert len(bpy.data.images) == 1, "no copy is left behind"


def smart(image: bpy.types.Image) -> None:
    textured(image)
    bpy.data.materials["Bad"].node_tree.nodes["Image Texture"].interpolation = "Smart"


def inverted(image: bpy.types.Image) -> None:
    """Nodes give the image a curve."""
    textured(image)
    tree = bpy.data.materials["Bad"].node_tree
    change = add(tree, "Invert")
    tree.links.new(tree.nodes["Image Texture"].outputs[0], change.node.inputs["Color"])
    tree.links.new(change, tree.nodes["Principled BSDF"].inputs["Base Color"])


def tiled(image: bpy.types.Image) -> None:
    image.name = "a.png"
    image.source, image.filepath = "TILED", image.filepath.replace("a.1001", "a.<UDIM>")
    textured(image)


@pytest.mark.parametrize(
    ("show", "place", "name", "count"),
    [
        (textured, "image_pixels", "_given", 0),
        (tiled, "image_grid", "grid", 0),
        (smart, "image_cubic", "finer", 1),
        (inverted, "images", "Image", 1),
    ],
)
def test_an_image_that_memory_has_no_room_for_is_named_until_there_is_room(
    scene, export, tmp_path, monkeypatch, show, place, name, count
):
    def full(*args: object) -> None:
        raise MemoryError

    show(picture(tmp_path / "a.1001.png", "PNG"))
    bpy.data.images[0].name = "a.png"
    with monkeypatch.context() as patch:
        patch.setattr(part(f"addon.export.{place}"), name, full)
        frame, warnings = export()
    assert warnings[0].startswith('Image "a.png": there is no memory for its pixels. Use a smaller image')
    assert len(frame.images) == count and len(frame.meshes) == 1
    frame, warnings = export()
    assert not any("memory" in text for text in warnings), warnings
    (made,) = frame.images
    assert made.pixels.size > 4


def test_a_painted_image_larger_than_blender_gives_away_is_not_baked_and_named(scene, monkeypatch):
    tree, principled = material("Bad")
    image = bpy.data.images.new("Painted", 32, 32)
    change = add(tree, "TexVoronoi", add(tree, "TexImage", image=image))
    tree.links.new(change, principled.inputs["Base Color"])
    swatch(bpy.data.materials["Bad"])
    manager = part("addon.bakes.manager").manager
    monkeypatch.setattr(part("addon.bakes.node_trees"), "MOST_NUMBERS", 32 * 32)
    wanted = part("addon.bakes.requests").Wanted.of(scene)
    part("addon.export").export_frame(bpy.context.evaluated_depsgraph_get(), str, lambda text: None, wanted=wanted)
    (request,) = wanted.requests
    manager.wait(object(), [request], lambda text, part: None, lambda: False)
    assert 'image "Painted": its 32 x 32 pixels are more than Blender gives away' in manager.failed[request.key]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit for files")
def test_a_full_disk_is_told_without_a_traceback(scene, tmp_path, monkeypatch):
    """The archive that was being written has nothing to say of its own when it goes."""
    import resource  # Windows has none

    tree, principled = material("Bad")
    tree.links.new(add(tree, "TexNoise"), principled.inputs["Base Color"])
    swatch(bpy.data.materials["Bad"])
    lost: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lost.append)
    manager = part("addon.bakes.manager").manager
    wanted = part("addon.bakes.requests").Wanted.of(scene)
    part("addon.export").export_frame(bpy.context.evaluated_depsgraph_get(), str, lambda text: None, wanted=wanted)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    (request,) = wanted.requests
    monkeypatch.setattr(part("addon.bakes.requests"), "_source", lambda owner, folder: {})  # that Blender writes
    resource.setrlimit(resource.RLIMIT_FSIZE, (512, hard))
    try:
        manager.wait(object(), [request], lambda text, part: None, lambda: False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert manager.failed[request.key].startswith("the files for it cannot be written")
    assert not lost
