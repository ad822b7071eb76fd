"""Convert to DR-GS: what other importers left in the scene."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from mathutils.bvhtree import BVHTree
from scenes import armature_object, asset_of, mesh_object, part, select, sphere

pytestmark = pytest.mark.blender_api


def columns() -> dict[str, np.ndarray]:
    """Splats on a sphere, as a PLY names them, with harmonics of degree 1."""
    surfels = asset_of(*sphere(12, 20)).surfels
    n = len(surfels.centre)
    rng = np.random.default_rng(1)
    found = {name: surfels.centre[:, i] for i, name in enumerate("xyz")}
    found |= {f"f_dc_{i}": rng.normal(scale=0.5, size=n) for i in range(3)}
    found |= {f"f_rest_{i}": rng.normal(scale=0.1, size=n) for i in range(9)}
    found |= {"opacity": np.full(n, 3.0)} | {f"scale_{i}": np.log(surfels.scale[:, i]) for i in range(2)}
    found |= {"scale_2": np.full(n, np.log(1e-4))} | {f"rot_{i}": surfels.rotation[:, i] for i in range(4)}
    return {name: np.asarray(values, np.float32) for name, values in found.items()}


def cloud(attributes: dict[str, tuple[str, np.ndarray]]) -> bpy.types.Object:
    """A mesh of points with these attributes: name -> (type, values)."""
    given = columns()
    obj = mesh_object("Cloud", np.stack([given[a] for a in "xyz"], axis=1), [])
    for name, (kind, values) in attributes.items():
        prop = {"FLOAT_VECTOR": "vector", "FLOAT_COLOR": "color"}.get(kind, "value")
        data = obj.data.attributes.new(name, kind, "POINT").data
        data.foreach_set(prop, np.ascontiguousarray(values, np.float32).ravel())
    select(obj)
    return obj


def of_ply() -> dict:
    return {name: ("FLOAT", v) for name, v in columns().items() if name not in "xyz"}


def native() -> dict:
    """Blender's own names: linear scale, activated opacity."""
    given = columns()
    stack = lambda *names: np.stack([given[n] for n in names], axis=1)  # noqa: E731
    opacity = 1 / (1 + np.exp(-given["opacity"]))
    found = {
        "scale": ("FLOAT_VECTOR", np.exp(stack("scale_0", "scale_1", "scale_2"))),
        "rotation": ("QUATERNION", stack("rot_0", "rot_1", "rot_2", "rot_3")),
        "radiance:base": ("FLOAT_COLOR", np.column_stack((stack("f_dc_0", "f_dc_1", "f_dc_2"), opacity))),
    }
    for k in range(3):
        found[f"radiance:sh_{k}"] = ("FLOAT_VECTOR", stack(*(f"f_rest_{c * 3 + k}" for c in range(3))))
    return found


def of_addon() -> dict:
    """Those of gaussian-splatting-blender-addon."""
    given = columns()
    stack = lambda *names: np.stack([given[n] for n in names], axis=1)  # noqa: E731
    found = {
        "logscale": ("FLOAT_VECTOR", stack("scale_0", "scale_1", "scale_2")),
        "log_opacity": ("FLOAT", given["opacity"]),
        "quatxyz": ("FLOAT_VECTOR", stack("rot_1", "rot_2", "rot_3")),
        "quatw": ("FLOAT", given["rot_0"]),
        "sh0": ("FLOAT_VECTOR", stack("f_dc_0", "f_dc_1", "f_dc_2")),
    }
    for k in range(3):
        found[f"sh{k + 1}"] = ("FLOAT_VECTOR", stack(*(f"f_rest_{c * 3 + k}" for c in range(3))))
    return found


def test_what_blender_imports_of_a_ply_is_read_as_its_columns(scene, tmp_path):
    """From Blender 5.3 on as its own splats, before as a mesh of points."""
    attributes, wanted = part("addon.splat_attributes"), columns()
    attributes.write_ply(tmp_path / "cloud.ply", wanted)
    bpy.ops.wm.ply_import(filepath=str(tmp_path / "cloud.ply"), forward_axis="Y", up_axis="Z")
    data = bpy.context.active_object.data
    assert getattr(data, "type", "GAUSSIAN_SPLAT") == "GAUSSIAN_SPLAT" and attributes.is_splats(data)
    found = attributes.read_splats(data)
    assert set(found) == set(wanted)
    for name, values in wanted.items():
        np.testing.assert_allclose(found[name], values, atol=2e-3 if name == "opacity" else 2e-5, err_msg=name)


