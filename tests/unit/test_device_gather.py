"""Materials pulled apart from light on a device, on Warp's device "cpu": what the processor's rays bring."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch")
pytest.importorskip("warp", reason="warp-lang is not installed")

from capture_cases import BALLS, balls  # noqa: E402
from cards import DEVICE, IS_CARD  # noqa: E402
from shapes import sphere_mesh  # noqa: E402
from test_decouple import sky  # noqa: E402

from drgs_blender.core.asset.model import Mesh  # noqa: E402
from drgs_blender.core.errors import DeviceError  # noqa: E402
from drgs_blender.reconstruct.backend import CPU, LearningBackend  # noqa: E402
from drgs_blender.reconstruct.gpu.gather import GATHER  # noqa: E402
from drgs_blender.reconstruct.gpu.warp_backend import WarpLearningBackend  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.estimator import Points  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.gatherer import Gatherer  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.run import decouple  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.settings import Settings  # noqa: E402
from drgs_blender.render.scene.triangle_bvh import TriangleBVH  # noqa: E402

POINTS = 300


@pytest.fixture
def there() -> WarpLearningBackend:
    return WarpLearningBackend(DEVICE)


def two_balls(places: Any = (((0, 0, 0), 1), ((2.2, 0, 0), 1))) -> Mesh:
    """Balls (middle, radius) side by side: each stands in the other's light."""
    points, triangles = sphere_mesh(3)
    vertices = np.concatenate([np.asarray(middle) + radius * points for middle, radius in places])
    faces, n = np.concatenate([triangles, triangles + len(points)]), len(vertices)
    return Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))


def gatherer(by: LearningBackend, shadows: bool = True, indirect: bool = True, normals: bool = True) -> Gatherer:
    mesh, tree = two_balls(), TriangleBVH()
    tree.build(mesh.vertices, mesh.faces if shadows else mesh.faces[:0])
    cache = np.random.default_rng(2).uniform(0.1, 1, (len(mesh.vertices), 4, 3)).astype(np.float32)
    return by.gatherer(mesh, tree, cache if indirect else None, (8, 8, 8), normals)


def gathered(found: Gatherer, turned: bool = False) -> list[Any]:
    """Sums and gradients at points of the first ball; with `turned`, each in a light of another rotation."""
    rng = np.random.default_rng(1)
    turn = Rotation.random(POINTS if turned else 0, 3).as_matrix().reshape(-1, 3, 3).astype(np.float32)
    normal = rng.normal(size=(POINTS, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    towards = normal + 0.6 * rng.normal(size=normal.shape).astype(np.float32)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    points = Points(1.001 * normal, normal, towards, np.arange(POINTS, dtype=np.uint32) + 5, turn)
    given = [torch.tensor(a) for a in (normal, rng.uniform(0.01, 0.9, POINTS).astype(np.float32), sky())]
    for value in given:
        value.requires_grad_()
    sums = found(points, *given)
    (sums * torch.tensor(rng.normal(size=sums.shape), dtype=torch.float32)).sum().backward()
    return [sums.detach(), *(value.grad for value in given)]


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("settings", [{}, {"shadows": False}, {"indirect": False}])
def test_what_arrives_and_its_derivatives(there: WarpLearningBackend, settings: dict[str, bool], turned: bool) -> None:
    device = gatherer(there, **settings)
    here, other = gathered(gatherer(CPU, **settings), turned), gathered(device, turned)
    assert not device.failed
    sums, same = here[0], (here[0] - other[0]).abs().amax((1, 2, 3)) <= 1e-4 * here[0].abs().amax((1, 2, 3))
    assert sums.abs().max() > 0
    assert same.float().mean() > 0.99  # a ray along an edge may meet either face
    for k, (a, b) in enumerate(zip(here[1:3], other[1:3], strict=True)):
        assert a.abs().max() > 0
        torch.testing.assert_close(b[same], a[same], rtol=1e-3, atol=1e-3 * float(a.abs().mean()), msg=str(k))
    assert (other[3] - here[3]).norm() < 1e-3 * here[3].norm()


def test_a_device_with_memory_of_its_own(there: WarpLearningBackend) -> None:
    expected = gathered(gatherer(there))
    there.launcher.apart = True
    assert all(torch.equal(a, b) for a, b in zip(expected, gathered(gatherer(there)), strict=True))


def test_shadows_and_light_from_the_mesh_count() -> None:
    """What the comparisons above would not see if nothing was met."""
    whole, alone, dark = (gathered(gatherer(CPU, **s))[0] for s in ({}, {"shadows": False}, {"indirect": False}))
    assert (whole - alone).norm() > 0.02 * whole.norm()
    assert (whole - dark).norm() > 0.02 * whole.norm()


def test_a_device_that_fails_is_a_warning(
    there: WarpLearningBackend, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: Any) -> None:
        raise DeviceError("device cuda", "out of memory")

    device, here = gatherer(there), gathered(gatherer(CPU))
    monkeypatch.setattr(there.launcher, "launch", fail)
    for _ in range(2):
        assert all(torch.equal(a, b) for a, b in zip(gathered(device), here, strict=True))
    (said,) = caplog.messages
    assert "out of memory" in said and "on the CPU" in said


def test_materials_and_light_are_those_that_the_processor_finds(
    there: WarpLearningBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture, mesh, asked = balls(count=8, size=32), two_balls(BALLS), []
    launch = there.launcher.launch
    monkeypatch.setattr(there.launcher, "launch", lambda kernel, *rest: asked.append(kernel) or launch(kernel, *rest))
    settings = Settings(iterations=40, pixels=128, cosine=4, ggx=4, light=4, environment=8, normals=True)
    here, other = (decouple(capture, mesh, settings, backend=by) for by in (CPU, there))
    assert asked == [GATHER] * 40
    for name in ("albedo", "roughness", "environment"):
        a, b = getattr(here, name), getattr(other, name)
        assert np.ptp(a) > 0.05, name
        assert np.linalg.norm(a - b) < (0.03 if IS_CARD else 0.01) * np.linalg.norm(a), name
