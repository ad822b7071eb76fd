"""Blur in rendered viewports: the same picture as F12, as far as keyframes tell what moves."""

from __future__ import annotations

import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector
from scenes import mesh_object, new_world, part, read_exr
from test_composed import CUBE, SIDES, painted

pytestmark = pytest.mark.blender_api

WIDTH, HEIGHT = 64, 48


@pytest.fixture
def views():
    module = part("addon.viewport.views")
    module.forget()
    yield module
    module.stop()
    part("addon.messages").history.clear()


@pytest.fixture
def lit(ball, scene):
    """The ball and a painted cube in a white world, no denoiser, the same seed everywhere."""
    new_world(scene)[1].inputs["Color"].default_value = (1, 1, 1, 1)
    cube = painted(mesh_object("Cube", CUBE, SIDES), (0.8, 0.2, 0.1))
    cube.scale, cube.location = (0.3, 0.3, 0.3), (0.6, -2, 0)
    settings = scene.drgs
    settings.use_strategy_samples, settings.samples, settings.subpixel_samples, settings.bounces = False, 48, 0, 0
    settings.blur_steps, settings.seed = 8, 3
    bpy.context.view_layer.update()
    return SimpleNamespace(scene=scene, ball=ball, cube=cube, camera=scene.camera)


def asked(views, scene, name="view", through=True, **screen):
    """Ask for the picture that a region as large as the final one shows; the request, None for the last one again."""
    bpy.context.view_layer.update()
    depsgraph, camera = bpy.context.evaluated_depsgraph_get(), scene.camera
    space = SimpleNamespace(camera=camera, local_view=None, clip_start=0.1, clip_end=100, use_render_border=False)
    rv3d = SimpleNamespace(
        window_matrix=camera.calc_matrix_camera(depsgraph, x=WIDTH, y=HEIGHT),
        view_matrix=camera.matrix_world.normalized().inverted(),
        is_perspective=camera.data.type != "ORTHO",
        view_perspective="CAMERA" if through else "PERSP",
    )
    context = SimpleNamespace(
        region=SimpleNamespace(width=WIDTH, height=HEIGHT),
        space_data=space,
        region_data=rv3d,
        screen=SimpleNamespace(is_animation_playing=screen.get("playing", False)),
    )
    before = views.worker._views[name].request if name in views.worker._views else None
    assert views.update(context, depsgraph, name) == ""
    now = views.worker._views[name].request
    return None if now is before else now


def converged(views, request, name="view"):
    end = time.monotonic() + 120
    while not ((seen := views.worker.picture(name)) and seen.request is request and seen.fraction == 1.0):
        assert time.monotonic() < end and not views.worker.state(name)[1], views.worker.state(name)
        time.sleep(0.01)
    return seen.passes["Combined"]


def final(scene):
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, WIDTH, HEIGHT)


def decibels(a, b):
    return -10 * np.log10(np.mean((a - b)[..., :3] ** 2) / np.max(b[..., :3]) ** 2 + 1e-20)


def keyed(obj, path, *values, frames=(0, 2)):
    """Keyframes of a property at two frames, with a line between them."""
    for number, value in zip(frames, values):
        setattr(obj, path, value)
        obj.keyframe_insert(path, frame=number)
    for curve in part("addon.viewport.keyed_motion")._curves_of(obj):
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


def told():
    return [m.text for m in part("addon.messages").history if "viewport" in m.text or "panorama" in m.text]


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_depth_of_field_through_the_camera_is_that_of_f12(lit, views, kind):
    scene, dof = lit.scene, lit.camera.data.dof
    lit.camera.data.type, lit.camera.data.ortho_scale = kind, 3
    sharp = converged(views, asked(views, scene))
    dof.use_dof, dof.focus_object, dof.aperture_fstop = True, lit.ball, {"PERSP": 0.1, "ORTHO": 1.5}[kind]
    seen, theirs = converged(views, asked(views, scene)), final(scene)
    np.testing.assert_array_equal(seen, theirs)
    assert decibels(sharp, theirs) < 35, "what is out of focus is seen to be"
    assert asked(views, scene) is None, "nothing changed"
    lit.ball.location.y += 0.5
    assert asked(views, scene).parts.moments[0].focus == pytest.approx(5.5), "the focus follows its object"


