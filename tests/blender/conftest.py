"""Blender as a module with the extension installed from its zip, as a user installs it."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Blender looks for its user folder when it is imported.
USER_FOLDER = os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="drgs-blender-")
BINARY = "Scripts/python.exe" if os.name == "nt" else "bin/python"
os.environ.setdefault("DRGS_ENGINE", str(ROOT / ".venv" / BINARY))
sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "tools")]

import bpy  # noqa: E402
import extension  # noqa: E402
from scenes import PACKAGE, part, write_ball  # noqa: E402

_exit_code = 0


def pytest_configure(config: pytest.Config) -> None:
    """Build the zip and install it."""
    archive = extension.build(Path(USER_FOLDER) / "drgs.zip")
    bpy.ops.extensions.package_install_files(filepath=str(archive), repo="user_default", enable_on_install=True)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    global _exit_code
    _exit_code = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """Disable the extension, then leave at once: Blender 4.2 as a module crashes when Python tidies up after it."""
    bpy.ops.preferences.addon_disable(module=PACKAGE)
    shutil.rmtree(USER_FOLDER, ignore_errors=True)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(_exit_code)


@pytest.fixture
def scene(tmp_path):
    """An empty, saved scene with the render engine DR-GS, a camera five metres in front (-Y), and 64 x 48 pixels."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.render.engine = "DRGS"
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location, camera.rotation_euler = (0, -5, 0), (np.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    settings = scene.drgs
    settings.use_strategy_samples, settings.cosine_samples, settings.ggx_samples, settings.environment_samples = (
        True,
        2,
        1,
        1,
    )
    settings.subpixel_samples, settings.denoise = 1, "none"
    image = scene.render.image_settings
    image.file_format, image.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(tmp_path / "out.exr")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    return scene


@pytest.fixture(scope="session")
def kept_blenders():
    """Processes that have baked, for the next test (`kept_blender`); they end with the suite."""
    kept: list = []
    yield kept
    for process in kept:
        process.close()


@pytest.fixture
def ball_file(tmp_path):
    """Path of a .drgs file: a sphere of radius 1 with surfels."""
    return write_ball(tmp_path / "assets" / "ball.drgs")


@pytest.fixture
def ball(scene, ball_file):
    """The imported sphere."""
    bpy.ops.import_scene.drgs(filepath=str(ball_file))
    return bpy.context.active_object


@pytest.fixture
def body(ball):
    """The sphere as matter, coarse and soft, that falls for a few frames."""
    from physics_scenes import FRAMES  # the extension is not installed before

    physics = ball.drgs.physics
    physics.use = True
    physics.youngs_modulus, physics.resolution, physics.frame_end = 2e4, 8, FRAMES
    return ball


@pytest.fixture
def export():
    """Function that exports the current scene as the viewport evaluates it; returns (frame, warnings)."""
    export_frame = part("addon.export").export_frame

    def run():
        warnings: list[str] = []
        return export_frame(bpy.context.evaluated_depsgraph_get(), str, warnings.append), warnings

    return run


@pytest.fixture
def captured(monkeypatch):
    """F12 without the engine: list of the frames that it was asked for; the pictures are grey."""
    frames: list = []
    link, protocol = part("addon.engine_link"), part("drgs_blender.ipc.protocol")
    table = part("drgs_blender.core.passes").BY_NAME

    def render(frame, on_progress=None, cancelled=None):
        frames.append(frame)
        x0, y0, x1, y1 = frame.camera.window
        shapes = {name: (y1 - y0, x1 - x0, len(table[name].channels)) for name in frame.passes}
        return protocol.Passes({name: np.full(shape, 0.5, np.float32) for name, shape in shapes.items()}, [], {})

    monkeypatch.setattr(link, "render", render)
    monkeypatch.setattr(link, "load_asset", lambda path, cancelled=None: str(path))
    return frames
