"""Colours of learned surfels blend as light, as their materials do when the asset is lit."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from capture_cases import camera  # noqa: E402

from drgs_blender.core.color import linear_to_srgb, srgb_to_linear  # noqa: E402
from drgs_blender.reconstruct.model.encoding import to_display, to_linear  # noqa: E402
from drgs_blender.reconstruct.model.gaussians import Gaussians  # noqa: E402

VIEW = camera(3, 16, 32)


def two(front: float, behind: float, opacity: float) -> Gaussians:
    """Two large surfels across the view, the nearer one of some opacity, the other opaque."""
    back = np.asarray(VIEW.matrix_world)[:3, 2]
    points = np.stack([0.2 * back, -0.2 * back])
    found = Gaussians.on_surface(points, np.stack([back, back]), np.array([[front] * 3, [behind] * 3]), 20.0)
    logits = torch.tensor([np.log(opacity / (1 - opacity)), 12.0], dtype=torch.float32)
    return found.like(found.parameters | {"opacity": logits})


def test_the_transfer_function_is_that_of_pictures():
    x = torch.linspace(-0.1, 1.3, 1001)
    assert to_linear(x).numpy() == pytest.approx(srgb_to_linear(x.numpy()), abs=1e-6)
    assert to_display(x).numpy() == pytest.approx(linear_to_srgb(x.numpy()), abs=1e-6)
    double = torch.tensor([-0.05, 0.001, 0.02, 0.0404, 0.2, 0.9, 1.4], dtype=torch.float64, requires_grad=True)
    for function in (to_linear, to_display):
        assert torch.autograd.gradcheck(function, (double,))


@pytest.mark.parametrize(("front", "behind"), [(1.0, 0.0), (0.0, 1.0), (0.7, 0.1)])
def test_half_of_a_colour_before_another_is_half_of_its_light(front, behind):
    surfels = two(front, behind, 0.5)
    with torch.no_grad():
        shown = surfels.render(VIEW, torch.zeros(3), 0, reflections=False)
    weights = surfels.render(VIEW, torch.zeros(3), 0, reflections=False, materials=torch.eye(2)).materials
    parts = weights.detach().numpy()[16, 16]
    assert parts[0] == pytest.approx(0.5, abs=0.01) and parts.sum() > 0.98
    wanted = linear_to_srgb(parts @ srgb_to_linear([front, behind]) / parts.sum())
    alpha = shown.maps.alpha.numpy()[16, 16]
    assert shown.colour.numpy()[16, 16] == pytest.approx(wanted * alpha, abs=1e-4)


def test_what_is_behind_the_surfels_is_covered_as_pictures_are():
    """Half of a surfel over a background is the mean of both as they are displayed: so are pictures with masks made."""
    surfels = two(0.8, 0.2, 0.5).select(np.array([0]))
    with torch.no_grad():
        shown = surfels.render(VIEW, torch.full((3,), 0.3), 0, reflections=False)
    alpha = shown.maps.alpha.numpy()[16, 16]
    assert alpha == pytest.approx(0.5, abs=0.01)
    assert shown.colour.numpy()[16, 16] == pytest.approx(0.8 * alpha + 0.3 * (1 - alpha), abs=1e-3)


def test_surfels_of_an_asset_keep_the_light_that_is_mirrored_on_the_mean():
    """Harmonics and albedo of what is written have it, one encoded, the other linear."""
    surfels = two(0.6, 0.4, 0.9)
    written = surfels.surfels()
    tint, light = torch.sigmoid(surfels.parameters["tint"]).detach().numpy(), surfels.light.exp().mean().item()
    wanted = srgb_to_linear([[0.6] * 3, [0.4] * 3]) + tint * light
    assert written.albedo == pytest.approx(wanted, abs=1e-4)
    assert srgb_to_linear(0.5 + 0.28209479177387814 * written.sh[:, 0]) == pytest.approx(wanted, abs=1e-4)
