"""Published sets in miniature: their own asset scores high, another one low, and what is missing is named."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

import captures
import published_sets
from PIL import Image
from published_sets import Maker, light, object_asset, with_mesh

from drgs_blender.cli import evaluate_protocol
from drgs_blender.cli.main import main
from drgs_blender.core.asset import Environment
from drgs_blender.core.asset.container import inspect_asset, read_asset, write_asset
from drgs_blender.core.color import linear_to_srgb
from drgs_blender.core.errors import AssetError
from drgs_blender.evaluate.protocols import PROTOCOLS, orb_metrics, stanford_orb, tensoir
from drgs_blender.evaluate.protocols.bench import Bench, find_light
from drgs_blender.evaluate.protocols.table import differences, strangers
from drgs_blender.formats.latlong import directions
from drgs_blender.reconstruct.readers import nero, read_capture

#: Protocol -> object of its miniature.
OBJECTS = {
    "glossysynthetic": "bell", "tensoir": "lego", "stanford-orb": "teapot_scene001", "shiny-blender": "toaster",
}  # fmt: skip
#: Decibels of the true asset where what is known of the truth is not exact: masks of whole pixels, in pictures so small
#: that many of them lie on the outline; lights resampled to the view of a camera.
LEAST = {("glossysynthetic", "views"): 32, ("stanford-orb", "relit"): 36}


@pytest.fixture(scope="module")
def maker(tmp_path_factory) -> Maker:
    return Maker(tmp_path_factory.mktemp("true"), object_asset(light(1)))


class Sets(dict):
    """Protocol -> folder of its miniature, made when it is first asked for."""

    def __init__(self, maker: Maker, folder: Path) -> None:
        self.maker, self.folder = maker, folder

    def __missing__(self, name: str) -> Path:
        self[name] = getattr(self.maker, name.replace("-", "_"))(self.folder / name)
        return self[name]


@pytest.fixture(scope="module")
def sets(maker, tmp_path_factory) -> Sets:
    return Sets(maker, tmp_path_factory.mktemp("sets"))


def scored(capsys, protocol: str, asset: Path, root: Path, *words: str) -> dict:
    options = ["--protocol", protocol, str(asset), str(root), "--samples", str(published_sets.SAMPLES), "--json"]
    assert main(["evaluate", *options, "--objects", OBJECTS[protocol], *words]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys, code: int, *words: object) -> str:
    assert main(["evaluate", *map(str, words)]) == code
    return capsys.readouterr().err


def test_the_parser_knows_the_protocols_there_are():
    assert tuple(PROTOCOLS) == evaluate_protocol.NAMES
    assert len(PROTOCOLS["stanford-orb"].objects) == 42


@pytest.mark.parametrize("protocol", OBJECTS)
def test_the_true_asset_scores_high_and_another_one_low(protocol, maker, sets, tmp_path, capsys):
    name = OBJECTS[protocol]
    report = scored(capsys, protocol, maker.file, sets[protocol])
    true, paths = report["objects"][name], [column.path for column in PROTOCOLS[protocol].columns]
    found = {path: value(true, path) for path in paths}
    assert all(found[path] is not None for path in paths if not path.endswith(".lpips"))
    assert report["mean"]["views"] == pytest.approx(
        {k: v for k, v in true["views"].items() if k in report["mean"]["views"]}
    )
    assert report["missing"] == [other for other in PROTOCOLS[protocol].objects if other != name]
    original = read_asset(maker.file)
    grey = np.full_like(original.mesh.albedo, 0.4)
    other = with_mesh(original, albedo=grey, roughness=np.full_like(original.mesh.roughness, 0.9))
    other.surfels.rotation = np.roll(other.surfels.rotation, 40, axis=0)  # normals of others
    write_asset(tmp_path / "other.drgs", other)
    wrong = scored(capsys, protocol, tmp_path / "other.drgs", sets[protocol])["objects"][name]
    for path in paths:
        if found[path] is None:
            continue
        if "psnr" in path:
            assert found[path] > LEAST.get((protocol, path.split(".")[0]), 40), path
            assert found[path] > value(wrong, path) + 8, path
        elif path.endswith("ssim"):
            assert found[path] > 0.98 and found[path] > value(wrong, path), path
        else:  # FLIP, normals, depth
            assert found[path] < value(wrong, path), path
    if "shape.normal_degrees" in found:
        assert found["shape.normal_degrees"] < 1.5


def value(row: dict, path: str) -> float | None:
    for name in path.split("."):
        row = row[name]
    return row


def test_the_table_is_for_people(maker, sets, capsys, tmp_path):
    words = ["--protocol", "shiny-blender", str(maker.file), str(sets["shiny-blender"]), "--objects", "toaster"]
    words += ["--samples", "4", "--most-views", "1", "--pictures", str(tmp_path / "shown")]
    assert main(["evaluate", *words]) == 0
    said = capsys.readouterr().out
    head, row, rule, mean = said.splitlines()[:4]
    assert head.split() == ["object", "Views", "PSNR", "SSIM", "FLIP", "Normals", "MAE"]
    assert row.split()[0] == "toaster" and set(rule) == {"-"} and mean.split()[1:] == row.split()[1:]
    assert "the mean is of 1 objects; published ones have ball, car, coffee, ..., too; at most 1 views" in said
    assert [file.name for file in (tmp_path / "shown" / "toaster").iterdir()] == ["views-000.png"]


def test_albedo_off_by_a_factor_a_channel_is_aligned_before_relighting(maker, sets, tmp_path, capsys):
    """TensoIR's set: relit pictures hardly notice, those of the own light do."""
    original = read_asset(maker.file)
    dark = with_mesh(original, albedo=(original.mesh.albedo * [0.5, 0.8, 0.6]).astype(np.float32))
    write_asset(tmp_path / "dark.drgs", dark)
    row = scored(capsys, "tensoir", tmp_path / "dark.drgs", sets["tensoir"])["objects"]["lego"]
    np.testing.assert_allclose(row["materials"]["albedo_factors"], [2, 1.25, 1 / 0.6], rtol=0.02)
    assert row["relit"]["psnr"] > 38 and row["views"]["psnr"] < 30 and row["materials"]["albedo_psnr"] > 34


