"""Photographs to assets, all stages: views left out, relit, relit and deformed, materials and shape against the truth.

python bench/bench_asset.py --scenes scenes [--objects spot fern] [--minutes 7 | --steps 3000 2500] [--rays 128]

Scenes are those of `drgs evaluate --make-scenes scenes`. Rows are kept, so that objects may be measured one by one. An
object of 256 pixels takes its minutes and three more for the pictures that score it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_evaluate import mean, score, under_other_lights
from report import OUT, keep, table, write_section
from scipy.spatial import cKDTree

from drgs_blender.asset.container import read_asset, write_asset
from drgs_blender.asset.model import MATERIAL_CHANNELS, Asset, Mesh, Surfels
from drgs_blender.evaluate.truth import read_truth, true_asset
from drgs_blender.reconstruct.job import Settings, reconstruct
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.reconstruct.train import Schedule

Array = np.ndarray

FOLDER = OUT / "assets"
COLUMNS = (
    "Object", "Primary", "Views left out: frame / foreground", "Relit scaled: frame / foreground",
    "Relit with the true materials",
    "Relit and deformed scaled: frame / foreground", "Normals deg", "Silhouettes", "Albedo scaled",
    "Roughness / metallic RMSE",
)  # fmt: skip


def settings_of(options: argparse.Namespace) -> Settings:
    """What the options ask for; steps where they bound the run, so that a busy machine gives the same figures."""
    if options.minutes:
        return Settings(minutes=options.minutes)
    learning, decoupling = options.steps
    base = Settings(schedule=Schedule(iterations=learning))
    return replace(base, decoupling=replace(base.decoupling, iterations=decoupling))


def pair(rows: list[dict[str, Any]]) -> str:
    """Relit pictures, scaled: the whole frame and the foreground."""
    return f"{mean(rows, 'scaled', 'full'):.2f} / {mean(rows, 'scaled', 'foreground'):.2f}"


def with_true_materials(asset: Asset, folder: Path, primary: str, rays: int) -> str:
    """What errors of shape alone cost: relit with the true materials of the nearest vertices.

    No bound: materials that were learned on this shape may make up for some of it.
    """
    truth = read_truth(folder)
    assert truth is not None
    true = true_asset(folder).mesh
    tree = cKDTree(true.vertices)

    def with_truth(part: Surfels | Mesh, points: Array) -> Surfels | Mesh:
        nearest = tree.query(points)[1]
        return replace(part, **{name: getattr(true, name)[nearest] for name in MATERIAL_CHANNELS})

    known = replace(
        asset,
        surfels=with_truth(asset.surfels, asset.surfels.centre),
        mesh=with_truth(asset.mesh, asset.mesh.vertices),
        environment=None,
    )
    path = FOLDER / f"{folder.name}-true-materials.drgs"
    write_asset(path, known)
    others = [item for item in truth.sets if not item.posed and item.light != truth.training_light]
    return pair(under_other_lights(score(path, folder, primary, rays, replace(truth, sets=others)), False))


def row(report: dict[str, Any], true_materials: str) -> list[str]:
    """Cells of a report, and what stands beside it."""
    novel, geometry, materials = report["novel"], report["geometry"], report["materials"]
    lit = [under_other_lights(report, posed) for posed in (False, True)]
    return [
        f"{novel['psnr']:.2f} / {novel['psnr_foreground']:.2f}",
        pair(lit[0]),
        true_materials,
        pair(lit[1]),
        f"{geometry['normal_degrees']:.2f}",
        f"{geometry['silhouette_iou']:.4f}",
        f"{materials['albedo_psnr_scaled']:.2f}",
        f"{materials['roughness_rmse']:.3f} / {materials['metallic_rmse']:.3f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--objects", nargs="+", default=["spot"])
    parser.add_argument("--minutes", type=float, help="of all stages; else the steps decide")
    parser.add_argument("--steps", type=int, nargs=2, default=(3000, 2500), help="of surfels, of materials and light")
    parser.add_argument("--rays", type=int, default=128)
    parser.add_argument("--again", action="store_true", help="score assets that are there, learn none")
    options = parser.parse_args()
    for name in options.objects:
        capture = read_capture(options.scenes / name)
        path = FOLDER / f"{name}.drgs"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not options.again or not path.exists():
            write_asset(path, reconstruct(capture, settings_of(options)))
        asset = read_asset(path)
        for primary in ("surfels", "mesh"):
            other = with_true_materials(asset, options.scenes / name, primary, options.rays)
            found = row(score(path, options.scenes / name, primary, options.rays), other)
            rows = keep(FOLDER / "rows.json", f"{name}|{primary}", found)
            print(name, primary, *found, flush=True)
    side = max(capture.views[0].colour.shape[:2])
    bound = f"{options.minutes:g} minutes" if options.minutes else "{} and {} steps".format(*options.steps)
    body = (
        f"{bound}, {len(capture.training)} photographs of {side} pixels by Cycles; PSNR in dB over the frame on white, "
        f"and of the foreground; scaled by one factor a channel; means over the other lights. With "
        f"the true materials: on the asset's own shape; no bound: learned ones may make up for its errors.\n\n"
    )
    cells = [(*key.split("|"), *cells) for key, cells in rows.items()]
    write_section("asset", "Photographs to assets", body + table(COLUMNS, cells))


if __name__ == "__main__":
    main()
