"""Cameras of photographs in Blender: they see points at the pixels that the capture says, photographs behind them."""

from __future__ import annotations

import json
import os
import sys

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from scenes import part


@pytest.fixture
def capture(tmp_path):
    """Three photographs of 80 x 60 and two of 40 x 60, off their axes, as nerfstudio has them; one lens distorts."""
    folder = tmp_path / "statue"
    (folder / "images").mkdir(parents=True)
    frames = []
    for k in range(5):
        width, height = (80, 60) if k < 3 else (40, 60)
        image = bpy.data.images.new(f"photo_{k}", width, height)
        image.filepath_raw, image.file_format = str(folder / "images" / f"photo_{k}.png"), "PNG"
        image.save()
        bpy.data.images.remove(image)
        back = np.array([np.cos(k), np.sin(k), 0.4])
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([right, np.cross(back, right), back, 3 * back])
        lens = {"w": width, "h": height, "fl_x": 90.0, "fl_y": 90.0, "cx": 0.55 * width, "cy": 0.42 * height}
        lens |= {"k1": 0.05 if k == 1 else 0.0}
        frames.append({"file_path": f"images/photo_{k}.png", "transform_matrix": matrix.tolist(), **lens})
    text = {"camera_model": "OPENCV", "orientation_override": "none", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(text))
    return folder, frames


@pytest.mark.slow
def test_a_file_of_the_capture_stands_for_its_folder(scene, capture):
    folder, _ = capture
    (folder / "sparse" / "0").mkdir(parents=True)
    for name in ("transforms.json", "cover.jpg", "images/photo_0.png", "sparse/0/cameras.bin"):
        (folder / name).touch()
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        assert bpy.ops.drgs.import_cameras(filepath=str(folder / name)) == {"FINISHED"}, name
        assert len(bpy.data.collections["Cameras of statue"].objects) == 5, name


def test_poses_of_llff_stand_for_their_folder(scene, tmp_path):
    folder = tmp_path / "fern"
    (folder / "images").mkdir(parents=True)
    rows = []
    for k in range(4):
        image = bpy.data.images.new(f"{k}", 40, 30)
        image.filepath_raw, image.file_format = str(folder / "images" / f"{k}.png"), "PNG"
        image.save()
        pose = np.column_stack([[0, -1, 0], [1, 0, 0], [0, 0, 1], [0.3 * k, 0.1 * k * k, 4], [30, 40, 50]])
        rows.append([*pose.ravel(), 1.0, 10.0])
    np.save(folder / "poses_bounds.npy", np.array(rows, float))
    assert bpy.ops.drgs.import_cameras(filepath=str(folder / "poses_bounds.npy")) == {"FINISHED"}
    assert len(bpy.data.collections["Cameras of fern"].objects) == 4


@pytest.mark.parametrize("name", ["statue.drgs", "walk.mp4", "mesh.obj"])
def test_files_of_other_kinds_are_refused(scene, capture, name):
    (capture[0] / name).write_bytes(b"v 0 0 0")
    with pytest.raises(RuntimeError, match=f"{name}: is neither a capture nor a photograph. Choose the folder"):
        bpy.ops.drgs.import_cameras(filepath=str(capture[0] / name))
    assert not bpy.data.collections


def test_a_photograph_without_a_capture_is_refused(scene, tmp_path):
    (tmp_path / "alone" / "deep" / "deeper").mkdir(parents=True)
    photo = tmp_path / "alone" / "deep" / "deeper" / "photo.png"
    photo.touch()
    with pytest.raises(RuntimeError, match="deeper: is no capture"):
        bpy.ops.drgs.import_cameras(filepath=str(photo))


