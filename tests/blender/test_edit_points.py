"""What happens to surfels that are edited as points between Edit Surfels and Finish, whatever an artist does there."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np
import pytest
from scenes import part, select, sphere

pytestmark = pytest.mark.blender_api

surfel_points = part("addon.surfel_points")
ASSET = sphere()
HEIGHT = ASSET[0][ASSET[1]].mean(axis=1)[:, 2]  # of the surfel in the middle of each face


def points_of(obj):
    return next(o for o in bpy.data.objects if o.drgs.points_of == obj)


def delete_points(chosen):
    """Delete the points of the object in Edit Mode that are the `chosen` surfels, (n,) bool, as by hand."""
    obj = bpy.context.edit_object
    mesh = bmesh.from_edit_mesh(obj.data)
    layer = mesh.verts.layers.int["drgs_surfel"]
    for vertex in mesh.verts:
        vertex.select = bool(chosen[vertex[layer]])
    bmesh.update_edit_mesh(obj.data)
    bpy.ops.mesh.delete(type="VERT")


def tab(to="OBJECT"):
    bpy.ops.object.mode_set(mode=to)


def begin(obj, chosen):
    """Edit Surfels, delete some, and leave by Tab without Finish."""
    select(obj)
    bpy.ops.drgs.edit_surfels()
    delete_points(chosen)
    tab()
    return points_of(obj)


def removed(export, name="ball"):
    """Surfels that an object lacks in the frame."""
    (state,) = [s for s in export()[0].objects if s.name == name]
    return [] if state.part is None or state.part.removed is None else state.part.removed.tolist()


def rows(chosen):
    return np.flatnonzero(chosen).tolist()


def said():
    return [message.text for message in part("addon.messages").history]


def test_tab_out_and_in_goes_on(ball, export):
    """Pictures follow what is deleted; Finish takes the faces of all of it, not of the last round alone."""
    high, low = HEIGHT > 0.6, HEIGHT < -0.6
    points = begin(ball, high)
    assert removed(export) == rows(high)
    select(points)
    tab("EDIT")
    assert removed(export) == rows(high)
    delete_points(low)
    assert removed(export) == rows(high | low)  # before Tab
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    (state,) = export()[0].objects
    assert state.part.removed.tolist() == rows(high | low)
    assert sorted(state.part.face) == rows(~(high | low))
    assert set(bpy.context.scene.objects) == {bpy.context.scene.camera, ball}


def test_edit_surfels_again_keeps_the_faces_of_the_first_round(ball, export):
    begin(ball, HEIGHT > 0.6)
    select(ball)
    bpy.ops.drgs.edit_surfels()
    bpy.ops.drgs.finish_surfels()
    assert sorted(export()[0].objects[0].part.face) == rows(HEIGHT <= 0.6)


def test_finish_works_with_the_object_active_and_renamed_points(ball, export):
    points = begin(ball, HEIGHT > 0.6)
    points.name = points.data.name = "my leftovers"
    other = bpy.data.objects.new("Other", None)
    bpy.context.scene.collection.objects.link(other)
    select(other)
    assert not bpy.ops.drgs.finish_surfels.poll()  # whose would it be
    select(ball)
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert sorted(export()[0].objects[0].part.face) == rows(HEIGHT <= 0.6)
    assert "my leftovers" not in bpy.data.objects and bpy.context.active_object == ball


def test_what_was_deleted_outlives_the_points(ball, export):
    bpy.data.objects.remove(begin(ball, HEIGHT > 0.6))
    assert removed(export) == rows(HEIGHT > 0.6)
    select(ball)
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert sorted(export()[0].objects[0].part.face) == rows(HEIGHT <= 0.6)
    assert not surfel_points.is_unfinished(ball)


@pytest.mark.parametrize("mode", ["OBJECT", "EDIT"])
def test_a_file_saved_in_the_middle_goes_on(ball, export, tmp_path, mode):
    select(begin(ball, HEIGHT > 0.6))
    tab(mode)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "middle.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "middle.blend"))
    assert removed(export) == rows(HEIGHT > 0.6)
    tab("EDIT")
    delete_points(HEIGHT < -0.6)
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert sorted(export()[0].objects[0].part.face) == rows(np.abs(HEIGHT) <= 0.6)


def test_undo_goes_back_over_the_operators(ball, export):
    """Step by step to before Edit Surfels, and forth to Finish."""
    select(ball)
    bpy.ops.ed.undo_push(message="begin")
    bpy.ops.drgs.edit_surfels()
    bpy.ops.ed.undo_push(message="Edit Surfels")
    delete_points(HEIGHT > 0.6)
    bpy.ops.ed.undo_push(message="Delete")
    bpy.ops.drgs.finish_surfels()
    bpy.ops.ed.undo_push(message="Finish")
    steps = [[], [], rows(HEIGHT > 0.6), rows(HEIGHT > 0.6)]
    for expected in steps[-2::-1]:
        bpy.ops.ed.undo()
        assert removed(export) == expected
    assert [o.name for o in bpy.context.scene.objects if o.drgs.points_of] == [] and bpy.context.mode == "OBJECT"
    for expected in steps[1:]:
        bpy.ops.ed.redo()
        assert removed(export) == expected
    assert sorted(export()[0].objects[0].part.face) == rows(HEIGHT <= 0.6)
    assert [o.name for o in bpy.context.scene.objects if o.drgs.points_of] == []


def test_of_duplicated_points_the_active_ones_count_and_others_are_named(ball, export):
    points = begin(ball, HEIGHT > 0.6)
    select(points)
    bpy.ops.object.duplicate()
    copy = bpy.context.active_object
    assert copy != points and removed(export) == rows(HEIGHT > 0.6)
    tab("EDIT")
    delete_points(HEIGHT < -0.6)
    tab()
    assert removed(export) == rows(HEIGHT > 0.6)  # those of the first ones, until Finish
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert removed(export) == rows(np.abs(HEIGHT) > 0.6)
    assert f'"{points.name}"' in said()[-1] and "are left" in said()[-1]
    select(points)  # the artist was wrong: what the first ones are is there still
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert removed(export) == rows(HEIGHT > 0.6)


def test_separated_points_are_gone_and_back_when_they_are_joined(ball, export):
    begin(ball, np.zeros(len(HEIGHT), bool))
    points = points_of(ball)
    select(points)
    tab("EDIT")
    mesh = bmesh.from_edit_mesh(points.data)
    for vertex in mesh.verts:
        vertex.select = vertex.co.z > 0.6
    bmesh.update_edit_mesh(points.data)
    bpy.ops.mesh.separate(type="SELECTED")
    tab()
    assert removed(export) == rows(HEIGHT > 0.6)
    (apart,) = [o for o in bpy.data.objects if o.drgs.points_of == ball and o != points]
    select(apart, points)
    bpy.ops.object.join()
    assert removed(export) == []
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert ball.drgs.surfel_points is None


def test_points_of_another_object_that_were_joined_bring_nothing_back(ball, ball_file, export):
    bpy.ops.import_scene.drgs(filepath=str(ball_file))
    twin = bpy.context.active_object
    whole = begin(twin, HEIGHT < -0.6)
    points = begin(ball, HEIGHT > 0.6)
    select(whole, points)
    bpy.ops.object.join()
    assert removed(export) == rows(HEIGHT > 0.6) and removed(export, twin.name) == rows(HEIGHT < -0.6)
    tab("EDIT")
    assert bpy.ops.drgs.select_surfels(criterion="SIZE", size=0.0) == {"FINISHED"}
    tab()
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert removed(export) == rows(HEIGHT > 0.6)
    assert '"ball": ' in said()[-1] and "none of its surfels" in said()[-1]
    select(twin)
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert removed(export, twin.name) == rows(HEIGHT < -0.6)


def test_points_that_were_added_are_none_of_the_surfels(ball, export):
    points = begin(ball, HEIGHT > 0.6)
    select(points)
    tab("EDIT")
    bpy.ops.mesh.primitive_cube_add()
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert removed(export) == rows(HEIGHT > 0.6)
    assert "8 of the points are none of its surfels" in said()[-1]


def test_a_copy_made_meanwhile_keeps_what_it_was(ball, export):
    """Shift-D of the object alone shares its points: what is deleted in them is not deleted of the copy."""
    begin(ball, HEIGHT > 0.8)
    select(ball)
    bpy.ops.drgs.finish_surfels(use_faces=False)
    points = begin(ball, HEIGHT > 0.6)
    select(ball)
    bpy.ops.object.duplicate()
    copy = bpy.context.active_object
    assert removed(export) == rows(HEIGHT > 0.6) and removed(export, copy.name) == rows(HEIGHT > 0.8)
    assert not surfel_points.is_unfinished(copy)
    select(points)
    bpy.ops.drgs.finish_surfels(use_faces=False)
    assert removed(export) == rows(HEIGHT > 0.6) and removed(export, copy.name) == rows(HEIGHT > 0.8)


def test_a_copy_with_its_points_is_edited_apart(ball, export):
    points = begin(ball, HEIGHT > 0.6)
    select(points, ball)
    bpy.ops.object.duplicate()
    copy = bpy.context.active_object
    second = points_of(copy)
    select(second)
    tab("EDIT")
    delete_points(HEIGHT < -0.6)
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert removed(export, copy.name) == rows(np.abs(HEIGHT) > 0.6) and removed(export) == rows(HEIGHT > 0.6)
    assert points_of(ball) == points


@pytest.mark.parametrize("command", ["crop", "save_asset", "save_shape"])
def test_what_would_cross_the_editing_is_refused(ball, tmp_path, command):
    points = begin(ball, HEIGHT > 0.6)
    bpy.ops.object.empty_add(type="CUBE")
    select(bpy.context.active_object, ball)
    given = {} if command == "crop" else {"filepath": str(tmp_path / "a.drgs")}
    if command == "save_asset":
        given["use_saved"] = True
    with pytest.raises(RuntimeError, match='"ball": has surfels that are still edited as points'):
        getattr(bpy.ops.drgs, command)(**given)
    assert points.drgs.points_of == ball and not (tmp_path / "a.drgs").exists()


def test_restore_ends_the_editing(ball, export):
    begin(ball, HEIGHT > 0.6)
    select(ball)
    assert bpy.ops.drgs.restore_surfels() == {"FINISHED"}
    assert removed(export) == [] and not [o for o in bpy.data.objects if o.drgs.points_of]


def test_several_objects_are_edited_and_finished_at_once(ball, ball_file, export):
    bpy.ops.import_scene.drgs(filepath=str(ball_file))
    twin = bpy.context.active_object
    nothing = np.zeros(len(HEIGHT), bool)
    select(begin(ball, nothing), begin(twin, nothing))
    tab("EDIT")
    for obj in bpy.context.objects_in_mode:
        mesh = bmesh.from_edit_mesh(obj.data)
        for vertex in mesh.verts:
            vertex.select = vertex.co.z > 0.6
        bmesh.update_edit_mesh(obj.data)
    bpy.ops.mesh.delete(type="VERT")
    assert bpy.ops.drgs.finish_surfels() == {"FINISHED"}
    assert removed(export) == removed(export, twin.name) == rows(HEIGHT > 0.6)
