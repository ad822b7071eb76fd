"""Adjustments of what is selected: vertices or surfels, by a mask, with keyframes, and the captured one click away."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np
import pytest
from scenes import asset_of, part, read_exr, select, sphere
from test_render import light

pytestmark = pytest.mark.blender_api

container, edits = part("drgs_blender.core.asset.container"), part("drgs_blender.core.material_adjustments")


def choose(obj, above):
    """Select the vertices, or points, of the object in Edit Mode that are higher."""
    mesh = bmesh.from_edit_mesh(obj.data)
    for vertex in mesh.verts:
        vertex.select_set(vertex.co.z > above)
    mesh.select_flush(True)
    bmesh.update_edit_mesh(obj.data)


def heights(obj):
    found = np.empty((len(obj.data.vertices), 3), np.float32)
    obj.data.vertices.foreach_get("co", found.ravel())
    return found[:, 2]


@pytest.fixture
def half(ball):
    """The ball, its upper half selected and the mask of its adjustments."""
    select(ball)
    bpy.ops.object.mode_set(mode="EDIT")
    choose(ball, 0.1)
    assert bpy.ops.drgs.mask_selection(name="Upper") == {"FINISHED"}
    assert bpy.context.mode == "EDIT_MESH" and ball.drgs.adjustment.mask == "Upper"
    bpy.ops.object.mode_set(mode="OBJECT")
    return ball


@pytest.mark.parametrize(
    ("setting", "value", "channel"),
    [
        ("tint", (1, 0.2, 0.2), "albedo"), ("hue", 1.0, "albedo"), ("saturation", 0.0, "albedo"),
        ("value", 0.5, "albedo"), ("brightness", 0.2, "albedo"), ("contrast", 0.5, "albedo"),
        ("roughness_gain", 0.2, "roughness"), ("metallic_offset", 0.4, "metallic"), ("opacity", 0.2, "opacity"),
    ],
)  # fmt: skip
def test_every_adjustment_changes_the_selection_alone(half, export, ball_file, setting, value, channel):
    setattr(half.drgs.adjustment, setting, value)
    asset = container.read_asset(ball_file)
    made = edits.edited_asset(asset, {}, export()[0].objects[0].adjustment)
    own, new = asset.mesh.channel(channel), made.mesh.channel(channel)
    changed = (np.abs(own - new).reshape(len(own), -1) > 1e-6).any(axis=1)
    np.testing.assert_array_equal(changed, heights(half) > 0.1)
    assert bpy.ops.drgs.restore_material() == {"FINISHED"}
    assert export()[0].objects[0].adjustment is None


def test_surfels_that_are_selected_as_points_are_adjusted(scene, export, tmp_path):
    asset = asset_of(*sphere(24, 36))
    container.write_asset(tmp_path / "fine.drgs", asset)
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "fine.drgs"))
    obj = bpy.context.active_object
    bpy.ops.drgs.edit_surfels()
    with pytest.raises(RuntimeError, match="has nothing selected"):
        bpy.ops.drgs.mask_selection()
    points = bpy.context.edit_object
    choose(points, 0.5)
    assert bpy.ops.drgs.mask_selection() == {"FINISHED"}
    assert bpy.context.edit_object == points  # to go on with
    bpy.ops.drgs.finish_surfels()
    obj.drgs.adjustment.brightness = 0.1
    made = edits.edited_asset(asset, {}, export()[0].objects[0].adjustment)
    change = (made.surfels.albedo - asset.surfels.albedo)[:, 2]
    height = asset.surfels.centre[:, 2]
    np.testing.assert_allclose(change[height > 0.75], 0.1, atol=1e-5)
    np.testing.assert_array_equal(change[height < 0.25], 0)
    assert ((change > 0.01) & (change < 0.09)).any()  # at the rim, by the surfels around


def test_vertices_without_surfels_have_the_share_of_those_around(scene):
    asset, model = asset_of(*sphere(16, 24)), part("drgs_blender.core.asset.model")
    kept = np.flatnonzero(np.arange(len(asset.surfels)) % 40 == 0)
    b = asset.binding
    few = model.Asset(
        part("drgs_blender.core.asset.part").taken(asset.surfels, kept), asset.mesh,
        model.Binding(b.face[kept], b.barycentric[kept], b.offset[kept], b.normal[kept]),
    )  # fmt: skip
    shares = part("operators.mask_selection").vertex_shares
    every = np.arange(len(kept))
    np.testing.assert_allclose(shares(few, every, every), 1, atol=1e-6)
    upper = np.flatnonzero(few.surfels.centre[:, 2] > 0)
    share = shares(few, upper, every)
    z = asset.mesh.vertices[:, 2]
    assert (share[z > 0.7] > 0.9).all() and (share[z < -0.7] < 0.1).all()


def test_surfels_that_were_removed_do_not_dilute_the_mask(scene, tmp_path):
    """Every other one is deleted; all that are left are selected."""
    asset = asset_of(*sphere(24, 36))
    container.write_asset(tmp_path / "fine.drgs", asset)
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "fine.drgs"))
    obj = bpy.context.active_object
    bpy.ops.drgs.edit_surfels()
    mesh = bmesh.from_edit_mesh(bpy.context.edit_object.data)
    for vertex in mesh.verts:
        vertex.select_set(vertex.index % 2 == 0)
    bmesh.update_edit_mesh(bpy.context.edit_object.data)
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.mesh.select_all(action="SELECT")
    assert bpy.ops.drgs.mask_selection() == {"FINISHED"}
    mask = part("addon.mesh_arrays").read_mask(obj, obj.data, "Selection")
    np.testing.assert_array_equal(mask, 1)


@pytest.mark.parametrize("mask", ["Upper", "Other"])
def test_linked_duplicates_whose_mask_changes_are_named(half, scene, mask):
    """Weights are of the mesh, which they share."""
    twin = half.copy()
    scene.collection.objects.link(twin)
    twin.drgs.adjustment.mask = mask
    bpy.ops.object.mode_set(mode="EDIT")
    choose(half, 0.5)
    assert bpy.ops.drgs.mask_selection(name="Upper") == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    told = " ".join(message.text for message in part("addon.messages").history)
    assert (f'"{twin.name}" have the same mesh and mask' in told) == (mask == "Upper")


def test_painted_materials_are_taken_back_where_a_mask_says_so(half, export):
    bpy.ops.drgs.set_material(preset="GOLD")
    half.drgs.adjustment.hue = 0.5
    assert bpy.ops.drgs.restore_material(mask="Upper") == {"FINISHED"}
    state, own = export()[0].objects[0], part("addon.assets").captured_mesh(half)
    upper = heights(half) > 0.1
    np.testing.assert_array_equal(state.metallic[upper], own.metallic[upper])
    np.testing.assert_array_equal(state.albedo[upper], own.albedo[upper])
    assert (state.metallic[~upper] == 1).all() and state.adjustment is not None
    with pytest.raises(RuntimeError, match='has no vertex group or number of points "nothing"'):
        bpy.ops.drgs.restore_material(mask="nothing")


def fading_nodes(obj):
    """Geometry Nodes that give points above the ground the number `fade` = 1."""
    tree = bpy.data.node_groups.new("Fade", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    make = tree.nodes.new
    first, last, place, split, compare, store = (
        make(kind)
        for kind in (
            *("NodeGroupInput", "NodeGroupOutput", "GeometryNodeInputPosition", "ShaderNodeSeparateXYZ"),
            *("FunctionNodeCompare", "GeometryNodeStoreNamedAttribute"),
        )
    )
    compare.inputs["B"].default_value = 0.1
    store.inputs["Name"].default_value = "fade"
    link = tree.links.new
    link(place.outputs[0], split.inputs[0])
    link(split.outputs["Z"], compare.inputs["A"])
    link(compare.outputs[0], store.inputs["Value"])
    link(first.outputs[0], store.inputs["Geometry"])
    link(store.outputs[0], last.inputs[0])
    obj.modifiers.new("Fade", "NODES").node_group = tree


@pytest.mark.parametrize("mask", ["nodes", "group"])
def test_opacity_fades_by_keyframes_where_nodes_or_a_group_say(half, scene, export, mask):
    """A part of the object fades out; pictures show the rest as it was."""
    light(scene)
    scene.render.film_transparent, scene.drgs.use_animated_seed = True, False
    if mask == "nodes":
        fading_nodes(half)
        half.drgs.adjustment.mask = "fade"
    for frame, opacity in ((1, 1.0), (11, 0.0)):
        half.drgs.adjustment.opacity = opacity
        half.keyframe_insert("drgs.adjustment.opacity", frame=frame)
    scene.frame_set(6)
    state = export()[0].objects[0]
    assert state.adjustment.opacity == pytest.approx(0.5)
    np.testing.assert_array_equal(state.adjustment.mask > 0.5, heights(half) > 0.1)
    alphas = []
    for frame in (2, 11):  # both see the mesh, as light passes it
        scene.frame_set(frame)
        bpy.ops.render.render(write_still=True)
        alphas.append(read_exr(scene.render.filepath, 64, 48)[..., 3])
    shown, faded = alphas
    assert shown[:18].sum() > 20 and faded[:18].sum() < 0.1 * shown[:18].sum()
    np.testing.assert_allclose(faded[30:], shown[30:], atol=0.01)
    assert shown[30:].sum() > 100
