"""Blender's lights against formulas of photometry, and their two strategies against each other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from drgs_blender.core.frame import Light
from drgs_blender.render.lights.light_sampler import Lights, light_flags
from drgs_blender.render.lights.light_shapes import CAMERA, DIFFUSE, GLOSSY, INTENSITY, PLACE, RADIANCE, SHADOW
from drgs_blender.render.lights.light_tree import SECOND, lights_weight, pick_light, pick_probability
from drgs_blender.render.sampling import F, sobol

NUMBERS = sobol(1 << 14)


def placed(
    x: float, y: float, z: float, tilt: float = 0.0, scale: tuple[float, float, float] = (1, 1, 1)
) -> np.ndarray:
    """Matrix of a light at (x, y, z) that shines down, turned about X by `tilt`."""
    c, s = math.cos(tilt), math.sin(tilt)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) * np.array(scale)
    matrix[:3, 3] = x, y, z
    return matrix


def light(kind: str, *place: float, tilt: float = 0.0, scale=(1, 1, 1), **settings) -> Light:
    return Light("light", kind, placed(*place, tilt=tilt, scale=scale), **settings)


#: One of each, large in the sky of the origin so that uniform directions find it.
LARGE = {
    "soft point": light("point", 0.2, 0, 1, radius=0.7),
    "in soft point": light("point", 0.2, 0, 0.3, radius=0.7),
    "sphere": light("point", 0.2, 0, 1, radius=0.7, soft_falloff=False),
    "in sphere": light("point", 0.2, 0, 0.3, radius=0.7, soft_falloff=False),
    "spot": light("spot", 0, 0.1, 1, tilt=0.3, radius=0.7, spot_size=1.5, spot_blend=0.6),
    "stretched spot": light("spot", 0, 0.1, 1, tilt=0.3, scale=(1, 2, 0.7), radius=0.7, spot_size=1, spot_blend=1),
    "sun": light("sun", 0, 0, 0, tilt=0.4, angle=1.0),
    "square": light("area", 0, 0.3, 1, tilt=0.4, size_x=1.2),
    "far rectangle": light("area", 0.5, 0, 4, tilt=-0.4, shape="rectangle", size_x=0.2, size_y=0.3),
    "near rectangle": light("area", 0.5, 0, 0.05, shape="rectangle", size_x=2, size_y=3),
    "ellipse": light("area", 0, 0.3, 0.8, tilt=0.4, shape="ellipse", size_x=1.2, size_y=2),
    "disk": light("area", 0, 0.3, 0.8, scale=(1, 2, 1), shape="disk", size_x=0.7),
    "spread": light("area", 0.1, 0.3, 1, tilt=0.4, size_x=1.2, spread=1.3),
    "narrow spread": light("area", 0.1, 0.3, 1, size_x=2, spread=0.6),
    "spread ellipse": light("area", 0.1, 0.1, 0.6, tilt=0.2, shape="ellipse", size_x=2, size_y=1.5, spread=0.9),
}


def uniform_directions(count: int, seed: int = 1) -> np.ndarray:
    """(count, 3) float32, stratified over the sphere."""
    rng = np.random.default_rng(seed)
    side = math.isqrt(count)
    u, v = (np.stack(np.meshgrid(*[np.arange(side)] * 2)).reshape(2, -1) + rng.random((2, side * side))) / side
    z, a = 2 * u - 1, 2 * math.pi * v
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(a), r * np.sin(a), z], axis=1).astype(np.float32)


def irradiance(sampler: Lights, point=(0, 0, 0), normal=(0, 0, 1), numbers: np.ndarray = NUMBERS) -> float:
    """On a surface that faces `normal`, from the light samples."""
    directions, _, radiance, density, _ = sampler.sample(numbers, point)
    hit = density != 0
    cosine = np.maximum(directions[hit] @ np.array(normal, float), 0)
    return float((radiance[hit, 1] * cosine / np.abs(density[hit])).sum() / len(numbers))


def test_point_light_is_power_over_squared_distance():
    sampler = Lights([light("point", 0, 3, 4, power=20, colour=(1, 0.5, 0))])
    directions, distance, radiance, density, _ = sampler.sample(NUMBERS[:1], (0, 0, 0))
    np.testing.assert_allclose(directions, [[0, 0.6, 0.8]], rtol=1e-6)
    assert distance[0] == pytest.approx(5)
    assert density[0] == -1
    np.testing.assert_allclose(radiance, [[20 / (4 * math.pi * 25), 10 / (4 * math.pi * 25), 0]], rtol=1e-6)


def test_soft_point_is_a_disk_that_faces_the_surface():
    radius, distance = 0.5, 2.0
    radiance = 10 / (4 * math.pi * math.pi * radius**2)
    expected = math.pi * radiance * radius**2 / (radius**2 + distance**2)
    assert irradiance(Lights([light("point", 0, 0, 2, radius=radius)])) == pytest.approx(expected, rel=1e-4)
    # Far away it is a point.
    assert irradiance(Lights([light("point", 0, 0, 200, radius=radius)])) == pytest.approx(
        10 / (4 * math.pi * 200**2), rel=1e-4
    )


def test_sphere_above_the_horizon():
    """A sphere of uniform radiance gives pi L (r / d)^2 cos, at any distance, and pi L to whoever is inside."""
    for x, z in ((0, 2), (1.0, 1.0), (0, 0.501)):
        sampler = Lights([light("point", x, 0, z, radius=0.5, soft_falloff=False)])
        d2 = x * x + z * z
        assert irradiance(sampler) == pytest.approx(10 / (4 * math.pi * d2) * z / math.sqrt(d2), rel=3e-4)
    inside = Lights([light("point", 0.1, 0, 0.2, radius=0.5, soft_falloff=False)])
    assert irradiance(inside) == pytest.approx(10 / (4 * math.pi * 0.25), rel=3e-4)


@pytest.mark.parametrize("angle", [0.0, 0.009, 0.6, math.pi])
def test_sun_gives_its_strength(angle):
    sampler = Lights([light("sun", 5, 5, -7, tilt=0.0, angle=angle, power=3)])
    assert irradiance(sampler) == pytest.approx(3, rel=3e-4)
    if angle < 1:
        tilted = Lights([light("sun", 0, 0, 0, tilt=0.9, angle=angle, power=3)])
        assert irradiance(tilted) == pytest.approx(3 * math.cos(0.9), rel=3e-4)


def test_disk_on_its_axis():
    """pi L sin^2 of the half angle under which it is seen."""
    for height in (0.1, 1.0, 7.0):
        sampler = Lights([light("area", 0, 0, height, shape="disk", size_x=1.0)])
        radiance = 10 / (math.pi * math.pi * 0.25)
        expected = math.pi * radiance * 0.25 / (0.25 + height**2)
        found = irradiance(sampler, numbers=sobol(1 << 17))
        assert found == pytest.approx(expected, rel=2e-3 if height < 0.5 else 2e-4)


@pytest.mark.parametrize("height", [0.05, 0.5, 9.0])
def test_rectangle_over_its_corner(height):
    """Form factor of a parallel rectangle to a point under its corner (Siegel and Howell)."""
    a, b = 0.6 / height, 1.4 / height
    p, q = math.sqrt(1 + a * a), math.sqrt(1 + b * b)
    factor = (a / p * math.atan(b / p) + b / q * math.atan(a / q)) / (2 * math.pi)
    sampler = Lights([light("area", 0.3, 0.7, height, shape="rectangle", size_x=0.6, size_y=1.4)])
    assert irradiance(sampler) == pytest.approx(factor * 10 / (0.6 * 1.4), rel=3e-4)


def test_power_does_not_depend_on_spread_and_size():
    """All of an area's power passes a large plane beneath it, whatever its spread."""
    numbers = np.random.default_rng(0).integers(0, 2**32, (200 * 200, 3), dtype=np.uint32)
    for spread in (0.0, 0.08, 0.5, 1.5):
        sampler = Lights([light("area", 0, 0, 1.5, size_x=0.5, spread=spread)])
        width = 0.51 + 2 * 1.5 * math.tan(spread / 2)
        x, y = np.meshgrid(*[((np.arange(200) + 0.5) / 200 - 0.5) * width] * 2)
        directions, _, radiance, density, _ = sampler.sample(numbers, np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3))
        hit = density > 0
        flux = (radiance[hit, 0] * directions[hit, 2] / density[hit]).sum() * (width / 200) ** 2
        assert flux == pytest.approx(10, rel=0.02)


