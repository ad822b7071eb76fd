"""The torch samplers and the light: densities integrate to one, histograms follow densities, lookups are Blender's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

torch = pytest.importorskip("torch")

from drgs_blender.core.frame import World  # noqa: E402
from drgs_blender.render.reference import brdf, sampling  # noqa: E402
from drgs_blender.render.reference.light import Light, directions_of  # noqa: E402

torch.set_num_threads(1)
F64 = torch.float64
NORMAL = brdf.normalise(torch.tensor([0.3, -0.5, 0.7], dtype=F64))
VIEW = brdf.normalise(torch.tensor([-0.6, 0.1, 0.6], dtype=F64))


def spin(degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def picture(height: int = 8, width: int = 16) -> np.ndarray:
    """Random light with a bright texel and a black band."""
    values = np.random.default_rng(7).random((height, width, 3)).astype(np.float32)
    values[height // 4, width // 3] = 60.0
    values[height // 2 : height // 2 + 2] = 0.0
    return values


LIGHT = Light.from_world(World(environment=picture(), rotation=spin(35), colour=(1.0, 0.5, 0.25), strength=2.0))

STRATEGIES = {
    "cosine": (lambda d: sampling.pdf_cosine(NORMAL, d), lambda u: sampling.sample_cosine(NORMAL, u[:, :2])),
    **{
        f"ggx {r}": (
            lambda d, a=r**2: sampling.pdf_ggx(NORMAL, VIEW, d, torch.tensor(a, dtype=F64)),
            lambda u, a=r**2: sampling.sample_ggx(NORMAL, VIEW, torch.tensor(a, dtype=F64), u[:, :2]),
        )
        for r in (0.3, 0.6, 1.0)
    },
    "environment": (LIGHT.pdf, LIGHT.sample),
}


def sphere(rows: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions (rows, 2 rows, 3) in the frame of the light's picture, and solid angles of the rows."""
    v, u = (torch.arange(rows, dtype=F64) + 0.5) / rows, (torch.arange(2 * rows, dtype=F64) + 0.5) / (2 * rows)
    edges = torch.cos(torch.linspace(0, math.pi, rows + 1, dtype=F64))
    grid = directions_of(*torch.meshgrid(u, v, indexing="xy")) @ LIGHT.rotation
    return grid, ((edges[:-1] - edges[1:]) * math.pi / rows)[:, None]


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_the_bounded_cap_wastes_less_and_has_the_density_it_says(roughness: float):
    """Its density is the unbounded one times a constant: the share of draws that end above the surface says so."""
    u = torch.rand(200_000, 2, dtype=F64, generator=torch.Generator().manual_seed(8))
    alpha = torch.tensor(roughness**2, dtype=F64)
    whole = sampling.sample_ggx(NORMAL, VIEW, alpha, u)
    above = [(d @ NORMAL > 0).double().mean() for d in (whole, sampling.sample_ggx(NORMAL, VIEW, alpha, u, True))]
    light = whole[whole @ NORMAL > 0][:100]
    ratio = sampling.pdf_ggx(NORMAL, VIEW, light, alpha, True) / sampling.pdf_ggx(NORMAL, VIEW, light, alpha)
    torch.testing.assert_close(ratio, ratio[:1].expand(100))
    error = (above[0] * (1 - above[0]) / len(u)).sqrt() / above[0]
    assert ratio[0] >= 1
    assert float(above[1] / above[0]) == pytest.approx(float(ratio[0]), abs=float(6 * error * ratio[0]))


@pytest.mark.parametrize("name", STRATEGIES)
def test_density_integrates_to_one(name: str):
    grid, solid = sphere(384)
    total = float((STRATEGIES[name][0](grid) * solid).sum())
    assert total == pytest.approx(1.0, abs=3e-4)


