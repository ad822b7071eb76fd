"""Scenes with known truth, made by Cycles and read again; the asset that is the truth must score as such."""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import captures
import numpy as np
import pytest
from PIL import Image
from shapes import plain_mesh

from drgs_blender.cli import evaluate
from drgs_blender.cli.main import main
from drgs_blender.core.asset import Asset, Environment, Mesh
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import EXIT_USAGE, AssetError, DeviceError, EngineError, UsageError
from drgs_blender.evaluate.compare import compare, posed_as, table
from drgs_blender.evaluate.scenes import SMALL, Plan, cameras, make_scenes
from drgs_blender.evaluate.subjects import OBJECTS, make_subject
from drgs_blender.evaluate.truth import Truth, read_relit, read_truth, true_asset
from drgs_blender.formats.exr import write_exr_environment
from drgs_blender.reconstruct.readers import read_capture

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "drgs_blender" / "evaluate" / "scene_job.py"
PLAN = Plan(("spot",), 48, 3, 2, 8, ("courtyard", "city"), 1)


@pytest.fixture(scope="module")
def command() -> list[str]:
    python = ROOT / ".venv-blender" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    python = Path(os.environ.get("DRGS_BLENDER", python))
    if not python.exists():
        pytest.skip("Blender's Python is not installed in .venv-blender")
    return [str(python), "-P", str(SCRIPT)]


