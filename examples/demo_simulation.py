"""Matter: one body of two stiffnesses under gravity, and one of sand, metal and jelly that falls, baked and relit.

    .venv/bin/python examples/demo_simulation.py [--out out/demo-simulation]

Writes the assets, the .blend files with their caches, and a contact sheet (PNG) and an animated picture (WebP) of each
shot. Exit code 1 when the softer body does not droop more than the firmer one.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
from demo import BIN, EXE, ROOT, publish, run

from drgs_blender.core.particle_cache import ParticleCache


def textured_cow(out: Path) -> Path:
    """Spot with its texture: the file of the examples names none."""
    spot = ROOT / "examples" / "spot"
    shutil.copy(spot / "spot_texture.png", out)
    (out / "cow.mtl").write_text("newmtl cow\nmap_Kd spot_texture.png\n")
    (out / "cow.obj").write_text("mtllib cow.mtl\nusemtl cow\n" + (spot / "spot_triangulated.obj").read_text())
    return out / "cow.obj"


def droop(folder: Path) -> float:
    """How far a simulated body has sunk in its last frame, part of its height."""
    cache = ParticleCache(folder)
    rest, last = cache.rest().points, cache.read(cache.frames()[-1]).points
    return float((rest - last)[:, 2].mean() / np.ptp(rest[:, 2]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "demo-simulation")
    parser.add_argument("--frames", default="1-48x3")
    options = parser.parse_args()
    begin = time.perf_counter()
    out = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    drgs = [sys.executable, "-m", "drgs_blender.cli.main"]
    run(*drgs, "make", textured_cow(out), "--up", "y", "--max-triangles", 20000, "--out", out / "cow.drgs")
    cat = ROOT / "examples" / "cat" / "egyptian_cat.glb"
    run(*drgs, "make", cat, "--max-triangles", 30000, "--out", out / "cat.drgs")
    run(sys.executable, ROOT / "tools/extension.py", "--out", out / "extension.zip")
    blender = os.environ.get("DRGS_BLENDER", ROOT / ".venv-blender" / BIN / f"python{EXE}")
    os.environ.update(BLENDER_USER_RESOURCES=str(out / "blender"), DRGS_ENGINE=sys.executable)
    run(blender, "-P", ROOT / "examples" / "demo_simulation_scene.py", out / "extension.zip", out)
    sunk = {name: droop(out / "drgs_cache" / "droop" / name) for name in ("soft", "firm")}
    print(", ".join(f"{name}: has sunk by {value:.1%} of its height" for name, value in sunk.items()))
    if not sunk["soft"] > sunk["firm"] > 0:
        print("The softer body should have sunk more than the firmer one, and both some", file=sys.stderr)
        return 1
    for shot in ("droop", "fall"):
        frames = out / shot
        run(*drgs, "render", out / f"{shot}.blend", "--frames", options.frames, "--out", frames / "####.exr",
            "--samples", "16", "--denoise", "svgf")  # fmt: skip
        publish(sorted(frames.glob("*.exr")), frames, fps=8)
        print(f"Look at {frames / 'contact-sheet.png'} and {frames / 'animation.webp'}")
    print(f"Done in {time.perf_counter() - begin:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
