"""Surfaces that light may pass: shares of light and of samples, order, limits, and nothing where there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_surface import mesh_state

from drgs_blender.compute.jit import njit
from drgs_blender.core.frame import Camera, Frame, Layer, Light, RenderSettings, World
from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.engine.session import Session
from drgs_blender.render.scene.ray import Ray
from drgs_blender.render.scene.ray_masks import SHADOW
from drgs_blender.render.scene.see_through import MOST, nearest_there, transmitted
from drgs_blender.render.scene.trace_scene import TraceScene

F = np.float32
SQUARE = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = np.int32([[0, 1, 2], [0, 2, 3]])
UVS = (SQUARE[FACES][..., :2] + 1) / 2


@njit
def _pass(tracer, geometry, origins, numbers, mask, share, face, count):  # type: ignore[no-untyped-def]
    for i in range(len(origins)):
        start = (origins[i, 0], origins[i, 1], origins[i, 2])
        ray = Ray(start, (F(0.0), F(0.0), F(-1.0)), F(0.0), F(np.inf), mask)
        share[i] = transmitted(tracer, ray, geometry)
        _, face[i], _, _, _, _, _, _, count[i] = nearest_there(tracer, ray, geometry, numbers[i])


def passed(scene: TraceScene, origins: np.ndarray, numbers: np.ndarray) -> tuple:
    """Share of light, face and surfaces passed of rays that go down."""
    n = len(origins)
    share, face, count = np.empty(n, np.float32), np.empty(n, np.int32), np.empty(n, np.int64)
    given = np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(numbers, np.float32)
    _pass(scene.tracer, scene.geometry, *given, np.int32(SHADOW), share, face, count)
    return share, face, count


def at(z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def card(z: float, alpha: float = 1.0, *more: np.ndarray, **changes):
    textures = {key: changes.pop(key) for key in ("alpha_texture",) if key in changes}
    material = Material(f"card {z}", (0.5, 0.5, 0.5), alpha=alpha, **textures)
    return mesh_state(SQUARE, FACES, at(z), *more, name=f"card {z}", uvs=UVS, materials=[material], **changes)


def test_light_is_the_product_of_what_all_surfaces_let_through():
    """Cards in any order, several of one shape, with an image and with values at corners."""
    image = Image("i", np.random.default_rng(1).integers(0, 255, (8, 8, 4), dtype=np.uint8))
    values = np.random.default_rng(2).uniform(0, 1, (2, 3, 4)).astype(np.float32)
    states = [
        card(2, 0.3),
        card(-1, 0.5, at(-2), at(3)),
        card(1, 0.8, alpha_texture=Texture("i", "a")),
        card(0, alpha_texture=Texture("", "g", layer="paint"), layers=[Layer("paint", values)]),
    ]
    scene = TraceScene()
    scene.update([], states, [image])
    n = 500
    origins = np.column_stack([np.random.default_rng(3).uniform(-0.9, 0.9, (n, 2)), np.full(n, 5.0)])
    share, _, count = passed(scene, origins, np.zeros(n))
    table, uv = scene.mesh_materials.table, (origins[:, :2] + 1) / 2
    glow = [Material("g", emission=(1, 1, 1), emission_texture=Texture("i", "a"))]
    by_image = type(table)(glow, [image]).lookup(np.zeros(n, int), uv)[:, 5]
    u, v = uv.T
    low = (u > v)[:, None]
    weights = np.where(low, np.stack([1 - u, u - v, v], 1), np.stack([1 - v, u, v - u], 1))
    painted = np.einsum("nc,nc->n", weights, np.where(low, values[0, :, 1], values[1, :, 1]))
    expected = (1 - 0.3) * 0.5**3 * (1 - 0.8 * by_image) * (1 - painted)
    np.testing.assert_allclose(share, expected, rtol=2e-3, atol=2e-5)
    assert (count == 0).mean() > 0.9, "a number of 0 stops at whatever is there at all"
    scene.close()


def test_evenly_spread_numbers_see_every_surface_in_its_share():
    alphas = (0.25, 0.5, 0.1, 1.0)
    scene = TraceScene()
    scene.update([], [card(-i, alpha) for i, alpha in enumerate(alphas)])
    n = 1000
    _, face, count = passed(scene, np.tile((0.3, 0.1, 5.0), (n, 1)), (np.arange(n) + 0.5) / n)
    left, owner = 1.0, scene.face_object[face]
    for i, alpha in enumerate(alphas):
        seen = owner == i
        assert abs(seen.mean() - left * alpha) < 3 / n
        assert (count[seen] == i).all()
        left *= 1 - alpha
    scene.close()


def test_more_surfaces_than_a_ray_follows_end_it():
    clear = card(0, 0.0, *(at(-0.01 * i) for i in range(1, MOST + 50)))
    scene = TraceScene()
    scene.update([], [clear])
    share, face, count = passed(scene, np.float32([[0.3, 0.1, 5], [0.3, 0.1, -0.5]]), np.zeros(2))
    assert share[0] == 0 and face[0] >= 0 and count[0] == MOST
    left = MOST + 50 - 51
    assert count[1] == left and share[1] == 1 and face[1] == -1
    scene.close()


def frame(meshes: list, **changes) -> Frame:
    """Meshes from above, an even sky, a lamp."""
    camera = Camera(at(6), 48, 48, 90.0, 90.0, 24.0, 24.0)
    settings = RenderSettings(samples=32, bounces=1, camera_sees="mesh", film_transparent=True)
    lamp = Light("lamp", "point", at(4), power=100.0, radius=0.1)
    made = Frame(0, camera, [], World(colour=(0.2, 0.3, 0.4)), settings, ("Combined", "Depth"), meshes, [lamp])
    return replace(made, **changes)


def test_a_card_that_is_not_there_changes_nothing():
    """Of alpha 0 everywhere, before, between and behind other things: the same picture as without it, to its noise."""
    floor = mesh_state(3 * SQUARE, FACES, at(-1), name="floor", materials=[Material("f", (0.6, 0.5, 0.4))])
    plain, ghost = (Session().render(frame([floor, *more])) for more in ([], [card(1, 0.0), card(-2, 0.0)]))
    np.testing.assert_array_equal(ghost["Depth"], plain["Depth"])
    np.testing.assert_allclose(ghost["Combined"], plain["Combined"], rtol=1e-5, atol=1e-6)


def test_pictures_do_not_depend_on_threads(monkeypatch):
    states = [
        card(1, 0.4),
        mesh_state(3 * SQUARE, FACES, at(-1), materials=[Material("f", emission=(0.1, 0, 0), alpha=0.7)]),
    ]
    found = []
    for threads in (1, 2):
        made = frame(states)
        made.settings.threads = threads
        found.append(Session().render(made)["Combined"])
    np.testing.assert_array_equal(*found)


def test_half_a_glowing_card_gives_half_the_light():
    """By light samples and by rays that meet it: a floor under a lamp of alpha 0.5 and one of half the strength."""
    floor = mesh_state(3 * SQUARE, FACES, at(-1), name="floor", materials=[Material("f", (0.8, 0.8, 0.8), 0.2, 0.5)])
    unseen = replace(floor.visibility, camera=False)
    means = []
    for alpha, strength in ((0.5, 6.0), (1.0, 3.0)):
        glow = Material("g", (0, 0, 0), 1, 1, (strength,) * 3, alpha=alpha)
        lamp = mesh_state(0.5 * SQUARE, FACES, at(1), name="glow", materials=[glow], visibility=unseen)
        made = frame([floor, lamp], lights=[], world=World(colour=(0, 0, 0)))
        made.settings.samples, made.settings.bounces = 256, 0
        means.append(Session().render(made)["Combined"][..., :3].mean(axis=(0, 1)))
    np.testing.assert_allclose(means[0], means[1], rtol=0.01)


def test_too_many_surfaces_are_named():
    clear = card(0, 0.0, *(at(-0.01 * i) for i in range(1, MOST + 50)))
    (warning,) = Session().render(frame([clear])).warnings
    assert "card 0" in warning and str(MOST) in warning
    assert not Session().render(frame([card(0, 0.5)])).warnings


@pytest.mark.parametrize("alpha, taken", [(-1.0, 0.0), (7.0, 1.0), (float("nan"), 1.0)])
def test_impossible_alphas_are_named(alpha, taken):
    scene = TraceScene()
    scene.update([], [card(0, alpha)])
    (warning,) = scene.mesh_materials.warnings
    assert "alpha" in warning and "card 0" in warning
    share, _, _ = passed(scene, np.float32([[0.3, 0.1, 5]]), np.zeros(1))
    assert share[0] == (1 - taken if (scene.mesh_materials.table.clear and alpha < 1) or alpha != alpha else 1.0)
    scene.close()
