"""Surfels and ordinary meshes in one picture: what hides what, how much of it, and what holdouts and catchers leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import look_along_y, sphere_mesh, sphere_surfels
from test_surface import matrix, mesh_state

from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, Visibility, World
from drgs_blender.core.materials import Material
from drgs_blender.core.passes import BY_NAME
from drgs_blender.render import pipeline
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.film.film import Film
from drgs_blender.render.film.object_numbers import ObjectNumbers
from drgs_blender.render.gbuffer.gbuffer import GBuffer
from drgs_blender.render.gbuffer.mesh import primary_mesh
from drgs_blender.render.gbuffer.surfels import primary_surfels, snap_windows
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene
from drgs_blender.render.shading_points import CATCHER, SECOND, Radiance
from drgs_blender.render.surfels.splats import prepare

AA = 2
SIZE = 24
SQUARE = np.float32([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
FACES = np.int32([[0, 1, 2], [0, 2, 3]])
SETTINGS = RenderSettings(subpixel_samples=AA)
GLOW = Material("glow", (0.2, 0.4, 0.6), 0.3, 0.0, emission=(1.0, 2.0, 3.0))


def veil(opacity: float, y: float = 0.0) -> tuple[PosedSurfels, TraceObject]:
    """One huge surfel across the view with the square behind it as its mesh."""
    one, grey = np.ones(1, np.float32), np.full((1, 3), 0.5, np.float32)
    posed = PosedSurfels(
        np.float32([[0, y, 0]]), np.float32([[1e4, 0, 0]]), np.float32([[0, 0, 1e4]]), np.float32([[0, -1, 0]]),
        np.float32([opacity]), grey, one, 0 * one, np.zeros(1, np.int32),
    )  # fmt: skip
    flat = np.zeros(4, np.float32)
    return posed, TraceObject("veil", SQUARE * 9 + np.float32([0, y, 0]), FACES, np.full((4, 3), 0.5), flat, flat)


def look(posed: PosedSurfels, scene: TraceScene, camera: Camera, y0: int = 0, y1: int = SIZE) -> GBuffer:
    parameters = camera_parameters(camera, SETTINGS, 1)
    return primary_surfels(prepare(posed, camera, parameters), scene, snap_windows(scene, 1), camera, y0, y1)


def wall(y: float, material: Material = GLOW, **visibility: bool) -> object:
    return mesh_state(SQUARE * 9, FACES, matrix((0, y, 0)), materials=[material], visibility=Visibility(**visibility))


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9, 0.99])
def test_a_mesh_behind_fills_what_surfels_leave_free(opacity: float) -> None:
    posed, mesh = veil(opacity)
    scene = TraceScene()
    scene.update([mesh], [wall(1.0)])
    buffer = look(posed, scene, look_along_y(SIZE))
    points = buffer.points
    second = (points.flags & SECOND) > 0
    assert len(points) == 2 * SIZE * SIZE * AA and np.array_equal(second, np.arange(len(points)) % 2 == 1)
    np.testing.assert_allclose(points.weight[~second] * AA, opacity, atol=1e-4)
    np.testing.assert_allclose(points.weight[second] * AA, 1 - opacity, atol=1e-4)
    np.testing.assert_allclose(buffer.alpha, 1, atol=1e-6)
    np.testing.assert_array_equal(points.pixel[second], points.pixel[~second])
    np.testing.assert_array_equal(points.sample[second], points.sample[~second])
    np.testing.assert_allclose(buffer.depth[second], 5, rtol=1e-5)
    np.testing.assert_allclose(buffer.depth[~second], 4, rtol=1e-5)
    np.testing.assert_allclose(points.albedo[second], np.tile([0.2, 0.4, 0.6], (second.sum(), 1)), rtol=1e-6)
    np.testing.assert_allclose(buffer.emission[second], np.tile([1, 2, 3], (second.sum(), 1)))
    assert not buffer.emission[~second].any()
    np.testing.assert_array_equal(buffer.object_index, second)
    # Surfels stay tied to their own mesh, not to what is near them.
    np.testing.assert_allclose(points.origin[~second, 1], 0, atol=1e-5)
    np.testing.assert_allclose(points.normal[second], np.tile([0, -1, 0], (second.sum(), 1)), atol=1e-6)


def test_a_mesh_in_front_hides_surfels_and_one_just_behind_gets_nothing() -> None:
    posed, mesh = veil(0.9)
    scene = TraceScene()
    scene.update([mesh], [wall(-0.5)])
    buffer = look(posed, scene, look_along_y(SIZE))
    assert len(buffer.points) == SIZE * SIZE * AA and (buffer.points.flags == SECOND).all()
    np.testing.assert_allclose(buffer.points.weight, 1 / AA)
    np.testing.assert_allclose(buffer.depth, 3.5, rtol=1e-5)
    ball = sphere_surfels(1.0, 30000)
    scene.update(
        [TraceObject("ball", *sphere_mesh(3), np.full((642, 3), 0.5), np.ones(642), np.zeros(642))], [wall(9.0)]
    )
    buffer = look(ball, scene, look_along_y(SIZE))
    assert (buffer.alpha == 1).all()
    first = buffer.points.weight[(buffer.points.flags & SECOND == 0) & (np.abs(buffer.points.pixel // SIZE - 12) < 3)]
    assert (first == 1 / AA).any() and len(buffer.points) < 1.2 * SIZE * SIZE * AA


def test_a_mesh_between_the_balls_halves() -> None:
    """A wall through the middle of a ball: surfels in front of it, the wall around them, and the exact outline."""
    scene = TraceScene()
    vertices, faces = sphere_mesh(4)
    n = len(vertices)
    scene.update([TraceObject("ball", vertices, faces, np.full((n, 3), 0.5), np.ones(n), np.zeros(n))], [wall(0.0)])
    buffer = look(sphere_surfels(1.0, 20000), scene, look_along_y(SIZE))
    second = (buffer.points.flags & SECOND) > 0
    assert (buffer.position[~second, 1] < 0.02).all()
    np.testing.assert_allclose(buffer.position[second, 1], 0, atol=1e-5)
    np.testing.assert_allclose(np.bincount(buffer.points.pixel, buffer.points.weight), 1, atol=1e-5)


@pytest.mark.parametrize("camera_sees", ["surfels", "mesh"])
def test_the_whole_picture_does_not_depend_on_strips(camera_sees: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    light = EnvironmentLight(World(environment=rng.random((8, 16, 3)).astype(np.float32)))
    vertices, faces = sphere_mesh(3)
    n = len(vertices)
    thing = TraceObject("ball", vertices, faces, np.full((n, 3), 0.5), np.ones(n), np.zeros(n))
    small = mesh_state(
        vertices * 0.3, faces, matrix((1, -0.5, 0)), matrix((-1, 0, 0.5)), matrix((0, -2, -0.4), (0.5, 1, 2))
    )
    scene = TraceScene()
    hole = mesh_state(SQUARE * 0.3, FACES, matrix((0.9, -1.5, 0.9)), visibility=Visibility(holdout=True))
    meshes = [small, wall(2.0), hole]
    scene.update([thing], meshes)
    settings = RenderSettings(subpixel_samples=AA, samples=8, camera_sees=camera_sees, threads=1)  # type: ignore[arg-type]
    states = [ObjectState("ball", "key")]
    camera = look_along_y(SIZE, focal=20.0)
    frame = Frame(3, camera, states, settings=settings, passes=tuple(BY_NAME), meshes=meshes)
    posed = sphere_surfels(1.0, 3000)
    whole = pipeline.render(PreparedScene(scene, light, posed), frame)
    assert {10, 11, 12} <= set(np.unique(whole["IndexOB"]).astype(int))
    np.testing.assert_allclose(whole["Emit"][0, 0], (1, 2, 3), rtol=1e-5)
    assert 0 in whole["Coverage"] and 1 in whole["Coverage"]
    for height in (1, 7):
        monkeypatch.setattr(pipeline, "strip_height", lambda width, subpixels, h=height: h)
        again = pipeline.render(PreparedScene(scene, light, posed), frame)
        for name in BY_NAME:
            np.testing.assert_array_equal(again[name], whole[name], err_msg=name)


def developed(buffer: GBuffer, scene: TraceScene, radiance: Radiance, transparent: bool) -> dict[str, np.ndarray]:
    camera = look_along_y(SIZE)
    settings = replace(SETTINGS, film_transparent=transparent)
    film = Film(camera, settings, camera_parameters(camera, settings, 1))
    rows = ObjectNumbers(scene.pass_index, scene.pass_index)
    film.add(buffer, radiance, rows, EnvironmentLight(World(colour=(1.0, 0.5, 0.25))))
    white = np.ones((*buffer.alpha.shape[:2], 3), np.float32)
    apart = {
        "DiffCol",
        "GlossCol",
        "TransCol",
        "Mist",
        "UV",
        "IndexMA",
    }  # these have films of their own, as mattes have
    names = tuple(name for name in BY_NAME if name not in apart and not name.startswith("Crypto"))
    return film.passes(names, {"DiffCol": white, "GlossCol": white, "TransCol": white})


def uniform_light(buffer: GBuffer, value: float) -> Radiance:
    n = len(buffer.points)
    components = np.zeros((n, 4, 3), np.float32)
    components[:, 0] = value
    return Radiance(components, np.zeros((n, 2), np.float32))


@pytest.mark.parametrize("transparent", [False, True])
def test_emission_is_seen_by_what_is_seen_of_its_surface(transparent: bool) -> None:
    posed, mesh = veil(0.75)
    scene = TraceScene()
    scene.update([mesh], [wall(1.0)])
    buffer = look(posed, scene, look_along_y(SIZE))
    p = developed(buffer, scene, uniform_light(buffer, 0.5), transparent)
    np.testing.assert_allclose(p["Emit"], np.broadcast_to([0.25, 0.5, 0.75], (SIZE, SIZE, 3)), atol=1e-4)
    np.testing.assert_allclose(p["Combined"][..., :3], 0.5 + p["Emit"], atol=1e-5)
    np.testing.assert_allclose(p["Combined"][..., 3], 1, atol=1e-5)
    np.testing.assert_allclose(p["Depth"], 4, rtol=1e-5)


@pytest.mark.parametrize("transparent", [False, True])
@pytest.mark.parametrize(("place", "held"), [(-0.5, 1.0), (1.0, 0.4)])
def test_a_holdout_leaves_a_hole_where_it_would_be_seen(transparent: bool, place: float, held: float) -> None:
    posed, mesh = veil(0.6)
    scene = TraceScene()
    scene.update([mesh], [wall(place, holdout=True), wall(3.0)])
    buffer = look(posed, scene, look_along_y(SIZE))
    p = developed(buffer, scene, uniform_light(buffer, 0.5), transparent)
    np.testing.assert_allclose(p["Combined"][..., 3], 1 - held if transparent else 1, atol=1e-4)
    np.testing.assert_allclose(p["Combined"][..., :3], 0.5 * (1 - held), atol=1e-4)
    assert (p["Env"] == 0).all() or np.abs(p["Env"]).max() < 1e-6


def test_holdouts_of_surfels_hide_the_mesh_behind_them() -> None:
    posed, mesh = veil(0.75)
    scene = TraceScene()
    scene.update([replace(mesh, visibility=Visibility(holdout=True))], [wall(1.0)])
    for camera_mesh in (False, True):
        if camera_mesh:
            buffer = primary_mesh(
                scene, look_along_y(SIZE), camera_parameters(look_along_y(SIZE), SETTINGS, 1), 0, SIZE
            )
        else:
            buffer = look(posed, scene, look_along_y(SIZE))
        p = developed(buffer, scene, uniform_light(buffer, 1.0), True)
        left = 0.0 if camera_mesh else 0.25
        np.testing.assert_allclose(p["Combined"][..., 3], left, atol=1e-4)
        np.testing.assert_allclose(p["Emit"][..., 0], left, atol=1e-4)


@pytest.mark.parametrize("transparent", [False, True])
def test_a_catcher_is_seen_by_its_shadow_alone(transparent: bool) -> None:
    """Opacity 0.6 of surfels before a catcher whose light the scene dims to a quarter."""
    posed, mesh = veil(0.6)
    scene = TraceScene()
    scene.update([mesh], [wall(1.0, Material("grey"), shadow_catcher=True)])
    buffer = look(posed, scene, look_along_y(SIZE))
    caught = (buffer.points.flags & CATCHER) > 0
    assert caught.mean() == 0.5
    np.testing.assert_allclose(buffer.alpha, 0.6, atol=1e-5)
    light = uniform_light(buffer, 0.5)
    light.components[caught, 0] = 0.2
    light.unshadowed = np.where(caught, np.float32(0.8), np.float32(np.nan))
    p = developed(buffer, scene, light, transparent)
    world = np.float32([1.0, 0.5, 0.25])
    expected = 0.5 * 0.6 + (0.0 if transparent else 0.4 * 0.25 * world)
    np.testing.assert_allclose(p["Combined"][..., :3], np.broadcast_to(expected, (SIZE, SIZE, 3)), atol=1e-5)
    np.testing.assert_allclose(p["Combined"][..., 3], 0.6 + 0.4 * 0.75 if transparent else 1.0, atol=1e-5)
    np.testing.assert_allclose(p["Coverage"], 0.6, atol=1e-5)
    np.testing.assert_allclose(p["Depth"], 4, rtol=1e-5)
    # Alone in the picture, without any light: nothing at all, and no division by zero.
    scene.update([], [wall(1.0, shadow_catcher=True)])
    parameters = camera_parameters(look_along_y(SIZE), SETTINGS, 1)
    buffer = primary_mesh(scene, look_along_y(SIZE), parameters, 0, SIZE)
    p = developed(buffer, scene, uniform_light(buffer, 0.0), transparent)
    assert all(np.isfinite(array).all() for array in p.values())
    np.testing.assert_allclose(p["Combined"][..., 3], 0.0 if transparent else 1.0)
    assert (p["Depth"] == 1e10).all()
