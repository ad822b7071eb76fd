"""Stage (ii) the paper's way, surfels learned together with materials and light, against surfels that stay.

python bench/bench_joint.py --capture scenes/cat [--size 256] [--steps 1000] [--ways on-the-mesh last-half all]
python bench/bench_joint.py --capture scenes/fern --part rays

The second, after the first, renders what it made: what light meets of a thin object.

Scenes are those of `drgs evaluate --make-scenes scenes`. Surfels of stage (i) are those of `bench_normals.learned`;
rows are kept, so that captures may be measured one by one.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from bench_evaluate import mean, score
from bench_normals import FIGURES, FOLDER, figures, learned, same_surfels
from report import processor_seconds, store_row, table, write_section

from drgs_blender.cli.evaluate import session_renderer
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.frame import RenderSettings
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import compare
from drgs_blender.evaluate.truth import Truth, read_truth
from drgs_blender.reconstruct import pipeline
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.reconstruct.settings import Settings

#: Way -> its name in the table, and settings of decoupling.
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "on-the-mesh": ("surfels stay, materials on the mesh", {"domain": "mesh"}),
    "on-surfels": ("surfels stay, materials on them", {"domain": "surfels"}),
    "blurred": ("on the mesh, surfels take the values of where they hang", {"domain": "mesh"}),
    "last-half": ("surfels learned in the last half", {"joint": 0.5}),
    "all": ("surfels learned from the first step", {"joint": 1.0}),
}
#: What light meets -> whether the asset is thin, and what rays see.
RAYS: dict[str, tuple[bool, Any]] = {
    "the mesh": (False, "mesh"),
    "sheets of the surfels (default)": (True, "mesh"),
    "surfels": (True, "surfels"),
}


def ways(capture: Capture, folder: Path, truth: Truth, name: str, options: argparse.Namespace) -> None:
    """Measure and write the ways of stage (ii)."""
    rows: dict[str, Any] = {}
    blurred = patch.object(pipeline, "blended_as", lambda gaussians, visible, start, *rest: start)
    for way in options.ways:
        label, change = WAYS[way]
        settings = Settings()
        settings = replace(settings, decoupling=replace(settings.decoupling, iterations=options.steps, **change))
        surfels = learned(capture, name)  # joint learning moves them
        begun = processor_seconds()
        with same_surfels(surfels), blurred if way == "blurred" else nullcontext():
            asset = pipeline.reconstruct(capture, settings)
        spent, path = processor_seconds() - begun, FOLDER / f"{name}-{way}.drgs"
        write_asset(path, asset)
        row = figures(score(path, folder, "surfels", options.samples, truth), spent)
        rows = store_row(FOLDER / "joint.json", f"{name}|{label}", row)
        print(name, label, *row, flush=True)
    body = (
        f"The same surfels of stage (i), then {options.steps} steps of stage (ii); the camera sees surfels. Normals in "
        "mean degrees, PSNR of the foreground in dB, relit under the lights that were not photographed, scaled by one "
        f"factor a channel, {options.samples} samples; SSIM and FLIP of these pictures on white.\n\n"
    )
    cells = [(*key.split("|"), *row) for key, row in rows.items()]
    write_section(
        "reconstruct-joint",
        "Surfels learned with their materials",
        body + table(("Object-pixels", "Stage (ii)", *FIGURES), cells),
    )


def rays(capture: Capture, folder: Path, truth: Truth, name: str, options: argparse.Namespace) -> None:
    """Measure and write what light meets, of the asset whose surfels stay."""
    path, rows = FOLDER / f"{name}-on-the-mesh.drgs", {}
    asset = read_asset(path)
    sets = [item for item in truth.sets if item.light != truth.training_light]
    unseen = replace(capture, views=capture.training)
    for label, (thin, rays_see) in RAYS.items():
        asset.provenance = asset.provenance | {"report": {"thin": thin}}
        write_asset(FOLDER / "thin.drgs", asset)
        session = Session()
        key = session.load_asset(FOLDER / "thin.drgs")
        settings = RenderSettings(samples=options.samples, bounces=3, camera_sees="surfels", rays_see=rays_see)
        render = session_renderer(session, key, settings)
        compare(session.asset(key), unseen, replace(truth, sets=[replace(sets[0], views=sets[0].views[:1])]), render)
        begun = processor_seconds()
        lights = compare(session.asset(key), unseen, replace(truth, sets=sets), render)["lights"]
        spent = (processor_seconds() - begun) / sum(len(item.views) for item in sets)
        figures = [f"{mean(lights, kind, 'foreground'):.2f}" for kind in ("raw", "scaled")]
        rows = store_row(FOLDER / "rays.json", f"{name}|{label}", [*figures, f"{spent:.2f}"])
        print(name, label, *rows[f"{name}|{label}"], flush=True)
    body = (
        "An asset of photographs whose surfels stayed in stage (ii) (the first of its rows above), relit under the "
        f"lights that were not photographed; foreground PSNR in dB, {options.samples} samples, the camera sees "
        "surfels.\n\n"
    )
    head = ("Object-pixels", "Light meets", "Relit raw", "Relit scaled", "Processor s a picture")
    cells = [(*key.split("|"), *row) for key, row in rows.items()]
    write_section("thin-rays", "What light meets of thin objects", body + table(head, cells))


PARTS: dict[str, Callable[..., None]] = {"ways": ways, "rays": rays}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=tuple(PARTS), default="ways")
    parser.add_argument("--capture", type=Path, required=True)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--ways", nargs="+", choices=tuple(WAYS), default=list(WAYS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    folder, name = options.capture, f"{options.capture.name}-{options.size}"
    capture, truth = read_capture(folder, options.size), read_truth(folder)
    if truth is None:
        parser.error(f"{folder} has no truth.json: name a folder of `drgs evaluate --make-scenes`")
    truth = replace(truth, sets=[item for item in truth.sets if not item.posed])
    PARTS[options.part](capture, folder, truth, name, options)


if __name__ == "__main__":
    main()
