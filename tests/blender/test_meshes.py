"""Ordinary meshes as the engine gets them: shapes, instances, normals, UV maps, material slots."""

from __future__ import annotations

import sys

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import mesh_object, part, sphere

pytestmark = pytest.mark.blender_api

CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def cube(name: str = "Cube") -> bpy.types.Object:
    return mesh_object(name, CUBE, QUADS)


def areas(state) -> np.ndarray:
    corners = state.vertices[state.faces].astype(np.float64)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def test_mesh_is_described_in_object_space(scene, export):
    obj = cube()
    obj.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Diagonal((1, -2, 0.5, 1))
    obj.pass_index = 3
    frame, warnings = export()
    (state,) = frame.meshes
    assert not warnings and frame.objects == [] and state.name == "Cube"
    np.testing.assert_array_equal(state.vertices, CUBE)
    assert state.faces.shape == (12, 3) and state.faces.dtype == np.int32
    np.testing.assert_allclose(areas(state).sum(0), 0, atol=1e-6)
    outwards = np.einsum("ij,ij->i", areas(state), state.vertices[state.faces].mean(1))
    np.testing.assert_allclose(outwards, 2, rtol=1e-6)
    np.testing.assert_allclose(state.matrices, np.array(obj.matrix_world)[None])
    assert state.pass_indices.tolist() == [3]
    assert state.uvs is None and state.material_index is None
    assert [m.name for m in state.materials] == ["Default"]
    assert state.visibility == part("drgs_blender.core.frame").Visibility()


def test_arrays_can_be_kept_by_the_client(scene, export):
    """Frozen arrays of their own are compared by identity and never copied."""
    frozen = part("drgs_blender.core.arrays").frozen
    for faces in (QUADS, [q[:3] for q in QUADS]):  # triangulated, and triangles already
        obj = mesh_object("Shape", CUBE, faces)
        obj.data.uv_layers.new()
        obj.data.materials.append(textured("Checker"))
        (state,) = export()[0].meshes
        for name in ("vertices", "faces", "matrices", "pass_indices", "corner_normals", "uvs"):
            assert frozen(getattr(state, name)), name
        obj.data.shade_smooth()
        (state,) = export()[0].meshes
        assert state.vertex_normals is None or frozen(state.vertex_normals)
        bpy.data.objects.remove(obj)


