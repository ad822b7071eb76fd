"""Passes of motion: the scene one frame earlier and later, and the same vectors as Cycles."""

from __future__ import annotations

import os
import subprocess

import bpy
import numpy as np
import pytest
from scenes import armature_object, mesh_object, part, sphere

pytestmark = pytest.mark.blender_api

#: Turns the layers of an EXR file into arrays, in the engine's interpreter, which has OpenEXR.
READ = """
import sys
import numpy as np, OpenEXR
channels = {}
for p in OpenEXR.File(sys.argv[1], separate_channels=True).parts:
    channels |= {name.split(".", 1)[1]: c.pixels for name, c in p.channels.items()}
layers = {name.rpartition(".")[0] for name in channels}
np.savez(sys.argv[2], **{
    layer: np.stack([channels[f"{layer}.{c}"] for c in "XYZWRGBArgba" if f"{layer}.{c}" in channels], -1)
    for layer in layers if layer not in ("Depth",)
})
"""


def animate(obj, path, values):
    """Keyframes at 1, 2, 3 ..., straight between them."""
    for number, value in enumerate(values, 1):
        setattr(obj, path, value)
        obj.keyframe_insert(path, frame=number)


@pytest.fixture
def moving(ball, scene):
    """A ball bent by an armature, a cube and two linked spheres that fly and turn, and a camera that follows."""
    rig = armature_object({"Low": ((0, 0, -1), (0, 0, 0)), "High": ((0, 0, 0), (0, 0, 1))})
    height = np.array([v.co.z for v in ball.data.vertices])
    for name, weights in (("High", np.clip(0.5 + height, 0, 1)), ("Low", np.clip(0.5 - height, 0, 1))):
        group = ball.vertex_groups.new(name=name)
        for index, weight in enumerate(weights):
            group.add([index], float(weight), "REPLACE")
    ball.parent = rig
    ball.modifiers.new("Rig", "ARMATURE").object = rig
    bone = rig.pose.bones["High"]
    bone.rotation_mode = "XYZ"
    for number, angle in enumerate((0.0, 0.2, 0.35, 0.3), 1):
        bone.rotation_euler = (angle, 0.5 * angle, 0.3 * angle)
        bone.keyframe_insert("rotation_euler", frame=number)
    animate(rig, "location", [(0, 0, 0.05 * k * k) for k in range(4)])
    cube = mesh_object("Cube", *sphere(4, 6))
    animate(cube, "location", [(-1.2 + 0.1 * k, 0.02 * k * k, -0.6) for k in range(4)])
    animate(cube, "scale", [(0.5, 0.5, 0.5 + 0.05 * k) for k in range(4)])
    for side in (0.9, 1.5):
        twin = bpy.data.objects.new("Twin", cube.data)
        scene.collection.objects.link(twin)
        twin.scale = (0.3, 0.3, 0.3)
        animate(twin, "location", [(side, -1, -0.8 + 0.1 * k * side) for k in range(4)])
        animate(twin, "rotation_euler", [(0.1 * k, 0.2 * k * side, 0) for k in range(4)])
    for index, obj in enumerate(o for o in scene.objects if o.type == "MESH"):
        obj.pass_index = index + 1
    animate(scene.camera, "location", [(0.1 * k, -5 - 0.1 * k, 0.05 * k * k) for k in range(4)])
    animate(scene.camera, "rotation_euler", [(np.pi / 2 + 0.01 * k, 0.01 * k, 0.02 * k) for k in range(4)])
    scene.view_layers[0].use_pass_vector = scene.view_layers[0].use_pass_object_index = True
    scene.frame_set(3)
    return scene


def layers_of(scene, engine, tmp_path):
    """Layers of the file that a render with `engine` writes."""
    scene.render.engine = engine
    image = scene.render.image_settings
    if hasattr(image, "media_type"):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth = "OPEN_EXR_MULTILAYER", "32"
    scene.render.filepath = str(tmp_path / f"{engine}.exr")
    bpy.ops.render.render(write_still=True)
    arrays = tmp_path / f"{engine}.npz"
    subprocess.run([os.environ["DRGS_ENGINE"], "-c", READ, scene.render.filepath, str(arrays)], check=True, timeout=100)
    return dict(np.load(arrays))


