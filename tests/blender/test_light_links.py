"""Light linking and shadow linking: what is exported, and the same pictures as Cycles."""

from __future__ import annotations

import bpy
import pytest
from scenes import mesh_object, new_world, sphere
from test_panorama import _paint, picture, room, srgb_psnr  # noqa: F401  a fixture

pytestmark = pytest.mark.blender_api


def linked(name, *, include=(), exclude=(), children=()):
    """A linking collection; `children` are (collection, state)."""
    collection = bpy.data.collections.new(name)
    for obj, state in [*((o, "INCLUDE") for o in include), *((o, "EXCLUDE") for o in exclude)]:
        collection.objects.link(obj)
        collection.collection_objects[-1].light_linking.link_state = state
    for child, state in children:
        collection.children.link(child)
        collection.collection_children[-1].light_linking.link_state = state
    return collection


def add_lamp(scene, name, location, **values):
    lamp = bpy.data.objects.new(name, bpy.data.lights.new(name, "POINT"))
    lamp.location = location
    for key, value in values.items():
        setattr(lamp.data, key, value)
    scene.collection.objects.link(lamp)
    return lamp


@pytest.fixture
def shapes(scene):
    """Three triangles and a lamp."""
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    return [mesh_object(name, corners, [(0, 1, 2)]) for name in "abc"], add_lamp(scene, "Lamp", (0, 0, 3))


def lit(frame, light=0):
    """Names of the meshes that a light shines on, and of those that block it."""
    lamp = frame.lights[light]
    on = [m.name for m in frame.meshes if lamp.receivers < 0 or m.visibility.lit_by >> lamp.receivers & 1]
    by = [m.name for m in frame.meshes if lamp.blockers < 0 or m.visibility.blocks >> lamp.blockers & 1]
    return "".join(sorted(on)), "".join(sorted(by))


def test_included_and_excluded_members(shapes, export):
    (a, b, c), lamp = shapes
    links = lamp.light_linking
    assert lit(export()[0]) == ("abc", "abc")
    links.receiver_collection = linked("one", include=[a, b])
    assert lit(export()[0]) == ("ab", "abc")
    links.receiver_collection = linked("two", exclude=[c])
    links.blocker_collection = linked("three", include=[a, b, c], exclude=[])
    links.blocker_collection.collection_objects[1].light_linking.link_state = "EXCLUDE"
    assert lit(export()[0]) == ("ab", "ac")
    inner = bpy.data.collections.new("inner")
    inner.objects.link(c)
    links.receiver_collection = linked("four", include=[a], children=[(inner, "INCLUDE")])
    links.blocker_collection = linked("five", children=[(inner, "EXCLUDE")])
    frame, warnings = export()
    assert lit(frame) == ("ac", "ab")
    assert len(warnings) == 1 and lamp.name in warnings[0] and "excludes" in warnings[0]
    links.receiver_collection = bpy.data.collections.new("empty")
    assert lit(export()[0])[0] == "abc"


