"""The losses of the shape, against plain tensor operations in double precision."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.reconstruct.losses.shape import shape_loss  # noqa: E402

HEIGHT, WIDTH = 14, 17


def rays() -> torch.Tensor:
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, WIDTH), np.linspace(0.3, -0.3, HEIGHT))
    return torch.tensor(np.stack([x, y, -np.ones_like(x)], -1), dtype=torch.float32)


def maps(seed: int = 0) -> list[torch.Tensor]:
    """Alpha, weighted depth, distortion, normals of a bumpy surface that covers most of the picture."""
    rng = np.random.default_rng(seed)
    alpha = rng.uniform(0.2, 1, (HEIGHT, WIDTH))
    alpha[:4, :5] = 0
    depth = 3 + 0.3 * rng.normal(size=alpha.shape)
    normal = rng.normal(size=(*alpha.shape, 3)) * 0.4
    return [torch.tensor(a, dtype=torch.float32) for a in (alpha, alpha * depth, rng.uniform(size=alpha.shape), normal)]


COUNTS = np.random.default_rng(6).uniform(0.1, 1, (HEIGHT, WIDTH)).astype(np.float32)


def reference(alpha, depth, distortion, normal, mask, weights):
    points = (depth / alpha.clamp(min=1e-3))[..., None] * rays().double()
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    slope = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    inner = alpha.detach()[1:-1, 1:-1]
    cosine = (slope * normal[1:-1, 1:-1]).sum(-1)
    away = torch.where(inner > 0.5, inner - cosine, torch.zeros_like(inner)).clamp(min=0)
    by_normals = (torch.tensor(COUNTS)[1:-1, 1:-1] * away).mean()
    return weights[0] * (alpha - mask).abs().mean() + weights[1] * distortion.mean() + weights[2] * by_normals


@pytest.mark.parametrize("weights", [(0.1, 0.0, 0.0), (0.0, 0.7, 0.0), (0.0, 0.0, 0.25), (0.1, 2.0, 0.5)])
def test_values_and_gradients(weights):
    mask = np.random.default_rng(5).uniform(size=(HEIGHT, WIDTH)).astype(np.float32)
    mine = [m.clone().requires_grad_() for m in maps()]
    plain = [m.double().requires_grad_() for m in maps()]
    found = shape_loss(*mine, mask, rays().numpy(), COUNTS, weights)
    expected = reference(*plain, torch.tensor(mask, dtype=torch.float64), weights)
    assert float(found.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
    (3 * found).backward()
    (3 * expected).backward()
    for name, a, e in zip(("alpha", "depth", "distortion", "normal"), mine, plain, strict=True):
        wanted = torch.zeros_like(e) if e.grad is None else e.grad
        torch.testing.assert_close(a.grad.double(), wanted, rtol=1e-3, atol=1e-6, msg=name)


def test_a_plane_with_its_own_normals_costs_nothing_and_a_turned_one_does():
    view, n = rays().double().numpy(), np.array([0.3, -0.2, 0.9])
    n /= np.linalg.norm(n)
    depth = -2.0 / (view @ n)
    tensor = lambda a: torch.tensor(np.array(a), dtype=torch.float32)  # noqa: E731
    whole, none, all_alike = torch.ones(HEIGHT, WIDTH), torch.zeros(HEIGHT, WIDTH), np.ones_like(COUNTS)

    def loss(normal: np.ndarray) -> float:
        drawn = tensor(np.broadcast_to(normal, view.shape))
        return float(shape_loss(whole, tensor(depth), none, drawn, None, rays().numpy(), all_alike, (1, 0, 1)))

    assert loss(n) == pytest.approx(0, abs=1e-5)
    turned = np.array([n[0], n[1] * np.cos(0.5) - n[2] * np.sin(0.5), n[1] * np.sin(0.5) + n[2] * np.cos(0.5)])
    assert loss(turned) == pytest.approx(1 - float(n @ turned), rel=1e-4)


def test_pictures_too_small_for_differences_have_no_slope():
    small = [m[:2, :2].contiguous() for m in maps()]
    assert float(shape_loss(*small, None, rays()[:2, :2].contiguous().numpy(), COUNTS[:2, :2], (1.0, 0.0, 1.0))) == 0
