"""Meshes that the camera sees, on Warp's device "cpu": the points that the processor finds."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE
from shapes import scene_of, sphere_mesh, sphere_surfels
from test_device_integrate import among_meshes, ball, floor, placed, psnr
from test_raster import look_along_y

from drgs_blender.core.frame import Camera, RenderSettings, Visibility
from drgs_blender.render.backend import CPU, RenderBackend
from drgs_blender.render.camera import SUBPIXELS, camera_parameters
from drgs_blender.render.gbuffer.gbuffer import GBuffer
from drgs_blender.render.gbuffer.mesh import primary_mesh
from drgs_blender.render.gbuffer.surfels import Stages, primary_surfels, snap_windows
from drgs_blender.render.gpu.warp_backend import WarpRenderBackend
from drgs_blender.render.scene.ray_masks import CAMERA
from drgs_blender.render.scene.trace_scene import TraceScene


def looking_down(**more: float) -> Camera:
    camera = look_along_y(64, 48, **more)
    c, s = np.cos(0.7), np.sin(0.7)
    camera.matrix_world[:3, :3] = np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) @ camera.matrix_world[:3, :3]
    camera.matrix_world[:3, 3] = 0.0, -6.0, 5.5
    return camera


VIEWS = {
    "perspective": looking_down(),
    "orthographic": looking_down(focal=9.0, orthographic=True),
    "clipped": looking_down(clip_start=6.5, clip_end=8.5),
}


def unseen() -> tuple:
    """A plate before all others that the camera does not see, and kinds of rays that differ."""
    scene, shut = TraceScene(), Visibility(glossy=False)
    plates = placed(-1.0, 0.0, 1.0, 0.3), placed(1.0, -1.0, 1.5, 0.2)
    meshes = [
        floor(),
        floor(placed(0, -3, 3.0, 0.3), name="unseen", visibility=Visibility(camera=False)),
        floor(*plates, name="plates", visibility=shut),
    ]
    scene.update([ball((1.4, 0.6, 0.9), 0.6), ball((-1.4, 0.6, 0.9), 0.6, visibility=shut)], meshes)
    return (scene,)


SCENES = {"among meshes": among_meshes, "unseen": unseen}


def seen(by: RenderBackend, scene: TraceScene, camera: Camera, rows: tuple[int, int] = (0, 48)) -> GBuffer:
    parameters = camera_parameters(camera, RenderSettings(subpixel_samples=3, seed=5), 2)
    return primary_mesh(scene, camera, parameters, *rows, by.trace, by.shade)


def picture(buffer: GBuffer, values: np.ndarray, camera: Camera) -> np.ndarray:
    """(pixels, channels) sums of what the points show."""
    values = values.reshape(len(values), -1)
    out = np.zeros((camera.width * camera.height, values.shape[1]))
    np.add.at(out, buffer.points.pixel, buffer.points.weight[:, None] * values)
    return out


def assert_alike(here: GBuffer, there: GBuffer, camera: Camera) -> None:
    assert len(here.points) > 500
    np.testing.assert_allclose(there.alpha.mean(), here.alpha.mean(), atol=1e-4)
    for name in ("position", "depth", "emission", "face", "instance", "object_index", "barycentric"):
        assert getattr(there, name).dtype == getattr(here, name).dtype
    for name in ("albedo", "roughness", "metallic", "normal", "geometric_normal", "view"):
        a, b = (picture(buffer, getattr(buffer.points, name), camera) for buffer in (here, there))
        assert np.abs(a).max() > 0.1 and psnr(0.5 + 0.5 * a, 0.5 + 0.5 * b) > 60.0, name
    for name in ("position", "depth", "emission", "object_index"):
        a, b = (picture(buffer, getattr(buffer, name), camera) for buffer in (here, there))
        far = np.abs(a - b).max(axis=1) > 1e-4 * (1 + np.abs(a).max(axis=1))
        assert far.mean() < 0.002, name  # a ray along an edge meets the other face


@pytest.mark.slow
@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("name", SCENES)
def test_the_camera_sees_the_same_meshes(device: WarpRenderBackend, name: str, view: str) -> None:
    """Textures, emission, places, mirrored ones, what is hidden from the camera."""
    scene, camera = SCENES[name]()[0], VIEWS[view]
    assert_alike(seen(CPU, scene, camera), seen(device, scene, camera), camera)


@pytest.mark.slow
def test_rows_do_not_depend_on_those_rendered_with_them(device: WarpRenderBackend) -> None:
    scene, camera = among_meshes()[0], VIEWS["perspective"]
    whole, part = seen(device, scene, camera), seen(device, scene, camera, (11, 29))
    width = camera.width
    own = (whole.points.pixel >= 11 * width) & (whole.points.pixel < 29 * width)
    for field in fields(part.points):
        values = getattr(part.points, field.name)
        if isinstance(values, np.ndarray) and len(values):
            np.testing.assert_array_equal(values, getattr(whole.points, field.name)[own], field.name)


def test_meshes_behind_surfels_leave_the_surfels_as_they_are(device: WarpRenderBackend) -> None:
    """Only the points of meshes are filled."""
    scene, camera = scene_of(sphere_mesh(3)), look_along_y(48, 40)
    scene.update([scene._parts[0].item], [floor(placed(0, 0, -0.4), name="ground")])
    parameters, windows = camera_parameters(camera, RenderSettings(subpixel_samples=2), 1), snap_windows(scene, 1)
    posed = sphere_surfels(1.05)
    here, there = (
        primary_surfels(
            CPU.prepare(posed, camera, parameters), scene, windows, camera, 0, 40, True,
            Stages(trace=by.trace, shade=by.shade),
        )
        for by in (CPU, device)
    )  # fmt: skip
    behind = here.points.flags != 0
    assert 0.1 < behind.mean() < 0.9
    for name in ("origin", "normal", "albedo"):
        a, b = getattr(here.points, name), getattr(there.points, name)
        np.testing.assert_array_equal(a[~behind], b[~behind])
        np.testing.assert_allclose(a[behind], b[behind], rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(here.object_index, there.object_index)


def test_a_card_that_fails_between_hits_and_points_leaves_them_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    device, scene, camera = WarpRenderBackend(DEVICE), among_meshes()[0], VIEWS["perspective"]
    expected = seen(CPU, scene, camera)
    parameters = camera_parameters(camera, RenderSettings(subpixel_samples=3, seed=5), 2)
    trace = device.trace

    def broken(*arguments: object) -> None:
        raise RuntimeError("out of memory")

    def once(*arguments: object) -> object:
        hits = trace(*arguments)  # type: ignore[arg-type]
        monkeypatch.setattr(device.launcher, "_scratch_for", broken)
        return hits

    shape = 48, 64, int(parameters[SUBPIXELS])
    assert trace(scene, parameters, 0, 0, shape, 0).owner.max() == -1, "rays that meet nothing"
    assert trace(scene, parameters, 0, 0, shape, CAMERA).owner.max() >= 0
    found = primary_mesh(scene, camera, parameters, 0, 48, once, device.shade)
    assert "out of memory" in device.failed
    assert len(found.points) == len(expected.points)
    same = found.face == expected.face
    assert same.mean() > 0.99
    np.testing.assert_allclose(found.points.albedo[same], expected.points.albedo[same], rtol=1e-4, atol=1e-5)


def test_points_whose_hits_are_lost_and_not_found_again_are_on_some_face(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a device met the edge of a face, the processor's ray may go past."""
    device, scene, camera = WarpRenderBackend(DEVICE), among_meshes()[0], VIEWS["perspective"]
    parameters = camera_parameters(camera, RenderSettings(subpixel_samples=3, seed=5), 2)

    def lost(*arguments: object) -> object:
        hits = device.trace(*arguments)  # type: ignore[arg-type]
        again = CPU.trace(*arguments)  # type: ignore[arg-type]
        again.owner[:], again.face[:], again.instance[:] = -1, -1, -1
        hits.on_device, hits.again = (None,), lambda: again  # type: ignore[attr-defined]
        device.failed = "a card that is no more"
        return hits

    found = primary_mesh(scene, camera, parameters, 0, 48, lost, device.shade)
    assert len(found.points)
    assert (found.face >= 0).all() and np.isfinite(found.points.albedo).all()
