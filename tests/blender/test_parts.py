"""Meshes that are cut, copied and mended by hand: what is rendered and saved of their asset."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import asset_of, mesh_object, part, read_exr, select, sphere
from test_render import light

pytestmark = pytest.mark.blender_api

errors, model = part("drgs_blender.core.errors"), part("drgs_blender.core.asset.part")
container = part("drgs_blender.core.asset.container")


def edit(obj, change):
    """Edit Mode with nothing selected, then `change`, then Object Mode."""
    select(obj)
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        bpy.ops.mesh.select_all(action="DESELECT")
        change()
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def choose(obj, vertices):
    """Select vertices while their mesh is edited, as a click does."""
    import bmesh

    mesh = bmesh.from_edit_mesh(obj.data)
    bpy.context.tool_settings.mesh_select_mode = True, False, False
    mesh.verts.ensure_lookup_table()
    for vertex in mesh.verts:
        vertex.select_set(bool(vertices[vertex.index]))
    mesh.select_flush(True)
    bmesh.update_edit_mesh(obj.data)


def high(obj, above=0.1):
    z = np.empty(3 * len(obj.data.vertices), np.float32)
    obj.data.vertices.foreach_get("co", z)
    return z[2::3] > above


def delete(obj, chosen, kind="VERT"):
    edit(obj, lambda: (choose(obj, chosen), bpy.ops.mesh.delete(type=kind)))


def test_deleted_vertices_are_gone_with_their_faces(ball, export):
    vertices, faces = sphere()
    gone = high(ball)
    delete(ball, gone)
    state, warnings = export()[0].objects[0], export()[1]
    assert warnings == [] and len(state.vertices) == (~gone).sum()
    np.testing.assert_array_equal(state.part.vertices, np.flatnonzero(~gone))
    left = np.flatnonzero((~gone)[faces].all(axis=1))
    assert sorted(state.part.face) == left.tolist()
    np.testing.assert_array_equal(state.part.vertices[state.part.faces], faces[state.part.face])
    np.testing.assert_array_equal(state.vertices, vertices[~gone])
    assert state.albedo is None  # what is left has the asset's own values


def test_deleted_faces_are_gone_while_their_vertices_stay(ball, export):
    chosen = high(ball, 0.6)
    delete(ball, chosen, "ONLY_FACE")
    (state,), warnings = export()[0].objects, export()[1]
    assert warnings == [] and len(state.vertices) == len(sphere()[0])
    assert sorted(state.part.face) == np.flatnonzero(~chosen[sphere()[1]].all(axis=1)).tolist()


def test_the_picture_lacks_what_was_deleted(ball, scene):
    """Of a ball cut in half, the upper half of the picture is empty and the lower one as it was."""
    light(scene)
    scene.render.film_transparent = True
    bpy.ops.render.render(write_still=True)
    before = read_exr(scene.render.filepath, 64, 48)
    delete(ball, high(ball, 0.05))
    bpy.ops.render.render(write_still=True)
    after = read_exr(scene.render.filepath, 64, 48)
    assert before[:18, :, 3].sum() > 20 and after[:18, :, 3].sum() < 0.1 * before[:18, :, 3].sum()
    lower = slice(35, 48)  # surfels at the rim, half a metre wide, reach beyond it
    assert before[lower, :, 3].sum() > 20
    assert np.abs(after[lower] - before[lower]).mean() < 0.003


def test_undo_brings_everything_back(ball, export):
    bpy.ops.ed.undo_push(message="before")
    name = ball.name
    delete(ball, high(ball))
    bpy.ops.ed.undo_push(message="deleted")
    assert export()[0].objects[0].part is not None
    bpy.ops.ed.undo()
    assert name in bpy.data.objects and export()[0].objects[0].part is None


def test_separated_halves_are_the_whole(ball, export):
    """Every face is in one of the two objects, once; both have the asset's materials."""
    edit(ball, lambda: (choose(ball, high(ball)), bpy.ops.mesh.separate(type="SELECTED")))
    states = export()[0].objects
    assert len(states) == 2 and all(state.part is not None and state.albedo is None for state in states)
    faces = np.concatenate([state.part.face for state in states])
    assert sorted(faces) == list(range(len(sphere()[1])))
    select(*(bpy.data.objects[state.name] for state in states))
    bpy.ops.object.join()
    (state,), warnings = export()[0].objects, export()[1]
    assert warnings == [] and sorted(state.part.face) == list(range(len(sphere()[1])))


