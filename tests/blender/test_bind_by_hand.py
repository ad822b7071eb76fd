"""Armature, lattice and cage: what an artist without a rigged model binds to."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import armature_object, asset_of, mesh_object, part, select, sphere, write_ball

pytestmark = pytest.mark.blender_api


def world_vertices(obj) -> np.ndarray:
    """Evaluated vertices in world space."""
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    matrix = np.array(evaluated.matrix_world)
    return part("addon.mesh_arrays").read_vertices(evaluated.data) @ matrix[:3, :3].T + matrix[:3, 3]


def moved(vertices: np.ndarray, *by: float) -> np.ndarray:
    return vertices + np.array(by)


@pytest.fixture
def pair(scene, tmp_path):
    """Two spheres side by side, the second turned and scaled."""
    names = [write_ball(tmp_path / f"{n}.drgs").name for n in ("one", "two")]
    bpy.ops.import_scene.drgs(directory=str(tmp_path), files=[{"name": n} for n in names])
    one, two = bpy.data.objects["one"], bpy.data.objects["two"]
    two.matrix_world = Matrix.Translation((3, 0, 0)) @ Matrix.Rotation(0.5, 4, "X") @ Matrix.Scale(0.8, 4)
    bpy.context.view_layer.update()
    return one, two


def rig_of(*bones):
    return armature_object({f"Bone{i}": b for i, b in enumerate(bones)})


def test_automatic_weights_move_several_objects_and_leave_nothing_behind(pair):
    before = [world_vertices(o) for o in pair]
    rig = rig_of(((-1, 0, 0), (1, 0, 0)), ((2, 0, 0), (4, 0, 0)))
    rig.location = (0, 0, 0)
    select(*pair, rig)
    assert bpy.ops.drgs.bind_to_armature() == {"FINISHED"}
    for obj, rest in zip(pair, before):
        assert [m.type for m in obj.modifiers] == ["ARMATURE"] and obj.parent == rig
        np.testing.assert_allclose(world_vertices(obj), rest, atol=1e-5)
    rig.pose.bones["Bone0"].location = rig.pose.bones["Bone1"].location = (0, 1, 0)  # along the bone: +X
    bpy.context.view_layer.update()
    for obj, rest in zip(pair, before):
        np.testing.assert_allclose(world_vertices(obj), moved(rest, 1, 0, 0), atol=1e-4)


def test_torn_parts_that_heat_does_not_reach_follow_the_nearest_bone(scene, tmp_path):
    """Every triangle stands alone: heat has no surface to spread over."""
    vertices, faces = sphere()
    loose = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3)
    path = tmp_path / "torn.drgs"
    part("drgs_blender.core.asset.container").write_asset(path, asset_of(*loose))
    bpy.ops.import_scene.drgs(filepath=str(path))
    torn = bpy.context.active_object
    rest = world_vertices(torn)
    rig = rig_of(((0, 0, -1), (0, 0, 0)), ((0, 0, 0), (0, 0, 1)))
    select(torn, rig)
    assert bpy.ops.drgs.bind_to_armature() == {"FINISHED"}
    totals = [sum(g.weight for g in v.groups) for v in torn.data.vertices]
    assert min(totals) > 0.1
    rig.location = (0, 2, 0)
    for bone in rig.pose.bones:
        bone.location = (0, 0.5, 0)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(world_vertices(torn), moved(rest, 0, 2, 0.5), atol=1e-4)


def test_distance_weights_are_a_partition_and_prefer_the_nearest_bone():
    nearby = part("operators.bind_armature").nearby
    rng = np.random.default_rng(3)
    points, segments = rng.normal(size=(50, 3)), rng.normal(size=(6, 2, 3))
    weights = nearby(points, segments, np.arange(50) + 7)
    np.testing.assert_allclose(weights.totals(57)[7:], 1)
    heaviest = weights.group.reshape(50, 4)[np.arange(50), weights.weight.reshape(50, 4).argmax(1)]
    t = np.linspace(0, 1, 2001)[:, None, None]
    along = segments[:, 0] + t * (segments[:, 1] - segments[:, 0])
    distance = np.linalg.norm(points[:, None, None] - along[None], axis=-1).min(1)
    assert (heaviest == distance.argmin(1)).mean() > 0.95


def test_a_lattice_around_all_bends_all(pair):
    before = [world_vertices(o) for o in pair]
    select(*pair)
    assert bpy.ops.drgs.bind_to_lattice(points=(2, 2, 2)) == {"FINISHED"}
    lattice = bpy.context.active_object
    assert lattice.type == "LATTICE" and bpy.context.selected_objects == [lattice]
    for obj, rest in zip(pair, before):
        np.testing.assert_allclose(world_vertices(obj), rest, atol=1e-5)
    for point in lattice.data.points:
        point.co_deform.z += 0.25
    bpy.context.view_layer.update()
    for obj, rest in zip(pair, before):
        np.testing.assert_allclose(world_vertices(obj), moved(rest, 0, 0, 0.25 * lattice.scale.z), atol=1e-4)
    # The same lattice once more: nothing is added twice.
    select(*pair, lattice)
    assert bpy.ops.drgs.bind_to_lattice() == {"FINISHED"}
    assert [len(o.modifiers) for o in pair] == [1, 1] and len(bpy.data.lattices) == 1


def test_a_new_cage_carries_the_objects(pair):
    before = [world_vertices(o) for o in pair]
    select(*pair)
    assert bpy.ops.drgs.bind_to_cage(faces=200) == {"FINISHED"}
    cage = bpy.context.active_object
    assert cage.hide_render and cage.display_type == "WIRE" and 60 < len(cage.data.polygons) < 300
    for obj, rest in zip(pair, before):
        np.testing.assert_allclose(world_vertices(obj), rest, atol=1e-4)
    cage.data.transform(Matrix.Translation((0, 0, 0.7)))
    bpy.context.view_layer.update()
    for obj, rest in zip(pair, before):
        np.testing.assert_allclose(world_vertices(obj), moved(rest, 0, 0, 0.7), atol=1e-3)


def test_a_mesh_that_cannot_carry_is_refused_and_nothing_changes(pair):
    for faces in ([], [(0, 1, 2)]):
        cage = mesh_object("Fin", [(0, 0, 0), (0, 0, 1), (0, 0, 2)], faces)
        select(cage, *pair)
        with pytest.raises(RuntimeError, match='"Fin"'):
            bpy.ops.drgs.bind_to_cage()
        assert not any(o.modifiers for o in pair) and not cage.hide_render
        bpy.data.objects.remove(cage)


@pytest.mark.parametrize("flat", ["object", "cage"])
def test_what_is_scaled_to_nothing_is_refused_by_name_and_nothing_changes(ball, flat):
    cage = rough_cage(2.5)
    obj = ball if flat == "object" else cage
    obj.scale.z = 0
    bpy.context.view_layer.update()
    select(cage, ball)
    with pytest.raises(RuntimeError, match=rf'"{obj.name}": is scaled to nothing\. Give it a size'):
        bpy.ops.drgs.bind_to_cage()
    assert not ball.modifiers and not cage.hide_render


@pytest.mark.parametrize("operator", ["bind_to_lattice", "bind_to_cage"])
def test_vertices_that_are_nowhere_are_told(ball, operator):
    ball.data.vertices[3].co.x = np.nan
    ball.data.vertices[4].co.x = 1e38
    with pytest.raises(RuntimeError, match=r'"ball": has 2 vertices that are not finite or too far away'):
        getattr(bpy.ops.drgs, operator)()
    assert not ball.modifiers and set(bpy.data.objects) == {bpy.context.scene.camera, ball}


def rough_cage(size: float) -> bpy.types.Object:
    """What Surface Deform refuses: a prism over an L, whose caps are concave, with a fin at one of its edges."""
    shape = [(-1, -1), (1, -1), (1, 0), (0, 0), (0, 1), (-1, 1)]
    corners = [(size * x, size * y, size * z) for z in (-1, 1) for x, y in shape] + [(2 * size, 0, 0)]
    sides = [(i, (i + 1) % 6, 6 + (i + 1) % 6, 6 + i) for i in range(6)]
    return mesh_object("Rough", corners, [tuple(range(5, -1, -1)), tuple(range(6, 12)), *sides, (1, 7, 12)])


def test_what_surface_deform_refuses_carries_by_nodes(pair):
    """Exactly along with a cage that is moved, turned and scaled; where it bends, near vertices go with their faces."""
    before = [world_vertices(o) for o in pair]
    cage = rough_cage(2.5)
    cage.matrix_world = Matrix.Translation((1, 0, 0)) @ Matrix.Rotation(0.3, 4, "Z")
    bpy.context.view_layer.update()
    select(cage, *pair)
    assert bpy.ops.drgs.bind_to_cage() == {"FINISHED"}
    assert cage.hide_render and [m.type for o in pair for m in o.modifiers] == ["NODES", "NODES"]
    assert part("addon.workflow").poser_of(pair[0]) == cage
    for obj, rest in zip(pair, before):
        np.testing.assert_allclose(world_vertices(obj), rest, atol=1e-5)
    turn = Matrix.Translation((0, 2, 1)) @ Matrix.Rotation(1.0, 4, (1, 2, 3)) @ Matrix.Scale(1.5, 4)
    cage.data.transform(turn)
    bpy.context.view_layer.update()
    whole = np.array(cage.matrix_world @ turn @ cage.matrix_world.inverted())
    for obj, rest in zip(pair, before):
        np.testing.assert_allclose(world_vertices(obj), rest @ whole[:3, :3].T + whole[:3, 3], atol=2e-5)
    cage.data.transform(turn.inverted())
    for vertex in cage.data.vertices:
        vertex.co.z *= 1 + 0.5 * (vertex.co.z > 0)
    bpy.context.view_layer.update()
    for obj, rest in zip(pair, before):
        lifted = world_vertices(obj)[:, 2] - rest[:, 2]
        assert lifted[rest[:, 2] > 0.5].min() > 0.1 and lifted.max() < 1.3
        assert lifted[rest[:, 2].argmax()] > lifted[rest[:, 2].argmin()] + 0.2


def test_nodes_of_a_cage_have_a_mesh_for_each_object(ball):
    twin = ball.copy()
    bpy.context.scene.collection.objects.link(twin)
    cage = rough_cage(2.5)
    select(cage, ball)
    with pytest.raises(RuntimeError, match=r'"ball".*shares its mesh.*Single User'):
        bpy.ops.drgs.bind_to_cage()
    assert not ball.modifiers and not cage.hide_render
    bpy.data.objects.remove(twin)
    for _ in range(2):
        select(cage, ball)
        assert bpy.ops.drgs.bind_to_cage() == {"FINISHED"}
    assert len(ball.modifiers) == 1 and sum(tree.is_modifier for tree in bpy.data.node_groups) == 1


@pytest.fixture
def linked(ball, tmp_path):
    """The ball, linked from a library into an empty scene."""
    saved = str(tmp_path / "library.blend")
    bpy.ops.wm.save_as_mainfile(filepath=saved, copy=True)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(saved, link=True) as (_, target):
        target.objects = ["ball"]
    bpy.context.scene.collection.objects.link(target.objects[0])
    return target.objects[0]


def test_objects_of_a_library_are_refused_by_name(linked):
    select(linked)
    for operator in (bpy.ops.drgs.bind_to_lattice, bpy.ops.drgs.bind_to_cage):
        with pytest.raises(RuntimeError, match=r'"ball".*library'):
            operator()
    assert not bpy.data.lattices


def test_an_overridden_object_is_bent_and_its_linked_mesh_not_weighted(linked):
    own = linked.override_create(remap_local_usages=True)
    select(own)
    assert bpy.ops.drgs.bind_to_lattice() == {"FINISHED"}
    assert [m.name for m in own.modifiers] == ["DR-GS Lattice"]
    rig = rig_of(((0, 0, -1), (0, 0, 1)))
    select(own, rig)
    with pytest.raises(RuntimeError, match=r'"ball".*library'):
        bpy.ops.drgs.bind_to_armature()
    assert not any(m.type == "ARMATURE" for m in own.modifiers)


def test_what_surface_deform_refuses_is_taken_out_of_a_new_cage(ball):
    """A concave polygon, three faces at one edge, and a sliver."""
    corners = [(-2, -2, -2), (2, -2, -2), (0, -1, -2), (0, 2, -2), (0, 0, 2), (2, 2, 1), (0, 1e-7, -2), (0, 2, 2)]
    faces = [(0, 2, 1, 3), (0, 1, 4), (1, 3, 4), (1, 3, 5), (3, 2, 6), (3, 0, 4), (3, 7, 5)]
    cage = mesh_object("Rough", corners, faces)
    select(cage, ball)
    assert bpy.ops.drgs.bind_to_cage() == {"FINISHED"} and ball.modifiers[0].type == "NODES"
    part("operators.bind_cage").clean(cage.data, 1e-4)
    select(cage, ball)
    assert bpy.ops.drgs.bind_to_cage() == {"FINISHED"} and ball.modifiers[0].type == "SURFACE_DEFORM"
    assert {len(p.vertices) for p in cage.data.polygons} == {3} and len(cage.data.polygons) >= 6
