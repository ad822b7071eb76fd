"""What the camera sees: mesh against closed forms, surfels tied to their mesh without shadowing themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import look_along_y, scene_of, sphere_mesh, sphere_surfels

from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.core.frame import Camera, RenderSettings, World
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.gbuffer.gbuffer import GBuffer
from drgs_blender.render.gbuffer.mesh import primary_mesh
from drgs_blender.render.gbuffer.surfels import primary_surfels, snap_windows
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene
from drgs_blender.render.shading_points import ShadingPoints
from drgs_blender.render.surfels.splats import prepare

SETTINGS = RenderSettings(subpixel_samples=2, bounces=0, samples=64, shading_model="paper")


def surfel_buffer(posed: PosedSurfels, scene: TraceScene, camera: Camera, settings: RenderSettings) -> GBuffer:
    parameters = camera_parameters(camera, settings, 1)
    windows = snap_windows(scene, 1)
    return primary_surfels(prepare(posed, camera, parameters), scene, windows, camera, 0, camera.height)


def white_light(scene: TraceScene, points: ShadingPoints) -> np.ndarray:
    """(n,) direct light of a uniform white world, nearly without noise."""
    return integrate(
        scene, EnvironmentLight(World()), points, replace(SETTINGS, strategy_samples=(64, 32, 128)), 1
    ).total[:, 1]


def check_contract(buffer: GBuffer, subpixels: int) -> None:
    points = buffer.points
    for name in ("normal", "geometric_normal", "view"):
        assert np.allclose(np.linalg.norm(getattr(points, name), axis=1), 1, atol=1e-5), name
    assert ((points.normal * points.view).sum(1) > 0).all()
    assert ((points.geometric_normal * points.view).sum(1) > 0).all()
    order = points.pixel.astype(np.int64) * subpixels + points.sample
    assert (np.diff(order) > 0).all()
    covered = buffer.alpha[buffer.alpha > 0]
    assert np.allclose(points.weight, covered / subpixels)


@pytest.mark.parametrize("offset", [-0.4, -0.1, -0.02, -0.004, 0.0, 0.004, 0.02, 0.1])
def test_surfels_off_their_mesh_do_not_shadow_themselves(offset: float) -> None:
    """In a uniform white world a convex object is lit alike wherever it is looked at: no sample may be dark."""
    scene = scene_of(sphere_mesh(3))
    buffer = surfel_buffer(sphere_surfels(1 + offset), scene, look_along_y(), SETTINGS)
    check_contract(buffer, 2)
    points = buffer.points
    lit = white_light(scene, points)
    frontal = (points.normal * points.view).sum(1) > 0.3
    reference = np.median(lit[frontal])
    assert 0.4 < reference < 0.6
    assert lit[frontal].min() > 0.85 * reference
    assert lit.min() > 0.5 * reference  # the rim as well, where smooth and flat normals differ most
    # Origins lie on the mesh, positions on the surfels (half a standard deviation, which is 0.027).
    assert np.abs(np.linalg.norm(points.origin, axis=1) - 1).max() < 0.02
    facing = (points.normal * points.view).sum(1) > 0.9
    assert np.abs(np.linalg.norm(buffer.position, axis=1) - 1 - offset)[facing].max() < 0.0137
    if offset == -0.1:
        # What happens without: rays that start at the surfels are blocked by the mesh outside.
        naive = replace(points, origin=buffer.position, geometric_normal=points.normal)
        assert np.median(white_light(scene, naive)[frontal]) < 0.1 * reference


def test_a_thin_wall_takes_the_light_of_the_side_that_is_seen() -> None:
    """Two sheets, closer than the window and turned apart: whichever way surfels are turned, they snap to the front.

    Behind it lies the inside of the wall, which is black.
    """
    square = np.array([[-3, 0, -3], [3, 0, -3], [3, 0, 3], [-3, 0, 3]], np.float32)
    front = (square + np.float32([0, -0.02, 0]), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    back = (square + np.float32([0, 0.02, 0]), np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    scene = scene_of(front, back)
    line = np.linspace(-1, 1, 41)
    x, z = (a.ravel() for a in np.meshgrid(line, line))
    n = len(x)
    for normal_y in (-1.0, 1.0):
        posed = PosedSurfels(
            np.stack([x, np.full(n, 0.01), z], -1).astype(np.float32),
            np.tile(np.float32([0.04, 0, 0]), (n, 1)),
            np.tile(np.float32([0, 0, 0.04]), (n, 1)),
            np.tile(np.float32([0, normal_y, 0]), (n, 1)),
            *(np.full((n, *s), 0.9, np.float32) for s in ((), (3,), (), ())),
            np.zeros(n, np.int32),
        )
        buffer = surfel_buffer(posed, scene, look_along_y(24), SETTINGS)
        assert np.allclose(buffer.points.origin[:, 1], -0.02, atol=1e-4)
        assert np.allclose(buffer.points.normal, (0, -1, 0), atol=1e-4)
        check_contract(buffer, 2)
        assert white_light(scene, buffer.points).min() > 0.4


def test_a_sheet_that_is_seen_from_behind_is_met_from_behind() -> None:
    """Of an open mesh, surfels and face turned away: nothing is before them, and the back is what is seen."""
    square = np.array([[-3, 0, -3], [3, 0, -3], [3, 0, 3], [-3, 0, 3]], np.float32)
    scene = scene_of((square + np.float32([0, 0.02, 0]), np.array([[0, 2, 1], [0, 3, 2]], np.int32)))
    line = np.linspace(-1, 1, 41)
    x, z = (a.ravel() for a in np.meshgrid(line, line))
    n = len(x)
    flat = [np.full((n, *s), 0.9, np.float32) for s in ((), (3,), (), ())]
    wide = (np.tile(np.float32(axis), (n, 1)) for axis in ([0.04, 0, 0], [0, 0, 0.04], [0, 1, 0]))
    posed = PosedSurfels(np.stack([x, np.zeros(n), z], -1).astype(np.float32), *wide, *flat, np.zeros(n, np.int32))
    points = surfel_buffer(posed, scene, look_along_y(24), SETTINGS).points
    assert np.allclose(points.origin[:, 1], 0.02, atol=1e-4) and np.allclose(points.normal, (0, -1, 0), atol=1e-4)
    assert white_light(scene, points).min() > 0.4


def test_without_a_mesh_points_stay_and_are_lit() -> None:
    scene = scene_of()
    buffer = surfel_buffer(sphere_surfels(1.0), scene, look_along_y(), SETTINGS)
    check_contract(buffer, 2)
    points = buffer.points
    lifted = np.linalg.norm(points.origin - buffer.position, axis=1)
    sigma = 0.6 * np.sqrt(4 * np.pi / 6000)
    assert np.allclose(lifted, 4 * sigma, rtol=1e-3)
    frontal = (points.normal * points.view).sum(1) > 0.3
    assert white_light(scene, points)[frontal].min() > 0.4


def test_surfels_that_overhang_the_silhouette_are_brought_back() -> None:
    scene = scene_of(sphere_mesh(4))
    buffer = surfel_buffer(sphere_surfels(1.02), scene, look_along_y(64), SETTINGS)
    points = buffer.points
    # Distance of the camera ray from the sphere's centre: beyond one it misses the mesh.
    overhang = (np.linalg.norm(np.cross([0, -4, 0], points.view), axis=1) > 1.001) & (points.weight > 0.25)
    assert overhang.sum() > 50
    assert np.abs(np.linalg.norm(points.origin[overhang], axis=1) - 1).max() < 0.01
    assert white_light(scene, points)[overhang].min() > 0.35


@pytest.mark.parametrize("orthographic", [False, True])
def test_mesh_samples_lie_on_the_sphere(orthographic: bool) -> None:
    scene = scene_of(sphere_mesh(5))
    camera = look_along_y(focal=16.0 if orthographic else 70.0, orthographic=orthographic)
    parameters = camera_parameters(camera, SETTINGS, 1)
    buffer = primary_mesh(scene, camera, parameters, 0, camera.height)
    check_contract(buffer, 2)
    points = buffer.points
    assert np.abs(np.linalg.norm(points.origin, axis=1) - 1).max() < 1e-3
    assert np.allclose(points.normal, points.origin, atol=0.03)
    assert np.allclose(buffer.depth, points.origin[:, 1] + 4, atol=1e-4)
    assert np.allclose(points.roughness, 0.6) and np.allclose(points.albedo, 0.5)
    # Area of the disc in pixels: the sphere's outline.
    radius = 16.0 if orthographic else 70 * np.tan(np.arcsin(1 / 4))
    assert abs(points.weight.sum() - np.pi * radius**2) < 0.01 * np.pi * radius**2
    if orthographic:
        assert np.allclose(points.view, (0, -1, 0), atol=1e-6)
    else:
        towards = np.array([0, -4, 0]) - points.origin
        assert np.allclose(points.view, towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-4)


def test_mesh_and_surfels_look_through_the_same_positions() -> None:
    square = np.array([[-3, 0, -3], [3, 0, -3], [3, 1, 3], [-3, 1, 3]], np.float32)
    scene = scene_of((square, np.array([[0, 1, 2], [0, 2, 3]], np.int32)))
    posed = PosedSurfels(
        np.float32([[0, 0.5, 0]]), np.float32([[50, 0, 0]]), np.float32([[0, 50 / 6, 50]]),
        np.float32([[0, -0.986, 0.164]]), *(np.full((1, *s), 0.9, np.float32) for s in ((), (3,), (), ())),
        np.zeros(1, np.int32),
    )  # fmt: skip
    camera = look_along_y(20)
    a = surfel_buffer(posed, scene, camera, SETTINGS)
    b = primary_mesh(scene, camera, camera_parameters(camera, SETTINGS, 1), 0, 20)
    assert np.array_equal(a.points.pixel, b.points.pixel) and np.array_equal(a.points.sample, b.points.sample)
    assert np.allclose(a.position, b.position, atol=1e-4)
    assert np.allclose(a.points.origin, b.points.origin, atol=1e-4)
    assert np.allclose(a.points.view, b.points.view, atol=1e-6)


@pytest.mark.parametrize("width", [0.75, 1.5])
def test_an_edge_is_as_soft_as_the_pixel_filter(width: float) -> None:
    """Coverage across a straight edge is the integral of the window, here of a mesh."""
    edge = 0.3
    plane = np.array([[-9, 0, -9], [edge, 0, -9], [edge, 0, 9], [-9, 0, 9]], np.float32)
    scene = scene_of((plane, np.array([[0, 1, 2], [0, 2, 3]], np.int32)))
    camera = look_along_y(24, focal=4.0, orthographic=True)
    settings = RenderSettings(subpixel_samples=64, camera_sees="mesh", filter_width=width)
    buffer = primary_mesh(scene, camera, camera_parameters(camera, settings, 1), 0, 24)
    coverage = np.bincount(buffer.points.pixel, buffer.points.weight, 24 * 24).reshape(24, 24).mean(0)
    a, k = np.array([0.48829, 0.14128, 0.01168]), 2 * np.pi * np.arange(1, 4)
    x = np.clip((12 + 4 * edge - np.arange(24) - 0.5) / (2 * width), -0.5, 0.5)
    expected = 0.5 + x + (a / k * np.sin(np.outer(x, k))).sum(1) / 0.35875
    assert ((expected > 0.01) & (expected < 0.99)).any()
    assert np.abs(coverage - expected).max() < 0.01


def test_mesh_region_and_clipping() -> None:
    scene = scene_of(sphere_mesh(3))
    camera = look_along_y(40)
    parameters = camera_parameters(camera, SETTINGS, 1)
    whole = primary_mesh(scene, camera, parameters, 0, 40)
    camera.region = (9, 4, 31, 37)
    part = primary_mesh(scene, camera, parameters, 11, 29)
    x, y = whole.points.pixel % 40, whole.points.pixel // 40
    inside = (x >= 9) & (x < 31) & (y >= 11) & (y < 29)
    assert np.array_equal(part.points.pixel, whole.points.pixel[inside])
    assert np.array_equal(part.points.origin, whole.points.origin[inside])
    camera = look_along_y(40, clip_start=3.5)  # cuts the front off: the inside of the back is seen
    cut = primary_mesh(scene, camera, camera_parameters(camera, SETTINGS, 1), 0, 40)
    assert cut.depth.min() >= 3.5 and cut.depth.max() > 4.5
    check_contract(cut, 2)
    camera = look_along_y(40, clip_end=2.5)
    assert len(primary_mesh(scene, camera, camera_parameters(camera, SETTINGS, 1), 0, 40).points) == 0


def test_overhang_of_a_fold_is_lit_as_the_face_beyond() -> None:
    """A step seen at a slant from above: surfels of its upright side reach over the flat top and must not darken it."""
    vertices = np.float32([[-1, 0, 0], [1, 0, 0], [1, 0, 1], [-1, 0, 1], [1, 2, 1], [-1, 2, 1]])
    faces = np.int32([[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]])
    eye, target = np.array([0.0, -2.0, 1.6]), np.array([0.0, 0.1, 1.0])
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.array([1.0, 0, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = eye
    camera = Camera(pose, 40, 40, 120.0, 120.0, 20.0, 20.0)
    settings = RenderSettings(subpixel_samples=4)
    parameters = camera_parameters(camera, settings, 0)
    scene = TraceScene()
    one = np.ones(len(vertices), np.float32)
    scene.update([TraceObject("step", vertices, faces, np.ones((6, 3), np.float32), one, 0 * one)])
    # One large surfel in the plane of the upright side, centred on the edge: half of it hangs in the air over the top.
    posed = PosedSurfels(
        np.float32([[0, 0, 1]]), np.float32([[0.3, 0, 0]]), np.float32([[0, 0, 0.1]]), np.float32([[0, -1, 0]]),
        np.float32([0.99]), np.ones((1, 3), np.float32), np.float32([1]), np.float32([0]), np.int32([0]),
    )  # fmt: skip
    windows = snap_windows(scene, 1)
    points = primary_surfels(prepare(posed, camera, parameters), scene, windows, camera, 0, 40).points
    above, side = points.origin[:, 1] > 0.01, points.origin[:, 2] < 0.99  # beyond the edge, below it
    assert above.sum() > 20 and side.sum() > 20
    np.testing.assert_allclose(points.normal[above], np.tile([0, 0, 1], (above.sum(), 1)), atol=1e-5)
    np.testing.assert_allclose(points.normal[side], np.tile([0, -1, 0], (side.sum(), 1)), atol=1e-5)
    np.testing.assert_allclose(points.origin[above, 2], 1, atol=1e-4)
