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


def test_a_file_beside_the_photographs_stands_for_their_folder(scene, capture):
    folder, _ = capture
    for name in ("transforms.json", "cover.jpg"):
        (folder / name).touch()
        assert bpy.ops.drgs.import_cameras(filepath=str(folder / name)) == {"FINISHED"}
    with pytest.raises(RuntimeError, match="images: is no capture"):
        bpy.ops.drgs.import_cameras(filepath=str(folder / "images" / "photo_0.png"))


@pytest.mark.skipif(os.name == "nt", reason="a shell script stands for a Python without DR-GS")
def test_a_python_without_the_engine_is_named(scene, capture, tmp_path, monkeypatch):
    bare = tmp_path / "python"
    bare.write_text(f'#!/bin/sh\nexec "{sys.executable}" -I -S "$@"\n')
    bare.chmod(0o755)
    monkeypatch.setenv("DRGS_ENGINE", str(bare))
    with pytest.raises(RuntimeError, match=r"python cannot run it \(ModuleNotFoundError.*Set Up Engine"):
        bpy.ops.drgs.import_cameras(filepath=str(capture[0]))


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
