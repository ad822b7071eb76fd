"""Real photographs through both stages: views left out, by the surfels' own colours and by materials under their light.

python bench/bench_photographs.py --capture ethiopianHead_1000 [--size 256] [--steps 3000 2500] [--turntable no]

No truth is known of them but the photographs themselves. Views are left out by the capture, else every eighth. Surfels
are learned once and kept, and so are rows; --pictures draws photograph, surfels and materials beside each other.
"""

from __future__ import annotations

import argparse
import json
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
from drgs_blender.core.color import linear_to_srgb
from drgs_blender.core.file_types import TURNTABLE
from drgs_blender.core.frame import Camera, RenderSettings, World
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import Posed, compare
from drgs_blender.evaluate.metrics import mean_psnr, straight
from drgs_blender.reconstruct import held_out, pipeline
from drgs_blender.reconstruct.capture.capture import WHITE, Capture
from drgs_blender.reconstruct.capture.training_views import background_of, composed
from drgs_blender.reconstruct.losses.photometric import Photograph, structural_similarity
from drgs_blender.reconstruct.model.gaussians import Gaussians
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.reconstruct.settings import Settings

FOLDER = OUT / "photographs"
COLUMNS = (
    "Capture", "Pixels", "Light stands still", "Steps", "Surfels: whole / foreground dB", "SSIM", "on white",
    "Materials: whole / foreground dB", "SSIM", "on white", "Processor s, surfels / materials",
)  # fmt: skip


def learned(capture: Capture, schedule: Schedule, name: str) -> tuple[Gaussians, float]:
    """The surfels of stage (i), kept from the first time on, and what they cost in processor seconds."""
    file = FOLDER / f"{name}.npz"
    if not file.exists():
        training, row = trained(capture, schedule, None)
        surfels, light = training.gaussians.arrays(), training.gaussians.light
        assert light is not None
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, light=light.detach().numpy(), spent=row["cpu"], **surfels)  # type: ignore[arg-type]
    with np.load(file) as kept:
        tensors = {key: torch.from_numpy(kept[key]) for key in kept.files}
    light, spent = tensors.pop("light"), float(tensors.pop("spent"))
    return Gaussians(tensors, light), spent


def decoupled(capture: Capture, gaussians: Gaussians, steps: int, path: Path) -> float:
    """Make the asset of these surfels, kept from the first time on; what that cost in processor seconds."""
    cost = path.with_suffix(".json")
    if not (path.exists() and cost.exists()):
        settings = Settings()
        settings = replace(settings, decoupling=replace(settings.decoupling, iterations=steps))
        begun = processor_seconds()
        with same_surfels(gaussians):
            write_asset(path, pipeline.reconstruct(capture, settings))
        cost.write_text(json.dumps(processor_seconds() - begun))
    return float(json.loads(cost.read_text()))


def relit(capture: Capture, path: Path, samples: int) -> tuple[list[Array], float]:
    """The views left out as the asset shows them by its own light, over `background_of` the capture; PSNR on white."""
    session, shown = Session(), []
    key = session.load_asset(path)
    lit = session_renderer(session, key, RenderSettings(samples=samples, bounces=3, camera_sees="surfels"))

    def keep(camera: Camera, light: World, pose: Posed | None) -> dict[str, Array]:
        passes = lit(camera, light, pose)
        linear, alpha = straight(passes)
        encoded = np.clip(linear_to_srgb(np.clip(linear, 0, 1)), 0, 1)
        shown.append(encoded * alpha[..., None] + background_of(capture) * (1 - alpha[..., None]))
        return passes

    return shown, compare(session.asset(key), capture, None, keep)["novel"]["psnr"]


def on_white(gaussians: Gaussians, capture: Capture) -> str:
    """PSNR of the surfels' own colours in the views left out, whole pictures, on white as `relit` has them."""
    if capture.background is not None:
        return "-"
    shown, true = [], []
    for view in capture.testing:
        with torch.no_grad():
            shown.append(gaussians.render(view.camera, torch.ones(3), turn=view.turn).colour.numpy().clip(0, 1))
        true.append(view.laid_on(WHITE, None))
    return f"{mean_psnr(shown, true):.2f}"


def figures(shown: list[Array], capture: Capture) -> tuple[str, str]:
    """PSNR of whole pictures and of the foreground, and SSIM, means of the views left out."""
    true = [composed(view, capture) for view in capture.testing]
    inside = [
        np.ones(view.colour.shape[:2], bool) if view.mask is None else view.mask > 0.5 for view in capture.testing
    ]
    similar = np.mean([structural_similarity(a.astype(np.float32), Photograph.of(b)) for a, b in zip(shown, true)])
    return f"{mean_psnr(shown, true):.2f} / {mean_psnr(shown, true, inside):.2f}", f"{similar:.4f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, required=True)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--steps", type=int, nargs=2, default=(Schedule().iterations, Settings().decoupling.iterations))
    parser.add_argument("--turntable", choices=TURNTABLE, default="auto")
    parser.add_argument("--mask", type=float, default=Schedule().mask, help="its weight in stage (i)")
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    capture = read_capture(options.capture, options.size, 8, turntable=options.turntable)
    still = "with the camera" if capture.turned else "in the world"
    schedule = Schedule(iterations=options.steps[0], mask=options.mask)
    kind = f"{'turned' if capture.turned else 'still'}-mask{options.mask:g}"
    name = f"{options.capture.name}-{options.size}-{options.steps[0]}-{kind}"
    gaussians, spent = learned(capture, schedule, name)
    own = [held_out.drawn(gaussians, view, capture) for view in capture.testing]
    path = FOLDER / f"{name}-{options.steps[1]}.drgs"
    costs = spent, decoupled(capture, gaussians, options.steps[1], path)
    shown, lit_on_white = relit(capture, path, options.samples)
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
        for view, *drawn in zip(capture.testing, own, shown, strict=True):
            pixels = (255 * np.concatenate([composed(view, capture), *drawn], axis=1)).round().astype(np.uint8)
            Image.fromarray(pixels).save(options.pictures / f"{name}-{view.name}.png")
    steps = " / ".join(map(str, options.steps))
    if options.mask != Schedule().mask:
        steps += f", mask {options.mask:g}"
    row = [
        *(options.size, still, steps, *figures(own, capture), on_white(gaussians, capture)),
        *(*figures(shown, capture), f"{lit_on_white:.2f}"),
        " / ".join(f"{seconds:.0f}" for seconds in costs),
    ]
    print(options.capture.name, *row, flush=True)
    rows = store_row(FOLDER / "rows.json", f"{options.capture.name}|{options.size}|{still}|{steps}", row)
    body = (
        "Means over the views left out, which no stage has seen, over one background (grey where the real one is cut "
        "away): the surfels' own colours; and relit with the light that was recovered, camera sees surfels, "
        f"{options.samples} samples; on white as `drgs evaluate` has it, where outlines of dark objects count more. "
        "Foreground: where masks are above one half. Steps of surfels / of materials.\n\n"
    )
    cells = [(key.split("|")[0], *cells) for key, cells in sorted(rows.items())]
    write_section("photographs", "Real photographs", body + table(COLUMNS, cells))


if __name__ == "__main__":
    main()