def test_without_normalize_radiance_stays():
    for settings in (
        {"kind": "area", "size_x": 0.3},
        {"kind": "point", "radius": 0.3},
        {"kind": "spot", "radius": 2.0},
    ):
        settings = dict(settings)
        sampler = Lights([light(settings.pop("kind"), 0, 0, 1, normalize=False, power=2, **settings)])
        assert sampler.along((0, 0, 0), [[0, 0, 1]])[0, 0] == pytest.approx(2 / math.pi)
    assert Lights([light("sun", 0, 0, 1, normalize=False, power=2, angle=0.3)]).along((0, 0, 0), [[0, 0, 1]])[0, 0] == 2


@pytest.mark.parametrize("name", LARGE)
def test_density_integrates_to_one(name):
    """Over all directions; where samples may miss (cone of a spot or spread), to the share of those that count."""
    sampler = Lights([LARGE[name]])
    directions = uniform_directions(1 << 20)
    density = sampler.pdf(0, (0, 0, 0), directions).astype(float)
    drawn = (sampler.sample(NUMBERS, (0, 0, 0))[2][:, 0] > 0).mean()
    error = density.std() / math.sqrt(len(density)) * 4 * math.pi
    assert density.mean() * 4 * math.pi == pytest.approx(drawn, abs=min(3 * error, 0.03) + 1e-3)
    assert drawn > (0.5 if "sp" in name else 0.9999)


