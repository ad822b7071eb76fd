"""The torch integrator: analytic light, chance against quadrature, bounces, gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.core.frame import World  # noqa: E402
from drgs_blender.render.reference import brdf  # noqa: E402
from drgs_blender.render.reference.integrate import (  # noqa: E402
    Counts,
    EmptyTracer,
    SurfacePoints,
    TriangleTracer,
    integrate,
    integrate_quadrature,
    tracer_from_arrays,
)
from drgs_blender.render.reference.light import Light  # noqa: E402

torch.set_num_threads(1)
F64 = torch.float64
WHITE = Light.from_world(World())


def points_up(roughness=(0.25, 0.5, 0.8), metallic=(0.0, 1.0, 0.3), albedo=(0.8, 0.5, 0.2)) -> SurfacePoints:
    n = len(roughness)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(n, 3)
    view = brdf.normalise(torch.tensor([[0.3, 0.2, 1.0], [0.9, 0.0, 0.4], [-0.5, 0.5, 0.5]], dtype=F64)[:n])
    colour = torch.tensor(albedo, dtype=F64).expand(n, 3).clone()
    values = (torch.tensor(v, dtype=F64) for v in (roughness, metallic))
    return SurfacePoints(torch.zeros(n, 3, dtype=F64), up, up, view, colour, *values)


def random_light(seed: int = 0, height: int = 8) -> Light:
    image = np.random.default_rng(seed).random((height, 2 * height, 3)).astype(np.float32) ** 3 * 4
    return Light.from_world(World(environment=image))


def quads(*corners: list[tuple[float, float, float]], albedo: float = 0.6, dtype: torch.dtype = F64) -> TriangleTracer:
    """Quadrilaterals, two triangles each, diffuse."""
    vertices = np.concatenate([np.asarray(c, dtype=float) for c in corners])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(corners))])
    n = len(vertices)
    return tracer_from_arrays(vertices, faces, np.full((n, 3), albedo), np.ones(n), np.zeros(n), dtype=dtype)


FLOOR = [(-50, 0, 0), (50, 0, 0), (50, 50, 0), (-50, 50, 0)]
WALL = [(-50, 0, 0), (50, 0, 0), (50, 0, 1), (-50, 0, 1)]


def test_white_light_on_a_diffuse_plane_leaves_as_albedo():
    points = points_up((1.0,), (0.0,))
    result = integrate_quadrature(EmptyTracer(), WHITE, points, 256, "paper")
    torch.testing.assert_close(result[:, 0], points.albedo, rtol=2e-5, atol=0)
    drawn = integrate(EmptyTracer(), WHITE, points, Counts(64, 0, 0), 0, "paper")
    torch.testing.assert_close(drawn[:, 0], points.albedo, rtol=1e-12, atol=0)  # cosine sampling has no variance here


def z_scores(samples: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    error = (samples.var(1) * samples.shape[1]).sqrt()
    return (samples.sum(1) - truth)[error > 0] / error[error > 0]


@pytest.mark.slow
@pytest.mark.parametrize("shading_model", brdf.SHADING_MODELS)
@pytest.mark.parametrize("counts", [(30000, 0, 0), (0, 30000, 0), (0, 0, 30000), (10000, 5000, 5000)])
def test_each_strategy_and_all_together_find_the_truth(counts: tuple[int, int, int], shading_model: str):
    light, points = random_light(), points_up()
    truth = integrate_quadrature(EmptyTracer(), light, points, 256, shading_model)
    # Samples of one strategy are equally distributed; those of several are not, which only widens the estimate of
    # the error.
    generator = torch.Generator().manual_seed(5)
    samples = integrate(EmptyTracer(), light, points, Counts(*counts), 0, shading_model, generator, samples=True)
    z = z_scores(samples, truth)
    assert z.abs().max() < 4.0
    assert (z**2).mean() < 2.5


def test_the_balance_heuristic_keeps_its_promise():
    """Veach 1997, theorem 9.2: its variance exceeds any single strategy's by (1 / min n - 1 / sum n) mu^2 at most."""
    image = np.full((16, 32, 3), 0.2, dtype=np.float32)
    image[3, 5] = 100.0  # a light
    light = Light.from_world(World(environment=image))
    points = points_up((0.1, 0.4, 0.8), (1.0, 1.0, 0.0))

    def noise(counts: Counts) -> torch.Tensor:
        samples = integrate(EmptyTracer(), light, points, counts, 0, samples=True).sum(2)[..., 0]
        blocks = samples.split([n for n in (counts.cosine, counts.ggx, counts.environment) if n], 1)
        return sum(block.var(1) * block.shape[1] for block in blocks)

    single = torch.stack([noise(Counts(*c)) for c in ((1000, 0, 0), (0, 1000, 0), (0, 0, 1000))])
    mean = integrate_quadrature(EmptyTracer(), light, points, 256).sum(1)[:, 0]
    together = noise(Counts(1000, 1000, 1000))
    assert (together <= single.min(0).values + (1 / 1000 - 1 / 3000) * mean**2).all()
    assert (together < 0.2 * single.max(0).values).all()


