"""The torch BRDFs: closed forms, energy, reciprocity, the published table of Cycles, gradients."""

from __future__ import annotations

import math

import pytest

torch = pytest.importorskip("torch")

from drgs_blender.render.reference import brdf, sampling  # noqa: E402

torch.set_num_threads(1)
F64 = torch.float64
UP = torch.tensor([0.0, 0.0, 1.0], dtype=F64)


def view_at(cosine: float) -> torch.Tensor:
    return torch.tensor([math.sqrt(1 - cosine * cosine), 0.0, cosine], dtype=F64)


def scalar(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=F64)


def hemisphere(view: torch.Tensor, roughness: float, rows: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    """Light directions and solid angles, the midpoint rule in polar coordinates about the mirror direction.

    The polar angle is spaced by the cube of its index: cells are small where a narrow lobe peaks.
    """
    mirror = torch.tensor([-view[0], -view[1], view[2]], dtype=F64)
    edges = math.pi * torch.linspace(0, 1, rows + 1, dtype=F64) ** (3 if roughness < 0.9 else 1)
    centres = (edges[:-1] + edges[1:]) / 2
    phi = (torch.arange(rows, dtype=F64) + 0.5) / rows * 2 * math.pi
    sine, cosine = torch.sin(centres)[:, None], torch.cos(centres)[:, None].expand(rows, rows)
    local = torch.stack([sine * torch.cos(phi), sine * torch.sin(phi), cosine], -1)
    solid = ((torch.cos(edges[:-1]) - torch.cos(edges[1:]))[:, None] * 2 * math.pi / rows).expand(rows, rows)
    return sampling.to_world(local.reshape(-1, 3), mirror), solid.reshape(-1)


def mirror_albedo(cosine: float, roughness: float) -> float:
    """Directional albedo of the GGX lobe with Fresnel 1, integrated over light directions."""
    view = view_at(cosine)
    light, solid = hemisphere(view, roughness)
    white = torch.ones(3, dtype=F64)
    _, glossy = brdf.evaluate(UP, view, light, white, scalar(roughness), scalar(1.0), "paper")
    return float((glossy[:, 0] * solid).sum())


def test_smooth_dielectric_reflects_as_fresnel_said():
    cosine = torch.tensor([1.0, 1 / math.sqrt(1 + 1.5**2), 0.0], dtype=F64)
    # At Brewster's angle only the perpendicular part is left: ((n^2 - 1) / (n^2 + 1))^2 / 2.
    expected = torch.tensor([0.04, 0.5 * (1.25 / 3.25) ** 2, 1.0], dtype=F64)
    torch.testing.assert_close(brdf.fresnel_dielectric(cosine), expected, rtol=0, atol=1e-12)


def test_roughest_ggx_at_normal_incidence_reflects_one_minus_log_two():
    # alpha = 1: D = 1 / pi and G2 = 2 c / (1 + c), so E = int_0^1 c / (1 + c) dc.
    assert mirror_albedo(1.0, 1.0) == pytest.approx(1 - math.log(2), abs=1e-5)


@pytest.mark.parametrize("roughness", [0.05, 0.13, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.3])
def test_directional_albedo_computed_two_ways(cosine: float, roughness: float):
    """Over light directions, and as the mean of G2 / G1 over visible normals."""
    view, alpha = view_at(cosine), brdf.alpha_of(scalar(roughness))
    u = (torch.arange(400, dtype=F64) + 0.5) / 400
    light = sampling.sample_ggx(UP, view, alpha, torch.cartesian_prod(u, u))
    cos_light = light[:, 2]
    root_view, root_light = brdf.smith_root(scalar(cosine), alpha), brdf.smith_root(cos_light, alpha)
    lambda_view = (root_view / cosine - 1) / 2
    lambda_light = (root_light / cos_light - 1) / 2
    ratio = torch.where(
        cos_light > 0, (1 + lambda_view) / (1 + lambda_view + lambda_light), torch.zeros_like(cos_light)
    )
    assert mirror_albedo(cosine, roughness) == pytest.approx(float(ratio.mean()), abs=6e-4)


def test_a_narrow_lobe_keeps_its_energy():
    """Below roughness 0.13 clamped denominators lose the lobe; here it reflects (nearly) all."""
    assert mirror_albedo(0.8, 0.05) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("shading_model", brdf.SHADING_MODELS)
@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.2])
def test_white_furnace(shading_model: str, cosine: float):
    view, white = view_at(cosine), torch.ones(3, dtype=F64)
    for roughness in (0.2, 0.5, 1.0):
        light, solid = hemisphere(view, roughness)
        for metallic in (0.0, 0.4, 1.0):
            parts = brdf.evaluate(UP, view, light, white, scalar(roughness), scalar(metallic), shading_model)
            diffuse, glossy = (float((part[:, 0] * solid).sum()) for part in parts)
            weight = 1 - metallic
            if shading_model == "principled":
                weight *= 1 - float(brdf.layer_albedo(scalar(cosine), scalar(roughness)))
                assert diffuse + glossy <= 1.0
            assert diffuse == pytest.approx(weight, abs=1e-4)  # error of the midpoint rule: 4e-5
            assert glossy <= 1.0


