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