def test_relit_pictures_of_another_exposure_are_aligned_by_stanford_orb(maker, tmp_path, capsys):
    root = maker.stanford_orb(tmp_path, gains=(0.5, 1.6, 0.8))
    row = scored(capsys, "stanford-orb", maker.file, root)["objects"]["teapot_scene001"]
    assert row["relit"]["psnr_l"] > 36 and row["relit"]["psnr_h"] > 36


def test_the_light_about_a_camera_is_turned_into_the_world():
    """What is before the camera, right of it and above it comes from there."""
    matrix = captures.look_at(np.array([4.0, 1.0, 2.0]))
    right, up, back = matrix[:3, :3].T
    image = np.zeros((64, 128, 3), np.float32)
    image[28:36, 60:68, 0] = image[28:36, 92:100, 1] = image[:4, :, 2] = 1
    ways, radiance = directions(64), stanford_orb.camera_light(image, matrix)
    for channel, towards in enumerate((-back, right, up)):
        lit = ways[radiance[..., channel] > 0.5]
        assert len(lit) and (lit @ towards > np.cos(0.3)).all()


def test_metrics_of_stanford_orb():
    random = np.random.default_rng(0)
    true = random.uniform(0, 3, (40, 40, 3))
    mask = np.zeros((40, 40), bool)
    mask[5:35, 5:35] = True
    assert orb_metrics.eroded(mask).sum() == 26 * 26 and orb_metrics.eroded(np.ones((9, 9), bool)).all()
    same = orb_metrics.picture_scores(true * [2, 3, 0.1], true, mask, True, None, None).figures
    assert same["psnr_h"] > 90 and same["psnr_l"] > 90 and same["ssim"] == pytest.approx(1)
    # Squared errors are spread over all pixels: outside of the mask anything goes.
    off = np.clip(true, 0, 0.5)
    one, other = (
        orb_metrics.picture_scores(np.where(mask[..., None], 0.9 * off, outside), off, mask, False, None, None).figures
        for outside in (0.0, 5.0)
    )
    assert one == other
    inside = orb_metrics.eroded(mask)
    error = ((linear_to_srgb(0.9 * off) - linear_to_srgb(off)) ** 2)[inside].sum() / off.size
    assert one["psnr_l"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
    # Nothing scores worse than grey.
    worst = orb_metrics.picture_scores(np.full_like(off, 90.0), off, mask, False, None, None).figures["psnr_l"]
    grey = ((0.5 - linear_to_srgb(off)) ** 2)[inside].sum() / off.size
    assert worst == pytest.approx(-10 * np.log10(grey), abs=1e-3)
    depth = random.uniform(1, 2, 50)
    assert orb_metrics.depth_error([(3 * depth, depth, 100)]) == pytest.approx(0, abs=1e-12)
    assert orb_metrics.depth_error([]) is None


def test_lpips_of_stanford_orb_is_of_pictures_that_are_encoded_twice():
    random = np.random.default_rng(4)
    ours, true = random.uniform(0, 1, (2, 12, 12, 3))
    mask = np.ones((12, 12), bool)
    mask[:, 6:] = False
    found = orb_metrics.picture_scores(ours, true, mask, False, None, lambda a, b: float(10 * a.sum() + b.sum()))
    inside = orb_metrics.eroded(mask)
    twice = [linear_to_srgb(linear_to_srgb(picture))[inside].sum() for picture in (ours, true)]
    assert 0 < inside.sum() < mask.sum() and found.figures["lpips"] == pytest.approx(10 * twice[0] + twice[1], rel=1e-6)


def test_ssim_of_stanford_orb_is_that_of_its_windows():
    """A plain loop over the windows of three pixels, mirrored without the outermost pixel."""
    random = np.random.default_rng(5)
    ours, true = random.uniform(0, 1, (2, 9, 8, 3))
    figures = orb_metrics.picture_scores(ours, true, np.ones((9, 8), bool), False, None, None).figures
    weights = np.exp(-0.5 * (np.arange(-1, 2) / 1.5) ** 2)
    weights = np.outer(weights, weights) / weights.sum() ** 2
    a, b = (np.pad(linear_to_srgb(p), ((1, 1), (1, 1), (0, 0)), mode="reflect") for p in (ours, true))
    values = []
    for row, column, channel in np.ndindex(9, 8, 3):
        x, y = (picture[row : row + 3, column : column + 3, channel] for picture in (a, b))
        p, q = (weights * x).sum(), (weights * y).sum()
        spread = (weights * (x - p) ** 2).sum() + (weights * (y - q) ** 2).sum()
        covariance = (weights * (x - p) * (y - q)).sum()
        values.append((2 * p * q + 1e-4) * (2 * covariance + 9e-4) / ((p * p + q * q + 1e-4) * (spread + 9e-4)))
    assert figures["ssim"] == pytest.approx(np.mean(values), abs=1e-6) and figures["ssim"] < 0.5


def test_normals_of_stanford_orb():
    true = np.zeros((4, 4, 3))
    true[..., 2] = 1
    across, longer = np.roll(true, 1, axis=-1), 3 * true
    inside = np.zeros((4, 4), bool)
    inside[:2] = True
    assert orb_metrics.normal_distance(longer, true, inside) == pytest.approx(0)
    assert orb_metrics.normal_distance(across, true, inside) == pytest.approx(1)
    assert orb_metrics.normal_distance(-true, true, inside) == pytest.approx(2)
    assert orb_metrics.normal_distance(np.zeros_like(true), true, inside) == pytest.approx(1)
    half = np.where(inside[..., None], true, across)
    half[0] = 0  # without a normal
    assert orb_metrics.normal_distance(half, true, inside) == pytest.approx(0.5)
    assert np.isnan(orb_metrics.normal_distance(true, true, np.zeros((4, 4), bool)))


def test_the_own_light_of_tensoir_may_be_one_of_rotated_ones(sets, tmp_path):
    root, protocol = tmp_path / "set", PROTOCOLS["tensoir"]
    shutil.copytree(sets["tensoir"], root)
    expected = protocol.read(root, "lego", None)
    for file in list(root.glob("lego/*/rgba_sunset.png")):
        file.rename(file.with_name("rgba_sunset_000.png"))
    protocol.check(root, "lego", None)
    assert protocol.counts(root, "lego") == {"training views": 6, "views left out": 2}
    for one, other in zip(protocol.read(root, "lego", None).views, expected.views, strict=True):
        np.testing.assert_array_equal(one.colour, other.colour)
    (root / "lego" / "train_001" / "rgba_sunset_000.png").unlink()
    with pytest.raises(AssetError, match=r"train_001/rgba_sunset_000\.png"):
        protocol.check(root, "lego", None)


def test_median_ratios_of_albedo_are_not_moved_by_a_few_pixels():
    true = np.random.default_rng(1).uniform(0.2, 0.8, (90, 3))
    found = true / [2, 1, 0.5]
    found[:20] = 0.01
    np.testing.assert_allclose(tensoir.albedo_factors([(found, true)] * 3), [2, 1, 0.5])


def test_glossysynthetic_has_the_published_split(tmp_path):
    scene = captures.make(tmp_path / "bell", 2)
    captures.write_nero(scene)
    for k in range(2, 128):
        for end in (".png", "-camera.pkl", "-depth.png"):
            (tmp_path / "bell" / f"{k}{end}").symlink_to(f"{k % 2}{end}")
    layout = nero.read(tmp_path / "bell")
    testing = [int(photograph.name) for photograph in layout.photographs if photograph.test]
    assert len(testing) == 32 and testing == sorted(nero.SPLIT) and {0, 2, 3, 120, 127} < set(testing)


def test_only_the_first_sixteen_relit_views_count(maker, sets, tmp_path, capsys):
    root = tmp_path / "set"
    shutil.copytree(sets["glossysynthetic"], root)
    folder = root / "glossy_relight" / "relight_gt" / "bell_golf"
    for k in range(2, 18):
        for end in (".png", "-camera.pkl", "-depth.png"):
            shutil.copy(folder / f"{k % 2}{end}", folder / f"{k}{end}")
    for k in (16, 17):
        Image.new("RGBA", (captures.WIDTH, captures.HEIGHT), (200, 30, 90, 255)).save(folder / f"{k}.png")
    row = scored(capsys, "glossysynthetic", maker.file, root)["objects"]["bell"]
    assert row["lights"]["golf"]["psnr"] > 40


def test_relit_pictures_of_glossysynthetic_are_scaled(maker, sets, tmp_path, capsys):
    root = tmp_path / "set"
    shutil.copytree(sets["glossysynthetic"], root)
    published_sets.hdr(root / "glossy_relight" / "hdr2k" / "neon.exr", (1.3 * light(12)).astype(np.float32))
    lights = scored(capsys, "glossysynthetic", maker.file, root)["objects"]["bell"]["lights"]
    # White, which is most of the frame, lets the factors come to little.
    assert lights["neon"]["raw_psnr"] + 0.1 < lights["neon"]["psnr"] < 40 < lights["golf"]["raw_psnr"]


def test_lpips_of_glossysynthetic_is_of_pictures_that_are_not_shifted(maker, sets):
    """LPIPS takes [0, 1] to [-1, 1]; what it is given comes out of that as the pictures were, in [0, 1]."""
    shifted = []

    def lpips(ours, true):
        shifted.extend((2 * ours - 1, 2 * true - 1))
        return 0.0

    shown = []
    bench = Bench(
        read_asset(maker.file), lambda camera, radiance, _: maker.render(camera.matrix_world, radiance),
        most_views=1, lpips=lpips, show=lambda part, number, ours, true: shown.append(true),
    )  # fmt: skip
    PROTOCOLS["glossysynthetic"].measure(bench, sets["glossysynthetic"], "bell", None)
    np.testing.assert_allclose(shifted[1], shown[0], atol=0.51 / 255)
    assert len(shifted) == 14 and all(picture.min() >= -1e-6 and picture.max() <= 1.5 for picture in shifted)


@pytest.mark.parametrize("part", [0.5, 1.0])
def test_normals_of_shiny_blender_count_where_the_asset_is(part, maker, sets):
    """A hole in the asset changes the pictures alone; without anything there is no figure."""

    def render(camera, radiance, factors):
        passes = {name: values.copy() for name, values in maker.render(camera.matrix_world, radiance).items()}
        for values in passes.values():
            values[:, : int(part * values.shape[1])] = 0
        return passes

    report = PROTOCOLS["shiny-blender"].measure(
        Bench(read_asset(maker.file), render, most_views=1), sets["shiny-blender"], "toaster", None
    )
    found = report["shape"]["normal_degrees"]
    assert report["views"]["psnr"] < 25 and (found is None if part == 1 else found < 1.5)


@pytest.mark.parametrize(
    ("protocol", "what", "said"),
    [
        ("tensoir", "env/high_res_envmaps_2k/night.exr", "light night"),
        ("tensoir", "lego/test_000/rgba_sunset.png", "test_000/rgba_sunset.png"),
        ("tensoir", "lego/train_001/rgba_sunset.png", "train_001/rgba_sunset.png"),
        ("glossysynthetic", "GlossySynthetic/bell/3.png", "3.png"),
        ("glossysynthetic", "glossy_relight/relight_gt/bell_golf/1.png", "1.png"),
        (None, None, "shown"),
    ],
)
def test_what_is_missing_is_told_before_anything_is_reconstructed(
    protocol, what, said, maker, sets, tmp_path, capsys, monkeypatch
):
    root = tmp_path / "set"
    shutil.copytree(sets[protocol or "shiny-blender"], root)
    asked = reconstructions(monkeypatch, maker.file)
    if what is None:  # a folder of pictures that cannot be written
        (tmp_path / "shown").write_text("a file")
        words = ["--protocol", "shiny-blender", root, "--out", tmp_path / "out", "--pictures", tmp_path / "shown"]
    else:
        (root / what).unlink()
        words = ["--protocol", protocol, root, "--out", tmp_path / "out"]
    assert said in refused(capsys, 73 if what is None else 65, *words)
    assert not asked and not (tmp_path / "out").exists()


@pytest.mark.parametrize("protocol", OBJECTS)
def test_a_set_that_is_not_the_published_one_is_told(protocol, maker, sets, capsys):
    words = ["--protocol", protocol, str(maker.file), str(sets[protocol]), "--samples", "1", "--most-views", "1"]
    assert main(["evaluate", *words, "--objects", OBJECTS[protocol], "--json"]) == 0
    said = capsys.readouterr()
    notes = json.loads(said.out)["notes"]
    wrong = {
        "glossysynthetic": "bell has 7 training views, not 96; 1 views left out, not 32; 2 views in corridor, not 16",
        "tensoir": "lego has 6 training views, not 100; 2 views left out, not 200",
        "stanford-orb": "teapot_scene001 has 1 other scenes, not 2",
        "shiny-blender": "toaster has 8 training views, not 100; 3 views left out, not 200",
    }[protocol]
    assert any(note.startswith(wrong) for note in notes) and wrong in said.err


def test_counts_that_are_as_published_and_objects_of_the_tables_are_not_told():
    for protocol in PROTOCOLS.values():
        assert not differences("one", dict(protocol.expected), protocol) and protocol.expected
        assert not strangers(protocol.objects, protocol)


def test_objects_that_the_tables_have_not_are_told(maker, sets, tmp_path, capsys):
    shutil.copytree(sets["shiny-blender"] / "toaster", tmp_path / "chair")
    words = ["--protocol", "shiny-blender", str(maker.file), str(tmp_path), "--objects", "chair", "--json"]
    assert main(["evaluate", *words, "--samples", "1", "--most-views", "1"]) == 0
    said = capsys.readouterr()
    assert "published means are without chair" in said.err
    assert "published means are without chair" in json.loads(said.out)["notes"]


def test_the_capture_of_stanford_orb_is_one_that_is_read(sets):
    capture = read_capture(sets["stanford-orb"] / "blender_HDR" / "teapot_scene001")
    assert len(capture.training) == 6 and len(capture.testing) == 2
    view = capture.testing[0]
    assert view.mask is not None and 0.05 < view.mask.mean() < 0.9 and 0.2 < view.colour[view.mask > 0.9].mean() < 1


#: What is done to a set -> what is said of it: (protocol, what, words).
DAMAGE = [
    ("glossysynthetic", "GlossySynthetic/bell/3.png", None, "3.png"),
    ("glossysynthetic", "glossy_relight/hdr2k/golf.exr", None, "light golf: is not there"),
    ("glossysynthetic", "glossy_relight/relight_gt/bell_neon", None, "bell_neon: is not there"),
    ("glossysynthetic", "glossy_relight/relight_gt/bell_neon", "empty", "is empty"),
    ("glossysynthetic", "glossy_relight/relight_gt/bell_neon/1.png", "opaque", "1.png: has no alpha"),
    ("glossysynthetic", "glossy_relight/relight_gt/bell_neon/1.png", "other size", "1.png: is 20 x 70 pixels"),
    ("tensoir", "lego/test_001/rgba_city.png", None, "rgba_city.png"),
    ("tensoir", "lego/test_001/albedo.png", None, "1 of 30 images that are not there: test_001/albedo.png"),
    ("tensoir", "lego/test_000/normal.png", "text", "normal.png: is no image"),
    ("tensoir", "lego/test_000/metadata.json", "text", "metadata.json: is not JSON"),
    ("tensoir", "env/high_res_envmaps_2k/night.exr", None, "light night: is not there"),
    ("tensoir", "lego/test_001/rgba_city.png", "other size", "rgba_city.png: is 20 x 70 pixels"),
    ("stanford-orb", "blender_HDR/teapot_scene002/test/0001.exr", None, "teapot_scene002/test/0001.exr"),
    ("stanford-orb", "blender_HDR/teapot_scene002/test_mask/0001.png", "other size", "0001.png: is 20 x 70 pixels"),
    (
        "stanford-orb",
        "blender_HDR/teapot_scene001/transforms_novel.json",
        None,
        "transforms_novel.json: cannot be read",
    ),
    ("stanford-orb", "blender_HDR/teapot_scene001/transforms_novel.json", "json", "does not describe cameras"),
    ("stanford-orb", "ground_truth/teapot_scene002/env_map/0000.exr", None, "env_map/0000.exr: is not there"),
    ("stanford-orb", "ground_truth/teapot_scene001/surface_normal/0000.npy", "text", "0000.npy: holds no map"),
    ("stanford-orb", "ground_truth/teapot_scene001/surface_normal/0000.npy", "nothing", "0000.npy: holds no map"),
    ("stanford-orb", "ground_truth/teapot_scene001/z_depth/0001.npy", "npz", "0001.npy: holds no map"),
    ("stanford-orb", "ground_truth/teapot_scene001/z_depth/0000.npy", "cut", "0000.npy: holds no map"),
    ("stanford-orb", "ground_truth/teapot_scene001/z_depth/0001.npy", (40, 40, 3), "an array of shape (40, 40, 3)"),
    ("stanford-orb", "ground_truth/teapot_scene001/surface_normal/0001.npy", (4800,), "an array of shape (4800,)"),
    ("stanford-orb", "ground_truth/teapot_scene001/surface_normal/0001.npy", (0, 0, 3), "0001.npy: holds no map"),
    ("stanford-orb", "ground_truth/teapot_scene001/surface_normal/0001.npy", (40, 30, 3), "is 30 x 40 pixels, its"),
    ("stanford-orb", "ground_truth/teapot_scene001/z_depth/0000.npy", (20, 20), "is 20 x 20 pixels, its picture 40"),
    ("stanford-orb", "ground_truth/teapot_scene001/pseudo_gt_albedo/0000.png", "other size", "is 20 x 70 pixels, its"),
    (
        "stanford-orb",
        "blender_HDR/teapot_scene001/test/0001.exr",
        (40, 30, 3),
        "0001.exr: is 30 x 40 pixels, not square",
    ),
    ("stanford-orb", "ground_truth/teapot_scene002/env_map/0000.exr", "text", "env_map/0000.exr: is damaged"),
    ("shiny-blender", "toaster/transforms_test.json", None, "transforms_test.json: is not there"),
    ("shiny-blender", "toaster/test/r_1.png", None, "r_1"),
    ("shiny-blender", "toaster/test/r_1_normal.png", None, "r_1_normal.png"),
]


@pytest.mark.parametrize(("protocol", "what", "how", "said"), DAMAGE)
def test_what_is_missing_or_damaged_is_named(protocol, what, how, said, maker, sets, tmp_path, capsys):
    root = tmp_path / "set"
    shutil.copytree(sets[protocol], root)
    path = root / what
    opaque = Image.open(path).convert("RGB") if how == "opaque" else None
    half = path.read_bytes()[: path.stat().st_size // 2] if how == "cut" else b""
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if how == "empty":
        path.mkdir()
    elif how in ("cut", "nothing"):
        path.write_bytes(half)
    elif how == "npz":
        with path.open("wb") as file:
            np.savez(file, depth=np.ones((40, 40), np.float32))
    elif isinstance(how, tuple):
        values = np.ones(how, np.float32)
        published_sets.exr(path, values) if path.suffix == ".exr" else np.save(path, values)
    elif how in ("text", "json"):
        path.write_text("{}" if how == "json" else "nothing")
    elif how == "opaque":
        opaque.save(path)
    elif how == "other size":
        image = Image.new("L" if "mask" in what else "RGBA", (20, 70))
        image.paste(255, (0, 0, 10, 70)) if image.mode == "L" else image.paste((9, 200, 9, 255), (0, 0, 10, 70))
        image.save(path)
    words = ["--protocol", protocol, maker.file, root, "--objects", OBJECTS[protocol], "--samples", "1"]
    assert said in refused(capsys, 65, *words)


def test_a_damaged_object_does_not_keep_the_others_from_being_scored(maker, sets, tmp_path, capsys):
    root = tmp_path / "set"
    for name in ("toaster", "ball"):
        shutil.copytree(sets["shiny-blender"] / "toaster", root / name)
        shutil.copy(maker.file, tmp_path / f"{name}.drgs")
    (root / "ball" / "test" / "r_1.png").write_bytes((root / "ball" / "test" / "r_1.png").read_bytes()[:200])
    words = ["--protocol", "shiny-blender", str(tmp_path), str(root), "--samples", "4", "--json"]
    assert main(["evaluate", *words]) == 65
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert list(report["objects"]) == ["toaster"] and "r_1.png" in report["failed"]["ball"]
    assert "ball is not scored" in said.err and "ball" in report["missing"]


def several(sets: dict[str, Path], root: Path, assets: Path, file: Path) -> list[str]:
    """Words that score two objects of Shiny Blender, ball and toaster, with the asset `file`."""
    assets.mkdir(exist_ok=True)
    for name in ("ball", "toaster"):
        shutil.copytree(sets["shiny-blender"] / "toaster", root / name)
        shutil.copy(file, assets / f"{name}.drgs")
    return ["--protocol", "shiny-blender", "--samples", "1", "--most-views", "1", "--json"]


@pytest.mark.parametrize(("how", "said"), [("damaged", "ball.drgs"), ("no light", "no light of its own")])
def test_an_asset_that_cannot_be_used_does_not_keep_the_others_from_being_scored(
    how, said, maker, sets, tmp_path, capsys
):
    words = several(sets, tmp_path / "set", tmp_path / "assets", maker.file)
    bad = tmp_path / "assets" / "ball.drgs"
    if how == "damaged":
        bad.write_bytes(bad.read_bytes()[:500])
    else:
        asset = read_asset(bad)
        asset.environment = None
        write_asset(bad, asset)
    assert main(["evaluate", *words, str(tmp_path / "assets"), str(tmp_path / "set")]) == 65
    report = json.loads(capsys.readouterr().out)
    assert list(report["objects"]) == ["toaster"] and said in report["failed"]["ball"]


def reconstructions(monkeypatch, file: Path) -> list:
    """Puts the asset `file` in the place of what is reconstructed; the captures of which it is asked for."""
    asked = []

    def reconstruct(capture, *_):
        asked.append(capture)
        return read_asset(file)

    monkeypatch.setattr("drgs_blender.reconstruct.pipeline.reconstruct", reconstruct)
    return asked


def test_photographs_that_cannot_be_learned_from_do_not_keep_the_others_from_being_scored(
    maker, sets, tmp_path, capsys, monkeypatch
):
    words = several(sets, tmp_path / "set", tmp_path / "assets", maker.file)
    bad = tmp_path / "set" / "ball" / "train" / "r_2.png"
    bad.write_bytes(bad.read_bytes()[:200])
    asked = reconstructions(monkeypatch, maker.file)
    assert main(["evaluate", *words, str(tmp_path / "set"), "--out", str(tmp_path / "new")]) == 65
    report = json.loads(capsys.readouterr().out)
    assert [capture.source.name for capture in asked] == ["toaster"]
    assert list(report["objects"]) == ["toaster"] and "r_2.png" in report["failed"]["ball"]


def test_assets_of_a_try_are_told_when_they_are_used_again(maker, sets, tmp_path, capsys, monkeypatch):
    asked = reconstructions(monkeypatch, maker.file)
    words = ["--protocol", "shiny-blender", str(sets["shiny-blender"]), "--out", str(tmp_path), "--samples", "1"]
    words += ["--json", "--most-views", "1"]
    told = []
    for more in (["--resolution", "32", "--set", "schedule.iterations=7"], [], ["--set", "schedule.iterations=7"]):
        assert main(["evaluate", *words, *more]) == 0
        said = capsys.readouterr()
        told.append((said.err, "; ".join(json.loads(said.out)["notes"])))
    assert len(asked) == 1 and max(view.camera.width for view in asked[0].views) == 32
    assert not any("other settings" in text for text in told[0])
    assert all("made with other settings (capture.resolution, schedule.iterations)" in text for text in told[1])
    assert all("made with other settings (capture.resolution)" in text for text in told[2])
    write_asset(tmp_path / "toaster.drgs", read_asset(maker.file))
    assert main(["evaluate", *words]) == 0
    assert "settings that it does not keep" in capsys.readouterr().err


def test_the_asset_keeps_the_size_at_which_stanford_orb_is_read(maker, sets, tmp_path, capsys, monkeypatch):
    reconstructions(monkeypatch, maker.file)
    words = ["--protocol", "stanford-orb", str(sets["stanford-orb"]), "--objects", "teapot_scene001"]
    assert main(["evaluate", *words, "--out", str(tmp_path), "--samples", "1", "--most-views", "1"]) == 0
    kept = inspect_asset(tmp_path / "teapot_scene001.drgs")["provenance"]["settings"]
    assert kept["capture"]["resolution"] == 512


@pytest.mark.parametrize("given", ["axes=opencv", "up=y", "test_every=5"])
def test_settings_of_reading_that_the_set_says_are_refused(given, sets, tmp_path, capsys):
    words = ["--protocol", "shiny-blender", sets["shiny-blender"], "--out", tmp_path / "out"]
    said = refused(capsys, 64, *words, "--set", f"capture.{given}")
    assert f"capture.{given.split('=')[0]}: has no effect with --protocol" in said


def test_without_pytorch_it_is_said_before_anything_else(sets, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    said = refused(capsys, 69, "--protocol", "shiny-blender", sets["shiny-blender"], "--out", tmp_path / "out")
    assert "reconstruct: needs PyTorch" in said


def test_maps_that_a_set_lacks_are_told_and_the_rest_is_scored(maker, sets, tmp_path, capsys):
    root = tmp_path / "set"
    shutil.copytree(sets["stanford-orb"], root)
    (root / "ground_truth" / "teapot_scene001" / "z_depth" / "0001.npy").unlink()
    words = ["--protocol", "stanford-orb", str(maker.file), str(root), "--objects", "teapot_scene001"]
    assert main(["evaluate", *words, "--samples", "1", "--json"]) == 0
    said = capsys.readouterr()
    row = json.loads(said.out)["objects"]["teapot_scene001"]
    assert "1 of 2 files z_depth" in said.err
    assert row["shape"]["depth_mse"] is None and row["shape"]["normal_distance"] is not None


def test_what_cannot_be_scored_is_refused(maker, sets, tmp_path, capsys):
    root = sets["shiny-blender"]
    (tmp_path / "empty").mkdir()
    words = ["--protocol", "shiny-blender"]
    assert "needs assets and the set" in refused(capsys, 64, *words, root)
    assert "needs the folder of the set" in refused(capsys, 64, *words, maker.file, root, "--out", tmp_path / "out")
    assert "holds no object of shiny-blender" in refused(capsys, 65, *words, maker.file, tmp_path / "empty")
    assert "is not there" in refused(capsys, 65, *words, maker.file, tmp_path / "none")
    assert "is not there" in refused(capsys, 65, *words, tmp_path / "none.drgs", root)
    assert "has no object car; there are toaster" in refused(capsys, 65, *words, maker.file, root, "--objects", "car")
    assert "has no toaster.drgs" in refused(capsys, 65, *words, tmp_path / "empty", root)
    for option in (["--lights-from", tmp_path], ["--set", "variant=m"], ["--test-every", "3"], ["--axes", "opencv"]):
        assert f"{option[0]}: has no effect" in refused(capsys, 64, *words, maker.file, root, *option)
    of_scenes = {"--lights": "x", "--small": None, "--size": 32, "--train": 4, "--test": 4, "--spp": 1}
    for option, value in (of_scenes | {"--meshes": tmp_path, "--blender": "x"}).items():
        given = [option] if value is None else [option, value]
        assert f"{option}: has no effect" in refused(capsys, 64, maker.file, root, *words, *given)
    assert "--most-views: is an option of --protocol" in refused(capsys, 64, maker.file, root, "--most-views", 0)
    assert "--most-views: is 0" in refused(capsys, 64, *words, maker.file, root, "--most-views", 0)
    assert "--most-views: is an option of --protocol" in refused(capsys, 64, maker.file, root, "--most-views", 2)
    assert "--out: is an option of --protocol" in refused(capsys, 64, "--make-scenes", tmp_path, "--out", tmp_path)
    assert "cannot be given with --protocol" in refused(capsys, 64, *words, root, "--make-scenes", tmp_path)
    without = read_asset(maker.file)
    without.environment = None
    write_asset(tmp_path / "toaster.drgs", without)
    assert "no light of its own" in refused(capsys, 64, *words, tmp_path, root)


def test_an_asset_that_knows_the_views_or_another_world_is_told(maker, sets, tmp_path, capsys):
    asset = read_asset(maker.file)
    asset.provenance |= {"learned_from": ["test/r_0", "train/r_1"], "settings": {"capture": {"up": "y"}}}
    write_asset(tmp_path / "toaster.drgs", asset)
    words = ["--protocol", "shiny-blender", str(tmp_path), str(sets["shiny-blender"]), "--most-views", "1"]
    assert main(["evaluate", *words, "--samples", "1"]) == 0
    said = capsys.readouterr().err
    assert "learned from 1 of the views" in said and "--up y: its world is not that of the set" in said


def test_a_light_is_found_by_its_name(tmp_path):
    for name in ("neon_photostudio_4k.exr", "golf.hdr", "golf_2k.exr", "city_1k.exr", "city_2k.exr", "bridge.png"):
        (tmp_path / name).touch()
    assert find_light([tmp_path / "none", tmp_path], "neon").name == "neon_photostudio_4k.exr"
    assert find_light([tmp_path], "golf").name == "golf.hdr"
    with pytest.raises(AssetError, match="2 files for the light city"):
        find_light([tmp_path], "city")
    with pytest.raises(AssetError, match="light bridge: is not there"):
        find_light([tmp_path], "bridge")


@pytest.mark.slow
def test_assets_are_reconstructed_where_they_are_not_yet(sets, tmp_path, capsys):
    out = tmp_path / "out"
    sets_of = ["schedule.iterations=60", "schedule.surfels=400", "mesh_resolution=24", "decoupling.iterations=8"]
    words = ["--protocol", "shiny-blender", str(sets["shiny-blender"]), "--out", str(out), "--samples", "4", "--json"]
    given = [word for one in sets_of for word in ("--set", one)]
    assert main(["evaluate", *words, *given]) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["objects"]["toaster"]["views"]["psnr"] > 15
    assert [file.name for file in out.iterdir()] == ["toaster.drgs"]
    kept = read_asset(out / "toaster.drgs").provenance["settings"]
    assert kept["schedule"]["iterations"] == 60
    before = (out / "toaster.drgs").stat().st_mtime_ns
    assert main(["evaluate", *words, *given]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out) == first and "other settings" not in said.err
    assert (out / "toaster.drgs").stat().st_mtime_ns == before
    assert main(["evaluate", *words, "--set", "variant=m"]) == 0
    assert "made with other settings" in capsys.readouterr().err


def test_the_own_light_is_that_of_the_asset(maker, sets):
    """Views left out are rendered under it, relit pictures under those of the set."""
    asset, shown = read_asset(maker.file), []
    asset.environment = Environment(light(77))

    def render(camera, radiance, factors):
        shown.append(radiance)
        return maker.render(camera.matrix_world, radiance)

    bench = Bench(asset, render, most_views=1)
    assert bench.own_light() is asset.environment.radiance
    PROTOCOLS["glossysynthetic"].measure(bench, sets["glossysynthetic"], "bell", None)
    expected = [light(77), light(10), light(11), light(12)]  # corridor, golf, neon
    assert len(shown) == 4 and all(np.allclose(one, other, rtol=2e-3) for one, other in zip(shown, expected))


def test_an_asset_from_before_masks_had_a_default_of_their_own_is_used_again(monkeypatch, tmp_path):
    """Of sets with cameras the new default is what "given" was."""
    from drgs_blender.cli import evaluate_protocol
    from drgs_blender.core.asset import container
    from drgs_blender.reconstruct.settings import Reading, Settings
    from drgs_blender.reconstruct.settings_table import as_tables

    kept = as_tables(Settings(), Reading(masks="given"))
    monkeypatch.setattr(container, "inspect_asset", lambda *_, **__: {"provenance": {"settings": kept}})
    assert not evaluate_protocol._made_otherwise(tmp_path, Settings(), Reading())
    kept["capture"]["masks"] = "none"
    assert "capture.masks" in evaluate_protocol._made_otherwise(tmp_path, Settings(), Reading())