def test_a_view_of_its_own_and_a_panorama_are_sharp(lit, views):
    scene, camera = lit.scene, lit.camera
    camera.data.dof.use_dof = True
    assert len(asked(views, scene).parts) == 8
    assert asked(views, scene, through=False).parts == ()
    camera.data.type = "PANO"
    part("addon.export.camera").lens_of(camera.data).panorama_type = "EQUIRECTANGULAR"
    assert asked(views, scene).parts == () and any("panoramas have no depth" in text for text in told())
    camera.data.type = "PERSP"
    assert len(asked(views, scene).parts) == 8 and not told(), "the warning leaves with its cause"


def test_the_first_picture_is_the_one_without_blur(lit, views):
    """No more of the engine is asked for before something is seen, however many parts there are."""
    lit.camera.data.dof.use_dof, lit.scene.drgs.blur_steps = True, 1024
    request = asked(views, lit.scene)
    calls, client = [], request.client
    watched = SimpleNamespace(
        wake=client.wake,
        load_asset=client.load_asset,
        view=lambda *a: calls.append("view") or client.view(*a),
        render=lambda *a: calls.append("render") or client.render(*a),
    )
    views.worker.submit("view", type(request)(request.frame, watched, request.assets, request.parts))
    end = time.monotonic() + 120
    while "render" not in calls and time.monotonic() < end:
        time.sleep(0.005)
    assert calls[0] == "view" and "render" in calls[1:3]
    assert views.worker.picture("view").passes["Combined"].shape[-1] == 4


def test_keyframed_motion_is_that_of_f12(lit, views):
    """A ball that rolls, a cube that hangs on it and a camera that pans, all by keyframes."""
    scene, render = lit.scene, lit.scene.render
    keyed(lit.ball, "location", (-0.4, 0, 0), (0.4, 0, 0.2))
    keyed(lit.ball, "rotation_euler", (0, 0, 0), (0.4, 1.2, 0))
    keyed(lit.ball, "scale", (0.5, 0.5, 0.5), (0.7, 0.6, 0.5))
    lit.cube.parent = lit.ball
    lit.cube.matrix_parent_inverse = Matrix.Translation((0.3, 0, 0))
    lit.cube.delta_location = 0, 0, 0.4
    keyed(lit.camera, "location", (0, -5, 0), (0.5, -5, 0.2))
    scene.frame_set(1)
    still = converged(views, asked(views, scene))
    render.use_motion_blur, render.motion_blur_shutter = True, 1.0
    scene.drgs.samples = 96
    request = asked(views, scene)
    assert len(request.parts) == 8 and scene.frame_current == 1
    seen, theirs = converged(views, request), final(scene)
    assert decibels(seen, theirs) > 40 > 30 > decibels(still, theirs)
    assert not told()
    scene.drgs.use_viewport_motion_blur = False
    assert asked(views, scene).parts == ()


def test_while_it_plays_or_in_a_layer_without_it_pictures_are_sharp(lit, views):
    keyed(lit.ball, "location", (-1, 0, 0), (1, 0, 0))
    lit.scene.frame_set(1)
    lit.scene.render.use_motion_blur = True
    assert len(asked(views, lit.scene).parts) == 8
    assert asked(views, lit.scene, playing=True).parts == ()
    assert len(asked(views, lit.scene).parts) == 8
    lit.scene.view_layers[0].use_motion_blur = False
    assert asked(views, lit.scene).parts == ()


def test_other_keyframes_of_the_same_moment_make_another_picture(lit, views):
    keyed(lit.ball, "location", (-1, 0, 0), (1, 0, 0))
    lit.scene.frame_set(1)
    lit.scene.render.use_motion_blur = True
    before = asked(views, lit.scene).parts[0].objects[0].matrix_world
    keyed(lit.ball, "location", (-2, 0, 0), (2, 0, 0))
    lit.scene.frame_set(1)
    after = asked(views, lit.scene).parts[0].objects[0].matrix_world
    assert before[0, 3] == pytest.approx(-0.21875, abs=1e-4) and after[0, 3] == pytest.approx(2 * before[0, 3])


