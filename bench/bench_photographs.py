"""Real photographs through both stages: views left out, by the surfels' own colours and by materials under their light.

python bench/bench_photographs.py --capture ethiopianHead_1000 [--size 256] [--steps 3000 2500] [--turntable no]

No truth is known of them but the photographs themselves. Views are left out by the capture, else every eighth. Surfels
are learned once and kept, and so are rows; --pictures draws photograph, surfels and materials beside each other.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from bench_normals import same_surfels
from bench_reconstruct import trained
from PIL import Image
from report import OUT, processor_seconds, store_row, table, write_section

from drgs_blender.cli.evaluate import session_renderer
from drgs_blender.core.arrays import Array
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.file_types import TURNTABLE
from drgs_blender.core.frame import RenderSettings
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import compare
from drgs_blender.reconstruct import pipeline
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.capture.training_views import composed
from drgs_blender.reconstruct.model.gaussians import Gaussians
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.reconstruct.settings import Settings

FOLDER = OUT / "photographs"
COLUMNS = (
    "Capture", "Pixels", "Light stands still", "Steps", "Surfels: whole / foreground dB", "SSIM",
    "Materials: whole / foreground dB", "SSIM", "Processor s, surfels / materials",
)  # fmt: skip


def learned(capture: Capture, steps: int, name: str) -> tuple[Gaussians, float]:
    """The surfels of stage (i), kept from the first time on, and what they cost in processor seconds."""
    file = FOLDER / f"{name}.npz"
    if not file.exists():
        training, row = trained(capture, Schedule(iterations=steps), None)
        surfels, light = training.gaussians.arrays(), training.gaussians.light
        assert light is not None
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, light=light.detach().numpy(), spent=row["cpu"], **surfels)  # type: ignore[arg-type]
    with np.load(file) as kept:
        tensors = {key: torch.from_numpy(kept[key]) for key in kept.files}
    light, spent = tensors.pop("light"), float(tensors.pop("spent"))
    return Gaussians(tensors, light), spent


def foreground(gaussians: Gaussians, capture: Capture) -> float:
    """PSNR of the surfels' own colours where the masks show the object, the mean of the views left out."""
    found = []
    for view in capture.testing:
        squared = np.square(pipeline.drawn(gaussians, view, capture) - composed(view, capture))
        inside = slice(None) if view.mask is None else view.mask > 0.5
        found.append(-10 * np.log10(squared[inside].mean()))
    return float(np.mean(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, required=True)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--steps", type=int, nargs=2, default=(Schedule().iterations, Settings().decoupling.iterations))
    parser.add_argument("--turntable", choices=TURNTABLE, default="auto")
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    capture = read_capture(options.capture, options.size, 8, turntable=options.turntable)
    still = "with the camera" if capture.turned else "in the world"
    name = f"{options.capture.name}-{options.size}-{options.steps[0]}-{'turned' if capture.turned else 'still'}"
    gaussians, spent = learned(capture, options.steps[0], name)
    own = pipeline.held_out_metrics(gaussians, capture)
    settings = Settings()
    settings = replace(settings, decoupling=replace(settings.decoupling, iterations=options.steps[1]))
    begun = processor_seconds()
    with same_surfels(gaussians):
        asset = pipeline.reconstruct(capture, settings)
    costs = spent, processor_seconds() - begun
    path = FOLDER / f"{name}-{options.steps[1]}.drgs"
    write_asset(path, asset)
    session = Session()
    key = session.load_asset(path)
    lit = session_renderer(session, key, RenderSettings(samples=options.samples, bounces=3, camera_sees="surfels"))

    def show(_: str, number: int, ours: Array, true: Array) -> None:
        if options.pictures is not None:
            strip = np.concatenate([true, pipeline.drawn(gaussians, capture.testing[number], capture), ours], axis=1)
            options.pictures.mkdir(parents=True, exist_ok=True)
            pixels = (255 * strip.clip(0, 1)).round().astype(np.uint8)
            Image.fromarray(pixels).save(options.pictures / f"{name}-{number:03d}.png")

    found = compare(session.asset(key), capture, None, lit, show=show)["novel"]
    steps = " / ".join(map(str, options.steps))
    row = [
        *(options.size, still, steps, f"{own['psnr']:.2f} / {foreground(gaussians, capture):.2f}"),
        *(f"{own['ssim']:.4f}", f"{found['psnr']:.2f} / {found['psnr_foreground']:.2f}", f"{found['ssim']:.4f}"),
        " / ".join(f"{seconds:.0f}" for seconds in costs),
    ]
    print(options.capture.name, *row, flush=True)
    rows = store_row(FOLDER / "rows.json", f"{options.capture.name}|{options.size}|{still}|{steps}", row)
    body = (
        "Means over the views left out, which no stage has seen: the surfels' own colours before grey (or the "
        "pictures' own background), and relit with the light that was recovered, camera sees surfels, "
        f"{options.samples} samples, on white. Foreground: where masks are above one half. Steps of surfels / of "
        "materials.\n\n"
    )
    cells = [(key.split("|")[0], *cells) for key, cells in sorted(rows.items())]
    write_section("photographs", "Real photographs", body + table(COLUMNS, cells))


if __name__ == "__main__":
    main()
