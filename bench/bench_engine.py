"""The engine as a process: start to first frame, and what the link costs.

    python bench/bench_engine.py [--asset FILE.drgs]

``link`` times a conversation of two threads
of this process over real pipes: 12 MB of vertices one way, 24.9 MB of picture (1920 x 1080 x 3 float32) back.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from report import table, write_section

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.deform.attach import attach
from drgs_blender.ipc import protocol
from drgs_blender.ipc.client import EngineClient, locate_engine
from drgs_blender.ipc.protocol import Link
from drgs_blender.ipc.shared_memory import Region


def plane_asset(path: Path, cells: int = 100) -> None:
    """A wavy sheet of 2 x cells x cells triangles."""
    grid = np.linspace(-1, 1, cells + 1)
    x, y = (a.ravel() for a in np.meshgrid(grid, grid))
    vertices = np.stack([x, y, 0.1 * np.sin(6 * x) * np.cos(5 * y)], axis=1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = corner, corner + 1, corner + cells + 2, corner + cells + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.6), np.full(n, 0.4), np.zeros(n))
    surfels, binding, _ = attach(mesh)
    write_asset(path, Asset(surfels, mesh, binding))


def first_frame(path: Path, in_viewport: bool = False) -> dict[str, float]:
    """Seconds from nothing to a first picture of 400 x 400 pixels, and for the next ones.

    A viewport shows it at once, of coarse pixels.
    """
    camera = Camera(np.eye(4), 400, 400, 440.0, 440.0, 200.0, 200.0)
    camera.matrix_world[2, 3] = 2.5
    world = World(np.random.default_rng(0).uniform(0, 1, (256, 512, 3)).astype(np.float32))
    settings = RenderSettings(samples=4, subpixel_samples=1)
    start = time.perf_counter()
    with EngineClient(locate_engine()) as client:
        client.start()
        greeted = time.perf_counter()
        key = client.load_asset(str(path))
        loaded = time.perf_counter()
        frame = Frame(1, camera, [ObjectState("sheet", key)], world, settings)
        if in_viewport:
            client.view("viewport", frame)
        else:
            client.render(frame)
        first = time.perf_counter()
        later = []
        for number in range(2, 7):
            frame.noise_index = number
            again = time.perf_counter()
            engine = client.render(frame).statistics["seconds.total"]
            later.append(time.perf_counter() - again - engine)
    return {
        "hello_s": greeted - start,
        "asset_s": loaded - greeted,
        "first_frame_s": first - loaded,
        "start_to_first_frame_s": first - start,
        "overhead_of_a_frame_s": statistics.median(later),
    }


def link(shared: bool, repeats: int = 15) -> dict[str, float]:
    """Median seconds of one exchange between two threads."""
    there, back = os.pipe(), os.pipe()
    files = [os.fdopen(fd, mode, buffering=0) for fd, mode in zip((*there, *back), ("rb", "wb", "rb", "wb"))]
    engine, client = Link(files[0], files[3]), Link(files[2], files[1])  # type: ignore[arg-type]
    if shared:
        engine.incoming = client.outgoing = Region.create()
        engine.outgoing = client.incoming = Region.create()
    vertices = np.random.default_rng(1).normal(size=(1_000_000, 3)).astype(np.float32)
    picture = np.random.default_rng(2).normal(size=(1080, 1920, 3)).astype(np.float32)

    def answer() -> None:
        while engine.receive() is not None:
            engine.send(protocol.Result(1, [], {}), {"Combined": picture})

    thread = threading.Thread(target=answer)
    thread.start()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        client.send(protocol.Render(1, {}, {}), {"objects/a/vertices": vertices})
        client.receive()
        times.append(time.perf_counter() - start)
    files[1].close()
    thread.join()
    return {"median_s": statistics.median(times), "best_s": min(times)}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--asset", type=Path, help="asset to render; default: a sheet of 20,000 triangles")
    args = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else each start compiles all sources: users have them compiled
    links = {"shared memory": link(True), "pipes alone": link(False)}
    with tempfile.TemporaryDirectory() as folder:
        path = args.asset or Path(folder) / "sheet.drgs"
        if args.asset is None:
            plane_asset(path)
        first_frame(path)  # compiles what is not yet in the cache
        starts = [first_frame(path) for _ in range(5)]
    names = {
        "hello_s": "start to greeting",
        "asset_s": "load the asset",
        "first_frame_s": "first frame",
        "start_to_first_frame_s": "start to first frame",
        "overhead_of_a_frame_s": "a later frame beyond the engine's own work",
    }
    rows = [[text, 1000 * statistics.median(s[key] for s in starts)] for key, text in names.items()]
    rows += [[f"link, {name}", 1000 * times["median_s"]] for name, times in links.items()]
    body = (
        "Kernels cached; a sheet of 20,000 triangles at 400 x 400, 4 rays; medians of 5 starts. Link: 12 MB "
        "of vertices one way, 24.9 MB of picture back, median of 15.\n\n" + table(["step", "wall ms"], rows)
    )
    write_section("engine", "The engine process", body)


if __name__ == "__main__":
    main()
