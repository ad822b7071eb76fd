"""The rendered viewport in a real window: time to the first picture after a change, and what a redraw takes.

    DRGS_UI_BLENDER="path/to/blender" python bench/bench_viewport.py

Needs a Blender with a window: the command in DRGS_UI_BLENDER (it may have arguments), else ``blender`` of the PATH;
without one it says so and ends. Where there is no display, it starts Xvfb and draws with software OpenGL.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from report import ROOT, table, write_section
from subjects import SOURCES, asset_path

BENCH = Path(__file__).resolve().parent
ENABLE = """
import bpy
bpy.ops.preferences.addon_enable(module='bl_ext.user_default.drgs')
bpy.context.preferences.view.show_splash = False
bpy.ops.wm.save_userpref()
"""


def blender_command() -> list[str] | None:
    """The Blender to measure, or None."""
    given = os.environ.get("DRGS_UI_BLENDER")
    if given:
        return shlex.split(given)
    found = shutil.which("blender")
    return [found] if found else None


@contextlib.contextmanager
def display() -> Iterator[dict[str, str] | None]:
    """Environment with a display, one of its own where there is none; None where that cannot be had."""
    if os.environ.get("DISPLAY") or sys.platform != "linux":
        yield {}
        return
    program = shutil.which("Xvfb")
    if program is None:
        yield None
        return
    reading, writing = os.pipe()
    server = subprocess.Popen(
        [program, "-displayfd", str(writing), "-screen", "0", "1280x800x24", "+extension", "GLX", "-noreset"],
        pass_fds=[writing],
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as pipe:
            number = pipe.readline().strip()
        yield {"DISPLAY": f":{number}", "LIBGL_ALWAYS_SOFTWARE": "1"}
    finally:
        server.terminate()
        server.wait()


def measure(command: list[str], asset: Path, screen: dict[str, str], repeats: int, seconds: float) -> dict:
    """Run the job in a window of 640 x 360 pixels."""
    with tempfile.TemporaryDirectory(prefix="drgs-viewport-") as folder:
        extensions = Path(folder, "extensions", "user_default")
        extensions.mkdir(parents=True)
        (extensions / "drgs").symlink_to(ROOT, target_is_directory=True)
        job = Path(folder, "job.json")
        job.write_text(json.dumps({"asset": str(asset), "repeats": repeats, "seconds": seconds, "patience": 240}))
        environment = os.environ | screen | {"BLENDER_USER_RESOURCES": folder, "DRGS_VIEWPORT_JOB": str(job)}
        environment.setdefault("DRGS_ENGINE", sys.executable)
        log = Path(folder, "log.txt")
        with log.open("w") as out:
            prepared = subprocess.run(
                [*command, "-b", "--python-expr", ENABLE], env=environment, stdout=out, stderr=out, timeout=180
            )
            window = [*command, "--gpu-backend", "opengl", "--window-geometry", "0", "0", "640", "360"]
            running = subprocess.Popen(
                [*window, "--python", str(BENCH / "viewport_job.py")], env=environment, stdout=out, stderr=out
            )
            try:
                end = time.monotonic() + 900
                while not job.with_suffix(".result").exists():
                    if running.poll() is not None or time.monotonic() > end:
                        raise SystemExit(f"Blender ended early ({prepared.returncode}):\n{log.read_text()[-3000:]}")
                    time.sleep(0.2)
                result = json.loads(job.with_suffix(".result").read_text())
                running.wait(30)
            finally:
                if running.poll() is None:
                    running.kill()
                    running.wait()
    if "error" in result:
        raise SystemExit(result["error"])
    return result


def rows_of(result: dict) -> list[list[object]]:
    """Figure, median, 99th percentile; milliseconds."""
    names = {"turn": "the view turns", "move": "the object moves", "light": "the world changes", "bend": "a shape key"}
    rows: list[list[object]] = []
    for name, text in names.items():
        values = 1000 * np.array(result["latencies"][name])
        rows.append([f"first picture, {text}", float(np.median(values)), float(values.max())])
        for stage in ("deform", "light", "render", "worker"):
            parts = [1000 * s.get(f"seconds.{stage}", 0.0) for s in result["engine"][name]]
            rows.append([f"first picture, {text}: of these {stage}", float(np.median(parts)), float(max(parts))])
    for name in ("redraws while changing", "redraws while turning, rendered", "redraws while turning, composited"):
        wall, work, new = np.array(result[name]).T * [[1000], [1000], [1]]
        rows.append([f"{name}, wall", float(np.median(wall)), float(np.percentile(wall, 99))])
        rows.append([f"{name}, work of Blender's thread", float(np.median(work)), float(np.percentile(work, 99))])
        for text, part in (("with a new picture", work[new > 0]), ("without one", work[new == 0])):
            rows.append([f"{name}, work {text}", float(np.median(part)), float(np.percentile(part, 99))])
        rows.append([f"{name}, share with a new picture", float(new.mean()), ""])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--subject", choices=sorted(SOURCES), default="robot")
    parser.add_argument("--repeats", type=int, default=20, help="changes of each kind")
    parser.add_argument("--seconds", type=float, default=5.0, help="of turning without a pause")
    parser.add_argument("--dry", action="store_true", help="print, and leave docs/benchmarks.md as it is")
    args = parser.parse_args()
    command = blender_command()
    with display() as screen:
        if command is None or screen is None:
            print("skipped:", "no Blender program (set DRGS_UI_BLENDER)" if command is None else "no display, no Xvfb")
            return
        result = measure(command, asset_path(args.subject), screen, args.repeats, args.seconds)
    width, height = result["size"]
    rates, last = (
        [result[f"pictures a second, {n}"] for n in ("rendered", "composited")],
        result["seconds to the last sample"],
    )
    body = (
        f"Blender {result['blender']}, {args.subject}, a viewport of {width} x {height} pixels"
        f"{', software OpenGL on the same cores' if 'LIBGL_ALWAYS_SOFTWARE' in screen else ''}. While the view turns "
        f"without a pause, {rates[0]:.1f} pictures a second ({rates[1]:.1f} composited into Solid shading); {last:.2f} "
        "s from the last change to the last of 32 rays.\n\n"
        + table(["milliseconds", "median", "worst of the changes, 99th percentile of redraws"], rows_of(result))
    )
    if args.dry:
        print(body)
    else:
        write_section("viewport", "The rendered viewport", body)


if __name__ == "__main__":
    main()
