"""Add Proxy Mesh: captures without a mesh are bent by what bends meshes, in pictures, exports and the viewport."""

from __future__ import annotations

from dataclasses import fields, replace
from math import radians

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector
from scenes import (
    armature_object,
    asset_of,
    import_surfels_alone,
    mesh_object,
    new_world,
    part,
    read_exr,
    select,
    sphere,
)

pytestmark = pytest.mark.blender_api


@pytest.fixture
def cloud(scene, tmp_path):
    """The ball's surfels alone, moved and turned."""
    obj = import_surfels_alone(tmp_path)
    scene.drgs.rays_see = "surfels"
    obj.matrix_world = Matrix.Translation((1, 2, 0.5)) @ Matrix.Rotation(0.4, 4, "Z")
    bpy.context.view_layer.update()
    return obj


def add_proxy(*others, faces=400):
    assert bpy.ops.drgs.add_proxy(faces=faces) == {"FINISHED"}
    return bpy.context.object


def centres(obj) -> np.ndarray:
    return part("addon.assets").load(part("addon.assets").file_of(obj)).surfels.centre


def test_a_proxy_is_closed_around_all_surfels(cloud, export):
    add_proxy()
    assert 100 < len(cloud.data.polygons) < 700 and cloud.display_type == "WIRE"
    edges = np.array([edge.vertices for edge in cloud.data.edges])
    faces = [edge for polygon in cloud.data.polygons for edge in polygon.edge_keys]
    assert len(faces) == 2 * len(edges), "every edge has two faces"
    import bmesh

    solid = bmesh.new()
    solid.from_mesh(cloud.data)
    assert solid.calc_volume(signed=True) > 4 / 3 * np.pi * 0.9**3, "it is around the ball, its faces outwards"
    frame, warnings = export()
    assert not warnings and frame.objects[0].proxy is None, "nothing moves it"


def picture(scene) -> np.ndarray:
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, 64, 48)


def test_an_armature_bends_a_capture_without_a_mesh(scene, cloud, export):
    """A bone that turns the whole proxy gives the picture of an object that is turned."""
    scene.render.film_transparent = True
    new_world(scene)[1].inputs["Color"].default_value = (1, 1, 1, 1)
    rig = armature_object({"Bone": ((0, 0, -1), (0, 0, 1))})
    cloud.matrix_world = rig.matrix_world = Matrix.Rotation(0.3, 4, "X")
    select(cloud)
    add_proxy()
    select(rig, cloud)
    assert bpy.ops.drgs.bind_to_armature() == {"FINISHED"}
    before = picture(scene)
    bone = rig.pose.bones["Bone"]
    bone.rotation_mode, bone.rotation_euler, bone.location = "XYZ", (0, radians(70), 0), (0.3, 0.4, 0)
    bpy.context.view_layer.update()
    assert not export()[1]
    found = picture(scene)
    turn = bone.matrix @ bone.bone.matrix_local.inverted()
    bone.rotation_euler = bone.location = (0, 0, 0)
    cloud.matrix_world = cloud.matrix_world @ turn
    bpy.context.view_layer.update()
    want = picture(scene)
    assert np.abs(found - want).mean() < 0.1 * np.abs(before - want).mean()
    assert np.abs(before - want).mean() > 0.02


def test_viewports_show_them_about_there(cloud, export):
    select(cloud)
    add_proxy()
    twist = cloud.modifiers.new("Twist", "SIMPLE_DEFORM")
    twist.deform_method, twist.angle, twist.deform_axis = "TWIST", radians(60), "Z"
    bpy.context.view_layer.update()
    proxy = export()[0].objects[0].proxy
    shown = part("addon.proxies").carried(centres(cloud), proxy)
    low, high = proxy.rest[:, 2].min(), proxy.rest[:, 2].max()
    angle = radians(60) * ((centres(cloud)[:, 2] - low) / (high - low) - 0.5)
    x, y, z = centres(cloud).T
    want = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z], axis=1)
    assert np.abs(shown - want).max() < 0.06 < np.abs(want - centres(cloud)).max()