@pytest.fixture(scope="module")
def scenes(command, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("scenes")
    make_scenes(out, PLAN, command, ROOT / "examples", threads=2)
    return out


def test_help_says_what_scenes_are_made(capsys):
    assert main(["evaluate", "--help"]) == 0
    said, plan = " ".join(capsys.readouterr().out.split()), Plan()
    assert f"which of {', '.join(OBJECTS)}; default all" in said and plan.objects == OBJECTS
    for option, value in (("size", plan.size), ("train", plan.train), ("test", plan.test), ("spp", plan.samples)):
        assert re.search(rf"--{option} N [^-]*; default {value}\b", said), option


def test_samples_of_cycles_are_those_of_spp():
    parser = argparse.ArgumentParser()
    evaluate.add_arguments(parser)
    plans = [evaluate.plan_of(parser.parse_args(["--make-scenes", "x", *more])) for more in ([], ["--spp", "24"])]
    assert [plan.samples for plan in plans] == [Plan().samples, 24]
    assert evaluate.plan_of(parser.parse_args(["--make-scenes", "x", "--small"])) == SMALL


def test_cameras_stand_level_around_the_object_and_test_views_are_others():
    train, test = cameras(40, -25, 80, 0.0), cameras(8, 0, 60, 1.0)
    for matrix in train + test:
        rotation, centre = matrix[:3, :3], matrix[:3, 3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert abs(rotation[2, 0]) < 1e-12 and rotation[2, 1] > 0
        np.testing.assert_allclose(rotation[:, 2], centre / np.linalg.norm(centre), atol=1e-12)
    places = np.array([m[:3, 3] for m in train + test])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9 * np.eye(len(places))
    assert apart.min() > 0.15
    assert np.abs(places[:40, :2].mean(axis=0)).max() < 0.2  # on all sides


@pytest.mark.parametrize("name", ["robot", "fern"])
def test_objects_lie_in_the_unit_sphere_and_span_matte_to_mirror(name):
    data = make_subject(name, ROOT / "examples")
    assert np.linalg.norm(data["vertices"], axis=1).max() == pytest.approx(1, abs=1e-6)
    assert data["faces"].min() >= 0 and data["faces"].max() < len(data["vertices"])
    for values in (data["albedo"], data["roughness"], data["metallic"]):
        assert values.min() >= 0 and values.max() <= 1
    assert data["roughness"].min() < 0.15 and data["roughness"].max() > 0.65
    assert (data["metallic"] > 0.9).mean() > 0.05 and (data["metallic"] < 0.1).mean() > 0.4
    with pytest.raises(UsageError, match="fern"):
        make_subject("teapot", ROOT / "examples")
    assert name in OBJECTS


@pytest.mark.slow
def test_the_capture_is_one_that_any_reader_takes(scenes):
    capture = read_capture(scenes / "spot")
    assert (len(capture.training), len(capture.testing)) == (3, 2)
    assert capture.background == (1.0, 1.0, 1.0)
    assert all(0.02 < view.mask.mean() < 0.6 for view in capture.views)


def keys_of(report: object) -> set[str]:
    """Of all dictionaries within."""
    inner = report.values() if isinstance(report, dict) else report if isinstance(report, list) else ()
    return set(report if isinstance(report, dict) else ()).union(*map(keys_of, inner))


@pytest.mark.slow
def test_the_true_object_scores_as_true(scenes, tmp_path, capsys):
    write_asset(tmp_path / "true.drgs", true_asset(scenes / "spot", density=20.0))
    arguments = [
        "evaluate",
        str(tmp_path / "true.drgs"),
        str(scenes / "spot"),
        "--camera-sees",
        "mesh",
        "--samples",
        "64",
    ]
    assert main([*arguments, "--json", "--pictures", str(tmp_path / "pictures")]) == 0
    report = json.loads(capsys.readouterr().out)
    page = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    assert {key for key in keys_of(report) if f"`{key}`" not in page} == set()
    assert report["novel"]["psnr"] > 27 and report["novel"]["lpips"] is None
    for pose in ("geometry", "posed_geometry"):
        assert report[pose]["normal_degrees"] < 3 and report[pose]["depth_median"] < 2e-3
        assert report[pose]["silhouette_iou"] > 0.97
    assert report["materials"]["albedo_psnr"] > 28
    assert report["materials"]["roughness_rmse"] < 0.02 and report["materials"]["metallic_rmse"] < 0.05
    rows = {row["name"]: row for row in report["lights"]}
    assert set(rows) == {"test", "relit-city", "posed", "posed-city"}
    for row in rows.values():
        assert row["raw"]["full"] > 27
        np.testing.assert_allclose(row["scale"], 1, atol=0.06)  # the light has the exposure that Cycles rendered with
    # The pose and the light were followed: the wrong ones score far worse.
    assert (tmp_path / "pictures" / "posed-city-001.png").exists()
    assert main(arguments) == 0
    assert "city posed" in capsys.readouterr().out


@pytest.mark.slow
def test_the_pose_is_carried_to_another_mesh_of_the_same_shape(scenes):
    truth = read_truth(scenes / "spot")
    assert np.linalg.norm(truth.posed - truth.rest, axis=1).max() > 0.1
    used = np.unique(truth.faces)
    rng = np.random.default_rng(0)
    corners = truth.faces[rng.integers(0, len(truth.faces), 500)]
    share = rng.dirichlet([1, 1, 1], 500)[..., None]
    inner = (truth.rest[corners] * share).sum(axis=1).astype(np.float32)
    wanted = (truth.posed[corners] * share).sum(axis=1)
    numbers = np.zeros(len(inner), np.float32)
    mesh = Mesh(inner, np.zeros((1, 3), np.int32), np.zeros((500, 3), np.float32), numbers, numbers)
    found = posed_as(Asset(attach_nothing(), mesh, None), truth).vertices
    error = np.linalg.norm(found - wanted, axis=1)
    assert np.median(error) < 2e-3 and np.quantile(error, 0.95) < 0.02
    assert len(used) > 1000


def test_flat_sides_carry_what_lies_on_them():
    """A roof of two large faces that folds: corners alone would bend what lies in between."""
    rest = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
    posed = rest + np.float32([[0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    random = np.random.default_rng(0).dirichlet((1, 1, 1), 200)
    points = np.einsum("nk,nkc->nc", random, rest[faces[np.arange(200) % 2]])
    wanted = np.einsum("nk,nkc->nc", random, posed[faces[np.arange(200) % 2]])
    mesh = plain_mesh(points.astype(np.float32), np.arange(198, dtype=np.int32).reshape(-1, 3))
    found = posed_as(Asset(attach_nothing(), mesh, None), Truth([], "sun", rest, posed, faces)).vertices
    assert np.linalg.norm(found - wanted, axis=1).mean() < 0.005


def attach_nothing():
    from drgs_blender.core.asset import Surfels

    one = np.zeros(1, np.float32)
    return Surfels(np.zeros((1, 3)), np.ones((1, 2)), np.array([[1.0, 0, 0, 0]]), one, np.zeros((1, 3)), one, one)


def test_a_published_set_is_scored_under_the_lights_that_are_named(tmp_path):
    """TensoIR's layout; the renderer shows the true pictures, too bright by a factor that is forgiven."""
    scene = captures.make(tmp_path / "set")
    captures.write_tensoir(scene)
    tests = sorted((tmp_path / "set").glob("test_*"))
    for folder, matrix in zip(tests, scene.cameras[::4]):
        pixels = captures.picture(matrix)
        Image.fromarray(np.dstack([pixels[..., :3] // 2, pixels[..., 3]])).save(folder / "rgba_night.png")
        Image.fromarray(pixels).save(folder / "albedo.png")
        normal = np.where(pixels[..., 3:] > 0, np.array([255, 127.5, 127.5]), 0).round().astype(np.uint8)
        Image.fromarray(normal).save(folder / "normal.png")
    write_exr_environment(tmp_path / "night.exr", Environment(np.ones((4, 8, 3), np.float32)))
    relit = read_relit(tmp_path / "set", tmp_path / "night.exr")
    assert [view.name for view in relit.views] == [folder.name for folder in tests] and len(tests) == 3
    mesh = Mesh(np.zeros((3, 3)), np.zeros((1, 3), np.int32), np.zeros((3, 3)), np.zeros(3), np.zeros(3))
    asset = Asset(attach_nothing(), mesh, None)

    def renderer(camera, light, vertices):
        assert vertices is None and (light.environment == 1).all() and (light.rotation == np.eye(3)).all()
        pixels = captures.picture(camera.matrix_world)
        alpha = pixels[..., 3:] / np.float32(255)
        shown = srgb_to_linear(pixels[..., :3] // 2 / np.float32(255)) * 1.5 * alpha
        turned = np.broadcast_to(np.array([np.cos(0.1), np.sin(0.1), 0], np.float32), shown.shape)
        return {
            "Combined": np.dstack([shown, alpha]),
            "Albedo": pixels[..., :3] / np.float32(255),
            "Normal": turned,
            "Coverage": alpha,
        }

    capture = read_capture(tmp_path / "set")
    report = compare(asset, capture, Truth([relit]), renderer)
    (row,) = report["lights"]
    np.testing.assert_allclose(row["scale"], 1 / 1.5, rtol=2e-3)
    assert row["scaled"]["foreground"] > 50 > 25 > row["raw"]["foreground"]
    assert report["geometry"]["normal_degrees"] == pytest.approx(np.degrees(0.1), abs=0.5)
    assert report["geometry"]["depth_mean"] is None and report["geometry"]["silhouette_iou"] == 1
    assert report["materials"]["albedo_psnr"] > 60 and "metallic_rmse" not in report["materials"]
    assert any("night" in line for line in table(report))
    assert any(re.match(r"shape: normals \d\.\d degrees off; ", line) for line in table(report))
    json.dumps(report, allow_nan=False)
    nowhere = compare(asset, capture, Truth([relit]), lambda *about: {k: 0 * v for k, v in renderer(*about).items()})
    assert nowhere["materials"]["albedo_psnr"] is None and nowhere["geometry"]["silhouette_iou"] == 0
    assert any("albedo PSNR not computed" in line for line in table(nowhere))
    with pytest.raises(UsageError, match=r"nothing to compare.* no light of its own.*--relit"):
        compare(asset, capture, None, renderer)
    with pytest.raises(UsageError, match=r"nothing to compare.* no views left out.*--test-every"):
        compare(asset, replace(capture, views=capture.training), None, renderer)


@pytest.mark.parametrize(
    ("provenance", "test_every", "words"),
    [
        ({"capture": "set", "learned_from": ["r_1", "r_2", "r_3", "r_5", "r_6", "r_7"]}, 4, ""),
        ({"capture": "set", "learned_from": ["r_1", "r_3", "r_5", "r_7"]}, 4, ""),
        ({"capture": "set", "learned_from": ["r_1", "r_2", "r_3", "r_5", "r_6", "r_7"]}, 3, "2 of the 3 views"),
        ({"capture": "set/transforms_train.json", "learned_from": [f"r_{k}" for k in range(8)]}, 4, "2 of the 2 views"),
        ({"capture": "other", "learned_from": ["r_1"]}, 4, "learned from other"),
        ({"capture": "set"}, 4, ""),  # of an older version
    ],
)
def test_views_that_the_asset_was_learned_from_are_not_taken_for_left_out(
    tmp_path, caplog, provenance, test_every, words
):
    captures.write_nerf(captures.make(tmp_path / "set", 8))
    mesh = Mesh(np.zeros((3, 3)), np.zeros((1, 3), np.int32), np.zeros((3, 3)), np.zeros(3), np.zeros(3))
    asset = Asset(attach_nothing(), mesh, None, Environment(np.ones((4, 8, 3), np.float32)), provenance)
    blank = {"Combined": np.zeros((captures.HEIGHT, captures.WIDTH, 4), np.float32)}
    compare(asset, read_capture(tmp_path / "set", test_every=test_every), None, lambda *_: blank)
    assert words in caplog.text and bool(words) == bool(caplog.records)


@pytest.mark.slow
def test_what_is_there_is_kept_and_what_is_missing_made_again(scenes, command):
    folder = scenes / "spot"
    kept, gone = folder / "test" / "r_001.exr", folder / "posed" / "r_001.png"
    before, first = kept.stat().st_mtime_ns, gone.read_bytes()
    gone.unlink()
    done = []
    make_scenes(scenes, PLAN, command, ROOT / "examples", lambda k, of, name: done.append((k, of, name)), threads=2)
    assert kept.stat().st_mtime_ns == before and gone.read_bytes() == first  # deterministic, too
    assert [k for k, _, _ in done] == list(range(1, done[-1][1] + 1))
    assert not list(folder.glob("raw-*")) and not list(folder.glob("part-*"))


@pytest.mark.slow
def test_other_settings_need_another_folder(scenes, command):
    with pytest.raises(UsageError, match="other settings"):
        make_scenes(scenes, Plan(("spot",), 64), command, ROOT / "examples")


def test_a_blender_that_fails_is_reported(tmp_path):
    with pytest.raises(DeviceError, match="does not start"):
        make_scenes(tmp_path / "a", PLAN, [str(tmp_path / "no-blender")], ROOT / "examples")
    with pytest.raises(EngineError, match="nothing like this"):
        make_scenes(tmp_path / "b", PLAN, [sys.executable, "-c", "raise SystemExit('nothing like this')"], ROOT)


@pytest.mark.slow
def test_damaged_truth_is_refused(scenes, tmp_path, capsys):
    folder = tmp_path / "scenes"
    shutil.copytree(scenes, folder)
    file = folder / "spot" / "truth.json"
    data = json.loads(file.read_text())
    for change in ({"format": 2}, {"lights": {}}, {"posed": "nothing.npy"}, {"sets": 3}):
        file.write_text(json.dumps(data | change))
        with pytest.raises(AssetError, match=r"truth\.json"):
            read_truth(folder / "spot")
    assert main(["evaluate"]) == EXIT_USAGE
    assert capsys.readouterr().err.startswith("drgs: evaluate: needs an asset")
    assert main(["evaluate", "a.drgs", "b", "--make-scenes", "c"]) == EXIT_USAGE
    assert "takes no asset" in capsys.readouterr().err