def test_a_copy_in_edit_mode_is_moved_alone(ball, export):
    def double():
        choose(ball, high(ball))
        bpy.ops.mesh.duplicate()
        bpy.ops.transform.translate(value=(0, 0, 2))

    edit(ball, double)
    (state,), warnings = export()[0].objects, export()[1]
    faces = sphere()[1]
    copied = high(ball)[: len(sphere()[0])][faces].all(axis=1)
    assert warnings == [] and len(state.part.face) == len(faces) + copied.sum()
    heights = state.vertices[state.part.faces][..., 2].mean(axis=1)
    twice = np.bincount(state.part.face, minlength=len(faces)) == 2
    np.testing.assert_array_equal(twice, copied)
    of_copies = np.flatnonzero(np.isin(state.part.face, np.flatnonzero(copied)))
    assert (heights[of_copies] > 1.5).sum() == copied.sum()


def test_sorted_and_merged_elements_are_the_same_object(ball, export):
    edit(ball, lambda: (bpy.ops.mesh.select_all(action="SELECT"), bpy.ops.mesh.sort_elements(
        type="RANDOMIZE", elements={"VERT", "FACE"}, seed=3)))  # fmt: skip
    (state,), warnings = export()[0].objects, export()[1]
    vertices, faces = sphere()
    assert warnings == [] and sorted(state.part.face) == list(range(len(faces)))
    np.testing.assert_allclose(state.vertices, vertices[state.part.vertices])


def test_new_faces_are_counted_and_not_rendered(ball, export):
    """A subdivided region: its new vertices are blends of others, and are nobody's; polygons next to it stay faces."""
    chosen = high(ball, 0.6)
    edit(ball, lambda: (choose(ball, chosen), bpy.ops.mesh.subdivide(number_cuts=2)))
    (state,), warnings = export()[0].objects, export()[1]
    faces = sphere()[1]
    untouched = np.flatnonzero(~chosen[faces].all(axis=1))
    assert sorted(state.part.face) == untouched.tolist()
    assert len(warnings) == 1 and "faces are not in its asset and are not rendered" in warnings[0]


def test_masked_vertices_are_left_out_and_come_back(ball, export):
    """A Mask modifier: live, with an adjustment limited by another group."""
    group = ball.vertex_groups.new(name="Shown")
    group.add(np.flatnonzero(~high(ball)).tolist(), 1.0, "REPLACE")
    tinted = ball.vertex_groups.new(name="Tinted")
    tinted.add([0, 5], 0.5, "REPLACE")
    ball.drgs.adjustment.use, ball.drgs.adjustment.tint, ball.drgs.adjustment.mask = True, (1, 0, 0), "Tinted"
    modifier = ball.modifiers.new("Mask", "MASK")
    modifier.vertex_group = "Shown"
    (state,), warnings = export()[0].objects, export()[1]
    assert warnings == [] and len(state.vertices) == (~high(ball)).sum()
    weights = np.zeros(len(sphere()[0]), np.float32)
    weights[[0, 5]] = 0.5
    np.testing.assert_array_equal(state.adjustment.mask, weights[state.part.vertices])
    modifier.show_viewport = modifier.show_render = False
    assert export()[0].objects[0].part is None


@pytest.mark.parametrize(("kind", "copies", "foreign"), [("ARRAY", 2, 0), ("EDGE_SPLIT", 1, 0), ("SOLIDIFY", 1, 1)])
def test_modifiers_that_copy_or_split(ball, export, kind, copies, foreign):
    """An array has the surfels of each copy; the inner side of a shell has none, and is counted."""
    modifier = ball.modifiers.new("Some", kind)
    if kind == "EDGE_SPLIT":
        modifier.split_angle = 0
    (state,), warnings = export()[0].objects, export()[1]
    m = len(sphere()[1])
    np.testing.assert_array_equal(np.bincount(state.part.face, minlength=m), copies)
    assert len(warnings) == foreign
    if foreign:
        assert f"{m} faces are not in its asset" in warnings[0]
        radius = np.linalg.norm(state.vertices[state.part.faces], axis=2)
        assert radius.min() > 0.999


