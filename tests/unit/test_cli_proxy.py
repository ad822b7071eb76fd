"""``drgs relight`` and ``drgs simulate`` of surfels without a mesh: a proxy mesh in a file carries them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.deform.attach import attach
from drgs_blender.formats.point_cache import write_point_cache
from drgs_blender.render.film.frame_files import read_frame

LOOK = (
    "--camera-sees", "surfels", "--rays-see", "surfels", "--samples", "2", "--passes", "Combined,Position,Coverage",
    "--transparent", "--env-strength", "1",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A ball of surfels, the same with its mesh, a proxy around it, a light and a camera."""
    folder = tmp_path_factory.mktemp("proxy")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    n = len(ball.vertices)
    mesh = Mesh(ball.vertices, ball.faces, np.full((n, 3), 0.5), np.full(n, 0.8), np.zeros(n))
    surfels, binding, _ = attach(mesh, density=60)
    write_asset(folder / "meshed.drgs", Asset(surfels, mesh, binding))
    write_asset(folder / "bare.drgs", Asset(surfels, Mesh.empty()))
    trimesh.creation.icosphere(subdivisions=2, radius=0.6).export(folder / "hull.ply")
    look = {"matrix_world": [[1, 0, 0, 0], [0, 0, -1, -6], [0, 1, 0, 0], [0, 0, 0, 1]], "width": 40, "height": 30}
    (folder / "front.json").write_text(json.dumps(look | {"fov_x": 30}))
    from PIL import Image

    Image.new("RGB", (16, 8), (128, 128, 128)).save(folder / "sky.png")
    return folder


@pytest.fixture
def relight(folder, tmp_path, capsys):
    """Function that relights the bare ball and returns its passes, or the exit code and what was said."""

    def run(*options, asset="bare.drgs", name="out.exr"):
        words = ["relight", str(folder / asset), "--env", str(folder / "sky.png"), "--camera"]
        code = main([*words, str(folder / "front.json"), "--out", str(tmp_path / name), *LOOK, *map(str, options)])
        if code:
            return code, capsys.readouterr().err
        numbered = sorted(tmp_path.glob(name.replace("####", "*")))
        return [read_frame(path)[0] for path in numbered]

    return run


def hull(folder) -> np.ndarray:
    return np.asarray(trimesh.load(folder / "hull.ply", process=False).vertices, np.float32)


def simulation(folder, out) -> list[str]:
    asset, proxy = str(folder / "bare.drgs"), str(folder / "hull.ply")
    return ["simulate", asset, "--proxy", proxy, "--out", str(out / "bake"), "--resolution", "8"]


def middle(picture) -> np.ndarray:
    return np.average(picture["Position"].reshape(-1, 3), axis=0, weights=picture["Coverage"].ravel())


def test_poses_of_a_proxy_move_the_surfels(folder, relight, tmp_path):
    """Frame by frame of a point cache; what is turned and moved is as the asset with a mesh, moved so."""
    turn = trimesh.transformations.rotation_matrix(0.5, (0, 1, 0))[:3, :3].astype(np.float32)
    moved = [hull(folder) @ turn.T + np.float32((0.2 * k, 0, 0.3)) for k in range(3)]
    write_point_cache(tmp_path / "wind.pc2", iter(moved), 3, len(moved[0]), 1, 24.0)
    found = relight("--proxy", folder / "hull.ply", "--vertices", tmp_path / "wind.pc2", name="f####.exr")
    rest = relight()[0]
    for number, picture in enumerate(found):
        way = middle(picture) - middle(rest)  # another side is seen
        assert way == pytest.approx((0.2 * number, 0.0, 0.3), abs=0.03)
    meshed = np.asarray(trimesh.creation.icosphere(subdivisions=3, radius=0.5).vertices, np.float32)
    np.save(tmp_path / "pose.npy", meshed @ turn.T + np.float32((0.4, 0, 0.3)))
    posed = relight("--vertices", tmp_path / "pose.npy", asset="meshed.drgs")[0]
    np.save(tmp_path / "hull.npy", moved[2])
    same = relight("--proxy", folder / "hull.ply", "--vertices", tmp_path / "hull.npy")[0]
    assert np.abs(same["Coverage"] - posed["Coverage"]).mean() < 1e-4


