"""Transfer Rig: a DR-GS object follows the rig of another mesh exactly as that mesh does."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import armature_object, asset_of, mesh_object, part, select, sphere

pytestmark = pytest.mark.blender_api


def world_vertices(obj) -> np.ndarray:
    """Evaluated vertices in world space."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = obj.evaluated_get(depsgraph)
    matrix = np.array(evaluated.matrix_world)
    return part("addon.mesh_arrays").read_vertices(evaluated.data) @ matrix[:3, :3].T + matrix[:3, 3]


def pose(rig) -> None:
    rig.rotation_mode = "XYZ"
    rig.location, rig.rotation_euler = (0.4, -0.2, 0.1), (0.2, 0.1, -0.5)
    for name, angles in (("Low", (0.3, 0.2, 0)), ("High", (0.7, -0.4, 0.5))):
        bone = rig.pose.bones[name]
        bone.rotation_mode, bone.rotation_euler = "XYZ", angles
    bpy.context.view_layer.update()


@pytest.fixture
def rig(scene):
    return armature_object({"Low": ((0, 0, -1), (0, 0, 0)), "High": ((0, 0, 0), (0, 0, 1))})


def skinned(name, rig, vertices, faces):
    """A mesh whose weights change from one bone to the other along Z."""
    obj = mesh_object(name, vertices, faces)
    obj.parent = rig
    obj.modifiers.new("Armature", "ARMATURE").object = rig
    low, high = (obj.vertex_groups.new(name=n) for n in ("Low", "High"))
    for i, z in enumerate(vertices[:, 2]):
        share = float(np.clip((z + 1) / 2, 0, 1))
        for group, weight in ((low, 1 - share), (high, share)):
            if weight > 0:
                group.add([i], weight, "REPLACE")
    return obj


def bind(target, *sources):
    select(*sources, target)
    assert bpy.ops.drgs.bind_to_rig() == {"FINISHED"}


def test_coincident_vertices_follow_exactly(ball, rig, export):
    source = skinned("Source", rig, *sphere())
    bind(ball, source)
    np.testing.assert_allclose(world_vertices(ball), sphere()[0], atol=1e-6)
    pose(rig)
    moved = world_vertices(source)
    assert np.abs(moved - sphere()[0]).max() > 0.3
    np.testing.assert_allclose(world_vertices(ball), moved, atol=2e-6)
    exported = export()[0].objects
    state = exported[0]
    assert state.name == "ball"
    np.testing.assert_allclose(
        state.vertices @ state.matrix_world[:3, :3].T + state.matrix_world[:3, 3], moved, atol=2e-6
    )


def test_several_objects_are_bound_at_once(ball, ball_file, rig):
    bpy.ops.import_scene.drgs(filepath=str(ball_file))
    other = bpy.context.active_object
    source = skinned("Source", rig, *sphere())
    select(other)
    bind(ball, source, other)
    pose(rig)
    for obj in (ball, other):
        np.testing.assert_allclose(world_vertices(obj), world_vertices(source), atol=2e-6)


def test_binding_in_a_pose_and_with_other_transforms_gives_the_same(ball, rig):
    """The rig is posed while binding, the target's object space is turned and scaled, the source's as well."""
    vertices, faces = sphere()
    frame = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.7, 4, "X") @ Matrix.Diagonal((2, 1, 0.5, 1))
    local = np.array(frame.inverted())
    source = skinned("Source", rig, vertices, faces)
    source.data.vertices.foreach_set("co", (vertices @ local[:3, :3].T + local[:3, 3]).ravel())
    source.data.update()
    source.matrix_parent_inverse = frame
    other = Matrix.Translation((-1, 0, 0.5)) @ Matrix.Rotation(-0.4, 4, "Z") @ Matrix.Scale(0.3, 4)
    inverse = np.array(other.inverted())
    ball.data.vertices.foreach_set("co", (vertices @ inverse[:3, :3].T + inverse[:3, 3]).ravel())
    ball.data.update()
    ball.matrix_world = other
    for bone in rig.pose.bones:
        bone.rotation_mode = "XYZ"
    rig.pose.bones["High"].rotation_euler = (1, 0, 0)
    bpy.context.view_layer.update()
    bind(ball, source)
    np.testing.assert_allclose(world_vertices(ball), world_vertices(source), atol=1e-5)
    rig.pose.bones["High"].rotation_euler = (0.2, 0.9, -0.3)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(world_vertices(ball), world_vertices(source), atol=1e-5)