@pytest.mark.parametrize("name", LARGE)
def test_samples_lie_where_their_density_says(name):
    sampler = Lights([LARGE[name]])
    directions, distance, radiance, density, rows = sampler.sample(NUMBERS, (0, 0, 0))
    hit = (density > 0) & (radiance[:, 0] > 0)
    np.testing.assert_allclose(np.linalg.norm(directions[hit], axis=1), 1, rtol=2e-6)
    found = sampler.pdf(rows[hit], (0, 0, 0), directions[hit])
    # A sample on the very rim may miss after rounding.
    np.testing.assert_allclose(found[found > 0], density[hit][found > 0], rtol=3e-4)
    assert (found > 0).mean() > 0.999
    seen = sampler.along((0, 0, 0), directions[hit])[found > 0]
    np.testing.assert_allclose(seen, radiance[hit][found > 0], rtol=2e-3, atol=1e-3 * radiance.max())
    assert ((distance[hit] > 0) & (np.isfinite(distance[hit]) | (name == "sun"))).all()


@pytest.mark.parametrize("name", LARGE)
def test_both_strategies_and_their_combination_agree(name):
    sampler = Lights([LARGE[name]])
    weigh = lambda d: np.maximum(d @ (0.3, 0.5, 0.4), 0)  # noqa: E731
    directions, _, radiance, density, _ = sampler.sample(NUMBERS, (0, 0, 0))
    hit = density > 0
    terms = np.zeros(len(density))
    terms[hit] = radiance[hit, 0] * weigh(directions[hit]) / density[hit]
    by_light = terms.mean()
    around = uniform_directions(1 << 20)
    values = sampler.along((0, 0, 0), around)[:, 0] * weigh(around) * 4 * math.pi
    error = values.std() / math.sqrt(len(values))
    # Stratified directions have far less than this error, light samples hardly any.
    assert by_light == pytest.approx(values.mean(), abs=error + 1e-3 * by_light)
    assert error < 0.08 * by_light
    # Two light samples and one uniform direction, by the balance heuristic.
    elsewhere = 1 / (4 * math.pi)
    terms[hit] = 2 * radiance[hit, 0] * weigh(directions[hit]) / (2 * density[hit] + elsewhere)
    rest = sampler.along((0, 0, 0), around, elsewhere, 2.0)[:, 0] * weigh(around)
    assert terms.mean() + rest.mean() == pytest.approx(by_light, rel=0.01)


def test_weights_of_one_direction_sum_to_one():
    for one in LARGE.values():
        sampler = Lights([one, light("sun", 0, 0, 0, tilt=3.0, angle=0.2), light("point", 9, 9, 9)])
        directions, _, radiance, density, rows = sampler.sample(NUMBERS[:512], (0, 0, 0))
        density = np.where(rows == 0, density, 0)
        for others, share in ((0.3, 1.0), (4.0, 0.25)):
            hit = (density > 0) & (sampler.pdf(0, (0, 0, 0), directions) > 0) & (radiance[:, 0] > 1e-2 * radiance.max())
            weighed = sampler.along((0, 0, 0), directions[hit], others, share)[:, 0]
            total = others * weighed / radiance[hit, 0] + share * density[hit] / (share * density[hit] + others)
            np.testing.assert_allclose(total, 1, rtol=2e-3)


