"""Small Blender files with an asset, as a user would save them."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.cli.find_blender import CHECKOUT, find_blender
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import DeviceError
from drgs_blender.deform.attach import attach

BUILD = """
import importlib, os, runpy, sys, tempfile
from pathlib import Path
import bpy
checkout, folder = {checkout!r}, Path({folder!r})
job = runpy.run_path(checkout + "/drgs_blender/cli/blender_job.py")
bpy.ops.wm.read_factory_settings(use_empty=True)
with tempfile.TemporaryDirectory() as repository:
    os.symlink(checkout, repository + "/drgs", target_is_directory=True)
    package = job["enable_extension"](repository)
    importlib.import_module(package + ".operators.import_asset").import_assets(bpy.context, [folder / "tile.drgs"])
scene = bpy.context.scene
tile = bpy.context.object
tile.keyframe_insert("location", frame=1)
tile.location.x = 1
tile.keyframe_insert("location", frame=3)
hidden = tile.copy()
hidden.name, hidden.hide_render, hidden.location.z = "Hidden", True, 1
hidden.animation_data_clear()
scene.collection.objects.link(hidden)
camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
camera.location, camera.rotation_euler = (0, -6, 0), (1.5707963, 0, 0)
scene.collection.objects.link(camera)
scene.camera = camera
scene.world = bpy.data.worlds.new("World")
scene.world.use_nodes = True
scene.render.engine = "BLENDER_WORKBENCH"
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 64, 48, 50
scene.drgs.samples = 4
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
scene.render.resolution_percentage = 1000
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "large.blend"))
scene.render.resolution_percentage = 50
text = bpy.data.texts.new("stop.py")
text.write("import os; os._exit(9)")
text.use_module = True
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "script.blend"))
text.from_string("import bpy, time; bpy.app.handlers.frame_change_pre.append(lambda *_: time.sleep(30))")
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "slow.blend"))
bpy.data.texts.remove(text)
scene.view_layers[0].use_pass_cryptomatte_asset = True
for name, path in (("gone", "//gone.png"), ("there", str(folder / "there.png"))):
    image = bpy.data.images.new(name, 4, 4)
    image.source, image.filepath, image.use_fake_user = "FILE", path, True
(folder / "there.png").write_bytes(b"not looked into")
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "faulty.blend"))
for image in list(bpy.data.images):
    bpy.data.images.remove(image)
scene.view_layers[0].use_pass_cryptomatte_asset = False
bpy.ops.file.make_paths_relative()
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "relative.blend"))
scene.render.use_motion_blur = scene.view_layers[0].use_pass_z = camera.data.dof.use_dof = True
camera.data.dof.focus_distance, camera.data.dof.aperture_fstop, scene.drgs.blur_steps = 3, 0.3, 3
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "blurred.blend"))
scene.render.use_motion_blur = scene.view_layers[0].use_pass_z = camera.data.dof.use_dof = False
scene.view_layers.new("Second layer")
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "layers.blend"))
scene.view_layers.remove(scene.view_layers["Second layer"])
scene.view_layers[0].use = False
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "layerless.blend"))
scene.view_layers[0].use = scene.render.use_border = True
scene.render.border_min_x = scene.render.border_max_x = 0.5
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "empty.blend"))
scene.render.use_border = False
scene.camera = None
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "blind.blend"))
sys.stdout.flush()
os._exit(0)
"""


def make_blend_files(folder: Path) -> None:
    """Write an asset and files that show it moving to the right from frame 1 to 3; skips without Blender."""
    try:
        blender = find_blender()
        blender.version()
    except DeviceError as error:
        pytest.skip(str(error))
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9))
    vertices = np.stack([x.ravel(), np.zeros(81), z.ravel()], axis=1)
    quads = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate([quads[:, None] + (0, 1, 10), quads[:, None] + (0, 10, 9)])
    mesh = Mesh(vertices, faces, np.full((81, 3), 0.8), np.full(81, 0.5), np.zeros(81))
    surfels, binding, _ = attach(mesh, density=30)
    write_asset(folder / "tile.drgs", Asset(surfels, mesh, binding))
    script = folder / "build.py"
    script.write_text(BUILD.format(checkout=str(CHECKOUT), folder=str(folder)))
    result = subprocess.run(blender.command(script), capture_output=True, text=True, timeout=120)
    assert (folder / "blind.blend").exists(), result.stdout + result.stderr