def test_finer_target_follows_the_coarse_source_between_its_vertices(scene, rig, tmp_path):
    """A plane divided finely follows a plane of two triangles: weights are interpolated over the triangle."""
    corners = np.float32([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)])
    source = skinned("Source", rig, corners, np.int32([(0, 1, 2), (0, 2, 3)]))
    x, z = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
    fine = np.stack((x, 0 * x, z), -1).reshape(-1, 3).astype(np.float32)
    i = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate((np.stack((i, i + 1, i + 10), 1), np.stack((i, i + 10, i + 9), 1))).astype(np.int32)
    path = tmp_path / "plane.drgs"
    part("drgs_blender.core.asset.container").write_asset(path, asset_of(fine, faces))
    bpy.ops.import_scene.drgs(filepath=str(path))
    target = bpy.context.active_object
    bind(target, source)
    weights = {g.name: np.zeros(len(fine)) for g in target.vertex_groups}
    for vertex in target.data.vertices:
        for element in vertex.groups:
            weights[target.vertex_groups[element.group].name][vertex.index] = element.weight
    np.testing.assert_allclose(weights["High"], (fine[:, 2] + 1) / 2, atol=1e-6)
    np.testing.assert_allclose(weights["Low"] + weights["High"], 1, atol=1e-6)


def test_parts_parented_to_bones_move_with_their_bone(scene, rig, tmp_path):
    vertices, faces = sphere(6, 8)
    lower, upper = vertices * 0.4 - np.float32((0, 0, 0.6)), vertices * 0.4 + np.float32((0, 0, 0.6))
    sources = []
    for bone, points in (("Low", lower), ("High", upper)):
        obj = mesh_object(bone, points, faces)
        obj.parent, obj.parent_type, obj.parent_bone = rig, "BONE", bone
        bpy.context.view_layer.update()
        obj.matrix_world = Matrix.Identity(4)
        sources.append(obj)
    joined = np.vstack((upper, lower))
    path = tmp_path / "pair.drgs"
    asset = asset_of(joined, np.vstack((faces, faces + len(upper))).astype(np.int32))
    part("drgs_blender.core.asset.container").write_asset(path, asset)
    bpy.ops.import_scene.drgs(filepath=str(path))
    target = bpy.context.active_object
    bind(target, *sources)
    pose(rig)
    expected = np.vstack((world_vertices(sources[1]), world_vertices(sources[0])))
    assert np.abs(expected - joined).max() > 0.3
    np.testing.assert_allclose(world_vertices(target), expected, atol=2e-6)


def test_shape_keys_follow_with_values_drivers_and_action(ball, rig, scene):
    source = skinned("Source", rig, *sphere())
    source.shape_key_add(name="Basis")
    for name, factor in (("Wide", (1.5, 1, 1)), ("Tall", (1, 1, 1.4))):
        key = source.shape_key_add(name=name, from_mix=False)
        key.points.foreach_set("co", (sphere()[0] * np.float32(factor)).ravel())
    keys = source.data.shape_keys
    for number, value in ((1, 0.0), (11, 1.0)):
        keys.key_blocks["Wide"].value = value
        keys.key_blocks["Wide"].keyframe_insert("value", frame=number)
    driver = keys.key_blocks["Tall"].driver_add("value").driver
    driver.type = "SCRIPTED"
    variable = driver.variables.new()
    variable.name, variable.type = "x", "TRANSFORMS"
    variable.targets[0].id, variable.targets[0].transform_type = rig, "LOC_X"
    driver.expression = "x"
    bind(ball, source)
    pose(rig)
    for number in (1, 6, 11):
        scene.frame_set(number)
        np.testing.assert_allclose(world_vertices(ball), world_vertices(source), atol=3e-6)
    assert np.abs(world_vertices(ball) - sphere()[0]).max() > 0.4
    keys.key_blocks["Wide"].slider_max = 2
    bind(ball, source)
    names = [k.name for k in ball.data.shape_keys.key_blocks]
    assert names == ["Basis", "Wide", "Tall"], "binding again adds nothing twice"
    assert ball.data.shape_keys.key_blocks["Wide"].slider_max == 2
    assert [m.type for m in ball.modifiers] == ["ARMATURE"]