def test_what_is_in_a_proxy_is_simulated_and_its_particles_carry_the_surfels(folder, relight, tmp_path):
    assert main([*simulation(folder, tmp_path), "--frames", "4"]) == 0
    rest = relight()[0]
    fallen = relight("--cache", tmp_path / "bake", "--frames", 4)[0]
    down = 0.5 * 9.81 * (3 / 24) ** 2
    assert middle(fallen) - middle(rest) == pytest.approx((0, 0, -down), abs=0.15 * down)
    code, told = relight("--cache", tmp_path / "bake", "--frames", 4, "--driven-by", "surface")
    assert code == 64 and "surfels alone" in told


def test_matter_that_flows_carries_no_surfels(folder, relight, tmp_path):
    assert main([*simulation(folder, tmp_path), "--frames", "2", "--material", "water"]) == 0
    code, told = relight("--cache", tmp_path / "bake", "--frames", 2)
    assert code == 64 and "bare.drgs" in told and "keeps its shape" in told


@pytest.mark.parametrize(("options", "asset", "said"), [
    (("--proxy", "hull.ply"), "bare.drgs", "--vertices"),
    (("--vertices", "pose.npy"), "bare.drgs", "--proxy"),
    (("--proxy", "hull.ply", "--vertices", "pose.npy"), "meshed.drgs", "has a mesh"),
    (("--proxy", "hull.ply", "--vertices", "few.npy"), "bare.drgs", "has 7 vertices"),
    (("--proxy", "hull.ply", "--vertices", "pose.npy", "--vertex-order", "asset"), "bare.drgs", "--vertex-order"),
    (("--proxy", "far.ply", "--vertices", "pose.npy"), "bare.drgs", "is not where"),
    (("--proxy", "flat.ply", "--vertices", "pose.npy"), "bare.drgs", "without area"),
    (("--proxy", "large.ply", "--vertices", "pose.npy"), "bare.drgs", "in metres"),
    (("--proxy", "points.ply", "--vertices", "pose.npy"), "bare.drgs", "points.ply"),
    (("--proxy", "nothing.ply", "--vertices", "pose.npy"), "bare.drgs", "nothing.ply"),
])  # fmt: skip
def test_what_carries_nothing_is_named(folder, relight, options, asset, said):
    np.save(folder / "pose.npy", hull(folder))
    np.save(folder / "few.npy", hull(folder)[:7])
    trimesh.creation.icosphere(subdivisions=2).apply_translation((9, 0, 0)).export(folder / "far.ply")
    trimesh.creation.icosphere(subdivisions=2, radius=600).export(folder / "large.ply")
    trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False).export(folder / "flat.ply")
    trimesh.PointCloud(hull(folder)).export(folder / "points.ply")
    words = [str(folder / word) if "." in word else word for word in options]
    code, told = relight(*words, asset=asset)
    assert code in (64, 65, 66) and said in told


def test_poses_that_are_not_finite_leave_the_picture_without_them(folder, relight, tmp_path):
    broken = hull(folder)
    broken[:20] = np.nan
    np.save(tmp_path / "pose.npy", broken)
    picture = relight("--proxy", folder / "hull.ply", "--vertices", tmp_path / "pose.npy")[0]
    assert all(np.isfinite(values).all() for values in picture.values())
    assert 0 < picture["Coverage"].sum() <= relight()[0]["Coverage"].sum() * 1.02


def test_surfels_alone_are_no_solid(folder, tmp_path, capsys):
    assert main(["simulate", str(folder / "bare.drgs"), "--out", str(tmp_path / "bake")]) == 64
    assert "--proxy" in capsys.readouterr().err
