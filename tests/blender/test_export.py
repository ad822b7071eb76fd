"""The scene as the engine gets it: visibility, instances, deformation, normals, materials, settings."""

from __future__ import annotations

import time
import typing

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import armature_object, mesh_object, part, sphere

pytestmark = pytest.mark.blender_api

errors = part("drgs_blender.core.errors")


def test_object_is_described_with_world_matrix_and_vertices(ball, export):
    ball.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Diagonal((1, -2, 0.5, 1))
    ball.pass_index = 7
    frame, warnings = export()
    (state,) = frame.objects
    np.testing.assert_allclose(state.matrix_world, np.array(ball.matrix_world))
    np.testing.assert_array_equal(state.vertices, sphere()[0])
    assert (state.name, state.pass_index, state.corner_normals) == ("ball", 7, None)
    assert state.albedo is None and state.roughness is None and state.metallic is None
    assert not warnings


def test_other_objects_take_part_without_a_warning(ball, export):
    for name in ("Cube", "Floor"):
        mesh_object(name, *sphere(4, 4))
    frame, warnings = export()
    assert [s.name for s in frame.objects] == ["ball"]
    assert sorted(m.name for m in frame.meshes) == ["Cube", "Floor"]
    assert warnings == []


def test_what_the_picture_will_lack_is_said(ball, scene, export):
    for name in ("Fog", "Smoke"):
        scene.collection.objects.link(bpy.data.objects.new(name, bpy.data.volumes.new(name)))
    assert export()[1] == ["2 volume objects are not rendered by DR-GS: Fog, Smoke"]
    scene.render.use_multiview = True
    with pytest.raises(errors.UsageError, match="Disable Output > Stereoscopy"):
        export()


def test_visibility_of_objects_is_blenders(ball, scene, export):
    assert export()[0].objects[0].visibility == part("drgs_blender.core.frame").Visibility()
    ball.visible_camera = ball.visible_glossy = ball.visible_shadow = False
    ball.is_holdout = ball.is_shadow_catcher = True
    rays = export()[0].objects[0].visibility
    assert (rays.camera, rays.diffuse, rays.glossy, rays.shadow) == (False, True, False, False)
    assert rays.holdout and rays.shadow_catcher
    ball.visible_diffuse = False
    assert export()[0].objects == [], "what no ray meets is not sent"


def test_collections_make_holdouts_and_indirect_objects(ball, scene, export):
    group = bpy.data.collections.new("Group")
    scene.collection.children.link(group)
    scene.collection.objects.unlink(ball)
    group.objects.link(ball)
    layer = bpy.context.view_layer.layer_collection.children["Group"]
    layer.indirect_only = True
    rays = export()[0].objects[0].visibility
    assert not rays.camera and rays.diffuse and not rays.holdout
    layer.holdout = True
    rays = export()[0].objects[0].visibility
    assert rays.camera and rays.holdout


def test_instances_have_their_own_transforms_and_share_arrays(ball, scene, export):
    group = bpy.data.collections.new("Group")
    group.objects.link(ball)
    for x in (3, 6):
        empty = bpy.data.objects.new("Instance", None)
        empty.instance_type, empty.instance_collection = "COLLECTION", group
        empty.location.x = x
        scene.collection.objects.link(empty)
    frame, _ = export()
    assert sorted(s.matrix_world[0, 3] for s in frame.objects) == [0, 3, 6]
    assert len({id(s.vertices) for s in frame.objects}) == 1


def test_hidden_objects_are_not_rendered(ball, scene, captured):
    hidden = ball.copy()
    scene.collection.objects.link(hidden)
    hidden.hide_render = True
    eye = ball.copy()
    scene.collection.objects.link(eye)
    eye.hide_viewport = True  # of no concern to a render
    excluded = bpy.data.collections.new("Excluded")
    scene.collection.children.link(excluded)
    excluded.objects.link(ball.copy())
    bpy.context.view_layer.layer_collection.children["Excluded"].exclude = True
    bpy.ops.render.render()
    assert sorted(s.name for s in captured[0].objects) == ["ball", eye.name]


