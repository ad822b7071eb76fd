"""Steps of learning surfels from photographs, on every device there is: how many a second, and what they lead to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import ours
from judge import environments, frame_camera
from report import table

from drgs_blender.compute.threads import use_threads
from drgs_blender.core.asset.container import read_asset
from drgs_blender.core.color import linear_to_srgb
from drgs_blender.core.errors import DeviceError
from drgs_blender.reconstruct.backend import CPU, LearningBackend
from drgs_blender.reconstruct.capture.capture import Capture, View
from drgs_blender.reconstruct.gpu.select_backend import select_backend
from drgs_blender.reconstruct.gpu.warp_backend import WarpLearningBackend
from drgs_blender.reconstruct.held_out import held_out_metrics
from drgs_blender.reconstruct.meshing.visual_hull import find_region
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.optim.train import Training

#: Views around the object, every fourth left out; steps of a run that is not timed, which compiles.
VIEWS, FIRST = 24, 20


def photographs(path: Path, size: int) -> Capture:
    """An asset as our own renderer shows it from around it, lit by a city, before black."""
    vertices, views = read_asset(path).mesh.vertices, []
    for k in range(VIEWS):
        described = frame_camera(vertices, size, azimuth=360 * k / VIEWS)
        found = ours.relight(
            path, environments() / "city.exr", described, samples=32, subpixel_samples=4, denoise="svgf"
        )["Combined"]
        camera, colour, mask = ours.pinhole(described), linear_to_srgb(found[..., :3].clip(0, 1)), found[..., 3]
        views.append(View(f"{k:02d}", camera, colour.astype("float32"), mask.clip(0, 1), k % 4 == 0))
    return Capture(path, views, (0.0, 0.0, 0.0))


def learning(path: Path, size: int, steps: int, surfels: int, missing: str, pair: bool = False) -> str:
    """Table of the same steps everywhere, of a `pair` by the CPU and a card; `missing`: what cannot be measured."""
    capture = photographs(path, size)
    region, schedule = find_region(capture), Schedule(iterations=steps, surfels=surfels)

    def train(schedule: Schedule, backend: LearningBackend) -> Training:
        training = Training(capture, region, schedule, backend=backend)
        while not training.finished:
            training.step()
        if training.fallback.failed:
            raise DeviceError("device", training.fallback.failed, "")
        return training

    def run(backend: LearningBackend, threads: int) -> list[str]:
        use_threads(threads)
        train(replace(schedule, iterations=FIRST), backend)
        training = train(schedule, backend)
        use_threads(0)
        found = held_out_metrics(training.gaussians.on(CPU), capture)
        rate = f"{steps / training.time_budget.spent:.1f}"
        return [rate, f"{len(training.gaussians)}", f"{found['psnr']:.2f} dB", f"{found['ssim']:.4f}"]

    rows = [["Numba and torch, all threads", *run(CPU, 0)]]
    if not pair:
        rows.append(["Numba and torch, 1 thread", *run(CPU, 1)])
        rows.append(["Warp and torch on the processor, 1 thread", *run(WarpLearningBackend("cpu"), 1)])
    card = select_backend("cuda")
    rows.append(["Warp and torch on CUDA", *([missing] * 4 if card is CPU else run(card, 0))])
    head = (
        f"Surfels learned from {VIEWS * 3 // 4} pictures of {size}x{size} that our renderer made of the {path.stem}, "
        f"{steps} steps, at most {surfels} surfels, the whole schedule: half size first, surfels cut, mirrors, shape. "
        f"PSNR and SSIM are of the {VIEWS // 4} views left out; what differs grows out of last bits. Held to: 0.1 dB "
        "between devices; 15 minutes on a data-centre card for the paper's 30000 steps at 800x800 (`--learn-size 800 "
        "--steps 30000`).\n\n"
    )
    return head + table(["Where", "Steps a second", "Surfels", "PSNR", "SSIM"], rows)