def textured(name: str, uv_map: str | None = None) -> bpy.types.Material:
    """A material with a generated image as its colour."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = bpy.data.images.new(name, 4, 4)
    tree.links.new(texture.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    if uv_map is not None:
        node = tree.nodes.new("ShaderNodeUVMap")
        node.uv_map = uv_map
        tree.links.new(node.outputs["UV"], texture.inputs["Vector"])
    return material


@pytest.mark.skipif(sys.platform != "linux", reason="no such memory")
def test_large_arrays_reach_the_engine_without_a_copy(scene, export):
    """All of a mesh, of quads and smooth: Blender is not asked for normals of corners, which it would keep."""
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=600, y_subdivisions=600)
    mesh = bpy.context.active_object.data
    mesh.shade_smooth()
    mesh.color_attributes.new("Paint", "FLOAT_COLOR", "POINT").data[0].color = (1, 0, 0, 1)
    for name in "AB":
        mesh.materials.append(material := bpy.data.materials.new(name))
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        paint = nodes.new("ShaderNodeVertexColor")
        paint.layer_name = "Paint"
        links.new(paint.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
        image = nodes.new("ShaderNodeTexImage")
        image.image = bpy.data.images.new(name, 2, 2)
        links.new(image.outputs["Color"], nodes["Principled BSDF"].inputs["Roughness"])
    mesh.polygons.foreach_set("material_index", np.arange(len(mesh.polygons), dtype=np.int32) % 2)
    frame, warnings = export()
    (state,) = frame.meshes
    assert not warnings
    assert state.corner_normals is None
    arrays = part("drgs_blender.core.arrays")
    large = {"layer": state.layers[0].values}
    for name in ("vertices", "faces", "vertex_normals", "uvs", "material_index"):
        large[name] = getattr(state, name)
    assert {name for name, array in large.items() if arrays.shared_file(array) is None} == set()


def test_linked_duplicates_are_one_shape(scene, export):
    first = cube()
    for x in (3, 6):
        copy = first.copy()
        copy.location.x, copy.pass_index = x, x
        scene.collection.objects.link(copy)
    (state,) = export()[0].meshes
    assert sorted(state.matrices[:, 0, 3]) == [0, 3, 6]
    assert state.pass_indices.tolist() == state.matrices[:, 0, 3].tolist()


def test_duplicates_that_look_different_are_several_shapes(scene, export):
    first = cube()
    first.data.materials.append(bpy.data.materials.new("Red"))
    painted, hidden, bent = (first.copy() for _ in range(3))
    for copy in (painted, hidden, bent):
        scene.collection.objects.link(copy)
    painted.material_slots[0].link = "OBJECT"
    painted.material_slots[0].material = bpy.data.materials.new("Blue")
    hidden.visible_camera = False
    bent.modifiers.new("Displace", "DISPLACE").strength = 0.5
    states = export()[0].meshes
    assert len(states) == 4 and sorted(s.materials[0].name for s in states) == ["Blue", "Red", "Red", "Red"]
    assert sum(not s.visibility.camera for s in states) == 1
    assert sum(not np.array_equal(s.vertices, CUBE) for s in states) == 1


def test_collection_instances_share_the_shape_and_the_visibility_of_both(scene, export):
    obj = cube()
    group = bpy.data.collections.new("Group")
    group.objects.link(obj)
    for x in (3, 6):
        empty = bpy.data.objects.new("Instance", None)
        empty.instance_type, empty.instance_collection, empty.location.x = "COLLECTION", group, x
        scene.collection.objects.link(empty)
    (state,) = export()[0].meshes
    assert sorted(state.matrices[:, 0, 3]) == [0, 3, 6]
    empty.visible_glossy = False
    states = sorted(export()[0].meshes, key=lambda s: len(s.matrices))
    assert [len(s.matrices) for s in states] == [1, 2]
    assert [s.visibility.glossy for s in states] == [False, True]
    empty.is_shadow_catcher = True
    states = sorted(export()[0].meshes, key=lambda s: len(s.matrices))
    assert [s.visibility.shadow_catcher for s in states] == [True, False]


def scatter(obj: bpy.types.Object) -> None:
    """Geometry nodes: a cube on each of nine points of a grid."""
    group = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    names = ("GeometryNodeMeshGrid", "GeometryNodeMeshCube", "GeometryNodeInstanceOnPoints", "NodeGroupOutput")
    grid, shape, instances, output = (group.nodes.new(n) for n in names)
    group.links.new(grid.outputs["Mesh"], instances.inputs["Points"])
    group.links.new(shape.outputs["Mesh"], instances.inputs["Instance"])
    group.links.new(instances.outputs[0], output.inputs[0])
    obj.modifiers.new("Scatter", "NODES").node_group = group


def test_instances_of_geometry_nodes_are_one_shape(scene, export):
    obj = mesh_object("Scatter", np.zeros((1, 3)), [])
    obj.location = (10, 0, 0)
    scatter(obj)
    (state,) = export()[0].meshes
    assert state.matrices.shape == (9, 4, 4) and len(state.faces) == 12
    np.testing.assert_allclose(np.sort(np.unique(state.matrices[:, 0, 3].round(5))), (9.5, 10, 10.5))


def test_materials_set_by_geometry_nodes(scene, export):
    obj = mesh_object("Scatter", np.zeros((1, 3)), [])
    scatter(obj)
    group = obj.modifiers[0].node_group
    shape = next(n for n in group.nodes if n.bl_idname == "GeometryNodeMeshCube")
    target = shape.outputs["Mesh"].links[0].to_socket
    node = group.nodes.new("GeometryNodeSetMaterial")
    node.inputs["Material"].default_value = bpy.data.materials.new("Painted")
    group.links.new(shape.outputs["Mesh"], node.inputs[0])
    group.links.new(node.outputs[0], target)
    (state,) = export()[0].meshes
    index = 0 if state.material_index is None else state.material_index[0]
    assert state.materials[index].name == "Painted" and len(state.matrices) == 9


def test_curves_texts_surfaces_and_metaballs_come_as_their_mesh_once(scene, export):
    path = bpy.data.curves.new("Path", "CURVE")
    path.dimensions = "3D"
    path.splines.new("BEZIER").bezier_points.add(1)
    path.splines[0].bezier_points[1].co = (2, 0, 0)
    tube = path.copy()
    tube.name, tube.bevel_depth = "Tube", 0.1
    text = bpy.data.curves.new("Text", "FONT")
    text.body = "o"
    for data in (path, tube, text):
        scene.collection.objects.link(bpy.data.objects.new(data.name, data))
    bpy.ops.surface.primitive_nurbs_surface_sphere_add()
    bpy.ops.object.metaball_add(location=(5, 0, 0))
    bpy.ops.object.metaball_add(location=(6, 0, 0))  # of the same family: one surface
    frame, warnings = export()
    names = sorted(s.name for s in frame.meshes)
    assert names == ["Mball", "SurfSphere", "Text", "Tube"] and not warnings
    assert all(len(s.matrices) == 1 and len(s.faces) > 10 for s in frame.meshes)
    # The same as instances: each once more.
    group = bpy.data.collections.new("Group")
    group.objects.link(bpy.data.objects["Text"])
    empty = bpy.data.objects.new("Instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", group
    scene.collection.objects.link(empty)
    assert sum(len(s.matrices) for s in export()[0].meshes) == 5


def test_nothing_is_exported_twice(ball, scene, export):
    """A DR-GS object next to meshes: every visible surface is in exactly one list."""
    cube("One"), cube("Two")
    hidden = cube("Hidden")
    hidden.hide_viewport = True
    mesh_object("Wire", CUBE, [])
    frame, warnings = export()
    assert [s.name for s in frame.objects] == ["ball"]
    assert sorted(s.name for s in frame.meshes) == ["One", "Two"] and not warnings


def test_smooth_meshes_leave_normals_to_the_engine(scene, export):
    obj = mesh_object("Ball", *sphere())
    flat = export()[0].meshes[0]
    assert flat.corner_normals.shape == (len(flat.faces), 3, 3)
    face = areas(flat) / np.linalg.norm(areas(flat), axis=1, keepdims=True)
    np.testing.assert_allclose(flat.corner_normals, np.repeat(face[:, None], 3, 1), atol=1e-4)
    obj.data.shade_smooth()
    assert export()[0].meshes[0].corner_normals is None
    custom = np.tile(np.float32((0, 0, 1)), (len(obj.data.loops), 1))
    obj.data.normals_split_custom_set(custom.tolist())
    normals = export()[0].meshes[0].corner_normals
    np.testing.assert_allclose(normals.reshape(-1, 3), custom, atol=1e-3)


def test_custom_normals_of_vertices_are_not_taken_for_smooth_ones(scene, export):
    obj = mesh_object("Ball", *sphere())
    obj.data.shade_smooth()
    up = np.tile(np.float32((0, 0, 1)), (len(obj.data.vertices), 1))
    obj.data.normals_split_custom_set_from_vertices(up.tolist())
    np.testing.assert_allclose(export()[0].meshes[0].corner_normals.reshape(-1, 3)[:, 2], 1, atol=1e-3)


def test_smooth_quads_keep_blenders_normals(scene, export):
    """A bent quad's triangles would weigh otherwise in the normals of its corners."""
    obj = mesh_object(
        "Bent", [(0, 0, 0), (1, 0, 0.4), (1, 1, 0), (0, 1, 0.4), (2, 0, 0), (2, 1, 0.3)], [(0, 1, 2, 3), (1, 4, 5, 2)]
    )
    obj.data.shade_smooth()
    (state,) = export()[0].meshes
    obj.data.calc_loop_triangles()
    expected = [[obj.data.vertices[v].normal[:] for v in t.vertices] for t in obj.data.loop_triangles]
    assert state.corner_normals is None
    np.testing.assert_allclose(state.vertex_normals[state.faces], expected, atol=1e-6)


