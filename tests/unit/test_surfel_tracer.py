"""Surfels as what rays meet: equal to a blend of all surfels, no shadow of a surface on itself, real ones kept."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from clouds import blend_all, cloud, join, rays, select
from shapes import sphere_surfels

from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.core.errors import UsageError
from drgs_blender.render.surfels.surfel_bvh import SurfelBVH
from drgs_blender.render.surfels.surfel_query import CAPACITY
from drgs_blender.render.surfels.surfel_tracer import RayStarts, SurfelHits, trace, transmittance_many

Array = np.ndarray


def check(bvh: SurfelBVH, posed: PosedSurfels, count: int = 400, spread: float = 1.0, **ways: float) -> SurfelHits:
    """Hold the tracer against the blend of all surfels; returns what the latter gave."""
    origins, directions = rays(count, len(posed), spread)
    hits = trace(bvh, origins, directions, **{"gap": math.inf} | ways)
    expected = blend_all(posed, origins, directions, **ways)
    np.testing.assert_allclose(hits.through, expected.through, atol=1e-4)
    met = expected.object_index >= 0
    np.testing.assert_array_equal(hits.object_index >= 0, met)
    for name in ("depth", "normal", "geometric_normal", "albedo", "roughness", "metallic", "size"):
        np.testing.assert_allclose(getattr(hits, name)[met], getattr(expected, name)[met], atol=1e-4, err_msg=name)
    np.testing.assert_array_equal(hits.object_index[met], expected.object_index[met])
    ways.pop("gap", None)
    np.testing.assert_allclose(transmittance_many(bvh, origins, directions, **ways), expected.through, atol=1e-4)
    return expected


def traced(posed: PosedSurfels) -> SurfelBVH:
    bvh = SurfelBVH()
    bvh.update(posed)
    return bvh


@pytest.mark.parametrize("ways", [{}, {"gap": 0.7}, {"tnear": 0.3, "tfar": 1.2}])
@pytest.mark.parametrize(("n", "size"), [(3, 0.5), (60, 0.5), (800, 0.15)])
def test_a_ray_meets_what_a_blend_of_all_surfels_gives(n: int, size: float, ways: dict[str, float]) -> None:
    posed = cloud(n, seed=n, size=size)
    assert (check(traced(posed), posed, **ways).object_index >= 0).sum() > 20


def test_rays_go_on_where_a_walk_ends_with_its_list_full() -> None:
    posed = cloud(8000, seed=5, size=0.3, opacity=(0.004, 0.06))
    bvh = traced(posed)
    expected = check(bvh, posed, count=100, spread=0.3)
    fewest = np.log(expected.through) / np.log1p(-0.06)
    assert np.median(fewest) > CAPACITY and expected.through.max() > 1e-3


def test_surfels_at_equal_depth_are_each_met_once() -> None:
    posed = cloud(2 * CAPACITY, seed=6, opacity=(0.005, 0.2))
    posed.centre[:] = posed.centre[0]
    posed.tangent_u[:, 2] = posed.tangent_v[:, 2] = posed.centre[:, 2] = 0.0
    posed.tangent_u[:], posed.tangent_v[:] = posed.tangent_u[0], posed.tangent_v[0]
    rng = np.random.default_rng(0)
    uv = rng.normal(size=(200, 2))
    origins = posed.centre[0] + uv[:, :1] * posed.tangent_u[0] + uv[:, 1:] * posed.tangent_v[0]
    origins = np.ascontiguousarray(origins + np.array([0, 0, 2]), np.float32)
    down = np.tile(np.float32([0, 0, -1]), (200, 1))
    hits, expected = trace(traced(posed), origins, down), blend_all(posed, origins, down)
    assert np.unique(expected.through).size > 50
    np.testing.assert_allclose(hits.through, expected.through, atol=1e-4)
    np.testing.assert_allclose(hits.albedo, expected.albedo, atol=1e-4)
    np.testing.assert_array_equal(hits.object_index, expected.object_index)
    np.testing.assert_allclose(transmittance_many(traced(posed), origins, down), expected.through, atol=1e-4)


def test_bad_and_flat_surfels_are_not_met() -> None:
    posed = cloud(200, seed=7, size=0.4)
    posed.centre[0, 1] = np.nan
    posed.centre[1, 0] = 1e30
    posed.tangent_u[2, 2] = np.inf
    posed.opacity[3] = np.nan
    posed.tangent_u[4] = 0.0
    posed.tangent_u[5] = posed.tangent_v[5] = 0.0
    posed.tangent_u[6] = posed.tangent_v[6]
    posed.opacity[7] = 0.0
    posed.albedo[8], posed.normal[9] = np.nan, np.nan
    bvh = traced(posed)
    assert bvh.bad == 4
    origins, directions = rays(2000, 7)
    hits = trace(bvh, origins, directions)
    without = trace(traced(select(posed, np.arange(8, 200))), origins, directions)
    for name in SurfelHits.__slots__:
        assert np.isfinite(getattr(hits, name)[hits.object_index >= 0]).all(), name
        np.testing.assert_array_equal(getattr(hits, name), getattr(without, name), err_msg=name)


def test_a_ray_in_the_plane_of_a_surfel_passes() -> None:
    posed = select(cloud(1, size=0.5, opacity=(0.9, 1.0)), [0])
    posed.centre[:], posed.tangent_u[:], posed.tangent_v[:] = 0.0, [1, 0, 0], [0, 1, 0]
    hits = trace(traced(posed), [[-3, 0, 0], [-3, 0.1, 1e-3]], [[1, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(hits.through, 1.0)
    np.testing.assert_array_equal(hits.object_index, -1)


def test_far_from_the_origin_nothing_is_lost() -> None:
    """The tree is float32 as its input: discs as small as its rounding are still met where they lie."""
    posed = cloud(300, seed=8, size=0.2)
    posed.centre[:] += np.float32([1000.0, -2000.0, 500.0])
    origins, directions = rays(300, 8)
    origins += np.float32([1000.0, -2000.0, 500.0])
    hits, expected = trace(traced(posed), origins, directions, gap=math.inf), blend_all(posed, origins, directions)
    np.testing.assert_allclose(hits.through, expected.through, atol=1e-4)
    np.testing.assert_allclose(hits.albedo, expected.albedo, atol=1e-4)


def test_surfels_that_moved_are_met_where_they_are() -> None:
    first, then = cloud(500, seed=9, size=0.2), cloud(500, seed=9, size=0.2)
    then.centre += np.float32(0.1) * np.sin(4 * then.centre[:, [1, 2, 0]])
    then.tangent_u *= np.float32(1.3)
    then.opacity[:50] = 0.0
    first.opacity[50:90], first.centre[60:80] = 0.0, np.nan  # dead in one frame, seen in the next
    bvh = traced(first)
    built = bvh.rebuilds
    bvh.update(then)
    assert bvh.rebuilds == built
    check(bvh, then)
    bvh.update(cloud(400, seed=10, size=0.2))
    assert bvh.rebuilds == built + 1
    check(bvh, cloud(400, seed=10, size=0.2))
    rng = np.random.default_rng(0)
    torn = select(cloud(400, seed=10, size=0.01), rng.permutation(400))
    bvh.update(cloud(400, seed=10, size=0.01))
    tidy = bvh.rebuilds
    bvh.update(torn)  # may be refitted or rebuilt: the hits are the same
    assert bvh.rebuilds in (tidy, tidy + 1)
    check(bvh, torn)


def test_a_hit_depends_neither_on_the_tree_nor_on_other_rays() -> None:
    """Lists are sorted and cut by content: a refitted tree gives the last bit of what a new one gives."""
    first, then = cloud(2000, seed=12, size=0.15), cloud(2000, seed=13, size=0.15)
    bvh = traced(first)
    bvh.update(then)
    origins, directions = rays(1000, 12)
    hits, again = trace(bvh, origins, directions), trace(traced(then), origins[::-3], directions[::-3])
    for name in SurfelHits.__slots__:
        np.testing.assert_array_equal(getattr(hits, name)[::-3], getattr(again, name), err_msg=name)


def test_rays_that_are_not_finite_meet_nothing() -> None:
    bvh = traced(cloud(500, seed=14, size=0.4))
    origins, directions = rays(4, 14, spread=0.1)
    origins[0, 1], directions[1, 2], directions[2] = np.nan, np.nan, 0.0
    hits = trace(bvh, origins, directions)
    np.testing.assert_array_equal(hits.object_index >= 0, [False, False, False, True])
    np.testing.assert_array_equal(transmittance_many(bvh, origins, directions) < 1.0, [False, False, False, True])


def test_no_surfels_no_hits() -> None:
    bvh = SurfelBVH()
    origins, directions = rays(20)
    assert (transmittance_many(bvh, origins, directions) == 1.0).all()
    bvh.update(select(cloud(3), []))
    hits = trace(bvh, origins, directions, tfar=7.0)
    assert (hits.object_index == -1).all() and (hits.depth == 7.0).all()
    bvh.close()
    bvh.close()


def test_masks_choose_what_a_ray_meets() -> None:
    posed = cloud(300, seed=11, size=0.4)
    bvh = SurfelBVH()
    bvh.update(posed, np.array([1, 2, 4], np.int32))
    origins, directions = rays(400, 11)
    expected = blend_all(select(posed, posed.object_index != 1), origins, directions)
    hits = trace(bvh, origins, directions, mask=5, gap=math.inf)
    np.testing.assert_allclose(hits.through, expected.through, atol=1e-4)
    np.testing.assert_array_equal(hits.object_index, expected.object_index)
    np.testing.assert_allclose(transmittance_many(bvh, origins, directions, mask=5), expected.through, atol=1e-4)
    with pytest.raises(UsageError, match="object 2 of 2"):
        bvh.update(posed, np.array([1, 2], np.int32))


def cosine_rays(points: Array, normals: Array, count: int, seed: int = 0) -> tuple[Array, Array]:
    """`count` cosine-weighted directions about each point's normal, and the points repeated."""
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(len(points), count, 3))
    direction = normals[:, None] + ball / np.linalg.norm(ball, axis=2, keepdims=True)
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    return np.repeat(points, count, axis=0).astype(np.float32), direction.reshape(-1, 3).astype(np.float32)


