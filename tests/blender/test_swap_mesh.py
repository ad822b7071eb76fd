"""A new mesh with its rig takes the surfels of a DR-GS object."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import armature_object, asset_of, mesh_object, part, select, sphere

pytestmark = pytest.mark.blender_api

container = part("drgs_blender.core.asset.container")


@pytest.fixture
def dense(scene, tmp_path):
    """A ball of many faces, each with a surfel."""
    path = tmp_path / "dense.drgs"
    container.write_asset(path, asset_of(*sphere(24, 36)))
    bpy.ops.import_scene.drgs(filepath=str(path))
    return bpy.context.active_object


def retopology(matrix=None, flip=False):
    """A ball of quads at the same place, seen through an object matrix of its own."""
    vertices, faces = sphere(16, 24)
    matrix = Matrix() if matrix is None else matrix
    inverse = np.array(matrix.inverted())
    local = vertices @ inverse[:3, :3].T + inverse[:3, 3]
    obj = mesh_object("retopo", local, faces[:, ::-1] if flip else faces)
    obj.matrix_world = matrix
    select(obj)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.tris_convert_to_quads()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len(obj.data.polygons) < len(faces)
    return obj


def swap(obj, other, tmp_path, **more):
    select(other, obj)
    return bpy.ops.drgs.swap_mesh(filepath=str(tmp_path / "swapped.drgs"), **more)


def test_the_new_mesh_has_the_surfels_and_keeps_its_rig(dense, export, tmp_path):
    """Another transform, quads, weights, a shape key and a bone: what is bent afterwards carries the surfels along."""
    other = retopology(Matrix.LocRotScale((3, 0, 1), Matrix.Rotation(0.7, 3, "X").to_quaternion(), (2, 2, 2)))
    dense.matrix_world = Matrix.Translation((0, 0, 0))
    rig = armature_object({"bone": ((0, 0, 0), (0, 0, 1))})
    other.vertex_groups.new(name="bone").add(range(len(other.data.vertices)), 1.0, "REPLACE")
    other.modifiers.new("Armature", "ARMATURE").object = rig
    other.shape_key_add(name="Basis")
    key = other.shape_key_add(name="Up")
    for point in key.data:
        point.co.z += 1
    key.value = 0.0
    before = container.read_asset(tmp_path / "dense.drgs")
    assert swap(dense, other, tmp_path) == {"FINISHED"}
    made = container.read_asset(tmp_path / "swapped.drgs")
    world = np.array(other.matrix_world)
    centre = made.surfels.centre @ world[:3, :3].T + world[:3, 3]
    np.testing.assert_allclose(centre, before.surfels.centre, atol=1e-4)
    (state,), warnings = export()[0].objects, export()[1]
    assert state.name == "retopo" and state.asset == str(tmp_path / "swapped.drgs")
    assert state.part is None and state.albedo is None and warnings == []
    rows = part("addon.mesh_arrays").read_source_vertices(other.data, made.mesh)
    np.testing.assert_array_equal(rows, np.arange(len(state.vertices)))  # for what is cut and copied later
    assert dense.hide_get() and dense.hide_render and bpy.context.active_object == other
    assert [m.type for m in other.modifiers] == ["ARMATURE"] and other.vertex_groups[0].name == "bone"
    key.value = 1.0
    assert np.allclose(export()[0].objects[0].vertices - state.vertices, [0, 0, 1], atol=1e-5)
    key.value = 0.0
    rig.pose.bones["bone"].location.y = 5
    bpy.context.view_layer.update()
    moved = export()[0].objects[0].vertices - state.vertices
    assert np.abs(moved).max() > 1 and len(other.data.polygons) < len(made.mesh.faces)


def test_what_is_painted_cut_and_deleted_comes_along(dense, export, tmp_path):
    heights = container.read_asset(tmp_path / "dense.drgs").surfels.centre[:, 2]
    bpy.ops.drgs.set_material(preset="GOLD")
    dense.drgs.adjustment.hue = 1.0
    select(dense)
    bpy.ops.drgs.edit_surfels()
    import bmesh

    mesh = bmesh.from_edit_mesh(bpy.context.edit_object.data)
    for vertex in mesh.verts:
        vertex.select = vertex.co.z > 0.8
    bmesh.update_edit_mesh(bpy.context.edit_object.data)
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.drgs.finish_surfels()
    for vertex in dense.data.vertices:
        vertex.co.x *= 1.02
    other = retopology()
    assert swap(dense, other, tmp_path) == {"FINISHED"}
    made = container.read_asset(tmp_path / "swapped.drgs")
    assert len(made.surfels) == (heights <= 0.8).sum() and made.surfels.metallic.min() > 0.99
    assert made.mesh.metallic.min() > 0.99 and abs(made.surfels.centre[:, 0].max() - 1.02) < 0.02
    assert export()[0].objects[0].adjustment.hue == pytest.approx(1 / (2 * np.pi))
    told = " ".join(message.text for message in part("addon.messages").history)
    assert "has no surfels on" in told  # where they were deleted


@pytest.mark.parametrize("has", [False, True])
def test_a_mask_that_the_new_mesh_lacks_is_told(dense, tmp_path, has):
    dense.vertex_groups.new(name="Half").add([0, 1], 1.0, "REPLACE")
    dense.drgs.adjustment.hue, dense.drgs.adjustment.mask = 1.0, "Half"
    other = retopology()
    if has:
        other.vertex_groups.new(name="Half").add([0], 1.0, "REPLACE")
    swap(dense, other, tmp_path)
    told = " ".join(message.text for message in part("addon.messages").history)
    assert ('adjustments want the mask "Half"' in told) != has


def test_a_copy_that_was_remeshed_is_a_new_mesh_too(dense, export, tmp_path):
    select(dense)
    bpy.ops.object.duplicate()
    copy = bpy.context.active_object
    modifier = copy.modifiers.new("Decimate", "DECIMATE")
    modifier.ratio = 0.4
    with pytest.raises(RuntimeError, match=r'has the modifier "Decimate".*Apply it'):
        swap(dense, copy, tmp_path)
    select(copy)
    bpy.ops.object.modifier_apply(modifier="Decimate")
    assert swap(dense, copy, tmp_path, use_original=True) == {"FINISHED"}
    assert not dense.hide_get() and not dense.hide_render
    states = {state.name: state for state in export()[0].objects}
    assert states[copy.name].part is None and states["dense"].asset != states[copy.name].asset


def test_splats_without_a_mesh_are_bound(scene, export, tmp_path):
    model = part("drgs_blender.core.asset.model")
    asset = asset_of(*sphere(24, 36))
    container.write_asset(tmp_path / "cloud.drgs", model.Asset(asset.surfels, model.Mesh.empty(), None))
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "cloud.drgs"))
    cloud = bpy.context.active_object
    cloud.location.x = 2
    bpy.context.view_layer.update()
    other = retopology()
    other.location.x = 2
    bpy.context.view_layer.update()
    assert swap(cloud, other, tmp_path) == {"FINISHED"}
    made = container.read_asset(tmp_path / "swapped.drgs")
    np.testing.assert_allclose(made.surfels.centre, asset.surfels.centre, atol=1e-5)
    assert made.binding is not None and export()[1] == []


def test_undo_brings_the_old_object_back(dense, export, tmp_path):
    other = retopology()
    bpy.ops.ed.undo_push(message="before")
    swap(dense, other, tmp_path)
    bpy.ops.ed.undo_push(message="Swap Mesh")
    bpy.ops.ed.undo()
    assert [state.name for state in export()[0].objects] == ["dense"]
    assert not bpy.data.objects["retopo"].drgs.is_drgs and "albedo" not in bpy.data.meshes["retopo"].attributes
    bpy.ops.ed.redo()
    assert [state.name for state in export()[0].objects] == ["retopo"]


def test_what_cannot_be_swapped_is_named(dense, tmp_path):
    select(dense)
    with pytest.raises(RuntimeError, match="is not one new mesh"):
        bpy.ops.drgs.swap_mesh(filepath=str(tmp_path / "a.drgs"))
    other = retopology()
    other.location.x = 9
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError, match=r'"retopo".*do not overlap'):
        swap(dense, other, tmp_path)
    other.location.x, other.scale = 0, (-1, 1, 1)
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError, match='"retopo": is mirrored by its scale'):
        swap(dense, other, tmp_path)
    bpy.data.objects.remove(other)
    with pytest.raises(RuntimeError, match="is inside out"):
        swap(dense, retopology(flip=True), tmp_path)
    bare = bpy.data.objects.new("bare", bpy.data.meshes.new("bare"))
    bpy.context.scene.collection.objects.link(bare)
    with pytest.raises(RuntimeError, match='"bare": has no faces'):
        swap(dense, bare, tmp_path)
    assert not (tmp_path / "swapped.drgs").exists() and dense.drgs.is_drgs


def test_an_object_that_was_edited_meanwhile_stays(dense, tmp_path):
    from types import SimpleNamespace

    other = retopology()
    target = tmp_path / "other.drgs"
    container.write_asset(target, asset_of(*sphere()))  # of faces that it had before
    said = []
    operator = SimpleNamespace(_object=dense.name, _other=other.name, _target=target, warn=said.append)
    part("operators.swap_mesh").DRGS_OT_swap_mesh.done(operator, bpy.context)
    assert not other.drgs.is_drgs and "was edited meanwhile" in said[0]
