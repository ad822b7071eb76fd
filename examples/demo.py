"""The main job, end to end: make and import assets, rig them in Blender, relight and render 24 frames.

    .venv/bin/python examples/demo.py [--out out/demo] [--frames 1-24]

Writes the assets, the .blend, an EXR a frame, a contact sheet (PNG) and an animated picture (WebP).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

from drgs_blender.colour import linear_to_srgb
from drgs_blender.render.picture.frames import read_frame

ROOT = Path(__file__).resolve().parent.parent
BIN = "Scripts" if sys.platform == "win32" else "bin"
EXE = ".exe" if sys.platform == "win32" else ""


def run(*command: object) -> None:
    print("$", *command, flush=True)
    subprocess.run([str(c) for c in command], check=True, timeout=900)


def to_picture(linear: np.ndarray) -> Image.Image:
    """Linear Rec.709 -> 8-bit sRGB."""
    return Image.fromarray((linear_to_srgb(np.clip(linear[..., :3], 0, 1)) * 255 + 0.5).astype(np.uint8))


def publish(frames: list[Path], out: Path, fps: int = 24) -> None:
    pictures = [to_picture(read_frame(path)[0]["Combined"]) for path in frames]
    chosen = pictures[:: max(1, len(pictures) // 8)][:8]
    width, height = chosen[0].size
    sheet = Image.new("RGB", (width * 4, height * ((len(chosen) + 3) // 4)))
    for i, picture in enumerate(chosen):
        sheet.paste(picture, (i % 4 * width, i // 4 * height))
    sheet.save(out / "contact-sheet.png")
    pictures[0].save(
        out / "animation.webp", save_all=True, append_images=pictures[1:], duration=1000 // fps, loop=0, quality=90
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "demo")
    parser.add_argument("--frames", default="1-24")
    options = parser.parse_args()
    begin = time.perf_counter()
    out = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    drgs = [sys.executable, "-m", "drgs_blender.cli.main"]
    examples = ROOT / "examples"
    run(*drgs, "make", examples / "robot/RobotExpressive.glb", "--out", out / "robot.drgs")
    run(*drgs, "make", examples / "helmet/FlightHelmet.gltf", "--out", out / "helmet.drgs")
    run(*drgs, "import", examples / "playbot/playbot.ply", "--up=-y", "--out", out / "playbot.drgs")
    run(sys.executable, ROOT / "tools/extension.py", "--out", out / "extension.zip")
    blender = os.environ.get("DRGS_BLENDER", ROOT / ".venv-blender" / BIN / f"python{EXE}")
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(out / "blender"), "DRGS_ENGINE": sys.executable}
    os.environ.update(environment)
    run(blender, "-P", examples / "demo_scene.py", out / "extension.zip", out, out / "demo.blend")
    run(*drgs, "render", out / "demo.blend", "--frames", options.frames, "--out", out / "frames/####.exr",
        "--denoise", "svgf")  # fmt: skip
    publish(sorted((out / "frames").glob("*.exr")), out)
    print(
        f"Done in {time.perf_counter() - begin:.0f} s. Look at {out / 'contact-sheet.png'} and {out / 'animation.webp'}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
