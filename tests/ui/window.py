"""A job in a window: the extension is installed from its zip, Blender runs the job, photographs are taken.

Without a display Xvfb is started. The job is a script that uses `hands`; it ends with a file of what it found.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tools"), str(ROOT / "bench")]

import dev  # noqa: E402
import extension  # noqa: E402
from bench_viewport import blender_command, display  # noqa: E402
from subjects import asset_path  # noqa: E402

INSTALL = """
import bpy
bpy.ops.extensions.package_install_files(filepath={!r}, repo="user_default", enable_on_install=True)
bpy.context.preferences.view.show_splash = False
bpy.ops.wm.save_userpref()
"""
#: Photographs lie here, in a folder for each version of Blender.
PICTURES = ROOT / "out" / "ui"


@dataclass(slots=True)
class Seen:
    """What a job found, all that Blender printed, and who was its process."""

    result: dict
    log: str
    pid: int
    pictures: Path

    def photograph(self, name: str) -> np.ndarray:
        """(h, w, 3) float32 in [0, 1]; the test is skipped where there is none."""
        if not shutil.which("import"):
            pytest.skip("no photographs without ImageMagick")
        return picture(self.pictures / f"{name}.png")


def picture(path: Path | str) -> np.ndarray:
    """(h, w, 3) float32 in [0, 1] of an image file."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), np.float32) / 255


def run(job: str, folder: Path, seconds: float = 1800, **variables: str) -> Seen:
    """Run the script `job` of this folder in the window; skip where there is no Blender or no display."""
    if reason := dev.no_window():
        pytest.skip(reason)
    command = blender_command()
    said = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=180).stdout
    pictures = PICTURES / said.split()[1]  # Blender 5.0.1 ...
    pictures.mkdir(parents=True, exist_ok=True)
    archive = extension.build(folder / "drgs.zip")
    with display() as screen:
        environment = os.environ | screen | {"BLENDER_USER_RESOURCES": str(folder / "user")} | variables
        environment |= {"DRGS_WINDOW_JOB": str(folder), "DRGS_WINDOW_ASSET": str(asset_path("robot"))}
        environment.setdefault("DRGS_ENGINE", sys.executable)
        with (folder / "log.txt").open("w") as out:
            install = [*command, "-b", "--python-expr", INSTALL.format(str(archive))]
            subprocess.run(install, env=environment, stdout=out, stderr=out, timeout=180)
            window = [*command, "--gpu-backend", "opengl", "--window-geometry", "0", "0", "1280", "800"]
            script = ["--enable-event-simulate", "--python", str(Path(__file__).parent / job)]
            running = subprocess.Popen([*window, *script], env=environment, stdout=out, stderr=out)
            try:
                _follow(running, folder, environment, seconds, pictures)
                running.wait(60)
            finally:
                if running.poll() is None:
                    running.kill()
                running.wait()
    log = (folder / "log.txt").read_text(errors="replace")
    return Seen(json.loads((folder / "result.json").read_text()), log, running.pid, pictures)


def _follow(
    running: subprocess.Popen, folder: Path, environment: dict[str, str], seconds: float, pictures: Path
) -> None:
    """Take the photographs that the job asks for, until it has ended."""
    camera = shutil.which("import")
    end = time.monotonic() + seconds
    while not (folder / "result.json").exists():
        log = (folder / "log.txt").read_text(errors="replace")
        assert running.poll() is None and time.monotonic() < end, f"the window did not come to its end:\n{log[-3000:]}"
        for request in folder.glob("*.photo"):
            if camera:
                picture = pictures / f"{request.stem}.png"
                subprocess.run([camera, "-window", "root", str(picture)], env=environment, check=True, timeout=60)
            request.unlink()
        time.sleep(0.1)
