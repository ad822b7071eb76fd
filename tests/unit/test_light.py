"""The environment light: orientation, densities, odd pictures."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.color import LUMINANCE
from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame import World
from drgs_blender.render.lights.environment import EnvironmentLight


def picture(kind: str) -> np.ndarray | None:
    rng = np.random.default_rng(5)
    if kind == "constant":
        return None
    if kind == "large":  # blocks of 4 x 4 cells, those of the last row of 2 x 4, some without any light
        image = rng.random((30, 120, 3)) ** 4
        image[11, 77], image[16:, :48] = 500.0, 0.0
        return image.astype(np.float32)
    image = rng.random((16, 32, 3)) ** 4 if kind == "random" else np.zeros((16, 32, 3))
    if kind == "sun":
        image[5, 31] = 1000.0
    if kind == "pole":
        image[0, 3] = 10.0
    return image.astype(np.float32)


KINDS = ["constant", "random", "sun", "pole"]


@functools.lru_cache(maxsize=1)
def sphere_grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) on a lat-long grid and the solid angle (n,) of each; multiples of 16 and 32 keep to cells."""
    theta = np.pi * (np.arange(rows) + 0.5) / rows
    phi = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    angle = -np.diff(np.cos(np.pi * np.arange(rows + 1) / rows)) * 2 * np.pi / columns
    theta, phi = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    return directions, np.repeat(angle, columns)


def cell_means(luminance: np.ndarray) -> np.ndarray:
    """Mean of the bilinear interpolant over each cell between centres of texels: wraps in columns, clamps in rows."""
    rows = np.concatenate([luminance[:1], luminance, luminance[-1:]])
    rows = 0.5 * (rows[:-1] + rows[1:])
    return 0.5 * (np.roll(rows, 1, axis=1) + rows)


def numbers(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2**32, size=(count, 4), dtype=np.uint32)


def test_blenders_orientation() -> None:
    """+X in the middle, +Y a quarter turn to the left (u = 1/4), +Z on top."""
    image = np.zeros((8, 16, 3), np.float32)
    image[:, :, 0] = (np.arange(16) + 0.5) / 16
    image[:, :, 1] = ((np.arange(8) + 0.5) / 8)[:, None]
    light = EnvironmentLight(World(environment=image))
    found = light.lookup(np.array([[1, 0, 0], [0, 1, 0], [0, -1, 0], [0.6, 0, 0.8], [0, 0, 1], [0, 0, -1]]))
    np.testing.assert_allclose(found[:3, 0], [0.5, 0.25, 0.75], atol=1e-5)
    np.testing.assert_allclose(found[:3, 1], 0.5, atol=1e-5)
    assert found[3, 1] == pytest.approx(np.arccos(0.8) / np.pi, abs=1e-5)
    np.testing.assert_allclose(found[4:, 1], [1 / 16, 15 / 16], atol=1e-5)


def test_the_seam_is_interpolated() -> None:
    image = np.zeros((4, 8, 3), np.float32)
    image[:, 0], image[:, 7] = 1.0, 3.0
    light = EnvironmentLight(World(environment=image))
    np.testing.assert_allclose(light.lookup([[-1, 1e-7, 0], [-1, -1e-7, 0]]), 2.0, atol=1e-4)


