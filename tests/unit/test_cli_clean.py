"""``drgs clean``: what is removed, and every bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset, Binding, Surfels
from drgs_blender.core.floaters import connected_parts, find_floaters
from drgs_blender.deform.attach import attach


@pytest.fixture(scope="module")
def littered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A ball with a clump, lone surfels and haze around it, and which surfels these are."""
    mesh = plain_mesh(*sphere_mesh(4))
    own, binding, _ = attach(mesh, density=60)
    rng = np.random.default_rng(4)
    far = rng.normal(size=(60, 3))
    far *= rng.uniform(1.5, 3, (60, 1)) / np.linalg.norm(far, axis=1, keepdims=True)
    clump = np.array([0, 0, 2.0]) + rng.normal(0, 0.02, (40, 3))
    litter = np.concatenate([far, clump]).astype(np.float32)
    k, n = len(litter), len(own)
    pick = rng.integers(0, n, k)
    more = {name: np.concatenate([v, v[pick]]) for name in ("scale", "rotation", "albedo", "roughness", "metallic")
            if (v := getattr(own, name)) is not None}  # fmt: skip
    surfels = Surfels(
        np.concatenate([own.centre, litter]), opacity=np.append(own.opacity, rng.uniform(0.1, 0.9, k)), **more
    )
    hung = {name: np.concatenate([v, v[pick]]) for name in ("face", "barycentric", "offset", "normal")
            if (v := getattr(binding, name)) is not None}  # fmt: skip
    path = tmp_path_factory.mktemp("clean") / "littered.drgs"
    write_asset(path, Asset(surfels, mesh, Binding(**hung)))
    return path, np.arange(n + k) >= n


def test_floaters_go_and_the_rest_stays(littered, tmp_path, capsys):
    path, litter = littered
    assert main(["clean", str(path), "--floaters", "--out", str(tmp_path / "c.drgs")]) == 0
    asset, cleaned = read_asset(path), read_asset(tmp_path / "c.drgs")
    kept = np.isin(asset.surfels.centre[:, 0], cleaned.surfels.centre[:, 0])
    assert (kept == ~litter).mean() > 0.999 and kept[~litter].all()
    np.testing.assert_array_equal(cleaned.mesh.faces, asset.mesh.faces)
    assert cleaned.provenance["cleaned_from"] == "littered.drgs"
    assert f"floaters: {int((~kept).sum())} of {len(kept)} surfels" in capsys.readouterr().out


def test_faces_that_only_what_is_removed_covered_go_when_asked(littered, tmp_path, capsys):
    """Half of the ball is faint: its faces go, but for those on which litter hangs, and no surfel that stays."""
    path, litter = littered
    asset = read_asset(path)
    low = asset.mesh.vertices[:, 2] < 0
    faint = low[asset.mesh.faces].all(axis=1)[asset.binding.face] & ~litter
    asset.surfels.opacity = np.where(faint, np.float32(0.01), np.maximum(asset.surfels.opacity, np.float32(0.1)))
    write_asset(tmp_path / "a.drgs", asset)
    given = ["clean", str(tmp_path / "a.drgs"), "--opacity", "0.05", "--out"]
    assert main([*given, str(tmp_path / "b.drgs")]) == 0
    assert main([*given, str(tmp_path / "c.drgs"), "--faces"]) == 0
    without, cleaned = read_asset(tmp_path / "b.drgs"), read_asset(tmp_path / "c.drgs")
    assert len(without.mesh.faces) == len(asset.mesh.faces)
    np.testing.assert_array_equal(cleaned.surfels.centre, without.surfels.centre)
    still = np.zeros(len(asset.mesh.faces), bool)
    still[asset.binding.face[~faint]] = True
    assert len(cleaned.mesh.faces) == still.sum() < len(still)


def test_a_clean_capture_has_none_and_size_is_no_matter():
    mesh = plain_mesh(*sphere_mesh(4))
    for scale in (1e-3, 1.0, 1e3):
        mesh.vertices = mesh.vertices * np.float32(scale)
        surfels, _, _ = attach(mesh, density=60)
        assert not find_floaters(surfels).any()
        mesh.vertices = mesh.vertices / np.float32(scale)
    assert find_floaters(surfels.__class__(*(a[:0] for a in (surfels.centre, surfels.scale, surfels.rotation,
        surfels.opacity, surfels.albedo, surfels.roughness, surfels.metallic)))).shape == (0,)  # fmt: skip


def test_connected_parts_are_those_of_scipy():
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 500, (2, 350))
    ours = connected_parts(500, first, second)
    count, theirs = connected_components(coo_matrix((np.ones(350), (first, second)), (500, 500)), directed=False)
    assert len(np.unique(ours)) == count == len(np.unique(np.stack([ours, theirs]), axis=1).T)


def test_a_box_cuts_surfels_and_faces(littered, tmp_path):
    path, _ = littered
    out = tmp_path / "half.drgs"
    assert main(["clean", str(path), "--box", "-2,-2,0,2,2,2", "--out", str(out)]) == 0
    half = read_asset(out)
    assert half.mesh.vertices[:, 2].min() >= 0 and half.surfels.centre[:, 2].min() >= 0
    assert 0.4 < len(half.mesh.faces) / len(read_asset(path).mesh.faces) < 0.5
    assert half.binding is not None and half.binding.face.max() < len(half.mesh.faces)


def test_faint_wide_and_distant_ones_go(littered, tmp_path):
    path, litter = littered
    asset = read_asset(path)
    for words, expected in (
        (["--opacity", "0.5"], asset.surfels.opacity < 0.5),
        (["--distance", "5"], litter),
        (["--wider", "1.0"], asset.surfels.scale.max(axis=1) > np.median(asset.surfels.scale.max(axis=1))),
    ):
        assert main(["clean", str(path), *words, "--out", str(tmp_path / "o.drgs")]) == 0
        np.testing.assert_array_equal(read_asset(tmp_path / "o.drgs").surfels.centre, asset.surfels.centre[~expected])


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ([], 64, "is told nothing to remove"),
        (["--box", "1,0,0,0,1,1"], 64, "has no inside"),
        (["--box", "50,50,50,51,51,51"], 64, "would be gone as a whole"),
        (["--opacity", "2"], 64, "would be gone as a whole"),
        (["--box", "1,2,3"], 64, "is not six numbers"),
    ],
)
def test_what_cannot_be_done_is_said(littered, tmp_path, capsys, words, code, message):
    try:
        given = main(["clean", str(littered[0]), *words, "--out", str(tmp_path / "o.drgs")])
    except SystemExit as ended:  # of the parser
        given = ended.code
    assert given == code
    assert message in capsys.readouterr().err and not (tmp_path / "o.drgs").exists()


def test_the_asset_itself_is_not_written_over(littered, capsys):
    before = littered[0].read_bytes()
    assert main(["clean", str(littered[0]), "--floaters", "--out", str(littered[0])]) == 64
    assert littered[0].read_bytes() == before and "is also the input" in capsys.readouterr().err