def test_armature_and_shape_key_move_the_vertices(ball, export):
    rig = armature_object({"Bone": ((0, 0, -1), (0, 0, 1))})
    rest = sphere()[0]
    top = np.flatnonzero(rest[:, 2] > 0.5)
    ball.vertex_groups.new(name="Bone").add(top.tolist(), 1.0, "REPLACE")
    ball.modifiers.new("Armature", "ARMATURE").object = rig
    ball.shape_key_add(name="Basis")
    key = ball.shape_key_add(name="Wide", from_mix=False)
    wide = rest * np.float32((2, 1, 1))
    key.points.foreach_set("co", wide.ravel())
    key.value = 0.5
    rig.pose.bones["Bone"].location = (0, 0.25, 0)  # along the bone, which is +Z of the world
    frame, _ = export()
    expected = (rest + wide) / 2
    expected[top, 2] += 0.25
    np.testing.assert_allclose(frame.objects[0].vertices, expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["SUBSURF", "DECIMATE"])
def test_modifier_that_changes_the_count_is_named(ball, export, kind):
    ball.modifiers.new("Innocent", "SMOOTH")
    ball.modifiers.new("Culprit", kind)
    if kind == "DECIMATE":
        ball.modifiers["Culprit"].ratio = 0.5
    with pytest.raises(errors.AssetError, match=r'"ball".*"Culprit" changes the number of vertices') as caught:
        export()
    assert "Innocent" not in str(caught.value)
    ball.modifiers["Culprit"].show_viewport = ball.modifiers["Culprit"].show_render = False
    assert len(export()[0].objects[0].vertices) == 86


def test_subdivision_is_refused_before_it_is_computed(ball, export):
    """From 5.0 on Blender computes it when the mesh is looked at: 86 vertices become 22 million at level 9."""
    modifier = ball.modifiers.new("Culprit", "SUBSURF")
    modifier.levels = modifier.render_levels = level = 9 if bpy.app.version >= (5, 0, 0) else 2
    start = time.process_time()
    with pytest.raises(errors.AssetError, match=r'"ball".*"Culprit".*subdividing'):
        export()
    with pytest.raises(RuntimeError, match=r'"ball".*"Culprit".*subdividing'):
        bpy.ops.render.render()
    assert time.process_time() - start < 2
    modifier.levels = 0
    assert export()[1] == []
    modifier.levels = level
    bpy.context.scene.render.use_simplify, bpy.context.scene.render.simplify_subdivision = True, 0
    assert export()[1] == []


def renumbered(ball, order):
    """Give the object the same surface with vertex i called order[i]."""
    vertices, faces = sphere()
    moved = np.empty_like(vertices)
    moved[order] = vertices
    mesh = bpy.data.meshes.new("Renumbered")
    mesh.from_pydata(moved.tolist(), [], order[faces].tolist())
    mesh.shade_smooth()
    ball.data = mesh


def test_renumbered_vertices_are_refused(ball, export):
    """As many vertices and faces as the asset, but the asset's faces would join the wrong ones."""
    renumbered(ball, np.random.default_rng(5).permutation(len(sphere()[0])))
    with pytest.raises(errors.AssetError, match=r'"ball".*ball\.drgs.*edges differ.*import the asset again'):
        export()
    renumbered(ball, np.arange(len(sphere()[0])))
    assert export()[1] == []


def modeled(obj, change):
    """Change the mesh with bmesh."""
    import bmesh

    edited = bmesh.new()
    edited.from_mesh(obj.data)
    change(bmesh.ops, edited)
    edited.to_mesh(obj.data)
    edited.free()


def test_triangles_merged_to_polygons_fit(ball, export):
    def merge(ops, mesh):
        ops.join_triangles(mesh, faces=mesh.faces[:], angle_face_threshold=1, angle_shape_threshold=1)

    modeled(ball, merge)
    ball.data.shade_smooth()
    assert len(ball.data.polygons) < len(sphere()[1])
    frame, warnings = export()
    np.testing.assert_array_equal(frame.objects[0].vertices, sphere()[0])
    assert warnings == []
    ball.data.shade_flat()
    frame, warnings = export()
    vertices, faces = sphere()
    corners = vertices[faces].astype(np.float64)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert warnings == []
    assert (np.einsum("fc,fkc->fk", flat, frame.objects[0].corner_normals) > 0.9).all()  # quads are a little bent


def test_faces_in_another_order_fit_and_deleted_ones_are_gone(ball, export):
    modeled(ball, lambda ops, mesh: ops.reverse_faces(mesh, faces=mesh.faces[:40]))
    assert export()[1] == []
    modeled(ball, lambda ops, mesh: ops.delete(mesh, geom=mesh.faces[:3], context="FACES_ONLY"))
    frame, warnings = export()
    assert warnings == [] and len(frame.objects[0].part.face) == len(sphere()[1]) - 3