def test_rotation_colour_and_strength() -> None:
    image = picture("random")
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    plain = EnvironmentLight(World(environment=image))
    turned = EnvironmentLight(World(environment=image, rotation=turn, colour=(1.0, 0.5, 0.0), strength=3.0))
    directions, _ = sphere_grid(20, 40)
    expected = plain.lookup(directions @ turn.T) * [3.0, 1.5, 0.0]
    np.testing.assert_allclose(turned.lookup(directions), expected, atol=2e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_density_integrates_to_one(kind: str) -> None:
    light = EnvironmentLight(World(environment=picture(kind)))
    density = light.cells.density
    # Rows of cells have unequal heights in z: integrate cell by cell.
    solid = -np.diff(light.row_z.astype(float)) * 2 * np.pi / density.shape[1]
    assert (density * solid[:, None]).sum() == pytest.approx(1.0, abs=1e-5)
    directions, angle = sphere_grid(960, 1920)
    assert light.pdf(directions).astype(float) @ angle == pytest.approx(1.0, abs=1e-4)
    assert (density > 0).sum() == len(light.cells.runs)
    assert len(np.unique(light.cells.runs[:, 1])) == len(light.cells.runs)
    assert light.cells.runs[-1, 0] == 2**32 - 1


@pytest.mark.parametrize("size", [(1000, 2000), (1024, 2048), pytest.param((1448, 2896), marks=pytest.mark.slow)])
@pytest.mark.parametrize("sky", ["white", "gradient", "sun"])
def test_every_lit_cell_of_a_large_map_has_its_density(size: tuple[int, int], sky: str) -> None:
    image = np.ones((*size, 3), np.float32)
    if sky == "gradient":
        image *= np.linspace(1e-4, 1, size[0], dtype=np.float32)[:, None, None]
    elif sky == "sun":
        image *= 1e-5
        image[size[0] // 3, 70:73] = 1e5
    light = EnvironmentLight(World(environment=image))
    density = light.cells.density
    solid = -np.diff(light.row_z.astype(float)) * 2 * np.pi / density.shape[1]
    expected = cell_means(image @ LUMINANCE)
    probability = density * solid[:, None]
    expected = expected * solid[:, None] / (expected * solid[:, None]).sum()
    # Half a random number of rounding at either edge, and what the darkest cells were raised to one.
    assert np.abs(probability - expected).max() < 2.0**-32 * 2 + 1e-3 * expected.max()
    assert density.min() > 0
    assert (np.diff(light.cells.runs[:, 0].astype(np.int64)) >= 1).all() and light.cells.runs[-1, 0] == 2**32 - 1


@pytest.mark.alone
def test_any_number_of_threads_makes_the_same_cells() -> None:
    world = World(environment=np.random.default_rng(0).random((96, 192, 3)).astype(np.float32) ** 4)
    before = get_num_threads()
    try:
        use_threads(1)
        one = EnvironmentLight(world)
    finally:
        use_threads(before)
    many = EnvironmentLight(world)
    for name in ("grid", "runs", "guide", "first", "parts"):
        np.testing.assert_array_equal(getattr(one.cells, name), getattr(many.cells, name))
    np.testing.assert_array_equal(one.product.starts, many.product.starts)


def test_the_search_of_a_number_starts_at_the_first_cell_of_its_slice() -> None:
    light = EnvironmentLight(World(environment=picture("large")))
    ends, size = light.cells.runs[:, 0].astype(np.int64), len(light.cells.guide)
    np.testing.assert_array_equal(light.cells.guide, np.searchsorted(ends, np.arange(size) * (2**32 // size)))


@pytest.mark.parametrize("kind", [*KINDS, "large"])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("normal", [None, (0.6, 0.0, 0.8), (-0.36, 0.48, -0.8)])
def test_samples_follow_the_density(kind: str, turned: bool, normal: tuple[float, float, float] | None) -> None:
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0] if turned else np.eye(3)
    light = EnvironmentLight(World(environment=picture(kind), rotation=rotation))
    count = 200_000
    directions, pdf = light.sample(numbers(count), normal)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-5)
    # On a block's very border the lookup may fall to the neighbour.
    assert (np.abs(light.pdf(directions, normal) - pdf) <= 1e-3 * pdf).mean() > 0.998
    # Histogram over octants and over bands, against the density's integral.
    grid, angle = sphere_grid(1920, 960)  # borders of bands run through bright rows
    weights = light.pdf(grid @ rotation, normal) * angle  # the grid keeps to the cells in the environment's own frame

    def cells(d: np.ndarray) -> np.ndarray:
        return (d > 0) @ [1, 2, 4] * 4 + np.minimum((np.abs(d[:, 2]) * 4).astype(int), 3)

    expected = np.bincount(cells(grid), weights, minlength=32)
    found = np.bincount(cells(directions @ rotation.T), minlength=32) / count
    np.testing.assert_allclose(found, expected, atol=5 * np.sqrt(0.25 / count))


@pytest.mark.parametrize("kind", [*KINDS, "large"])
def test_sampling_integrates_the_radiance(kind: str) -> None:
    light = EnvironmentLight(World(environment=picture(kind)))
    directions, pdf = light.sample(numbers(100_000, seed=1))
    value = light.lookup(directions) @ LUMINANCE / pdf
    grid, angle = sphere_grid(960, 1920)
    expected = (light.lookup(grid) @ LUMINANCE) @ angle
    error = value.std() / np.sqrt(len(value))
    assert abs(value.mean() - expected) < 5 * error + 3e-3 * expected
    if kind == "constant":
        np.testing.assert_allclose(pdf, 1 / (4 * np.pi), rtol=1e-5)


@pytest.mark.parametrize("size", [(64, 128), (2048, 4096)])
def test_every_direction_towards_a_small_sun_brings_the_same(size: tuple[int, int]) -> None:
    """Its few texels are slopes of the bilinear lookup; a density constant over a texel would spread by half of it."""
    image = np.zeros((*size, 3), np.float32)
    image[size[0] // 3, 70:72] = (9, 8, 5), (1, 1, 1)
    light = EnvironmentLight(World(environment=image))
    directions, pdf = light.sample(numbers(50_000))
    brought = light.lookup(directions) @ LUMINANCE / pdf
    if light.cells.step == 1:
        np.testing.assert_allclose(brought, light.power, rtol=0.06)
    assert brought.mean() == pytest.approx(light.power, rel=0.02)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0.0, 0.8), (0.48, -0.64, -0.6)])
def test_light_on_a_surface_is_found_with_little_noise(normal: tuple[float, float, float], turned: bool) -> None:
    """The constant light of a hemisphere is pi; from all directions alike its samples would spread by 1.29 of that."""
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0] if turned else np.eye(3)
    light = EnvironmentLight(World(rotation=rotation))
    directions, pdf = light.sample(numbers(100_000, seed=1), normal)
    value = np.maximum(directions @ np.array(normal), 0) / pdf
    assert value.mean() == pytest.approx(np.pi, rel=5 * value.std() / np.pi / np.sqrt(len(value)))
    assert value.std() < 0.4 * np.pi
    assert (directions @ np.array(normal) < -0.2).mean() < 0.05