def constraint(lit):
    track = lit.cube.constraints.new("COPY_LOCATION")
    track.target = lit.ball
    return lambda: lit.cube.constraints.remove(track)


def driver(lit):
    lit.cube.driver_add("location", 0).driver.expression = "frame"
    return lambda: lit.cube.driver_remove("location", 0)


def shape_keys(lit):
    for name in ("Basis", "Tall"):
        lit.cube.shape_key_add(name=name)
    lit.cube.data.shape_keys.key_blocks["Tall"].keyframe_insert("value", frame=1)
    return lit.cube.data.shape_keys.animation_data_clear


def cloth(lit):
    lit.cube.modifiers.new("Cloth", "CLOTH")
    return lit.cube.modifiers.clear


def by_hand(lit):
    keyed(lit.cube, "location", (0, 0, 0), (1, 0, 0))
    lit.scene.frame_set(1)
    lit.cube.location.z = 3
    return lambda: lit.scene.frame_set(1)


def nla(lit):
    keyed(lit.cube, "location", (0, 0, 0), (1, 0, 0))
    data = lit.cube.animation_data
    action, data.action = data.action, None
    track = data.nla_tracks.new()
    track.strips.new("Strip", 0, action)
    return lambda: data.nla_tracks.remove(track)


@pytest.mark.parametrize(
    ("how", "why"),
    [
        (constraint, "constraint Copy Location"),
        (driver, "driver"),
        (shape_keys, "shape keys"),
        (cloth, "modifier Cloth"),
        (by_hand, "stands elsewhere"),
        (nla, "NLA"),
    ],
)
def test_what_else_moves_is_named_and_stays_where_it_is(lit, views, how, why):
    """And is not named any more when it has gone; nothing of the scene is changed by looking."""
    keyed(lit.ball, "location", (-1, 0, 0), (1, 0, 0))
    lit.scene.frame_set(1)
    lit.scene.render.use_motion_blur = True
    asked(views, lit.scene)
    assert not told()
    undo = how(lit)
    bpy.context.view_layer.update()
    place = tuple(lit.cube.location)
    request = asked(views, lit.scene) or views.worker._views["view"].request
    assert [(text.count('"Cube"'), why in text) for text in told()] == [(1, True)] and views.not_blurred() == told()
    assert tuple(lit.cube.location) == place and lit.scene.frame_current == 1
    stands = np.array(lit.cube.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world)
    np.testing.assert_allclose(request.parts[0].meshes[0].matrices[0], stands, atol=1e-6)
    undo()
    asked(views, lit.scene)
    assert not told() and not views.not_blurred()


def test_still_constraints_and_modifiers_are_no_motion(lit, views):
    """A camera that looks at something that stands still, and a mesh that is bevelled, are blurred as they are."""
    lit.camera.constraints.new("TRACK_TO").target = lit.cube
    lit.cube.modifiers.new("Bevel", "BEVEL")
    keyed(lit.ball, "location", (-1, 0, 0), (1, 0, 0))
    lit.scene.frame_set(1)
    lit.scene.render.use_motion_blur = True
    request = asked(views, lit.scene)
    assert not told()
    np.testing.assert_array_equal(request.parts[0].camera.matrix_world, request.frame.camera.matrix_world)


def test_instances_move_with_what_makes_them(lit, views):
    collection = bpy.data.collections.new("Group")
    collection.objects.link(lit.cube)
    empty = bpy.data.objects.new("Empty", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    lit.scene.collection.objects.link(empty)
    keyed(empty, "location", (0, 0, 0), (0, 0, 2))
    keyed(empty, "rotation_euler", (0, 0, 0), (0, 0, 1))
    lit.scene.frame_set(1)
    lit.scene.render.use_motion_blur = True
    request = asked(views, lit.scene)
    for step, place in zip((request.parts[0], request.parts[7]), (0.78125, 1.21875)):
        moved = [m for mesh in step.meshes for m in mesh.matrices if not np.allclose(m, lit.cube.matrix_world)]
        turn = Matrix.Translation((0, 0, place)) @ Matrix.Rotation(place / 2, 4, "Z")
        where = turn @ Vector(lit.cube.location)
        assert len(moved) == 1 and moved[0][:3, 3] == pytest.approx(where, abs=1e-5)
