"""Drive From: other objects carry DR-GS objects, whatever they are made of; what cannot is refused or told."""

from __future__ import annotations

from math import radians

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import mesh_object, part, select, sphere

pytestmark = pytest.mark.blender_api


def drive(obj, carrier, source="GEOMETRY"):
    select(carrier, obj)
    assert bpy.ops.drgs.drive_from(source=source) == {"FINISHED"}
    assert bpy.context.object == obj


def world(obj) -> np.ndarray:
    bpy.context.view_layer.update()
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    matrix = np.array(evaluated.matrix_world)
    return part("addon.mesh_arrays").read_vertices(evaluated.data) @ matrix[:3, :3].T + matrix[:3, 3]


def cloud_of(points):
    """An object of points alone: vertices without faces."""
    return mesh_object("Points", points, [])


def grid(count=5, size=1.2):
    axis = np.linspace(-size, size, count)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


AFFINE = Matrix(((1.2, 0.3, 0, 0.4), (-0.2, 0.9, 0.1, -0.1), (0, 0.2, 0.8, 0.3), (0, 0, 0, 1)))


@pytest.mark.parametrize("size", [1, -0.7], ids=["", "mirrored"])
@pytest.mark.parametrize("what", ["solid", "twice", "sheet", "one", "faces"])
def test_nothing_moves_when_it_is_bound(ball, what, size):
    ball.matrix_world = Matrix.Translation((2, 0, 1)) @ Matrix.Rotation(0.5, 4, "X")
    points = {"solid": grid(), "sheet": grid()[:, :2] @ np.eye(2, 3), "one": grid(2)[:1]}
    points["twice"] = np.repeat(grid(), 2, axis=0)
    carrier = mesh_object("Body", *sphere(6, 9)) if what == "faces" else cloud_of(points[what])
    carrier.matrix_world = Matrix.Translation((2.1, 0, 1)) @ Matrix.Rotation(0.2, 4, "Z") @ Matrix.Scale(size, 4)
    bpy.context.view_layer.update()
    before = world(ball)
    drive(ball, carrier)
    np.testing.assert_allclose(world(ball), before, atol=2e-6)


def test_points_that_move_affinely_carry_it_alike(ball):
    carrier = cloud_of(grid())
    before = world(ball)
    drive(ball, carrier)
    carrier.data.transform(AFFINE)
    matrix = np.array(AFFINE)
    np.testing.assert_allclose(world(ball), before @ matrix[:3, :3].T + matrix[:3, 3], atol=2e-4)