@pytest.mark.parametrize("kind", [*KINDS, "large"])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0.0, 0.8), (0.48, -0.64, -0.6)])
@pytest.mark.parametrize("count", [(0, 16), (8, 24)])
def test_strategies_together_find_the_irradiance(
    kind: str, normal: tuple[float, float, float], count: tuple[int, int]
) -> None:
    """Environment and cosine samples by the balance heuristic: what tables leave to the others is not lost."""
    light, n = EnvironmentLight(World(environment=picture(kind))), np.array(normal)
    cosines, lights = 50_000 * np.array(count) // sum(count)
    drawn, _ = light.sample(numbers(lights, seed=1), normal)
    height, turn = np.random.default_rng(2).random((2, cosines)) * [[1.0], [2 * np.pi]]
    a = np.linalg.svd(n[None])[2]
    ring = np.sqrt(height)
    about = ring * np.cos(turn) * a[1][:, None] + ring * np.sin(turn) * a[2][:, None] + np.sqrt(1 - height) * n[:, None]
    found, seen = 0.0, 0.0
    for directions in (drawn, about.T.astype(np.float32)):
        cosine = np.maximum(directions @ n, 0)
        density = lights * light.pdf(directions, normal).astype(float) + cosines * cosine / np.pi
        value = light.lookup(directions) @ LUMINANCE * cosine / np.maximum(density, 1e-30)
        found, seen = found + value.sum(), seen + (value**2).sum()
    grid, angle = sphere_grid(960, 1920)
    expected = (light.lookup(grid) @ LUMINANCE * np.maximum(grid @ n, 0)) @ angle
    assert abs(found - expected) < 5 * np.sqrt(seen) + 3e-3 * expected + 1e-4 * light.power


@pytest.mark.parametrize("kind", [*KINDS, "large"])
def test_where_light_is_there_is_density(kind: str) -> None:
    light = EnvironmentLight(World(environment=picture(kind)))
    directions, _ = sphere_grid(300, 600)
    lit = light.lookup(directions).sum(axis=1) > 0
    assert lit.any()
    assert (light.pdf(directions)[lit] > 0).all()
    assert (light.pdf(directions, (0, 0, 1))[lit] > 0).all()


