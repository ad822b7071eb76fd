"""Points carried along by particles on a device, on Warp's device "cpu": where the processor carries them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE, assert_same
from scipy.spatial.transform import Rotation
from test_deform_gmls import CENTRE, cloud
from test_simulate_bake import job_of

from drgs_blender.compute.warp.kernels import Launcher
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.deform.gmls import bind_points, carry
from drgs_blender.deform.gpu.gmls import Carrier
from drgs_blender.simulation.bake import bake
from drgs_blender.simulation.gpu.grid import DeviceGrid

EPS = float(np.finfo(np.float32).eps)
SOURCES, POINTS = cloud(2000, 0), cloud(700, 2)


@pytest.fixture
def launcher() -> Launcher:
    """Warp's processor with memory of its own, as a card has."""
    found = Launcher(DEVICE)
    found.apart = True
    return found


def bent() -> tuple[np.ndarray, np.ndarray]:
    """Every source turned, stretched and moved in its own way, by little."""
    noise = np.random.default_rng(3).normal(size=(len(SOURCES), 3, 3))
    return SOURCES + 0.1 * np.sin(3 * SOURCES[:, [1, 2, 0]]), (np.eye(3) + 0.1 * noise).astype(np.float32)


def torn() -> tuple[np.ndarray, np.ndarray]:
    """Halves pulled apart, and a layer that believes it is stretched by fifty."""
    gradients = np.tile(np.eye(3, dtype=np.float32), (len(SOURCES), 1, 1))
    gradients[np.abs(SOURCES[:, 1] - CENTRE[1]) < 0.1, 0, 0] = 50
    return SOURCES + [5.0, 0, 0] * (SOURCES[:, :1] > CENTRE[0]), gradients


def inside_out() -> tuple[np.ndarray, np.ndarray]:
    return SOURCES, Rotation.random(len(SOURCES), random_state=0).as_matrix().astype(np.float32)


MOTIONS: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = {"bent": bent, "torn": torn, "inside out": inside_out}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("neighbours", [1, 16])
@pytest.mark.parametrize("name", MOTIONS)
def test_a_device_carries_points_as_the_processor_does(
    launcher: Launcher, name: str, neighbours: int, kind: type
) -> None:
    x, gradients = MOTIONS[name]()
    x = x.astype(kind)
    weights = bind_points(POINTS, SOURCES, neighbours=neighbours)
    expected, grown, turned = carry(weights, x, gradients)
    points, found, alone = Carrier(weights, launcher).carry(x, gradients)
    assert points.dtype == expected.dtype == kind and found.dtype == np.float32
    assert alone == turned and (turned > 0) == (name != "bent" and neighbours > 1)
    assert_same(found, grown, 1e-6)
    # Sums of single precision around the nearest source, in another order; then the sum with where that is.
    near = np.abs(expected - x[weights.source[:, 0]]).max() + np.abs(x - x.mean(axis=0)).max()
    np.testing.assert_allclose(points, expected, rtol=2 * EPS if kind is np.float32 else 0, atol=2 * EPS * near)
    assert np.abs(expected - POINTS).max() > 0.01


@pytest.mark.parametrize("shape", ["full", "coplanar", "collinear", "single"])
def test_affine_motion_is_exact_on_a_device(launcher: Launcher, shape: str) -> None:
    sources = {
        "full": SOURCES,
        "coplanar": SOURCES * [1, 1, 0] + [0, 0, CENTRE[2]],
        "collinear": SOURCES[:200] * [1, 0, 0] + [0, *CENTRE[1:]],
        "single": SOURCES[:1],
    }[shape]
    linear = Rotation.from_rotvec([0.3, 0.8, -0.2]).as_matrix() @ [[1.5, 0.4, 0], [0, 0.8, 0], [0.1, 0, 1.1]]
    move = lambda p: (p - CENTRE) @ linear.T + [1, 2, 3]  # noqa: E731
    carrier = Carrier(bind_points(POINTS, sources), launcher)
    moved, gradients, turned = carrier.carry(move(sources), np.tile(linear, (len(sources), 1, 1)))
    assert np.abs(moved - move(POINTS)).max() < 1e-6
    assert np.abs(gradients - linear).max() < 2e-5
    assert turned == 0


def test_nothing_to_carry(launcher: Launcher) -> None:
    points, gradients, turned = Carrier(bind_points(POINTS[:0], SOURCES), launcher).carry(*bent())
    assert (points.shape, gradients.shape, turned) == ((0, 3), (0, 3, 3), 0)


def test_of_a_frame_only_the_sources_go_to_the_device(launcher: Launcher, monkeypatch: pytest.MonkeyPatch) -> None:
    weights, copied, copy = bind_points(POINTS, SOURCES), [], launcher.array
    expected = carry(weights, *torn())[0]
    monkeypatch.setattr(launcher, "array", lambda array, *more: copied.append(array.nbytes) or copy(array, *more))
    carrier = Carrier(weights, launcher)
    for array in (weights.source, weights.weight, weights.offset, weights.reach):
        array.view(np.uint8)[...] = 0  # a card cannot read this memory
    copied.clear()
    points, _, _ = carrier.carry(*torn())
    assert copied == [64 * len(SOURCES)]
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-6)


# --- baked -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Warp's processor is the card; the number of points of each call of `Carrier.carry`."""
    monkeypatch.setattr("drgs_blender.simulation.solver.name_of", lambda device: DEVICE)
    inner, calls = Carrier.carry, []

    def carried(carrier: Carrier, *given: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        found = inner(carrier, *given)
        calls.append(len(found[0]))
        return found

    monkeypatch.setattr(Carrier, "carry", carried)
    return calls


def test_a_bake_carries_its_mesh_on_its_device(card: list[int], tmp_path: Path) -> None:
    there, here = job_of(device="cuda"), job_of()
    bake(there, ParticleCache(tmp_path / "there"))
    rest = there.rest().vertices
    assert card == [len(rest)] * 5
    assert isinstance(there.solver.grid, DeviceGrid)
    here.solver.restore(there.solver.frame, there.solver.arrays())
    found, expected = there.now().vertices, here.now().vertices
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert len(card) == 6 and np.abs(expected - rest).max() > 0.05


def test_a_bake_whose_device_cannot_carry_its_mesh_is_whole(
    card: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    carried = Carrier.carry

    def broken(carrier: Carrier, *given: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        if len(card) == 2:
            with carrier.launcher.failures("carrying points"):
                raise RuntimeError("Failed to allocate 12 bytes on device 'cuda:0'\nlog")
        return carried(carrier, *given)

    monkeypatch.setattr(Carrier, "carry", broken)
    cache, job, here = ParticleCache(tmp_path), job_of(device="cuda"), job_of()
    assert bake(job, cache) == 5
    (said,) = caplog.messages
    assert "Failed to allocate" in said and said.endswith("The mesh is carried on the CPU from frame 4 on")
    assert isinstance(job.solver.grid, DeviceGrid) and len(card) == 2
    here.solver.restore(job.solver.frame, job.solver.arrays())
    np.testing.assert_array_equal(cache.read(6).vertices, here.now().vertices)
