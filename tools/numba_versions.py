"""Try versions of Numba: the frame of each must be the same, bit for bit, with this project's kernel compiler in use.

    .venv/bin/python tools/numba_versions.py 0.63.1 0.64.0 ...

Each version goes into an environment of its own, with the other packages of this one (and an older NumPy where it
wants one). `drgs_blender.compute.kernel_compiler.TESTED` lists those that passed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from environments import borrowing

ROOT = Path(__file__).resolve().parent.parent
#: What Numba before 0.66 takes.
OLD_NUMPY = "numpy==2.2.6"
#: Prints whether the kernel compiler is in use, and the digest of a frame of surfels, denoised.
FRAME = """
import hashlib, sys
import numpy as np
from drgs_blender.compute import jit
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.engine.session import Session
session = Session()
key = session.load_asset(sys.argv[1])
camera = Camera(np.eye(4), 96, 96, 105.0, 105.0, 48.0, 48.0)
camera.matrix_world[2, 3] = 2.5
world = World(np.random.default_rng(0).uniform(0, 1, (64, 128, 3)).astype(np.float32))
settings = RenderSettings(samples=8, subpixel_samples=1, denoise="svgf")
frame = Frame(1, camera, [ObjectState("cow", key)], world, settings)
passes = session.render(frame, lambda phase, part: None, lambda: False)
print(jit._OWN_CACHE, hashlib.sha256(np.ascontiguousarray(passes["Combined"])).hexdigest()[:16])
"""


def digest_by(version: str, asset: Path, folder: Path) -> tuple[bool, str]:
    """Whether the kernel compiler takes a version of Numba, and the digest of the frame that it renders.

    Raises
    ------
    subprocess.CalledProcessError
    """
    python, site = borrowing(folder / version)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(site)]
    old = [OLD_NUMPY] if tuple(map(int, version.split(".")[:2])) < (0, 66) else []
    subprocess.run([*pip, f"numba=={version}", *old], check=True)
    variables = {"PYTHONPATH": str(ROOT), "DRGS_SHIPPED": "0", "DRGS_CACHE_DIR": str(folder / f"kernels-{version}")}
    command = [str(python), "-P", "-c", FRAME, str(asset)]
    done = subprocess.run(command, env=os.environ | variables, check=True, stdout=subprocess.PIPE, text=True)
    is_ours, digest = done.stdout.split()
    return is_ours == "True", digest


def main() -> int:
    """Try the versions; the return value is the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("versions", nargs="+", metavar="VERSION")
    options = parser.parse_args()
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as name:
        asset = Path(name) / "cow.drgs"
        drgs = [sys.executable, "-m", "drgs_blender.cli.main", "make"]
        subprocess.run([*drgs, ROOT / "examples/spot/spot_triangulated.obj", "--out", asset], check=True)
        for version in options.versions:
            try:
                is_ours, found[version] = digest_by(version, asset, Path(name))
            except subprocess.CalledProcessError as error:
                print(f"{version}: failed, {error}", flush=True)
                found[version] = "failed"
                continue
            print(f"{version}: {found[version]}{'' if is_ours else ', by Numba alone'}", flush=True)
    return 0 if len({*found.values()}) == 1 and "failed" not in found.values() else 1


if __name__ == "__main__":
    sys.exit(main())