def test_objects_of_one_mesh_and_instances_are_told_apart(scene, shapes, ball, export):
    """Two objects share a mesh; an instance of a collection has the links of what instances it, as in Cycles."""
    (a, b, c), lamp = shapes
    b.data = a.data
    group = bpy.data.collections.new("group")
    group.objects.link(c)
    empty = bpy.data.objects.new("Instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", group
    scene.collection.objects.link(empty)
    lamp.light_linking.receiver_collection = linked("lit", include=[a, empty, ball])
    frame, _ = export()
    number = frame.lights[0].receivers
    states = {(m.name, m.visibility.lit_by >> number & 1, len(m.matrices)) for m in frame.meshes}
    assert states == {("a", 1, 1), ("b", 0, 1), ("c", 0, 1), ("c", 1, 1)}
    assert frame.objects[0].visibility.lit_by >> number & 1


def test_more_collections_of_blockers_than_there_is_room_for_are_told(scene, shapes, export):
    (a, *_), lamp = shapes
    lamp.light_linking.blocker_collection = linked("b0", include=[a])
    for i in range(1, 10):
        add_lamp(scene, f"Lamp {i}", (i, 0, 3)).light_linking.blocker_collection = linked(f"b{i}", include=[a])
    frame, warnings = export()
    assert len(warnings) == 4 and all("shadow linking" in text and '"Lamp' in text for text in warnings)
    assert sorted(light.blockers for light in frame.lights) == [-1] * 4 + list(range(6))


CASES = {
    "receivers": lambda o: setattr(o["Lamp"].light_linking, "receiver_collection", linked("r", include=[o["ball"]])),
    "blockers": lambda o: setattr(o["Lamp"].light_linking, "blocker_collection", linked("b", exclude=[o["ball"]])),
    "glow, receivers": lambda o: setattr(
        o["glow"].light_linking, "receiver_collection", linked("r", include=[o["ball"], o["back"]])
    ),
    "glow, blockers": lambda o: setattr(
        o["glow"].light_linking, "blocker_collection", linked("b", exclude=[o["ball"]])
    ),
}


@pytest.mark.slow
@pytest.mark.judged
@pytest.mark.parametrize("name", CASES)
def test_pictures_are_those_of_cycles(room, name):  # noqa: F811
    add_lamp(room, "Fill", (1.5, -1.5, 1.0), energy=40.0, shadow_soft_size=0.2)
    z = 1.2
    glow = mesh_object("glow", [(-1.5, 1, z), (-0.9, 1, z), (-0.9, 1.6, z), (-1.5, 1.6, z)], [(0, 1, 2, 3)])
    _paint(glow, (0, 0, 0, 1), 1.0, 0.0)
    shader = next(n for n in glow.data.materials[0].node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    shader.inputs["Emission Color"].default_value = (1, 0.7, 0.4, 1)
    shader.inputs["Emission Strength"].default_value = 12.0
    room.camera.location, room.camera.rotation_euler = (-0.4, -2.6, 0.3), (1.45, 0.0, -0.15)
    room.camera.data.lens = 18
    objects = {obj.name: obj for obj in room.objects}
    plain = picture(room, "DRGS", 128)
    CASES[name](objects)
    theirs, ours = picture(room, "CYCLES", 512), picture(room, "DRGS", 512)
    found, change = srgb_psnr(ours[..., :3], theirs[..., :3]), srgb_psnr(ours[..., :3], plain[..., :3])
    print(f"{name}: {found:.1f} dB, unlinked {change:.1f} dB, mean {ours.mean() / theirs.mean():.4f}")
    assert found >= 38 and found > change + 4
    assert abs(ours[..., :3].mean() / theirs[..., :3].mean() - 1) < 0.01


@pytest.fixture
def gallery(scene):
    """Balls of mirror, coat and glass on a floor; before a part of the lamp a screen that the camera does not see."""
    floor = mesh_object("floor", [(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)], [(0, 1, 2, 3)])
    _paint(floor, (0.6, 0.6, 0.6, 1), 0.3, 0.0)
    looks = {
        "mirror": (0.0, 1.0, {}),
        "coat": (0.6, 0.0, {"Coat Weight": 1.0}),
        "glass": (0.05, 0.0, {"Transmission Weight": 1.0}),
    }
    for i, (name, (roughness, metallic, values)) in enumerate(looks.items()):
        ball = mesh_object(name, 0.4 * sphere(32, 48)[0] + (i - 1, 0, 0.4), sphere(32, 48)[1])
        for polygon in ball.data.polygons:
            polygon.use_smooth = True
        _paint(ball, (0.8, 0.7, 0.6, 1), roughness, metallic)
        shader = next(n for n in ball.data.materials[0].node_tree.nodes if n.type == "BSDF_PRINCIPLED")
        for socket, value in values.items():
            shader.inputs[socket].default_value = value
    corners = [(-0.3, -1.2, 1.4), (0.7, -1.2, 1.4), (0.7, -0.2, 1.4), (-0.3, -0.2, 1.4)]
    screen = mesh_object("screen", corners, [(0, 1, 2, 3)])
    _paint(screen, (0.2, 0.5, 0.2, 1), 1.0, 0.0)
    screen.visible_camera = False
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "AREA"))
    lamp.data.energy, lamp.data.size, lamp.location = 100, 1.0, (0.4, -1.2, 2.6)
    lamp.rotation_euler = (-0.4, 0.15, 0.0)
    scene.collection.objects.link(lamp)
    _, background = new_world(scene)
    background.inputs["Color"].default_value = (0.1, 0.1, 0.1, 1)
    scene.camera.location, scene.camera.rotation_euler = (0, -4, 3), (0.95, 0, 0)
    scene.camera.data.lens = 45
    scene.render.resolution_x, scene.render.resolution_y = 96, 64
    return scene


SHADOWS = {
    "blocked by the mirror alone": lambda o: setattr(
        o["Lamp"].light_linking, "blocker_collection", linked("b", include=[o["mirror"]])
    ),
    "not blocked by the glass": lambda o: setattr(
        o["Lamp"].light_linking, "blocker_collection", linked("b", exclude=[o["glass"]])
    ),
    "without shadow": lambda o: setattr(o["Lamp"].data, "use_shadow", False),
}


@pytest.mark.slow
@pytest.mark.judged
@pytest.mark.parametrize("name", SHADOWS)
def test_mirrors_coats_and_glass_show_lamps_as_in_cycles(gallery, name):
    """Whatever blocks the lamp, its reflections and caustics are those of Cycles."""
    SHADOWS[name]({obj.name: obj for obj in gallery.objects})
    theirs, ours = picture(gallery, "CYCLES", 256, passes=12), picture(gallery, "DRGS", 256)
    found = srgb_psnr(ours[..., :3], theirs[..., :3])
    print(f"{name}: {found:.1f} dB, mean {ours[..., :3].mean() / theirs[..., :3].mean():.4f}")
    assert found >= 30  # caustics of 256 paths are noise
    assert abs(ours[..., :3].mean() / theirs[..., :3].mean() - 1) < 0.02
