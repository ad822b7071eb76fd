"""Steps a state by MLS-MPM written in Taichi: for bench_simulate.py, in an interpreter that has it.

python bench/taichi_mpm.py STATE.npz OUT.npz --steps N [--threads K] [--double] [--atomic]

STATE holds x, v, c, f, mass, volume, mu, lam of particles, sorted by place, and origin, spacing, size, gravity, dt. OUT
is x and f after N steps; the line printed is JSON with seconds a step (processor and wall) and Taichi's version.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
import taichi as ti


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("state")
    parser.add_argument("out")
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--double", action="store_true")
    parser.add_argument("--atomic", action="store_true", help="atomic sums on one thread too, as Taichi's examples do")
    options = parser.parse_args()
    real = ti.f64 if options.double else ti.f32
    ti.init(arch=ti.cpu, cpu_max_num_threads=options.threads, default_fp=real, log_level=ti.ERROR)
    state = np.load(options.state)
    kind = np.float64 if options.double else np.float32
    count = len(state["x"])
    h, dt = float(state["spacing"]), float(state["dt"])
    scale, inertia = 1 / h, 4 / h**2
    gravity = ti.Vector(state["gravity"].tolist())
    x, v = (ti.Vector.field(3, real, count) for _ in range(2))
    c, f = (ti.Matrix.field(3, 3, real, count) for _ in range(2))
    mass, volume, mu, lam = (ti.field(real, count) for _ in range(4))
    size = tuple(int(n) for n in state["size"])
    grid = ti.Vector.field(4, real, size)  # momentum and mass, in one place of memory
    alone = options.threads == 1 and not options.atomic  # then sums need not be atomic
    x.from_numpy((state["x"] - state["origin"]).astype(kind))
    for target, name in ((v, "v"), (c, "c"), (f, "f"), (mass, "mass"), (volume, "volume"), (mu, "mu"), (lam, "lam")):
        target.from_numpy(state[name].astype(kind))

    @ti.kernel
    def step():  # type: ignore[no-untyped-def]
        for node in ti.grouped(grid):
            grid[node] = ti.Vector.zero(real, 4)
        ti.loop_config(serialize=alone)
        for p in x:
            base = ti.cast(x[p] * scale - 0.5, ti.i32)
            t = x[p] * scale - ti.cast(base, real)
            w = [0.5 * (1.5 - t) ** 2, 0.75 - (t - 1.0) ** 2, 0.5 * (t - 0.5) ** 2]
            one = ti.Matrix.identity(real, 3)
            f_p = f[p]
            tau = mu[p] * (f_p @ f_p.transpose() - one) + lam[p] * ti.log(f_p.determinant()) * one
            affine = h * (mass[p] * c[p] - dt * inertia * volume[p] * tau)
            start = mass[p] * v[p] - affine @ t
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                share = w[i][0] * w[j][1] * w[k][2]
                own = start + affine @ ti.Vector([i, j, k])
                node = base + ti.Vector([i, j, k])
                sums = share * ti.Vector([own[0], own[1], own[2], mass[p]])
                if ti.static(alone):
                    grid[node] = grid[node] + sums
                else:
                    grid[node] += sums
        for node in ti.grouped(grid):
            if grid[node][3] > 0:
                for i in ti.static(range(3)):
                    grid[node][i] = grid[node][i] / grid[node][3] + dt * gravity[i]
        ti.loop_config(serialize=alone)
        for p in x:
            base = ti.cast(x[p] * scale - 0.5, ti.i32)
            t = x[p] * scale - ti.cast(base, real)
            w = [0.5 * (1.5 - t) ** 2, 0.75 - (t - 1.0) ** 2, 0.5 * (t - 0.5) ** 2]
            new, slope = ti.Vector.zero(real, 3), ti.Matrix.zero(real, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                node = grid[base + ti.Vector([i, j, k])]
                at = w[i][0] * w[j][1] * w[k][2] * ti.Vector([node[0], node[1], node[2]])
                new += at
                slope += at.outer_product(ti.Vector([i, j, k]) - t)
            gradient = inertia * h * slope
            v[p] = new
            c[p] = gradient
            x[p] += dt * new
            f[p] += dt * gradient @ f[p]

    before = [a.to_numpy() for a in (x, v, c, f)]
    step()  # compiles
    for target, values in zip((x, v, c, f), before, strict=True):
        target.from_numpy(values)
    ti.sync()
    cpu, wall = time.process_time(), time.perf_counter()
    for _ in range(options.steps):
        step()
    ti.sync()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    np.savez(options.out, x=x.to_numpy() + state["origin"], f=f.to_numpy())
    version = ".".join(map(str, ti.__version__))
    print(json.dumps({"cpu": cpu / options.steps, "wall": wall / options.steps, "version": version}))


if __name__ == "__main__":
    main()
