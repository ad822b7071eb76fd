"""Materials by one click, the way back, and what is told about a fault."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from scenes import mesh_object, part, select, sphere, write_ball

pytestmark = pytest.mark.blender_api

CHANNELS = ("albedo", "roughness", "metallic")


def channels(obj) -> dict[str, np.ndarray]:
    read = part("addon.mesh_arrays").read_channel
    return {name: read(obj.data, name) for name in CHANNELS}


def test_gold_is_what_the_engine_gets_and_the_captured_comes_back(ball, export):
    before = channels(ball)
    assert bpy.ops.drgs.set_material(preset="GOLD") == {"FINISHED"}
    state = export()[0].objects[0]
    assert (state.metallic == 1).all() and np.ptp(state.albedo, axis=0).max() < 1e-6
    assert state.albedo[0, 0] > state.albedo[0, 1] > state.albedo[0, 2]
    assert bpy.ops.drgs.restore_material() == {"FINISHED"}
    for name, values in channels(ball).items():
        np.testing.assert_array_equal(values, before[name])
    state = export()[0].objects[0]
    assert state.albedo is None and state.metallic is None


def test_factor_mixes_and_a_vertex_group_masks(ball):
    before = channels(ball)
    group = ball.vertex_groups.new(name="Top")
    group.add(list(range(10)), 0.5, "REPLACE")
    bpy.ops.drgs.set_material(preset="CLAY", factor=0.5, mask="Top")
    after = channels(ball)
    share = np.where(np.arange(len(ball.data.vertices)) < 10, 0.25, 0)
    np.testing.assert_allclose(after["roughness"], before["roughness"] * (1 - share) + 0.9 * share, atol=1e-6)
    np.testing.assert_allclose(
        after["albedo"], before["albedo"] * (1 - share[:, None]) + 0.5 * share[:, None], atol=1e-6
    )


def test_an_attribute_masks_a_preset_and_what_is_outside_keeps_every_bit(ball):
    """Numbers outside [0, 1] and those that are none are held to it; a name that nothing has changes nothing."""
    before, count = channels(ball), len(ball.data.vertices)
    numbers = np.linspace(-1, 2, count).astype(np.float32)
    numbers[0] = np.nan
    ball.data.attributes.new("wear", "FLOAT", "POINT").data.foreach_set("value", numbers)
    with pytest.raises(RuntimeError, match=r'"ball".*"nobody"'):
        bpy.ops.drgs.set_material(preset="GOLD", mask="nobody")
    for name, values in channels(ball).items():
        np.testing.assert_array_equal(values, before[name])
    for invert in (False, True):
        share = np.clip(np.nan_to_num(numbers), 0, 1)
        share = 1 - share if invert else share
        bpy.ops.drgs.set_material(preset="GOLD", mask="wear", use_invert=invert)
        after = channels(ball)
        np.testing.assert_allclose(after["metallic"], before["metallic"] * (1 - share) + share, atol=1e-6)
        for name, values in after.items():
            np.testing.assert_array_equal(values[share == 0], before[name][share == 0])
        bpy.ops.drgs.restore_material()


@pytest.mark.parametrize("preset", ["GOLD", "COPPER", "CHROME", "CLAY", "PLASTIC", "WET"])
def test_every_preset_gives_values_that_are_colours_on_several_objects(ball, tmp_path, preset):
    bpy.ops.import_scene.drgs(filepath=str(write_ball(tmp_path / "two.drgs")))
    both = [ball, bpy.context.active_object]
    select(*both)
    bpy.ops.drgs.set_material(preset=preset)
    first, second = map(channels, both)
    for name in CHANNELS:
        np.testing.assert_array_equal(first[name], second[name])
        assert np.isfinite(first[name]).all() and (first[name] >= 0).all() and (first[name] <= 1).all()


def test_a_mesh_that_is_not_the_assets_is_not_restored(ball):
    ball.data.clear_geometry()
    ball.data.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    with pytest.raises(RuntimeError, match=r'"ball".*3 vertices'):
        bpy.ops.drgs.restore_material()


@pytest.mark.slow
def test_a_report_tells_of_engine_scene_and_messages(ball, tmp_path):
    part("addon.messages").note("WARNING", "something about the light")
    path = tmp_path / "report.txt"
    assert bpy.ops.drgs.report(filepath=str(path)) == {"FINISHED"}
    text = path.read_text(encoding="utf-8")
    told = '"ball"', "something about the light", "samples = "
    for expected in (bpy.app.version_string, "DR-GS can render here", *told):
        assert expected in text
    assert "\nsubmit.chunk = " in text and "bpy_struct" not in text and "bl_ext" not in text
    with pytest.raises(RuntimeError, match="cannot be written"):
        bpy.ops.drgs.report(filepath=str(tmp_path / "absent" / "report.txt"))


def test_the_object_of_a_message_is_found_and_selected(ball, tmp_path):
    named_in = part("addon.messages").named_in
    objects = bpy.context.view_layer.objects
    assert named_in('Object "ball": modifier "X" changes', objects) == "ball"
    assert named_in("ball: 2 faces have no area; light passes through them", objects) == "ball"
    assert named_in('"Y" is 3" wide', objects) == ""
    bpy.ops.import_scene.drgs(filepath=str(write_ball(tmp_path / "two.drgs")))
    assert bpy.ops.drgs.select_named(name="ball") == {"FINISHED"}
    assert bpy.context.active_object.name == "ball" and len(bpy.context.selected_objects) == 1
    with pytest.raises(RuntimeError, match="not in this view layer"):
        bpy.ops.drgs.select_named(name="nobody")


def test_what_is_hidden_is_not_painted(ball):
    for hide in (lambda on: ball.hide_set(on), lambda on: setattr(ball, "hide_viewport", on)):
        hide(True)
        bpy.context.view_layer.objects.active = ball
        with pytest.raises(RuntimeError, match='"ball": is hidden'):
            bpy.ops.drgs.paint(channel="roughness")
        assert bpy.context.mode == "OBJECT" and ball.data.attributes["roughness"].data_type == "FLOAT"
        hide(False)


def test_of_several_the_active_one_is_painted_and_all_stay_selected(ball, tmp_path):
    """As in Blender's own paint modes, so that what follows can be done to all of them again."""
    bpy.ops.import_scene.drgs(filepath=str(write_ball(tmp_path / "two.drgs")))
    other = bpy.context.active_object
    select(other, ball)
    assert bpy.ops.drgs.paint(channel="metallic") == {"FINISHED"}
    assert (ball.mode, other.mode) == ("VERTEX_PAINT", "OBJECT") and set(bpy.context.selected_objects) == {ball, other}
    types = [obj.data.attributes["metallic"].data_type for obj in (ball, other)]
    assert types == ["FLOAT_COLOR", "FLOAT"], "the other is as it was"
    plain = mesh_object("Plain", *sphere())
    bpy.ops.object.mode_set(mode="OBJECT")
    select(other, plain)  # the active one has no channels
    assert bpy.ops.drgs.paint(channel="metallic") == {"FINISHED"}
    assert bpy.context.active_object == other and other.mode == "VERTEX_PAINT" and plain.select_get()
    about = bpy.ops.drgs.paint.get_rna_type().description
    assert "active DR-GS object" in about and "stay selected" in about