def test_a_mesh_of_the_artist_is_the_proxy(cloud, export):
    cage = mesh_object("Body", *sphere(6, 8))
    cage.matrix_world = cloud.matrix_world
    bpy.context.view_layer.update()
    select(cage, cloud)
    assert bpy.ops.drgs.add_proxy() == {"FINISHED"}
    assert cage.hide_render and bpy.context.object == cloud
    own = part("addon.mesh_arrays").read_vertices(cloud.data)
    np.testing.assert_allclose(own, sphere(6, 8)[0], atol=1e-5)
    cloud.shape_key_add(name="Basis")
    key = cloud.shape_key_add(name="Up")
    for point in key.data:
        point.co.z += 0.25
    key.value = 1.0
    bpy.context.view_layer.update()
    proxy = export()[0].objects[0].proxy
    np.testing.assert_allclose(proxy.vertices - proxy.rest, np.tile((0, 0, 0.25), (len(own), 1)), atol=1e-6)


def test_modifiers_may_subdivide_a_proxy(cloud, export):
    """New vertices know where they were: only what moves them counts."""
    select(cloud)
    add_proxy()
    cloud.modifiers.new("Finer", "SUBSURF").subdivision_type = "SIMPLE"
    bpy.context.view_layer.update()
    frame, warnings = export()
    proxy = frame.objects[0].proxy
    assert not warnings and (proxy is None or np.abs(proxy.vertices - proxy.rest).max() < 1e-5)


def test_what_has_a_mesh_or_a_proxy_is_refused(ball, cloud):
    select(ball)
    with pytest.raises(RuntimeError, match="can be bent itself"):
        bpy.ops.drgs.add_proxy()
    select(cloud)
    add_proxy()
    with pytest.raises(RuntimeError, match=r"has a proxy already.*delete its vertices in Edit Mode"):
        bpy.ops.drgs.add_proxy()


def test_meshes_that_are_no_proxy_are_refused_and_nothing_changes(cloud):
    far = mesh_object("Far", *sphere(6, 8))
    far.location = (100, 0, 0)
    wires = mesh_object("Wires", [(0, 0, 0), (1, 0, 0)], [])
    bpy.context.view_layer.update()
    for other, words in ((far, "is not at"), (wires, "has no faces")):
        select(other, cloud)
        with pytest.raises(RuntimeError, match=words):
            bpy.ops.drgs.add_proxy()
        assert not len(cloud.data.vertices) and not other.hide_render


def test_without_a_proxy_binding_says_what_to_do(cloud):
    select(cloud)
    with pytest.raises(RuntimeError, match="Add Proxy Mesh"):
        bpy.ops.drgs.bind_to_lattice()


def test_materials_of_a_proxy_are_refused_by_name(cloud):
    select(cloud)
    add_proxy()
    with pytest.raises(RuntimeError, match="Use Adjustments"):
        bpy.ops.drgs.set_material()


def test_a_mask_of_a_proxy_is_told(cloud, export):
    select(cloud)
    add_proxy()
    cloud.drgs.adjustment.saturation = 0.2
    assert export()[0].objects[0].adjustment is not None and not export()[1]
    cloud.vertex_groups.new(name="Half")
    cloud.drgs.adjustment.mask = "Half"
    frame, warnings = export()
    assert frame.objects[0].adjustment is None and any('"Half"' in text for text in warnings)


def test_a_proxy_is_simulated_and_its_particles_carry_the_surfels(scene, cloud, export, captured):
    """What is inside of the proxy is the matter; without particles the proxy's vertices carry."""
    select(cloud)
    add_proxy()
    physics = cloud.drgs.physics
    physics.use = True
    physics.youngs_modulus, physics.resolution, physics.frame_end = 2e4, 8, 4
    bpy.ops.drgs.bake_physics()
    scene.frame_set(4)
    frame, warnings = export()
    state = frame.objects[0]
    assert not warnings and state.proxy is None and state.particles.all
    assert (state.particles.points[:, 2] < state.particles.rest[:, 2]).all(), "it falls"
    fallen = (state.particles.points - state.particles.rest)[:, 2].mean()
    physics.driven_by = "surface"
    state = export()[0].objects[0]
    assert state.particles is None
    assert abs((state.proxy.vertices - state.proxy.rest)[:, 2].mean() - fallen) < 0.05 * abs(fallen)


