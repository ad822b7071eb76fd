"""Surfels on another mesh: where they are, what they follow, what the mesh takes of the old one, and what is told."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

from drgs_blender.build.swap_mesh import swap_mesh, transformed
from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import AssetError
from drgs_blender.deform.attach import attach
from drgs_blender.deform.mesh_driven import MeshDriven


@pytest.fixture(scope="module")
def ball() -> Asset:
    mesh = plain_mesh(*sphere_mesh(4))
    mesh.albedo = np.clip(0.5 + 0.4 * mesh.vertices, 0, 1).astype(np.float32)
    mesh.emission = (3 + 3 * mesh.vertices).astype(np.float32)
    mesh.groups = {"top": np.flatnonzero(mesh.vertices[:, 2] > 0.5).astype(np.int32)}
    surfels, binding, _ = attach(mesh, density=30)
    surfels.sh = np.random.default_rng(0).normal(0, 0.1, (len(surfels), 4, 3)).astype(np.float32)
    return Asset(surfels, mesh, binding)


@pytest.fixture(scope="module")
def coarse() -> tuple[np.ndarray, np.ndarray]:
    """A retopology: fewer faces, turned, so that no vertex is one of the old mesh."""
    vertices, faces = sphere_mesh(3)
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]], np.float32)
    return (vertices @ turn.T).astype(np.float32), faces


def test_surfels_stay_and_materials_come_along(ball: Asset, coarse: tuple, caplog: pytest.LogCaptureFixture) -> None:
    made, _ = swap_mesh(ball, *coarse)
    assert made.surfels is ball.surfels and caplog.records == []
    np.testing.assert_array_equal(made.mesh.faces, coarse[1])
    np.testing.assert_allclose(made.mesh.albedo, np.clip(0.5 + 0.4 * coarse[0], 0, 1), atol=0.01)
    np.testing.assert_allclose(made.mesh.emission, 3 + 3 * coarse[0], atol=0.05)
    height = coarse[0][:, 2]
    inside = np.isin(np.arange(len(height)), made.mesh.groups["top"])
    assert inside[height > 0.6].all() and not inside[height < 0.4].any()


def test_surfels_follow_the_new_mesh(ball: Asset, coarse: tuple) -> None:
    """At rest where they were; turned and moved with it, as everything else."""
    made, _ = swap_mesh(ball, *coarse)
    assert made.binding is not None
    driven = MeshDriven(made.mesh, made.surfels, made.binding)
    np.testing.assert_allclose(driven.pose(made.mesh.vertices).centre, ball.surfels.centre, atol=1e-5)
    turn, shift = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([1, 2, 3.0])
    moved = driven.pose((coarse[0] @ turn.T + shift).astype(np.float32))
    np.testing.assert_allclose(moved.centre, ball.surfels.centre @ turn.T + shift, atol=1e-5)


def test_splats_without_a_mesh_get_one(ball: Asset, coarse: tuple, caplog: pytest.LogCaptureFixture) -> None:
    made, _ = swap_mesh(Asset(ball.surfels, Mesh.empty(), None), *coarse)
    assert made.binding is not None and made.surfels is ball.surfels and caplog.records == []
    np.testing.assert_allclose(made.mesh.albedo, np.clip(0.5 + 0.4 * coarse[0], 0, 1), atol=0.1)


@pytest.mark.parametrize("bound", [True, False])
def test_a_transformed_asset_is_its_pose(ball: Asset, bound: bool) -> None:
    asset = ball if bound else Asset(ball.surfels, Mesh.empty(), None)
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    matrix[:3, 3] = 1, 2, 3
    made = transformed(asset, matrix)
    np.testing.assert_allclose(made.surfels.centre, ball.surfels.centre @ matrix[:3, :3].T + [1, 2, 3], atol=1e-5)
    # a surfel that is round or nearly so has no first axis
    np.testing.assert_allclose(made.surfels.scale.prod(axis=1), 4 * ball.surfels.scale.prod(axis=1), rtol=1e-3)
    back = transformed(made, np.linalg.inv(matrix))
    assert back.surfels.sh is not None and made.surfels.sh is not None
    np.testing.assert_allclose(back.surfels.sh, ball.surfels.sh, atol=1e-4)
    assert np.abs(made.surfels.sh - ball.surfels.sh).max() > 0.05
    assert transformed(asset, np.eye(4)) is asset


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f: (v + np.array([5, 0, 0]), f), "do not overlap"),
        (lambda v, f: (v * 20, f), "do not fit"),
        (lambda v, f: (v, f[:, ::-1]), "is inside out"),
        (lambda v, f: (v, f[:0]), "has no faces"),
        (lambda v, f: (np.where(v > 0.99, np.nan, v), f), "vertices that are not finite"),
        (lambda v, f: (v, np.where(f == 0, 9999, f)), "faces of vertex 9999"),
    ],
)
def test_a_mesh_that_is_none_of_this_object_is_refused(ball: Asset, coarse: tuple, change, message: str) -> None:
    vertices, faces = change(*coarse)
    with pytest.raises(AssetError, match=f"(?s)new.obj.*{message}"):
        swap_mesh(ball, vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32), "new.obj")


@pytest.mark.parametrize(
    ("cut", "told"),
    [
        (lambda v, f: (v, f[v[f][..., 2].max(axis=1) < 0.3]), ["does not cover", "is open"]),
        (
            lambda v, f: (np.concatenate([v, v + np.array([0, 0, 1.4])]), np.concatenate([f, f + len(v)])),
            ["has no surfels on"],
        ),
    ],
)
def test_what_the_mesh_lacks_is_told(ball: Asset, coarse: tuple, cut, told: list[str], caplog) -> None:
    with caplog.at_level(logging.WARNING):
        swap_mesh(ball, *(array.astype(dtype) for array, dtype in zip(cut(*coarse), ("f4", "i4"), strict=True)), "new")
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == len(told) and all(text in line for text, line in zip(told, said, strict=True))


def test_an_open_mesh_of_an_open_object_is_no_news(ball: Asset, coarse: tuple, caplog) -> None:
    kept = ball.mesh.vertices[ball.mesh.faces][..., 2].max(axis=1) < 0.3
    bowl = plain_mesh(ball.mesh.vertices, ball.mesh.faces[kept])
    surfels, binding, _ = attach(bowl, density=30)
    vertices, faces = coarse
    with caplog.at_level(logging.WARNING):
        swap_mesh(Asset(surfels, bowl, binding), vertices, faces[vertices[faces][..., 2].max(axis=1) < 0.35])
    assert caplog.records == []


def test_the_command(ball: Asset, coarse: tuple, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    import trimesh

    write_asset(tmp_path / "ball.drgs", ball)
    trimesh.Trimesh(*coarse, process=False).export(tmp_path / "new.obj")
    given = ["reshape", str(tmp_path / "ball.drgs"), "--mesh", str(tmp_path / "new.obj")]
    assert main([*given, "--up", "z", "--out", str(tmp_path / "swapped.drgs")]) == 0
    made = read_asset(tmp_path / "swapped.drgs")
    np.testing.assert_allclose(made.mesh.vertices, coarse[0], atol=1e-6)
    np.testing.assert_array_equal(made.surfels.centre, ball.surfels.centre)
    assert made.provenance["edited_from"] == "ball.drgs" and "bound to 1280 faces" in capsys.readouterr().out
    damaged = (tmp_path / "new.obj").read_text().splitlines()
    damaged[next(i for i, line in enumerate(damaged) if line.startswith("v "))] = "v nan 0 0"
    (tmp_path / "new.obj").write_text("\n".join(damaged))
    assert main([*given, "--up", "z", "--out", str(tmp_path / "damaged.drgs")]) == 0
    assert "new.obj: 1 vertices that are NaN or infinite removed" in capsys.readouterr().out
    assert main([*given, "--edit", "e.npz", "--out", str(tmp_path / "b.drgs")]) == 64
    np.savez(tmp_path / "swap.npz", mesh_vertices=coarse[0], mesh_faces=coarse[1], matrix=np.eye(3))
    given[2:] = ["--edit", str(tmp_path / "swap.npz"), "--out", str(tmp_path / "c.drgs")]
    assert main(given) == 65
    assert "matrix have shape (3, 3)" in capsys.readouterr().err


def test_an_edit_and_another_mesh_at_once(ball: Asset, coarse: tuple, tmp_path: Path) -> None:
    """As Blender gives them: painted, without some surfels, and at another place."""
    write_asset(tmp_path / "ball.drgs", ball)
    n, m = len(ball.mesh.vertices), len(ball.mesh.faces)
    matrix = np.eye(4)
    matrix[0, 3] = 7
    np.savez(
        tmp_path / "swap.npz",
        vertices=ball.mesh.vertices, source=np.arange(n, dtype=np.int32), faces=ball.mesh.faces,
        face=np.arange(m, dtype=np.int32), removed=np.arange(5, dtype=np.int32),
        metallic=np.ones(n, np.float32), matrix=matrix,
        mesh_vertices=coarse[0] + np.float32([7, 0, 0]), mesh_faces=coarse[1],
    )  # fmt: skip
    out = tmp_path / "made.drgs"
    assert main(["reshape", str(tmp_path / "ball.drgs"), "--edit", str(tmp_path / "swap.npz"), "--out", str(out)]) == 0
    made = read_asset(out)
    np.testing.assert_allclose(made.surfels.centre, ball.surfels.centre[5:] + np.array([7, 0, 0]), atol=1e-5)
    np.testing.assert_allclose(made.mesh.metallic, 1, atol=1e-5)
    np.testing.assert_allclose(made.surfels.metallic, 1, atol=1e-5)


def test_textures_stay_behind_and_that_is_told(ball: Asset, coarse: tuple, caplog) -> None:
    from drgs_blender.core.asset.textures import MeshTextures

    m = len(ball.mesh.faces)
    textures = MeshTextures(
        np.zeros((m, 3, 2), np.float32), np.full(m, -1, np.int32), np.zeros((0, 8), np.int32),
        np.zeros((0, 12), np.float32), np.zeros((0, 8, 2, 3), np.float32), np.zeros((0, 8), np.int32), [],
    )  # fmt: skip
    with caplog.at_level(logging.WARNING):
        made, _ = swap_mesh(replace(ball, mesh=replace(ball.mesh, textures=textures)), *coarse)
    assert made.mesh.textures is None and "textures of the asset stay behind" in caplog.text
