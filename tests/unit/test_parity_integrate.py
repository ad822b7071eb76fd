"""The compiled integrator against the torch reference: both draw, so means agree within their stated errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

torch = pytest.importorskip("torch")
trimesh = pytest.importorskip("trimesh")

from drgs_blender.core.frame import RenderSettings, World  # noqa: E402
from drgs_blender.render.integrator.integrate import integrate as kernel_integrate  # noqa: E402
from drgs_blender.render.lights.environment import EnvironmentLight  # noqa: E402
from drgs_blender.render.reference.integrate import (  # noqa: E402
    Counts,
    SurfacePoints,
    integrate,
    integrate_quadrature,
    tracer_from_arrays,
)
from drgs_blender.render.reference.light import Light  # noqa: E402
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene  # noqa: E402
from drgs_blender.render.shading_points import ShadingPoints  # noqa: E402

torch.set_num_threads(1)
F64 = torch.float64
AA = 4


def world() -> World:
    """A random sky with a light, turned and coloured."""
    image = np.random.default_rng(3).random((8, 16, 3)).astype(np.float32) ** 2
    image[2, 5] = 12.0
    angle = math.radians(40)
    spin = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    return World(image, spin, (1.0, 0.8, 0.6), 1.5)


def sphere_over_plane() -> dict[str, np.ndarray]:
    """Unit sphere with smooth normals, 0.2 above a plane, materials that vary from vertex to vertex."""
    ball = trimesh.creation.icosphere(1, 1.0)
    vertices = np.concatenate([np.add(ball.vertices, (0, 0, 1.2)), [(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)]])
    n = len(ball.vertices)
    faces = np.concatenate([ball.faces, [(n, n + 1, n + 2), (n, n + 2, n + 3)]])
    normals = np.concatenate([ball.vertices[ball.faces], np.tile((0, 0, 1.0), (2, 3, 1))])
    rng = np.random.default_rng(8)
    values = rng.uniform(0.1, 0.9, (n + 4, 3)), rng.uniform(0.3, 0.9, n + 4), rng.uniform(0, 1, n + 4)
    return {
        "vertices": vertices.astype(np.float32),
        "faces": faces.astype(np.int32),
        "albedo": values[0].astype(np.float32),
        "roughness": values[1].astype(np.float32),
        "metallic": values[2].astype(np.float32),
        "corner_normals": normals.astype(np.float32),
    }


def visible_points(enclosed: bool = False) -> SurfacePoints:
    """Three points on the plane and three on the sphere's faces; `enclosed`: in the gap, where they see each other."""
    scene = sphere_over_plane()
    height = scene["vertices"][scene["faces"][:-2]].mean(1)[:, 2]
    chosen = np.argsort(height)[[0, 2, 9]] if enclosed else [3, 20, 61]
    places = [(0.1, 0.2, 0), (0.5, -0.2, 0), (-0.4, 0.1, 0)] if enclosed else [(0.9, 0.3, 0), (-0.2, 0.5, 0), (2, 2, 0)]
    corners = scene["vertices"][scene["faces"][chosen]].astype(float)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    smooth = scene["corner_normals"][chosen].astype(float).mean(1)
    smooth /= np.linalg.norm(smooth, axis=1, keepdims=True)
    up = np.tile((0, 0, 1.0), (3, 1))
    origin = np.concatenate([places, corners.mean(1)])
    normal, geometric = np.concatenate([up, smooth]), np.concatenate([up, flat])
    aside = np.array(
        [(0.8, 0.2, 0.5), (-0.3, 0.9, 0.2), (0.1, -0.7, 0.7), (0.4, 0.4, 0.1), (0.2, -0.5, 0.3), (0.3, 0, 0)]
    )
    view = normal + aside - (aside * normal).sum(1, keepdims=True) * normal
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    albedo = np.random.default_rng(2).uniform(0.2, 0.9, (6, 3))
    roughness, metallic = np.array([0.3, 0.6, 0.9, 0.25, 0.5, 0.8]), np.array([0.0, 0.5, 0.2, 1.0, 0.0, 0.6])
    return SurfacePoints(*(torch.from_numpy(a) for a in (origin, normal, geometric, view, albedo, roughness, metallic)))


