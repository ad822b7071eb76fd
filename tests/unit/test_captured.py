"""Surfels as captured, against independent renderers of 3DGS and 2DGS, and against what turning an object means."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import splat_renderers

from drgs_blender.core.asset.model import Surfels
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.frame import Camera, RenderSettings
from drgs_blender.deform.rigid import pose_by_matrix
from drgs_blender.formats.harmonics import basis, rotate_harmonics
from drgs_blender.formats.registry import read_surfels
from drgs_blender.render.camera import camera_parameters, lattice, pixel_shift
from drgs_blender.render.surfels.captured import CapturedObject, blend, project
from drgs_blender.render.surfels.harmonics import harmonics
from drgs_blender.render.surfels.raster import rasterise
from drgs_blender.render.surfels.splats import prepare

PLAYBOT = Path(__file__).resolve().parents[2] / "examples" / "playbot" / "playbot.ply"


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((np.asarray(a, np.float64) - b) ** 2)))


def cloud(count: int = 250, coefficients: int = 16, thick: bool = False, seed: int = 1) -> Surfels:
    """Splats of all shapes, whose colours change much with the direction."""
    rng = np.random.default_rng(seed)
    rotation = rng.normal(size=(count, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    scale = 0.3 * np.exp(rng.uniform(-3, 0, (count, 2)))
    sh = rng.normal(size=(count, coefficients, 3)) * 0.3
    albedo, none = np.full((count, 3), 0.5), np.zeros(count)
    extras = {"thickness": (scale.min(axis=1) * rng.uniform(0.1, 1, count)).astype(np.float32)} if thick else {}
    given = rng.uniform(-1, 1, (count, 3)), scale, rotation, rng.uniform(0.02, 1, count)
    return Surfels(*given, albedo, none, none, sh, extras)


def looking(direction: tuple[float, float, float] = (0.5, -1.0, 0.4), size: int = 40, distance: float = 4.0) -> Camera:
    """A camera that sees the origin from `direction`, off its axis, with pixels that are not square."""
    z = np.array(direction) / np.linalg.norm(direction)
    x = np.cross([0, 0, 1], z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.column_stack([x, np.cross(z, x), z]), distance * z
    return Camera(matrix, size, size - 6, 1.4 * size, 1.3 * size, 0.55 * size, 0.4 * size, clip_start=0.1)


def positions_of(camera: Camera, parameters: np.ndarray, samples: int) -> np.ndarray:
    """(h, w, samples, 2) positions of the sub-pixel samples."""
    position = np.empty((camera.height, camera.width, samples, 2))
    for y, x in np.ndindex(camera.height, camera.width):
        shift = pixel_shift(parameters, y * camera.width + x)
        for k in range(samples):
            position[y, x, k] = np.add((x, y), lattice(*shift, k, parameters))
    return position


def shown(surfels: Surfels, camera: Camera, samples: int = 1):
    """What our renderer shows: premultiplied linear radiance and alpha of every sample, and their positions."""
    parameters = camera_parameters(camera, RenderSettings(subpixel_samples=samples, samples=samples), 1)
    posed = pose_by_matrix(surfels, np.eye(4))
    others = prepare(pose_by_matrix(cloud(0), np.eye(4)), camera, parameters)
    splats = project([CapturedObject(posed, surfels, False)], camera, parameters)
    found = blend(splats, others, 0, camera.height, rasterise)
    alpha = found.samples.alpha
    assert np.array_equal(found.captured, alpha > 0)
    light = np.where(found.captured[..., None], found.radiance, 0) * alpha[..., None]
    return light, alpha, positions_of(camera, parameters, samples)


def expected(surfels: Surfels, camera: Camera, positions: np.ndarray):
    """The same by the reference renderer: its picture over black, as light of its colour and opacity."""
    scale = surfels.scale
    if "thickness" in surfels.extras:
        scale = np.column_stack([scale, surfels.extras["thickness"]])
    given = surfels.centre, scale, surfels.rotation, surfels.opacity, surfels.sh
    colour, alpha = splat_renderers.render(*given, camera, positions.reshape(-1, 2))
    light = srgb_to_linear(colour / np.maximum(alpha, 1e-12)[:, None]) * alpha[:, None]
    return light.reshape(*positions.shape[:-1], 3), alpha.reshape(positions.shape[:-1])


def test_harmonics_are_orthonormal_and_those_of_the_files():
    """Bands 0 to 4 by quadrature over the sphere; they are those that readers turn."""
    node, weight = np.polynomial.legendre.leggauss(12)
    angle = np.arange(24) * 2 * np.pi / 24
    ring = np.sqrt(1 - node**2)[:, None]
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), node[:, None] + 0 * angle], -1).reshape(-1, 3)
    values = np.zeros((len(directions), 25))
    for row, d in zip(values, directions, strict=True):
        harmonics(*d, 25, row)
    measure = np.repeat(weight, 24) * 2 * np.pi / 24
    assert np.allclose(values.T @ (values * measure[:, None]), np.eye(25), atol=1e-12)
    assert np.allclose(values, basis(directions, 4), atol=1e-12)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("thick", [False, True], ids=["2DGS", "3DGS"])
def test_the_picture_is_that_of_the_renderer_that_trained_it(thick: bool, coefficients: int):
    """To more than 60 dB at the same positions, at every degree; what is asked for is 40."""
    surfels, camera = cloud(120, coefficients, thick, seed=coefficients), looking()
    light, alpha, positions = shown(surfels, camera)
    truth, opacity = expected(surfels, camera, positions)
    assert alpha.mean() > 0.2
    assert psnr(light, truth) > 60 and psnr(alpha, opacity) > 60


def test_more_samples_are_the_same_picture_at_more_places():
    """The filters of both renderers are of a pixel, not of a sample."""
    for thick in (False, True):
        surfels, camera = cloud(60, 4, thick), looking(size=20)
        light, alpha, positions = shown(surfels, camera, samples=6)
        truth, opacity = expected(surfels, camera, positions)
        assert psnr(light, truth) > 60 and psnr(alpha, opacity) > 60


def test_an_orthographic_camera_sees_all_along_its_axis():
    """As a perspective one does from very far away."""
    surfels, far = cloud(100, 9, thick=True), looking(size=30, distance=4e4)
    far.fx, far.fy, far.clip_end = far.fx * 1e4, far.fy * 1e4, 1e6
    flat = Camera(far.matrix_world, 30, 24, far.fx / 4e4, far.fy / 4e4, far.cx, far.cy, True, 0.1, 1e6)
    (a, alpha, _), (b, other, _) = shown(surfels, far), shown(surfels, flat)
    assert psnr(a, b) > 50 and psnr(alpha, other) > 50


@pytest.mark.slow
@pytest.mark.parametrize("thick", [False, True], ids=["2DGS", "3DGS"])
def test_a_real_capture_is_shown_as_its_renderer_does(thick: bool):
    surfels = read_surfels(PLAYBOT).surfels
    surfels.centre[:] -= np.median(surfels.centre, axis=0)
    if thick:
        surfels.extras = {"thickness": surfels.scale.min(axis=1) * 0.3}
    camera = looking((0.5, -0.4, -1.0), 48, 2.0)
    light, alpha, positions = shown(surfels, camera)
    truth, opacity = expected(surfels, camera, positions)
    assert psnr(light, truth) > 60 and psnr(alpha, opacity) > 60


def turned(angle: float, axis: tuple[float, float, float], scale: float = 1.0, mirror: bool = False) -> np.ndarray:
    """(4, 4) matrix that turns about an axis, scales, mirrors and moves."""
    n = np.array(axis) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), n)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * (np.eye(3) - math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)
    if mirror:
        matrix[:3, :3] = matrix[:3, :3] @ np.diag([1, -1, 1])
    matrix[:3, 3] = 1.0, -2.0, 0.5
    return matrix


def colours_of(surfels: Surfels, matrix: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Colours of an object's surfels from the world's point `eye`, in their order."""
    camera = looking()
    camera.matrix_world = camera.matrix_world.copy()
    z = (eye - matrix[:3, 3]) / np.linalg.norm(eye - matrix[:3, 3])
    x = np.cross([0.3, 0.2, 1], z)
    x /= np.linalg.norm(x)
    camera.matrix_world[:3, :3], camera.matrix_world[:3, 3] = np.column_stack([x, np.cross(z, x), z]), eye
    camera.fx = camera.fy = 5.0
    camera.cx = camera.cy = 20.0
    parameters = camera_parameters(camera, RenderSettings(samples=1, subpixel_samples=1), 1)
    posed = pose_by_matrix(surfels, matrix)
    posed.opacity = np.ones(len(surfels), np.float32)
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    splats = project([CapturedObject(posed, surfels, mirrored)], camera, parameters).colours
    assert splats.number == len(surfels)
    order = np.lexsort(splats.screen[:, :2].T)
    return splats.surface[order, 3:6]


