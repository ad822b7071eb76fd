"""Point clouds: spheres as in Cycles, with the attributes of their points; splats are none."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from parity import light, pictures, psnr, set_up
from scenes import mesh_object
from test_materials import material

pytestmark = pytest.mark.blender_api

PLACES = np.random.default_rng(4).uniform(-1, 1, (40, 3))


def cloud(places=PLACES, radius: float = 0.2, looks=None) -> bpy.types.Object:
    """A mesh of vertices of which Geometry Nodes make points, as large as an attribute says, the last half as large."""
    obj = mesh_object("Cloud", places.tolist(), [])
    radii = np.full(len(places), radius, np.float32)
    radii[-1:] /= 2
    for name, kind, key, values in (
        ("size", "FLOAT", "value", radii),
        ("tint", "FLOAT_COLOR", "color", np.c_[np.abs(places), np.ones(len(places))].astype(np.float32).ravel()),
    ):
        obj.data.attributes.new(name, kind, "POINT").data.foreach_set(key, values)
    tree = bpy.data.node_groups.new("Points", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    points, size, look = (
        tree.nodes.new(f"GeometryNode{n}") for n in ("MeshToPoints", "InputNamedAttribute", "SetMaterial")
    )
    size.data_type, size.inputs["Name"].default_value = "FLOAT", "size"
    tree.links.new(start.outputs[0], points.inputs["Mesh"])
    tree.links.new(size.outputs[0], points.inputs["Radius"])
    tree.links.new(points.outputs[0], look.inputs["Geometry"])
    tree.links.new(look.outputs[0], end.inputs[0])
    look.inputs["Material"].default_value = looks
    obj.modifiers.new("Points", "NODES").node_group = tree
    return obj


def test_points_are_spheres_of_their_radius(scene, export):
    cloud()
    frame, warnings = export()
    (mesh,) = [m for m in frame.meshes if len(m.faces)]
    assert not warnings
    each = mesh.vertices.reshape(len(PLACES), -1, 3)
    np.testing.assert_allclose(each.mean(axis=1), PLACES, atol=1e-5)
    reach = np.linalg.norm(each - PLACES[:, None], axis=2)
    np.testing.assert_allclose(reach[:-1], 0.2, rtol=0.02)
    np.testing.assert_allclose(reach[-1], 0.1, rtol=0.02)


def test_bad_points_are_left_out_and_counted(scene, export):
    places = PLACES.copy()
    places[3] = np.nan
    cloud(places, radius=0.3)
    frame, warnings = export()
    assert all(np.isfinite(m.vertices).all() for m in frame.meshes)
    assert [w for w in warnings if "1 of its 40 points" in w and "not finite" in w]


def test_points_that_are_splats_are_told(scene, export):
    obj = cloud()
    for name in ("opacity", "scale_0", "rot_0"):
        obj.data.attributes.new(name, "FLOAT", "POINT")
    frame, warnings = export()
    assert not [m for m in frame.meshes if len(m.faces)]
    assert [w for w in warnings if "splat" in w and "Convert" in w]


@pytest.mark.judged
@pytest.mark.slow
def test_point_clouds_look_as_in_cycles(scene):
    """Coloured by an attribute of their points, on a floor, under a world."""
    tree, shader = material("Look")
    tint = tree.nodes.new("ShaderNodeAttribute")
    tint.attribute_name = "tint"
    tree.links.new(tint.outputs["Color"], shader.inputs["Base Color"])
    cloud(PLACES * (0.8, 0.5, 0.6), 0.12, bpy.data.materials["Look"])
    mesh_object("Floor", [(-3, -3, -0.8), (3, -3, -0.8), (3, 3, -0.8), (-3, 3, -0.8)], [(0, 1, 2, 3)])
    light(scene)
    set_up(scene, 64, samples=128, bounces=1)
    ours, theirs = pictures(scene, "DRGS"), pictures(scene, "CYCLES")
    assert psnr(ours, theirs) > 36