@pytest.mark.slow
def test_vectors_are_those_of_cycles(moving, tmp_path):
    """An armature, a scale, instances and the camera move; frame 3 of 4, so that both neighbours differ."""
    cycles = moving.cycles
    cycles.device, cycles.samples, cycles.pixel_filter_type = "CPU", 256, "BOX"
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    theirs = layers_of(moving, "CYCLES", tmp_path)
    settings = moving.drgs
    settings.camera_sees, settings.subpixel_samples, settings.filter_width = "mesh", 64, 0
    settings.cosine_samples, settings.ggx_samples, settings.environment_samples = 32, 16, 16
    ours = layers_of(moving, "DRGS", tmp_path)
    index = next(name for name in ours if name in ("IndexOB", "Object Index"))
    alike = ours[index] == theirs[index]
    h, w = alike.shape[:2]
    padded = np.pad(np.where(alike, ours[index], -1)[..., 0], 1, mode="edge")
    around = [padded[y : y + h, x : x + w] == padded[1:-1, 1:-1] for y in range(3) for x in range(3)]
    inside = np.all(around, axis=0) & (ours[index][..., 0] > 0)
    assert {1, 2, 3, 4} <= set(np.unique(ours[index][inside]).astype(int))
    difference = np.abs(ours["Vector"] - theirs["Vector"])[inside]
    assert np.median(difference) < 0.001 and difference.max() < 0.01
    assert np.abs(theirs["Vector"][inside]).max() > 3
    settings.camera_sees = "surfels"
    seen = layers_of(moving, "DRGS", tmp_path)
    # The few large surfels of this ball stand off its faces, which turn; other meshes are as before.
    off = np.abs(seen["Vector"] - theirs["Vector"])
    assert np.median(off[inside]) < 0.1 and np.median(off[inside & (ours[index][..., 0] > 2)]) < 0.002


def test_only_passes_of_motion_cost_an_evaluation(moving, captured):
    layer = moving.view_layers[0]
    bpy.ops.render.render()
    layer.use_pass_vector = False
    layer.drgs.use_pass_previous_position = True
    bpy.ops.render.render()
    layer.drgs.use_pass_previous_position = False
    bpy.ops.render.render()
    assert [(f.previous is None, f.next is None) for f in captured] == [(False, False), (False, True), (True, True)]


def test_a_frame_is_the_same_whatever_was_rendered_before(moving, captured):
    """What the engine is told of frames 3 and 2 when they are rendered alone, and within an animation."""
    encode = part("drgs_blender.ipc.codec").encode_frame
    for number in (3, 2):
        moving.frame_set(number)
        bpy.ops.render.render()
    moving.frame_start, moving.frame_end = 1, 3
    bpy.ops.render.render(animation=True)
    alone, animated = captured[:2][::-1], captured[3:]
    for a, b in zip(alone, animated):
        (first, arrays), (second, others) = encode(a), encode(b)
        assert first == second and arrays.keys() == others.keys()
        for slot, array in arrays.items():
            np.testing.assert_array_equal(array, others[slot], slot)
    # What was now is what was before, one frame later.
    two, three = animated
    np.testing.assert_array_equal(three.previous.camera.matrix_world, two.camera.matrix_world)
    np.testing.assert_array_equal(three.previous.objects[0].vertices, two.objects[0].vertices)
    np.testing.assert_array_equal(two.next.meshes[0].matrices, three.meshes[0].matrices)
    assert three.previous.meshes[0].vertices is None, "what keeps its shape is not sent again"


def test_the_scene_is_at_its_frame_afterwards(moving, captured):
    moving.frame_set(3)
    bpy.ops.render.render()
    assert moving.frame_current == 3
    assert captured[0].noise_index == 3


def test_what_comes_and_goes_stands_still(moving, captured):
    """An object that is hidden in the frames around, and one whose vertices change their number."""
    twin = moving.objects["Twin"]
    for number, hidden in ((2, True), (3, False), (4, True)):
        twin.hide_render = hidden
        twin.keyframe_insert("hide_render", frame=number)
    array = moving.objects["Cube"].modifiers.new("Array", "ARRAY")
    for number in (2, 3, 4):
        array.count = number
        array.keyframe_insert("count", frame=number)
    moving.frame_set(3)
    bpy.ops.render.render()
    frame = captured[0]
    twins = next(i for i, mesh in enumerate(frame.meshes) if len(mesh.matrices) == 2)
    moved = (frame.previous.meshes[twins].matrices != frame.meshes[twins].matrices).any(axis=(1, 2))
    assert sorted(moved) == [False, True]
    cube = next(i for i, mesh in enumerate(frame.meshes) if mesh.name == "Cube")
    assert frame.previous.meshes[cube].vertices.shape != frame.meshes[cube].vertices.shape


def test_one_switch_adds_what_temporal_denoising_needs(moving, captured):
    moving.drgs.use_denoising_data, moving.drgs.denoise = True, "svgf"
    moving.view_layers[0].use_pass_vector = False
    bpy.ops.render.render()
    assert set(captured[0].passes) >= set(part("drgs_blender.core.passes").TEMPORAL)
    assert captured[0].settings.denoise == "none"
    assert captured[0].previous is not None
