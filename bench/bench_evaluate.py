"""Scenes with known truth: what Cycles needs for a view, what the true object scores, the ceiling of reconstructions.

python bench/bench_evaluate.py [--size 128] [--test 8] [--samples 64] [--rays 256] [--objects spot fern]

The true mesh, materials and lights are rendered by our renderer and compared with Cycles' pictures, once with the mesh
as what the camera sees, once with surfels that were made from it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from report import OUT, ROOT, processor_seconds, table, write_section

from drgs_blender.asset.container import write_asset
from drgs_blender.cli.evaluate import session_renderer
from drgs_blender.cli.find_blender import find_blender
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import compare
from drgs_blender.evaluate.scenes import Plan, make_scenes
from drgs_blender.evaluate.subjects import OBJECTS
from drgs_blender.evaluate.truth import Truth, read_truth, true_asset
from drgs_blender.frame import RenderSettings, split_rays
from drgs_blender.reconstruct.readers import read_capture


def score(path: Path, folder: Path, primary: str, rays: int, truth: Truth | None = None) -> dict:
    """The report of an asset of a scene, against all that is known of it or `truth`."""
    session = Session()
    key = session.load_asset(path)
    cosine, ggx, environment = split_rays(rays)
    settings = RenderSettings(cosine=cosine, ggx=ggx, environment=environment, bounces=3, primary=primary)  # type: ignore[arg-type]
    return compare(
        session.asset(key), read_capture(folder), truth or read_truth(folder), session_renderer(session, key, settings)
    )


def of_truth(folder: Path) -> Path:
    """The true asset of a scene."""
    path = folder.parent / f"{folder.name}-true.drgs"
    if not path.exists():
        write_asset(path, true_asset(folder))
    return path


def under_other_lights(report: dict, posed: bool) -> list[dict]:
    """The rows of a report under lights that the photographs do not show."""
    return [row for row in report["lights"] if row["posed"] == posed and not row["training_light"]]


def mean(rows: list[dict], kind: str, region: str) -> float:
    return float(np.mean([row[kind][region] for row in rows]))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--test", type=int, default=8)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--rays", type=int, default=256)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS))
    args = parser.parse_args()
    plan = Plan(tuple(args.objects), args.size, 2, args.test, args.samples)
    out = OUT / f"scenes-{args.size}-{args.test}-{args.samples}"
    command = find_blender().command(ROOT / "drgs_blender" / "evaluate" / "scene_job.py")
    before, rendered = processor_seconds(children=True), len(list(out.glob("*/*/*.png")))
    folders = make_scenes(out, plan, command, ROOT / "examples")
    made = len(list(out.glob("*/*/*.png"))) - rendered
    spent = processor_seconds(children=True) - before
    cost = f"{spent / made:.2f} processor seconds a view" if made else "views were there already"
    rows = []
    for folder in folders:
        for primary in ("mesh", "surfels"):
            report = score(of_truth(folder), folder, primary, args.rays)
            rest, posed = under_other_lights(report, False), under_other_lights(report, True)
            materials, geometry = report["materials"], report["geometry"]
            rows.append(
                (
                    folder.name,
                    primary,
                    f"{100 * rest[0]['coverage']:.0f} %",
                    f"{report['novel']['psnr']:.1f} / {report['novel']['psnr_foreground']:.1f}",
                    f"{mean(rest, 'raw', 'foreground'):.1f} / {mean(rest, 'scaled', 'foreground'):.1f}",
                    f"{mean(rest, 'scaled', 'full'):.1f} / {np.mean([row['published'] for row in rest]):.1f}",
                    f"{mean(posed, 'raw', 'foreground'):.1f} / {mean(posed, 'scaled', 'foreground'):.1f}",
                    f"{np.mean([row['flip'] for row in rest]):.4f}",
                    f"{geometry['normal_degrees']:.2f}",
                    f"{materials['albedo_psnr']:.1f}",
                    f"{materials['roughness_rmse']:.3f} / {materials['metallic_rmse']:.3f}",
                )
            )
            print(*rows[-1], flush=True)
    columns = (
        *(
            "Object",
            "Camera sees",
            "Foreground",
            "Views left out: frame / foreground",
            "Relit, foreground: raw / scaled",
        ),
        *("Relit, frame: scaled / published way", "Relit and deformed, foreground: raw / scaled", "FLIP relit"),
        *("Normals, degrees", "Albedo", "Roughness / metallic RMSE"),
    )
    text = f"""
The true mesh, materials and light against Cycles' pictures of them: the ceiling of every reconstruction of these
scenes. {args.size} x {args.size} pixels, {args.test} test views, 3 other lights, {args.samples} samples and denoiser
of Cycles ({cost}), {args.rays} rays of ours without a denoiser. PSNR in dB on white; "published way" fits a scale an
image to 8-bit values, white background included.

{table(columns, rows)}
"""
    write_section("evaluate", "Scenes with known truth: the ceiling", text)


if __name__ == "__main__":
    main()
