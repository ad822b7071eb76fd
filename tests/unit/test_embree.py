"""Ray casting: right hits, moving meshes, kernels that survive in the cache."""

from __future__ import annotations

import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drgs_blender.errors import DeviceError, UsageError
from drgs_blender.render import embree
from drgs_blender.render.embree import TriangleBVH


def rays(count: int, seed: int = 0, spread: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return (rng.normal(size=(count, 3)) * spread).astype(np.float32), direction.astype(np.float32)


def brute_force(vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple:
    """Every ray against every triangle in float64 (Moeller-Trumbore): t, face, u, v of the closest hit."""
    a, b, c = (vertices.astype(float)[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    o, d = origins.astype(float)[:, None], directions.astype(float)[:, None]
    p = np.cross(d, e2)
    det = (p * e1).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = o - a
        u = (s * p).sum(-1) / det
        q = np.cross(s, np.broadcast_to(e1, s.shape))
        v = (d * q).sum(-1) / det
        t = (e2 * q).sum(-1) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    face = t.argmin(axis=1)
    row = np.arange(len(t))
    hit = np.isfinite(t[row, face])
    return t[row, face], np.where(hit, face, -1), u[row, face], v[row, face]


@pytest.fixture(scope="module")
def soup() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    vertices = (rng.normal(size=(200, 1, 3)) + rng.normal(size=(200, 3, 3)) * 0.4).reshape(-1, 3)
    return vertices.astype(np.float32), np.arange(600, dtype=np.int32).reshape(-1, 3)


def test_hits_are_those_of_brute_force(soup: tuple[np.ndarray, np.ndarray]) -> None:
    bvh = TriangleBVH()
    bvh.build(*soup)
    origins, directions = rays(2000)
    t, face, u, v = bvh.intersect(origins, directions)
    expected_t, expected_face, expected_u, expected_v = brute_force(*soup, origins, directions)
    same = face == expected_face
    assert same.mean() > 0.999  # an edge may fall to either side
    hit = same & (face >= 0)
    assert hit.sum() > 500
    np.testing.assert_allclose(t[hit], expected_t[hit], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.stack([u, v])[:, hit], np.stack([expected_u, expected_v])[:, hit], atol=2e-3)
    assert np.isinf(t[face < 0]).all()


def test_occlusion_agrees_with_the_closest_hit(soup: tuple[np.ndarray, np.ndarray]) -> None:
    bvh = TriangleBVH()
    bvh.build(*soup)
    origins, directions = rays(2000, seed=3)
    _, face, _, _ = bvh.intersect(origins, directions, tfar=1.0)
    np.testing.assert_array_equal(bvh.occluded_many(origins, directions, tfar=1.0), face >= 0)
    assert 0.05 < (face >= 0).mean() < 0.95


def test_a_refitted_tree_hits_what_a_new_one_hits() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    moved = TriangleBVH()
    moved.build(mesh.vertices, mesh.faces)
    built = moved.rebuilds
    vertices = (mesh.vertices * [1.0, 0.6, 1.5] + 0.1 * np.sin(5 * mesh.vertices[:, [1, 2, 0]])).astype(np.float32)
    moved.refit(vertices)
    assert moved.rebuilds == built
    fresh = TriangleBVH()
    fresh.build(vertices, mesh.faces)
    origins, directions = rays(3000, spread=2.0)
    for a, b in zip(moved.intersect(origins, directions), fresh.intersect(origins, directions), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_a_worn_out_tree_is_built_anew() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    bvh = TriangleBVH()
    bvh.build(mesh.vertices, mesh.faces)
    built = bvh.rebuilds
    bvh.refit(mesh.vertices * 100 + 7)  # moved and scaled, but as good as before
    assert bvh.rebuilds == built
    rng = np.random.default_rng(0)
    bvh.refit(rng.permutation(mesh.vertices))  # neighbours torn apart
    assert bvh.rebuilds == built + 1
    origins, directions = rays(500)
    _, face, _, _ = bvh.intersect(origins, directions)
    np.testing.assert_array_equal(face, brute_force(bvh.vertices, bvh.faces, origins, directions)[1])


def test_nothing_to_hit() -> None:
    bvh = TriangleBVH()
    origins, directions = rays(10)
    assert (bvh.intersect(origins, directions)[1] == -1).all()
    assert not bvh.occluded_many(origins, directions).any()
    bvh.build(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert (bvh.intersect(origins, directions)[1] == -1).all()
    bvh.close()
    bvh.close()


def test_faces_must_exist() -> None:
    with pytest.raises(UsageError, match=r"0\.\.2"):
        TriangleBVH().build(np.zeros((3, 3)), [[0, 1, 3]])


def test_a_wheel_without_embree_is_a_device_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = types.ModuleType("embreex.rtcore")
    fake.__file__ = str(tmp_path / "embreex" / "rtcore.so")
    package = types.ModuleType("embreex")
    package.rtcore = fake  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "embreex", package)
    monkeypatch.setitem(sys.modules, "embreex.rtcore", fake)
    with pytest.raises(DeviceError, match="Reinstall"):
        embree.library.__wrapped__()


_PROGRAM = """
import numpy as np
from drgs_blender.render import embree
bvh = embree.TriangleBVH()
bvh.build([[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 1, 2]])
t, face, u, v = bvh.intersect([[0.25, 0.25, 0]], [[0, 0, 1]])
print(t[0], face[0], u[0], v[0], sum(embree._intersect.stats.cache_hits.values()))
"""


def test_kernels_come_out_of_the_cache_in_another_process(tmp_path: Path) -> None:
    """Addresses differ from process to process; cached code must not have kept one."""
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(root)}
    environment.pop("NUMBA_CACHE_DIR", None)
    outputs = [
        subprocess.run([sys.executable, "-c", _PROGRAM], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    assert outputs[0].stdout.split() == ["1.0", "0", "0.25", "0.25", "0"]
    assert outputs[1].stdout.split() == ["1.0", "0", "0.25", "0.25", "1"]
