"""Pixels of the passes: identities between them, edges, background."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.core.frame import Camera, RenderSettings, World
from drgs_blender.core.passes import BY_NAME
from drgs_blender.render.camera import camera_parameters, sample_ray
from drgs_blender.render.film.film import EMPTY_DEPTH, Film
from drgs_blender.render.film.object_numbers import ObjectNumbers
from drgs_blender.render.film.surface_film import CHANNELS
from drgs_blender.render.gbuffer.gbuffer import GBuffer, compact
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.shading_points import Radiance

#: These have films of their own.
ALL = tuple(name for name in BY_NAME if not name.startswith("Crypto") and name not in CHANNELS)
WHITE = {name: np.ones((10, 12, 3), np.float32) for name in ("DiffCol", "GlossCol", "TransCol")}
AA = 4


def camera(**more: object) -> Camera:
    return Camera(np.eye(4), 12, 10, 12.0, 12.0, 6.0, 5.0, **more)  # type: ignore[arg-type]


def strip(view: Camera, settings: RenderSettings, rows: tuple[int, int], alpha: np.ndarray, seed: int = 0) -> GBuffer:
    """A G-buffer with random contents and the given coverage (rows, width, subpixels)."""
    rng = np.random.default_rng(seed)
    buffer = compact(alpha.astype(np.float32), camera_parameters(view, settings, 1), view.window[0], rows[0])
    points, n = buffer.points, len(buffer.points)
    normal = rng.normal(size=(n, 3)) * 0.3 + (0, 0, 1)
    points.normal[:] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    for array in (points.albedo, points.roughness, points.metallic, buffer.position):
        array[:] = rng.random(array.shape)
    buffer.depth[:] = 5 + 0.1 * rng.random(n)
    buffer.object_index[:] = 0
    return buffer


def random_light(n: int, seed: int = 1) -> Radiance:
    rng = np.random.default_rng(seed)
    return Radiance(rng.random((n, 4, 3)).astype(np.float32), rng.random((n, 2)).astype(np.float32))


def numbers(*pass_index: int) -> ObjectNumbers:
    rows = np.arange(len(pass_index), dtype=np.int32)
    return ObjectNumbers(np.array(pass_index, np.int32), rows + 1)


def expose(
    alpha: np.ndarray, transparent: bool, world: World | None = None, view: Camera | None = None
) -> tuple[Film, GBuffer, Radiance]:
    view = view or camera()
    settings = RenderSettings(subpixel_samples=AA, film_transparent=transparent)
    film = Film(view, settings, camera_parameters(view, settings, 1))
    buffer = strip(view, settings, (view.window[1], view.window[3]), alpha)
    light = random_light(len(buffer.points))
    film.add(buffer, light, numbers(7), EnvironmentLight(world or World()))
    return film, buffer, light


def some_coverage(seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    alpha = rng.random((10, 12, AA)) * (rng.random((10, 12, 1)) < 0.7)
    return alpha * (rng.random((10, 12, AA)) < 0.8)


@pytest.mark.parametrize("transparent", [False, True])
def test_combined_is_the_sum_of_its_parts_to_the_last_bit(transparent: bool) -> None:
    film, _, _ = expose(some_coverage(), transparent, World(colour=(0.3, 0.7, 1.9)))
    p = film.passes(ALL, WHITE)
    assert [p[n].shape for n in ALL] == [(10, 12, len(BY_NAME[n].channels)) for n in ALL]
    assert all(v.dtype == np.float32 for v in p.values())
    total = p["DiffDir"] + p["DiffInd"] + p["GlossDir"] + p["GlossInd"] + p["Env"] + p["Emit"]
    assert np.array_equal(p["Combined"][..., :3], total)
    assert np.array_equal(p["Combined"], p["Noisy Image"])
    if transparent:
        assert np.array_equal(p["Combined"][..., 3], p["Coverage"][..., 0])
        assert (p["Env"] == 0).all()
        assert (p["Combined"][p["Coverage"][..., 0] == 0] == 0).all()
    else:
        assert (p["Combined"][..., 3] == 1).all()
        world = (1 - p["Coverage"]) * np.float32([0.3, 0.7, 1.9])
        assert np.allclose(p["Env"], world, atol=1e-6)


def test_light_is_the_weighted_sum_of_the_samples() -> None:
    film, buffer, light = expose(some_coverage(), True)
    points = buffer.points
    expected = np.zeros((120, 4, 3))
    np.add.at(expected, points.pixel, points.weight[:, None, None] * light.components)
    assert np.allclose(film.pixels.components.reshape(-1, 4, 3), expected, atol=1e-6)
    variance = np.zeros((120, 2))
    np.add.at(variance, points.pixel, points.weight[:, None] ** 2 * light.variance)
    assert np.allclose(film.pixels.variance.reshape(-1, 2), variance, atol=1e-7)


def test_surface_passes_have_no_dark_rim_and_no_holes() -> None:
    film, _, _ = expose(some_coverage(), True)
    p = film.passes(ALL, WHITE)
    covered = p["Coverage"][..., 0] > 0
    assert covered.any() and (~covered).any()
    depth = p["Depth"][..., 0]
    assert (depth[~covered] == EMPTY_DEPTH).all()
    assert ((depth[covered] >= 5) & (depth[covered] <= 5.1)).all()
    assert np.allclose(np.linalg.norm(p["Normal"][covered], axis=-1), 1, atol=1e-5)
    assert (p["IndexOB"][covered] == 7).all() and (p["IndexOB"][~covered] == 0).all()
    for name in ("Normal", "Position", "Albedo", "Roughness", "Metallic"):
        assert (p[name][~covered] == 0).all()
    # Means by weight, not by area: a barely covered pixel has the colour of what covers it.
    faint = np.zeros((10, 12, AA))
    faint[4, 5, 2] = 0.01
    film, buffer, _ = expose(faint, True)
    p = film.passes(ALL, WHITE)
    assert np.allclose(p["Albedo"][4, 5], buffer.points.albedo[0], atol=1e-6)
    assert np.allclose(p["Position"][4, 5], buffer.position[0], atol=1e-6)
    assert np.isclose(p["Coverage"][4, 5, 0], 0.0025)


def test_depth_and_index_at_an_edge_are_of_the_nearest_surface() -> None:
    view, settings = camera(), RenderSettings(subpixel_samples=AA, film_transparent=True)
    film = Film(view, settings, camera_parameters(view, settings, 1))
    alpha = np.ones((10, 12, AA))
    buffer = strip(view, settings, (0, 10), alpha)
    near = buffer.points.sample == 3  # one of four sub-pixel samples
    buffer.depth[:] = np.where(near, 2.0, 50.0)
    buffer.position[:] = np.where(near, 1.0, -30.0)[:, None]
    buffer.object_index[:] = np.where(near, 1, 0)
    film.add(buffer, random_light(len(near)), numbers(7, 9), EnvironmentLight(World()))
    p = film.passes(ALL, WHITE)
    assert (p["Depth"] == 2).all() and (p["Position"] == 1).all() and (p["IndexOB"] == 9).all()
    assert (p["Object"] == 2).all()


def test_background_is_the_mean_over_the_sub_pixel_rays() -> None:
    rng = np.random.default_rng(5)
    world = World(environment=rng.random((16, 32, 3)).astype(np.float32) * 3, strength=0.5)
    view = camera(region=(3, 2, 9, 8))
    alpha = some_coverage()[:6, :6]
    film, _, _ = expose(alpha, False, world, view)
    light = EnvironmentLight(world)
    parameters = camera_parameters(view, RenderSettings(subpixel_samples=AA), 1)
    expected = np.zeros((6, 6, 3))
    for y, x, k in np.ndindex(6, 6, AA):
        direction = np.array(sample_ray(parameters, (2 + y) * 12 + 3 + x, k))[3:]
        seen = light.lookup((direction / np.linalg.norm(direction))[None])[0]
        expected[y, x] += (1 - alpha[y, x, k]) / AA * seen
    assert np.allclose(film.passes(("Env",), {})["Env"], expected, atol=1e-5)


def test_denoised_light_replaces_all_but_the_noisy_image() -> None:
    film, _, _ = expose(some_coverage(), True)
    p = film.passes(ALL, WHITE, 2 * film.pixels.components)
    assert np.allclose(p["Combined"][..., :3], 2 * p["Noisy Image"][..., :3], rtol=1e-6)
    assert np.array_equal(p["Combined"][..., 3], p["Noisy Image"][..., 3])
    total = p["DiffDir"] + p["DiffInd"] + p["GlossDir"] + p["GlossInd"] + p["Env"] + p["Emit"]
    assert np.array_equal(p["Combined"][..., :3], total)