def test_vectors_know_where_a_proxy_was(scene, cloud, captured):
    """Bent by a shape key, at rest before and after; then simulated; then not moving at all."""
    scene.view_layers[0].use_pass_vector = True
    select(cloud)
    add_proxy()
    moved_up(cloud, 0.5)
    key = cloud.data.shape_keys.key_blocks["Up"]
    for number, value in enumerate((0.0, 1.0, 0.0), 1):
        key.value = value
        key.keyframe_insert("value", frame=number)
    for number in (1, 2):
        scene.frame_set(number)
        bpy.ops.render.render()
    one, two = captured
    assert one.objects[0].proxy is None and one.previous.objects[0].proxy is None
    for at_rest in (two.previous, two.next):
        proxy = at_rest.objects[0].proxy
        np.testing.assert_array_equal(proxy.vertices, proxy.rest)
    lifted = one.next.objects[0].proxy
    np.testing.assert_array_equal(lifted.vertices, two.objects[0].proxy.vertices)
    np.testing.assert_allclose((lifted.vertices - lifted.rest)[:, 2], 0.5, atol=1e-6)


def test_vectors_know_where_particles_were(scene, cloud, captured):
    scene.view_layers[0].use_pass_vector = True
    select(cloud)
    add_proxy()
    physics = cloud.drgs.physics
    physics.use = True
    physics.youngs_modulus, physics.resolution, physics.frame_end = 2e4, 8, 4
    bpy.ops.drgs.bake_physics()
    for number in (3, 4):
        scene.frame_set(number)
        bpy.ops.render.render()
    three, four = captured
    assert four.previous.objects[0].proxy is None
    np.testing.assert_array_equal(four.previous.objects[0].particles.points, three.objects[0].particles.points)
    np.testing.assert_array_equal(three.next.objects[0].particles.gradients, four.objects[0].particles.gradients)
    assert (three.objects[0].particles.points[:, 2] > four.objects[0].particles.points[:, 2]).all()


def test_a_proxy_in_edit_mode_shows_what_is_edited(cloud, export):
    select(cloud)
    add_proxy()
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.transform.translate(value=(0, 0, 0.5))
    proxy = export()[0].objects[0].proxy
    np.testing.assert_allclose((proxy.vertices - proxy.rest)[:, 2], 0.5, atol=1e-5)
    bpy.ops.object.mode_set(mode="OBJECT")
    proxy = export()[0].objects[0].proxy
    np.testing.assert_allclose((proxy.vertices - proxy.rest)[:, 2], 0.5, atol=1e-5)


def test_a_modifier_that_forgets_the_proxy_is_named(cloud, export):
    """Remesh makes vertices that do not know where they were."""
    select(cloud)
    add_proxy()
    cloud.modifiers.new("New mesh", "REMESH").voxel_size = 0.2
    bpy.context.view_layer.update()
    with pytest.raises(part("drgs_blender.core.errors").AssetError, match="New mesh"):
        export()


def moved_up(obj, by):
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="Up")
    for point in key.data:
        point.co.z += by
    key.value = 1.0
    bpy.context.view_layer.update()


def test_vertices_that_are_added_or_joined_carry_nothing_and_are_told(cloud, export):
    """Blender gives them 0 as their place at rest."""
    select(cloud)
    add_proxy()
    count = len(cloud.data.vertices)
    other = mesh_object("Other", *sphere(6, 8))
    other.location = (30, 0, 0)
    bpy.context.view_layer.update()
    select(other, cloud)
    bpy.ops.object.join()
    cloud.data.vertices[0].co.z += 0.1
    bpy.context.view_layer.update()
    frame, warnings = export()
    assert len(frame.objects[0].proxy.rest) == count < len(cloud.data.vertices)
    added = len(cloud.data.vertices) - count
    assert any(f"{added} vertices of its proxy do not know" in text for text in warnings)


def test_parts_of_one_proxy_are_told(cloud, export):
    """Both have all surfels; a copy and the same capture with a proxy of its own do not count."""
    select(cloud)
    add_proxy()
    bpy.ops.object.duplicate()
    bpy.ops.import_scene.drgs(filepath=str(part("addon.assets").file_of(cloud)))
    sheet = mesh_object("Sheet", [(-1, -1, 0), (1, -1, 0), (1, 1, 0)], [(0, 1, 2)])
    select(sheet, bpy.context.object)
    assert bpy.ops.drgs.add_proxy() == {"FINISHED"}
    assert not export()[1]
    select(cloud)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    for vertex in cloud.data.vertices:
        vertex.select = vertex.co.z > 0
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.separate(type="SELECTED")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len([text for text in export()[1] if "parts of one proxy" in text and cloud.name in text]) == 1