def test_what_has_no_place_in_the_world_is_refused_by_name(ball, rig):
    ghost = skinned("Ghost", rig, *sphere())
    nowhere = r": has \d+ vertices that are not finite or too far away\. Correct them"
    for obj in (ball, ghost):
        obj.data.vertices[5].co.y = np.nan
        select(ghost, ball)
        with pytest.raises(RuntimeError, match=f'"{obj.name}"{nowhere}'):
            bpy.ops.drgs.bind_to_rig()
        obj.data.vertices[5].co = sphere()[0][5]
        obj.location.y = np.nan
        bpy.context.view_layer.update()
        with pytest.raises(RuntimeError, match=f'"{obj.name}"'):
            bpy.ops.drgs.bind_to_rig()
        obj.location.y = 0
        bpy.context.view_layer.update()
    ghost.shape_key_add(name="Basis")
    ghost.shape_key_add(name="Wide")
    for obj in (ball, rig):
        obj.scale = (1, 1, 0)
        bpy.context.view_layer.update()
        with pytest.raises(RuntimeError, match=f'"{obj.name}": is scaled to nothing'):
            bpy.ops.drgs.bind_to_rig()
        obj.scale = (1, 1, 1)
        bpy.context.view_layer.update()
    assert not ball.modifiers and ball.parent is None
    bind(ball, ghost)


def test_errors_name_the_object_and_the_remedy(ball, rig):
    select(ball)
    with pytest.raises(RuntimeError, match=r'"ball".*Select the rigged meshes first'):
        bpy.ops.drgs.bind_to_rig()
    plain = mesh_object("Plain", *sphere())
    select(plain, ball)
    with pytest.raises(RuntimeError, match="none of the selected meshes has an armature"):
        bpy.ops.drgs.bind_to_rig()
    far = skinned("Far", rig, sphere()[0] + np.float32((9, 0, 0)), sphere()[1])
    select(far, ball)
    with pytest.raises(RuntimeError, match=r'"ball".*away from the selected meshes'):
        bpy.ops.drgs.bind_to_rig()
    assert not ball.modifiers and ball.parent is None
    second = armature_object({"Low": ((0, 0, -1), (0, 0, 0)), "High": ((0, 0, 0), (0, 0, 1))})
    both = [skinned("A", rig, *sphere()), skinned("B", second, *sphere())]
    select(*both, ball)
    with pytest.raises(RuntimeError, match="several armatures"):
        bpy.ops.drgs.bind_to_rig()
    select(plain)
    assert not bpy.ops.drgs.bind_to_rig.poll()


def test_real_character_follows_its_skeleton(scene, tmp_path):
    """The robot of the examples: bones, rigid parts and facial shape keys, in the middle of its dance."""
    from scenes import ROOT

    bpy.ops.import_scene.gltf(filepath=str(ROOT / "examples" / "robot" / "RobotExpressive.glb"))
    rig = next(o for o in scene.objects if o.type == "ARMATURE")
    # Some parts hang on the bones by way of an empty.
    sources = [o for o in rig.children_recursive if o.type == "MESH"]
    assert len(sources) == 19
    # An asset at the place of the rest pose: all parts in one mesh, triangulated.
    rig.data.pose_position = "REST"
    bpy.context.view_layer.update()
    vertices, faces, start = [], [], 0
    for source in sources:
        places = np.array([source.matrix_world @ v.co for v in source.data.vertices], np.float32)
        source.data.calc_loop_triangles()
        faces += [tuple(start + i for i in t.vertices) for t in source.data.loop_triangles]
        vertices.append(places)
        start += len(places)
    rig.data.pose_position = "POSE"
    path = tmp_path / "robot.drgs"
    asset = asset_of(np.vstack(vertices), np.array(faces, np.int32))
    part("drgs_blender.core.asset.container").write_asset(path, asset)
    bpy.ops.import_scene.drgs(filepath=str(path))
    target = bpy.context.active_object
    bind(target, *sources)
    if rig.animation_data is None:
        rig.animation_data_create()
    for track in rig.animation_data.nla_tracks:
        track.mute = True
    action = next(a for a in bpy.data.actions if a.name.startswith("Dance"))
    rig.animation_data.action = action
    if hasattr(rig.animation_data, "action_slot") and rig.animation_data.action_slot is None:
        rig.animation_data.action_slot = action.slots[0]
    size = np.ptp(np.vstack(vertices), axis=0).max()
    for number in (1, 20):
        scene.frame_set(number)
        expected = np.vstack([world_vertices(s) for s in sources])
        error = np.linalg.norm(world_vertices(target) - expected, axis=1)
        assert error.max() < 1e-6 * size, number
    assert np.abs(expected - np.vstack(vertices)).max() > 0.1 * size
    assert {k.name for s in sources if s.data.shape_keys for k in s.data.shape_keys.key_blocks} <= {
        k.name for k in target.data.shape_keys.key_blocks
    }
