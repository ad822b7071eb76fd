"""What surfels show of their raw parameters, against plain tensor operations in double precision."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.formats.harmonics import basis  # noqa: E402
from drgs_blender.reconstruct.model.attributes import attributes, frames  # noqa: E402

EYE = np.array([0.3, -4.0, 1.0])


def surfels(n: int = 200, seed: int = 0) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    rng = np.random.default_rng(seed)
    shapes = {"scale": (2,), "rotation": (4,), "opacity": (), "sh": (9, 3), "tint": (3,), "blur": ()}
    raw = {k: torch.tensor(rng.normal(size=(n, *shape)), dtype=torch.float32) for k, shape in shapes.items()}
    return raw, torch.tensor(rng.normal(size=(n, 3)), dtype=torch.float32)


def reference(p: dict[str, torch.Tensor], centre: torch.Tensor, bands: int, reflections: bool) -> list[torch.Tensor]:
    away = torch.nn.functional.normalize(centre.double() - torch.tensor(EYE), dim=1)
    w, x, y, z = torch.nn.functional.normalize(p["rotation"], dim=1).unbind(1)
    turn = torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], 1).reshape(-1, 3, 3)  # fmt: skip
    u, v, normal = turn.unbind(2)
    size = p["scale"].exp()
    k = (bands + 1) ** 2
    colour = (0.5 + (torch.tensor(basis(away.numpy(), bands))[:, :, None] * p["sh"][:, :k]).sum(1)).clamp(min=0)
    side = -torch.sign((away * normal).sum(1, keepdim=True)).detach()
    features = [colour, side * normal]
    if reflections:
        features += [torch.sigmoid(p["tint"]), torch.sigmoid(p["blur"])[:, None]]
    return [u * size[:, :1], v * size[:, 1:], torch.sigmoid(p["opacity"]), torch.cat(features, 1)]


@pytest.mark.parametrize(("bands", "reflections"), [(0, True), (2, True), (1, False)])
def test_values_and_gradients(bands, reflections):
    raw, centre = surfels()
    mine = {k: v.clone().requires_grad_() for k, v in raw.items()}
    plain = {k: v.double().requires_grad_() for k, v in raw.items()}
    found, expected = attributes(mine, centre, EYE, bands, reflections), reference(plain, centre, bands, reflections)
    rng = np.random.default_rng(1)
    pull = [torch.tensor(rng.normal(size=e.shape)) for e in expected]
    for a, e in zip(found, expected, strict=True):
        torch.testing.assert_close(a.double(), e, rtol=1e-5, atol=1e-5)
    sum((a * p.float()).sum() for a, p in zip(found, pull, strict=True)).backward()
    sum((e * p).sum() for e, p in zip(expected, pull, strict=True)).backward()
    for name, value in plain.items():
        if value.grad is None:
            assert not mine[name].grad.any(), name
            continue
        torch.testing.assert_close(mine[name].grad.double(), value.grad, rtol=1e-4, atol=1e-4, msg=name)


def test_a_part_without_a_gradient_counts_as_none():
    raw, centre = surfels(20)
    for value in raw.values():
        value.requires_grad_()
    _, _, opacity, _ = attributes(raw, centre, EYE, 2, True)
    opacity.sum().backward()
    assert raw["opacity"].grad.min() > 0
    assert not raw["sh"].grad.any()
    assert not raw["rotation"].grad.any()


def test_frames_are_orthogonal_and_as_long_as_the_deviations():
    raw, _ = surfels(50)
    u, v, normal = frames(raw["scale"].numpy(), raw["rotation"].numpy())
    size = np.exp(raw["scale"].numpy())
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), size[:, 0], rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), size[:, 1], rtol=1e-5)
    np.testing.assert_allclose(np.cross(u / size[:, :1], v / size[:, 1:]), normal, atol=1e-5)
