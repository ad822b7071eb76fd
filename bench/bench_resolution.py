"""What larger photographs bring: the whole pipeline, scored against the same pictures of the truth.

python bench/bench_resolution.py --photographs scenes-512/robot scenes-800/cat --truth scenes-256
    [--surfels 16000 --voxels 256] [--iterations 3000] [--samples 64] [--threads 2]

PHOTOGRAPHS are scenes of `drgs evaluate --make-scenes` at any size; TRUTH has scenes of the same objects under the same
first light, whose test views, other lights and shape judge. Without --surfels and --voxels these are the defaults,
which follow the photographs. Rows are kept, so that captures may be measured one by one.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch
from bench_asset import FOLDER as ASSETS
from bench_evaluate import mean, score, similarity, under_other_lights
from report import OUT, processor_seconds, store_row, table, write_section

from drgs_blender.core.asset.container import write_asset
from drgs_blender.evaluate.truth import read_truth
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.pipeline import Settings, reconstruct
from drgs_blender.reconstruct.readers import read_capture

COLUMNS = (
    "Object", "Photographs", "Surfels", "Vertices", "Normals deg, surfels / mesh", "Relit scaled, surfels / mesh",
    "Relit: SSIM / FLIP", "Views left out", "Albedo scaled", "Roughness / metallic RMSE", "Silhouettes",
    "Processor s", "s",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=Path, nargs="+", required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--surfels", type=int, help="at most; default: as many as the photographs show")
    parser.add_argument("--voxels", type=int, help="of the longest side; default: as the photographs show")
    parser.add_argument("--iterations", type=int, default=Schedule().iterations)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    for folder in options.photographs:
        name, folder_of_truth = folder.name, options.truth / folder.name
        learned, truth = read_truth(folder), read_truth(folder_of_truth)
        if truth is None:
            parser.error(f"{folder_of_truth} has no truth.json: name a folder of `drgs evaluate --make-scenes`")
        if learned is not None and learned.training_light != truth.training_light:
            parser.error(f"{folder} was photographed under {learned.training_light}, the truth {truth.training_light}")
        capture = read_capture(folder)
        capture.views = [view for view in capture.views if not view.test]
        settings = Settings(
            schedule=Schedule(iterations=options.iterations, surfels=options.surfels), mesh_resolution=options.voxels
        )
        begun, wall = processor_seconds(), time.perf_counter()
        asset = reconstruct(capture, settings)
        spent = processor_seconds() - begun, time.perf_counter() - wall
        side = max(capture.views[0].colour.shape[:2])
        asked = {"surfels": options.surfels, "voxels": options.voxels, "steps": options.iterations}
        default = {"surfels": None, "voxels": None, "steps": Schedule().iterations}
        limit = "".join(f", {value} {what}" for what, value in asked.items() if value != default[what])
        path = ASSETS / f"{name}-{side}{limit.replace(', ', '-').replace(' ', '-')}.drgs"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_asset(path, asset)
        kept = [item for item in truth.sets if not item.posed]  # the shape follows poses as before
        reports = [
            score(path, folder_of_truth, sees, options.samples, replace(truth, sets=kept))
            for sees in ("surfels", "mesh")
        ]
        lit = [under_other_lights(report, False) for report in reports]
        first = reports[0]
        materials = first["materials"]
        row = [
            f"{len(capture.views)} of {side}{limit}",
            len(asset.surfels),
            len(asset.mesh.vertices),
            " / ".join(f"{report['geometry']['normal_degrees']:.2f}" for report in reports),
            " / ".join(f"{mean(rows, 'scaled', 'foreground'):.2f}" for rows in lit),
            similarity(lit[0]),
            f"{first['novel']['psnr_foreground']:.2f}",
            f"{materials['albedo_psnr_scaled']:.2f}",
            f"{materials['roughness_rmse']:.3f} / {materials['metallic_rmse']:.3f}",
            f"{first['geometry']['silhouette_iou']:.4f}",
            *(f"{seconds:.0f}" for seconds in spent),
        ]
        rows = store_row(OUT / "resolution.json", f"{name}|{row[0]}", row)
        print(name, *row, flush=True)
    body = (
        "Foregrounds under lights that were not photographed, scaled by one factor a channel; 256 x 256 pixels of the "
        f"same test views judge all rows. {Schedule().iterations} and {Settings().decoupling.iterations} steps, and "
        "surfels and voxels that follow the photographs, where nothing else stands there.\n\n"
    )
    cells = [(key.split("|")[0], *cells) for key, cells in sorted(rows.items())]
    write_section("resolution", "Larger photographs", body + table(COLUMNS, cells))


if __name__ == "__main__":
    main()