def crowd(count: int, seed: int = 0) -> list[Light]:
    """Lights of all kinds, sizes and directions in a hall of 20 x 20 x 4 metres, and three suns."""
    rng = np.random.default_rng(seed)
    lights = []
    for i in range(count):
        matrix = np.eye(4)
        matrix[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * np.exp(rng.normal(0, 0.3, 3))
        matrix[:3, 3] = rng.uniform((-10, -10, 0), (10, 10, 4))
        lights.append(
            Light(
                f"light {i}",
                ("point", "spot", "area")[i % 3],
                matrix,
                colour=tuple(rng.random(3)),
                power=float(np.exp(rng.normal(2, 1))),
                radius=float(rng.choice([0.0, 0.2])),
                soft_falloff=bool(i & 1),
                spot_size=float(rng.uniform(0.2, 2.5)),
                shape=("square", "ellipse")[i % 2],
                size_x=float(rng.uniform(0.1, 0.6)),
                size_y=float(rng.uniform(0.1, 0.6)),
                spread=float(rng.choice([math.pi, rng.uniform(0.1, 2)])),
            )
        )
    return lights + [light("sun", 0, 0, 0, tilt=t, angle=0.2 * t, power=1e-2) for t in (0.0, 0.5, 2.0)]


@pytest.mark.parametrize("count", [0, 1, 32, 33, 300])
def test_pick_probabilities(count):
    sampler = Lights(crowd(count))
    assert sampler.count == count + 3
    assert (sampler.pick[1:, SECOND] > 0).any() == (count > 32)
    rng = np.random.default_rng(1)
    for point in rng.uniform((-10, -10, 0), (10, 10, 4), (4, 3)).astype(np.float32):
        each = np.array([pick_probability(i, *point, sampler.table, sampler.pick) for i in range(sampler.count)])
        numbers = (np.arange(1 << 14, dtype=np.uint32) << np.uint32(18)) + np.uint32(1 << 17)
        found = np.array([pick_light(n, *point, sampler.table, sampler.pick) for n in numbers])
        index, probability = found[:, 0].astype(int), found[:, 1]
        np.testing.assert_allclose(probability[index >= 0], each[index[index >= 0]], rtol=1e-4)
        picked = np.bincount(index % (sampler.count + 1), minlength=sampler.count + 1)
        # Equally spaced numbers: each light gets its share to within one number a boundary.
        np.testing.assert_allclose(picked[:-1] / len(numbers), each, atol=2 / len(numbers))
        assert picked[-1] / len(numbers) == pytest.approx(1 - each.sum(), abs=1e-3)
        assert lights_weight(*point, sampler.table, sampler.pick) > 0


def test_every_light_that_shines_on_a_point_can_be_picked():
    lights = crowd(300)
    sampler = Lights(lights)
    points = np.random.default_rng(2).uniform((-10, -10, 0), (10, 10, 4), (40, 3)).astype(np.float32)
    shining = 0
    for row, own in enumerate(sampler.order):
        alone = Lights([lights[own]])
        for point in points:
            lit = (alone.sample(NUMBERS[:16], point)[2] > 0).any()
            shining += lit
            assert not lit or pick_probability(row, *point, sampler.table, sampler.pick) > 0
    assert shining > 3000


def test_crowd_is_the_sum_of_its_lights():
    """By samples through the tree, and by the lights alone, all over a hall; with less spread than by power."""
    lights = crowd(300)
    sampler = Lights(lights)
    numbers, spread, spread_by_power = sobol(1 << 15), 0.0, 0.0
    by_power = sampler.table[:, INTENSITY] / sampler.table[:, INTENSITY].sum()
    points = np.random.default_rng(3).uniform((-10, -10, 0), (10, 10, 1), (6, 3)).astype(np.float32)
    for point in points:
        directions, _, radiance, density, _ = sampler.sample(numbers, point)
        hit = density != 0
        terms = np.zeros(len(numbers))
        terms[hit] = radiance[hit, 1] * np.maximum(directions[hit, 2], 0) / np.abs(density[hit])
        each = np.array([irradiance(Lights([lights[i]]), point, numbers=NUMBERS[:1024]) for i in sampler.order])
        assert terms.mean() == pytest.approx(each.sum(), rel=0.02)
        spread += terms.std() / each.sum()
        spread_by_power += math.sqrt((each**2 / by_power).sum() / each.sum() ** 2 - 1)
    assert spread < spread_by_power / 4


def test_rays_through_the_tree_meet_what_each_light_says():
    lights = [one for one in crowd(300) if one.kind != "spot"]
    sampler = Lights(lights)
    rng = np.random.default_rng(4)
    origins = rng.uniform((-10, -10, 0), (10, 10, 4), (3000, 3)).astype(np.float32)
    aims = sampler.table[rng.integers(0, sampler.count - 3, 3000), PLACE : PLACE + 3] + rng.normal(0, 0.1, (3000, 3))
    directions = (aims - origins).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:300] = np.eye(3)[np.arange(300) % 3]
    for tmax, seen_by in ((np.inf, DIFFUSE), (6.0, GLOSSY)):
        found = sampler.along(origins, directions, tmax=tmax, seen_by=seen_by)
        expected = sum(Lights([one]).along(origins, directions, tmax=tmax, seen_by=seen_by) for one in lights)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
        assert (found > 0).any(axis=1).mean() > 0.05
    some = np.stack([sampler.pdf(i, origins, directions) for i in range(0, sampler.count, 7)])
    assert np.isfinite(some).all()