def test_a_vertex_in_the_origin_is_known(cloud, export):
    select(cloud)
    cage = mesh_object("Sheet", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0, 0, 0)], [(0, 1, 4), (2, 3, 4)])
    cage.matrix_world = cloud.matrix_world
    bpy.context.view_layer.update()
    select(cage, cloud)
    bpy.ops.drgs.add_proxy()
    assert not export()[1] and export()[0].objects[0].proxy is None


@pytest.mark.parametrize("kind", ["ARRAY", "MIRROR", "SOLIDIFY", "SUBSURF"])
def test_modifiers_that_change_the_shape_of_a_proxy_are_named(cloud, export, kind):
    select(cloud)
    add_proxy()
    cloud.modifiers.new("Other shape", kind)
    bpy.context.view_layer.update()
    assert any('"Other shape"' in text for text in export()[1])
    cloud.modifiers[0].show_viewport = False
    bpy.context.view_layer.update()
    assert not export()[1]


def test_surfels_are_edited_and_cropped_where_they_are_seen(cloud, scene):
    select(cloud)
    add_proxy()
    moved_up(cloud, 2.0)
    count = len(cloud.data.vertices)
    crop_to_upper_half(cloud, scene, lifted=2)
    kept = part("addon.surfel_points").left_of(cloud, part("addon.assets").load(part("addon.assets").file_of(cloud)))
    assert 0 < len(kept) < len(centres(cloud)) and (centres(cloud)[kept, 2] > -0.05).all()
    assert len(cloud.data.vertices) == count
    select(cloud)
    bpy.ops.drgs.edit_surfels()
    bpy.ops.object.mode_set(mode="OBJECT")
    shown = part("addon.mesh_arrays").read_vertices(bpy.context.object.data)
    np.testing.assert_allclose(shown, centres(cloud)[kept] + (0, 0, 2), atol=1e-4)


def crop_to_upper_half(cloud, scene, lifted=0):
    box = bpy.data.objects.new("Box", None)
    scene.collection.objects.link(box)
    box.empty_display_type, box.matrix_world = "CUBE", cloud.matrix_world @ Matrix.Translation((0, 0, 1 + lifted))
    bpy.context.view_layer.update()
    select(box, cloud)
    assert bpy.ops.drgs.crop() == {"FINISHED"}
    select(cloud)


def test_a_proxy_and_its_matter_are_of_the_surfels_that_are_left(cloud, scene):
    select(cloud)
    add_proxy()
    whole = part("addon.mesh_arrays").read_vertices(cloud.data)
    assert whole[:, 2].min() < -0.9
    crop_to_upper_half(cloud, scene)
    told = part("addon.messages").history[-1]
    assert told.level == "WARNING" and '"cloud": its proxy still encloses the surfels that are removed' in told.text
    # What it says to do.
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.object.mode_set(mode="OBJECT")
    add_proxy()
    found = part("addon.mesh_arrays").read_vertices(cloud.data)
    asset = part("addon.assets").load(part("addon.assets").file_of(cloud))
    reach = 1.5 * asset.surfels.scale.max() + 4 * 2 * 3**0.5 / 64
    assert max(-reach, 0.7 * whole[:, 2].min()) < found[:, 2].min() < 0.05 and found[:, 2].max() > 0.95
    cloud.drgs.physics.use, cloud.drgs.physics.resolution = True, 12
    bpy.ops.drgs.show_particles()
    points = part("addon.physics.particle_display").of(cloud).points
    assert len(points) > 100 and points[:, 2].min() > found[:, 2].min()


def test_a_mesh_of_the_artist_is_held_against_what_is_left(cloud, scene):
    crop_to_upper_half(cloud, scene)
    shape = mesh_object("Shape", np.multiply(sphere()[0], 0.3), sphere()[1])
    shape.matrix_world = cloud.matrix_world @ Matrix.Translation((0, 0, -2.5))
    select(shape, cloud)
    with pytest.raises(RuntimeError, match='"Shape": is not at "cloud"'):
        bpy.ops.drgs.add_proxy()


