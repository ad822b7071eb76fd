"""Emitting surfaces as lights: what is drawn towards them is what rays find on them, in less noise."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_integrate import points, settings
from test_light_sampler import irradiance, light
from test_surface import matrix, mesh_state

from drgs_blender.compute.jit import njit
from drgs_blender.core.color import LUMINANCE
from drgs_blender.core.frame import MeshState, Visibility, World
from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.lights.light_sampler import Lights, emission_along
from drgs_blender.render.lights.mesh_lights import MOST, Emitters
from drgs_blender.render.sampling import F, sobol
from drgs_blender.render.scene import ray_masks
from drgs_blender.render.scene.interaction import nearest
from drgs_blender.render.scene.ray import Ray
from drgs_blender.render.scene.trace_scene import TraceScene
from drgs_blender.render.shading_points import CATCHER

GLOW = Material("glow", (0.0, 0.0, 0.0), 1.0, 1.0, (3.0, 2.0, 1.0))
SQUARE = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = np.int32([[0, 1, 2], [0, 2, 3]])
UVS = np.float32([[0, 0], [1, 0], [1, 1], [0, 1]])[FACES]


def scene_of(*meshes: MeshState, images: tuple[Image, ...] = ()) -> TraceScene:
    scene = TraceScene()
    scene.update([], meshes, images)
    return scene


def panel(*places: np.ndarray, **changes: object) -> MeshState:
    """A square of two by two metres that glows, in places."""
    return mesh_state(SQUARE, FACES, *places, **({"materials": [GLOW]} | changes))


def soup(count: int, seed: int = 0, size: float = 0.2) -> MeshState:
    """Triangles of all sizes and shapes, strewn over a box above the origin."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform((-1, -1, 0.3), (1, 1, 2), (count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    return mesh_state(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), materials=[GLOW])


