"""Surfels blended on a device, on Warp's device "cpu": the samples that the processor finds."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE, assert_near
from shapes import scene_of, sphere_mesh, sphere_surfels
from test_raster import join, look_along_y, plane_of_surfels, random_surfels

from drgs_blender.core.frame import MeshState, RenderSettings
from drgs_blender.render.backend import CPU
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.gbuffer.surfels import Stages, primary_surfels, snap_windows
from drgs_blender.render.gpu import raster as device_raster
from drgs_blender.render.gpu.warp_backend import WarpRenderBackend
from drgs_blender.render.surfels.raster import SurfelSamples, rasterise
from drgs_blender.render.surfels.splats import prepare

SCENES = {
    "cloud": (random_surfels(3000), {}),
    "layers": (join(*(plane_of_surfels(y, 0.5, 0.05, 0.04, opacity=0.6) for y in (-0.4, 0.0, 0.02, 0.4))), {}),
    "orthographic": (random_surfels(800, seed=3, size=0.1), {"orthographic": True, "focal": 20.0}),
    "far": (plane_of_surfels(0.0, 0.5, 0.01, 0.008, opacity=0.9), {"orthographic": True, "focal": 20.0}),
    "near": (random_surfels(500, seed=4, size=0.3), {"distance": 0.9}),
}


def both(
    device: WarpRenderBackend, name: str, rows: tuple[int, int] = (0, 30), width: float = 0.0
) -> tuple[SurfelSamples, SurfelSamples]:
    posed, view = SCENES[name]
    camera = look_along_y(40, 30, **view)
    given = posed, camera, camera_parameters(camera, RenderSettings(subpixel_samples=3, seed=5, filter_width=width), 2)
    return rasterise(prepare(*given), *rows), device.rasterise(device.prepare(*given), *rows)


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.0, 1.5])
@pytest.mark.parametrize("name", SCENES)
def test_a_device_finds_the_samples_that_the_processor_finds(
    device: WarpRenderBackend, name: str, width: float
) -> None:
    here, there = both(device, name, width=width)
    seen = here.alpha > 0
    assert seen.mean() > 0.1
    np.testing.assert_array_equal(there.alpha > 0, seen)
    assert_near(there.alpha, here.alpha, atol=1e-6)
    assert_near(there.depth[seen], here.depth[seen], rtol=1e-5)
    assert_near(there.surface[seen], here.surface[seen], atol=1e-5)
    np.testing.assert_array_equal(there.object_index[seen], here.object_index[seen])


def test_rows_do_not_depend_on_those_rendered_with_them(device: WarpRenderBackend) -> None:
    _, whole = both(device, "cloud")
    _, part = both(device, "cloud", (11, 17))
    np.testing.assert_array_equal(part.alpha, whole.alpha[11:17])


def test_fog_of_any_depth_is_blended_in_exact_order(device: WarpRenderBackend) -> None:
    """More contributions a sample than a list holds: the list is filled again."""
    fog = join(*(plane_of_surfels(0.05 * i, 0.3, 0.05, 0.05, opacity=0.012) for i in range(16)))
    camera = look_along_y(12, 12, focal=30.0)
    splats = prepare(fog, camera, camera_parameters(camera, RenderSettings(subpixel_samples=1), 0))
    here, there = rasterise(splats, 0, 12), device.rasterise(splats, 0, 12)
    assert 0.5 < here.alpha.max() < 0.999
    assert len(splats.tile_list) / len(splats.tile_start) > 10 * device_raster.MOST
    np.testing.assert_allclose(there.alpha, here.alpha, atol=1e-5)
    seen = here.alpha > 0
    np.testing.assert_allclose(there.depth[seen], here.depth[seen], rtol=1e-4)
    np.testing.assert_allclose(there.surface[seen], here.surface[seen], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [-0.02, 0.1])
@pytest.mark.parametrize("tied", [True, False])
def test_points_are_tied_to_the_mesh_as_the_processor_ties_them(
    device: WarpRenderBackend, offset: float, tied: bool
) -> None:
    """A sphere of surfels about its mesh, before an ordinary mesh that they must not be tied to."""
    scene, camera = scene_of(sphere_mesh(3)), look_along_y(48, 40)
    wall = np.float32([[-3, -0.5, -3], [3, -0.5, -3], [3, -0.5, 3], [-3, -0.5, 3]])
    kept = scene_of(sphere_mesh(3))._parts[0].item
    ordinary = MeshState("wall", wall, np.int32([[0, 1, 2], [0, 2, 3]]), np.eye(4)[None], np.zeros(1, np.int32))
    scene.update([kept], [ordinary])
    parameters = camera_parameters(camera, RenderSettings(subpixel_samples=2), 1)
    posed, windows = sphere_surfels(1 + offset), snap_windows(scene, 1)
    here, there = (
        primary_surfels(
            by.prepare(posed, camera, parameters), scene, windows, camera, 0, 40, tied, Stages(by.rasterise, by.tie)
        )
        for by in (CPU, device)
    )
    for name in ("pixel", "sample", "flags", "own"):
        np.testing.assert_array_equal(getattr(there.points, name), getattr(here.points, name))
    for name in ("origin", "normal", "geometric_normal", "view", "albedo", "roughness"):
        a, b = getattr(here.points, name), getattr(there.points, name)
        far = np.abs(a - b).reshape(len(a), -1).max(axis=1) > 1e-4
        assert far.mean() < 0.002, name  # a ray along an edge meets the other face
    np.testing.assert_allclose(there.depth, here.depth, rtol=1e-4)
    assert (here.face >= 0).mean() > 0.3
    assert (there.face == here.face).mean() > 0.995


def test_blended_samples_are_not_copied_to_a_card_again(monkeypatch: pytest.MonkeyPatch) -> None:
    device, scene, camera, copied = WarpRenderBackend(DEVICE), scene_of(sphere_mesh(2)), look_along_y(48, 40), []
    device.launcher.apart, copy = True, device.launcher.array
    monkeypatch.setattr(
        device.launcher, "array", lambda array, *more, **how: copied.append(array) or copy(array, *more, **how)
    )
    parameters, windows = camera_parameters(camera, RenderSettings(subpixel_samples=2), 1), snap_windows(scene, 1)
    splats = device.prepare(sphere_surfels(1.0), camera, parameters)
    given, samples = (scene, windows, camera, 0, 40, True), []

    def rasterise_there(*arguments: object) -> SurfelSamples:
        samples.append(device.rasterise(*arguments))  # type: ignore[arg-type]
        return samples[-1]

    found = primary_surfels(splats, *given, Stages(rasterise_there, device.tie))
    assert not device.failed and not any(np.shares_memory(array, samples[0].surface) for array in copied)
    other = device.rasterise(splats, 0, 40)  # other samples than the latest are copied
    again = primary_surfels(splats, *given, Stages(lambda *arguments: samples[0], device.tie))
    assert other.surface is not samples[0].surface
    assert any(np.shares_memory(array, samples[0].surface) for array in copied)
    np.testing.assert_array_equal(found.points.origin, again.points.origin)
