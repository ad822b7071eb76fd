"""Try the engine on an Arm processor that QEMU emulates: a picture, beside that of this machine.

    .venv/bin/python tools/arm.py PYTHON examples/captured/spot.drgs --env city.hdr [--size 96] [--samples 16]

PYTHON is a program that starts Linux' Python for aarch64 with the engine's packages, such as

    #!/bin/sh
    export PYTHONPATH=SITE QEMU_LD_PREFIX=ROOT
    exec qemu-aarch64-static ROOT/usr/bin/python3.13 "$@"

where ROOT holds the unpacked packages of a Debian for arm64 (Python and libembree4 4.4), and SITE the wheels for
aarch64. There is none of embreex: a folder ``embreex`` with an empty ``rtcore.py``, and in ``embreex.libs`` Debian's
library as ``libembree4-debian.so.4``, take its place. Nothing is fetched. Kernels are compiled by the emulated
processor: half an hour, the first time. Exit code 1: the pictures differ.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenEXR
from wine import ALIKE

ROOT = Path(__file__).resolve().parent.parent
RELIGHT = "import sys; from drgs_blender.cli.entry import main; sys.exit(main())"


def picture(python: str, arguments: Sequence[str], out: Path) -> np.ndarray:
    """(h, w, 4) linear picture that `drgs relight` writes when one Python runs it; its seconds are printed."""
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    # Workers that compile are started by the path of Python's own file, which this processor does not run.
    settings = os.environ | {"PYTHONPATH": paths, "DRGS_PREPARE": "0"}
    began = time.monotonic()
    subprocess.run([python, "-c", RELIGHT, "relight", *arguments, "--out", str(out)], env=settings, check=True)
    print(f"{python}: {time.monotonic() - began:.0f} s", flush=True)
    with OpenEXR.File(str(out)) as file:
        return np.array(file.channels()["RGBA"].pixels)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("python", type=Path, help="program that starts Python for aarch64")
    parser.add_argument("asset", type=Path)
    parser.add_argument("--env", type=Path, required=True, help="environment map")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--samples", type=int, default=16)
    options = parser.parse_args()
    for path in (options.python, options.asset, options.env):
        if not path.is_file():
            parser.error(f"there is no file {path}")
    if not os.access(options.python, os.X_OK):
        parser.error(f"{options.python} is no program: make it executable")
    arguments = [str(options.asset.resolve()), "--env", str(options.env.resolve())]
    arguments += ["--size", str(options.size), "--samples", str(options.samples)]
    with tempfile.TemporaryDirectory() as folder:
        here = picture(sys.executable, arguments, Path(folder, "here.exr"))
        arm = picture(str(options.python.resolve()), arguments, Path(folder, "arm.exr"))
    error = np.abs(np.float64(arm) - here)
    decibels = 20 * np.log10(here.max() / max(np.sqrt(np.mean(error**2)), 1e-30))
    print(f"{np.count_nonzero(error)} of {error.size} values differ, by {error.max():.1g} at most: {decibels:.0f} dB")
    return int(decibels < ALIKE)


if __name__ == "__main__":
    sys.exit(main())