def light(bvh: SurfelBVH, hits: SurfelHits, points: Array, rays_each: int = 256) -> Array:
    """Irradiance / pi of a white sky at seen points, each with its own start."""
    origins, directions = cosine_rays(points, hits.geometric_normal, rays_each)
    each = np.repeat(np.arange(len(points)), rays_each)
    starts = RayStarts(hits.object_index[each], hits.geometric_normal[each], hits.size[each])
    return transmittance_many(bvh, origins, directions, starts=starts).reshape(-1, rays_each).mean(axis=1)


def seen(bvh: SurfelBVH, centre: Array, n: int, seed: int = 0) -> tuple[SurfelHits, Array]:
    """What rays from all around towards points near `centre` meet, and where."""
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=(n, 3))
    towards /= -np.linalg.norm(towards, axis=1, keepdims=True)
    origins = (np.asarray(centre) - 5.0 * towards).astype(np.float32)
    hits = trace(bvh, origins, towards.astype(np.float32))
    return hits, origins + hits.depth[:, None] * towards


@pytest.mark.parametrize(("n", "noise"), [(1500, 0.0), (6000, 0.0), (6000, 0.3)])
def test_a_ball_of_surfels_casts_no_shadow_on_its_outside(n: int, noise: float) -> None:
    """Under a white sky every point of a convex body gets pi. Noise: of the centres along the normal, in sizes."""
    ball = sphere_surfels(1.0, n)
    size = np.linalg.norm(ball.tangent_u[0])
    rng = np.random.default_rng(1)
    ball.centre += (noise * size * rng.normal(size=(n, 1)) * ball.normal).astype(np.float32)
    bvh = traced(ball)
    hits, points = seen(bvh, [0, 0, 0], 300)
    assert (hits.through < 0.05).mean() > 0.95
    received = light(bvh, hits, points)
    assert received.mean() > 0.998
    assert np.quantile(received, 0.05) > 0.99
    if noise == 0.0:
        np.testing.assert_allclose(received, 1.0, atol=1e-3)
    # Without the rule a surface lies in its own shade.
    bare = SurfelHits(*(getattr(hits, name) for name in list(SurfelHits.__slots__)[:-1]), np.full(len(points), -1))
    assert light(bvh, bare, points).mean() < 0.8


