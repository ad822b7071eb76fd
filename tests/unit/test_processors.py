"""What is computed with numpy before a picture has the same bits on older processors."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]

#: Prints a digest of each array that pixels are made of.
PROGRAM = """
import hashlib
import numpy as np
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.engine.scene_objects import world_vertices
from drgs_blender.core.frame import Light, World
from drgs_blender.render.lights.light_sampler import Lights
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.integrator.brdf import layer_table

rng = np.random.default_rng(0)
turns = np.tile(np.eye(4), (90, 1, 1))
turns[:, :3] = rng.uniform(-3, 3, (90, 3, 4))
spots = [Light("spot", "spot", t, tuple(rng.random(3)), spot_size=s) for t, s in zip(turns, rng.uniform(0.1, 2, 90))]
light, lights = EnvironmentLight(World(rng.random((64, 128, 3), np.float32))), Lights(spots)
arrays = {
    "bytes": srgb_to_linear(np.arange(256) / 255), "floats": srgb_to_linear(rng.random(100000)),
    "vertices": world_vertices(rng.random((100000, 3), np.float32), turns[0]), "layer": layer_table(),
    "edges": light.row_z, "runs": light.cells.runs, "starts": light.product.starts, "ratio": light.product.ratio,
    "lights": lights.table, "tree": lights.pick,
}
for name, array in arrays.items():
    print(name, hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest())
"""


def digests(**environment: str) -> dict[str, str]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=os.environ | {"PYTHONPATH": str(ROOT)} | environment, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return dict(line.split() for line in done.stdout.splitlines())


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="processors of the x86 family")
def test_older_instructions_give_the_same_bits() -> None:
    """Numpy and its BLAS choose their code by the processor; the kernels are strict, see docs/farm/nodes.md."""
    core = getattr(np, "_core", None) or np.core
    newer = " ".join(core._multiarray_umath.__cpu_dispatch__)
    ours, theirs = digests(), digests(NPY_DISABLE_CPU_FEATURES=newer, OPENBLAS_CORETYPE="Prescott")
    assert len(ours) == 10
    assert [name for name in ours if ours[name] != theirs[name]] == []