@pytest.mark.parametrize("channel", CHANNELS)
def test_a_painted_channel_is_what_the_engine_gets(ball, export, channel):
    before = channels(ball)
    assert bpy.ops.drgs.paint(channel=channel) == {"FINISHED"}
    assert bpy.context.mode == "PAINT_VERTEX" and ball.data.attributes.active_color.name == channel
    for name, values in channels(ball).items():  # nothing has been painted yet
        np.testing.assert_array_equal(values, before[name])
    ball.data.attributes[channel].data[0].color = (0.25, 0.25, 0.25, 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    ball.data.update_tag()
    painted = getattr(export()[0].objects[0], channel)
    np.testing.assert_allclose(painted[0], 0.25, atol=1e-6)
    np.testing.assert_array_equal(painted[1:], before[channel][1:])
    bpy.ops.drgs.restore_material()
    np.testing.assert_array_equal(channels(ball)[channel], before[channel])


@pytest.mark.parametrize("channel", ["opacity", "emission", "specular", "coat"])
def test_a_channel_that_the_asset_lacks_is_painted_saved_and_taken_away(ball, export, tmp_path, channel):
    neutral = {"opacity": 1.0, "emission": 0.0, "specular": 0.5, "coat": 0.0}[channel]
    plain = ball.data.materials[0].name
    assert channel not in ball.data.attributes and getattr(export()[0].objects[0], channel) is None
    assert bpy.ops.drgs.paint(channel=channel) == {"FINISHED"}
    assert ball.data.attributes.active_color.name == channel
    ball.data.attributes[channel].data[0].color = (0.25, 0.25, 0.25, 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    ball.data.update_tag()
    painted = getattr(export()[0].objects[0], channel)
    np.testing.assert_allclose(painted[0], 0.25, atol=1e-6)
    assert (painted[1:] == neutral).all()
    assert ball.data.materials[0].name == f"{plain} {channel}"
    assert bpy.ops.drgs.save_asset(filepath=str(tmp_path / "painted.drgs")) == {"FINISHED"}
    saved = part("drgs_blender.core.asset.container").read_asset(tmp_path / "painted.drgs")
    np.testing.assert_array_equal(getattr(saved.mesh, channel), painted)
    assert bpy.ops.drgs.restore_material() == {"FINISHED"}
    assert channel not in ball.data.attributes and getattr(export()[0].objects[0], channel) is None
    assert ball.data.materials[0].name == plain


def test_radiance_beyond_white_goes_through_blender_unchanged(ball, export, ball_file, tmp_path):
    container, core = part("drgs_blender.core.asset.container"), part("drgs_blender.core.asset.model")
    asset = container.read_asset(ball_file)
    n, k = len(asset.mesh.vertices), len(asset.surfels)
    mesh = dataclasses.replace(asset.mesh, emission=np.full((n, 3), 20.0), opacity=np.full(n, 0.5))
    surfels = dataclasses.replace(asset.surfels, emission=np.full((k, 3), 20.0))
    container.write_asset(tmp_path / "lamp.drgs", core.Asset(surfels, mesh, asset.binding))
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "lamp.drgs"))
    lamp = bpy.context.active_object
    assert [n in lamp.data.attributes for n in ("emission", "opacity", "coat")] == [True, True, False]
    state = export()[0].objects[1]
    assert state.emission is None and state.opacity is None  # they are the asset's
    shader = next(n for n in lamp.data.materials[0].node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    assert shader.inputs["Emission Color"].is_linked and shader.inputs["Alpha"].is_linked
    adjustment(lamp).emission = 2.0
    assert bpy.ops.drgs.save_asset(filepath=str(tmp_path / "again.drgs"), use_saved=True) == {"FINISHED"}
    saved = container.read_asset(tmp_path / "again.drgs")
    assert (saved.mesh.emission == 40).all() and (saved.surfels.emission == 40).all()
    select(ball, lamp)
    bpy.ops.drgs.copy_material()
    state = next(o for o in export()[0].objects if o.name == ball.name)
    np.testing.assert_allclose(state.emission, 40, rtol=1e-5)
    np.testing.assert_allclose(state.opacity, 0.5, rtol=1e-5)


def test_a_material_is_copied_from_the_nearest_places(ball, tmp_path):
    bpy.ops.import_scene.drgs(filepath=str(write_ball(tmp_path / "two.drgs")))
    other = bpy.context.active_object
    bpy.ops.drgs.set_material(preset="COPPER", factor=0.5)
    select(ball, other)
    assert bpy.ops.drgs.copy_material() == {"FINISHED"}
    for name, values in channels(other).items():
        np.testing.assert_allclose(channels(ball)[name], values, atol=1e-5)
    ball.data.vertices[7].co.z = np.nan
    with pytest.raises(RuntimeError, match='"ball": has 1 vertices that are not finite'):
        bpy.ops.drgs.copy_material()
    select(ball)
    with pytest.raises(RuntimeError, match="no two DR-GS objects"):
        bpy.ops.drgs.copy_material()


def adjustment(ball):
    return ball.drgs.adjustment


def test_adjustments_reach_the_engine_and_go_away_by_the_switch(ball, export):
    settings = adjustment(ball)
    assert export()[0].objects[0].adjustment is None
    settings.tint, settings.hue, settings.roughness_gain, settings.metallic_offset = (1, 0.5, 0.25), np.pi, 0.5, 0.2
    sent = export()[0].objects[0].adjustment
    assert sent.tint == (1, 0.5, 0.25) and sent.hue == pytest.approx(0.5) and sent.mask is None
    assert sent.roughness == (0.5, 0, 0, 1) and sent.metallic == pytest.approx((1, 0.2, 0, 1))
    settings.use = False
    assert export()[0].objects[0].adjustment is None
    settings.use = True
    bpy.ops.drgs.reset_adjustments()
    assert export()[0].objects[0].adjustment is None and settings.roughness_gain == 1


def test_before_and_after_is_a_switch_that_loses_nothing(ball, scene, ball_file):
    """What is painted and adjusted goes and comes, in viewports that remember, in discs, and by keyframes."""
    bpy.ops.drgs.set_material(preset="GOLD")
    adjustment(ball).tint = (1, 0.5, 1)
    export_frame, cache = part("addon.export").export_frame, part("addon.export.export_cache").ExportCache()
    surfels, asset = part("addon.viewport.surfels"), part("addon.assets").load(ball_file)

    def state():
        depsgraph = bpy.context.evaluated_depsgraph_get()
        discs = surfels.shown_asset(ball.evaluated_get(depsgraph), asset)[0].surfels.albedo
        return export_frame(depsgraph, str, lambda text: None, cache=cache).objects[0], discs

    after = state()
    for number, before in ((1, True), (2, False)):
        ball.drgs.show_captured = before
        ball.keyframe_insert("drgs.show_captured", frame=number)
    for number, edited in ((1, False), (2, True)):
        scene.frame_set(number)
        now, discs = state()
        assert (now.adjustment is not None) == edited
        for channel in ("albedo", "roughness", "metallic"):
            values = getattr(now, channel)
            assert np.array_equal(values, getattr(after[0], channel)) if edited else values is None
        np.testing.assert_array_equal(discs, after[1] if edited else asset.surfels.albedo)


def test_the_mask_is_a_vertex_group_or_an_attribute(ball, export):
    settings, count = adjustment(ball), len(ball.data.vertices)
    settings.value = 0.5
    ball.vertex_groups.new(name="Top").add(list(range(10)), 0.25, "REPLACE")
    numbers = np.linspace(0, 1, count).astype(np.float32)
    ball.data.attributes.new("wear", "FLOAT", "POINT").data.foreach_set("value", numbers)
    ball.data.attributes.new("faces", "FLOAT", "FACE")
    settings.mask = "Top"
    np.testing.assert_allclose(export()[0].objects[0].adjustment.mask, np.where(np.arange(count) < 10, 0.25, 0))
    settings.mask, settings.use_invert = "wear", True
    np.testing.assert_allclose(export()[0].objects[0].adjustment.mask, 1 - numbers)
    for name in ("faces", "nobody"):
        settings.mask = name
        frame, warnings = export()
        assert frame.objects[0].adjustment is None and f'"{name}"' in warnings[0] and '"ball"' in warnings[0]


def test_adjustments_follow_keyframes_and_are_exported_anew_by_viewports(ball, scene):
    settings = adjustment(ball)
    for number, value in ((1, 1.0), (11, 0.0)):
        settings.saturation = value
        ball.keyframe_insert("drgs.adjustment.saturation", frame=number)
    export_frame, cache = part("addon.export").export_frame, part("addon.export.export_cache").ExportCache()
    seen = []
    for number in (1, 6, 11):
        scene.frame_set(number)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        state = export_frame(depsgraph, str, lambda text: None, cache=cache).objects[0]
        seen.append(1.0 if state.adjustment is None else state.adjustment.saturation)
    assert seen == pytest.approx([1, 0.5, 0], abs=1e-6)


def test_copying_a_material_copies_its_adjustments(ball, tmp_path):
    adjustment(ball).tint = (1, 0, 0)
    bpy.ops.import_scene.drgs(filepath=str(write_ball(tmp_path / "two.drgs")))
    second = bpy.context.active_object
    select(second, ball)
    bpy.ops.drgs.copy_material()
    assert tuple(adjustment(second).tint) == (1, 0, 0)
    select(second)
    bpy.ops.drgs.restore_material()
    assert tuple(adjustment(second).tint) == (1, 1, 1) and tuple(adjustment(ball).tint) == (1, 0, 0)


def test_a_saved_asset_looks_as_the_edited_object(ball, export, tmp_path, ball_file):
    """Written, imported again: the same materials and nothing on top; the pose is not part of it."""
    bpy.ops.drgs.set_material(preset="COPPER", factor=0.5)
    adjustment(ball).tint, adjustment(ball).roughness_offset = (0.5, 1, 1), 0.1
    ball.location.x, ball.rotation_euler.z = 2, 1
    state, asset = export()[0].objects[0], part("addon.assets").load(ball_file)
    expected = part("drgs_blender.core.material_adjustments").edited_asset(
        asset, {name: getattr(state, name) for name in CHANNELS}, state.adjustment
    )
    path = tmp_path / "edited"
    assert bpy.ops.drgs.save_asset(filepath=str(path)) == {"FINISHED"}
    saved = part("drgs_blender.core.asset.container").read_asset(path.with_suffix(".drgs"))
    for name in CHANNELS:
        np.testing.assert_allclose(getattr(saved.mesh, name), getattr(expected.mesh, name), atol=1e-6)
        np.testing.assert_allclose(getattr(saved.surfels, name), getattr(expected.surfels, name), atol=1e-6)
    assert np.abs(saved.surfels.albedo - asset.surfels.albedo).max() > 0.1
    np.testing.assert_array_equal(saved.mesh.vertices, asset.mesh.vertices)
    np.testing.assert_array_equal(saved.binding.barycentric, asset.binding.barycentric)
    bpy.ops.drgs.save_asset(filepath=str(tmp_path / "again"), use_saved=True)
    state = export()[0].objects[0]
    assert state.asset == str(tmp_path / "again.drgs") and state.adjustment is None
    # What stood in the attributes is not added a second time, and a picture of either is the same.
    np.testing.assert_allclose(channels(ball)["albedo"], expected.mesh.albedo, atol=1e-6)


def test_no_asset_is_written_over_or_lost(ball, tmp_path, ball_file):
    before = ball_file.read_bytes()
    with pytest.raises(RuntimeError, match="would be lost"):
        bpy.ops.drgs.save_asset(filepath=str(ball_file))
    with pytest.raises(RuntimeError, match="cannot be written"):
        bpy.ops.drgs.save_asset(filepath=str(tmp_path / "absent" / "x.drgs"))
    assert ball_file.read_bytes() == before
    second = ball.copy()
    bpy.context.scene.collection.objects.link(second)
    select(second, ball)
    assert bpy.ops.drgs.save_asset(filepath=str(tmp_path / "out.drgs")) == {"FINISHED"}
    assert sorted(p.name for p in tmp_path.glob("*.drgs")) == ["ball.drgs", f"{bpy.path.clean_name(second.name)}.drgs"]
    (tmp_path / f"{bpy.path.clean_name(second.name)}.drgs").unlink()
    (tmp_path / "ball.drgs").write_bytes(b"somebody's")
    with pytest.raises(RuntimeError, match=r"ball\.drgs: is there already"):  # the file browser asked for out.drgs
        bpy.ops.drgs.save_asset(filepath=str(tmp_path / "out.drgs"))
    assert [p.read_bytes() for p in tmp_path.glob("*.drgs")] == [b"somebody's"]


def test_the_asset_of_a_library_is_not_written_over(ball, tmp_path):
    """Its path is relative to the library, not to the file that links it."""
    theirs = tmp_path / "library" / "theirs.drgs"
    bpy.ops.import_scene.drgs(filepath=str(write_ball(theirs)))
    bpy.ops.wm.save_as_mainfile(filepath=str(theirs.with_suffix(".blend")))
    bpy.ops.file.make_paths_relative()
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))
    with bpy.data.libraries.load(str(theirs.with_suffix(".blend")), link=True) as (_, target):
        target.objects = ["theirs"]
    bpy.context.scene.collection.objects.link(target.objects[0])
    bpy.ops.import_scene.drgs(filepath=str(write_ball(tmp_path / "own.drgs")))
    before = theirs.read_bytes()
    bpy.ops.drgs.set_material()
    with pytest.raises(RuntimeError, match=r'"theirs": is made of .*would be lost'):
        bpy.ops.drgs.save_asset(filepath=str(theirs))
    assert theirs.read_bytes() == before


def test_geometry_nodes_compute_materials(ball, export):
    """A number stored on the points counts as if it were painted, and follows its keyframes."""
    tree = bpy.data.node_groups.new("Rust", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeStoreNamedAttribute", "NodeGroupOutput")
    first, store, last = (tree.nodes.new(kind) for kind in kinds)
    store.inputs["Name"].default_value = "roughness"
    tree.links.new(first.outputs[0], store.inputs["Geometry"])
    tree.links.new(store.outputs[0], last.inputs[0])
    ball.modifiers.new("Rust", "NODES").node_group = tree
    for frame, value in ((1, 0.25), (11, 0.75)):
        store.inputs["Value"].default_value = value
        store.inputs["Value"].keyframe_insert("default_value", frame=frame)
    for frame, value in ((1, 0.25), (6, 0.5), (11, 0.75)):
        bpy.context.scene.frame_set(frame)
        (state,), warnings = export()[0].objects, export()[1]
        np.testing.assert_allclose(state.roughness, value, atol=1e-6)
        assert state.albedo is None and not warnings