@pytest.mark.parametrize("mirror", [False, True], ids=["turned", "mirrored"])
def test_colours_turn_with_the_object(mirror: bool):
    """An object and its camera moved together: every surfel has the colour that it had."""
    surfels = cloud(60, 16)
    matrix, eye = turned(1.1, (0.3, 1.0, -0.5), 1.7, mirror), np.array([3.0, -4.0, 2.0])
    moved = matrix[:3, :3] @ eye + matrix[:3, 3]
    before, after = colours_of(surfels, np.eye(4), eye), colours_of(surfels, matrix, moved)
    assert before.std() > 0.1
    assert np.allclose(np.sort(before, axis=0), np.sort(after, axis=0), atol=2e-5)


def test_functions_of_every_degree_turn():
    """The coefficients turned, asked at a turned direction, are what they were."""
    sh, turn = np.random.default_rng(2).normal(size=(5, 25, 3)), turned(0.8, (1.0, 2.0, -0.5))[:3, :3]
    d = np.random.default_rng(3).normal(size=(9, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    before, after = basis(d, 4), basis(d @ turn.T, 4)
    rotated = rotate_harmonics(sh.astype(np.float32), turn)
    assert np.allclose(np.einsum("dk,nkc->ndc", before, sh), np.einsum("dk,nkc->ndc", after, rotated), atol=1e-5)


def test_colours_of_a_stretched_surfel_turn_as_its_matter_does():
    """Of a deformation gradient the rotation counts, that of the polar decomposition in the surfel's plane."""
    from scipy.linalg import polar

    surfels = cloud(1, 16, seed=3)
    surfels.centre[:] = 0
    surfels.rotation[:] = 1, 0, 0, 0
    shear = np.eye(4)
    shear[:2, :2] = [[1.3, 0.9], [-0.2, 0.8]]
    turn = np.eye(4)
    turn[:2, :2] = polar(shear[:2, :2])[0]
    eye = np.array([1.0, 2.0, 3.0])
    assert np.allclose(colours_of(surfels, shear, eye), colours_of(surfels, turn, eye), atol=1e-5)
    assert not np.allclose(colours_of(surfels, np.eye(4), eye), colours_of(surfels, turn, eye), atol=0.02)


def test_what_collapses_has_a_finite_colour():
    surfels, flat = cloud(20, 16, thick=True), np.diag([1.0, 1e-12, 0.0, 1.0])
    posed = pose_by_matrix(surfels, flat)
    camera = looking()
    parameters = camera_parameters(camera, RenderSettings(samples=1, subpixel_samples=1), 1)
    splats = project([CapturedObject(posed, surfels, False)], camera, parameters)
    assert np.isfinite(splats.colours.surface).all() and np.isfinite(splats.surfaces.screen).all()


def test_rows_alone_are_those_of_the_whole():
    """Strips do not show, to the last bit."""
    surfels, camera = cloud(100, 9, thick=True), looking()
    parameters = camera_parameters(camera, RenderSettings(samples=2, subpixel_samples=2), 1)
    posed = pose_by_matrix(surfels, np.eye(4))
    lit = prepare(pose_by_matrix(cloud(80, seed=5), np.eye(4), 1), camera, parameters)
    splats = project([CapturedObject(posed, surfels, False)], camera, parameters)
    whole = blend(splats, lit, 0, camera.height, rasterise)
    parts = [blend(splats, lit, y, min(y + 5, camera.height), rasterise) for y in range(0, camera.height, 5)]
    assert np.array_equal(whole.captured, np.concatenate([part.captured for part in parts]))
    assert 0.1 < whole.captured[whole.samples.alpha > 0].mean() < 0.9
    rows = np.concatenate([part.radiance for part in parts])
    assert np.array_equal(whole.radiance[whole.captured], rows[whole.captured])
    assert np.array_equal(whole.samples.alpha, np.concatenate([part.samples.alpha for part in parts]))


def test_what_is_nearer_hides_what_is_farther():
    """A captured disc in front of a lit one, behind it, and one through which the lit one is seen."""
    camera = looking((0.0, -1.0, 0.0))
    parameters = camera_parameters(camera, RenderSettings(samples=1, subpixel_samples=1), 1)

    def disc(y: float, opacity: float) -> Surfels:
        made = cloud(1, 1)
        made.centre[:], made.scale[:], made.opacity[:] = (0, y, 0), 1.0, opacity
        made.rotation[:] = math.sqrt(0.5), math.sqrt(0.5), 0, 0
        return made

    def middle(captured: Surfels, lit: Surfels):
        own = CapturedObject(pose_by_matrix(captured, np.eye(4), 0), captured, False)
        splats = project([own], camera, parameters)
        found = blend(
            splats, prepare(pose_by_matrix(lit, np.eye(4), 1), camera, parameters), 0, camera.height, rasterise
        )
        at = 15, 21, 0  # the nearest pixel to the discs' middle
        return found.captured[at], found.samples.alpha[at], found.samples.object_index[at], found.samples.depth[at]

    shows, alpha, who, depth = middle(disc(-1, 0.9), disc(1, 0.9))
    assert shows and who == 0 and alpha == pytest.approx(0.99, abs=0.01) and depth == pytest.approx(3, abs=0.1)
    shows, alpha, who, depth = middle(disc(1, 0.9), disc(-1, 0.9))
    assert not shows and who == 1 and alpha == pytest.approx(0.99, abs=0.01) and depth == pytest.approx(3, abs=0.1)
    shows, alpha, who, _ = middle(disc(-1, 0.3), disc(1, 0.9))
    assert not shows and who == 1 and alpha == pytest.approx(0.93, abs=0.02)


def test_a_device_blends_the_same(device):
    """The rasteriser of a card takes the same records."""
    surfels, camera = cloud(100, 9, thick=True), looking(size=24)
    parameters = camera_parameters(camera, RenderSettings(samples=2, subpixel_samples=2), 1)
    posed = pose_by_matrix(surfels, np.eye(4))
    lit = pose_by_matrix(cloud(80, seed=5), np.eye(4), 1)
    splats = project([CapturedObject(posed, surfels, False)], camera, parameters)
    here = blend(splats, prepare(lit, camera, parameters), 0, camera.height, rasterise)
    there = blend(splats, device.prepare(lit, camera, parameters), 0, camera.height, device.rasterise)
    assert np.array_equal(here.captured, there.captured)
    assert np.allclose(here.radiance[here.captured], there.radiance[here.captured], atol=1e-5)