def test_one_ball_shadows_another() -> None:
    """A ball of radius r at distance d, all above the horizon, hides (r / d)^2 cos of the cosine-weighted sky."""
    low, high = sphere_surfels(1.0, 6000), sphere_surfels(0.8, 6000)
    high.centre[:, 2] += 2.5
    both = join(low, high)
    bvh = traced(both)
    for polar in (0.0, 0.3, 0.5):
        normal = np.array([math.sin(polar), 0.0, math.cos(polar)])
        hits = trace(bvh, [1.1 * normal], [-normal])
        point = 1.1 * normal - hits.depth[0] * normal
        way = np.array([0, 0, 2.5]) - point
        distance = np.linalg.norm(way)
        hidden = (0.8 / distance) ** 2 * (way @ normal) / distance
        assert hits.object_index[0] == 0
        received = light(bvh, hits, point[None], 40000)[0]
        assert received == pytest.approx(1.0 - hidden, abs=0.02)


def test_contact_shadows_of_other_objects_stay() -> None:
    """A ball that stands on a sheet of surfels keeps the light off the spot it touches, however near."""
    ball, sheet = sphere_surfels(0.5, 4000), sphere_surfels(1.0, 2500)
    ball.centre[:, 2] += 0.5
    side = np.linspace(-2, 2, 50, dtype=np.float32)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    sheet.centre[:] = np.stack([x, y, 0 * x], -1)
    sheet.tangent_u[:], sheet.tangent_v[:], sheet.normal[:] = [0.05, 0, 0], [0, 0.05, 0], [0, 0, 1]
    bvh = traced(join(ball, sheet))
    x = np.array([0.03, 0.2, 0.5, 1.0])
    points = np.stack([x, 0 * x, 0 * x], -1)
    count = len(x)
    up = np.tile(np.float32([0, 0, 1]), (count, 1))
    starts = SurfelHits(None, None, None, up, None, None, None, np.full(count, 0.05), np.full(count, 1))  # type: ignore[arg-type]
    received = light(bvh, starts, points, 4000)
    distance = np.hypot(x, 0.5)
    np.testing.assert_allclose(received, 1 - (0.5 / distance) ** 2 * 0.5 / distance, atol=0.03)


_PROGRAM = """
import sys
sys.path.insert(0, {tests!r})
import numpy as np
from shapes import sphere_surfels
from drgs_blender.render.surfels import surfel_tracer
from drgs_blender.render.surfels.surfel_bvh import SurfelBVH
bvh = SurfelBVH()
bvh.update(sphere_surfels(1.0, 500))
through = surfel_tracer.transmittance_many(bvh, [[0, 0, 3], [0, 0, 3]], [[0, 0, -1], [0, 0, 1]])
print(through[0], through[1], sum(surfel_tracer._shadow.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_kernels_and_callbacks_come_out_of_the_cache_in_another_process(tmp_path: Path) -> None:
    """Addresses differ from process to process; cached code must not have kept one."""
    here = Path(__file__).resolve()
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(here.parents[2])}
    environment.pop("NUMBA_CACHE_DIR", None)
    program = _PROGRAM.format(tests=str(here.parent))
    outputs = [
        subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    first, second = (o.stdout.split() for o in outputs)
    assert first[:2] == second[:2] and float(first[0]) < 0.05 and float(first[1]) == 1.0
    assert (first[2], second[2]) == ("0", "1")
