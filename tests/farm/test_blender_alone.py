"""Blender alone with the extension, as by `blender -b SCENE -a`: the frames of `drgs render`, and faults told."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import OpenEXR
import psutil
import pytest
from processes import all_gone, children

from drgs_blender.cli.find_blender import CHECKOUT, find_blender
from drgs_blender.render.film.frame_files import read_frame

from .conftest import WHOLE

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

#: Factory settings and no preferences: what the engine is, a variable alone says.
BEGIN = """
import os, runpy, sys, tempfile
import bpy
job = runpy.run_path({checkout!r} + "/drgs_blender/cli/blender_job.py")
bpy.ops.wm.read_factory_settings(use_empty=True)
repository = tempfile.mkdtemp(prefix="repository-")
os.symlink({checkout!r}, repository + "/drgs", target_is_directory=True)
package = job["enable_extension"](repository)
def opened():
    bpy.ops.wm.open_mainfile(filepath={scene!r}, load_ui=False)
    scene = bpy.context.scene
    scene.render.engine = "DRGS"
    image = scene.render.image_settings
    image.file_format, image.color_depth, image.color_mode, image.exr_codec = "OPEN_EXR", "32", "RGBA", "ZIP"
    return scene
"""
ANIMATION = """
scene = opened()
scene.frame_start, scene.frame_end, scene.frame_step = 1, 3, 2
scene.render.filepath = {out!r} + "/####"
scene.drgs.samples = {samples}
bpy.ops.render.render(animation=True)
"""
END = """
sys.stdout.flush()
os._exit(0)
"""


def begin(scene: Path, tmp_path: Path, body: str, **environment: str) -> subprocess.Popen[str]:
    """A Blender in which `body` runs."""
    script = tmp_path / "script.py"
    script.write_text(BEGIN.format(checkout=str(CHECKOUT), scene=str(scene)) + body + END)
    environment = os.environ | {"DRGS_ENGINE": sys.executable, "TMPDIR": str(tmp_path)} | environment
    command, pipe = find_blender().command(script), subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True)


def animate(
    scene: Path, out: Path, tmp_path: Path, samples: int = 4, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Frames 1 and 3 of `scene`, rendered and written by Blender."""
    process = begin(scene, tmp_path, ANIMATION.format(out=str(out), samples=samples), **environment)
    try:
        said, errors = process.communicate(timeout=400)  # the first may compile kernels
    finally:
        process.kill()
    return subprocess.CompletedProcess(process.args, process.returncode, said, errors)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["relative.blend", "blurred.blend"])
def test_animation_rendered_by_blender_has_the_same_bits(drgs, folder, tmp_path, scene):
    own, blender = tmp_path / "drgs", tmp_path / "blender"
    result = animate(folder / scene, blender, tmp_path)
    assert drgs("render", folder / scene, "--frames", "1-3x2", "--out", own / "####.exr")[0] == 0
    names = ["0001.exr", "0003.exr"]
    assert sorted(path.name for path in own.iterdir()) == names
    assert sorted(path.name for path in blender.iterdir()) == names, result.stdout + result.stderr
    for name in names:
        assert np.array_equal(written_by_blender(blender / name), read_frame(own / name)[0]["Combined"])


@pytest.mark.slow
def test_failures_end_a_blender_on_a_farm_with_their_code(folder, tmp_path):
    scene = shutil.copy(folder / "relative.blend", tmp_path)  # without its asset
    result = animate(scene, tmp_path / "out", tmp_path, DRGS_FARM="1")
    assert (result.returncode, result.stdout.splitlines()[-1]) == (65, "DRGS_EXIT class=bad-asset")
    assert "tile.drgs" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_frame_that_blender_writes_on_a_full_disk_does_not_stay(folder, tmp_path, small_disk):
    """Blender says that it is saved, and takes the empty file for a finished frame the next time."""
    disk = small_disk("size=16k")
    (disk / "filler").write_bytes(bytes(16 << 10))
    result = animate(folder / "relative.blend", disk, tmp_path, DRGS_FARM="1")
    assert (result.returncode, result.stdout.splitlines()[-1]) == (73, "DRGS_EXIT class=cannot-write")
    assert [path.name for path in disk.iterdir()] == ["filler"]


@pytest.mark.slow
@pytest.mark.parametrize("pages", [1, 4, 16])
def test_frame_that_finds_room_for_a_part_of_it_does_not_stay(folder, tmp_path, small_disk, pages):
    disk = small_disk(f"size={4 * pages + 4}k")
    (disk / "filler").write_bytes(bytes(4 << 10))
    result = animate(folder / "large.blend", disk, tmp_path, DRGS_FARM="1")
    assert (result.returncode, result.stdout.splitlines()[-1]) == (73, "DRGS_EXIT class=cannot-write")
    assert [path.name for path in disk.iterdir()] == ["filler"]


