"""What stands between a pose and the first ray, and between a file and an asset, at a million of each.

python bench/bench_scene.py
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from report import table, write_section

from drgs_blender.core.asset import Asset, Binding, Mesh, Surfels
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene


def median_ms(work: Callable[[], object], runs: int) -> float:
    times = []
    for _ in range(runs):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return 1000 * float(np.median(times))


def update_of(levels: int) -> list[object]:
    """Median time of `TraceScene.update` when all vertices of one object moved: refit, normals, materials."""
    ball = trimesh.creation.icosphere(levels)
    n = len(ball.vertices)
    scene, step = TraceScene(), iter(range(1000))
    grey, rough = np.full((n, 3), 0.5, np.float32), np.full(n, 0.5, np.float32)
    faces = ball.faces.astype(np.int32)

    def move() -> None:
        vertices = (ball.vertices * (1 + 0.001 * next(step))).astype(np.float32)
        began = time.perf_counter()
        scene.update([TraceObject("ball", vertices, faces, grey, rough, rough)])
        times.append(time.perf_counter() - began)

    times: list[float] = []
    for _ in range(12):
        move()
    wall = 1000 * float(np.median(times[2:]))
    scene.close()
    return [f"{len(ball.faces):,} triangles", wall, wall * 1e6 / len(ball.faces)]


def file_times(n: int = 1_000_000) -> list[list[object]]:
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(6)
    m = len(ball.vertices)
    mesh = Mesh(ball.vertices, ball.faces, np.full((m, 3), 0.5), np.full(m, 0.5), np.zeros(m))
    turn = rng.normal(size=(n, 4))
    surfels = Surfels(
        rng.normal(size=(n, 3)), rng.uniform(0.01, 0.02, (n, 2)), turn / np.linalg.norm(turn, axis=1, keepdims=True),
        rng.uniform(0, 1, n), rng.uniform(0, 1, (n, 3)), rng.uniform(0, 1, n), rng.uniform(0, 1, n),
    )  # fmt: skip
    binding = Binding(
        rng.integers(0, len(ball.faces), n), np.full((n, 3), 1 / 3), np.zeros(n), np.tile([0.0, 0.0, 1.0], (n, 1))
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "million.drgs"
        rows: list[list[object]] = [["write", median_ms(lambda: write_asset(path, Asset(surfels, mesh, binding)), 3)]]
        rows.append(["open", median_ms(lambda: read_asset(path, verify=False), 9)])
        rows.append(["open and verify every byte", median_ms(lambda: read_asset(path), 5)])
        rows.append([f"size {path.stat().st_size / 1e6:.0f} MB", ""])
    return rows


def main() -> None:
    body = "Update of the traced scene when every vertex moved: refit, smooth normals, materials; median of 10.\n\n"
    body += table(["scene", "wall ms", "ms a million triangles"], [update_of(6), update_of(8)])
    body += "\n\nA .drgs file of 1,000,000 surfels and 81,920 triangles:\n\n" + table(["step", "wall ms"], file_times())
    write_section("scene", "Scene update and asset files", body)


if __name__ == "__main__":
    main()