@pytest.mark.parametrize("name", STRATEGIES)
def test_histogram_follows_the_density(name: str):
    """Pearson's test over 16 x 32 cells of the sphere."""
    density, sample = STRATEGIES[name]
    count, rows, cell = 100_000, 384, 24
    grid, solid = sphere(rows)
    expected = (density(grid) * solid).reshape(rows // cell, cell, 2 * rows // cell, cell).sum((1, 3)).numpy() * count
    drawn = sample(torch.rand(count, 3, dtype=F64, generator=torch.Generator().manual_seed(11)))
    torch.testing.assert_close(torch.linalg.vector_norm(drawn, dim=-1), torch.ones(count, dtype=F64))
    local = (drawn @ LIGHT.rotation.T).numpy()
    v = np.arccos(np.clip(local[:, 2], -1, 1)) / math.pi
    u = 0.5 - np.arctan2(local[:, 1], local[:, 0]) / (2 * math.pi)
    observed, *_ = np.histogram2d(v, u, bins=(rows // cell, 2 * rows // cell), range=((0, 1), (0, 1)))
    keep = expected > 10
    rest = [observed[~keep].sum()], [expected[~keep].sum()]
    observed, expected = np.append(observed[keep], rest[0]), np.append(expected[keep], rest[1])
    chi2 = ((observed - expected) ** 2 / np.maximum(expected, 1)).sum()
    assert stats.chi2.sf(chi2, len(observed) - 1) > 1e-3


def test_the_frame_is_orthonormal_everywhere():
    axes = torch.tensor([[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]], dtype=F64)
    random = torch.randn(200, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    normal = torch.cat([axes, brdf.normalise(random)])
    frame = torch.stack([*sampling.basis(normal), normal], -1)
    torch.testing.assert_close(frame.mT @ frame, torch.eye(3, dtype=F64).expand(204, 3, 3))
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones(204, dtype=F64))
    torch.testing.assert_close(sampling.to_local(sampling.to_world(frame[..., 0], normal), normal), frame[..., 0])


def test_lookup_follows_the_mapping_of_blender():
    """Row 0 is at +Z, +X in the centre, +Y a quarter to the left; the rotation turns the looked-up vector."""
    image = np.zeros((64, 128, 3), dtype=np.float32)
    image[..., 0] = np.linspace(1, 0, 64)[:, None]  # height
    image[..., 1] = np.arange(128)[None, :]  # column
    axes = torch.tensor([[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=F64)
    plain = Light.from_world(World(environment=image)).radiance(axes)
    assert plain[0, 0] == 1 and plain[1, 0] == 0
    torch.testing.assert_close(plain[2:, 1], torch.tensor([63.5, 31.5, 95.5], dtype=F64), rtol=0, atol=1e-6)
    turned = Light.from_world(World(environment=image, rotation=spin(90))).radiance(axes)
    torch.testing.assert_close(turned[2, 1], plain[3, 1])


def test_colour_and_strength_scale_light():
    direction = brdf.normalise(torch.randn(20, 3, dtype=F64, generator=torch.Generator().manual_seed(5)))
    grey = Light.from_world(World(colour=(0.5, 1.0, 2.0), strength=3.0))
    torch.testing.assert_close(grey.radiance(direction), torch.tensor([[1.5, 3.0, 6.0]], dtype=F64).expand(20, 3))
    torch.testing.assert_close(grey.pdf(direction), torch.full((20,), 1 / (4 * math.pi), dtype=F64))


def test_light_is_drawn_wherever_there_is_light():
    grid, _ = sphere(96)
    lit = LIGHT.radiance(grid).sum(-1) > 0
    assert (LIGHT.pdf(grid)[lit] > 0).all()


def test_a_black_world_is_no_accident():
    black = Light.from_world(World(environment=np.zeros((4, 8, 3), dtype=np.float32)))
    drawn = black.sample(torch.rand(50, 3, dtype=F64, generator=torch.Generator().manual_seed(1)))
    torch.testing.assert_close(black.pdf(drawn), torch.full((50,), 1 / (4 * math.pi), dtype=F64))
    assert (black.radiance(drawn) == 0).all()


def test_radiance_gradient_reaches_the_picture():
    image = torch.rand(3, 5, 3, dtype=F64, generator=torch.Generator().manual_seed(2), requires_grad=True)
    direction = brdf.normalise(torch.randn(6, 3, dtype=F64, generator=torch.Generator().manual_seed(3)))
    eye, colour = torch.eye(3, dtype=F64), torch.ones(3, dtype=F64)
    assert torch.autograd.gradcheck(lambda i: Light(i, eye, colour).radiance(direction), (image,))
