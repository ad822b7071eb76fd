"""Assets with the shape of an edited mesh: moved, cut, and mended with new faces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

from drgs_blender.build.reshape import Edit, reshape
from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset
from drgs_blender.core.errors import AssetError
from drgs_blender.deform.attach import attach
from drgs_blender.deform.mesh_driven import MeshDriven


@pytest.fixture(scope="module")
def ball() -> Asset:
    mesh = plain_mesh(*sphere_mesh(3))
    mesh.albedo = np.clip(0.5 + 0.4 * mesh.vertices, 0, 1).astype(np.float32)
    surfels, binding, _ = attach(mesh, density=40)
    surfels.sh = np.random.default_rng(0).normal(0, 0.1, (len(surfels), 4, 3)).astype(np.float32)
    binding.offset = np.random.default_rng(1).uniform(-0.2, 0.2, len(surfels)).astype(np.float32)
    return Asset(surfels, mesh, binding)


def unchanged(asset: Asset) -> Edit:
    n, m = len(asset.mesh.vertices), len(asset.mesh.faces)
    return Edit(asset.mesh.vertices, np.arange(n, dtype=np.int32), asset.mesh.faces, np.arange(m, dtype=np.int32))


def decapitated(asset: Asset) -> Edit:
    """Without what is above .7, closed by a fan around a new vertex."""
    mesh, edit = asset.mesh, unchanged(asset)
    kept = mesh.vertices[mesh.faces][..., 2].max(axis=1) < 0.7
    edges = np.concatenate([mesh.faces[kept][:, [0, 1]], mesh.faces[kept][:, [1, 2]], mesh.faces[kept][:, [2, 0]]])
    known = {tuple(edge) for edge in edges.tolist()}
    rim = [(a, b) for a, b in known if (b, a) not in known]
    middle = mesh.vertices[[a for a, _ in rim]].mean(axis=0)
    fan = np.array([(b, a, len(mesh.vertices)) for a, b in rim], np.int32)
    return Edit(
        np.concatenate([mesh.vertices, middle[None]]).astype(np.float32),
        np.append(edit.source, -1).astype(np.int32),
        np.concatenate([mesh.faces[kept], fan]),
        np.concatenate([np.flatnonzero(kept), np.full(len(fan), -1)]).astype(np.int32),
    )


def test_nothing_edited_is_the_same_asset(ball: Asset) -> None:
    made, counts = reshape(ball, unchanged(ball))
    assert counts == {"new_faces": 0, "new_surfels": 0, "moved": 0}
    for name in ("centre", "scale", "rotation", "opacity", "albedo", "sh"):
        np.testing.assert_array_equal(getattr(made.surfels, name), getattr(ball.surfels, name))
    np.testing.assert_array_equal(made.mesh.faces, ball.mesh.faces)


def test_a_moved_shape_at_rest_is_what_the_pose_was(ball: Asset) -> None:
    """Surfels of the new asset at rest, and in a further pose, are those of the old one in these poses."""
    bent = ball.mesh.vertices * np.float32([1, 1.4, 0.8])
    bent[:, 0] += 0.3 * bent[:, 2] ** 2
    made, counts = reshape(ball, replace(unchanged(ball), vertices=bent))
    assert counts["moved"] == 1
    old = MeshDriven(ball.mesh, ball.surfels, ball.binding)
    new = MeshDriven(made.mesh, made.surfels, made.binding)
    further = bent @ np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]], np.float32).T
    for vertices in (bent, further):
        a, b = old.pose(vertices), new.pose(vertices)
        np.testing.assert_allclose(b.centre, a.centre, atol=2e-3)
        np.testing.assert_allclose(b.normal, a.normal, atol=2e-3)
        spread = [np.einsum("nc,nd->ncd", p.tangent_u, p.tangent_u) + np.einsum("nc,nd->ncd", p.tangent_v, p.tangent_v)
                  for p in (a, b)]  # fmt: skip
        np.testing.assert_allclose(spread[1], spread[0], atol=1e-4)


def test_a_hole_is_closed_with_surfels_of_the_materials_around(ball: Asset) -> None:
    edit = decapitated(ball)
    made, counts = reshape(ball, edit)
    fan = int((edit.face < 0).sum())
    assert counts["new_faces"] == fan and counts["new_surfels"] >= fan
    assert made.binding is not None and made.surfels.sh is not None
    new = made.binding.face >= len(made.mesh.faces) - fan
    assert new.sum() == counts["new_surfels"]
    heights = made.surfels.centre[new][:, 2]
    assert np.ptp(heights) < 0.15 and abs(heights.mean() - edit.vertices[-1, 2]) < 0.1
    rim = ball.mesh.albedo[np.unique(edit.faces[edit.face < 0])[:-1]]
    albedo = made.surfels.albedo[new]
    assert (albedo >= rim.min(axis=0) - 0.1).all() and (albedo <= rim.max(axis=0) + 0.1).all()
    area = np.pi * np.quantile(np.linalg.norm(made.surfels.centre[new][:, :2], axis=1), 1.0) ** 2
    assert (2 * np.pi * made.surfels.scale[new].prod(axis=1)).sum() > 0.8 * area  # they cover the hole
    ratio = np.median(made.surfels.scale[new].max(axis=1)) / np.median(ball.surfels.scale.max(axis=1))
    assert 0.4 < ratio < 2.5
    assert np.abs(made.surfels.sh[new][:, 1:]).max() == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"faces": np.int32([[0, 1, 99999]]), "face": np.int32([0])}, "refer to vertex 99999"),
        ({"faces": np.int32([[0, 1, -1]]), "face": np.int32([0])}, "refer to vertex -1 "),
        ({"face": np.int32([0])}, "face have shape"),
        ({"vertices": np.full((642, 3), np.nan, np.float32)}, "642 vertices are not finite"),
        ({"face": np.full(1280, -1, np.int32)}, "no face of its asset left"),
        ({"source": np.full(642, -1, np.int32)}, "calls faces with new vertices"),
        ({"source": np.full(642, 700, np.int32)}, "of its part refer to number 700"),
    ],
)
def test_an_edit_that_does_not_fit_is_named(ball: Asset, change: dict, message: str) -> None:
    with pytest.raises(AssetError, match=message):
        reshape(ball, replace(unchanged(ball), **change))


def test_the_command(ball: Asset, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_asset(tmp_path / "ball.drgs", ball)
    edit = decapitated(ball)
    np.savez(tmp_path / "edit.npz", vertices=edit.vertices, source=edit.source, faces=edit.faces, face=edit.face)
    given = ["reshape", str(tmp_path / "ball.drgs"), "--edit", str(tmp_path / "edit.npz"), "--out"]
    assert main([*given, str(tmp_path / "closed.drgs")]) == 0
    made = read_asset(tmp_path / "closed.drgs")
    assert made.provenance["edited_from"] == "ball.drgs" and len(made.mesh.vertices) == len(edit.vertices)
    assert "new faces with" in capsys.readouterr().out
    assert main([*given, str(tmp_path / "ball.drgs")]) == 64
    (tmp_path / "edit.npz").write_bytes((tmp_path / "edit.npz").read_bytes()[:200])
    assert main([*given, str(tmp_path / "o.drgs")]) == 65
    np.savez(tmp_path / "edit.npz", vertices=edit.vertices)
    assert main([*given, str(tmp_path / "o.drgs")]) == 65
    assert "lacks source, faces, face" in capsys.readouterr().err
