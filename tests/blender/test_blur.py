"""Motion blur and depth of field: the mean over time and lens, as Cycles has it."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import mesh_object, new_world, part, read_exr
from test_composed import CUBE, SIDES, painted

pytestmark = pytest.mark.blender_api

JUDGED = pytest.mark.judged
WIDTH, HEIGHT = 64, 48
blur = part("drgs_blender.ipc.blur")


@pytest.fixture
def white(ball, scene):
    """White things in a white world, film transparent: the picture is its alpha."""
    new_world(scene)[1].inputs["Color"].default_value = (1, 1, 1, 1)
    scene.render.film_transparent = True
    settings = scene.drgs
    settings.use_strategy_samples, settings.samples, settings.subpixel_samples, settings.bounces = False, 48, 0, 0
    settings.camera_sees, settings.blur_steps = "mesh", 16
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = "CPU", 512, False, False
    cycles.pixel_filter_type, cycles.filter_width, cycles.max_bounces = "BOX", 1.0, 0
    return scene


def alpha(scene, engine="DRGS") -> np.ndarray:
    scene.render.engine = engine
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, WIDTH, HEIGHT)[..., 3]


@pytest.mark.slow
@pytest.mark.parametrize("position", [*(pytest.param(p, marks=JUDGED) for p in ("START", "END")), "CENTER"])
def test_motion_blur_is_that_of_cycles(white, ball, position):
    """A ball flies half a metre a frame, its mesh bends meanwhile; the shutter is open for one frame."""
    for number, x in ((0, -0.5), (2, 0.5)):
        ball.location.x = x
        ball.keyframe_insert("location", frame=number)
    action = ball.animation_data.action
    curves = action.fcurves if hasattr(action, "fcurves") else action.layers[0].strips[0].channelbags[0].fcurves
    for curve in curves:
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
    ball.data.shape_keys or (ball.shape_key_add(name="Basis"), ball.shape_key_add(name="Tall"))
    tall = ball.data.shape_keys.key_blocks["Tall"]
    for point in tall.data:
        point.co.z *= 1.5
    for number, value in ((0, 0.0), (2, 1.0)):
        tall.value = value
        tall.keyframe_insert("value", frame=number)
    white.frame_set(1)
    render = white.render
    render.use_motion_blur, render.motion_blur_shutter, render.motion_blur_position = True, 1.0, position
    ours = alpha(white)
    assert white.frame_current == 1 and white.frame_subframe == 0
    theirs = alpha(white, "CYCLES")
    columns = np.arange(WIDTH) + 0.5
    assert abs((ours.sum(0) @ columns) / ours.sum() - (theirs.sum(0) @ columns) / theirs.sum()) < 0.15
    np.testing.assert_allclose(ours.sum(), theirs.sum(), rtol=0.01)
    assert np.abs(ours - theirs).mean() < 0.02 and ((ours > 0.05) & (ours < 0.95)).mean() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        ("PERSP", {"aperture_blades": 5, "aperture_rotation": 0.4}),
        pytest.param("PERSP", {"aperture_ratio": 2.0}, marks=JUDGED),
        pytest.param("ORTHO", {}, marks=JUDGED),
    ],
)
def test_depth_of_field_is_that_of_cycles(white, ball, kind, shape):
    """The ball is sharp, a cube before it is not: edges of both are as soft as in Cycles."""
    ball.scale = (0.5, 0.5, 0.5)
    ball.location.x = -0.6
    cube = painted(mesh_object("Cube", CUBE, SIDES), (1, 1, 1))
    cube.scale, cube.location = (0.15, 0.15, 0.15), (0.4, -3, 0)
    dof = white.camera.data.dof
    white.camera.data.type, white.camera.data.ortho_scale = kind, 2.5
    # An orthographic camera's aperture is one of a lens of a metre.
    dof.use_dof, dof.focus_object, dof.aperture_fstop = True, ball, {"PERSP": 0.1, "ORTHO": 1.5}[kind]
    for name, value in shape.items():
        setattr(dof, name, value)
    white.drgs.blur_steps, white.drgs.samples = 128, 3
    ours, theirs = alpha(white), alpha(white, "CYCLES")
    np.testing.assert_allclose(ours.sum(), theirs.sum(), rtol=0.02)
    right = slice(36, None)
    assert np.abs(ours - theirs)[:, right].mean() < 0.02
    soft = (theirs > 0.05) & (theirs < 0.95)
    assert soft[:, right].sum() > 150 and np.abs(ours - theirs)[:, :32].mean() < 0.02


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_what_is_in_focus_stays_where_it_is(white, kind):
    """A point at the distance in focus is seen in the same pixel from everywhere on the lens."""
    camera_of = part("addon.export.camera").export_camera
    white.camera.data.type = kind
    bpy.context.view_layer.update()
    camera = camera_of(white.camera, white.render)
    far = 1 if kind == "ORTHO" else 4
    point = np.array(white.camera.matrix_world) @ (0.3, -0.2, -4.0, 1)
    for lens in ((0, 0), (0.2, 0), (-0.1, 0.3)):
        moved = blur.camera_on_lens(camera, lens, 4.0)
        x, y, z = (np.linalg.inv(moved.matrix_world) @ point)[:3]
        x, y = (x, y) if kind == "ORTHO" else (x / -z, y / -z)
        pixel = moved.cx + moved.fx * x, moved.cy - moved.fy * y
        assert pixel == pytest.approx((camera.cx + camera.fx * 0.3 / far, camera.cy + camera.fy * 0.2 / far))


def test_a_view_layer_without_motion_blur_keeps_its_depth_of_field(white, captured, ball):
    """As in Cycles: its own switch counts where the scene has motion blur."""
    white.render.engine, white.render.use_motion_blur = "DRGS", True
    dof, layer = white.camera.data.dof, white.view_layers[0]
    pictures = []
    for layer.use_motion_blur, dof.use_dof in ((True, False), (False, False), (False, True)):
        captured.clear()
        bpy.ops.render.render()
        pictures.append([p.camera.matrix_world[0, 3] for p in captured])
    assert list(map(len, pictures)) == [16, 1, 16] and len(set(pictures[0])) == 1 and len(set(pictures[2])) == 16


def test_rays_are_divided_and_surface_passes_stay_sharp(white, captured, ball):
    white.render.engine = "DRGS"
    white.view_layers[0].use_pass_z = True
    white.drgs.samples, white.drgs.blur_steps = 64, 8
    white.camera.data.dof.use_dof = True
    bpy.ops.render.render()
    sharp, *pictures = captured
    assert sharp.passes == ("Depth",) and len(pictures) == 8
    assert all(p.passes == ("Combined",) and p.settings.sample_count == 8 for p in pictures)
    assert len({p.settings.seed for p in pictures}) == 8
    assert np.array_equal(sharp.camera.matrix_world, np.array(white.camera.matrix_world))
    history = part("addon.messages").history
    white.view_layers[0].use_pass_cryptomatte_object = True
    bpy.ops.render.render()
    assert not any("Cryptomatte" in m.text for m in history)
    white.view_layers[0].use_pass_cryptomatte_asset = True
    bpy.ops.render.render()
    assert any("no pass Cryptomatte Asset" in m.text for m in history)


def test_the_line_above_the_picture_says_what_it_is_made_of(white, captured):
    white.render.engine = "DRGS"
    bpy.ops.render.render()
    engine = part("addon.render_engine.engine")
    text = engine.summary(captured[0], {"surfels": 1234.0, "seconds.total": 2.0, "samples": 6e6})
    assert text == "48 samples | 1,234 surfels | 2.00 s in the engine, 3.0 million samples/s"
    assert engine.summary(captured[0], {}) == "48 samples"


def test_what_of_motion_blur_is_left_out_is_told_by_name(scene, ball):
    """Only while there is motion blur, and no longer than it holds."""
    steps = part("addon.export.blur_steps").steps
    scene.render.use_motion_blur, said = True, []
    layer = scene.view_layers[0]
    steps(scene, layer, None, said.append)
    assert not said
    ball.cycles.use_motion_blur = False
    scene.render.motion_blur_shutter_curve.curves[0].points[0].location.y = 0.0
    steps(scene, layer, None, said.append)
    curve, objects = said
    assert "Shutter Curve" in curve and f'"{ball.name}"' in objects
    scene.render.use_motion_blur = False
    steps(scene, layer, None, said.append)
    assert len(said) == 2
