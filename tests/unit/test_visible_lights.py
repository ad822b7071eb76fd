"""Lights in the picture: how bright they are, what hides them, what they leave of alpha."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from shapes import look_along_y
from test_layers import FACES, SIZE, SQUARE, veil, wall
from test_surface import matrix, mesh_state

from drgs_blender.core.frame import Frame, Light, RenderSettings, Visibility, World
from drgs_blender.core.materials import Material
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.lights.light_sampler import Lights
from drgs_blender.render.pipeline import render
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.scene.trace_scene import TraceScene

BLACK = Material("black", (0.0, 0.0, 0.0), 1.0)
#: Radiance of `panel`: power times colour over pi times its area.
SHINE = np.array([1.0, 0.5, 0.25]) * 20 / (math.pi * 0.5)


def panel(y: float, **settings: object) -> Light:
    """An area light of 1 by 0.5 metres at depth 4 + y that shines at the camera."""
    place = np.eye(4)
    place[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    place[1, 3] = y
    values = {"power": 20.0, "size_x": 1.0, "size_y": 0.5, "camera": True} | settings
    return Light("panel", "area", place, (1.0, 0.5, 0.25), shape="rectangle", **values)  # type: ignore[arg-type]


def picture(
    lights: list[Light], meshes: list, posed=None, objects=(), clip=(1e-3, 1e6), **settings
) -> dict[str, np.ndarray]:
    scene = TraceScene()
    scene.update(list(objects), meshes)
    values = {
        "subpixel_samples": 4,
        "samples": 2,
        "bounces": 0,
        "camera_sees": "mesh" if posed is None else "surfels",
    }
    camera = look_along_y(SIZE, clip_start=clip[0], clip_end=clip[1])
    frame = Frame(1, camera, [], settings=RenderSettings(**(values | settings)), passes=("Combined", "Emit"))
    return render(PreparedScene(scene, EnvironmentLight(World(strength=0.0)), posed, Lights(lights)), frame)


def test_a_light_covers_what_it_should_with_its_radiance_and_no_alpha() -> None:
    seen = picture([panel(0.0)], [], film_transparent=True, subpixel_samples=16)
    middle = seen["Emit"][SIZE // 2 - 3 : SIZE // 2 + 3, SIZE // 2 - 7 : SIZE // 2 + 7]
    np.testing.assert_allclose(middle, np.broadcast_to(SHINE, middle.shape), rtol=1e-5)
    # 70 pixels a radian at 4 metres.
    np.testing.assert_allclose(seen["Emit"].sum((0, 1)), SHINE * 0.5 * (70 / 4) ** 2, rtol=0.01)
    np.testing.assert_array_equal(seen["Combined"][..., :3], seen["Emit"])
    assert not seen["Combined"][..., 3].any()


@pytest.mark.parametrize("change", [{"camera": False}, {"power": 0.0}])
def test_lights_are_seen_only_where_they_are_to_be(change: dict) -> None:
    assert not picture([panel(0.0, **change)], [])["Emit"].any()


def test_surfaces_hide_lights_behind_them_and_lights_hide_nothing() -> None:
    half = mesh_state(SQUARE * (0.5, 1, 9) - (0.5, 0, 0), FACES, matrix((0, 1.0, 0)), materials=[BLACK])
    before, behind = (picture([panel(y)], [half])["Emit"] for y in (0.9, 1.1))
    left = slice(0, SIZE // 2 - 1)
    assert before[:, left].any() and not behind[:, left].any()
    for free in (before, behind):
        np.testing.assert_allclose(free[SIZE // 2, SIZE // 2 + 2], SHINE, rtol=1e-5)
    glow = wall(1.0)
    both = picture([panel(0.5), panel(0.9)], [glow])["Emit"][SIZE // 2, SIZE // 2]
    np.testing.assert_allclose(both, 2 * SHINE + (1, 2, 3), rtol=1e-5)


@pytest.mark.parametrize(("clip", "factor"), [((3.9, 4.1), 1), ((4.1, 9), 0), ((0.1, 3.9), 0), ((0.1, 9), 1)])
@pytest.mark.parametrize("meshes", [[], [wall(1.0, BLACK)]])
def test_lights_beyond_the_clip_distances_are_not_seen_and_suns_are(clip: tuple, factor: float, meshes: list) -> None:
    """Measured in Cycles of Blender 5.0. A mesh beyond them hides nothing."""
    light, sun = panel(0.0), replace(panel(0.0), kind="sun", angle=0.5, power=1.0)
    found, middle = picture([light], meshes, clip=clip)["Emit"], (SIZE // 2, SIZE // 2)
    np.testing.assert_allclose(found[middle], factor * SHINE, rtol=1e-5)
    hidden = bool(meshes) and clip[1] > 5
    assert picture([sun], meshes, clip=clip)["Emit"][middle].any() != hidden


@pytest.mark.parametrize("opacity", [0.25, 0.75])
def test_surfels_let_through_what_they_leave_free(opacity: float) -> None:
    posed, mesh = veil(opacity)
    middle = SIZE // 2, SIZE // 2
    behind, before = (picture([panel(y)], [], posed, [mesh])["Emit"][middle] for y in (0.5, -0.5))
    np.testing.assert_allclose(behind, (1 - opacity) * SHINE, rtol=1e-3)
    np.testing.assert_allclose(before, SHINE, rtol=1e-4)
    hidden = picture([panel(2.0)], [wall(1.0, BLACK)], posed, [mesh])["Emit"]
    assert not hidden.any()


def test_holdouts_hide_lights_and_catchers_do_not() -> None:
    for kind, factor in (("holdout", 0.0), ("shadow_catcher", 1.0)):
        cut = mesh_state(SQUARE * 9, FACES, matrix((0, 0, 0)), materials=[BLACK], visibility=Visibility(**{kind: True}))
        seen = picture([panel(1.0)], [cut], film_transparent=True)["Emit"][SIZE // 2, SIZE // 2]
        np.testing.assert_allclose(seen, factor * SHINE, rtol=1e-5)


def test_the_window_and_a_distant_sun() -> None:
    """Part of a picture is that part of the whole, and suns shine where nothing is met."""
    away = np.eye(4)
    away[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    away[:3, 2] *= -1  # shines along -Z of the light, towards the camera
    away[:3, 1] *= -1
    sun = Light("sun", "sun", away, power=3.0, angle=0.2, camera=True)
    half = mesh_state(SQUARE * 9 - (9, 0, 0), FACES, matrix((0, 1.0, 0)), materials=[BLACK])
    scene = TraceScene()
    scene.update([], [half])
    frame = Frame(
        1,
        look_along_y(SIZE),
        [],
        settings=RenderSettings(samples=2, bounces=0, subpixel_samples=4, camera_sees="mesh"),
        passes=("Emit",),
    )
    whole = render(PreparedScene(scene, EnvironmentLight(World(strength=0.0)), None, Lights([sun])), frame)["Emit"]  # type: ignore[arg-type]
    radiance = 3.0 / (math.pi * math.sin(0.1) ** 2)
    np.testing.assert_allclose(whole[SIZE // 2, SIZE // 2 + 2], radiance, rtol=1e-4)
    assert not whole[:, : SIZE // 2 - 1].any()
    part = replace(frame, camera=replace(frame.camera, region=(8, 6, 20, 15)))
    window = render(PreparedScene(scene, EnvironmentLight(World(strength=0.0)), None, Lights([sun])), part)["Emit"]  # type: ignore[arg-type]
    np.testing.assert_array_equal(window, whole[6:15, 8:20])
