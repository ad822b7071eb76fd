"""The cube of light that reflections look up."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.reconstruct.reflection import LEVELS, dark_cube, pyramid, reflected  # noqa: E402


def test_an_even_light_is_seen_evenly_from_everywhere():
    rng = np.random.default_rng(0)
    n, d = (torch.tensor(rng.normal(size=(500, 3)), dtype=torch.float32) for _ in range(2))
    blur = torch.tensor(rng.uniform(0, 1, 500), dtype=torch.float32)
    assert torch.allclose(reflected(n, d, blur, pyramid(dark_cube(0.3))), torch.tensor(0.3), atol=1e-5)


def test_a_mirror_shows_the_face_that_the_ray_leaves_through():
    cube = dark_cube(0.1)
    cube[4] = 0.0  # +Z shines with 1
    texels = pyramid(cube)
    normal, blur = torch.tensor([[0.0, 0, 5]]), torch.zeros(1)
    down, up = torch.tensor([[0.1, -0.2, -1.0]]), torch.tensor([[0.1, -0.2, 1.0]])
    assert torch.allclose(reflected(normal, down, blur, texels), torch.tensor(1.0), atol=1e-5)
    assert torch.allclose(reflected(normal, up, blur, texels), torch.tensor(0.1), atol=1e-5)


def test_gradients_are_those_of_differences():
    rng = np.random.default_rng(1)
    cube = torch.tensor(rng.normal(size=(6, 3, 32, 32)) * 0.5, dtype=torch.float32).requires_grad_()
    # A smooth light, as differences of float32 see nothing of texels.
    with torch.no_grad():
        cube.copy_(torch.nn.functional.interpolate(cube[:, :, :4, :4], size=32, mode="bilinear"))
    normal = torch.tensor(rng.normal(size=(60, 3)), dtype=torch.float32, requires_grad=True)
    rays = torch.tensor(rng.normal(size=(60, 3)), dtype=torch.float32)
    blur = torch.tensor(rng.uniform(0.05, 0.9, 60), dtype=torch.float32, requires_grad=True)
    pull = torch.tensor(rng.normal(size=(60, 3)), dtype=torch.float32)
    value = lambda n, b, c: (reflected(n, rays, b, pyramid(c)) * pull).sum(1)  # noqa: E731
    value(normal, blur, cube).sum().backward()
    with torch.no_grad():
        step = torch.tensor(rng.normal(size=(60, 3)), dtype=torch.float32)
        by_normal = (value(normal + 1e-3 * step, blur, cube) - value(normal - 1e-3 * step, blur, cube)) / 2e-3
        mine = (normal.grad * step).sum(1)
        # Some rays cross an edge of the cube or a texel's middle within the difference.
        assert ((by_normal - mine).abs() < 0.03 * (1 + mine.abs())).float().mean() > 0.9
        by_blur = (value(normal, blur + 1e-3, cube) - value(normal, blur - 1e-3, cube)) / 2e-3
        crossing = (blur * (LEVELS - 1)).frac()
        inner = (crossing > 0.01) & (crossing < 0.99)
        assert torch.allclose(by_blur[inner], blur.grad[inner], atol=5e-3)
        shift = torch.tensor(rng.normal(size=cube.shape), dtype=torch.float32)
        change = value(normal, blur, cube + 1e-3 * shift).sum() - value(normal, blur, cube - 1e-3 * shift).sum()
        assert float(change / 2e-3) == pytest.approx(float((cube.grad * shift).sum()), rel=1e-2)