@pytest.mark.parametrize("points", [False, True])
def test_splats_that_are_not_converted_are_named_with_the_remedy(ball, export, points):
    """As vertices, where Blender's own renderers show nothing either, and as points."""
    cloud(native())
    if points:
        if not part("addon.splat_attributes").can_write():
            pytest.skip("this Blender does not convert meshes to point clouds")
        bpy.ops.object.convert(target="POINTCLOUD")
    (warning,) = export()[1]
    assert warning.startswith("1 splat object is not rendered by DR-GS: Cloud") and "Convert > DR-GS" in warning


@pytest.mark.parametrize("kind", [of_ply, native, of_addon])
@pytest.mark.parametrize("points", [False, True])
def test_attributes_are_read_as_the_columns_of_a_ply(scene, kind, points):
    obj = cloud(kind())
    if points:
        if not part("addon.splat_attributes").can_write():
            pytest.skip("this Blender does not convert meshes to point clouds")
        bpy.ops.object.convert(target="POINTCLOUD")
        assert obj.type == "POINTCLOUD"
    attributes = part("addon.splat_attributes")
    assert attributes.is_splats(obj.data)
    found, wanted = attributes.read_splats(obj.data), columns()
    assert set(found) - {"radius"} == set(wanted)
    for name, values in wanted.items():
        np.testing.assert_allclose(found[name], values, atol=2e-3 if name == "opacity" else 2e-5, err_msg=name)


def test_values_are_found_in_attributes_of_every_type(scene):
    """Of types that this Blender lacks, too: the four numbers of Blender 5.3's splats are no colour."""
    layout = part("addon.splat_attributes")._layout
    attributes = mesh_object("Points", [(0, 0, 0)] * 3, []).data.attributes
    kinds = {"FLOAT": 1, "FLOAT2": 2, "FLOAT_VECTOR": 3, "FLOAT_COLOR": 4, "QUATERNION": 4}
    for kind, width in kinds.items():
        attribute = attributes.new(kind, kind, "POINT")
        name, found = layout(attribute)
        assert found == width
        attribute.data.foreach_set(name, np.arange(3 * width, dtype=np.float32))
    with pytest.raises(TypeError, match="Number is INT"):
        layout(attributes.new("Number", "INT", "POINT"))
    element = SimpleNamespace(properties={"vector": SimpleNamespace(type="FLOAT", array_length=4)})
    data = {"data": SimpleNamespace(fixed_type=element)}
    assert layout(SimpleNamespace(name="new", bl_rna=SimpleNamespace(properties=data))) == ("vector", 4)


@pytest.mark.slow
def test_objects_become_splats_of_blenders_own_and_come_back(ball, scene, tmp_path):
    """The numbers that a PLY of the same scene has, in the world; converted again, the same splats."""
    attributes = part("addon.splat_attributes")
    if not attributes.can_write():
        assert not bpy.ops.drgs.splats.poll()
        pytest.skip("this Blender does not convert meshes to point clouds")
    ball.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.5, 4, "X") @ Matrix.Scale(2, 4)
    bpy.context.view_layer.update()
    chosen = {"colour": "albedo", "use_selection": True}
    assert bpy.ops.drgs.export(filepath=str(tmp_path / "a.ply"), format="3DGS PLY", **chosen) == {"FINISHED"}
    assert bpy.ops.drgs.splats(**chosen) == {"FINISHED"}
    made = bpy.context.active_object
    assert made.type == "POINTCLOUD" and attributes.is_splats(made.data) and made.select_get() and not ball.select_get()
    assert getattr(made.data, "type", "GAUSSIAN_SPLAT") == "GAUSSIAN_SPLAT"
    found, wanted = attributes.read_splats(made.data), attributes.read_ply(tmp_path / "a.ply")
    assert set(found) == set(wanted) - {"nx", "ny", "nz"}
    for name, values in found.items():
        np.testing.assert_allclose(values, wanted[name], atol=1e-4, err_msg=name)
    assert bpy.ops.drgs.convert(use_mesh=False, out=str(tmp_path / "back.drgs")) == {"FINISHED"}
    back = part("addon.assets").load(tmp_path / "back.drgs").surfels
    np.testing.assert_allclose(back.centre, np.stack([wanted[a] for a in "xyz"], axis=1), atol=1e-5)