# Blender's own table, interpolated at IOR 1.5 (rows: roughness; columns: cosine 1, 0.7, 0.4, 0.1).
CYCLES_BLEND = {
    0.0: (0.0000, 0.0117, 0.0955, 0.5628),
    0.25: (0.0001, 0.0126, 0.0927, 0.4092),
    0.5: (0.0006, 0.0138, 0.0639, 0.1705),
    1.0: (0.0014, 0.0058, 0.0161, 0.0403),
}


@pytest.mark.parametrize("roughness", CYCLES_BLEND)
def test_layer_albedo_is_that_of_cycles(roughness: float):
    cosine = torch.tensor([1.0, 0.7, 0.4, 0.1], dtype=F64)
    blend = (brdf.layer_albedo(cosine, scalar(roughness)) - brdf.F0) / (1 - brdf.F0)
    torch.testing.assert_close(blend, torch.tensor(CYCLES_BLEND[roughness], dtype=F64), rtol=0, atol=1.5e-4)


def random_unit(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    return brdf.normalise(torch.randn(*shape, 3, dtype=F64, generator=torch.Generator().manual_seed(seed)))


def test_the_paper_brdf_is_reciprocal():
    generator = torch.Generator().manual_seed(3)
    normal = random_unit((500,), 0)
    view, light = random_unit((500,), 1), random_unit((500,), 2)
    view = view * torch.sign(brdf.dot(view, normal)).unsqueeze(-1)
    light = light * torch.sign(brdf.dot(light, normal)).unsqueeze(-1)
    albedo = torch.rand(500, 3, dtype=F64, generator=generator)
    roughness, metallic = torch.rand(2, 500, dtype=F64, generator=generator)
    for part, swapped in zip(
        brdf.evaluate(normal, view, light, albedo, roughness, metallic, "paper"),
        brdf.evaluate(normal, light, view, albedo, roughness, metallic, "paper"),
        strict=True,
    ):
        there = part / brdf.dot(normal, light).unsqueeze(-1)
        back = swapped / brdf.dot(normal, view).unsqueeze(-1)
        torch.testing.assert_close(there, back, rtol=1e-9, atol=0)


@pytest.mark.parametrize("shading_model", brdf.SHADING_MODELS)
def test_below_the_surface_is_black_and_without_nan(shading_model: str):
    view, light = random_unit((200,), 4).requires_grad_(), random_unit((200,), 5).requires_grad_()
    roughness = torch.full((200,), 0.3, dtype=F64, requires_grad=True)
    half = torch.full((200,), 0.5, dtype=F64)
    parts = brdf.evaluate(UP, view, light, torch.full((200, 3), 0.5, dtype=F64), roughness, half, shading_model)
    value = torch.cat(parts, 1)
    unlit, unseen = light[:, 2] <= 0, view[:, 2] <= 0
    assert unlit.any() and unseen.any() and (~unlit & ~unseen).any()
    assert (value[unlit] == 0).all() and (value[~unlit & ~unseen] > 0).all()
    assert (parts[1][unseen] == 0).all()  # a diffuse surface is lit whether its smooth normal faces the viewer or not
    value.sum().backward()
    assert all(torch.isfinite(x.grad).all() for x in (view, light, roughness))


@pytest.mark.parametrize("shading_model", brdf.SHADING_MODELS)
def test_gradients(shading_model: str):
    def unit_parts(normal, view, light, albedo, roughness, metallic):
        normal, view, light = (brdf.normalise(x) for x in (normal, view, light))
        return brdf.evaluate(normal, view, light, albedo, roughness, metallic, shading_model)

    inputs = (
        torch.tensor([[0.1, -0.2, 1.0], [0.0, 0.3, 0.9]], dtype=F64),
        torch.tensor([[0.5, 0.1, 0.8], [-0.3, 0.3, 0.4]], dtype=F64),
        torch.tensor([[-0.4, 0.2, 0.6], [0.6, 0.3, 0.7]], dtype=F64),
        torch.tensor([[0.8, 0.4, 0.1], [0.3, 0.5, 0.9]], dtype=F64),
        torch.tensor([0.23, 0.71], dtype=F64),
        torch.tensor([0.15, 0.85], dtype=F64),
    )
    assert torch.autograd.gradcheck(unit_parts, tuple(x.requires_grad_() for x in inputs))
