"""Tables of the benchmarks: relit pictures have SSIM and FLIP beside PSNR, and rows of earlier runs stay in them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
sys.path.append(str(Path(__file__).resolve().parents[2] / "bench"))

import bench_asset
import bench_baselines
import bench_materials
import report
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


def test_rows_that_a_section_loses_are_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report, "DOCUMENT", tmp_path / "benchmarks.md")
    rows = [("cat", 1), ("helmet", 2)]
    for count, told in ((2, ""), (2, ""), (1, "1 lines of the table before are gone")):
        report.write_section("some", "Some", table(("Scene", "dB"), rows[:count]))
        said = capsys.readouterr().err
        assert told in said and bool(said) == bool(told)


def test_rows_of_some_scenes_go_where_the_order_has_them_and_the_others_stay():
    kept = [(name, "once", "50.0", "44.0", "+0.00%", "45.0") for name in ("helmet", "glass")]
    columns = ("Scene", "", "No noise, dB", "PSNR dB", "Mean light", "Cycles itself")
    section = "<!-- begin materials -->\n## Title\n\nPictures of 384 spp and 384 samples.\n\n" + table(columns, kept)
    section += "\n\n`python bench/bench_materials.py`"
    run = "\n\nRows that name 9 and 9 samples:\n\n`python bench/bench_materials.py --scenes {}` · 2026-11-26"
    section += run.format("glass bump") + run.format("bump helmet") + "\n<!-- end materials -->"
    new = [(name, "again", "60.0", "50.0", "+0.01%", "55.0") for name in ("terminator", "bump", "helmet")]
    text = bench_materials.replaced(section, new, "64 and 96 samples")
    rows = [line for line in text.splitlines() if line.startswith("|")][2:]
    assert [row.split(" | ")[0] for row in rows] == ["| helmet", "| bump", "| glass", "| terminator"]
    assert rows[2] in section and all("again (64 and 96 samples)" in rows[i] for i in (0, 1, 3))
    assert "`python bench/bench_materials.py`" in text
    assert run.format("glass bump") in text and "bump helmet" not in text
    again = bench_materials.replaced(section, new, "384 and 384 samples")
    assert "| again |" in again and "Rows measured alone:" in again


def test_of_several_passes_the_row_has_the_worst():
    """Its name is in the row, and its pixels alone decide."""
    name, passes = next(iter(bench_materials.PASSES.items()))
    rng = np.random.default_rng(1)
    theirs = rng.uniform(0.2, 0.6, (2, 24, 24 * len(passes), 4)).astype(np.float32)
    theirs[..., 3] = 1.0
    theirs[1] = theirs[0]
    ours = theirs.copy()
    ours[:, :, 24:48, :3] *= 1.1
    row = bench_materials.row(name, ours, theirs)
    assert row[1].endswith(passes[1]) and row[4] == "+10.00%" and 25 < float(row[3]) < 35
