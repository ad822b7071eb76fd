"""The tour in a real window, with the extension installed from its zip.

    DRGS_UI_BLENDER="path/to/blender" python -m pytest tests/ui

The command may have arguments; without it, ``blender`` of the PATH. Without a display Xvfb is started. Photographs of
the window are left in ``out/ui`` where ImageMagick's ``import`` is there: look at them.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tools"), str(ROOT / "bench")]

import extension  # noqa: E402
from bench_viewport import blender_command, display  # noqa: E402
from subjects import asset_path  # noqa: E402

INSTALL = """
import bpy
bpy.ops.extensions.package_install_files(filepath={!r}, repo="user_default", enable_on_install=True)
bpy.context.preferences.view.show_splash = False
bpy.ops.wm.save_userpref()
"""
SECONDS = 600


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[dict, str]]:
    """What the job found in the window, and all that Blender printed."""
    command, folder = blender_command(), tmp_path_factory.mktemp("window")
    if command is None:
        pytest.skip("no Blender program (set DRGS_UI_BLENDER)")
    archive = extension.build(folder / "drgs.zip")
    with display() as screen:
        if screen is None:
            pytest.skip("no display, and no Xvfb")
        environment = os.environ | screen | {"BLENDER_USER_RESOURCES": str(folder / "user")}
        environment |= {"DRGS_WINDOW_JOB": str(folder), "DRGS_WINDOW_ASSET": str(asset_path("robot"))}
        environment.setdefault("DRGS_ENGINE", sys.executable)
        with (folder / "log.txt").open("w") as out:
            install = [*command, "-b", "--python-expr", INSTALL.format(str(archive))]
            subprocess.run(install, env=environment, stdout=out, stderr=out, timeout=180)
            job = Path(__file__).with_name("window_job.py")
            window = [*command, "--gpu-backend", "opengl", "--window-geometry", "0", "0", "1280", "800"]
            running = subprocess.Popen([*window, "--python", str(job)], env=environment, stdout=out, stderr=out)
            try:
                follow(running, folder, environment)
            finally:
                if running.poll() is None:
                    running.kill()
                running.wait()
    yield json.loads((folder / "result.json").read_text()), (folder / "log.txt").read_text(errors="replace")


def follow(running: subprocess.Popen, folder: Path, environment: dict[str, str]) -> None:
    """Take the photographs that the job asks for, until it has ended."""
    camera, pictures = shutil.which("import"), ROOT / "out" / "ui"
    pictures.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + SECONDS
    while not (folder / "result.json").exists():
        log = (folder / "log.txt").read_text(errors="replace")
        assert running.poll() is None and time.monotonic() < end, f"the window did not come to its end:\n{log[-3000:]}"
        for request in folder.glob("*.photo"):
            if camera:
                picture = pictures / f"{request.stem}.png"
                subprocess.run([camera, "-window", "root", str(picture)], env=environment, check=True, timeout=60)
            request.unlink()
        time.sleep(0.1)


def test_each_step_leads_to_the_next(seen):
    result, _ = seen
    assert "error" not in result, result["error"]
    steps = ("first", "with engine", "imported", "lit", "seen", "camera")
    assert [result[s] for s in steps] == ["engine", "import", "light", "view", "render", "bind"]
    assert result["mode"] == "EDIT_LATTICE", "of lattice and cage, the lattice is what Pose goes to"
    assert not result["messages"]


def test_the_viewport_shows_the_picture(seen):
    assert seen[0]["fraction"] == 1


def test_a_file_is_written_beside_the_window(seen):
    assert seen[0]["exported"]


def test_binding_is_undone_and_redone(seen):
    result, _ = seen
    assert result["bound"] == ["DR-GS Lattice"]
    assert result["undone"] == [[], 0] and result["redone"] == [["DR-GS Lattice"], 1]


def test_nothing_fails_where_blender_only_prints_it(seen):
    """Panels that cannot be drawn, properties that are not known: Blender tells the console alone."""
    _, log = seen
    for word in ("Traceback", "rna_uiItem", "unknown operator", "Error: Python"):
        assert word not in log, log[-3000:]