def test_clouds_keep_the_order_of_harmonics(scene):
    """What is written of columns is read as the same columns, red apart from green."""
    attributes = part("addon.splat_attributes")
    if not attributes.can_write():
        pytest.skip("this Blender does not convert meshes to point clouds")
    found = attributes.read_splats(attributes.new_object(bpy.context, "Cloud", columns()).data)
    assert "Cloud" not in bpy.data.meshes
    assert set(found) == set(columns())
    for name, values in columns().items():
        np.testing.assert_allclose(found[name], values, atol=2e-3 if name == "opacity" else 2e-5, err_msg=name)


def test_splats_become_an_object_at_their_place(scene, tmp_path):
    obj = cloud(of_ply())
    obj.matrix_world = Matrix.Translation((4, 5, 6)) @ Matrix.Rotation(1, 4, "Y") @ Matrix.Scale(3, 4)
    assert bpy.ops.drgs.convert(use_mesh=False) == {"FINISHED"}
    made = bpy.context.active_object
    assert made.drgs.is_drgs and made.name.startswith("Cloud") and obj.hide_render
    np.testing.assert_allclose(np.array(made.matrix_world), np.array(obj.matrix_world), atol=1e-6)
    asset = part("addon.assets").load(tmp_path / "Cloud.drgs")
    np.testing.assert_allclose(asset.surfels.centre, np.stack([columns()[a] for a in "xyz"], axis=1), atol=1e-6)
    np.testing.assert_allclose(asset.surfels.sh[:, 1, 0], columns()["f_rest_0"], atol=1e-6)


def test_a_textured_mesh_becomes_an_object_at_its_place(scene, tmp_path):
    obj = mesh_object("Ball", *sphere(16, 24))
    obj.location = (1, 2, 3)
    image = bpy.data.images.new("Red", 4, 4)
    image.pixels.foreach_set(np.tile(np.float32((0.5, 0, 0, 1)), 16))
    image.pack()
    material = bpy.data.materials.new("Paint")
    if material.node_tree is None:
        material.use_nodes = True
    nodes = material.node_tree.nodes
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = image
    surface = next(n for n in nodes if n.type == "BSDF_PRINCIPLED")
    surface.inputs["Roughness"].default_value = 0.25
    material.node_tree.links.new(texture.outputs["Color"], surface.inputs["Base Color"])
    obj.data.materials.append(material)
    obj.data.uv_layers.new()
    select(obj)
    assert bpy.ops.drgs.convert(out=str(tmp_path / "red.drgs"), use_original=True) == {"FINISHED"}
    made = bpy.context.active_object
    assert made.name == "red" and made.drgs.is_drgs and not obj.hide_render
    points = np.array([made.matrix_world @ v.co for v in made.data.vertices])
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[0, 1, 2], [2, 3, 4]], atol=0.02)
    mesh = part("addon.assets").load(tmp_path / "red.drgs").mesh
    np.testing.assert_allclose(mesh.albedo, np.tile([0.214, 0, 0], (len(mesh.albedo), 1)), atol=0.01)  # sRGB 0.5
    np.testing.assert_allclose(mesh.roughness, 0.25, atol=0.01)


def test_what_cannot_be_converted_is_said(ball, scene, tmp_path):
    select(ball)
    with pytest.raises(RuntimeError, match="is a DR-GS object already"):
        bpy.ops.drgs.convert()
    light = bpy.data.objects.new("Light", bpy.data.lights.new("Light", "POINT"))
    scene.collection.objects.link(light)
    select(light)
    with pytest.raises(RuntimeError, match="neither faces nor the attributes of splats"):
        bpy.ops.drgs.convert()
    broken = of_ply()
    obj = cloud({"opacity": ("FLOAT", broken["opacity"][1]), "scale_0": ("FLOAT", broken["scale_0"][1]),
                 "rot_0": ("FLOAT", broken["rot_0"][1])})  # fmt: skip
    with pytest.raises(RuntimeError, match=r'"Cloud".*could not be made into an asset'):
        bpy.ops.drgs.convert()
    assert not obj.hide_render
    before = (tmp_path / "assets" / "ball.drgs").read_bytes()
    obj.name = "Other"
    with pytest.raises(RuntimeError, match=r'"ball": is made of .*would be lost'):
        bpy.ops.drgs.convert(out=str(tmp_path / "assets" / "ball"))
    assert (tmp_path / "assets" / "ball.drgs").read_bytes() == before


