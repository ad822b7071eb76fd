"""Blender alone with the extension, as by `blender -b SCENE -a`: the frames of `drgs render`, and faults told."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR

from drgs_blender.cli.find_blender import CHECKOUT, find_blender
from drgs_blender.render.picture.frames import read_frame

#: Factory settings and no preferences: what the engine is, a variable alone says.
ANIMATION = """
import os, runpy, sys, tempfile
import bpy
job = runpy.run_path({checkout!r} + "/drgs_blender/cli/blender_job.py")
bpy.ops.wm.read_factory_settings(use_empty=True)
with tempfile.TemporaryDirectory() as repository:
    os.symlink({checkout!r}, repository + "/drgs", target_is_directory=True)
    job["enable_extension"](repository)
    bpy.ops.wm.open_mainfile(filepath={scene!r}, load_ui=False)
    scene = bpy.context.scene
    scene.render.engine = "DRGS"
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 3, 2
    scene.render.filepath = {out!r}
    image = scene.render.image_settings
    image.file_format, image.color_depth, image.color_mode, image.exr_codec = "OPEN_EXR", "32", "RGBA", "ZIP"
    bpy.ops.render.render(animation=True)
sys.stdout.flush()
os._exit(0)
"""


def animate(scene: Path, out: Path, tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Frames 1 and 3 of `scene`, rendered and written by Blender."""
    script = tmp_path / "animation.py"
    script.write_text(ANIMATION.format(checkout=str(CHECKOUT), scene=str(scene), out=str(out / "####")))
    environment = os.environ | {"DRGS_ENGINE": sys.executable} | environment
    command = find_blender().command(script)
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)


def test_animation_rendered_by_blender_has_the_same_bits(drgs, folder, tmp_path):
    own, blender = tmp_path / "drgs", tmp_path / "blender"
    result = animate(folder / "relative.blend", blender, tmp_path)
    assert drgs("render", folder / "relative.blend", "--frames", "1-3x2", "--out", own / "####.exr")[0] == 0
    names = ["0001.exr", "0003.exr"]
    assert sorted(path.name for path in own.iterdir()) == names
    assert sorted(path.name for path in blender.iterdir()) == names, result.stdout + result.stderr
    for name in names:
        assert np.array_equal(written_by_blender(blender / name), read_frame(own / name)[0]["Combined"])


def test_failures_end_a_blender_on_a_farm_with_their_code(folder, tmp_path):
    scene = shutil.copy(folder / "relative.blend", tmp_path)  # without its asset
    result = animate(scene, tmp_path / "out", tmp_path, DRGS_FARM="1")
    assert (result.returncode, result.stdout.splitlines()[-1]) == (65, "DRGS_EXIT class=bad-asset")
    assert "tile.drgs" in result.stderr
    assert not (tmp_path / "out").exists()


def test_frame_that_blender_writes_on_a_full_disk_does_not_stay(folder, tmp_path, small_disk):
    """Blender says that it is saved, and takes the empty file for a finished frame the next time."""
    disk = small_disk("size=16k")
    (disk / "filler").write_bytes(bytes(16 << 10))
    result = animate(folder / "relative.blend", disk, tmp_path, DRGS_FARM="1")
    assert (result.returncode, result.stdout.splitlines()[-1]) == (73, "DRGS_EXIT class=cannot-write")
    assert [path.name for path in disk.iterdir()] == ["filler"]


def written_by_blender(path: Path) -> np.ndarray:
    """(h, w, 4) float32 of a picture with one layer."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        return np.stack([channels[name].pixels for name in "RGBA"], axis=-1)