def test_loose_edges_are_no_faces(ball, export):
    modeled(ball, lambda ops, mesh: (mesh.verts.ensure_lookup_table(), mesh.edges.new((mesh.verts[0], mesh.verts[50]))))
    assert len(ball.data.edges) > 0 and export()[1] == []


def test_a_mesh_whose_vertices_are_not_known_is_named(ball, export):
    ball.data.vertices.add(1)
    ball.data.update()
    assert export()[0].objects[0].part is not None  # a new vertex without a face
    ball.data.attributes.remove(ball.data.attributes["drgs_vertex"])
    with pytest.raises(errors.AssetError, match=r'"ball".*its mesh has 87 vertices, the asset 86'):
        export()


def test_edit_mode_exports_and_renders_the_mesh(ball, export, captured):
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        np.testing.assert_array_equal(export()[0].objects[0].vertices, sphere()[0])
        bpy.ops.render.render()
        np.testing.assert_array_equal(captured[0].objects[0].vertices, sphere()[0])
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def test_corner_normals_are_sent_only_when_shading_is_not_smooth(ball, export):
    assert export()[0].objects[0].corner_normals is None
    ball.data.shade_flat()
    vertices, faces = sphere()
    corners = vertices[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    normals = export()[0].objects[0].corner_normals
    np.testing.assert_allclose(normals, np.repeat(flat[:, None], 3, 1), atol=1e-5)
    ball.data.shade_smooth()
    custom = np.tile(np.float32((0, 0, 1)), (3 * len(faces), 1))
    ball.data.normals_split_custom_set(custom.tolist())
    np.testing.assert_allclose(export()[0].objects[0].corner_normals.reshape(-1, 3), custom, atol=1e-3)


def test_edited_materials_are_sent_and_only_those(ball, export):
    count = len(sphere()[0])
    arrays = part("addon.mesh_arrays")
    paint = np.random.default_rng(3).uniform(0, 1, (count, 3)).astype(np.float32)
    arrays.write_channel(ball.data, "albedo", paint)
    (state,) = export()[0].objects
    np.testing.assert_array_equal(state.albedo, paint)
    assert state.roughness is None and state.metallic is None


def test_attribute_of_a_wrong_kind_is_named_and_ignored(ball, export):
    ball.data.attributes.remove(ball.data.attributes["albedo"])
    ball.data.attributes.new("albedo", "FLOAT_COLOR", "CORNER")
    frame, warnings = export()
    assert frame.objects[0].albedo is None
    assert any('"ball"' in w and "albedo" in w for w in warnings)


def test_an_attribute_that_the_material_does_not_show_is_named(ball, export):
    """What a script adds counts here; Cycles and the viewport see it only by the material's node."""
    material = part("addon.viewport_material")
    mesh = ball.data
    material.update_viewport_material(mesh)
    glow = mesh.attributes.new("emission", "FLOAT_COLOR", "POINT")
    glow.data.foreach_set("color", np.ones(4 * len(mesh.vertices), np.float32))
    frame, (text,) = export()
    assert frame.objects[0].emission is not None
    assert '"ball"' in text and "emission" in text and f'"{mesh.materials[0].name}"' in text and "Paint" in text
    material.update_viewport_material(mesh)
    assert not export()[1]


def test_attribute_values_that_are_no_numbers_are_named_and_the_assets(ball, export):
    values = ball.data.attributes["roughness"].data
    own = np.array([v.value for v in values], np.float32)
    values[3].value, values[5].value, values[7].value = np.nan, 0.875, 9.0
    frame, (warning,) = export()
    assert '"ball": 1 values of attribute roughness' in warning
    own[5], own[7] = 0.875, 1.0
    np.testing.assert_array_equal(frame.objects[0].roughness, own)


def test_missing_asset_is_named(ball, ball_file, export):
    ball_file.unlink()
    with pytest.raises(errors.AssetError, match=r'"ball".*ball\.drgs does not exist'):
        export()


def test_replaced_asset_file_is_read_again(ball, ball_file, export):
    export()
    container = part("drgs_blender.core.asset.container")
    asset = container.read_asset(ball_file)
    asset.mesh.roughness = np.zeros_like(asset.mesh.roughness)
    container.write_asset(ball_file, asset)
    assert export()[0].objects[0].roughness is not None


def test_no_camera_is_an_error_with_a_remedy(scene, export):
    scene.camera = None
    with pytest.raises(errors.UsageError, match=r"has no camera.*Add a camera"):
        export()


def test_settings_and_passes_reach_the_frame(ball, scene, captured):
    settings, layer = scene.drgs, scene.view_layers[0]
    settings.use_strategy_samples, settings.samples = False, 64
    settings.bounces, settings.subpixel_samples, settings.shading_model, settings.denoise, settings.seed = (
        3,
        8,
        "paper",
        "svgf",
        5,
    )
    settings.camera_sees, settings.rays_see, scene.render.film_transparent = "mesh", "surfels", True
    settings.noise_threshold, settings.clamp_indirect, settings.filter_glossy = 0.02, 10, 2
    layer.use_pass_z = layer.use_pass_object_index = layer.drgs.use_pass_albedo = layer.drgs.use_pass_noisy_image = True
    scene.frame_set(12)
    bpy.ops.render.render()
    frame = captured[0]
    s = frame.settings
    assert (s.samples, s.strategy_samples, s.bounces, s.subpixel_samples, s.seed) == (64, None, 3, 8, 5)
    assert (s.shading_model, s.denoise, s.camera_sees, s.rays_see, s.film_transparent) == (
        "paper",
        "svgf",
        "mesh",
        "surfels",
        True,
    )
    assert (s.noise_threshold, s.clamp_indirect, s.filter_glossy) == (0, 10, 2), "the threshold is off"
    assert frame.passes == ("Combined", "Depth", "Albedo", "IndexOB", "Noisy Image")
    assert frame.noise_index == 12
    settings.use_animated_seed, settings.use_noise_threshold = False, True
    bpy.ops.render.render()
    assert captured[1].noise_index == 0 and captured[1].settings.noise_threshold == pytest.approx(0.02)


def test_settings_offer_what_the_engine_knows():
    """The menus of the panel and the choices of the frame description are the same."""
    hints = typing.get_type_hints(part("drgs_blender.core.frame").RenderSettings)
    defaults = part("drgs_blender.core.frame").RenderSettings()
    properties = part("addon.properties").DrgsSceneSettings.bl_rna.properties
    for name in ("camera_sees", "rays_see", "denoise", "shading_model"):
        assert {i.identifier for i in properties[name].enum_items} == set(typing.get_args(hints[name])), name
        if name != "denoise":
            assert properties[name].default == getattr(defaults, name)
    assert properties["denoise"].default == "svgf"  # the first picture of an artist is clean; programs ask for it


def stored(group):
    """Where Blender keeps the values of a property group, as no limit holds them."""
    return group.bl_system_properties_get(do_create=True) if hasattr(group, "bl_system_properties_get") else group


def test_settings_of_another_version_become_sound_and_are_named(ball, scene, export):
    """A number out of its limits, no number, an entry that this version does not know, another type."""
    blur = part("addon.export.blur_steps")
    kept = {
        "samples": 2**31 - 1,
        "camera_sees": 7,
        "bounces": -3,
        "clamp_indirect": float("nan"),
        "shading_model": "another",
    }
    for name, value in (kept | {"blur_steps": 2**31 - 1}).items():
        stored(scene.drgs)[name] = value
    stored(scene.view_layers[0].drgs)["others"] = 9
    ball.drgs.adjustment.use = True
    stored(ball.drgs.adjustment)["roughness_gain"] = float("nan")
    scene.render.use_motion_blur, scene.drgs.use_strategy_samples = True, False
    frame, warnings = export()
    settings = frame.settings
    assert (settings.samples, settings.bounces, settings.clamp_indirect) == (65536, 0, 0)
    assert (settings.camera_sees, settings.shading_model) == ("surfels", "principled")
    assert frame.objects[0].adjustment.roughness[0] == 1 and not frame.objects[0].visibility.holdout
    assert len(blur.steps(scene, scene.view_layers[0], scene.camera, warnings.append)) == 1024
    named = {w.split(" is ")[0] for w in warnings}
    assert named == {
        'Scene "Scene": Samples', 'Scene "Scene": Camera Sees', 'Scene "Scene": Bounces',
        'Scene "Scene": Clamp Indirect', 'Scene "Scene": Blur Steps', 'View layer "ViewLayer": Other Objects',
        'Object "ball": Roughness Factor',
    }  # fmt: skip
    assert all("is used. Set it again" in w for w in warnings)
