"""A picture, its light, matter, and learning from photographs on every device: how alike they are, and seconds.

python bench/bench_device.py [--size 800] [--runs 5] [--learn-size 400] [--steps 1000] [--surfels 16000]
                             [--particles 100000] [--pair]

With --pair alone what is compared with a card is measured: the CPU with all threads, and the card.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace

import numpy as np
import ours
from device_simulation import matter
from judge import environments, frame_camera
from learning import learning
from ours import pinhole
from report import table, write_section
from subjects import asset_path

from drgs_blender.compute.threads import use_threads
from drgs_blender.compute.warp.runtime import cuda_devices, warp
from drgs_blender.core.asset.container import read_asset
from drgs_blender.core.errors import DeviceError
from drgs_blender.core.frame import RenderSettings, World
from drgs_blender.formats.registry import read_environment
from drgs_blender.render.backend import CPU, RenderBackend
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.gbuffer.mesh import primary_mesh
from drgs_blender.render.gpu.warp_backend import WarpRenderBackend
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene
from drgs_blender.render.shading_points import Radiance

#: Rows, and the processor for each; a card stands in its row whether there is one or not.
ROWS = ("Numba, Embree, all threads", "Numba, Embree, 1 thread", "Warp on the processor, 1 thread", "Warp on CUDA")
WARP_ON_A_PROCESSOR = (
    " Warp runs one thread on a processor: its row there shows that the code is right, not how fast a card is."
)
NOT_MEASURED = "not measured: no card"


def psnr(a: np.ndarray, b: np.ndarray) -> str:
    """Of two pictures whose white is 1."""
    if a is b:
        return "the reference"
    error = np.mean((np.minimum(a, 1) - np.minimum(b, 1)).astype(np.float64) ** 2)
    return f"{-10 * np.log10(error):.1f} dB" if error else "the same bits"


def frames(options: argparse.Namespace, cards: list[str]) -> str:
    """Table of whole pictures of what moves: deformation, tree, surfels, light, SVGF; and the first of a viewport."""
    path = asset_path(options.asset, max_triangles=82000)
    vertices = read_asset(path).mesh.vertices
    camera = frame_camera(vertices, options.size, azimuth=-60, fill=0.66)
    sky = read_environment(environments() / "city.exr").radiance
    rows, reference = [], np.empty(0)
    places: list[tuple[str, RenderBackend | None, int]] = [(ROWS[0], CPU, 0)]
    if not options.pair:
        places.append(("the same, surfels, light and filter by Warp on the processor", WarpRenderBackend("cpu"), 0))
    places.append(("the same, by Warp on CUDA", WarpRenderBackend(cards[0]) if cards else None, 0))
    for name, processor, threads in places:
        if processor is None:
            rows.append([name, *[NOT_MEASURED] * 4])
            continue
        ours.SESSION._backends._known["cuda"] = processor
        seconds = []
        common = {"samples": 32, "subpixel_samples": 4, "denoise": "svgf", "device": "cuda", "threads": threads}
        for k in range(options.runs, -1, -1):  # the last is at rest
            began = time.perf_counter()
            moved = (vertices * (1 + 1e-3 * k)).astype(np.float32)
            found = ours.relight(path, sky, camera, vertices=moved, **common)["Combined"]
            seconds.append(time.perf_counter() - began)
        first = []
        for k in range(options.runs + 1):
            began = time.perf_counter()
            moved = (vertices * (1 + 1e-3 * k)).astype(np.float32)
            ours.first_view(path, sky, camera, vertices=moved, **common)
            first.append(time.perf_counter() - began)
        if processor.failed:
            raise DeviceError("device", processor.failed, "")
        reference = reference if len(reference) else found
        middle = statistics.median(seconds[1:])
        quick = f"{1e3 * statistics.median(first[1:]):.0f} ms"
        rows.append([name, f"{middle:.3f} s", f"{1 / middle:.2f}", psnr(found, reference), quick])
    return table(["Where", "Seconds", "Pictures a second", "PSNR", "Viewport's first picture"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--asset", default="cat")
    parser.add_argument("--learn-size", type=int, default=400, help="of the photographs that are learned from")
    parser.add_argument("--steps", type=int, default=1000, help="of learning")
    parser.add_argument("--surfels", type=int, default=16000, help="that are learned, at most")
    parser.add_argument("--particles", type=int, default=100_000, help="of simulated matter")
    parser.add_argument("--pair", action="store_true", help="only the CPU with all threads, and the card")
    options = parser.parse_args()
    mesh = read_asset(asset_path(options.asset, max_triangles=82000)).mesh
    scene = TraceScene()
    shades = mesh.albedo, mesh.roughness, mesh.metallic
    scene.update([TraceObject(options.asset, mesh.vertices, mesh.faces, *shades)])
    camera = pinhole(frame_camera(mesh.vertices, options.size, azimuth=-60, fill=0.66))
    settings = RenderSettings(samples=32, bounces=1, camera_sees="mesh", subpixel_samples=4)
    points = primary_mesh(scene, camera, camera_parameters(camera, settings, 1), 0, options.size).points
    light = EnvironmentLight(World(environment=read_environment(environments() / "city.exr").radiance))

    def run(processor: RenderBackend, threads: int) -> tuple[Radiance, float, float]:
        """The light, seconds of the first time, and the median of the others."""
        use_threads(threads)
        seconds = []
        for _ in range(options.runs + 1):
            began = time.perf_counter()
            found = processor.integrate(scene, light, points, replace(settings, threads=threads), 1)
            seconds.append(time.perf_counter() - began)
        use_threads(0)
        if processor.failed:
            raise DeviceError("device", processor.failed, "")
        return found, seconds[0], statistics.median(seconds[1:])

    cards = cuda_devices()
    made: dict[str, tuple[Radiance, float, float] | None] = {ROWS[0]: run(CPU, 0)}
    if not options.pair:
        made |= {ROWS[1]: run(CPU, 1), ROWS[2]: run(WarpRenderBackend("cpu"), 1)}
    made[ROWS[3]] = run(WarpRenderBackend(cards[0]), 0) if cards else None
    reference, _, whole = made[ROWS[0]] or (Radiance.dark(0), 0.0, 1.0)
    rows = []
    for name, result in made.items():
        if result is None:
            rows.append([name, *[NOT_MEASURED] * 5])
            continue
        found, first, seconds = result
        alike = float((found.components == reference.components).all(axis=(1, 2)).mean())
        times = f"{first:.1f} s", f"{seconds:.3f} s", f"{whole / seconds:.2f}"
        likeness = "the reference" if found is reference else psnr(found.total, reference.total)
        rows.append([name, *times, likeness, f"{100 * alike:.1f} %"])
    body = (
        f"Light of {len(points)} points ({options.size}x{options.size}, 4 positions a pixel, 82k triangles, city HDRI, "
        f"{settings.samples} samples, one bounce), the same samples and seeds everywhere; medians of {options.runs} "
        f"runs, "
        "copies to and from the device included. The first time includes compiling what the folder of kernels lacks. "
        "Held to: 60 dB between devices."
        + ("" if options.pair else WARP_ON_A_PROCESSOR)
        + "\n\n"
        + table(["Where", "First time", "Seconds", "Speed", "PSNR of the light", "Points alike to the last bit"], rows)
    )
    body += (
        f"\n\nWhole pictures of the same view: {options.size}x{options.size}, surfels, 32 samples, one bounce, SVGF, "
        "by the session that Blender talks to, every vertex moved before each. Held to: 60 a second on a data-centre "
        "card, a viewport's first picture after 33 ms.\n\n"
    )
    body += frames(options, cards)
    body += matter(options.particles, 24, options.pair)
    body += "\n\n" + learning(
        asset_path(options.asset, max_triangles=82000),
        options.learn_size,
        options.steps,
        options.surfels,
        NOT_MEASURED,
        options.pair,
    )
    if cards:
        body += f"\n\nCard: {warp().get_device(cards[0]).name}."
        write_section("card", "A graphics card", body)
    else:
        write_section("device", "Devices", body)


if __name__ == "__main__":
    main()
