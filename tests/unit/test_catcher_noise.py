"""Shadows on catchers, denoised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import look_along_y
from test_layers import FACES, SQUARE
from test_surface import matrix, mesh_state

from drgs_blender.core.frame import Frame, RenderSettings, Visibility, World
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.denoise.catchers import smooth_catchers
from drgs_blender.render.film.catcher_film import CatcherFilm
from drgs_blender.render.gbuffer.mesh import primary_mesh
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.pipeline import render
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.scene.trace_scene import TraceScene
from drgs_blender.render.shading_points import Radiance

SIZE = 48
SETTINGS = RenderSettings(samples=4, subpixel_samples=4, bounces=0, camera_sees="mesh", film_transparent=True)


def walled(*more: object) -> TraceScene:
    """A wall that catches shadows, and more."""
    scene = TraceScene()
    scene.update(
        [], [mesh_state(SQUARE * 9, FACES, matrix((0, 1.0, 0)), visibility=Visibility(shadow_catcher=True)), *more]
    )
    return scene


def shadow(settings: RenderSettings, sky: np.ndarray) -> np.ndarray:
    """Alpha (h, w) of the shadow of a slat on a wall; the slat itself is not seen."""
    scene = walled(mesh_state(SQUARE * (0.4, 1, 9), FACES, matrix((0, 0.5, 0)), visibility=Visibility(camera=False)))
    frame = Frame(1, look_along_y(SIZE), [], settings=settings, passes=("Combined",))
    prepared = PreparedScene(scene, EnvironmentLight(World(sky)), None)  # type: ignore[arg-type]
    return render(prepared, frame)["Combined"][..., 3]


def test_noise_of_shadows_goes_and_their_density_stays() -> None:
    sky = np.full((8, 16, 3), 0.2, np.float32)
    sky[3, ::5] = 6.0
    true = shadow(replace(SETTINGS, samples=2048, seed=9), sky)
    noisy, smooth = (shadow(replace(SETTINGS, denoise=kind), sky) for kind in ("none", "svgf"))
    assert true.max() > 0.3 and np.ptp(true) > 0.2
    errors = [np.sqrt(((one - true) ** 2).mean()) for one in (noisy, smooth)]
    assert errors[1] < 0.5 * errors[0]
    assert abs((smooth - true).mean()) < 0.05 * true.mean()


@pytest.mark.parametrize("part", [1.0, 0.25])
def test_an_even_shadow_stays_what_it_is_however_noisy_the_light_is(part: float) -> None:
    """1.0: no shadow stays none, since both sums have one set of weights."""
    camera, settings = look_along_y(SIZE), replace(SETTINGS, denoise="svgf")
    parameters = camera_parameters(camera, settings, 1)
    buffer, catchers = primary_mesh(walled(), camera, parameters, 0, SIZE), CatcherFilm(camera, settings, parameters)
    catchers.add(buffer, Radiance.dark(len(buffer.points)))
    assert catchers.variance is not None and not catchers.variance.any()
    catchers.variance[:] = 4.0 * part**2
    sums = np.ones((SIZE, SIZE, 3), np.float32)
    sums[..., 2] = np.random.default_rng(1).gamma(0.5, 2, (SIZE, SIZE)) + 0.01
    sums[..., 1] = sums[..., 2] * np.float32(part)
    noise = sums[..., 2].std()
    smooth_catchers(sums, catchers)
    assert sums[..., 2].std() < 0.5 * noise
    np.testing.assert_allclose(sums[..., 1], sums[..., 2] * part, rtol=1e-5)
