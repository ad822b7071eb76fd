"""Surfels projected, sorted and listed on a device, on Warp's device "cpu": the splats that the processor makes."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE, IS_CARD, assert_near, host
from test_device_raster import SCENES
from test_raster import join, look_along_y, plane_of_surfels, random_surfels, surfels

from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.core.frame import Camera, RenderSettings
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.gpu.warp_backend import WarpRenderBackend
from drgs_blender.render.surfels.raster import rasterise
from drgs_blender.render.surfels.splats import Splats, prepare

CAMERA = look_along_y(75, 50)


def both(device: WarpRenderBackend, posed: PosedSurfels, camera: Camera = CAMERA) -> tuple[Splats, Splats]:
    parameters = camera_parameters(camera, RenderSettings(subpixel_samples=3, seed=5), 2)
    return tuple(by(posed, camera, parameters) for by in (prepare, device.prepare))  # type: ignore[return-value]


def hopeless() -> PosedSurfels:
    """Surfels in the picture, of which some are not finite, faint, points, behind the camera or cut by its plane."""
    posed = random_surfels(400, seed=8)
    posed.centre[3], posed.tangent_u[5, 1], posed.opacity[7] = np.nan, np.inf, 1.0 / 300.0
    posed.tangent_u[9] = posed.tangent_v[9] = 0.0
    return join(posed, surfels([[0, -9, 0], [0, -3.95, 0]], [0.2, 0.2, 0], [0, 0.2, 0.2]))


#: How near numbers of the device are to the CPU's.
NEAR = 1e-4 if IS_CARD else 1e-6

VIEWS = {
    **{name: (posed, look_along_y(75, 50, **view)) for name, (posed, view) in SCENES.items()},
    "window": (random_surfels(2000, seed=6), replace(CAMERA, region=(21, 17, 60, 33))),
    "hopeless": (hopeless(), CAMERA),
    "equal depths": (join(*[plane_of_surfels(0.1, 0.5, 0.02, 0.1)] * 3), CAMERA),
    "elsewhere": (surfels([[0, -9, 0]], [1, 0, 0], [0, 0, 1]), CAMERA),
}


@pytest.mark.parametrize("name", VIEWS)
def test_a_device_makes_the_splats_that_the_processor_makes(device: WarpRenderBackend, name: str) -> None:
    here, there = both(device, *VIEWS[name])
    assert there.number == here.number and (here.number == 0) == (name == "elsewhere")
    for field in ("box", "object_index", "tile_start", "tile_list"):
        found, expected = host(getattr(there, field)), getattr(here, field)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected, field)
    for field in ("screen", "surface", "nearest"):
        np.testing.assert_allclose(host(getattr(there, field)), getattr(here, field), NEAR, NEAR * 1e-6, err_msg=field)


def test_surfels_are_copied_to_a_card_once_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    posed, device, copied = random_surfels(1500), WarpRenderBackend(DEVICE), []
    copy = device.launcher.array
    device.launcher.apart = True
    monkeypatch.setattr(device.launcher, "array", lambda array: copied.append(array.nbytes) or copy(array))
    here, there = both(device, posed)
    camera = there.parameters.nbytes
    assert sum(copied) == camera + sum(getattr(posed, field.name).nbytes for field in fields(PosedSurfels))
    copied.clear()
    for rows in ((0, 20), (20, 50)):
        assert_near(device.rasterise(there, *rows).alpha, rasterise(here, *rows).alpha, atol=1e-6)
    assert copied == [camera, camera] and not device.failed


def test_a_card_that_fails_after_its_splats_are_made_leaves_a_whole_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    device = WarpRenderBackend(DEVICE)
    here, there = both(device, random_surfels(1500))

    def broken(*arguments: object) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(device.launcher, "_scratch_for", broken)
    np.testing.assert_array_equal(device.rasterise(there, 0, 50).alpha, rasterise(here, 0, 50).alpha)
    assert "out of memory" in device.failed
    again = both(device, random_surfels(1500))[1]  # the card is left alone
    np.testing.assert_array_equal(again.screen, here.screen)