def test_cameras_that_are_imported_again_are_renewed(scene, capture):
    """The same objects, as the capture now has them; nothing is there twice, what holds them keeps them."""
    folder, _ = capture
    bpy.ops.drgs.import_cameras(filepath=str(folder))
    group = bpy.data.collections["Cameras of statue"]
    before = {obj.name: obj for obj in group.objects}
    text = json.loads((folder / "transforms.json").read_text())
    text["frames"][2]["transform_matrix"][0][3] += 1.0
    text["frames"][2]["fl_x"] *= 2
    del text["frames"][4]
    (folder / "transforms.json").write_text(json.dumps(text))
    place, lens = before["photo_2"].matrix_world[0][3], before["photo_2"].data.lens
    assert bpy.ops.drgs.import_cameras(filepath=str(folder / "transforms.json")) == {"FINISHED"}
    assert len(bpy.data.collections) == 1 and {obj.name: obj for obj in group.objects} == before
    assert len(bpy.data.cameras) == 6, "five and the scene's own"
    assert before["photo_2"].matrix_world[0][3] == pytest.approx(place + 1.0)
    assert before["photo_2"].data.lens == pytest.approx(2 * lens)
    assert all(len(obj.data.background_images) == 1 for obj in group.objects)
    said = [message.text for message in part("addon.messages").history]
    assert any("4 of its cameras were there already and are renewed, 0 are new" in text for text in said)
    bpy.data.objects.remove(before["photo_1"])
    bpy.ops.drgs.import_cameras(filepath=str(folder))
    assert len(group.objects) == 5 and len(bpy.data.collections) == 1


def test_a_copy_and_pictures_of_the_user_stay_when_cameras_are_renewed(scene, capture):
    folder, frames = capture
    bpy.ops.drgs.import_cameras(filepath=str(folder))
    group = bpy.data.collections["Cameras of statue"]
    first = group.objects["photo_2"]
    copy = first.copy()
    copy.data = first.data.copy()
    group.objects.link(copy)
    copy.matrix_world.translation = (9, 9, 9)
    first.matrix_world.translation = (5, 5, 5)
    own = first.data.background_images.new()
    own.image = bpy.data.images.new("grid", 4, 4)
    bpy.ops.drgs.import_cameras(filepath=str(folder))
    bpy.context.view_layer.update()
    assert copy.matrix_world.translation[:] == (9, 9, 9)
    assert first.matrix_world.translation[:] == pytest.approx([row[3] for row in frames[2]["transform_matrix"][:3]])
    assert sorted(one.image.name for one in first.data.background_images) == ["grid", "photo_2.png"]


@pytest.mark.slow
def test_a_photograph_beside_a_capture_is_not_taken_for_it_and_damage_is_named(scene, capture):
    folder, _ = capture
    (folder / "other").mkdir()
    (folder / "other" / "lens.png").touch()
    with pytest.raises(RuntimeError, match=r"lens.png: is no photograph of the capture .*statue"):
        bpy.ops.drgs.import_cameras(filepath=str(folder / "other" / "lens.png"))
    (folder / "transforms.json").write_text('{"frames": [')
    with pytest.raises(RuntimeError) as told:
        bpy.ops.drgs.import_cameras(filepath=str(folder / "images" / "photo_0.png"))
    assert "transforms.json" in str(told.value)


@pytest.fixture
def bare_python(tmp_path, monkeypatch):
    """Path of a Python without DR-GS, which DRGS_ENGINE names."""
    if os.name == "nt":
        pytest.skip("a shell script stands for a Python without DR-GS")
    bare = tmp_path / "bare" / "python"
    bare.parent.mkdir()
    bare.write_text(f'#!/bin/sh\nexec "{sys.executable}" -I -S "$@"\n')
    bare.chmod(0o755)
    monkeypatch.setenv("DRGS_ENGINE", str(bare))
    part("addon.engine_link").stop()
    return bare


def test_a_python_without_the_engine_is_named(scene, capture, ball, bare_python):
    """By every operator that needs it: which Python, who named it, what is missing, what to do."""
    told = r"bare/python \(named in DRGS_ENGINE\): DR-GS is not installed in it \(No module named .*Set Up Engine"
    with pytest.raises(RuntimeError, match=told):
        bpy.ops.drgs.import_cameras(filepath=str(capture[0]))
    cube = bpy.data.meshes.new("cube")
    cube.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    obj = bpy.data.objects.new("cube", cube)
    scene.collection.objects.link(obj)
    bpy.context.view_layer.objects.active = obj
    with pytest.raises(RuntimeError, match=told):
        bpy.ops.drgs.convert(out=str(bare_python.parent / "cube.drgs"))
    with pytest.raises(RuntimeError, match=r"bare/python: did not start as an engine.*No module named.*DRGS_ENGINE"):
        bpy.ops.drgs.engine_test()
    submit = part("addon.submit")
    scene.drgs.submit.folder = str(bare_python.parent)
    job = submit.start(scene)
    assert "DR-GS is not installed in it" in job.error and "DRGS_ENGINE" in job.error