def test_bad_texels_are_black_and_counted() -> None:
    image = np.ones((8, 16, 3), np.float32)
    image[2, 3, 0], image[4, 4, 1], image[5, 5], image[6, 6, 2] = np.nan, np.inf, -1.0, -np.inf
    light = EnvironmentLight(World(environment=image))
    assert light.bad_texels == 4
    directions, _ = sphere_grid(100, 200)
    found = light.lookup(directions)
    assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1.00001
    _, pdf = light.sample(numbers(1000))
    assert np.isfinite(pdf).all() and (pdf > 0).all()


def test_ringing_of_filters_costs_its_texels_nothing() -> None:
    """Every HDRI that Blender brings has a few values just below zero: no fault to tell an artist of."""
    image = np.ones((8, 16, 3), np.float32)
    image[2, 3, 2] = -1e-3
    light = EnvironmentLight(World(environment=image))
    assert light.bad_texels == 0
    assert (light.texels[2, 3, :3] == [1, 1, 0]).all()


def test_black_worlds_are_black() -> None:
    for world in (World(strength=0.0), World(environment=np.zeros((4, 8, 3), np.float32))):
        light = EnvironmentLight(world)
        assert light.black
        assert not light.lookup([[0, 0, 1]]).any() and not light.pdf([[0, 0, 1]]).any()


@pytest.mark.parametrize("strength", [1e-41, 2e-40, 1e-36, 1e-31])
def test_nearly_black_worlds_are_black_or_have_densities(strength: float) -> None:
    light = EnvironmentLight(World(strength=strength))
    assert np.isfinite(light.pdf([[0, 0, 1]], (0, 0, 1))).all()
    assert light.black == (not light.lookup([[0, 0, 1]]).any()) == (not light.pdf([[0, 0, 1]]).any())


def test_a_negative_part_of_the_colour_takes_nothing_from_the_others() -> None:
    light = EnvironmentLight(World(colour=(-1.0, 0.5, 1.0)))
    assert light.negative_colour and light.bad_texels == 0
    np.testing.assert_allclose(light.lookup([[0, 0, 1]]), [[0, 0.5, 1]])


def test_dim_sky_is_left_to_the_samples_of_the_surface() -> None:
    """MIS compensation (Karlik et al. 2019): of light all alike nothing is to be left out, of dim light most is."""
    window = np.full((64, 128, 3), 0.2, np.float32)
    window[8:16, 8:16] = 40.0
    bright, dim = EnvironmentLight(World()), EnvironmentLight(World(environment=window))
    around = np.array([[0.0, 0.6, 0.8], [0.6, 0.0, 0.8]], np.float32)  # as steep as each other
    even = bright.pdf(around, (0, 0, 1))
    assert even[0] == pytest.approx(even[1], rel=0.2)
    row, column = 12, 12  # the middle of the window
    polar, turn = np.pi * row / 64, 2 * np.pi * (0.5 - column / 128)
    there = np.array([[np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)]], np.float32)
    assert dim.lookup(there).max() > 30
    share = dim.pdf(around, (0, 0, 1)) / dim.pdf(there, (0, 0, 1))
    product = (dim.lookup(around)[:, 0] * around[:, 2]) / (dim.lookup(there)[0, 0] * there[0, 2])
    assert (share < 0.7 * product).all() and (share > 0.01 * product).all()


@pytest.mark.parametrize("strength", [-1.0, 1e39])
def test_a_strength_that_no_light_has_is_named_and_not_the_pixels(strength: float) -> None:
    with pytest.raises(UsageError, match=r"environment: its strength is .*must be from 0 to 1e\+06"):
        EnvironmentLight(World(strength=strength))


def test_a_world_that_is_no_world_is_refused() -> None:
    with pytest.raises(UsageError, match="not finite"):
        EnvironmentLight(World(strength=float("nan")))
    with pytest.raises(UsageError, match="no pixels"):
        EnvironmentLight(World(environment=np.zeros((0, 8, 3), np.float32)))
