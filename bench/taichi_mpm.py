"""Steps a state by MLS-MPM written in Taichi: for bench_simulate.py, in an interpreter that has it.

python bench/taichi_mpm.py STATE.npz OUT.npz --steps N [--threads K] [--double]

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
    momentum, weight = ti.Vector.field(3, real, size), ti.field(real, size)
    x.from_numpy((state["x"] - state["origin"]).astype(kind))
    for target, name in ((v, "v"), (c, "c"), (f, "f"), (mass, "mass"), (volume, "volume"), (mu, "mu"), (lam, "lam")):
        target.from_numpy(state[name].astype(kind))

    @ti.kernel
    def step():  # type: ignore[no-untyped-def]
        for node in ti.grouped(weight):
            momentum[node] = ti.Vector.zero(real, 3)
            weight[node] = 0.0
        for p in x:
            base = ti.cast(x[p] * scale - 0.5, ti.i32)
            t = x[p] * scale - ti.cast(base, real)
            w = [0.5 * (1.5 - t) ** 2, 0.75 - (t - 1.0) ** 2, 0.5 * (t - 0.5) ** 2]
            one = ti.Matrix.identity(real, 3)
            tau = mu[p] * (f[p] @ f[p].transpose() - one) + lam[p] * ti.log(f[p].determinant()) * one
            affine = mass[p] * c[p] - dt * inertia * volume[p] * tau
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                d = (ti.Vector([i, j, k]) - t) * h
                share = w[i][0] * w[j][1] * w[k][2]
                momentum[base + ti.Vector([i, j, k])] += share * (mass[p] * v[p] + affine @ d)
                weight[base + ti.Vector([i, j, k])] += share * mass[p]
        for node in ti.grouped(weight):
            if weight[node] > 0:
                momentum[node] = momentum[node] / weight[node] + dt * gravity
        for p in x:
            base = ti.cast(x[p] * scale - 0.5, ti.i32)
            t = x[p] * scale - ti.cast(base, real)
            w = [0.5 * (1.5 - t) ** 2, 0.75 - (t - 1.0) ** 2, 0.5 * (t - 0.5) ** 2]
            new, gradient = ti.Vector.zero(real, 3), ti.Matrix.zero(real, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                d = (ti.Vector([i, j, k]) - t) * h
                at = w[i][0] * w[j][1] * w[k][2] * momentum[base + ti.Vector([i, j, k])]
                new += at
                gradient += inertia * at.outer_product(d)
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