def rigged_arm(scene):
    """A bent arm: a column of two bones with weights, a shape key that swells it, posed and turned."""
    vertices, faces = sphere(16, 24)
    vertices = vertices * np.float32((0.3, 0.3, 1))
    arm = mesh_object("Arm", vertices, faces)
    rig = armature_object({"Lower": ((0, 0, -1), (0, 0, 0)), "Upper": ((0, 0, 0), (0, 0, 1))})
    for name, members in (("Lower", vertices[:, 2] < 0), ("Upper", vertices[:, 2] >= 0)):
        arm.vertex_groups.new(name=name).add(np.flatnonzero(members).tolist(), 1.0, "REPLACE")
    arm.modifiers.new("Armature", "ARMATURE").object = rig
    arm.parent = rig
    arm.shape_key_add(name="Basis")
    key = arm.shape_key_add(name="Fat", from_mix=False)
    key.points.foreach_set("co", (vertices * np.float32((1.5, 1.5, 1))).ravel())
    key.value = 1.0
    rig.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.5, 4, "Y") @ Matrix.Scale(2, 4)
    bone = rig.pose.bones["Upper"]
    bone.rotation_mode, bone.rotation_euler = "XYZ", (1.2, 0, 0)
    bpy.context.view_layer.update()
    return arm, rig, key, bone


def world_points(obj):
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.array([evaluated.matrix_world @ v.co for v in evaluated.data.vertices])


def test_a_rigged_mesh_keeps_its_rig_whatever_its_pose(scene, tmp_path):
    """The asset is of the rest pose, and bends as the original does, in this pose and in others."""
    arm, rig, key, bone = rigged_arm(scene)
    select(arm)
    assert bpy.ops.drgs.convert(out=str(tmp_path / "arm.drgs"), use_original=True) == {"FINISHED"}
    made = bpy.context.active_object
    rest = part("addon.assets").load(tmp_path / "arm.drgs").mesh.vertices
    np.testing.assert_allclose(np.ptp(rest, axis=0), (0.6, 0.6, 2), atol=1e-3)
    assert key.mute is False and rig.data.pose_position == "POSE" and [o.name for o in scene.objects].count("Arm") == 1
    for angle, value in ((1.2, 1.0), (-0.7, 0.3), (0.0, 0.0)):
        bone.rotation_euler[0], key.value = angle, value
        made.data.shape_keys.key_blocks["Fat"].value = value
        bpy.context.view_layer.update()
        tree = BVHTree.FromPolygons(world_points(arm).tolist(), [list(p.vertices) for p in arm.data.polygons])
        away = [tree.find_nearest(point)[3] for point in world_points(made)]
        assert max(away) < 0.01, (angle, value)  # of 4 m
        np.testing.assert_allclose(np.ptp(world_points(made), axis=0), np.ptp(world_points(arm), axis=0), atol=0.01)


def test_a_part_that_a_bone_carries_is_converted_in_any_pose(scene, tmp_path):
    """As importers of glTF make robots. Of several selected meshes the active one is taken; the others are named."""
    arm, _, _, bone = rigged_arm(scene)
    hand = mesh_object("Hand", *sphere(8, 12))
    hand.parent, hand.parent_type, hand.parent_bone = arm.parent, "BONE", "Upper"
    hand.scale = (0.2, 0.3, 0.4)
    bpy.context.view_layer.update()
    select(hand)
    arm.select_set(True)
    assert bpy.ops.drgs.convert(out=str(tmp_path / "hand.drgs"), use_original=True) == {"FINISHED"}
    assert any('"Hand", is converted, not Arm' in m.text for m in part("addon.messages").history)
    made = bpy.context.active_object
    for angle in (1.2, -0.7):
        bone.rotation_euler[0] = angle
        bpy.context.view_layer.update()
        wanted, found = world_points(hand), world_points(made)
        np.testing.assert_allclose(found.mean(axis=0), wanted.mean(axis=0), atol=0.02)
        np.testing.assert_allclose(np.ptp(found, axis=0), np.ptp(wanted, axis=0), atol=0.02)


