"""Decoupling: its estimator against the reference and the renderer, its losses, and materials found again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from shapes import plain_mesh

torch = pytest.importorskip("torch")

from drgs_blender.core.asset import Mesh  # noqa: E402
from drgs_blender.core.asset.model import PosedSurfels  # noqa: E402
from drgs_blender.core.color import linear_to_srgb, srgb_to_linear  # noqa: E402
from drgs_blender.core.errors import Cancelled, UsageError  # noqa: E402
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World  # noqa: E402
from drgs_blender.formats.harmonics import SH_C0  # noqa: E402
from drgs_blender.geometry.normals import VertexNormals, unit  # noqa: E402
from drgs_blender.reconstruct.capture.capture import Capture, View  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.decoupled import Decoupled, Progress  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.domain import mesh_domain  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.environment import LearnedLight, colour_cast  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.estimator import Points  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.gatherer import Gatherer  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.losses import (  # noqa: E402
    log_loss,
    metal_albedo_prior,
    metal_smoothness_prior,
    unbiased_loss,
)
from drgs_blender.reconstruct.inverse_rendering.materials import Materials, from_specular  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.pixels import pixels_of  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.radiance_cache import edges_of, radiance_cache  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.regularisers import Regularisers, fineness  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.run import _gain, decouple  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.settings import Settings  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.surface import SurfaceSamples  # noqa: E402
from drgs_blender.render.integrator.integrate import integrate as kernel_integrate  # noqa: E402
from drgs_blender.render.lights.environment import EnvironmentLight  # noqa: E402
from drgs_blender.render.pipeline import render  # noqa: E402
from drgs_blender.render.prepared_scene import PreparedScene  # noqa: E402
from drgs_blender.render.reference.integrate import EmptyTracer, SurfacePoints, integrate_quadrature  # noqa: E402
from drgs_blender.render.reference.light import Light  # noqa: E402
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene  # noqa: E402
from drgs_blender.render.scene.triangle_bvh import TriangleBVH  # noqa: E402
from drgs_blender.render.shading_points import ShadingPoints  # noqa: E402

torch.set_num_threads(1)

#: Roughness (n,), and views of a floor at z = 0: cosines from steep to grazing.
ROUGHNESS = np.array([0.15, 0.3, 0.6, 0.9], np.float32)
ALPHA2 = (ROUGHNESS**4).astype(np.float32)
#: `Points.turn` of light that stands still in the world.
STILL = np.empty((0, 3, 3), np.float32)


def sky(rows: int = 16) -> np.ndarray:
    """A coloured gradient with a light."""
    image = np.random.default_rng(3).uniform(0.2, 1.0, (rows, 2 * rows, 3)).astype(np.float32)
    image[rows // 4, rows // 2] = 12.0
    return image


def gatherer(mesh: Mesh, samples: int, normals: bool = False, cache: np.ndarray | None = None) -> Gatherer:
    tree = TriangleBVH()
    tree.build(mesh.vertices, mesh.faces)
    return Gatherer(mesh, tree, cache, (samples // 2, samples // 4, samples // 4), normals)


def floor_points(count: int = len(ROUGHNESS)) -> tuple[Mesh, Points, np.ndarray]:
    """A face far below, points above it that look up, and their normals."""
    mesh = plain_mesh(np.array([[0, 0, -9], [1, 0, -9], [0, 1, -9.0]]), np.array([[0, 1, 2]]))
    up = np.tile(np.float32([0, 0, 1]), (count, 1))
    cosine = np.linspace(0.9, 0.35, count)
    towards = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], -1).astype(np.float32)
    return mesh, Points(0 * up, up, towards, np.arange(count, dtype=np.uint32) + 7, STILL), up


def quadrature(
    image: torch.Tensor, normal: torch.Tensor, view: torch.Tensor, values: torch.Tensor, shading_model: str
) -> object:
    """Radiance (n, 3) of points in the open, materials (n, 5), without chance."""
    points = SurfacePoints(
        torch.zeros(len(view), 3, dtype=torch.float64), normal, normal.detach(), view, values[:, :3], values[:, 3],
        values[:, 4],
    )  # fmt: skip
    light = Light(image, torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    return integrate_quadrature(EmptyTracer(), light, points, 128, shading_model).sum(1)


@pytest.mark.parametrize("shading_model", ["principled", "paper"])
def test_radiance_and_its_derivatives_match_the_reference(shading_model):
    """Value, and derivatives by roughness, normal and light, against a quadrature that torch differentiates."""
    mesh, points, up = floor_points()
    image = sky()
    columns = torch.tensor([[0.6, 0.4, 0.2, 0.0, 0.3]]).repeat(len(up), 1)
    materials = Materials(mesh.vertices, "metallic", 0)
    columns[:, 3] = (torch.from_numpy(ROUGHNESS) - 0.03) / 0.97
    columns.requires_grad_(True)
    normal = torch.from_numpy(up).clone().requires_grad_(True)
    radiance = torch.from_numpy(image).clone().requires_grad_(True)
    towards = torch.from_numpy(points.towards)
    draw = gatherer(mesh, 1 << 15, normals=True)
    unit = normal / normal.norm(dim=1, keepdim=True)
    roughness = materials.roughness(columns)
    sums = draw(points, unit, roughness**4, radiance)
    nv = (unit * towards).sum(1)
    ours = materials.reflect(columns, sums, nv, shading_model)
    assert ours[:, 0].detach().numpy() == pytest.approx(ours[:, 1].detach().numpy(), rel=0.03)  # independent halves
    total = ours.mean(1)

    wide = torch.from_numpy(image).double().clone().requires_grad_(True)
    n64 = torch.from_numpy(up).double().requires_grad_(True)
    values = columns.detach().double()
    values[:, 3] = roughness.detach().double()
    values.requires_grad_(True)
    true = quadrature(wide, n64 / n64.norm(dim=1, keepdim=True), towards.double(), values, shading_model)
    assert total.detach().numpy() == pytest.approx(true.detach().numpy(), rel=0.01)

    weight = torch.tensor([1.0, 0.5, 2.0])
    own = torch.autograd.grad((total * weight).sum(), [columns, normal, radiance])
    theirs = torch.autograd.grad((true * weight.double()).sum(), [values, n64, wide])
    assert own[0][:, [0, 1, 2, 4]].numpy() == pytest.approx(theirs[0][:, [0, 1, 2, 4]].numpy(), rel=0.02, abs=0.01)
    assert own[0][:, 3].numpy() / 0.97 == pytest.approx(theirs[0][:, 3].numpy(), rel=0.04, abs=0.02)
    scale = float(theirs[1].abs().max())
    assert own[1].numpy() == pytest.approx(theirs[1].numpy(), abs=0.03 * scale)
    # Texels are found by chance one by one; bands of them, averaged, are compared.
    bands = [g.double().reshape(4, 4, 4, 8, 3).sum((1, 3)) for g in (own[2], theirs[2])]
    assert bands[0].numpy() == pytest.approx(bands[1].numpy(), abs=0.02 * float(bands[1].abs().max()))


def test_derivative_by_radiance_is_that_of_a_finite_difference():
    """The estimate is linear in the radiance, whatever was drawn: the difference quotient is exact."""
    mesh, points, up = floor_points()
    draw, image = gatherer(mesh, 64), sky(8)
    draw.aim(image)
    weights = torch.from_numpy(np.random.default_rng(1).normal(size=(len(up), 2, 4, 3)).astype(np.float32))
    radiance = torch.from_numpy(image).requires_grad_(True)

    def value(image: torch.Tensor) -> torch.Tensor:
        return (draw(points, torch.from_numpy(up), torch.from_numpy(ALPHA2), image) * weights).sum()

    (slope,) = torch.autograd.grad(value(radiance), radiance)
    step = torch.from_numpy(np.random.default_rng(2).uniform(0, 1, image.shape).astype(np.float32))
    with torch.no_grad():
        quotient = (value(radiance + step) - value(radiance - step)) / 2
    assert float((slope * step).sum()) == pytest.approx(float(quotient), rel=1e-3)


def test_white_furnace():
    """Under light of one everywhere a white Lambert surface sends one, and no lobe sends more."""
    mesh, points, up = floor_points()
    sums = gatherer(mesh, 8192).run(points, up, ALPHA2, np.ones((8, 16, 3), np.float32))[0].mean(1)
    assert sums[:, 0] == pytest.approx(1.0, rel=0.01)
    mirror = sums[:, 1] + sums[:, 2]
    assert (mirror < 1.01).all() and mirror[0] == pytest.approx(1.0, abs=0.03)
    assert (sums[:, 3] < 0.3).all()


def test_shading_matches_the_renderer_where_the_mesh_shadows_itself():
    """A ball over a floor: visibility, both lobes and the light's table, against the engine's own integrator."""
    ball = trimesh.creation.icosphere(3, 1.0)
    low = np.array([[-6, -6, -1.1], [6, -6, -1.1], [6, 6, -1.1], [-6, 6, -1.1]])
    vertices = np.concatenate([ball.vertices, low]).astype(np.float32)
    n = len(ball.vertices)
    faces = np.concatenate([ball.faces, [[n, n + 1, n + 2], [n, n + 2, n + 3]]]).astype(np.int32)
    mesh, image = plain_mesh(vertices, faces), sky()
    rng = np.random.default_rng(4)
    origin = np.concatenate([rng.uniform(-1.5, 1.5, (24, 2)), np.full((24, 1), -1.1)], 1).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (24, 1))
    view = np.array([0, -4, 3]) - origin
    view = (view / np.linalg.norm(view, axis=1, keepdims=True)).astype(np.float32)
    albedo, roughness, metallic = np.full((24, 3), 0.6, np.float32), np.full(24, 0.4), np.full(24, 0.5)
    columns = torch.from_numpy(np.column_stack([albedo, (roughness - 0.03) / 0.97, metallic]).astype(np.float32))
    draw = gatherer(mesh, 4096)
    points = Points(origin, up, view, np.arange(24, dtype=np.uint32), STILL)
    sums = draw.run(points, up, (roughness**4).astype("f4"), image)[0]
    materials = Materials(mesh.vertices, "metallic", 0)
    ours = materials.reflect(columns, torch.from_numpy(sums), torch.from_numpy(view[:, 2]), "principled").mean(1)

    scene = TraceScene()
    scene.update([TraceObject("both", mesh.vertices, mesh.faces, mesh.albedo, mesh.roughness, mesh.metallic)], [], [])
    number, zero = np.arange(24, dtype=np.int32), np.zeros(24, np.int32)
    points = ShadingPoints(
        number, zero, np.ones(24, np.float32), origin, up, up, view, albedo, roughness.astype(np.float32),
        metallic.astype(np.float32), np.zeros(24, np.uint8), zero - 1, np.zeros(24, np.float32),
    )  # fmt: skip
    settings = RenderSettings(samples=4096, bounces=0, subpixel_samples=1)
    theirs = kernel_integrate(scene, EnvironmentLight(World(image)), points, settings, 1).components.sum(1)
    # Next to the contact, rays that start a little higher see a little less.
    assert ours.numpy() == pytest.approx(theirs, rel=0.03, abs=0.006)
    open_floor = gatherer(plain_mesh(low.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]])), 4096)
    alone = open_floor.run(
        Points(origin, up, view, np.arange(24, dtype=np.uint32), STILL), up, (roughness**4).astype("f4"), image
    )[0]
    assert (sums[:, :, 0].mean((1, 2)) < 0.97 * alone[:, :, 0].mean((1, 2))).any()  # the ball does shadow


@pytest.mark.parametrize("weight_by_prediction", (False, True))
def test_only_the_unbiased_loss_leaves_noise_alone(weight_by_prediction: bool):
    """Two noisy estimates with the true mean: its slope is zero there, that of the common loss pulls."""
    generator = torch.Generator().manual_seed(5)
    photographed, none = torch.full((40000, 3), 0.3), torch.zeros(40000, 3, dtype=torch.bool)
    factor = torch.ones(1, requires_grad=True)
    # Monte Carlo noise is one-sided: seldom much, mostly too little.
    noise = torch.rand(40000, 2, 3, generator=generator) ** 3 * 4
    shown = photographed[:, None] * noise * factor
    (pull,) = torch.autograd.grad(unbiased_loss(shown, photographed, none, weight_by_prediction), factor)
    (biased,) = torch.autograd.grad(
        log_loss((photographed[:, None] * noise * factor).mean(1), photographed, none), factor
    )
    curvature = float((photographed / (photographed + 0.03) ** 0.6).square().mean())
    assert abs(float(pull)) < 0.02 * curvature
    assert abs(float(biased)) > 0.02


def test_weights_by_what_is_shown_find_the_mean_of_what_was_photographed():
    """One place that mirrors now bright, now dark, as under wrong normals: not a mean that the dark ones pull."""
    photographed = torch.tensor([0.02, 0.05, 0.1, 0.9])[:, None].expand(4, 3)

    def pull(value: float, weight_by_prediction: bool) -> float:
        place = torch.tensor(value, requires_grad=True)
        loss = unbiased_loss(place.expand(4, 2, 3), photographed, photographed > 1, weight_by_prediction)
        return float(torch.autograd.grad(loss, place)[0])

    mean = float(photographed.mean())
    assert abs(pull(mean, True)) < 1e-6
    assert pull(0.95 * mean, True) < 0 < pull(1.05 * mean, True)
    assert pull(0.5 * mean, False) > 0  # by the photographs, half of it is still too bright


def test_both_weights_are_alike_near_the_truth():
    """Losses and their slopes: the schedule may go over from one to the other."""
    photographed = torch.rand(50, 3, generator=torch.Generator().manual_seed(2)) * 0.9
    factor = torch.full((1,), 1.001, requires_grad=True)
    losses = [
        unbiased_loss((photographed * factor)[:, None].expand(50, 2, 3), photographed, photographed > 1, way)
        for way in (False, True)
    ]
    slopes = [float(torch.autograd.grad(loss, factor)[0]) for loss in losses]
    assert losses[1].item() == pytest.approx(losses[0].item(), rel=0.01)
    assert slopes[1] == pytest.approx(slopes[0], rel=0.01)


def test_clipped_photographs_set_no_upper_bound():
    white, clipped = torch.ones(4, 3), torch.ones(4, 3, dtype=torch.bool)
    bright, dim = torch.full((4, 2, 3), 3.0), torch.full((4, 3), 0.5)
    for way in (False, True):
        assert float(unbiased_loss(bright, white, clipped, way)) == 0
        assert float(unbiased_loss(bright, white, ~clipped, way)) > 0
    assert float(log_loss(bright[:, 0], white, clipped)) == 0 < float(log_loss(dim, white, clipped))
    assert float(log_loss(bright[:, 0], white, ~clipped)) > 0


def test_albedo_along_edges_of_metal_is_evened_out_but_for_its_patterns_and_paint():
    ends = torch.tensor([[0.6, 0.5, 0.3], [0.9, 0.5, 0.3]]).repeat(4, 1, 1).requires_grad_(True)
    metallic = torch.tensor([[1.0, 1.0], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    alike = torch.tensor([1.0, 1.0, 1.0, 0.0])  # the last edge crosses a line that the photographs show
    loss = metal_smoothness_prior((ends[:, 0] - ends[:, 1]).abs(), metallic, alike[:, None])
    (slope,) = torch.autograd.grad(loss, ends)
    assert slope[0, 0, 0] < 0 < slope[0, 1, 0]
    assert float(slope[1:].abs().max()) == 0
    metallic.requires_grad_(True)  # not by being less of a metal
    assert not metal_smoothness_prior((ends[:, 0] - ends[:, 1]).abs().detach(), metallic, alike[:, None]).requires_grad


@pytest.mark.parametrize("weight", ["metal_smoothness", pytest.param("metal_albedo_prior", marks=pytest.mark.slow)])
def test_what_is_said_of_metals_begins_late_and_counts_for_nothing_else(ball, capture, weight, monkeypatch):
    def alike(**other: str) -> bool:
        settings = replace(SMALL, metal_smoothness=0.0, metal_albedo_prior=0.0, **other)
        return np.array_equal(
            *(decouple(capture, ball, replace(settings, **{weight: value})).albedo for value in (0.0, 5.0))
        )

    assert not alike()
    assert alike(parametrisation="dielectric")
    monkeypatch.setattr("drgs_blender.reconstruct.inverse_rendering.schedule._METALS", 2.0)
    assert alike()


def test_pixels_beside_clipped_ones_are_known_by_channel_and_count_less(ball, capture):
    """Two pixels around; not the clipped ones themselves, other channels, nor what is clipped in the backdrop."""
    view = capture.views[0]
    height, width = view.colour.shape[:2]
    colour = np.full((height, width, 3), 0.5, np.float32)
    middle = tuple(np.round(np.argwhere(view.mask > 0.99).mean(0)).astype(int))
    colour[(*middle, 0)] = 1.0
    colour[np.asarray(view.mask) == 0] = 1.0
    tree = TriangleBVH()
    tree.build(ball.vertices, ball.faces)
    pixels = pixels_of(0, replace(view, colour=colour), ball, tree)
    assert int((pixels.colour[:, 0] > 0.9).sum()) == 1
    assert pixels.next_to_clipped.sum(axis=0).tolist() == [12, 0, 0]  # the disc of radius 2, without its middle
    assert not pixels.next_to_clipped[pixels.colour[:, 0] > 0.9].any()
    assert pixels.clipped.sum() == 1

    # A picture that has values above white does not clip at it.
    above = np.where(colour == 1, np.float32(2.5), np.float32(0))
    pixels = pixels_of(0, replace(view, colour=colour, above_white=above), ball, tree)
    assert not pixels.clipped.any() and not pixels.next_to_clipped.any()
    assert pixels.colour.max() == pytest.approx(3.5)

    photographed = torch.full((2, 3), 0.2)
    shown = torch.full((2, 2, 3), 0.5, requires_grad=True)
    weights = torch.tensor([[1.0, 1.0, 1.0], [0.5, 1.0, 1.0]])
    for weight_by_prediction in (False, True):
        (slope,) = torch.autograd.grad(
            unbiased_loss(shown, photographed, photographed > 1, weight_by_prediction, weights), shown
        )
        assert slope[1, :, 0] == pytest.approx(slope[0, :, 0] / 2) and torch.equal(slope[1, :, 1:], slope[0, :, 1:])


def alike_whole_and_half(ball: Mesh, capture: Capture, exposure: float) -> bool:
    """Whether photographs that are so much brighter teach the same with pixels beside clipped ones whole and half."""
    views = [replace(view, colour=np.clip(view.colour * np.float32(exposure), 0, 1)) for view in capture.views]
    found = [
        decouple(replace(capture, views=views), ball, replace(SMALL, clipped_neighbour_weight=weight)).albedo
        for weight in (1.0, 0.5)
    ]
    return np.array_equal(*found)


@pytest.mark.parametrize(("exposure", "alike"), [(0.5, True), (2.0, False)])
def test_only_photographs_that_are_clipped_learn_otherwise_beside_it(ball, capture, exposure, alike):
    assert alike_whole_and_half(ball, capture, exposure) == alike


def test_pixels_beside_clipped_ones_count_whole_as_long_as_photographs_weigh(ball, capture, monkeypatch):
    """Half from the first step on gained less: light that is not yet known needs them."""
    monkeypatch.setattr("drgs_blender.reconstruct.inverse_rendering.schedule._BY_PREDICTION", 2.0)
    assert alike_whole_and_half(ball, capture, 2.0)


def test_metals_are_pulled_to_be_bright_keep_their_hue_and_paint_is_let_alone():
    albedo = torch.tensor([[0.4, 0.3, 0.1], [0.95, 0.7, 0.4], [1.0, 1.0, 1.0], [0.4, 0.3, 0.1]], requires_grad=True)
    loss = metal_albedo_prior(albedo, torch.tensor([1.0, 1.0, 1.0, 0.4]))
    (slope,) = torch.autograd.grad(loss, albedo)
    step = -slope
    assert (step[0] > 0).all() and step[0] / step[0, 0] == pytest.approx(albedo[0].detach() / 0.4, rel=1e-5)
    assert step[1].abs().max() < 1e-6 and (step[2] < 0).all()
    assert 0 < step[3].max() < 0.01 * step[0].max()


def test_metals_too_dark_for_polished_ones_say_nothing_of_the_light():
    """A dark bronze photographed on a table came out 2.7 times too bright, its light as much too dim."""
    albedo = torch.tensor([[0.24, 0.2, 0.1], [0.4, 0.2, 0.1], [0.5, 0.4, 0.2], [0.7, 0.5, 0.3]], requires_grad=True)
    (slope,) = torch.autograd.grad(metal_albedo_prior(albedo, torch.ones(4)), albedo)
    pull = -slope[:, 0] / (0.95 - albedo[:, 0].detach())
    assert pull[0] == 0 and pull[1] == pytest.approx(0.6 * float(pull[2]), rel=1e-5)
    assert pull[3] == pytest.approx(float(pull[2]), rel=1e-5)


def test_specular_colours_and_back():
    rng = np.random.default_rng(6)
    albedo, metallic = rng.uniform(0.05, 0.95, (200, 3)), rng.uniform(0.02, 0.98, 200)
    diffuse = (1 - metallic[:, None]) * albedo
    specular = 0.04 * (1 - metallic[:, None]) + metallic[:, None] * albedo
    found, metal = from_specular(diffuse, specular)
    assert metal == pytest.approx(metallic, abs=2e-3) and found == pytest.approx(albedo, abs=2e-3)


@pytest.mark.parametrize("shading_model", ["principled", "paper"])
def test_dielectrics_are_surfaces_without_metal(shading_model):
    mesh, points, up = floor_points()
    sums = torch.rand(len(up), 2, 4, 3, generator=torch.Generator().manual_seed(2))
    columns, nv = torch.tensor([[0.6, 0.4, 0.2, 0.3, 0.0]]).repeat(len(up), 1), torch.from_numpy(points.towards[:, 2])
    metallic, plain = (Materials(mesh.vertices, kind, 0) for kind in ("metallic", "dielectric"))
    assert torch.equal(
        plain.reflect(columns[:, :4], sums, nv, shading_model), metallic.reflect(columns, sums, nv, shading_model)
    )
    assert not plain.values()[2].any() and metallic.values()[2].all()


def test_growing_light_keeps_what_it_was():
    light = LearnedLight(8, 1.5)
    assert light.radiance().numpy() == pytest.approx(1.5, rel=1e-5)
    u = torch.arange(16) / 16 * 2 * np.pi
    light.log = light.log + 0.2 * torch.cos(u)[None, :, None]
    before = light.log.mean()
    light.grow()
    assert light.log.shape == (16, 32, 3) and float(light.log.mean()) == pytest.approx(float(before), abs=1e-5)
    fine = (torch.arange(32) + 0.5) / 32 * 2 * np.pi - np.pi / 16
    wave = light.log[5, :, 0] - light.log[5, :, 0].mean()
    assert wave.numpy() == pytest.approx(0.2 * torch.cos(fine).numpy(), abs=0.01)
    assert float(colour_cast(light.radiance())) == pytest.approx(0, abs=1e-6)
    coloured = light.radiance() * torch.tensor([1.0, 0.5, 0.2])
    assert float(colour_cast(coloured)) > 0.1
    assert float(colour_cast(100 * coloured)) == pytest.approx(float(colour_cast(coloured)))


# A small capture: a ball with a painted and a metal half.


def camera_at(angle: float, height: float, size: int) -> Camera:
    eye = 4 * np.array([np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)])
    back = eye / np.linalg.norm(eye)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], -1)
    matrix[:3, 3] = eye
    return Camera(matrix, size, size, 1.7 * size, 1.7 * size, size / 2, size / 2)


@pytest.fixture(scope="module")
def ball() -> Mesh:
    shape = trimesh.creation.icosphere(4)
    v = np.asarray(shape.vertices)
    albedo = np.where(v[:, 2:] > 0, [0.8, 0.3, 0.15], [0.3, 0.5, 0.7]) * np.where(v[:, :1] > 0, 1.0, 0.45)
    return Mesh(v, shape.faces, albedo, np.where(v[:, 1] > 0, 0.3, 0.6), np.where(v[:, 1] > 0.2, 1.0, 0.0))


@pytest.fixture(scope="module")
def capture(ball) -> Capture:
    return photographed(ball)


def photographed(ball: Mesh) -> Capture:
    """14 photographs of 32 x 32 pixels by the engine, in grey light."""
    scene = TraceScene()
    scene.update([TraceObject("ball", ball.vertices, ball.faces, ball.albedo, ball.roughness, ball.metallic)], [], [])
    rows = np.linspace(0, np.pi, 33)[:-1, None]
    columns = np.linspace(0, 2 * np.pi, 65)[None, :-1]
    image = 0.1 + 1.0 * np.exp(-20 * ((rows - 0.9) ** 2 + (columns - 2.0) ** 2))
    image = (image + 0.9 * np.exp(-20 * ((rows - 1.6) ** 2 + (columns - 4.6) ** 2)))[..., None] * np.float32([1, 1, 1])
    world = World(image.astype(np.float32))
    light, none, column = EnvironmentLight(world), np.empty((0, 3), np.float32), np.empty(0, np.float32)
    posed = PosedSurfels(none, none, none, none, column, none, column, column, np.empty(0, np.int32))
    settings = RenderSettings(samples=128, bounces=0, camera_sees="mesh", subpixel_samples=4, film_transparent=True)
    views = []
    for k in range(14):
        camera = camera_at(2.4 * k, -0.6 + 0.12 * k, 32)
        frame = Frame(1, camera, [ObjectState("ball", "")], world, settings)
        picture = render(PreparedScene(scene, light, posed), frame)["Combined"]
        views.append(View(f"{k:02d}", camera, linear_to_srgb(np.clip(picture[..., :3], 0, 1)), picture[..., 3]))
    return Capture(Path("ball"), views, (0.0, 0.0, 0.0))


SMALL = Settings(iterations=12, pixels=128, cosine=4, ggx=4, light=4, environment=8, coarse=1)


def arrays(found: Decoupled) -> list[np.ndarray]:
    return [found.albedo, found.roughness, found.metallic, found.environment, found.normals]


@pytest.mark.slow
def test_materials_and_light_are_found_again(ball, capture):
    found = decouple(capture, ball, Settings(iterations=250, pixels=512, environment=16, smoothness=0.005, seed=3))
    scale = (found.albedo * ball.albedo).sum(0) / (found.albedo**2).sum(0)
    error = np.sqrt(((found.albedo * scale - ball.albedo) ** 2).mean())
    assert error < 0.45 * ball.albedo.std(axis=0).mean()
    bright = np.unravel_index(found.environment.sum(-1).argmax(), (16, 32))
    # Lights at rows and columns (4.6, 10.2) and (8.1, 23.4) of 16 x 32.
    assert min(np.hypot(bright[0] - 4.6, bright[1] - 10.2), np.hypot(bright[0] - 8.1, bright[1] - 23.4)) < 2, bright
    assert found.report["psnr"] > 34
    assert found.report["views"] == 14 and found.report["unseen_vertices"] < 0.2 * len(ball.vertices)


@pytest.mark.slow
def test_what_is_brighter_than_white_tells_materials_and_light(ball, capture):
    """Photographs exposed six stops too long teach the same, if they keep what is above white."""
    errors = []
    for exposure, keeps in ((1, True), (64, True), (64, False)):
        views = []
        for view in capture.views:
            linear = exposure * srgb_to_linear(view.colour)
            above = np.maximum(linear - 1, 0) if keeps and linear.max() > 1 else None
            colour = linear_to_srgb(np.clip(linear, 0, 1))
            views.append(replace(view, colour=colour, above_white=above, linear=keeps))
        settings = Settings(iterations=250, pixels=512, environment=16, smoothness=0.002, seed=3)
        found = decouple(replace(capture, views=views), ball, settings)
        scale = (found.albedo * ball.albedo).sum(0) / (found.albedo**2).sum(0)
        errors.append(np.sqrt(((found.albedo * scale - ball.albedo) ** 2).mean()))
    assert errors[1] == pytest.approx(errors[0], rel=0.02) and errors[2] > 1.5 * errors[1]


def test_only_pictures_whose_scale_says_nothing_are_brought_to_one_brightness(capture):
    linear = replace(capture, views=[replace(view, linear=True) for view in capture.views])
    for mean in (1e-3, 0.3, 40.0):
        assert _gain(linear, mean, 0.12) * mean == pytest.approx(0.12)
    assert _gain(capture, 0.05, 0.12) == _gain(capture, 0.3, 0.12) == 1.0
    assert _gain(capture, 1e-3, 0.12) * 1e-3 == pytest.approx(0.2 * 0.12)  # darker than anybody would photograph it


def test_light_and_errors_have_the_scale_of_the_photographs_and_the_domain_stays_as_it_is(ball, capture, monkeypatch):
    """Whatever brightness losses are weighed at; a second run on the same domain finds the same."""
    views = [replace(view, linear=True) for view in capture.views]
    plain = decouple(replace(capture, views=views), ball, SMALL)
    views = [
        replace(view, colour=linear_to_srgb(srgb_to_linear(view.colour) / np.float32(64)), linear=True)
        for view in capture.views
    ]
    dark = replace(capture, views=views)
    domain = mesh_domain(dark, ball, SMALL)
    before = domain.pixels.colour.copy()
    monkeypatch.setattr("drgs_blender.reconstruct.inverse_rendering.run.domain_of", lambda *_: domain)
    one, other = (decouple(dark, ball, SMALL) for _ in range(2))
    assert np.array_equal(domain.pixels.colour, before) and np.array_equal(one.environment, other.environment)
    assert 64 * one.environment.mean() == pytest.approx(plain.environment.mean(), rel=0.05)
    assert one.report["psnr"] > plain.report["psnr"] + 6  # differences of dark pictures are smaller in sRGB


@pytest.mark.slow
def test_the_hue_of_all_photographs_is_that_of_the_object_not_of_the_light(ball):
    """Bronze in grey light: only a start from its own hue keeps the light, which learns faster, from turning bronze."""
    bronze = replace(ball, albedo=np.where(ball.vertices[:, :1] > 0, 0.5, 0.3) * np.float32([[1.0, 0.55, 0.2]]))
    found = decouple(photographed(bronze), bronze, Settings(iterations=150, pixels=512, environment=16, seed=3))
    red, _, blue = found.environment.mean(axis=(0, 1))
    assert red / blue == pytest.approx(1.0, abs=0.25)
    red, _, blue = np.median(found.albedo, axis=0)
    assert red / blue > 3


def _cast(found: Decoupled) -> float:
    return float(colour_cast(torch.from_numpy(found.environment)))


def _steps(found: Decoupled) -> float:
    image = np.log(found.environment)
    return float(((image - np.roll(image, 1, 1)) ** 2).mean())


def _unevenness(found: Decoupled) -> float:
    return float(found.roughness.std())


def _between(found: Decoupled) -> float:
    return float((found.metallic * (1 - found.metallic)).mean())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("weight", "value", "measure"),
    [
        ("grey_light_prior", 0.3, _cast),
        ("light_smoothness", 0.3, _steps),
        ("smoothness", 1.0, _unevenness),
        ("binary_metallic_prior", 1.0, _between),
    ],
)
def test_each_weight_makes_less_of_what_it_weighs(ball, capture, weight, value, measure):
    settings = replace(SMALL, iterations=40)
    without, with_it = (measure(decouple(capture, ball, replace(settings, **{weight: w}))) for w in (0.0, value))
    assert with_it < 0.8 * without, (with_it, without)


def test_metallic_is_smoothed_more_than_other_materials(ball, capture, monkeypatch):
    def spread() -> float:
        return float(decouple(capture, ball, replace(SMALL, iterations=40, smoothness=0.05)).metallic.std())

    more = spread()
    monkeypatch.setattr("drgs_blender.reconstruct.inverse_rendering.regularisers._SMOOTH", (1.0,) * 7)
    assert more < 0.8 * spread()


@pytest.mark.slow
def test_exposures_of_photographs_are_found_again(ball, capture):
    """Every other one a quarter of a stop darker."""
    views = [
        replace(view, colour=linear_to_srgb(srgb_to_linear(view.colour) * np.float32(2 ** (-0.25 * (k % 2)))))
        for k, view in enumerate(capture.views)
    ]
    settings = Settings(iterations=150, pixels=512, environment=16, seed=3, exposure=True)
    found = np.array(decouple(replace(capture, views=views), ball, settings).report["exposures"])
    assert np.median(found[0::2]) / np.median(found[1::2]) == pytest.approx(2**0.25, rel=0.04)


@pytest.mark.slow
def test_grids_and_a_coarse_light_carry_what_many_pixels_agree_on(ball, capture):
    """With as many steps, what is learned on grids is nearer to the photographs; light begins with few rows."""
    psnr = [decouple(capture, ball, replace(SMALL, iterations=40, coarse=n)).report["psnr"] for n in (0, 2)]
    assert psnr[1] > psnr[0] + 1

    def rows(iterations: int, coarse_to_fine: bool) -> int:
        settings = replace(SMALL, iterations=iterations, environment=32, coarse_to_fine=coarse_to_fine)
        return len(decouple(capture, ball, settings).environment)

    assert [rows(1, True), rows(40, True), rows(1, False), rows(40, False)] == [8, 32, 32, 32]


def test_without_shadows_a_room_around_all_does_not_stand_before_the_light(ball, capture):
    room = trimesh.creation.icosphere(2, radius=9.0)
    room.invert()
    both = plain_mesh(
        np.concatenate([ball.vertices, room.vertices]), np.concatenate([ball.faces, room.faces + len(ball.vertices)])
    )
    short = replace(SMALL, iterations=60, pixels=256, indirect=False)
    dark, lit = (decouple(capture, both, replace(short, shadows=value)).report["psnr"] for value in (True, False))
    assert lit > dark + 10, (dark, lit)


@pytest.mark.parametrize(
    "more",
    [
        pytest.param({}, marks=pytest.mark.slow),
        {"normals": True, "exposure": True, "parametrisation": "specular"},
    ],
)
def test_an_interrupted_run_ends_where_an_undisturbed_one_does(ball, capture, tmp_path, more):
    settings = replace(SMALL, **more)
    whole = decouple(capture, ball, settings)
    path, asked = tmp_path / "materials.state", []

    def cancelled() -> bool:
        asked.append(0)
        return len(asked) > 7

    with pytest.raises(Cancelled):
        decouple(capture, ball, settings, cancelled=cancelled, checkpoint=path)
    assert path.exists()
    seen: list[Progress] = []
    resumed = decouple(capture, ball, settings, on_progress=seen.append, checkpoint=path)
    assert seen[-1].iteration == 12
    done: list[Progress] = []
    again = decouple(capture, ball, settings, on_progress=done.append, checkpoint=path)
    assert not done  # what makes something of it may be stopped, too, and no step is taken twice
    for a, b, c in zip(arrays(whole), arrays(resumed), arrays(again)):
        assert np.array_equal(a, b) and np.array_equal(a, c)
    other = decouple(capture, ball, replace(settings, seed=1))
    assert not np.array_equal(other.albedo, whole.albedo)


def test_torchs_threads_change_nothing(ball, capture):
    """A light of 128 rows has more numbers than torch sums on one thread by itself."""
    settings, found = replace(SMALL, iterations=4, environment=128, coarse_to_fine=False), []
    before = torch.get_num_threads()
    try:
        for threads in (1, 4):
            torch.set_num_threads(threads)
            found.append(decouple(capture, ball, settings))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert all(np.array_equal(a, b) for a, b in zip(*map(arrays, found), strict=True))


def test_a_run_whose_time_was_up_when_it_was_stopped_still_knows_how_good_it_is(ball, capture, tmp_path):
    clock, tick = [0.0], [1.0]

    def now() -> float:
        clock[0] += tick[0]
        return clock[0]

    settings, path = replace(SMALL, iterations=1000, seconds=100.0), tmp_path / "materials.state"
    asked = []
    with pytest.raises(Cancelled):
        stop = lambda: asked.append(0) or len(asked) > 5  # noqa: E731
        decouple(capture, ball, settings, cancelled=stop, checkpoint=path, now=now)
    tick[0] = 100.0
    report = decouple(capture, ball, settings, checkpoint=path, now=now).report
    assert report["iterations"] == 5 and 5 < report["psnr"] < 60
    report = decouple(capture, ball, settings, now=now).report
    assert report["iterations"] == 1 and 5 < report["psnr"] < 60


def test_a_damaged_or_foreign_checkpoint_is_not_used(ball, capture, tmp_path, caplog):
    whole = decouple(capture, ball, SMALL)
    path = tmp_path / "materials.state"
    path.write_bytes(b"PK not a checkpoint" * 9)
    assert np.array_equal(decouple(capture, ball, SMALL, checkpoint=path).albedo, whole.albedo)
    assert "cannot be used" in caplog.text
    with pytest.raises(Cancelled):
        decouple(capture, ball, replace(SMALL, seed=9), cancelled=lambda: True, checkpoint=path)
    assert np.array_equal(decouple(capture, ball, SMALL, checkpoint=path).albedo, whole.albedo)
    assert "other photographs or settings" in caplog.text


def test_cache_shows_what_was_photographed(ball, capture):
    domain = mesh_domain(capture, ball, SMALL)
    pixels = domain.pixels
    constant = replace(pixels, colour=np.full((len(pixels), 3), 0.3, np.float32))
    harmonics, weight = radiance_cache(constant, len(ball.vertices), domain.edges)
    assert harmonics[:, 0] * SH_C0 == pytest.approx(0.3, abs=0.02)  # those that no photograph shows as well
    assert (weight == 0).any()
    assert abs(harmonics[weight > 3, 1:]).max() < 0.05
    few = mesh_domain(capture, ball, replace(SMALL, most_pixels=140)).pixels
    assert len(few) == 140 and set(few.view) == set(range(14))


def test_normals_are_the_meshs_where_none_are_learned(ball, capture):
    found = decouple(capture, ball, replace(SMALL, iterations=2))
    assert found.report["iterations"] == 2 and found.environment.shape == (8, 16, 3)
    assert found.normals == pytest.approx(VertexNormals(ball.faces, len(ball.vertices))(ball.vertices), abs=1e-6)


@pytest.mark.slow
def test_normals_are_turned_towards_the_true_ones_once_light_is_known(ball, capture, monkeypatch):
    """A ball with bumps that the photographed one has not."""
    bumps = 1 + 0.1 * np.sin(3 * ball.vertices).prod(axis=1, keepdims=True)
    wrong = replace(ball, vertices=(ball.vertices * bumps).astype(np.float32))
    smooth = VertexNormals(wrong.faces, len(wrong.vertices))(wrong.vertices)
    settings = replace(SMALL, iterations=150, pixels=512, environment=16, coarse=3, normals=True)

    def off(normals: np.ndarray) -> float:
        return float(np.median(np.degrees(np.arccos(np.clip((normals * ball.vertices).sum(axis=1), -1, 1)))))

    assert off(decouple(capture, wrong, settings).normals) < 0.97 * off(smooth)
    monkeypatch.setattr("drgs_blender.reconstruct.inverse_rendering.schedule._NORMALS", 2.0)
    assert decouple(capture, wrong, replace(settings, iterations=3)).normals == pytest.approx(smooth, abs=1e-6)


def test_a_checkpoint_of_other_normals_is_not_gone_on_from(ball, capture, tmp_path, caplog):
    steps = iter(range(9))
    with pytest.raises(Cancelled):
        decouple(capture, ball, SMALL, cancelled=lambda: next(steps) == 5, checkpoint=tmp_path / "a.state")
    with caplog.at_level("INFO"):
        decouple(
            capture, ball, SMALL, checkpoint=tmp_path / "a.state", start=unit(ball.vertices + np.float32([0, 0, 1]))
        )
    assert "going on" not in caplog.text


def test_bad_input_is_named(ball, capture):
    for wrong in (
        {"iterations": 0},
        {"cosine": 3},
        {"environment": 24},
        {"smoothness": -1.0},
        {"shading_model": "flat"},
    ):
        with pytest.raises(UsageError, match=next(iter(wrong))):
            decouple(capture, ball, replace(SMALL, **wrong))
    with pytest.raises(UsageError, match="no training view"):
        decouple(Capture(Path("x"), []), ball, SMALL)
    away = [replace(view, mask=np.zeros_like(view.mask)) for view in capture.views]
    with pytest.raises(UsageError, match="none of its 14 training views sees the object"):
        decouple(replace(capture, views=away), ball, SMALL)
    small = [replace(view, colour=view.colour[:-1]) for view in capture.views]
    with pytest.raises(UsageError, match="32 x 31 pixels"):
        decouple(replace(capture, views=small), ball, SMALL)
    with pytest.raises(Exception, match="no faces"):
        decouple(capture, Mesh.empty(), SMALL)


def test_black_and_unfinished_photographs_do_no_harm(ball, capture):
    """A black frame and pixels that are no numbers: what is found stays finite."""
    views = [replace(view, colour=view.colour.copy()) for view in capture.views[:6]]
    views[0].colour[:] = 0
    views[1].colour[10:20] = np.nan
    found = decouple(replace(capture, views=views), ball, replace(SMALL, exposure=True))
    assert all(np.isfinite(array).all() for array in arrays(found))


def test_the_same_slope_is_smoothed_as_much_on_finer_meshes():
    """Of a sheet whose materials change evenly: along shorter edges they differ less, and weigh more."""
    smooth, pulled = [], []
    for cells in (100, 400, 800):  # edges of that part of the sheet: the first is coarser than 1/200
        place = np.linspace(0, 1, cells + 1)
        x, y = np.meshgrid(place, place, indexing="ij")
        corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
        faces = np.stack([corner, corner + cells + 1, corner + 1], -1)
        sheet = plain_mesh(np.stack([x, y, 0 * x], -1).reshape(-1, 3), faces)
        settings = Settings(metal_smoothness=0, metal_albedo_prior=0)
        finer = fineness(sheet.vertices, faces[:, :2])
        held = Regularisers(edges_of(faces), np.full((len(sheet.vertices), 3), 0.5), settings, finer)
        edge = np.arange(0, len(held._edges), 7)
        slope = torch.from_numpy(sheet.vertices[:, :1].astype(np.float32))
        ends = torch.from_numpy(held.edges(edge).astype(np.int64))
        samples = SurfaceSamples(slope.expand(-1, 5), slope, slope.expand(-1, 5), torch.ones(len(slope), 3), ends)
        pulled.append(float(held.of_normals(samples)))
        smooth.append(float(held.of_materials(samples, edge, True, True)))
    assert smooth[0] == pytest.approx(2 * smooth[1], rel=0.02) and smooth[1] == pytest.approx(smooth[2], rel=0.02)
    assert pulled[0] == pytest.approx(pulled[1]) and pulled[1] == pytest.approx(pulled[2])  # no difference along edges