def test_packages_that_the_engine_lacks_are_named(monkeypatch):
    link = part("addon.engine_link")
    monkeypatch.setenv("DRGS_ENGINE", "/x/python")
    with pytest.raises(
        part("drgs_blender.core.errors").DeviceError, match="numba, which DR-GS needs, is not installed"
    ):
        link.check_installed("/x/python", "ModuleNotFoundError: No module named 'numba'")
    link.check_installed("/x/python", "drgs: torch: is not installed (No module named 'torch'). pip install torch")
    link.check_installed("/x/python", "ValueError: what else goes wrong")


def test_cameras_see_what_the_photographs_show(scene, capture):
    folder, frames = capture
    assert bpy.ops.drgs.import_cameras(filepath=str(folder)) == {"FINISHED"}
    group = bpy.data.collections["Cameras of statue"]
    assert sorted(obj.name for obj in group.objects) == [f"photo_{k}" for k in range(5)]
    assert (scene.render.resolution_x, scene.render.resolution_y) == (80, 60) and scene.camera.name == "photo_0"
    bpy.context.view_layer.update()
    rng = np.random.default_rng(3)
    for k, frame in enumerate(frames):
        obj = group.objects[f"photo_{k}"]
        (background,) = obj.data.background_images
        assert obj.data.show_background_images and background.image.name == f"photo_{k}.png"
        scene.render.resolution_x, scene.render.resolution_y = frame["w"], frame["h"]
        for point in rng.uniform(-0.4, 0.4, (4, 3)):
            x, y, z = (np.linalg.inv(frame["transform_matrix"]) @ [*point, 1])[:3]
            expected = frame["cx"] + frame["fl_x"] * x / -z, frame["cy"] - frame["fl_y"] * y / -z
            seen = world_to_camera_view(scene, obj, Vector(point))
            np.testing.assert_allclose((seen.x * frame["w"], (1 - seen.y) * frame["h"]), expected, atol=2e-3)


def test_what_blenders_cameras_cannot_show_is_told(scene, capture):
    folder, _ = capture
    bpy.ops.drgs.import_cameras(filepath=str(folder / "transforms.json"), use_pictures=False)
    said = "\n".join(message.text for message in part("addon.messages").history if message.level == "WARNING")
    assert "the lenses of 1 photographs distort" in said and "photo_1" in said and "have 2 sizes" in said
    assert not bpy.data.collections["Cameras of statue"].objects["photo_0"].data.background_images


def test_photographs_that_are_cut_off_or_gone_are_named(scene, capture):
    folder, _ = capture
    exr = scene.render.image_settings
    image = bpy.data.images.new("whole", 80, 60, float_buffer=True)
    exr.file_format = "OPEN_EXR"
    image.save_render(str(folder / "images" / "photo_0.exr"), scene=scene)
    data = (folder / "images" / "photo_0.exr").read_bytes()
    (folder / "images" / "photo_0.exr").write_bytes(data[: len(data) // 2])
    text = (folder / "transforms.json").read_text().replace("photo_0.png", "photo_0.exr")
    (folder / "transforms.json").write_text(text)
    before = scene.camera
    assert bpy.ops.drgs.import_cameras(filepath=str(folder), use_camera=False) == {"FINISHED"}
    assert scene.camera == before
    said = [message.text for message in part("addon.messages").history]
    assert any("1 photographs cannot be loaded: photo_0.exr (cut off)" in text for text in said)


def test_folders_without_cameras_are_refused(scene, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RuntimeError, match=r"empty: is no capture\. Understood: transforms"):
        bpy.ops.drgs.import_cameras(filepath=str(tmp_path / "empty"))
    assert not [group for group in bpy.data.collections if group.name.startswith("Cameras")]