def test_a_thousand_lights():
    sampler = Lights(crowd(1000))
    directions, _, radiance, density, rows = sampler.sample(NUMBERS, (1.0, 2.0, 0.5))
    assert len(np.unique(rows)) > 100
    assert np.isfinite(directions).all() and np.isfinite(radiance).all() and np.isfinite(density).all()


def test_many_lights_in_one_place():
    sampler = Lights([light("point", 1, 1, 1) for _ in range(100)])
    assert irradiance(sampler, (1, 1, 0)) == pytest.approx(100 * 10 / (4 * math.pi), rel=1e-3)


def test_rays_see_only_what_they_may():
    flags = [{"camera": True}, {"diffuse": False}, {"glossy": False}]
    sampler = Lights([light("area", 0, 0, 1, colour=tuple(np.eye(3)[i]), **flag) for i, flag in enumerate(flags)])
    up = [[0.0, 0.0, 1.0]]
    for seen_by, expected in ((CAMERA, (1, 0, 0)), (DIFFUSE, (1, 0, 1)), (GLOSSY, (1, 1, 0))):
        np.testing.assert_array_equal(sampler.along((0, 0, 0), up, seen_by=seen_by)[0] > 0, np.array(expected) > 0)
    assert sampler.rays_differ and not Lights([light("sun", 0, 0, 0)]).rays_differ
    found = [light_flags(i, sampler.tables) & ~SHADOW for i in range(3)]
    assert found == [CAMERA | DIFFUSE | GLOSSY, GLOSSY, DIFFUSE]


def test_surfaces_in_front_hide_lights():
    sampler = Lights([light("area", 0, 0, 2), light("sun", 0, 0, 0, angle=0.5)])
    up = [[0.0, 0.0, 1.0]]
    both, near, none = (sampler.along((0, 0, 0), up, tmax=tmax)[0, 0] for tmax in (np.inf, 3.0, 1.0))
    assert both > near > none == 0


def test_light_without_shadow_is_seen_by_rays_as_others_are():
    free, other = (Lights([light("area", 0, 0, 2, cast_shadow=on, camera=True)]) for on in (False, True))
    up = [[0.0, 0.0, 1.0]]
    for kind in (DIFFUSE, CAMERA):
        assert free.along((0, 0, 0), up, seen_by=kind)[0, 0] == other.along((0, 0, 0), up, seen_by=kind)[0, 0] > 0
    assert np.array_equal(free.sample(NUMBERS[:64], (0, 0, 0))[3], other.sample(NUMBERS[:64], (0, 0, 0))[3])


def test_nothing_is_ever_infinite():
    """At, in, on, behind and far from every light; what is behind an area gets nothing."""
    lights = [*LARGE.values(), light("point", 0, 0, 0), light("spot", 0, 0, 0), light("area", 0, 0, 0, size_x=1e-5)]
    for each in lights:
        one = Lights([each])
        assert not one.warnings
        place = np.asarray(each.matrix_world)[:3, 3]
        back = np.asarray(each.matrix_world)[:3, 2]
        beside = np.asarray(each.matrix_world)[:3, 0]
        for point in (place, place + 0.3 * beside, place + 0.5 * back, place - 1e-6 * back, place + 1e6 * beside):
            directions, distance, radiance, density, _ = one.sample(NUMBERS[:512], point)
            assert np.isfinite(directions).all() and np.isfinite(radiance).all() and np.isfinite(density).all()
            assert not np.isnan(distance).any()
            assert (radiance >= 0).all()
            if each.kind == "area":
                behind = (point - place) @ back > 0.1
                assert not (behind and (radiance > 0).any())
            around = uniform_directions(1024)
            assert np.isfinite(one.along(point, around, 0.1, 1.0)).all()
            assert np.isfinite(one.pdf(0, point, around)).all()