def test_smooth_and_sharp_corners_follow_their_triangles(scene, export):
    """A cube of quads, half of them smooth: each corner of each triangle has the normal Blender shows there."""
    obj = cube()
    for polygon in obj.data.polygons:
        polygon.use_smooth = polygon.index % 2 == 0
    (state,) = export()[0].meshes
    mesh = obj.data
    mesh.calc_loop_triangles()
    expected = np.array([[tuple(mesh.corner_normals[c].vector) for c in t.loops] for t in mesh.loop_triangles])
    np.testing.assert_allclose(state.corner_normals, expected, atol=1e-6)
    faces = [[mesh.loops[c].vertex_index for c in t.loops] for t in mesh.loop_triangles]
    np.testing.assert_array_equal(state.faces, faces)


def test_modifiers_are_evaluated(scene, export):
    obj = cube()
    subdivision = obj.modifiers.new("Subdivision", "SUBSURF")
    subdivision.levels = subdivision.render_levels = 2
    (state,) = export()[0].meshes
    assert len(state.faces) == 6 * 16 * 2 and len(state.vertices) == 98
    assert np.abs(state.vertices).max() < 1


def test_edited_mesh_is_exported_as_it_is(scene, export):
    obj = cube()
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        (state,) = export()[0].meshes
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
    np.testing.assert_array_equal(state.vertices, CUBE)
    assert len(state.faces) == 12


