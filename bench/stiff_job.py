"""A body of stiff metal that lands on its legs, by whatever code is imported: a part of bench_simulate.py.

python bench/stiff_job.py OUT.npz RESOLUTION FRAMES COURANT

COURANT 0 leaves the time step to the code. Says how many particles, steps and seconds (of the processor, of the clock)
it took after a first frame, and writes the points of each frame in cells.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from animal import body

from drgs_blender.core.asset.model import Mesh
from drgs_blender.simulation.job import prepare
from drgs_blender.simulation.settings import parse_settings

FRAME = 1 / 24


def main() -> None:
    out, resolution, frames, courant = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
    shape = body().subdivide().subdivide()
    n = len(shape.vertices)
    vertices = np.add(shape.vertices, [0, 0, 0.08 - shape.vertices[:, 2].min()])
    mesh = Mesh(vertices, np.asarray(shape.faces), np.ones((n, 3)), np.ones(n), np.zeros(n))
    settings = {
        "material": {"name": "metal", "youngs_modulus": 1e8}, "floor": 0, "resolution": resolution,
        "velocity": [0, 0, -1.5], "last": frames + 1,
    }  # fmt: skip
    solver = prepare(mesh, parse_settings(settings | ({"courant": courant} if courant else {}))).solver
    points = []
    for frame in range(frames):
        solver.advance(FRAME)
        if frame == 0:
            steps, cpu, wall = solver.steps, time.process_time(), time.perf_counter()
        points.append(solver.points / solver.domain.spacing)
    took = time.process_time() - cpu, time.perf_counter() - wall
    np.savez(out, points=np.array(points))
    print(json.dumps({"particles": len(solver.points), "steps": solver.steps - steps, "seconds": took}))


if __name__ == "__main__":
    main()