def test_a_point_cloud_of_nodes_carries_it(ball):
    """What nodes make of a mesh may be a cloud: its points count."""
    carrier = cloud_of(grid())
    tree = bpy.data.node_groups.new("To Points", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    given, result = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    move = tree.nodes.new("GeometryNodeSetPosition")
    tree.links.new(given.outputs[0], move.inputs["Geometry"])
    tree.links.new(move.outputs[0], result.inputs[0])
    carrier.modifiers.new("Move", "NODES").node_group = tree
    before = world(ball)
    drive(ball, carrier)
    move.inputs["Offset"].default_value = (0, 0, 0.7)
    np.testing.assert_allclose(world(ball) - before, np.tile((0, 0, 0.7), (len(before), 1)), atol=1e-5)


def test_a_body_of_other_faces_carries_it_and_stays_as_it_is(ball):
    body = mesh_object("Body", *sphere(6, 9))
    before = world(ball)
    drive(ball, body)
    assert not body.hide_render and body.display_type == "TEXTURED"
    body.rotation_euler = (0, 0, radians(40))
    turn = np.array(Matrix.Rotation(radians(40), 3, "Z"))
    np.testing.assert_allclose(world(ball), before @ turn.T, atol=1e-4)


def test_cloth_carries_it(ball, scene):
    """A cloth that falls takes it along."""
    size = np.linspace(-1.2, 1.2, 8)
    vertices = np.stack([*np.meshgrid(size, size), np.zeros((8, 8))], -1).reshape(-1, 3)
    quads = [(8 * i + j, 8 * i + j + 1, 8 * i + j + 9, 8 * i + j + 8) for i in range(7) for j in range(7)]
    cloth = mesh_object("Cloth", vertices, quads)
    cloth.modifiers.new("Cloth", "CLOTH")
    scene.frame_set(1)
    before = world(ball)
    drive(ball, cloth)
    for frame in range(1, 12):
        scene.frame_set(frame)
    moved = world(cloth)[:, 2].mean()
    assert moved < -0.1
    assert abs((world(ball) - before)[:, 2].mean() - moved) < 0.05 * abs(moved)


def test_particles_of_a_system_carry_it(ball, scene):
    emitter = mesh_object("Emitter", *sphere(8, 12))
    emitter.modifiers.new("Particles", "PARTICLE_SYSTEM")
    settings = emitter.particle_systems[0].settings
    settings.count, settings.frame_start, settings.frame_end, settings.lifetime = 200, 1, 1, 100
    settings.normal_factor, settings.effector_weights.gravity = 0.0, 1.0
    for frame in (1, 2):
        scene.frame_set(frame)
    before = world(ball)
    drive(ball, emitter, "PARTICLES")
    points = bpy.data.objects["Emitter particles"]
    assert points.hide_render and len(world(points)) == 200
    start = world(points)[:, 2].mean()
    for frame in range(3, 12):
        scene.frame_set(frame)
    moved = world(points)[:, 2].mean() - start
    assert moved < -0.1
    assert abs((world(ball) - before)[:, 2].mean() - moved) < 0.03 * abs(moved)


def edges_of(obj) -> np.ndarray:
    return np.array([edge.vertices for edge in obj.data.edges])


@pytest.mark.parametrize("faces", [True, False], ids=["faces", "points"])
@pytest.mark.parametrize("around", [2.0, 3.0, 8.0])
def test_what_surrounds_it_does_not_tear_it(ball, faces, around):
    """Carried by a twisted sphere around it, neighbours stay as close as in a twisted ball."""
    vertices, polygons = sphere(12, 20)
    ball.location = (0.4, 0.2, 0.1)
    before = world(ball)
    carrier = mesh_object("Around", vertices * around, polygons if faces else [])
    drive(ball, carrier)
    twist = carrier.modifiers.new("Twist", "SIMPLE_DEFORM")
    twist.deform_method, twist.deform_axis, twist.angle = "TWIST", "Z", 1.5
    first, second = edges_of(ball).T
    length = [np.linalg.norm(p[first] - p[second], axis=1) for p in (world(ball), before)]
    shear = 1.5 * 1.5 / (2 * around) * np.linalg.norm(before[:, :2], axis=1).max()
    assert (length[0] / length[1]).max() < 1 + shear and (length[1] / length[0]).max() < 1 + shear


@pytest.mark.parametrize("faces", [True, False], ids=["faces", "points"])
def test_points_that_do_not_fill_it_are_told(ball, faces):
    vertices, polygons = sphere(12, 20)
    messages = part("addon.messages")
    messages.clear()
    drive(ball, mesh_object("Around", vertices * 1.5, polygons if faces else []))
    told = [m.text for m in messages.history if m.level == "WARNING"]
    assert not told if faces else '"ball"' in told[0] and '"Around"' in told[0]
    messages.clear()
    ball.modifiers.clear()
    drive(ball, cloud_of(grid()))
    assert not messages.history


@pytest.mark.parametrize("how", ["drive", "nodes", "cage"])
def test_what_has_other_points_in_renders_carries_it_there_too(ball, captured, scene, how):
    """Subdivided once in viewports and twice in renders, as Blender's modifier is when it is added."""
    vertices, polygons = sphere(6, 9)
    carrier = mesh_object("Body", vertices * 1.4, polygons)
    carrier.modifiers.new("Subdivision", "SUBSURF")
    if how == "nodes":
        carrier.modifiers["Subdivision"].subdivision_type = "SIMPLE"
    before = world(ball)
    select(carrier, ball)
    assert (bpy.ops.drgs.bind_to_cage if how == "cage" else bpy.ops.drgs.drive_from)() == {"FINISHED"}
    assert carrier.modifiers[0].levels == 1 and carrier.modifiers[0].render_levels == 2
    np.testing.assert_allclose(world(ball), before, atol=1e-4)
    for vertex in carrier.data.vertices:
        vertex.co.z += 0.7
    messages = part("addon.messages")
    messages.clear()
    bpy.ops.render.render()
    assert not [m.text for m in messages.history if "follow" in m.text]
    (rendered,) = captured[-1].objects
    for shown in (rendered.vertices, world(ball)):
        np.testing.assert_allclose(shown - before, np.tile((0, 0, 0.7), (len(before), 1)), atol=1e-4)
    carrier.modifiers[0].render_levels = 3
    bpy.ops.render.render()
    assert any('"Body", which carries it, has ' in m.text for m in messages.history)


def test_another_number_of_points_is_told(ball, export):
    carrier = cloud_of(grid())
    drive(ball, carrier)
    assert not any("when it was bound" in text for text in export()[1])
    carrier.data.clear_geometry()
    carrier.data.from_pydata(grid(4).tolist(), [], [])
    bpy.context.view_layer.update()
    assert any('"Points"' in text and "has 64 points and had 125" in text for text in export()[1])


def test_what_cannot_carry_is_refused_and_nothing_changes(ball):
    empty = mesh_object("Nothing", [], [])
    broken = cloud_of([(0, 0, 0), (np.nan, 0, 0)])
    plain = mesh_object("Plain", *sphere(4, 6))
    for carrier, source, words in (
        (empty, "GEOMETRY", "has no points"),
        (broken, "GEOMETRY", "not finite"),
        (plain, "PARTICLES", "has no particle system"),
    ):
        select(carrier, ball)
        with pytest.raises(RuntimeError, match=words):
            bpy.ops.drgs.drive_from(source=source)
        assert not len(ball.modifiers) and "Plain particles" not in bpy.data.objects
    select(ball)
    with pytest.raises(RuntimeError, match="nothing that carries"):
        bpy.ops.drgs.drive_from()


def moved(scene_object, of):
    """Whether `of` is another place than its mesh says."""
    return np.abs(world(scene_object) - of).max() > 1e-4


@pytest.mark.parametrize("faces", [True, False], ids=["faces", "points"])
def test_without_the_points_of_then_it_stays_and_that_is_told(ball, export, faces):
    """With other points, with none, and when what carried it is deleted."""
    carrier = mesh_object("Carrier", *sphere(6, 9)) if faces else cloud_of(grid())
    before = world(ball)
    drive(ball, carrier)
    for vertices in (grid(2).tolist(), []):
        carrier.data.clear_geometry()
        carrier.data.from_pydata(vertices, [], [])
        assert not moved(ball, before) and any("does not follow" in text for text in export()[1])
    bpy.data.objects.remove(carrier)
    assert not moved(ball, before) and any('"DR-GS Driver" is deleted' in text for text in export()[1])
    ball.modifiers.clear()
    bpy.context.view_layer.update()
    assert not export()[1]


def test_one_mesh_is_not_carried_twice_by_nodes(ball):
    """It knows the faces of one carrier; the first would carry it by those of the second."""
    body = mesh_object("Body", *sphere(6, 9))
    vertices, faces = sphere(5, 7)
    wing = [int(faces[0][0]), int(faces[0][1]), len(vertices)]  # three faces at an edge: Surface Deform refuses
    cage = mesh_object("Cage", [*vertices, (0, 0, 3)], [*(list(map(int, face)) for face in faces), wing])
    drive(ball, body)
    before = world(ball)
    select(cage, ball)
    with pytest.raises(RuntimeError, match='carried by modifier "DR-GS Driver"'):
        bpy.ops.drgs.bind_to_cage()
    assert [m.name for m in ball.modifiers] == ["DR-GS Driver"]
    body.location.x += 1
    np.testing.assert_allclose(world(ball) - before, np.tile((1, 0, 0), (len(before), 1)), atol=1e-5)
    ball.modifiers.clear()
    select(cage, ball)
    assert bpy.ops.drgs.bind_to_cage() == {"FINISHED"}
    select(body, ball)
    with pytest.raises(RuntimeError, match='carried by modifier "DR-GS Cage"'):
        bpy.ops.drgs.drive_from()


@pytest.mark.parametrize("between", ["", "a node", "an input"])
def test_what_it_shapes_itself_cannot_carry_it(ball, between):
    """Blender would evaluate one of them without the other."""
    body = mesh_object("Body", *sphere(6, 9))
    target = ball
    if between:
        target = mesh_object("Between", *sphere(6, 9))
        tree = bpy.data.node_groups.new("Shape", "GeometryNodeTree")
        modifier = target.modifiers.new("Shape", "NODES")
        if between == "a node":
            tree.nodes.new("GeometryNodeObjectInfo").inputs["Object"].default_value = ball
        else:
            name = tree.interface.new_socket("By", in_out="INPUT", socket_type="NodeSocketObject").identifier
        modifier.node_group = tree
        if between == "an input" and hasattr(modifier, "properties"):
            getattr(modifier.properties.inputs, name).value = ball
        elif between == "an input":
            modifier[name] = ball
    body.modifiers.new("Wrap", "SHRINKWRAP").target = target
    select(body, ball)
    with pytest.raises(RuntimeError, match='shapes "Body"'):
        bpy.ops.drgs.drive_from()
    assert not len(ball.modifiers)
    body.modifiers.clear()
    body.parent = ball  # moves it, does not shape it
    bpy.context.view_layer.update()
    before = world(ball)
    drive(ball, body)
    assert not moved(ball, before)
