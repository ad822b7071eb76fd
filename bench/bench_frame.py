"""One frame at 800x800, 32 rays, one bounce, against Cycles at 32 samples in the same run.

python bench/bench_frame.py [--runs 5]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from judge import environments, frame_camera, run_cycles
from ours import relight
from report import OUT, table, write_section
from subjects import asset_path, save_mesh

from drgs_blender.core.asset.container import read_asset


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--asset", default="cat")
    parser.add_argument("--max-triangles", type=int, default=82000)
    options = parser.parse_args()
    path = asset_path(options.asset, max_triangles=options.max_triangles)
    mesh = read_asset(path).mesh
    surfels = len(read_asset(path).surfels)
    camera = frame_camera(mesh.vertices, options.size, azimuth=-60, fill=0.66)
    npz = OUT / f"{options.asset}.npz"
    save_mesh(npz, mesh)
    environment = environments() / "city.exr"
    job = {
        "mesh": str(npz), "environment": str(environment), "camera": camera, "samples": 32, "bounces": 1,
        "repeat": 3, "out": str(OUT / "frame-cycles.npy"),
    }  # fmt: skip
    rows, medians = [], {}
    variants = {
        "surfels, 4 sub-pixel samples": {"camera_sees": "surfels", "subpixel_samples": 4},
        "surfels, 1 sub-pixel samples": {"camera_sees": "surfels", "subpixel_samples": 1},
        "mesh, 4 sub-pixel samples": {"camera_sees": "mesh", "subpixel_samples": 4},
        "surfels, 4 sub-pixel samples, SVGF": {"camera_sees": "surfels", "subpixel_samples": 4, "denoise": "svgf"},
    }
    coverage = 0.0
    for name, settings in variants.items():
        walls = []
        for run in range(options.runs + 1):
            # Everything moves a little in every frame, so that nothing is left out of the time.
            moved = mesh.vertices * np.float32(1 + 1e-4 * run)
            begin = time.perf_counter()
            picture = relight(path, environment, camera, samples=32, vertices=moved, bounces=1, seed=run, **settings)
            picture = picture["Combined"]
            walls.append(time.perf_counter() - begin)
        coverage = float((picture[..., 3] > 0.5).mean())
        medians[name] = float(np.median(walls[1:]))  # the first run loads kernels and asset
    cycles = run_cycles([job], "frame")[0]["seconds"]
    rows = [(name, f"{t:.2f}", f"{cycles / t:.1f}") for name, t in medians.items()]
    rows.append(("Cycles 32 spp, render call", f"{cycles:.2f}", "1.0"))
    body = (
        f"{options.asset}: {len(mesh.faces)} triangles, {surfels} surfels, {options.size}x{options.size}, "
        f"{coverage:.0%} coverage, 32 rays, one bounce, 2 threads; median of {options.runs} whole frames (deformation, "
        "BVH update, G-buffer, integration, passes), without denoising unless said. Cycles: median of 3 renders "
        "with persistent data, file writing included, same mesh, bounces and camera.\n\n"
        + table(("Frame", "Seconds", "Cycles / ours"), rows)
    )
    write_section("frame", "Time of a frame", body)


if __name__ == "__main__":
    main()
