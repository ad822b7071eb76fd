"""The main job, end to end: captured objects are rigged, simulated and painted in Blender, relit and rendered.

    python3.11 tools/dev.py demo [--out out/demo] [--frames 1-24]      # or make demo, which makes the environments too
    .venv/bin/python examples/demo.py [--out out/demo] [--frames 1-24]

Writes the .blend with its simulation, an EXR per frame, a contact sheet (PNG), an animated picture (WebP), and a strip
(PNG) of what two photographs became. Steps that do not wait for each other run side by side; of a demo before, the
scene is taken where nothing changed that it is made of. Frames are always rendered again.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tools"))

import environments  # noqa: E402
from steps import Step, StepFailed, run_steps  # noqa: E402

EXAMPLES = ROOT / "examples"


def steps(out: Path, frames: str) -> list[Step]:
    """All that follows the environments; seconds are those of two processors."""
    engine, blender = environments.python_of(environments.ENGINE), environments.blender()
    drgs = [engine, "-m", "drgs_blender.cli.main"]
    extension, scene = out / "extension.zip", out / "demo.blend"

    def rendered(line: str) -> tuple[str, float] | None:
        nonlocal done
        saved = line.startswith("Saved: ")
        if not (saved or (line.startswith("Fra:") and ("| Preparing" in line or "| Sample 0/" in line))):
            return None
        done += saved
        return f"Rendering, {done} of {count} frames", done / count

    done, count = 0, _count(frames)
    building = [environments.python_of(environments.ENGINE), ROOT / "tools/extension.py", "--out", extension]
    pattern = out / "frames" / "####.exr"
    strip = [engine, EXAMPLES / "demo_strip.py", "--out", out / "strip.png"]
    setting = [blender, "-P", EXAMPLES / "demo_scene.py", extension, scene]
    of_scene = (EXAMPLES / "captured", extension, EXAMPLES / "demo_scene.py", EXAMPLES / "blender_scenes.py")
    blenders = () if os.environ.get("DRGS_BLENDER") else (environments.FOR_BLENDER,)
    return [
        # Those of the simulation first; what is not compiled when it is needed is waited for.
        environments.kernels("kernels", "simulate", "frame", "mesh", "lights", "denoise", seconds=45.0),
        Step("extension", "Building the extension", building, 0.5, (environments.FOR_ENGINE,)),
        Step("scene", "Setting the scene", setting, 20.0, ("extension", *blenders), scene, of_scene),
        Step(
            "frames",
            "Starting Blender",
            [*drgs, "render", scene, "--frames", frames, "--out", pattern, "--denoise", "svgf", "--overwrite"],
            4.0 + 2.2 * count,
            ("scene",),
            count=rendered,
            before=partial(shutil.rmtree, out / "frames", ignore_errors=True),
            measured="rendering",
        ),
        Step("strip", "Making the strip", strip, 6.0, ("kernels",)),
        Step("sheet", "Making the contact sheet", [engine, __file__, "--out", out, "--sheet"], 2.0, ("frames",)),
    ]


def _count(frames: str) -> int:
    """How many frames a range like 1-24x2,30 has."""
    found: set[int] = set()
    for part in frames.split(","):
        span, _, stride = part.partition("x")
        first, _, last = span.partition("-")
        found.update(range(int(first), int(last or first) + 1, int(stride or 1)))
    return max(len(found), 1)


def run(out: Path, frames: str, before: Sequence[Step] = ()) -> None:
    """Run the demo after the steps `before`, and say where the pictures are.

    Raises
    ------
    StepFailed
    """
    out = out.resolve()
    settings = {
        "BLENDER_USER_RESOURCES": str(out / "blender"),
        "DRGS_ENGINE": str(environments.python_of(environments.ENGINE)),
        "DRGS_BLENDER": str(environments.blender()),
        "PYTHONUNBUFFERED": "1",
    }
    first = list(before) or [Step(environments.FOR_ENGINE, "", [sys.executable, "-c", ""], 0.1)]
    if not before and not os.environ.get("DRGS_BLENDER"):
        first.append(Step(environments.FOR_BLENDER, "", [sys.executable, "-c", ""], 0.1))
    seconds = run_steps([*first, *steps(out, frames)], out / "log.txt", ROOT, settings)
    print(f"Done in {seconds:.0f} s. Look at contact-sheet.png, animation.webp and strip.png in {out}")


def publish(frames: list[Path], out: Path, fps: int = 12) -> None:
    """The contact sheet and the animated picture."""
    from demo_pictures import combined, displayed, save_animation, to_bytes
    from PIL import Image

    def picture(path: Path) -> Image.Image:
        return Image.fromarray(to_bytes(displayed(combined(path)[..., :3])))

    with ThreadPoolExecutor() as pool:
        pictures = list(pool.map(picture, frames))
    chosen = pictures[:: max(1, len(pictures) // 8)][:8]
    width, height = chosen[0].size
    sheet = Image.new("RGB", (width * 4, height * ((len(chosen) + 3) // 4)))
    for i, one in enumerate(chosen):
        sheet.paste(one, (i % 4 * width, i // 4 * height))
    sheet.save(out / "contact-sheet.png")
    save_animation(out / "animation.webp", pictures, fps, quality=85)


def main(arguments: Sequence[str] | None = None, before: Sequence[Step] = ()) -> int:
    """The command line; `before` are steps of whoever calls."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "demo")
    parser.add_argument("--frames", default="1-24")
    parser.add_argument("--sheet", action="store_true", help="only the contact sheet, of the frames that are there")
    options = parser.parse_args(arguments)
    try:
        _count(options.frames)
    except ValueError:
        parser.error(f"--frames {options.frames} is no range like 1-24, 1-24x2 or 7")
    if options.sheet:
        publish(sorted((options.out / "frames").glob("*.exr")), options.out)
        return 0
    try:
        run(options.out, options.frames, before)
    except StepFailed as failure:
        print(f"demo: {failure}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