def kernel_means(points: SurfacePoints, settings: RenderSettings, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n, 4, 3) over `pixels` pixels of `settings.subpixel_samples` sub-samples, and its standard error."""
    arrays = sphere_over_plane()
    scene = TraceScene()
    scene.update([TraceObject("sphere and plane", **arrays)])
    n, subpixels = len(points), settings.subpixel_samples
    pixel = np.repeat(np.arange(n * pixels), subpixels)  # a pixel shows one point, n points take turns
    sample = np.tile(np.arange(subpixels), n * pixels)
    rows = {
        name: np.ascontiguousarray(getattr(points, name).numpy().astype(np.float32)[pixel % n])
        for name in ("origin", "normal", "geometric_normal", "view", "albedo", "roughness", "metallic")
    }
    strip = ShadingPoints(pixel, sample, np.full(len(pixel), 1 / subpixels, np.float32), **rows)
    found = kernel_integrate(scene, EnvironmentLight(world()), strip, settings, 3).components.astype(float)
    scene.close()
    a_pixel = found.reshape(pixels, n, subpixels, 4, 3).mean(2)
    return a_pixel.mean(0), a_pixel.std(0) / math.sqrt(pixels)


def judge(found: np.ndarray, truth: np.ndarray, error: np.ndarray) -> None:
    """Deviations in units of the combined standard error: none far out, and of unit size together.

    Colour channels come from the same rays, so one of them speaks for the whole in the chi-square test.
    """
    drawn = error > 1e-9
    np.testing.assert_allclose(found[~drawn], truth[~drawn], atol=1e-6)
    z = np.where(drawn, (found - truth) / np.where(drawn, error, 1), 0)
    assert np.abs(z).max() < 4.5
    assert stats.chi2.sf((z[..., 1] ** 2).sum(), drawn[..., 1].sum()) > 1e-3


COMBINATIONS = {
    "cosine alone": RenderSettings(strategy_samples=(8, 0, 0), subpixel_samples=1),
    "environment alone": RenderSettings(strategy_samples=(0, 0, 8), subpixel_samples=1),
    "all": RenderSettings(strategy_samples=(8, 4, 4), subpixel_samples=1),
    "counts that the sub-samples do not divide": RenderSettings(strategy_samples=(5, 3, 6), subpixel_samples=AA),
    "allotted by the material": RenderSettings(subpixel_samples=1),
    "allotted by the material, to sub-samples": RenderSettings(samples=23, subpixel_samples=AA),
}


@pytest.mark.parametrize("shading_model", ["principled", "paper"])
@pytest.mark.parametrize("name", COMBINATIONS)
def test_direct_light(name: str, shading_model: str):
    """Against quadrature, which has no noise: its own error is below 0.2 % of the light."""
    points = visible_points()
    arrays = sphere_over_plane()
    truth = integrate_quadrature(
        tracer_from_arrays(**arrays), Light.from_world(world()), _lifted(points), 96, shading_model
    )
    settings = replace(COMBINATIONS[name], shading_model=shading_model, bounces=0)
    found, error = kernel_means(points, settings, 4000)
    assert (found[:, 1] == 0).all() and (found[:, 3] == 0).all()
    truth = truth.numpy()
    judge(found, truth, np.where(truth > 0, np.hypot(error, 4e-3 * truth), error))


@pytest.mark.parametrize("shading_model", ["principled", "paper"])
@pytest.mark.parametrize("bounces", [1, 3])
def test_indirect_light(bounces: int, shading_model: str):
    points = visible_points(enclosed=True)
    tracer, light = tracer_from_arrays(**sphere_over_plane()), Light.from_world(world())
    generator = torch.Generator().manual_seed(21)
    counts = Counts(*((5000, 2500, 2500) if bounces == 1 else (1600, 800, 800)))
    samples = integrate(tracer, light, _lifted(points), counts, bounces, shading_model, generator, samples=True)
    reference, noise = samples.sum(1).numpy(), (samples.var(1) * samples.shape[1]).sqrt().numpy()
    found, error = kernel_means(
        points, RenderSettings(samples=16, bounces=bounces, subpixel_samples=1, shading_model=shading_model), 4000
    )
    assert (reference[:, 1] > 0).any()
    judge(found, reference, np.hypot(error, noise))


def _lifted(points: SurfacePoints) -> SurfacePoints:
    """The kernel lifts origins off the surface itself; the reference wants them safe."""
    return replace(points, origin=points.origin + 1e-5 * points.geometric_normal)