def test_useless_lights_are_named_and_left_out():
    nan = placed(0, 0, 1)
    nan[0, 3] = np.nan
    useless = {
        "dark": {"power": 0.0},
        "black": {"colour": (0, 0, 0)},
        "negative": {"power": -3.0},
        "endless": {"power": math.inf},
        "lost": {"matrix_world": nan},
        "thin": {"size_x": 0.0},
        "flat": {"matrix_world": placed(0, 0, 1, scale=(1, 1, 0))},
        "narrow": {"matrix_world": placed(0, 0, 1, scale=(0, 1, 1))},
        "blinding": {"power": 1e38, "size_x": 1e-3},
    }
    lights = [Light(name, "area", **{"matrix_world": placed(0, 0, 1)} | settings) for name, settings in useless.items()]
    lights.insert(4, light("point", 0, 0, 2))
    sampler = Lights(lights)
    assert [sum(repr(name) in warning for warning in sampler.warnings) for name in useless] == [1] * len(useless)
    assert sampler.count == 1 and sampler.order.tolist() == [4]
    assert irradiance(sampler) == pytest.approx(10 / (4 * math.pi * 4), rel=1e-5)
    assert "scale" in Lights([light("spot", 0, 0, 1, scale=(0, 1, 1))]).warnings[0]
    assert "scale" in Lights([light("sun", 0, 0, 1, scale=(1, 1, 0))]).warnings[0]
    assert "closed" in Lights([light("spot", 0, 0, 1, spot_size=0.0)]).warnings[0]
    # A point has no axes: its scale does not matter.
    assert not Lights([light("point", 0, 0, 1, scale=(0, 0, 0))]).warnings


def test_no_lights_are_black():
    sampler = Lights([])
    assert sampler.count == 0 and sampler.power == 0 and len(sampler.table) == 1
    _, _, radiance, density, rows = sampler.sample(NUMBERS[:16], (0, 0, 0))
    assert not radiance.any() and not density.any() and (rows == -1).all()
    assert not sampler.along((0, 0, 0), uniform_directions(64)).any()
    assert lights_weight(F(0), F(0), F(0), sampler.table, sampler.pick) == 0


def test_power_is_comparable_with_an_environment():
    """Luminance from all directions: irradiance of a sun, intensity over squared distance of a light."""
    assert Lights([light("sun", 0, 0, 0, power=3, angle=0.1)]).power == pytest.approx(3)
    far = Lights([light("point", 0, 0, 10, power=20)], centre=np.array([0, 0, 2.0]), radius=1.0)
    assert far.power == pytest.approx(20 / (4 * math.pi * 64))
    near = Lights([light("point", 0, 0, 0, power=20)], centre=np.zeros(3), radius=2.0)
    assert near.power == pytest.approx(20 / (4 * math.pi * 4))


def test_rows_keep_their_light():
    lights = crowd(40)
    sampler = Lights(lights)
    for row, own in enumerate(sampler.order):
        if lights[own].kind != "sun":
            np.testing.assert_allclose(
                sampler.table[row, PLACE : PLACE + 3], lights[own].matrix_world[:3, 3], rtol=1e-6
            )
        colour = np.array(lights[own].colour)
        found = sampler.table[row, RADIANCE : RADIANCE + 3]
        np.testing.assert_allclose(found / found.sum(), colour / colour.sum(), rtol=1e-5)


def test_lights_that_give_none_are_told_once_for_each_reason() -> None:
    off = [light("point", 0, 0, 1, power=0) for _ in range(300)]
    odd = [light("point", 0, 0, 1, power=-1), light("laser", 0, 0, 1, power=1)]
    sampler = Lights([*off, *odd, light("sun", 0, 0, 1, power=1)])
    assert sampler.count == 1
    zero, negative, kind = sampler.warnings
    assert zero == "300 lights ('light', 'light', 'light', ...) are each left out: its power or colour is zero"
    assert negative == "light 'light' is left out: its power is negative"
    assert kind == "light 'light' is left out: its kind 'laser' is none of point, sun, spot, area"
