"""How the objects of `examples/captured` were made: photographed by Cycles, and reconstructed from the photographs.

    .venv/bin/python examples/make_captured.py [--objects robot cat] [--work out/captured]

Forty photographs of 256 x 256 pixels of each object under one light, then 3000 steps of surfels and 4000 of materials
and light: a quarter of an hour per object on two cores. The colours as captured, a fourth of each file, are left out.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OBJECTS = ("robot", "cat", "spot", "fern")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", nargs="+", choices=OBJECTS, default=OBJECTS)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "captured", help="folder of photographs and assets")
    options = parser.parse_args()
    drgs = [sys.executable, "-m", "drgs_blender.cli.main"]
    scenes = options.work / "scenes"
    views = ("--size", "256", "--train", "40", "--test", "8", "--spp", "64")
    subprocess.run([*drgs, "evaluate", "--make-scenes", scenes, "--objects", *options.objects, *views], check=True)
    from drgs_blender.core.asset.container import read_asset, write_asset

    for name in options.objects:
        path = options.work / f"{name}.drgs"
        steps = ("--iterations", "3000", "--set", "decoupling.iterations=4000")
        subprocess.run([*drgs, "reconstruct", scenes / name, "--out", path, *steps], check=True)
        asset = read_asset(path)
        write_asset(ROOT / "examples" / "captured" / path.name, replace(asset, surfels=replace(asset.surfels, sh=None)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
