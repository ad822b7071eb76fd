"""Shapes that were mended and sculpted by hand are saved as assets, with surfels on new faces."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import part, select, sphere
from test_parts import delete, edit, high

pytestmark = pytest.mark.blender_api

container = part("drgs_blender.core.asset.container")


def fill_rim():
    """Fill the hole of the mesh that is edited."""
    bpy.context.tool_settings.mesh_select_mode = False, True, False
    bpy.ops.mesh.select_non_manifold(extend=False)
    bpy.ops.mesh.edge_face_add()


def test_a_hole_is_filled_and_has_surfels(ball, export, tmp_path, ball_file):
    delete(ball, high(ball, 0.6))
    edit(ball, fill_rim)
    state, warnings = export()[0].objects[0], export()[1]
    assert warnings == ['"ball": 1 faces are not in its asset and are not rendered']
    left = len(state.part.face)
    path = tmp_path / "mended.drgs"
    assert bpy.ops.drgs.save_shape(filepath=str(path)) == {"FINISHED"}
    made = container.read_asset(path)
    new = made.binding.face >= left
    heights = made.surfels.centre[new][:, 2]
    assert new.sum() >= 8 and np.ptp(heights) < 0.1 and 0.3 < heights.mean() < 0.7
    after, warnings = export()
    assert warnings == [] and after.objects[0].part is None and after.objects[0].asset == str(path)
    assert after.objects[0].albedo is None  # new vertices have the materials of the asset
    assert ball.name in bpy.data.objects and len(container.read_asset(ball_file).mesh.vertices) == 86


def test_a_sculpted_shape_is_the_new_rest(ball, export, tmp_path):
    """Surfels have followed; what is painted and the rig of the object stay."""
    group = ball.vertex_groups.new(name="All")
    group.add(range(86), 0.5, "REPLACE")
    bpy.ops.drgs.set_material(preset="GOLD")
    for vertex in ball.data.vertices:
        vertex.co.x *= 1.5
    before = export()[0].objects[0]
    path = tmp_path / "wide.drgs"
    assert bpy.ops.drgs.save_shape(filepath=str(path)) == {"FINISHED"}
    made = container.read_asset(path)
    np.testing.assert_allclose(made.mesh.vertices, sphere()[0] * [1.5, 1, 1], atol=1e-6)
    assert np.abs(made.surfels.centre[:, 0]).max() > 1.3
    after = export()[0].objects[0]
    np.testing.assert_array_equal(after.vertices, before.vertices)
    np.testing.assert_array_equal(after.metallic, before.metallic)
    assert abs(ball.data.vertices[3].groups[0].weight - 0.5) < 1e-6


def test_quads_of_the_asset_stay_its_faces(ball, export, tmp_path):
    edit(ball, lambda: (bpy.ops.mesh.select_all(action="SELECT"), bpy.ops.mesh.tris_convert_to_quads()))
    assert len(ball.data.polygons) < 168
    assert bpy.ops.drgs.save_shape(filepath=str(tmp_path / "quads.drgs")) == {"FINISHED"}
    made = container.read_asset(tmp_path / "quads.drgs")
    assert len(made.mesh.faces) == len(made.surfels) == 168
    assert export()[1] == [] and export()[0].objects[0].part is None


def test_what_cannot_be_saved_is_named(ball, tmp_path, ball_file):
    with pytest.raises(RuntimeError, match=r"ball\.drgs, which would be lost"):
        bpy.ops.drgs.save_shape(filepath=str(ball_file))
    ball.data.vertices[5].co.z = np.nan
    with pytest.raises(RuntimeError, match="1 vertices are not finite"):
        bpy.ops.drgs.save_shape(filepath=str(tmp_path / "nan.drgs"))
    assert not (tmp_path / "nan.drgs").exists()
    ball.data.vertices[5].co.z = 0
    delete(ball, np.ones(86, bool), "ONLY_FACE")
    with pytest.raises(RuntimeError, match="has no face of its asset left"):
        bpy.ops.drgs.save_shape(filepath=str(tmp_path / "none.drgs"))
    select(ball)
    ball.data.attributes.remove(ball.data.attributes["drgs_vertex"])
    ball.data.vertices.add(1)
    with pytest.raises(RuntimeError, match="its mesh has 87 vertices, the asset 86"):
        bpy.ops.drgs.save_shape(filepath=str(tmp_path / "unknown.drgs"))


def open_edges(path):
    """How many edges of a saved mesh have not two faces."""
    edges = np.sort(container.read_asset(path).mesh.faces[:, (0, 1, 1, 2, 2, 0)].reshape(-1, 2), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] != 2).sum())


def loops_around(faces, hole):
    """Edges around some faces."""
    edges = np.sort(faces[sorted(hole)][:, (0, 1, 1, 2, 2, 0)].reshape(-1, 2), axis=1)
    found, count = np.unique(edges, axis=0, return_counts=True)
    return found[count == 1]


def hole_beside_a_face_of_its_rim(faces):
    """Faces whose rim has 8 corners at most, three of which are those of another face, and a vertex inside."""
    rng = np.random.default_rng(0)
    neighbours = [np.flatnonzero(np.isin(faces, face).sum(axis=1) == 2) for face in faces]
    while True:
        hole = {int(rng.integers(len(faces)))}
        for _ in range(int(rng.integers(5, 12))):
            hole.add(int(rng.choice(neighbours[int(rng.choice(sorted(hole)))])))
        edges = loops_around(faces, hole)
        rim = np.unique(edges)
        inside = np.setdiff1d(faces[sorted(hole)], rim)
        beside = np.setdiff1d(np.flatnonzero(np.isin(faces, rim).all(axis=1)), sorted(hole))
        if len(rim) <= 8 and len(edges) == len(rim) and len(inside) and len(beside):
            return hole


def test_a_polygon_with_corners_of_a_face_beside_it_is_new(ball, export, tmp_path):
    import bmesh

    hole = hole_beside_a_face_of_its_rim(sphere()[1])
    mesh = bmesh.new()
    mesh.from_mesh(ball.data)
    mesh.faces.ensure_lookup_table()
    bmesh.ops.delete(mesh, geom=[mesh.faces[i] for i in hole], context="FACES")
    bmesh.ops.contextual_create(mesh, geom=[edge for edge in mesh.edges if edge.is_boundary])
    mesh.to_mesh(ball.data)
    mesh.free()
    (state,), warnings = export()[0].objects, export()[1]
    assert warnings == ['"ball": 1 faces are not in its asset and are not rendered']
    assert np.bincount(state.part.face).max() == 1
    select(ball)
    assert bpy.ops.drgs.save_shape(filepath=str(tmp_path / "filled.drgs")) == {"FINISHED"}
    assert open_edges(tmp_path / "filled.drgs") == 0


def test_a_large_polygon_that_is_no_longer_cut_as_the_asset_is_counted_and_closed(ball, export, tmp_path):
    def dissolve():
        import bmesh

        mesh = bmesh.from_edit_mesh(ball.data)
        for face in [f for f in mesh.faces if all(abs(v.co.z) < 0.5 for v in f.verts)][:9]:
            face.select_set(True)
        bmesh.update_edit_mesh(ball.data)
        bpy.ops.mesh.dissolve_faces()

    edit(ball, dissolve)
    assert max(len(polygon.vertices) for polygon in ball.data.polygons) == 9
    assert export()[1] == ['"ball": 1 faces are not in its asset and are not rendered']
    assert bpy.ops.drgs.save_shape(filepath=str(tmp_path / "merged.drgs")) == {"FINISHED"}
    assert open_edges(tmp_path / "merged.drgs") == 0


def test_an_object_in_edit_mode_keeps_its_file(ball, tmp_path, ball_file):
    """The program ends while the artist edits on."""
    from types import SimpleNamespace

    said = []
    operator = SimpleNamespace(_object=ball.name, _target=ball_file, warn=said.append, report=None)
    before = ball.drgs.asset
    select(ball)
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        part("operators.save_shape").DRGS_OT_save_shape.done(operator, bpy.context)
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
    assert ball.drgs.asset == before and "was edited meanwhile" in said[0]
