"""The cube of light that reflections look up."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.reconstruct.model.reflection_probe import BARE, LEVELS, dark_cube, mirrored, pyramid  # noqa: E402


def reflected(normal, rays, blur, texels, tint=1.0, alpha=1.0):
    """The light of a row of pixels with these blended normals (p, 3)."""
    n = len(normal)
    cover = torch.full((1, n), alpha) if isinstance(alpha, float) else alpha[None]
    features = torch.cat([torch.zeros(n, 3), normal, torch.full((n, 3), tint), (blur * cover[0])[:, None]], 1)
    return mirrored(features[None], cover, np.ascontiguousarray(rays.numpy())[None], texels)[0]


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


def test_gradients_of_tint_and_coverage():
    rng = np.random.default_rng(2)
    cube = dark_cube(0.1)
    cube[4] = 0.0
    features = torch.tensor(rng.uniform(0.2, 0.8, (6, 5, 10)), dtype=torch.float32)
    alpha = torch.tensor(rng.uniform(0.8, 1, (6, 5)), dtype=torch.float32)
    rays = np.broadcast_to(np.float32([0.1, -0.2, -1]), (6, 5, 3)).copy()
    pull = torch.tensor(rng.normal(size=(6, 5, 3)), dtype=torch.float32)
    value = lambda f, a: (mirrored(f, a, rays, pyramid(cube)) * pull).sum()  # noqa: E731
    f, a = features.clone().requires_grad_(), alpha.clone().requires_grad_()
    value(f, a).backward()
    seen = mirrored(features, alpha, rays, pyramid(cube)) / features[..., 6:9]
    torch.testing.assert_close(f.grad[..., 6:9], seen * pull)
    # What is blurred is the blend over the coverage: both times two is the same.
    torch.testing.assert_close((f.grad[..., 9] * f[..., 9]).detach(), -(a.grad * alpha), rtol=1e-4, atol=1e-6)


def test_pixels_hardly_covered_mirror_nothing():
    n = torch.tensor([[0.0, 0, 1]] * 2)
    cover = torch.tensor([0.9 * float(BARE), 1.1 * float(BARE)])
    seen = reflected(n, -n, torch.zeros(2), pyramid(dark_cube(0.3)), alpha=cover)
    assert not seen[0].any()
    assert torch.allclose(seen[1], torch.tensor(0.3))
