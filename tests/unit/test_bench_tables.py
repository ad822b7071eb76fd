"""Tables of the benchmarks: relit pictures have SSIM and FLIP beside PSNR, and rows of earlier runs stay in them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")
sys.path.append(str(Path(__file__).resolve().parents[2] / "bench"))

import bench_asset
import bench_baselines
from bench_evaluate import similarity
from report import table


def lights(flip: float | None) -> list[dict]:
    both = {"full": 30.0, "foreground": 20.0}
    figures = {"ssim": 0.9, "flip": flip, "scaled": both, "raw": both, "published": 31.0, "training_light": False}
    return [figures | {"posed": posed, "ssim": ssim} for posed in (False, True) for ssim in (0.9, 0.8)]


def test_similarity_is_the_mean_over_the_lights_and_a_dash_without_flip():
    assert similarity(lights(0.25)) == "0.8500 / 0.2500" and similarity(lights(None)) == "0.8500 / -"


def test_a_row_of_an_asset_has_a_cell_in_every_column():
    report = {
        "novel": {"psnr": 30.0, "psnr_foreground": 20.0},
        "geometry": {"normal_degrees": 2.0, "silhouette_iou": 0.99},
        "materials": {"albedo_psnr_scaled": 25.0, "roughness_rmse": 0.1, "metallic_rmse": 0.1},
        "lights": lights(0.25),
    }
    cells = bench_asset.row(report, ["1", "2"], 60.0)
    named = dict(zip(bench_asset.COLUMNS[2:], cells, strict=True))
    assert named["Relit: SSIM / FLIP"] == named[bench_asset.DEFORMED_SIMILARITY] == "0.8500 / 0.2500"
    assert named[bench_asset.DEFORMED] == "30.00 / 20.00"


def test_rows_of_earlier_runs_have_dashes_in_columns_that_they_lack():
    columns = bench_baselines.COLUMNS
    head, rule, old = table(columns, [("spot", "DR-GS", "1", "2", "3", "4")]).splitlines()
    assert head.count("|") == rule.count("|") == old.count("|") == len(columns) + 1
    assert old.endswith("| 4 | - | - |")
