"""Captured colours in Blender: the switch and its keyframes, pictures under Standard, and over another engine's."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import asset_of, mesh_object, new_world, part, read_exr, sphere
from test_composed import CUBE, SIDES, painted

pytestmark = pytest.mark.blender_api

#: Colour of the display that the ball has from all sides.
COLOUR = (0.6, 0.3, 0.8)


@pytest.fixture
def captured_ball(scene, tmp_path):
    """The imported sphere with one colour from all sides, shown in it; grey light from everywhere."""
    asset = asset_of(*sphere())
    sh = np.zeros((len(asset.surfels), 4, 3), np.float32)
    sh[:, 0] = (np.array(COLOUR) - 0.5) / 0.28209479177387814
    asset.surfels.sh, asset.surfels.opacity = sh, np.ones_like(asset.surfels.opacity)
    path = tmp_path / "captured.drgs"
    part("drgs_blender.core.asset.container").write_asset(path, asset)
    bpy.ops.import_scene.drgs(filepath=str(path))
    ball = bpy.context.active_object
    ball.drgs.captured_colours = True
    _, background = new_world(scene)
    background.inputs["Color"].default_value = (0.2, 0.2, 0.2, 1)
    return ball


def linear() -> np.ndarray:
    return part("drgs_blender.core.color").srgb_to_linear(np.array(COLOUR))


def test_the_switch_takes_keyframes_and_viewports_hear_of_it(captured_ball, scene):
    export_frame, cache = part("addon.export").export_frame, part("addon.export.export_cache").ExportCache()

    def state():
        return export_frame(bpy.context.evaluated_depsgraph_get(), str, lambda text: None, cache=cache).objects[0]

    for number, wanted in ((1, True), (2, False)):
        captured_ball.drgs.captured_colours = wanted
        captured_ball.keyframe_insert("drgs.captured_colours", frame=number)
    for number, wanted in ((1, True), (2, False), (1, True)):
        scene.frame_set(number)
        assert state().captured_colours is wanted


def test_a_picture_under_standard_has_the_numbers_of_the_file(captured_ball, scene, tmp_path):
    """As viewers of splats show them, to the last of 256 steps but one; beside a lit cube, in the pass Emission."""
    cube = painted(mesh_object("Cube", CUBE, SIDES), (0.5, 0.5, 0.5), 1.0)
    cube.scale, cube.location = (0.4, 0.4, 0.4), (1.6, 0, 0)
    scene.view_settings.view_transform = "Standard"
    image = scene.render.image_settings
    image.file_format, image.color_depth = "PNG", "8"
    scene.render.dither_intensity, scene.render.filepath = 0.0, str(tmp_path / "out.png")
    bpy.ops.render.render(write_still=True)
    picture = bpy.data.images.load(scene.render.filepath)
    pixels = np.array(picture.pixels).reshape(48, 64, 4)
    assert np.abs(pixels[20:28, 28:36, :3] - COLOUR).max() < 1.6 / 255
    side = pixels[22:26, 50:53, :3]
    assert side.std() < 0.2 and 0.1 < side.mean() < 0.9 and np.abs(side - COLOUR).max() > 0.1


def test_over_a_picture_of_cycles_it_is_captured_too(captured_ball, scene):
    cube = painted(mesh_object("Front", CUBE, SIDES), (0.8, 0.2, 0.1), 1.0)
    cube.scale, cube.location = (0.3, 0.3, 0.6), (0.6, -1.5, 0)
    scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", 4, "CPU"
    assert bpy.ops.drgs.set_up_compositing() == {"FINISHED"}
    bpy.ops.render.render(write_still=True)
    picture = read_exr(scene.render.filepath, 64, 48)
    np.testing.assert_allclose(np.median(picture[20:28, 22:30, :3], axis=(0, 1)), linear(), atol=4e-3)
    assert picture[24, 42, 0] < 0.5 * linear()[2]  # the cube hides it


def test_a_ball_without_captured_colours_says_so(ball, scene):
    history = part("addon.messages").history
    new_world(scene)
    history.clear()
    ball.drgs.captured_colours = True
    bpy.ops.render.render()
    assert any("no captured colours" in message.text for message in history)
