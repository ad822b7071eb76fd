"""Photographs to assets, all stages: views left out, relit, relit and deformed, materials and shape against the truth.

python bench/bench_asset.py --scenes scenes [--objects spot fern] [--time-budget 7 | --steps 3000 2500] [--variant m]
python bench/bench_asset.py --scenes scenes --objects spot fern --deformed
python bench/bench_asset.py --scenes scenes --objects spot fern --sheet

Scenes are those of `drgs evaluate --make-scenes scenes`. Rows are kept, so that objects may be measured one by one, and
assets, of which --sheet draws some and --deformed scores again how their surfels follow a pose. An object of 256 pixels
takes its minutes and three more for what scores it.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_evaluate import how_made, mean, of_truth, score, similarity, under_other_lights
from decouple_score import with_materials_of
from PIL import Image
from report import DOCUMENT, OUT, add_publish, picture_path, store_row, table, write_section

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset
from drgs_blender.evaluate.truth import Truth, read_truth, true_asset
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.pipeline import Progress, Settings, reconstruct
from drgs_blender.reconstruct.readers import read_capture

FOLDER = OUT / "assets"
FIGURE = "assets.png"
#: What the sheet shows.
LIGHT, VIEW = "city", 1
DEFORMED, DEFORMED_SIMILARITY = "Relit and deformed scaled: frame / foreground", "Relit and deformed: SSIM / FLIP"
COLUMNS = (
    "Object", "Primary", "Views left out: frame / foreground", "Relit scaled: frame / foreground",
    "Relit with the true materials", "Relit, the true asset",
    DEFORMED, "Normals deg", "Silhouettes", "Albedo scaled",
    "Roughness / metallic RMSE", "Seconds after stage (i)", "Relit: SSIM / FLIP", DEFORMED_SIMILARITY,
)  # fmt: skip


def settings_of(options: argparse.Namespace) -> Settings:
    """What the options ask for; steps where they bound the run, so that a busy machine gives the same figures."""
    if options.time_budget:
        return Settings(minutes=options.time_budget, variant=options.variant)
    learning, decoupling = options.steps
    base = Settings(schedule=Schedule(iterations=learning), variant=options.variant)
    return replace(base, decoupling=replace(base.decoupling, iterations=decoupling))


def pair(rows: list[dict[str, Any]]) -> str:
    """Relit pictures, scaled: the whole frame and the foreground."""
    return f"{mean(rows, 'scaled', 'full'):.2f} / {mean(rows, 'scaled', 'foreground'):.2f}"


def with_true_materials(asset: Asset, folder: Path) -> Path:
    """The asset with the true materials of the nearest vertices: what errors of shape alone cost.

    No bound: materials that were learned on this shape may make up for some of it.
    """
    true = true_asset(folder).mesh
    surfels = with_materials_of(true, asset.surfels, asset.surfels.centre)
    mesh = with_materials_of(true, asset.mesh, asset.mesh.vertices)
    path = FOLDER / f"{folder.name}-true-materials.drgs"
    write_asset(path, replace(asset, surfels=surfels, mesh=mesh, environment=None))
    return path


def relit_truth(folder: Path, posed: bool = False, views: int | None = None) -> Truth:
    """What is known of a scene under the lights that were not photographed: all views of each, or the first `views`."""
    truth = read_truth(folder)
    assert truth is not None
    sets = [item for item in truth.sets if item.posed == posed and item.light != truth.training_light]
    return replace(truth, sets=[replace(item, views=item.views[:views]) for item in sets])


def reconstruct_timed(capture: Capture, settings: Settings) -> tuple[Asset, float]:
    """An asset, and the seconds after stage (i): of the mesh, the materials and the light."""
    began: list[float] = []

    def watch(progress: Progress) -> None:
        if progress.phase != "surfels" and not began:
            began.append(time.monotonic())

    asset = reconstruct(capture, settings, watch)
    return asset, time.monotonic() - began[0]


def row(report: dict[str, Any], beside: list[str], seconds: float) -> list[str]:
    """Cells of a report, and what stands `beside` its relit pictures."""
    novel, geometry, materials = report["novel"], report["geometry"], report["materials"]
    lit = [under_other_lights(report, posed) for posed in (False, True)]
    return [
        f"{novel['psnr']:.2f} / {novel['psnr_foreground']:.2f}",
        pair(lit[0]),
        *beside,
        pair(lit[1]),
        f"{geometry['normal_degrees']:.2f}",
        f"{geometry['silhouette_iou']:.4f}",
        f"{materials['albedo_psnr_scaled']:.2f}",
        f"{materials['roughness_rmse']:.3f} / {materials['metallic_rmse']:.3f}",
        f"{seconds:.0f}",
        *map(similarity, lit),
    ]


def rescore_deformed(objects: list[str], scenes: Path, samples: int) -> None:
    """Score how kept assets look deformed, without learning them again; the rest of their rows stays."""
    before, section = DOCUMENT.read_text(encoding="utf-8").split("<!-- begin asset -->")
    for name, sees in itertools.product(objects, ("surfels", "mesh")):
        truth = relit_truth(scenes / name, posed=True)
        found = score(FOLDER / f"{name}.drgs", scenes / name, sees, samples, truth)["lights"]
        line = next(line for line in section.splitlines() if line.startswith(f"| {name} | {sees} |"))
        cells = line.strip("| ").split(" | ")
        columns = next(line for line in section.splitlines() if line.startswith(f"| {COLUMNS[0]} |"))
        for column, cell in ((DEFORMED, pair(found)), (DEFORMED_SIMILARITY, similarity(found))):
            if column in columns:  # the page may be older than the column
                cells[columns.strip("| ").split(" | ").index(column)] = cell
        section = section.replace(line, f"| {' | '.join(cells)} |")
        store_row(FOLDER / "rows.json", f"{name}|{sees}", cells[2:])
        print(*cells, flush=True)
    DOCUMENT.write_text(f"{before}<!-- begin asset -->{section}", encoding="utf-8")


def sheet(options: argparse.Namespace) -> None:
    """Of each asset one view: as photographed; under another light, the true one and ours; the same bent."""
    rows = []
    for name in options.objects:
        folder = options.scenes / name
        truth = read_truth(folder)
        assert truth is not None
        shown: dict[str, tuple[np.ndarray, np.ndarray]] = {}

        def show(name: str, _: int, ours: np.ndarray, true: np.ndarray, shown: dict = shown) -> None:
            shown[name] = (true, ours)

        wanted = [
            replace(item, views=[item.views[VIEW]], maps=item.maps[VIEW : VIEW + 1])
            for item in truth.sets
            if item.name in ("test", f"relit-{LIGHT}", f"posed-{LIGHT}")
        ]
        score(FOLDER / f"{name}.drgs", folder, "surfels", options.samples, replace(truth, sets=wanted), show)
        row = (shown["test"][0], *shown[f"relit-{LIGHT}"], *shown[f"posed-{LIGHT}"])
        rows.append(np.concatenate(row, axis=1))
    pixels = np.concatenate(rows).clip(0, 1)
    Image.fromarray((255 * pixels + 0.5).astype(np.uint8)).save(picture_path(FIGURE, options), optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--objects", nargs="+", default=["spot"])
    parser.add_argument("--time-budget", type=float, help="of all stages; else the steps decide")
    parser.add_argument("--steps", type=int, nargs=2, default=(3000, 2500), help="of surfels, of materials and light")
    parser.add_argument("--variant", choices=("p", "m"), default="p", help="m: surfels on the mesh")
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--deformed", action="store_true", help="score the assets that are there, deformed, again")
    parser.add_argument("--sheet", action="store_true", help="draw the assets that are there")
    add_publish(parser)
    options = parser.parse_args()
    if options.sheet:
        return sheet(options)
    if options.deformed:
        return rescore_deformed(options.objects, options.scenes, options.samples)
    for name in options.objects:
        capture = read_capture(options.scenes / name)
        folder, path = options.scenes / name, FOLDER / f"{name}.drgs"
        path.parent.mkdir(parents=True, exist_ok=True)
        asset, seconds = reconstruct_timed(capture, settings_of(options))
        write_asset(path, asset)
        relit, references = relit_truth(folder), (with_true_materials(asset, folder), of_truth(folder))
        for camera_sees in ("surfels",) if options.variant == "m" else ("surfels", "mesh"):  # the mesh is one
            beside = [pair(score(one, folder, camera_sees, options.samples, relit)["lights"]) for one in references]
            found = row(score(path, folder, camera_sees, options.samples), beside, seconds)
            seen = "surfels (M)" if options.variant == "m" else camera_sees
            rows = store_row(FOLDER / "rows.json", f"{name}|{seen}", found)
            print(name, camera_sees, *found, flush=True)
    side = max(capture.views[0].colour.shape[:2])
    bound = f"{options.time_budget:g} minutes" if options.time_budget else "{} and {} steps".format(*options.steps)
    body = (
        f"{bound}, {len(capture.training)} photographs of {side} pixels by Cycles; PSNR in dB over the frame on white, "
        f"and of the foreground; scaled by one factor a channel, as are the pictures of SSIM and FLIP, on white; means "
        f"over the other lights. With the true materials: "
        f"on the own shape; no bound, as learned ones may make up for its errors. The true asset: the ceiling. "
        f"{how_made(options.scenes)}\n\n"
        f"![One view of each: as photographed; under another light, Cycles and ours; bent](images/{FIGURE})\n\n"
    )
    cells = [(*key.split("|"), *cells) for key, cells in sorted(rows.items())]
    write_section("asset", "Photographs to assets", body + table(COLUMNS, cells))


if __name__ == "__main__":
    main()
