"""Surfels as points: selected, deleted, brought back; floaters, and cropping to a box."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import asset_of, part, select, sphere

pytestmark = pytest.mark.blender_api

container = part("drgs_blender.core.asset.container")


@pytest.fixture
def littered(scene, tmp_path):
    """The ball with five surfels in the air, which hang on its faces; (object, asset, which are in the air)."""
    asset, model = asset_of(*sphere(24, 36)), part("drgs_blender.core.asset.model")
    litter = np.float32([[2.5, 0, 0], [0, 2.5, 0], [0, 0, 2.5], [-2.5, 0, 0], [0, -2.5, 0]])
    k, s, b = len(litter), asset.surfels, asset.binding
    more = lambda values: np.concatenate([values, values[:k]])  # noqa: E731
    surfels = model.Surfels(
        np.concatenate([s.centre, litter]), more(s.scale), more(s.rotation), np.append(s.opacity, np.full(k, 0.2)),
        more(s.albedo), more(s.roughness), more(s.metallic),
    )  # fmt: skip
    binding = model.Binding(more(b.face), more(b.barycentric), np.append(b.offset, np.full(k, 5.0)), more(b.normal))
    path = tmp_path / "littered.drgs"
    container.write_asset(path, model.Asset(surfels, asset.mesh, binding))
    bpy.ops.import_scene.drgs(filepath=str(path))
    return bpy.context.active_object, container.read_asset(path), np.arange(len(surfels.centre)) >= len(s.centre)


def chosen():
    points = bpy.context.edit_object
    points.update_from_editmode()
    found = np.empty(len(points.data.vertices), bool)
    points.data.vertices.foreach_get("select", found)
    return found


def delete_upper_points():
    """Delete the points above the ground of the object in Edit Mode, as by hand."""
    import bmesh

    mesh = bmesh.from_edit_mesh(bpy.context.edit_object.data)
    for vertex in mesh.verts:
        vertex.select = vertex.co.z > 0
    bmesh.update_edit_mesh(bpy.context.edit_object.data)
    bpy.ops.mesh.delete(type="VERT")


def test_floaters_are_found_deleted_and_gone_from_the_render(littered, export):
    obj, asset, litter = littered
    assert bpy.ops.drgs.edit_surfels() == {"FINISHED"}
    assert bpy.context.mode == "EDIT_MESH" and not chosen().any()
    assert bpy.ops.drgs.select_surfels(criterion="FLOATERS") == {"FINISHED"}
    np.testing.assert_array_equal(chosen(), litter)
    assert export()[0].objects[0].part is None  # nothing is deleted yet
    bpy.ops.mesh.delete(type="VERT")
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert bpy.context.active_object is obj and "littered surfels" not in bpy.data.objects
    state, warnings = export()[0].objects[0], export()[1]
    np.testing.assert_array_equal(state.part.removed, np.flatnonzero(litter))
    assert warnings == [] and len(state.part.face) == len(asset.mesh.faces)  # no face was theirs
    cut = part("drgs_blender.core.asset.part").part_of(asset, state.part)
    np.testing.assert_array_equal(cut.surfels.centre, asset.surfels.centre[~litter])


def test_what_was_deleted_comes_back_with_a_click_or_undo(littered, export):
    obj, _, litter = littered
    bpy.ops.ed.undo_push(message="before")
    name = obj.name
    bpy.ops.drgs.edit_surfels()
    bpy.ops.drgs.select_surfels(criterion="FLOATERS")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.drgs.finish_surfels()
    bpy.ops.ed.undo_push(message="cleaned")
    bpy.ops.ed.undo()
    assert export()[0].objects[0].part is None
    bpy.ops.ed.redo()
    assert len(export()[0].objects[0].part.removed) == litter.sum()
    select(bpy.data.objects[name])
    assert bpy.ops.drgs.restore_surfels() == {"FINISHED"}
    assert export()[0].objects[0].part is None


def test_editing_goes_on_where_it_was_left(littered, export):
    """A second round shows what is left; what was deleted in the first one stays deleted."""
    _, _, litter = littered
    bpy.ops.drgs.edit_surfels()
    bpy.ops.drgs.select_surfels(criterion="FLOATERS")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.drgs.finish_surfels()
    bpy.ops.drgs.edit_surfels()
    assert len(chosen()) == (~litter).sum()
    assert len(export()[0].objects[0].part.removed) == litter.sum()  # also while points are edited
    bpy.ops.drgs.select_surfels(criterion="SIZE", size=0.0)
    assert chosen().all()
    bpy.ops.drgs.select_surfels(criterion="OPACITY", opacity=0.5)
    assert not chosen().any()
    with pytest.raises(RuntimeError, match="holds no surfel whose colour is meant"):
        bpy.ops.drgs.select_surfels(criterion="COLOUR")
    bpy.ops.object.mode_set(mode="OBJECT")  # by Tab, without Finish
    assert len(export()[0].objects[0].part.removed) == litter.sum()
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert [o.type for o in bpy.context.scene.objects if o.name.endswith("surfels")] == []


def test_editing_that_was_not_finished_goes_on(littered, export):
    """Tab and another click on Edit Surfels: one set of points, without what was deleted before."""
    obj, _, litter = littered
    bpy.ops.drgs.edit_surfels()
    bpy.ops.drgs.select_surfels(criterion="FLOATERS")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.object.mode_set(mode="OBJECT")
    select(obj)
    assert bpy.ops.drgs.edit_surfels() == {"FINISHED"}
    assert len(chosen()) == (~litter).sum()
    assert [o.drgs.points_of for o in bpy.data.objects if o.drgs.points_of is not None] == [obj]
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert len(export()[0].objects[0].part.removed) == litter.sum()


def test_faces_go_with_the_surfels_that_cover_them(littered, export):
    """Half of the surfels deleted by hand: their faces go, with Finish, and with them nothing else."""
    _, asset, _ = littered
    bpy.ops.drgs.edit_surfels()
    delete_upper_points()
    bpy.ops.drgs.finish_surfels()
    state = export()[0].objects[0]
    gone = asset.surfels.centre[: len(asset.mesh.faces), 2] > 0  # a surfel in the middle of each face
    assert sorted(state.part.face) == np.flatnonzero(~gone).tolist()
    np.testing.assert_array_equal(state.part.removed[state.part.removed < len(gone)], np.flatnonzero(gone))


def test_points_stand_where_the_object_is_posed(littered):
    obj, _, _ = littered
    for vertex in obj.data.vertices:
        vertex.co.x += 3
    obj.location = 0, 0, 1
    bpy.context.view_layer.update()
    bpy.ops.drgs.edit_surfels()
    points = bpy.context.edit_object
    low = min(v[0] for v in points.bound_box)
    assert points.matrix_world.translation.z == 1 and low > 1.4


@pytest.mark.parametrize("inside", [False, True])
def test_crop_leaves_what_is_in_the_box_or_outside(littered, export, inside):
    obj, asset, _ = littered
    bpy.ops.mesh.primitive_cube_add(size=2)
    box = bpy.context.active_object
    box.location, box.rotation_euler, box.scale = (0, 0, 1), (0, 0, 0.4), (3, 3, 1)
    bpy.context.view_layer.update()
    select(box, obj)
    assert bpy.ops.drgs.crop(use_inside=inside) == {"FINISHED"}
    bpy.data.objects.remove(box)
    state, warnings = export()[0].objects[0], export()[1]
    heights = asset.mesh.vertices[:, 2]
    kept = heights < 0 if inside else heights >= 0
    np.testing.assert_array_equal(np.sort(state.part.vertices), np.flatnonzero(kept))
    surfels = asset.surfels.centre
    angle = np.arctan2(surfels[:, 1], surfels[:, 0]) - 0.4
    flat = np.linalg.norm(surfels[:, :2], axis=1)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    within = (np.abs(flat) <= 3).all(axis=1) & (surfels[:, 2] >= 0) & (surfels[:, 2] <= 2)
    of_faces = np.arange(len(asset.mesh.faces))  # others hang where their faces say
    removed = state.part.removed[state.part.removed < len(of_faces)]
    np.testing.assert_array_equal(removed, np.flatnonzero(within[of_faces] == inside))
    assert warnings == []


def test_crop_needs_one_box_and_leaves_something(littered):
    obj, _, _ = littered
    select(obj)
    with pytest.raises(RuntimeError, match="0 objects that could be the box"):
        bpy.ops.drgs.crop()
    bpy.ops.object.empty_add(type="CUBE", location=(50, 0, 0))
    bpy.context.view_layer.update()
    select(bpy.context.active_object, obj)
    with pytest.raises(RuntimeError, match='"littered": would be gone as a whole'):
        bpy.ops.drgs.crop()


def test_shape_keys_and_groups_survive_a_crop(littered, export):
    obj, asset, _ = littered
    obj.shape_key_add(name="Basis")
    key = obj.shape_key_add(name="High")
    for point in key.data:
        point.co.z += 1
    key.value = 1.0
    obj.vertex_groups.new(name="All").add(range(len(obj.data.vertices)), 0.5, "REPLACE")
    bpy.context.view_layer.update()
    bpy.ops.object.empty_add(type="CUBE", location=(0, 0, 4))
    bpy.context.active_object.empty_display_size = 3.0
    bpy.context.view_layer.update()
    select(bpy.context.active_object, obj)
    bpy.ops.drgs.crop()  # by the places that the key has moved to: from 1 upwards
    kept = asset.mesh.vertices[:, 2] + 1 >= 1
    (state,) = export()[0].objects
    np.testing.assert_array_equal(np.sort(state.part.vertices), np.flatnonzero(kept))
    np.testing.assert_allclose(state.vertices, asset.mesh.vertices[state.part.vertices] + [0, 0, 1], atol=1e-6)
    assert all(abs(v.groups[0].weight - 0.5) < 1e-6 for v in obj.data.vertices)


def test_a_cleaned_object_is_saved_clean(littered, export, tmp_path):
    _, asset, litter = littered
    bpy.ops.drgs.edit_surfels()
    bpy.ops.drgs.select_surfels(criterion="FLOATERS")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.drgs.finish_surfels()
    path = tmp_path / "clean.drgs"
    assert bpy.ops.drgs.save_asset(filepath=str(path), use_saved=True) == {"FINISHED"}
    saved = container.read_asset(path)
    np.testing.assert_array_equal(saved.surfels.centre, asset.surfels.centre[~litter])
    np.testing.assert_array_equal(saved.mesh.faces, asset.mesh.faces)
    state = export()[0].objects[0]
    assert state.part is None and state.asset == str(path)


def test_points_of_another_asset_are_named(littered, export, ball_file):
    obj, _, _ = littered
    bpy.ops.drgs.edit_surfels()
    bpy.ops.drgs.select_surfels(criterion="FLOATERS")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.drgs.finish_surfels()
    obj.drgs.surfel_points.attributes["drgs_surfel"].data[0].value = 10**6
    with pytest.raises(Exception, match=r'"littered".*its points .* Press Restore Surfels'):
        export()


@pytest.mark.parametrize("way", ["finish", "save_asset", "save_shape"])
def test_objects_that_share_the_mesh_stay_as_they_are(ball, export, tmp_path, way):
    """Linked duplicates (Alt-D): of one, surfels are deleted with their faces, or it is saved as another asset."""
    twin = bpy.data.objects.new("twin", ball.data)
    twin.drgs.asset = ball.drgs.asset
    bpy.context.scene.collection.objects.link(twin)
    if way == "finish":
        select(ball)
        bpy.ops.drgs.edit_surfels()
        delete_upper_points()
        bpy.ops.drgs.finish_surfels()
        parts = {state.name: state.part for state in export()[0].objects}
        assert parts["twin"] is None and len(parts["ball"].face) < 168
        return
    import bmesh

    mesh = bmesh.new()
    mesh.from_mesh(ball.data)
    bmesh.ops.delete(mesh, geom=[v for v in mesh.verts if v.co.z > 0.1], context="VERTS")
    mesh.to_mesh(ball.data)
    mesh.free()
    select(ball, twin)
    if way == "save_asset":
        assert bpy.ops.drgs.save_asset(filepath=str(tmp_path / "a.drgs"), use_saved=True) == {"FINISHED"}
        assert [state.part for state in export()[0].objects] == [None, None]
    else:
        select(ball)
        assert bpy.ops.drgs.save_shape(filepath=str(tmp_path / "a.drgs")) == {"FINISHED"}
        parts = {state.name: state.part for state in export()[0].objects}
        assert parts["ball"] is None and len(parts["twin"].face) == 84
