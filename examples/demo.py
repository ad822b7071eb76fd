"""The main job, end to end: captured objects are rigged, simulated and painted in Blender, relit and rendered.

    python3.11 tools/dev.py demo [--out out/demo] [--frames 1-24]      # or make demo, which makes the environments too
    .venv/bin/python examples/demo.py [--out out/demo] [--frames 1-24]

Writes the .blend with its simulation, an EXR per frame, a contact sheet (PNG), an animated picture (WebP), and a strip
(PNG) of what two photographs became. Steps that do not wait for each other run side by side; of a demo before, the
scene is taken where nothing changed that it is made of. Frames are always rendered again.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tools"), str(ROOT / "examples")]

import environments  # noqa: E402
from demo_run import (  # noqa: E402
    DRGS,
    EXAMPLES,
    building,
    check_folder,
    exit_code,
    for_blender,
    frame_count,
    rendering,
    run_all,
)
from demo_shots import FRAMES  # noqa: E402
from steps import Step  # noqa: E402


def steps(out: Path, frames: str) -> list[Step]:
    """All that follows the environments; seconds are those of two processors."""
    engine, count = environments.python_of(environments.ENGINE), frame_count(frames, FRAMES)
    extension, scene = out / "extension.zip", out / "demo.blend"
    pattern = out / "frames" / "####.exr"
    strip = [engine, EXAMPLES / "demo_strip.py", "--out", out / "strip.png"]
    setting = [environments.blender(), "-P", EXAMPLES / "demo_scene.py", extension, scene]
    scripts = (EXAMPLES / name for name in ("demo_scene.py", "demo_shots.py", "blender_scenes.py"))
    of_scene = (EXAMPLES / "captured", extension, *scripts)
    render = [*DRGS, "render", scene, "--frames", frames, "--out", pattern, "--denoise", "svgf", "--overwrite"]
    rendered = rendering("frames", "Rendering", render, 4.0 + 2.2 * count, ("scene",), count)
    rendered.before = partial(shutil.rmtree, out / "frames", ignore_errors=True)
    return [
        # Those of the simulation first; what is not compiled when it is needed is waited for.
        environments.kernels("kernels", "simulate", "frame", "mesh", "lights", "denoise", "broken", seconds=45.0),
        building(extension),
        Step("scene", "Setting the scene", setting, 20.0, ("extension", *for_blender()), scene, of_scene),
        rendered,
        Step("strip", "Making the strip", strip, 6.0, ("kernels",)),
        Step("sheet", "Making the contact sheet", [engine, __file__, "--out", out, "--sheet"], 2.0, ("frames",)),
    ]


def run(out: Path, frames: str, before: Sequence[Step] = ()) -> None:
    """Run the demo after the steps `before`, and say where the pictures are.

    Raises
    ------
    StepFailed
    """
    out = out.resolve()
    chosen = steps(out, frames)
    check_folder("--out", out)
    seconds = run_all(chosen, out, before)
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
    parser.add_argument("--frames", default=f"1-{FRAMES}")
    parser.add_argument("--sheet", action="store_true", help="only the contact sheet, of the frames that are there")
    options = parser.parse_args(arguments)
    if options.sheet:
        publish(sorted((options.out / "frames").glob("*.exr")), options.out)
        return 0
    return exit_code("demo", "make demo", partial(run, options.out, options.frames, before))


if __name__ == "__main__":
    sys.exit(main())
