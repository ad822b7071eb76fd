"""Scenes with known truth: what Cycles needs for a view, what the true object scores, the ceiling of reconstructions.

python bench/bench_evaluate.py [--size 128] [--test 8] [--spp 64] [--samples 256] [--objects spot fern]
python bench/bench_evaluate.py --scenes scenes [--samples 128] [--objects spot fern]

The true mesh, materials and lights are rendered by our renderer and compared with Cycles' pictures, once with the mesh
as what the camera sees, once with surfels that were made from it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from report import OUT, ROOT, processor_seconds, table, write_section

from drgs_blender.cli.evaluate import session_renderer
from drgs_blender.cli.find_blender import find_blender
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.frame import RenderSettings
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import Show, compare
from drgs_blender.evaluate.scenes import Plan, make_scenes
from drgs_blender.evaluate.subjects import OBJECTS
from drgs_blender.evaluate.truth import Truth, read_truth, true_asset
from drgs_blender.reconstruct.readers import read_capture

COLUMNS = (
    "Object", "Camera sees", "Foreground", "Views left out: frame / foreground", "Relit, foreground: raw / scaled",
    "Relit, frame: scaled / published way", "Relit and deformed, foreground: raw / scaled", "Relit: SSIM / FLIP",
    "Normals deg", "Albedo", "Roughness / metallic RMSE",
)  # fmt: skip


def score(
    path: Path, folder: Path, camera_sees: str, samples: int, truth: Truth | None = None, show: Show | None = None
) -> dict:
    """The report of an asset of a scene, against all that is known of it or `truth`."""
    session = Session()
    key = session.load_asset(path)
    settings = RenderSettings(samples=samples, bounces=3, camera_sees=camera_sees)  # type: ignore[arg-type]
    renderer = session_renderer(session, key, settings)
    return compare(session.asset(key), read_capture(folder), truth or read_truth(folder), renderer, show=show)


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


def similarity(rows: list[dict]) -> str:
    """SSIM and FLIP of relit pictures, scaled, the whole frame on white; a dash where FLIP was not computed."""
    means = [
        None if rows[0][name] is None else float(np.mean([row[name] for row in rows])) for name in ("ssim", "flip")
    ]
    return " / ".join("-" if value is None else f"{value:.4f}" for value in means)


def made(args: argparse.Namespace) -> tuple[Path, Plan, str]:
    """Where the scenes of the options are, how they were made, and what a view cost, in words."""
    if args.scenes:
        return args.scenes, Plan(**json.loads((args.scenes / "plan.json").read_text())), ""
    plan = Plan(tuple(args.objects), args.size, 2, args.test, args.spp)
    out = OUT / f"scenes-{args.size}-{args.test}-{args.spp}"
    command = find_blender().command(ROOT / "drgs_blender" / "evaluate" / "scene_job.py")
    before, rendered = processor_seconds(children=True), len(list(out.glob("*/*/*.png")))
    make_scenes(out, plan, command, ROOT / "examples")
    views = len(list(out.glob("*/*/*.png"))) - rendered
    spent = processor_seconds(children=True) - before
    return out, plan, f" ({spent / views:.2f} processor seconds a view)" if views else ""


def how_made(scenes: Path) -> str:
    """The command that makes scenes again, and their lights, in words."""
    plan = Plan(**json.loads((scenes / "plan.json").read_text()))
    photographed, *others = plan.lights
    return (
        f"The scenes: `drgs evaluate --make-scenes {scenes.name} --size {plan.size} --train {plan.train} "
        f"--test {plan.test} --spp {plan.samples}`, {plan.bounces} bounces; photographed under Blender's "
        f"{photographed}, the other lights are {', '.join(others)}."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, help="that are there already; else they are made")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--test", type=int, default=8)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS))
    args = parser.parse_args()
    scenes, plan, cost = made(args)
    rows = []
    for folder in (scenes / name for name in args.objects):
        for camera_sees in ("mesh", "surfels"):
            report = score(of_truth(folder), folder, camera_sees, args.samples)
            rest, posed = under_other_lights(report, False), under_other_lights(report, True)
            materials, geometry = report["materials"], report["geometry"]
            rows.append(
                (
                    folder.name,
                    camera_sees,
                    f"{100 * rest[0]['coverage']:.0f} %",
                    f"{report['novel']['psnr']:.1f} / {report['novel']['psnr_foreground']:.1f}",
                    f"{mean(rest, 'raw', 'foreground'):.1f} / {mean(rest, 'scaled', 'foreground'):.1f}",
                    f"{mean(rest, 'scaled', 'full'):.1f} / {np.mean([row['published'] for row in rest]):.1f}",
                    f"{mean(posed, 'raw', 'foreground'):.1f} / {mean(posed, 'scaled', 'foreground'):.1f}",
                    similarity(rest),
                    f"{geometry['normal_degrees']:.2f}",
                    f"{materials['albedo_psnr']:.1f}",
                    f"{materials['roughness_rmse']:.3f} / {materials['metallic_rmse']:.3f}",
                )
            )
            print(*rows[-1], flush=True)
    about = (
        "The true mesh, materials and light against Cycles' pictures of them: the ceiling of every reconstruction of "
        f"these scenes. {plan.size} x {plan.size} pixels, {plan.test} test views, {len(plan.lights) - 1} other lights, "
        f"{plan.samples} samples and denoiser of Cycles{cost}, {args.samples} samples of ours without a denoiser. PSNR "
        f"in dB "
        'on white, SSIM and FLIP of the scaled pictures there; "published way" fits a scale an image to 8-bit values, '
        f"white background included. {how_made(scenes)}\n\n"
    )
    write_section("evaluate", "Scenes with known truth: the ceiling", about + table(COLUMNS, rows))


if __name__ == "__main__":
    main()
