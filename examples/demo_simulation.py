"""Matter: one body of two stiffnesses under gravity, and one of sand, metal and jelly that falls, baked and relit.

    python3.11 tools/dev.py demo-simulation [--out out/demo-simulation] [--frames 1-48x3]      # or make demo-simulation
    .venv/bin/python examples/demo_simulation.py [--out out/demo-simulation] [--frames 1-48x3]

Writes the assets, the .blend files with their caches, and a contact sheet (PNG) and an animated picture (WebP) of each
shot. What is there is not made again where nothing changed. Exit code 1 when the softer body does not droop more than
the firmer one.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tools"), str(ROOT / "examples")]

import environments  # noqa: E402
from demo import publish  # noqa: E402
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
from demo_shots import SIMULATED  # noqa: E402
from steps import Step  # noqa: E402

SPOT, CAT = EXAMPLES / "spot", EXAMPLES / "cat" / "egyptian_cat.glb"
#: Of the engine's kernels.
JOBS = ("make", "simulate", "frame", "mesh", "lights", "denoise", "broken")
#: Each rendered from its .blend.
SHOTS = ("droop", "fall")


def steps(out: Path, frames: str) -> list[Step]:
    """All that follows the environments; seconds are those of two processors."""
    engine, count = environments.python_of(environments.ENGINE), frame_count(frames, SIMULATED)
    extension, cow, cat = out / "extension.zip", out / "cow.drgs", out / "cat.drgs"
    make_cow = [*DRGS, "make", out / "cow.obj", "--up", "y", "--max-triangles", 20000, "--out", cow]
    make_cat = [*DRGS, "make", CAT, "--max-triangles", 30000, "--out", cat]
    setting = [environments.blender(), "-P", EXAMPLES / "demo_simulation_scene.py", extension, out]
    scripts = (EXAMPLES / name for name in ("demo_simulation_scene.py", "demo_shots.py", "blender_scenes.py"))
    own = [engine, __file__, "--out", out]
    after = ("cow", "cat", "extension", *for_blender())
    found = [
        environments.kernels("kernels", *JOBS, seconds=45.0),
        building(extension),
        Step(
            "cow", "Making the cow", make_cow, 8.0, (environments.FOR_ENGINE,), cow, (SPOT,),
            before=partial(textured_cow, out),
        ),
        Step("cat", "Making the cat", make_cat, 18.0, ("cow",), cat, (CAT,)),
        Step(
            "scene", "Baking what falls and droops", setting, 145.0, after, out / "fall.blend",
            (SPOT, CAT, extension, *scripts), before=partial(forget_frames, out),
        ),
        Step("check", "Measuring how far the cows droop", [*own, "--measure"], 1.0, ("scene",)),
    ]  # fmt: skip
    for shot in SHOTS:
        pattern = out / shot / "####.exr"
        render = [*DRGS, "render", out / f"{shot}.blend", "--frames", frames, "--out", pattern]
        render += ["--samples", "16", "--denoise", "svgf"]
        found.append(rendering(shot, f"Rendering {shot}", render, 10.0 * count, (found[-1].name,), count))
        sheet = [*own, "--sheet", shot]
        found.append(Step(f"{shot}, sheet", f"Making the contact sheet of {shot}", sheet, 2.0, (shot,)))
    return found


def textured_cow(out: Path) -> None:
    """Write Spot with its texture: the file of the examples names none."""
    shutil.copy(SPOT / "spot_texture.png", out)
    (out / "cow.mtl").write_text("newmtl cow\nmap_Kd spot_texture.png\n")
    (out / "cow.obj").write_text("mtllib cow.mtl\nusemtl cow\n" + (SPOT / "spot_triangulated.obj").read_text())


def forget_frames(out: Path) -> None:
    """Remove the frames of scenes that are made again."""
    for shot in SHOTS:
        shutil.rmtree(out / shot, ignore_errors=True)


def droop(folder: Path) -> float:
    """How far a simulated body has sunk in its last frame, part of its height."""
    import numpy as np

    from drgs_blender.core.particle_cache import ParticleCache

    cache = ParticleCache(folder)
    rest, last = cache.rest().points, cache.read(cache.frames()[-1]).points
    return float((rest - last)[:, 2].mean() / np.ptp(rest[:, 2]))


def measure(out: Path) -> int:
    """Compare the two cows; the exit code."""
    sunk = {name: droop(out / "drgs_cache" / "droop" / name) for name in ("soft", "firm")}
    words = ", ".join(f"{name}: has sunk by {value:.1%} of its height" for name, value in sunk.items())
    (out / "droop.txt").write_text(words + "\n")
    print(words)
    if not sunk["soft"] > sunk["firm"] > 0:
        print("The softer body should have sunk more than the firmer one, and both some", file=sys.stderr)
        return 1
    return 0


def run(out: Path, frames: str, before: Sequence[Step] = ()) -> None:
    """Run all after the steps `before`, and say where the pictures are.

    Raises
    ------
    StepFailed
    """
    out = out.resolve()
    chosen = steps(out, frames)
    check_folder("--out", out)
    seconds = run_all(chosen, out, before)
    print((out / "droop.txt").read_text().rstrip())
    folders = " and ".join(str(out / shot) for shot in SHOTS)
    print(f"Done in {seconds:.0f} s. Look at contact-sheet.png and animation.webp in {folders}")


def main(arguments: Sequence[str] | None = None, before: Sequence[Step] = ()) -> int:
    """The command line; `before` are steps of whoever calls."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "demo-simulation")
    parser.add_argument("--frames", default=f"1-{SIMULATED}x3")
    parser.add_argument("--measure", action="store_true", help="only compare the baked cows")
    parser.add_argument("--sheet", choices=SHOTS, help="only the contact sheet of this shot, of the frames there are")
    options = parser.parse_args(arguments)
    if options.measure:
        return measure(options.out)
    if options.sheet:
        frames = options.out / options.sheet
        publish(sorted(frames.glob("*.exr")), frames, fps=8)
        return 0
    return exit_code("demo-simulation", "make demo-simulation", partial(run, options.out, options.frames, before))


if __name__ == "__main__":
    sys.exit(main())