def test_material_slots_and_what_is_out_of_range(scene, export):
    obj = cube()
    for name in ("Red", None, "Blue"):
        obj.data.materials.append(name and bpy.data.materials.new(name))
    obj.data.polygons.foreach_set("material_index", np.array([0, 1, 2, 2, 99, 0], np.int32))
    (state,) = export()[0].meshes
    assert [m.name for m in state.materials] == ["Red", "Default", "Blue"]
    assert state.material_index.tolist() == [0, 0, 1, 1, 2, 2, 2, 2, 2, 2, 0, 0]


def unwrap(obj: bpy.types.Object, name: str, offset: float) -> np.ndarray:
    """A UV map with other numbers in every corner."""
    layer = obj.data.uv_layers.new(name=name)
    values = np.random.default_rng(4).uniform(0, 1, (len(obj.data.loops), 2)).astype(np.float32) + np.float32(offset)
    layer.uv.foreach_set("vector", values.ravel())
    return values


def test_every_face_has_the_uv_map_of_its_material(scene, export):
    obj = cube()
    first, second = unwrap(obj, "First", 0), unwrap(obj, "Second", 5)
    obj.data.uv_layers["First"].active_render = True
    for material in (textured("Plain"), textured("Other", "Second"), bpy.data.materials.new("None")):
        obj.data.materials.append(material)
    obj.data.polygons.foreach_set("material_index", np.array([0, 1, 2, 0, 1, 2], np.int32))
    frame, warnings = export()
    (state,) = frame.meshes
    assert not warnings
    obj.data.calc_loop_triangles()
    for triangle, uvs in zip(obj.data.loop_triangles, state.uvs, strict=True):
        expected = {0: first, 1: second}.get(triangle.material_index)
        corners = np.zeros((3, 2)) if expected is None else expected[list(triangle.loops)]
        np.testing.assert_array_equal(uvs, corners)


def test_missing_uv_map_is_named(scene, export):
    obj = cube()
    obj.data.materials.append(textured("Checker", "Absent"))
    frame, warnings = export()
    assert len(warnings) == 1 and '"Cube"' in warnings[0] and '"Absent"' in warnings[0]
    assert not frame.meshes[0].uvs.any()


def test_faces_of_which_nothing_is_seen_are_left_out(scene, export):
    clear = bpy.data.materials.new("Clear")
    clear.use_nodes = True
    tree = clear.node_tree
    output = next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")
    tree.links.new(tree.nodes.new("ShaderNodeBsdfTransparent").outputs[0], output.inputs["Surface"])
    obj = cube()
    for material in (bpy.data.materials.new("Solid"), clear):
        obj.data.materials.append(material)
    obj.data.polygons.foreach_set("material_index", np.array([0, 1, 0, 1, 1, 1], np.int32))
    frame, warnings = export()
    assert len(frame.meshes[0].faces) == 4 and frame.meshes[0].material_index is None and not warnings
    obj.data.polygons.foreach_set("material_index", np.ones(6, np.int32))
    obj.data.update()
    assert export()[0].meshes == []


def test_particles_on_a_mesh(scene, export):
    obj = cube("Furry")
    with bpy.context.temp_override(object=obj, active_object=obj):
        bpy.ops.object.particle_system_add()
    settings = obj.particle_systems[0].settings
    settings.count = 5
    other = mesh_object("Leaf", CUBE, QUADS)
    settings.render_type, settings.instance_object = "OBJECT", other
    settings.frame_end = settings.frame_start = 1
    scene.frame_set(2)
    frame, warnings = export()
    assert {s.name: len(s.matrices) for s in frame.meshes} == {"Furry": 1, "Leaf": 6} and not warnings