def engines_of(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of the engines of a Blender."""
    return [pid for pid, line in children(process.pid).items() if "drgs_blender.engine" in line]


@pytest.mark.slow
@linux
@pytest.mark.parametrize(("deaths", "code"), [(2, 0), (3, 75)])
def test_two_engines_may_die_of_a_frame(folder, tmp_path, deaths, code):
    """As under `drgs render`: the third death gives the frame back."""
    scene, samples = folder / "relative.blend", 8192
    body = ANIMATION.format(out=str(tmp_path / "shaken"), samples=samples).replace("= 1, 3, 2", "= 1, 1, 1")
    process = begin(scene, tmp_path, body, DRGS_FARM="1")
    killed: set[int] = set()
    try:
        while len(killed) < deaths:
            assert process.poll() is None
            for pid in set(engines_of(process)) - killed:
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
            time.sleep(0.02)
        said, errors = process.communicate(timeout=400)  # the first may compile kernels
    finally:
        process.kill()
    assert process.returncode == code, errors
    if code:
        assert said.splitlines()[-1] == "DRGS_EXIT class=retry" and not (tmp_path / "shaken").exists()
    else:
        assert animate(scene, tmp_path / "calm", tmp_path, samples).returncode == 0
        calm, shaken = (written_by_blender(tmp_path / name / "0001.exr") for name in ("calm", "shaken"))
        assert np.array_equal(calm, shaken)


@pytest.mark.slow
@linux
@pytest.mark.parametrize("attempt", range(20 if WHOLE else 1))
def test_killed_blender_takes_its_engine_along(folder, tmp_path, attempt):
    shared = set(os.listdir("/dev/shm"))
    process = begin(folder / "large.blend", tmp_path, ANIMATION.format(out=str(tmp_path / "out"), samples=65536))
    try:
        while not (found := engines_of(process)):
            assert process.poll() is None
            time.sleep(0.02)
        (engine,) = found
        while psutil.Process(engine).cpu_times().user < 2 + 0.1 * attempt:
            time.sleep(0.02)
    finally:
        process.kill()
        process.communicate()
    assert all_gone([engine], 2) and set(os.listdir("/dev/shm")) <= shared
    # Blender leaves a folder of its own where it is killed.
    left = {path.name.split("-")[0].split("_")[0] for path in tmp_path.iterdir()}
    assert left <= {"script.py", "repository", "blender"}


#: What an artist does a hundred times between two pictures of one frame; the engine stays the same one.
ARTIST = """
import importlib
link = importlib.import_module(package + ".addon.engine_link")
def picture(name):
    scene = bpy.context.scene
    scene.render.filepath = {out!r} + "/" + name
    bpy.ops.render.render(write_still=True)
    engines.add(link.client().pid)
engines = set()
opened()
picture("before.exr")
{body}
picture("after.exr")
assert len(engines) == 1, engines
"""
UNDO = """
def height():
    return round(bpy.data.objects["tile"].scale.z, 3)
bpy.ops.ed.undo_push(message="begin")
for k in range({count}):
    bpy.data.objects["tile"].scale.z = 0.125 * (k % 3 + 1)
    bpy.ops.ed.undo_push(message="moved")
    if k % 10 == 0:
        picture("moved.exr")
    bpy.ops.ed.undo()
    assert height() == 1
    bpy.ops.ed.redo()
    assert height() == 0.125 * (k % 3 + 1)
    bpy.ops.ed.undo()
"""
RELOAD = """
for k in range({count}):
    bpy.data.objects["tile"].scale.z = 0.5
    if k % 5 == 0:
        picture("moved.exr")
    opened()
"""


@pytest.mark.slow
@pytest.mark.parametrize(("body", "few", "many"), [(UNDO, 12, 200), (RELOAD, 5, 50)], ids=["undo", "reload"])
def test_a_picture_is_the_same_after_all_that_was_taken_back(folder, tmp_path, body, few, many):
    out = tmp_path / "out"
    out.mkdir()
    body = ARTIST.format(out=str(out), body=body.format(count=many if WHOLE else few))
    process = begin(folder / "relative.blend", tmp_path, body)
    said, errors = process.communicate(timeout=3000 if WHOLE else 400)
    assert process.returncode == 0, said + errors
    before, moved, after = (written_by_blender(out / f"{name}.exr") for name in ("before", "moved", "after"))
    assert np.array_equal(before, after) and not np.array_equal(before, moved)


#: The extension is switched off while its picture is rendered, and on again.
DISABLE = """
import addon_utils, importlib, threading, time
out, count = {out!r}, {count}
def picture(rays, name=""):
    scene = opened()
    scene.drgs.samples = rays
    scene.render.filepath = out + "/" + name
    try:
        bpy.ops.render.render(write_still=bool(name))
    except RuntimeError as error:
        print("told", error)
def disable(wait):
    link = importlib.import_module(package + ".addon.engine_link")
    while not (link.is_running() and not link._client._child.idle.is_set()):
        time.sleep(0.01)
    time.sleep(wait)
    began.append(time.monotonic())
    addon_utils.disable(package)
picture(4, "before.exr")
for k in range(count):
    began = []
    thread = threading.Thread(target=disable, args=(0.1 + 0.05 * k,))
    thread.start()
    picture(65536)
    assert began and time.monotonic() - began[0] < 10, "it was rendered to its end"
    thread.join()
    assert not hasattr(bpy.types.Scene, "drgs")
    assert addon_utils.enable(package) is not None
picture(4, "after.exr")
"""


@pytest.mark.slow
@linux
def test_extension_may_be_switched_off_while_it_renders(folder, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    process = begin(folder / "large.blend", tmp_path, DISABLE.format(out=str(out), count=20 if WHOLE else 2))
    said, errors = process.communicate(timeout=3000 if WHOLE else 400)
    assert process.returncode == 0, said + errors
    assert np.array_equal(*(written_by_blender(out / f"{name}.exr") for name in ("before", "after")))


def written_by_blender(path: Path) -> np.ndarray:
    """(h, w, 4) float32 of a picture with one layer."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        return np.stack([channels[name].pixels for name in "RGBA"], axis=-1)