def test_a_moving_mesh_goes_on_moving(scene, tmp_path):
    """Its action, its parent and its constraints are those of the object that is made of it."""
    obj = mesh_object("Ball", *sphere(8, 12))
    parent = bpy.data.objects.new("Parent", None)
    scene.collection.objects.link(parent)
    parent.location = (0, 0, 5)
    obj.parent = parent
    for frame, x in ((1, 0.0), (11, 4.0)):
        obj.location.x = x
        obj.keyframe_insert("location", frame=frame)
    obj.constraints.new("COPY_ROTATION").target = parent
    scene.frame_set(3)
    select(obj)
    assert bpy.ops.drgs.convert(out=str(tmp_path / "ball.drgs"), use_original=True) == {"FINISHED"}
    made = bpy.context.active_object
    assert [c.type for c in made.constraints] == ["COPY_ROTATION"]
    parent.rotation_euler = (0.3, 0.2, 0.1)
    for frame in (3, 7, 11):
        scene.frame_set(frame)
        np.testing.assert_allclose(np.array(made.matrix_world), np.array(obj.matrix_world), atol=1e-5)


def test_an_error_leaves_when_the_operator_succeeds(scene, tmp_path):
    messages = part("addon.messages")
    obj = mesh_object("Ball", *sphere(8, 12))
    select(obj)
    with pytest.raises(RuntimeError, match="cannot be read"):
        bpy.ops.drgs.import_parts(mesh=str(tmp_path / "none.glb"))
    assert [m.level for m in messages.history].count("ERROR") == 1
    assert bpy.ops.drgs.convert(out=str(tmp_path / "ball.drgs")) == {"FINISHED"}
    assert [m.level for m in messages.history].count("ERROR") == 1  # of another operator
    path = tmp_path / "ball.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n")
    assert bpy.ops.drgs.import_parts(mesh=str(path)) == {"FINISHED"}
    assert "ERROR" not in [m.level for m in messages.history]


def test_an_error_of_another_object_stays(scene, tmp_path):
    messages = part("addon.messages")
    empty = bpy.data.objects.new("Empty", bpy.data.meshes.new("Empty"))
    scene.collection.objects.link(empty)
    select(empty)
    with pytest.raises(RuntimeError, match=r'"Empty".*neither faces'):
        bpy.ops.drgs.convert(out=str(tmp_path / "empty.drgs"))
    select(mesh_object("Ball", *sphere(8, 12)))
    assert bpy.ops.drgs.convert(out=str(tmp_path / "ball.drgs")) == {"FINISHED"}
    assert [m.level for m in messages.history].count("ERROR") == 1


def test_slots_that_nodes_leave_out_are_no_error(scene, tmp_path):
    obj = mesh_object("Ball", *sphere(8, 12))
    for name in ("One", "Two"):
        obj.data.materials.append(bpy.data.materials.new(name))
    tree = bpy.data.node_groups.new("Cube", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    cube, out = tree.nodes.new("GeometryNodeMeshCube"), tree.nodes.new("NodeGroupOutput")
    tree.links.new(cube.outputs["Mesh"], out.inputs[0])
    obj.modifiers.new("Nodes", "NODES").node_group = tree
    select(obj)
    meshes = len(bpy.data.meshes)
    assert bpy.ops.drgs.convert(out=str(tmp_path / "cube.drgs"), use_original=True) == {"FINISHED"}
    assert len(bpy.data.meshes) == meshes + 1  # that of the new object


def test_what_a_rigged_mesh_does_beside_its_rig_is_told(scene, tmp_path):
    arm, _, _, _ = rigged_arm(scene)
    arm.keyframe_insert("location", frame=1)
    select(arm)
    assert bpy.ops.drgs.convert(out=str(tmp_path / "arm.drgs")) == {"FINISHED"}
    made, messages = bpy.context.active_object, part("addon.messages")
    moves = made.animation_data is not None and made.animation_data.action is arm.animation_data.action
    assert moves or any("is not taken over" in m.text or "are not taken over" in m.text for m in messages.history)
