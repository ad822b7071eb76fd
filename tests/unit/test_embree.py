"""Ray casting: right hits, moving meshes, kernels that survive in the cache."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drgs_blender.core.errors import DeviceError, UsageError
from drgs_blender.render.scene import embree
from drgs_blender.render.scene.triangle_bvh import ALL, Group, TriangleBVH


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


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="of x86 processors")
def test_rays_take_no_wider_instructions_than_avx2() -> None:
    """Embree ignores settings that it does not know."""
    native_ray16 = 34
    assert embree.library().rtcGetDeviceProperty(embree.device(), native_ray16) == 0


def test_a_wheel_without_embree_is_a_device_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = types.ModuleType("embreex.rtcore")
    fake.__file__ = str(tmp_path / "embreex" / "rtcore.so")
    package = types.ModuleType("embreex")
    package.rtcore = fake  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "embreex", package)
    monkeypatch.setitem(sys.modules, "embreex.rtcore", fake)
    with pytest.raises(DeviceError, match="Reinstall"):
        embree.library.__wrapped__()


#: Embree divides by approximate reciprocals, of which every make of processor has its own, and refines them.
ROUNDING = 4 * float(np.finfo(np.float32).eps)

_PROGRAM = """
import numpy as np
from drgs_blender.render.scene import triangle_bvh as tree
bvh = tree.TriangleBVH()
bvh.build([[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 1, 2]])
t, face, u, v = bvh.intersect([[0.25, 0.25, 0]], [[0, 0, 1]])
print(t[0], face[0], u[0], v[0], sum(tree._intersect.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_kernels_come_out_of_the_cache_in_another_process(tmp_path: Path) -> None:
    """Addresses differ from process to process; cached code must not have kept one."""
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(root)}
    environment.pop("NUMBA_CACHE_DIR", None)
    outputs = [
        subprocess.run([sys.executable, "-c", _PROGRAM], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    (*compiled, none), (*kept, one) = (output.stdout.split() for output in outputs)
    assert [float(x) for x in compiled] == pytest.approx([1, 0, 0.25, 0.25], rel=ROUNDING)
    assert kept == compiled
    assert (none, one) == ("0", "1")


# --- groups and places ---


def place(*, shift: tuple[float, float, float], scale: tuple[float, float, float], turn: int) -> np.ndarray:
    """(3, 4) float32: scale, then a turn, then a shift."""
    q, _ = np.linalg.qr(np.random.default_rng(turn).normal(size=(3, 3)))
    return np.concatenate([q * scale, np.array(shift)[:, None]], axis=1).astype(np.float32)


PLACES = np.stack(
    [
        place(shift=(0, 0, 0), scale=(1, 1, 1), turn=0),
        place(shift=(3, 0, 1), scale=(0.3, 0.7, 0.5), turn=1),
        place(shift=(0, -3, 0), scale=(-1, 1, 0.4), turn=2),
        place(shift=(-2, 2, -2), scale=(0.01, 0.01, 0.01), turn=3),
    ]
)


def copies(vertices: np.ndarray, faces: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    moved = np.concatenate([vertices.astype(float) @ m[:, :3].T + m[:, 3] for m in places.astype(float)])
    return moved.astype(np.float32), np.concatenate([faces + i * len(vertices) for i in range(len(places))])


def assert_same_hits(instanced: TriangleBVH, plain: TriangleBVH, faces: int, seed: int = 0) -> None:
    """Hits in places equal those of copies, save where a ray passes an edge."""
    origins, directions = rays(4000, seed, spread=3.0)
    t, face, instance, u, v = instanced.hits(origins, directions)
    expected_t, expected, expected_u, expected_v = plain.intersect(origins, directions)
    same = np.where(face >= 0, instance * faces + face, -1) == expected
    assert same.mean() > 0.995
    hit = same & (face >= 0)
    assert hit.sum() > 100 and len(np.unique(instance[hit])) > 1
    np.testing.assert_allclose(t[hit], expected_t[hit], rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(np.stack([u, v])[:, hit], np.stack([expected_u, expected_v])[:, hit], atol=5e-3)
    np.testing.assert_array_equal(instanced.occluded_many(origins, directions)[same], (face >= 0)[same])


def test_places_hit_as_copies_and_follow_what_moves() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    bvh, plain = TriangleBVH(), TriangleBVH()
    bvh.build(vertices, faces, [Group(0, len(faces), instances=PLACES)])
    built = bvh.rebuilds
    plain.build(*copies(vertices, faces, PLACES))
    assert_same_hits(bvh, plain, len(faces))
    other = PLACES[::-1] + np.float32(0.1)
    bvh.refit(moved=(), instances={0: other})
    plain.build(*copies(vertices, faces, other))
    assert_same_hits(bvh, plain, len(faces), 1)
    vertices = vertices * np.float32([1.0, 0.7, 1.3])
    bvh.refit(vertices)
    plain.build(*copies(vertices, faces, other))
    assert_same_hits(bvh, plain, len(faces), 2)
    for count in (2, 7):  # the number of places may change
        more = np.concatenate([PLACES, PLACES + np.float32([0, 0, 0, 2])])[:count]
        bvh.refit(moved=(), instances={0: more})
        plain.build(*copies(vertices, faces, more))
        assert_same_hits(bvh, plain, len(faces), 3)
    assert bvh.rebuilds == built


def test_rays_meet_the_groups_of_their_mask() -> None:
    """Three squares behind each other, the last in places; each mask meets the nearest that has one of its bits."""
    square = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([square + np.float32([0, 0, 1]), square + np.float32([0, 0, 2]), square])
    faces = np.concatenate([np.int32([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(3)])
    places = np.stack([np.eye(4, dtype=np.float32)[:3] for _ in range(2)])
    places[:, 2, 3] = 3, 4
    bvh = TriangleBVH()
    bvh.build(vertices, faces, [Group(0, 2, 1), Group(2, 4, 2 | 4), Group(4, 6, 4 | 8 | -(2**31), places)])
    origins, directions = np.float32([[0.2, 0.1, 0]] * 2), np.float32([[0, 0, 1], [0, 0, -1]])
    cases = ((1, 1, 0), (2, 2, 2), (4, 2, 2), (8, 3, 4), (1 | 8, 1, 0), (16, np.inf, -1), (ALL, 1, 0), (-(2**31), 3, 4))
    for mask, distance, face in cases:
        t, found, instance, _, _ = bvh.hits(origins, directions, mask=mask)
        assert t[0] == pytest.approx(distance, rel=ROUNDING)
        assert (found[0] // 2 * 2, instance[0]) == (face if face >= 0 else -2, 0 if face == 4 else -1)
        assert found[1] == -1
        np.testing.assert_array_equal(bvh.occluded_many(origins, directions, mask=mask), [face >= 0, False])


def test_groups_are_refitted_alone_and_rebuilt_alone() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    n, m = len(mesh.vertices), len(mesh.faces)
    vertices = np.concatenate([mesh.vertices, mesh.vertices + 4]).astype(np.float32)
    faces = np.concatenate([mesh.faces, mesh.faces + n]).astype(np.int32)
    groups = [Group(0, m, 1), Group(m, 2 * m, 2)]
    bvh, fresh = TriangleBVH(), TriangleBVH()
    bvh.build(vertices, faces, groups)
    built = bvh.rebuilds
    origins, directions = rays(3000, spread=3.0)
    rng = np.random.default_rng(0)
    vertices[n:] += np.float32([0.5, 0, 0])
    torn = vertices.copy()
    torn[:n] = rng.permutation(torn[:n])
    for now, moved, rebuilds in ((vertices, {1}, built), (torn, {0}, built + 1)):
        bvh.vertices[:] = now
        bvh.refit(moved=moved)
        fresh.build(now, faces, groups)
        assert bvh.rebuilds == rebuilds
        for mask in (1, 2, 3):
            for a, b in zip(bvh.hits(origins, directions, mask=mask), fresh.hits(origins, directions, mask=mask)):
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