def test_a_wall_hides_its_view_factor():
    """A long wall of height 1 hides (1 - d / sqrt(d^2 + 1)) / 2 of the cosine hemisphere at the distance d."""
    distance = torch.tensor([0.2, 0.5, 2.0], dtype=F64)
    points = points_up((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    points.origin = torch.stack([torch.zeros(3, dtype=F64), distance, torch.full((3,), 1e-6, dtype=F64)], -1)
    seen = 1 - (1 - distance / torch.sqrt(distance**2 + 1)) / 2
    result = integrate_quadrature(quads(WALL), WHITE, points, 192, "paper")
    torch.testing.assert_close(result[:, 0, 0], 0.8 * seen, rtol=0, atol=2e-3)


def test_white_surfaces_in_white_light_vanish():
    """Nothing is absorbed: with enough bounces every point of a white corner is as bright as the light."""
    points = points_up((1.0,), (0.0,), (1.0, 1.0, 1.0))
    points.origin = torch.tensor([[0.0, 0.1, 1e-5]], dtype=F64)
    brightness = []
    for bounces in (0, 1, 6):
        samples = integrate(
            quads(FLOOR, WALL, albedo=1.0), WHITE, points, Counts(4000, 0, 0), bounces, "paper", samples=True
        )
        diffuse = samples[0, :, 0, 0] + samples[0, :, 1, 0]
        brightness.append((float(diffuse.sum()), float((diffuse.var() * len(diffuse)).sqrt())))
    # Secondary points also have the dielectric gloss of the paper's look, which adds at most a few per cent.
    assert brightness[0][0] == pytest.approx(1 - (1 - 0.1 / math.sqrt(1.01)) / 2, abs=4 * brightness[0][1])
    assert brightness[0][0] < brightness[1][0] < brightness[2][0]
    assert 0.97 < brightness[2][0] < 1.06


@pytest.mark.parametrize("shading_model", brdf.SHADING_MODELS)
def test_indirect_light_agrees_with_quadrature(shading_model: str):
    light, points = random_light(3, 4), points_up(metallic=(0.0, 0.6, 0.3))
    points.origin = torch.tensor([[0.1, 0.3, 1e-4], [0.5, 0.6, 1e-4], [0.3, 0.2, 1e-4]], dtype=F64)
    wall = quads([(-2, 0, 0), (2, 0, 0), (2, 0, 3), (-2, 0, 3)], albedo=0.7)
    truth = integrate_quadrature(wall, light, points, 64, shading_model, bounces=1)
    generator = torch.Generator().manual_seed(9)
    samples = integrate(wall, light, points, Counts(6000, 3000, 3000), 1, shading_model, generator, samples=True)
    assert (truth[:, 1] > 0.01).all()
    # The coarse grid of the second surface leaves 1 % of the truth as its own error.
    error = (samples.var(1) * samples.shape[1]).sqrt()
    assert ((samples.sum(1) - truth).abs() <= 4 * error + 0.01 * truth).all()


def test_rays_find_the_nearest_triangle_and_its_materials():
    tracer = quads([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)])
    tracer.albedo = torch.linspace(0, 1, 24, dtype=F64).reshape(8, 3)
    origin = torch.tensor([[0.5, 0.0, 5], [0.5, 0.0, 0.5], [0.5, 0.0, 5], [3.0, 0.0, 5]], dtype=F64)
    direction = torch.tensor([[0, 0, -1], [0, 0, -1], [0, 0, 1], [0, 0, -1]], dtype=F64)
    hit, points = tracer.closest(origin, direction)
    assert hit.tolist() == [True, True, False, False]
    torch.testing.assert_close(points.origin[:, 2], torch.tensor([1 + 1e-5, 1e-5], dtype=F64))
    assert (points.normal[:, 2] == 1).all()
    upper = tracer.albedo[4:]
    # (0.5, 0) lies in the first triangle (corners 0, 1, 2) with the weights (1/4, 1/4, 1/2).
    torch.testing.assert_close(points.albedo[0], upper[0] / 4 + upper[1] / 4 + upper[2] / 2)
    hit, below = tracer.closest(origin[:1] * -1, -direction[:1])
    assert hit.all() and (below.normal[:, 2] == -1).all() and below.origin[0, 2] < 0


def test_gradients_by_differences_of_the_quadrature():
    points, light = points_up((0.4,), (0.4,)), random_light(2, 4)

    def lit(albedo, roughness, metallic, image):
        p = SurfacePoints(
            points.origin, points.normal, points.geometric_normal, points.view, albedo, roughness, metallic
        )
        world = Light(image, light.rotation, light.colour)
        return integrate_quadrature(EmptyTracer(), world, p, 16)

    inputs = (points.albedo, points.roughness, points.metallic, light.image.clone())
    assert torch.autograd.gradcheck(lit, tuple(x.requires_grad_() for x in inputs), fast_mode=True)


def test_gradient_of_the_estimate_is_an_estimate_of_the_gradient():
    """Directions are drawn without gradient, so d(estimate)/d(roughness) must be unbiased."""
    light = random_light(4)
    roughness = torch.tensor([0.5], dtype=F64, requires_grad=True)
    points = points_up((0.5,), (0.7,))
    points.roughness = roughness
    truth = integrate_quadrature(EmptyTracer(), light, points, 192).sum()
    (expected,) = torch.autograd.grad(truth, roughness)
    generator, drawn = torch.Generator().manual_seed(1), []
    for _ in range(60):
        estimate = integrate(EmptyTracer(), light, points, Counts(400, 400, 400), 0, generator=generator).sum()
        drawn.append(torch.autograd.grad(estimate, roughness)[0])
    drawn = torch.cat(drawn)
    assert (drawn.mean() - expected).abs() < 4 * drawn.std() / math.sqrt(len(drawn))
    assert drawn.std() / math.sqrt(len(drawn)) < 0.1 * expected.abs()


def test_gradients_reach_the_materials_that_rays_meet():
    """Directions do not depend on colour, so with one seed the estimate is a polynomial of it."""
    points = points_up((0.6,), (0.2,))
    points.origin = torch.tensor([[0.1, 0.3, 1e-4]], dtype=F64)
    wall = quads([(-2, 0, 0), (2, 0, 0), (2, 0, 3), (-2, 0, 3)])
    light = random_light(6, 4)

    def lit(vertex_albedo):
        wall.albedo = vertex_albedo
        generator = torch.Generator().manual_seed(4)
        return integrate(wall, light, points, Counts(20, 10, 10), 2, generator=generator)

    albedo = torch.rand(4, 3, dtype=F64, generator=torch.Generator().manual_seed(7), requires_grad=True)
    assert lit(albedo)[0, 1].min() > 0
    assert torch.autograd.gradcheck(lit, (albedo,))


def test_single_precision_is_precise_enough():
    wall, light, points = quads(WALL), random_light(1), points_up()
    points.origin = torch.tensor([[0.1, 0.3, 1e-3]], dtype=F64).expand(3, 3)
    truth = integrate_quadrature(wall, light, points, 64)

    rows = SurfacePoints(**{name: values.float() for name, values in vars(points).items()})
    sky = Light(light.image.float(), light.rotation.float(), light.colour.float())
    small = quads(WALL, dtype=torch.float32)
    found = integrate_quadrature(small, sky, rows, 64)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), truth, rtol=1e-3, atol=1e-5)
    assert integrate(small, sky, rows, Counts(2, 2, 2), 1).isfinite().all()