def test_a_boolean_leaves_whole_faces_and_tells_of_cut_ones(ball, export):
    """The box takes a corner away: faces outside of it stay with their surfels, those that it cuts have none."""
    corners = [(x, y, z) for x in (0.3, 2) for y in (-2, 2) for z in (-2, 2)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    cutter = mesh_object("Cutter", corners, sides)
    cutter.hide_render = True
    modifier = ball.modifiers.new("Boolean", "BOOLEAN")
    modifier.object, modifier.operation = cutter, "DIFFERENCE"
    (state,), warnings = export()[0].objects, export()[1]
    vertices, faces = sphere()
    outside = np.flatnonzero((vertices[faces][..., 0] < 0.3).all(axis=1))
    assert 0 < len(outside) < len(faces) and sorted(state.part.face) == outside.tolist()
    assert len(warnings) == 1 and "faces are not in its asset and are not rendered" in warnings[0]


def test_a_cut_object_is_saved_and_is_whole_again(ball, export, tmp_path, ball_file):
    gone = high(ball)
    delete(ball, gone)
    bpy.ops.drgs.set_material(preset="GOLD")
    state = export()[0].objects[0]
    path = tmp_path / "half.drgs"
    assert bpy.ops.drgs.save_asset(filepath=str(path), use_saved=True) == {"FINISHED"}
    saved, before = container.read_asset(path), container.read_asset(ball_file)
    assert len(saved.mesh.vertices) == (~gone).sum() and len(saved.surfels) == len(state.part.face)
    expected = model.part_of(before, state.part)
    np.testing.assert_array_equal(saved.surfels.centre, expected.surfels.centre)
    after = export()[0].objects[0]
    assert after.part is None and after.asset == str(path) and after.albedo is None
    bpy.ops.import_scene.drgs(filepath=str(path))
    assert export()[1] == []


def test_vertices_of_another_asset_are_not_taken_for_its_own(ball, export, tmp_path):
    """Two captures with the same faces are joined: only the active one's are rendered, and the others are counted."""
    vertices, faces = sphere()
    container.write_asset(tmp_path / "wide.drgs", asset_of(vertices * np.float32([2, 1, 1]), faces))
    bpy.ops.import_scene.drgs(filepath=str(tmp_path / "wide.drgs"))
    wide = bpy.context.active_object
    select(wide, ball)
    bpy.ops.object.join()
    (state,), warnings = export()[0].objects, export()[1]
    assert sorted(state.part.face) == list(range(len(faces)))
    assert warnings == [f'"ball": {len(faces)} faces are not in its asset and are not rendered']
    np.testing.assert_array_equal(state.vertices, vertices[state.part.vertices])


def test_materials_are_set_restored_and_painted_on_what_is_left(ball, export):
    delete(ball, high(ball))
    bpy.ops.drgs.set_material(preset="GOLD")
    assert export()[0].objects[0].metallic.min() == 1
    assert bpy.ops.drgs.restore_material() == {"FINISHED"}
    state = export()[0].objects[0]
    assert state.albedo is None and state.metallic is None


@pytest.mark.parametrize("kind", ["MIRROR", "REMESH", "DECIMATE"])
def test_modifiers_that_make_all_faces_anew_are_refused_with_the_way_out(ball, export, kind):
    ball.modifiers.new("Culprit", kind)
    with pytest.raises(errors.AssetError, match=r'"ball".*"Culprit" changes.*disable it for renders'):
        export()


def test_nothing_left_is_named(ball, export):
    """All faces replaced by others: an error; all deleted: the object is left out, and a warning says so."""
    delete(ball, np.ones(len(ball.data.vertices), bool), "ONLY_FACE")
    frame, warnings = export()
    assert frame.objects == [] and warnings == ['"ball": none of the faces of its asset is left; it is left out']


def test_a_file_of_before_knows_its_vertices_by_their_number(ball, export):
    ball.data.attributes.remove(ball.data.attributes["drgs_vertex"])
    assert export()[0].objects[0].part is None
    delete(ball, high(ball, 0.6), "ONLY_FACE")
    assert export()[0].objects[0].part is not None
    delete(ball, high(ball, 0.6))
    with pytest.raises(errors.AssetError, match=r"its mesh has .* vertices, the asset 86"):
        export()


def test_motion_vectors_are_of_what_is_left(ball, scene, export):
    delete(ball, high(ball))
    ball.location = 0, 0, 0
    ball.keyframe_insert("location", frame=1)
    ball.location = 1, 0, 0
    ball.keyframe_insert("location", frame=3)
    scene.view_layers[0].use_pass_vector = True
    scene.frame_set(2)
    frame, warnings = export()
    assert warnings == []
    pose = frame.previous.objects[0] if frame.previous is not None else None
    if pose is not None:
        assert pose.vertices is None and not np.array_equal(pose.matrices[0], frame.objects[0].matrix_world)


@pytest.mark.parametrize("way", ["deleted", "masked", "built later"])
def test_no_vertex_left_leaves_the_object_out(ball, scene, export, way, tmp_path):
    """Such as the first frames of a Build modifier: a warning, and everything else is rendered."""
    if way == "deleted":
        delete(ball, np.ones(86, bool))
    elif way == "masked":
        ball.modifiers.new("Mask", "MASK").vertex_group = ball.vertex_groups.new(name="None").name
    else:
        ball.modifiers.new("Build", "BUILD").frame_start = 10
    frame, warnings = export()
    assert frame.objects == [] and warnings == ['"ball": none of the faces of its asset is left; it is left out']
    select(ball)
    with pytest.raises(RuntimeError, match="has nothing left of its asset"):
        bpy.ops.drgs.save_asset(filepath=str(tmp_path / "nothing.drgs"))


def test_new_faces_alone_are_left_out(ball, export):
    """A hole is filled, and the filling separated."""
    delete(ball, high(ball, 0.6))

    def fill():
        bpy.context.tool_settings.mesh_select_mode = False, True, False
        bpy.ops.mesh.select_non_manifold(extend=False)
        bpy.ops.mesh.edge_face_add()
        bpy.ops.mesh.separate(type="SELECTED")

    edit(ball, fill)
    frame, warnings = export()
    assert [state.name for state in frame.objects] == ["ball"]
    assert '"ball.001": none of the faces of its asset is left; it is left out' in warnings


def test_pieces_without_surfels_are_left_out(ball, scene, export):
    """Faces that no surfel hangs on, because all are removed: where surfels are seen, the rest is rendered."""
    light(scene)
    select(ball)
    bpy.ops.drgs.edit_surfels()
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.drgs.finish_surfels(use_faces=False)
    assert export()[1] == ['"ball": none of the surfels of its asset is left; it is left out']
    assert bpy.ops.render.render() == {"FINISHED"}


def test_a_cut_object_that_moves_is_matched_once(ball, export, monkeypatch):
    check = part("addon.export.topology_check")
    calls, match = [], check.match_faces
    monkeypatch.setattr(check, "match_faces", lambda *given: calls.append(1) or match(*given))
    delete(ball, high(ball))
    first = export()[0].objects[0]
    ball.data.vertices[0].co.x += 1
    ball.data.update()
    second = export()[0].objects[0]
    assert len(calls) == 1 and second.part is first.part and second.vertices[0, 0] == first.vertices[0, 0] + 1
    delete(ball, high(ball, -0.5))
    assert len(export()[0].objects[0].part.face) < len(first.part.face) and len(calls) == 2


@pytest.mark.parametrize("count", [86, 49])
def test_a_cut_object_plays_caches_of_what_is_left(ball, export, tmp_path, count):
    import struct

    delete(ball, high(ball))
    path = tmp_path / "cache.pc2"
    head = struct.pack("<12s2i2fi", b"POINTCACHE2\0", 1, count, 1, 1.0, 1)
    path.write_bytes(head + np.full((count, 3), 2, "<f4").tobytes())
    if count == 49:
        assert bpy.ops.drgs.play_point_cache(filepath=str(path)) == {"FINISHED"}
        (state,), warnings = export()[0].objects, export()[1]
        assert warnings == [] and (state.vertices == 2).all()
        delete(ball, high(ball, -0.5))
        assert 'is not moved by modifier "Point Cache"' in export()[1][0]
        return
    with pytest.raises(RuntimeError, match=r"has 49 vertices left of 86; cache\.pc2 has 86"):
        bpy.ops.drgs.play_point_cache(filepath=str(path))


def test_finish_of_an_object_that_is_gone_is_refused(ball):
    bpy.ops.drgs.edit_surfels()
    points = bpy.context.active_object
    for collection in ball.users_collection:
        collection.objects.unlink(ball)
    with pytest.raises(RuntimeError, match="is in no collection of this view layer"):
        bpy.ops.drgs.finish_surfels()
    assert points.name in bpy.data.objects
    bpy.ops.object.mode_set(mode="OBJECT")


def test_viewports_show_what_is_deleted_at_once(ball, export):
    select(ball)
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        choose(ball, high(ball))
        bpy.ops.mesh.delete(type="VERT")
        assert len(export()[0].objects[0].part.face) == 84
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