def ball(rings: int, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of about 8 rings^2 triangles that look outwards: vertices, faces."""
    u, v = np.meshgrid(np.arange(4 * rings) * math.pi / (2 * rings), np.linspace(0, math.pi, rings + 1), indexing="ij")
    vertices = radius * np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], -1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(4 * rings), np.arange(rings), indexing="ij"))
    a, b = i * (rings + 1) + j, (i + 1) % (4 * rings) * (rings + 1) + j
    faces = np.concatenate([np.stack([a, a + 1, b + 1], -1), np.stack([a, b + 1, b], -1)])
    row = faces % (rings + 1)
    faces = np.where(row == 0, 0, np.where(row == rings, rings, faces))  # one vertex at each pole
    return vertices, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def bulb(*places: np.ndarray, inwards: bool = False) -> MeshState:
    """A glowing ball of unit radius or, looking inwards, a small one."""
    vertices, faces = ball(6, 1.0)
    if inwards:
        return mesh_state(0.1 * vertices + (0, 0.4, 0.3), np.ascontiguousarray(faces[:, ::-1]), materials=[GLOW])
    return mesh_state(vertices, faces, *places, materials=[GLOW])


@njit
def _look(origins, directions, tracer, geometry, lights, out):  # type: ignore[no-untyped-def]
    for i in range(len(origins)):
        o, d = (origins[i, 0], origins[i, 1], origins[i, 2]), (directions[i, 0], directions[i, 1], directions[i, 2])
        hit = nearest(tracer, Ray(o, d, F(0.0), F(np.inf), np.int32(ray_masks.DIFFUSE)))
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], _ = emission_along(o, d, hit, geometry, lights)


def along(scene: TraceScene, sampler: Lights, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n, 4): what rays meet, and the density with which it is drawn from the same place."""
    out = np.empty((len(directions), 4), np.float32)
    directions = np.ascontiguousarray(directions, np.float32)
    origins = np.ascontiguousarray(np.broadcast_to(np.float32(origins), directions.shape))
    _look(origins, directions, scene.tracer, scene.geometry, sampler.tables, out)
    return out


def light_of(
    meshes: list[MeshState],
    sampled: bool = True,
    *,
    bounces: int = 0,
    strength: float = 0.0,
    lights: tuple = (),
    counts: tuple[int, int, int] = (16, 8, 8),
    count: int = 4000,
    images: tuple[Image, ...] = (),
    **changes: object,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean light of a point by kind, (4, 3), and its standard error."""
    scene = scene_of(*meshes, images=images)
    seen = points(count, **({"albedo": 0.8, "roughness": 0.4, "origin": (0.3, 0.1, 0.0)} | changes))  # type: ignore[arg-type]
    how = settings(*counts, bounces=bounces, shading_model="principled")
    sampler = Lights(list(lights), np.zeros(3), 3.0, Emitters(scene) if sampled else None)
    found = integrate(scene, EnvironmentLight(World(strength=strength)), seen, how, 0, sampler).components.astype(float)
    return found.mean(0), found.std(0) / math.sqrt(count)


def assert_equal_light(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> None:
    assert (np.abs(a[0] - b[0]) <= 4.5 * np.hypot(a[1], b[1]) + 1e-5).all(), (a, b)


def place(shift: tuple[float, float, float], size: float = 1.0) -> np.ndarray:
    return matrix(shift, (size,) * 3)


def polygon_irradiance(corners: np.ndarray) -> float:
    """On a surface at the origin that faces +Z, from a polygon of radiance 1 above its horizon (Lambert)."""
    a = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    b = np.roll(a, -1, axis=0)
    across = np.cross(a, b)
    angle = np.arctan2(np.linalg.norm(across, axis=1), (a * b).sum(1))
    return abs(0.5 * (angle * across[:, 2] / np.linalg.norm(across, axis=1)).sum())


@pytest.mark.parametrize("height", [0.02, 0.5, 3.0, 30.0])
@pytest.mark.parametrize("turn", [0.0, 0.7, 2.9])
def test_irradiance_is_lambert_s_formula(height: float, turn: float) -> None:
    """Large and small in the sky, from either side."""
    c, s = math.cos(turn), math.sin(turn)
    corners = np.float32([[-0.5, -0.3, 0], [0.9, -0.2, 0], [0.1, 0.8, 0]]) @ np.float32(
        [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    )
    corners[:, 2] += height + 0.9 * abs(s)
    scene = scene_of(mesh_state(corners, np.int32([[0, 1, 2]]), materials=[GLOW]))
    sampler = Lights([], emitters=Emitters(scene))
    assert sampler.count == 1
    assert irradiance(sampler, numbers=sobol(1 << 13)) == pytest.approx(2.0 * polygon_irradiance(corners), rel=3e-3)


@pytest.mark.parametrize("count", [1, 5, 70, 3000])
def test_what_is_drawn_and_what_is_found_have_one_density(count: int) -> None:
    """So the weights of both strategies sum to one: p / (p + q) and q / (p + q), with the same p and q."""
    scene = scene_of(soup(count, size=min(0.2, 2.0 / math.sqrt(count))))
    sampler = Lights([light("point", 0, 1, 2, radius=0.2, power=30)], emitters=Emitters(scene))
    rng = np.random.default_rng(1)
    numbers = rng.integers(0, 1 << 32, (4000, 3), np.uint32)
    origins = np.float32(rng.uniform((-1, -1, -0.2), (1, 1, 0.2), (4000, 3)))
    directions, distance, radiance, density, row = sampler.sample(numbers, origins)
    surface = (row >= 1) & (density > 0)
    assert surface.mean() > 0.1
    t, _, _, _ = scene.bvh.intersect(origins, directions)
    first = surface & (np.abs(t - distance) < 1e-5 * distance)
    assert first.sum() > 200
    found = along(scene, sampler, origins, directions)
    np.testing.assert_allclose(found[first, :3], radiance[first], rtol=1e-6)
    # Rounding moves the direction, and the cosine of what is seen from its edge with it.
    ratio = found[first, 3] / density[first]
    assert np.quantile(np.abs(ratio - 1), 0.98) < 1e-3 and np.abs(np.log(ratio)).max() < 0.1


@pytest.mark.parametrize("count", [1, 4, 5, 9, 300])
def test_densities_over_all_directions_sum_to_one(count: int) -> None:
    """Of triangles that do not hide each other: a flat sheet of them."""
    rng = np.random.default_rng(count)
    side = math.ceil(math.sqrt(count))
    at = np.stack(np.meshgrid(*[np.arange(side)] * 2), -1).reshape(-1, 2)[:count] / side
    corners = np.full((count, 3, 3), 0.4)
    corners[..., :2] = (at[:, None] + rng.random((count, 3, 2)) / side) * 2 - 1
    scene = scene_of(mesh_state(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), materials=[GLOW]))
    sampler = Lights([], emitters=Emitters(scene))
    u, v = (rng.random((2, 400, 400)) + np.stack(np.meshgrid(*[np.arange(400)] * 2))).reshape(2, -1) / 400
    r = np.sqrt(1 - v * v)
    upwards = np.stack([r * np.cos(2 * math.pi * u), r * np.sin(2 * math.pi * u), v], -1)
    total = along(scene, sampler, np.zeros(3), upwards)[:, 3].mean() * 2 * math.pi
    assert total == pytest.approx(1.0, abs=0.02)


EMITTERS = {
    "small and bright": [
        panel(place((0.5, 0.4, 1.0), 0.02), materials=[replace(GLOW, emission=(900.0, 600.0, 300.0))])
    ],
    "around a corner": [panel(place((0, 0, 1.2), 0.4)), panel(place((0, 0, 0.6), 0.3), materials=[Material("dark")])],
    "places": [
        panel(place((0.5, 0.4, 1.0), 0.2), matrix((-1, 0, 0.7), (-0.2, 0.1, 0.3), 3), matrix((0, 1, 0.3), turn=4))
    ],
    "soup": [soup(200)],
    "bulbs": [bulb(place((0.5, 0.3, 0.5), 0.2), matrix((-0.5, 0.2, 0.4), (-0.2, 0.1, 0.15), 4)), bulb(inwards=True)],
    "touching": [panel(matrix((0.6, 0.0, 0.0), (0.3, 0.3, 0.3), 5))],
}


@pytest.mark.parametrize(
    ("bounces", "name"),
    [
        pytest.param(bounces, name, marks=[pytest.mark.slow] if bounces and name in ("soup", "places", "bulbs") else [])
        for bounces in (0, 2)
        for name in EMITTERS
    ],
)
def test_sampled_light_is_the_light_that_rays_find(name: str, bounces: int) -> None:
    wall = mesh_state(SQUARE, FACES, matrix((1.5, 0, 1), turn=2), materials=[Material("wall", (0.9, 0.6, 0.3), 0.4)])
    meshes = [*EMITTERS[name], wall]
    for strength, lights in ((0.0, ()), (0.3, (light("area", -1, 0, 2, size_x=0.5, power=20),))):
        rules = {"bounces": bounces, "strength": strength, "lights": lights}
        sampled, chance = light_of(meshes, **rules), light_of(meshes, False, count=12000, **rules)
        assert sampled[0][0].min() > 0
        assert_equal_light(sampled, chance)


def test_small_emitters_lose_their_noise() -> None:
    """Variance at equal rays, direct and indirect."""
    wall = mesh_state(SQUARE, FACES, matrix((1.5, 0, 1), turn=2), materials=[Material("wall", (0.9, 0.6, 0.3), 0.4)])
    meshes = [*EMITTERS["small and bright"], wall]
    (_, a), (_, b) = light_of(meshes, bounces=1), light_of(meshes, False, bounces=1)
    assert (a[0] ** 2 < 0.02 * b[0] ** 2).all() and (a[1] ** 2 < 0.1 * b[1] ** 2).all()


@pytest.mark.parametrize("rings", [8, 112])
@pytest.mark.parametrize("counts", [(16, 8, 8), (0, 0, 32), (0, 32, 8)])
def test_furnace(rings: int, counts: tuple[int, int, int]) -> None:
    """Within a ball that glows as the sky does elsewhere, of up to 99 904 triangles, light is that of the sky."""
    vertices, faces = ball(rings, 2.0)
    shell = mesh_state(vertices, faces, materials=[replace(GLOW, emission=(1.0, 1.0, 1.0))])
    within = light_of([shell], counts=counts, count=2000)
    under = light_of([], strength=1.0, counts=counts, count=2000, normal=(0, 0, 1))
    below = light_of([shell], False, counts=(16, 16, 0), count=2000)
    assert_equal_light(within, below)
    assert_equal_light(within, under)


def test_moments_are_of_all_the_light_that_a_point_has() -> None:
    """Sums of samples' luminance: of sky, of what glows and is sampled or met by rays, and of indirect light."""
    panels = [panel(place((0, 0.4, 0.8), 0.4)), mesh_state(SQUARE, FACES, place((0.5, 0, 0.5), 0.3), materials=[GLOW])]
    seen = points(500, albedo=0.8, roughness=0.4, origin=(0.3, 0.1, 0.0))
    scene = scene_of(*panels, mesh_state(SQUARE, FACES, place((0, 0, -0.5))))
    sky, lamps = EnvironmentLight(World(strength=0.3)), Lights([], np.zeros(3), 3.0, Emitters(scene))
    found = integrate(scene, sky, seen, settings(16, 8, 8, bounces=2, shading_model="principled"), 0, lamps)
    light = found.components.reshape(-1, 2, 2, 3).sum(axis=2) @ LUMINANCE
    assert (light > 0).all()
    np.testing.assert_allclose(found.moments[:, [1, 3]], light, rtol=1e-4)


def test_textures_are_looked_up_where_the_light_comes_from() -> None:
    """A picture on a screen: sampled by its mean, shining by its texels."""
    pixels = np.random.default_rng(3).random((8, 8, 4)).astype(np.float32) ** 4
    pixels[2, 5, :3] = 60, 20, 5
    glow = replace(GLOW, emission_texture=Texture("screen"))
    screen = panel(place((0.2, 0.3, 0.8), 0.5), materials=[glow], uvs=UVS)
    rules = {"images": (Image("screen", pixels),)}
    sampled, chance = light_of([screen], **rules), light_of([screen], False, count=20000, **rules)
    assert_equal_light(sampled, chance)
    # By light samples alone, dark texels between those that the pick looks at included.
    alone = light_of([screen], counts=(0, 0, 64), **rules)
    assert_equal_light(alone, chance)


def test_only_those_lobes_that_see_it_get_its_light() -> None:
    """Also where shadow rays pass it."""
    for visibility in (Visibility(diffuse=False), Visibility(glossy=False), Visibility(shadow=False)):
        meshes = [panel(place((0.2, 0.3, 0.8), 0.3), visibility=visibility), panel(place((0, 0, 9), 0.01))]
        sampled, chance = light_of(meshes), light_of(meshes, False, count=20000)
        assert_equal_light(sampled, chance)
        assert (sampled[0][0, 0] < 1e-3) == (not visibility.diffuse)
        assert (sampled[0][2, 0] < 1e-3) == (not visibility.glossy)


def test_a_catcher_s_own_world_has_no_light_of_other_surfaces() -> None:
    """Neither by rays nor by samples: what it would reflect without the scene is the sky's."""
    scene = scene_of(panel(place((0.2, 0.3, 0.8), 0.3)))
    seen = points(500, albedo=0.8, flags=np.full(500, CATCHER, np.int32))
    how = settings(16, 8, 8)
    sampler = Lights([], emitters=Emitters(scene))
    found = integrate(scene, EnvironmentLight(World(strength=0.0)), seen, how, 0, sampler)
    assert found.components.max() > 0 and found.unshadowed is not None and found.unshadowed.max() == 0


def test_the_tree_is_kept_until_something_that_glows_changes() -> None:
    scene, glow, dark = TraceScene(), soup(50), panel(place((0, 0, 5)), materials=[Material("dark")])
    scene.update([], [glow, dark])
    first = Emitters(scene)
    scene.update([], [glow, replace(dark, matrices=place((0, 0, 6))[None])])
    second = Emitters(scene, first)
    assert second.rows is first.rows
    moved = replace(glow, matrices=place((1, 0, 0))[None])
    scene.update([], [moved, dark])
    third = Emitters(scene, second)
    assert third.rows is not first.rows
    np.testing.assert_allclose(third.rows[:, :3].mean(0), first.rows[:, :3].mean(0) + np.eye(3)[0], atol=1e-4)
    scene.update([], [replace(moved, materials=[replace(GLOW, emission=(1.0, 1.0, 1.0))]), dark])
    assert Emitters(scene, third).scale != third.scale
    scene.update([], [dark])
    assert Emitters(scene, third).count == 0


def test_samples_of_closed_surfaces_go_to_the_side_that_is_seen() -> None:
    """However it is turned or mirrored; an open one has two sides."""
    vertices, faces = ball(16, 0.2)
    rng = np.random.default_rng(0)
    numbers = rng.integers(0, 1 << 32, (4000, 3), np.uint32)
    seen = []
    for own, where in (
        (faces, place((0, 0, 1))),
        (faces[:, ::-1], place((0, 0, 1))),
        (faces, matrix((0, 0, 1), (-1, 1, 1))),
        (faces[1:], place((0, 0, 1))),
    ):
        scene = scene_of(mesh_state(vertices, np.ascontiguousarray(own), where, where, materials=[GLOW]))
        directions, distance, _, _, _ = Lights([], emitters=Emitters(scene)).sample(numbers, np.zeros(3))
        first, _, _, _ = scene.bvh.intersect(np.zeros_like(directions), directions)
        seen.append((np.abs(first - distance) < 1e-4 * distance).mean())
    assert min(seen[:3]) > 0.85 and np.ptp(seen[:3]) < 0.02 and seen[3] < 0.6


def test_faces_that_cannot_shine_are_left_out() -> None:
    """Without area, at unusable corners, of black materials; the others keep their places."""
    corners = np.concatenate([SQUARE, [[np.nan, 0, 0], [5, 5, 5]]])
    faces = np.int32([[0, 1, 2], [0, 0, 1], [0, 1, 4], [5, 5, 5], [0, 2, 3], [1, 2, 3]])
    index = np.int32([0, 0, 0, 0, 0, 1])
    mesh = mesh_state(corners, faces, matrix((0, 0, 1)), materials=[GLOW, Material("dark")], material_index=index)
    emitters = Emitters(scene_of(mesh))
    assert emitters.count == 2 and sorted(emitters.faces) == [0, 4]


def test_more_triangles_than_fit_are_left_to_rays() -> None:
    """The mesh with the most, by name; the others are sampled, and no light is lost."""
    vertices, faces = ball(16, 1.0)
    places = [place((4 * i, 0, 0)) for i in range(MOST // len(faces) + 1)]
    many = mesh_state(vertices, faces, *places, name="Swarm", materials=[GLOW])
    emitters = Emitters(scene_of(many, panel()))
    assert emitters.count == 2
    assert len(emitters.warnings) == 1 and "Swarm" in emitters.warnings[0]
