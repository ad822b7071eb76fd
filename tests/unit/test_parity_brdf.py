"""Compiled BRDFs, samplers and light against the torch reference: two programs, one physics."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.compute.jit import njit  # noqa: E402
from drgs_blender.core.frame import World  # noqa: E402
from drgs_blender.render import sampling as kernel_sampling  # noqa: E402
from drgs_blender.render.integrator import brdf as kernel  # noqa: E402
from drgs_blender.render.lights.environment import EnvironmentLight  # noqa: E402
from drgs_blender.render.reference import brdf, sampling  # noqa: E402
from drgs_blender.render.reference.light import Light  # noqa: E402

torch.set_num_threads(1)
F64 = torch.float64
COUNT = 4000


@njit
def _evaluate_many(cosines, albedo, roughness, metallic, shading_model, table, out):
    """Rows of `cosines`: n.l, n.v, v.l, (n.h)^2, sin^2 of n and h."""
    for i in range(len(out)):
        nl, nv, vl, nh2, sin2 = cosines[i]
        angles = nl, nv, vl, nh2, sin2
        a2 = kernel.alpha_squared(roughness[i])
        kd = kernel.diffuse_weight(roughness[i], metallic[i], nv, shading_model, table)
        _, norm = kernel.vndf_terms(nv, a2)
        r, g, b = albedo[i]
        metal = metallic[i], metallic[i], metallic[i]
        weights = kd, metal, np.float32(1) - metallic[i]
        values = kernel.evaluate(angles, (r, g, b), weights, a2, norm, shading_model)
        for k in range(7):
            out[i, k] = values[k]


@njit
def _sample_many(u, view, alpha, out):
    for i in range(len(u)):
        bound, _ = kernel.vndf_terms(view[i, 2], alpha[i] * alpha[i])
        out[i, 0], out[i, 1], out[i, 2] = kernel.sample_vndf(
            u[i, 0], u[i, 1], view[i, 0], view[i, 1], view[i, 2], alpha[i], bound
        )


@njit
def _cosine_many(u, out):
    for i in range(len(u)):
        out[i, 0], out[i, 1], out[i, 2] = kernel_sampling.cosine_hemisphere(u[i, 0], u[i, 1])


def situations(seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Normal, view, light (a third near the mirror direction), albedo, roughness, metallic; all above the surface."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, dtype=F64, generator=generator)

    normal = brdf.normalise(torch.randn(COUNT, 3, dtype=F64, generator=generator))
    view, light = (sampling.sample_cosine(normal, uniform(COUNT, 2)) for _ in range(2))
    roughness = uniform(COUNT)
    narrow = torch.arange(COUNT) % 3 == 0
    mirrored = sampling.sample_ggx(normal, view, brdf.alpha_of(roughness), uniform(COUNT, 2))
    light = torch.where((narrow & (brdf.dot(normal, mirrored) > 0.01)).unsqueeze(-1), mirrored, light)
    return normal, view, light, uniform(COUNT, 3), roughness, uniform(COUNT)


def kernel_values(situation: tuple[torch.Tensor, ...], shading_model: str, table: np.ndarray) -> torch.Tensor:
    """(n, 7): diffuse and glossy value times the cosine, density."""
    normal, view, light, albedo, roughness, metallic = situation
    half = brdf.normalise(view + light)
    cosines = [brdf.dot(normal, light), brdf.dot(normal, view), brdf.dot(view, light), brdf.dot(normal, half) ** 2]
    cosines.append((torch.linalg.cross(normal, half) ** 2).sum(-1))
    single = [x.numpy().astype(np.float32) for x in (torch.stack(cosines, -1), albedo, roughness, metallic)]
    out = np.empty((len(normal), 7), np.float32)
    _evaluate_many(*single, kernel.SHADING_MODELS[shading_model], table.astype(np.float32), out)
    out[:, :6] *= single[0][:, :1]
    return torch.from_numpy(out).double()


@pytest.mark.parametrize("shading_model", brdf.SHADING_MODELS)
def test_brdf_values_and_the_density_of_visible_normals(shading_model: str):
    situation = situations()
    normal, view, light, *_, roughness, _ = situation
    table = brdf.F0 + (1 - brdf.F0) * brdf.layer_table()
    found = kernel_values(situation, shading_model, table)
    diffuse, glossy = brdf.evaluate(*situation, shading_model)
    density = sampling.pdf_ggx(normal, view, light, brdf.alpha_of(roughness), bounded=True)
    expected = torch.cat([diffuse, glossy, density.unsqueeze(-1)], -1)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-9)


def test_both_tables_of_the_dielectric_layer_agree():
    """Each is integrated in its own way; 1e-3 of the reflectance changes the diffuse light by a thousandth."""
    reference = brdf.F0 + (1 - brdf.F0) * brdf.layer_table()
    np.testing.assert_allclose(kernel.layer_table(), reference, rtol=0, atol=1e-3)


def test_directions_of_visible_normals_and_of_the_cosine():
    generator = torch.Generator().manual_seed(4)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(COUNT, 3)
    u = torch.rand(COUNT, 2, dtype=F64, generator=generator).float().double()
    view = sampling.sample_cosine(up, torch.rand(COUNT, 2, dtype=F64, generator=generator)).float().double()
    view = brdf.normalise(view)
    alpha = brdf.alpha_of(torch.rand(COUNT, dtype=F64, generator=generator)).float().double()
    out = np.empty((COUNT, 3), np.float32)
    _sample_many(*(x.numpy().astype(np.float32) for x in (u, view, alpha)), out)
    expected = sampling.sample_ggx(up, view, alpha, u, bounded=True)
    np.testing.assert_allclose(out, expected, rtol=0, atol=2e-4)
    _cosine_many(u.numpy().astype(np.float32), out)
    # The kernel takes its two numbers in the other order.
    np.testing.assert_allclose(out, sampling.sample_cosine(up, u.flip(-1)), rtol=0, atol=1e-5)


def worlds() -> dict[str, World]:
    values = np.random.default_rng(5).random((24, 48, 3)).astype(np.float32) ** 4
    values[5, 11] = 80.0
    values[12:16] = 0.0
    angle = math.radians(70)
    spin = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    tilt = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    return {
        "plain": World(environment=values),
        "turned": World(environment=values, rotation=spin, colour=(1.0, 0.5, 0.2), strength=3.0),
        "tilted": World(environment=values[:9, :17], rotation=tilt * np.sign(np.linalg.det(tilt))),
        "constant": World(colour=(0.2, 0.4, 0.8), strength=2.0),
    }


@pytest.mark.parametrize("name", worlds())
def test_light_and_its_density(name: str):
    world = worlds()[name]
    fast, slow = EnvironmentLight(world), Light.from_world(world)
    directions = brdf.normalise(torch.randn(20000, 3, dtype=F64, generator=torch.Generator().manual_seed(6)))
    directions = brdf.normalise(directions.float()).double()
    # acos in float32 is off by up to 3.5e-4 radians at the very poles; the rest is exact to rounding.
    directions = directions[(directions @ slow.rotation.T)[:, 2].abs() < 0.9998]
    radiance, density = slow.radiance(directions).numpy(), slow.pdf(directions).numpy()
    np.testing.assert_allclose(fast.lookup(directions.numpy()), radiance, rtol=0, atol=1e-4 * radiance.max())
    # Beside the sun the density grows by its whole height within a cell: places are exact to a few 1e-6 of one.
    np.testing.assert_allclose(fast.pdf(directions.numpy()), density, rtol=1e-4, atol=2e-5 * density.max())


@pytest.mark.parametrize("name", worlds())
def test_light_is_drawn_with_the_density_it_reports(name: str):
    """Directions of the kernel, judged by the reference: same density, and moments of uniform weights agree."""
    world = worlds()[name]
    fast, slow = EnvironmentLight(world), Light.from_world(world)
    numbers = np.random.default_rng(2).integers(0, 2**32, (60000, 4), dtype=np.uint32)
    drawn, reported = fast.sample(numbers)
    directions = brdf.normalise(torch.from_numpy(drawn).double())
    assert np.isclose(reported, slow.pdf(directions).numpy(), rtol=1e-3).mean() > 0.999
    # Mean of L / p estimates the light's integral over the sphere, that of d L / p its first moment.
    value = slow.radiance(directions)[:, 1].numpy() / reported
    parts = np.concatenate([value[:, None], value[:, None] * directions.numpy()], 1)
    reference = slow.sample(torch.rand(60000, 3, dtype=F64, generator=torch.Generator().manual_seed(3)))
    other = (slow.radiance(reference)[:, 1] / slow.pdf(reference)).numpy()
    others = np.concatenate([other[:, None], other[:, None] * reference.numpy()], 1)
    error = np.sqrt((parts.var(0) + others.var(0)) / 60000)
    assert (np.abs(parts.mean(0) - others.mean(0)) <= 4.5 * error + 1e-5).all()