@pytest.mark.parametrize("proxy", [False, True])
def test_a_new_camera_sees_the_surfels_that_are_left_as_they_are_posed(cloud, scene, proxy):
    from bpy_extras.object_utils import world_to_camera_view

    select(cloud)
    shift = 2.0 * proxy
    if proxy:
        add_proxy()
        moved_up(cloud, shift)
    else:
        crop_to_upper_half(cloud, scene)
    kept = part("addon.surfel_points").left_of(cloud, part("addon.assets").load(part("addon.assets").file_of(cloud)))
    places = centres(cloud)[slice(None) if kept is None else kept] + (0, 0, shift)
    bpy.data.objects.remove(scene.camera)
    assert bpy.ops.drgs.add_camera() == {"FINISHED"}
    bpy.context.view_layer.update()
    seen = np.array([world_to_camera_view(scene, scene.camera, cloud.matrix_world @ Vector(at)) for at in places])
    assert (seen[:, :2] > 0).all() and (seen[:, :2] < 1).all() and (seen[:, 2] > 0).all()
    assert np.ptp(seen[:, :2], axis=0).max() > 0.6, "and nothing that is not there"


def test_viewports_find_the_parts_of_what_is_left_once(cloud, export, monkeypatch):
    """After an edit the surfels are another array at every update, and two objects may have one asset."""
    select(cloud)
    add_proxy()
    moved_up(cloud, 0.5)
    proxies, proxy, made = part("addon.proxies"), export()[0].objects[0].proxy, []
    divided = proxies._divided
    monkeypatch.setattr(proxies, "_divided", lambda *given: made.append(given) or divided(*given))
    other = type(proxy)(proxy.rest * np.float32(1.1), proxy.vertices, proxy.faces)
    for each in (proxy, other, proxy, other):
        proxies.carried(centres(cloud)[::2].copy(), each)
    assert len(made) == 2


def test_one_that_has_no_room_for_a_proxy_leaves_the_others_as_they_are(cloud, scene, tmp_path):
    container, model = (part(f"drgs_blender.core.asset.{name}") for name in ("container", "model"))
    ball = asset_of(*sphere()).surfels
    none = {f.name: value[:0] for f in fields(ball) if isinstance(value := getattr(ball, f.name), np.ndarray)}
    container.write_asset(tmp_path / "none.drgs", model.Asset(replace(ball, **none), model.Mesh.empty()))
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "none.drgs"))
    select(cloud, bpy.context.object)
    with pytest.raises(RuntimeError, match="has no surfels"):
        bpy.ops.drgs.add_proxy()
    assert not len(cloud.data.vertices)


def test_a_proxy_is_not_saved_as_a_shape(cloud, tmp_path):
    select(cloud)
    add_proxy()
    with pytest.raises(RuntimeError, match="has a proxy in place of a mesh"):
        bpy.ops.drgs.save_shape(filepath=str(tmp_path / "shape.drgs"))


def test_an_alembic_file_of_a_proxy_is_told(cloud, tmp_path, capfd):
    """It has no surfels; the proxy alone is not what was captured."""
    select(cloud)
    add_proxy()
    bpy.ops.drgs.export("EXEC_DEFAULT", filepath=str(tmp_path / "x.abc"), format="Alembic sequence", frame_end=2)
    assert '"cloud" has no mesh: x.abc has only its proxy' in capfd.readouterr().out


def test_viewports_turn_what_lies_beside_a_sheet(cloud):
    """Points in a plane have a mirror image on each side: only one is a turn."""
    axis = np.linspace(-1, 1, 9)
    rest = np.stack([*np.meshgrid(axis, axis), np.zeros((9, 9))], -1).reshape(-1, 3).astype(np.float32)
    frame, proxies = part("drgs_blender.core.frame"), part("addon.proxies")
    for axis, angle in (("X", 0.5), ("Y", 2.0), ("Z", 3.0)):
        turn = np.array(Matrix.Rotation(angle, 3, axis), np.float32)
        proxy = frame.ProxyMesh(rest, rest @ turn.T, np.zeros((0, 3), np.int32))
        np.testing.assert_allclose(proxies.carried(centres(cloud), proxy), centres(cloud) @ turn.T, atol=1e-3)
