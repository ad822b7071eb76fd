"""The differentiable rasteriser on a device, on Warp's device "cpu": what the processor finds, and the brute force."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE, IS_CARD, assert_same  # noqa: E402
from test_reconstruct_raster import (  # noqa: E402
    assert_each_map_matches_brute_force,
    assert_matches_brute_force,
    camera,
    surfels,
)

from drgs_blender.core.errors import DeviceError  # noqa: E402
from drgs_blender.reconstruct.gpu import raster as there  # noqa: E402
from drgs_blender.reconstruct.gpu.launch import TensorLauncher  # noqa: E402
from drgs_blender.reconstruct.model import raster as here  # noqa: E402
from drgs_blender.reconstruct.model.raster import GradientStatistics, Maps  # noqa: E402


@pytest.fixture(scope="module")
def launcher() -> TensorLauncher:
    return TensorLauncher(DEVICE)


@pytest.fixture
def of_its_own(monkeypatch: pytest.MonkeyPatch) -> Iterator[TensorLauncher]:
    """A device with memory of its own: nothing on it may be read as an array of this process."""

    def refuse(*_: Any) -> None:
        raise TypeError("can't convert a tensor of a device to numpy")

    monkeypatch.setattr(torch.Tensor, "numpy", refuse)
    monkeypatch.setattr(torch.Tensor, "__array__", refuse)
    launcher = TensorLauncher(DEVICE)
    launcher.apart = True
    yield launcher
    monkeypatch.undo()


def at(place: Any, rasterise: Any) -> Any:
    """`rasterise` of tensors of this process, done at `place`."""

    def moved(camera: Any, statistics: Any = None, **given: Any) -> Maps:
        maps = rasterise(**{k: v.to(place) for k, v in given.items()}, camera=camera, statistics=statistics)
        return Maps(*(getattr(maps, field.name).cpu() for field in fields(Maps)))

    return moved


def seen(rasterise: Any, n: int, size: float, width: int, height: int) -> list[Any]:
    """Maps, gradients and statistics of random surfels."""
    place = rasterise.args[0].place if isinstance(rasterise, partial) else torch.device("cpu")
    given, statistics = surfels(n, seed=n, size=size), GradientStatistics.of(n, place)
    rasterise = at(place, rasterise)
    maps = rasterise(**given, camera=camera(width, height), statistics=statistics)
    found = [maps.features, maps.alpha, maps.depth, maps.median, maps.distortion]
    rng = np.random.default_rng(1)
    sum((m * torch.tensor(rng.normal(size=m.shape), dtype=torch.float32)).sum() for m in found).backward()
    return [
        *(m.detach() for m in found),
        *(v.grad for v in given.values()),
        statistics.gradient.cpu(),
        statistics.views.cpu(),
    ]


SIZES = [(60, 0.25, 37, 29), (12, 1.5, 100, 70), (2000, 0.08, 100, 70)]


@pytest.mark.parametrize("size", SIZES)
def test_maps_are_the_processors_to_the_last_bit_and_gradients_but_for_it(
    launcher: TensorLauncher, size: tuple[Any, ...]
) -> None:
    expected = seen(here.rasterise, *size)
    found = seen(partial(there.rasterise, launcher), *size)
    for a, b in zip(expected[:5], found[:5], strict=True):
        assert a.abs().max() > 0
        assert_same(b, a, 1e-4)
    for a, b in zip(expected[5:-1], found[5:-1], strict=True):
        assert (a - b).norm() < (1e-3 if IS_CARD else 2e-6) * a.norm()
    np.testing.assert_array_equal(found[-1], expected[-1])


@pytest.mark.parametrize(("n", "size"), [(1, 1.0), (60, 0.25), (400, 0.12)])
def test_maps_and_gradients_are_those_of_the_brute_force(launcher: TensorLauncher, n: int, size: float) -> None:
    assert_matches_brute_force(at(launcher.place, partial(there.rasterise, launcher)), n, size)


def test_every_map_has_a_gradient_of_its_own(launcher: TensorLauncher) -> None:
    assert_each_map_matches_brute_force(at(launcher.place, partial(there.rasterise, launcher)))


def test_a_device_with_memory_of_its_own_finds_the_same_bits_each_time(
    launcher: TensorLauncher, of_its_own: TensorLauncher
) -> None:
    results = [seen(partial(there.rasterise, by), *SIZES[2]) for by in (launcher, of_its_own, of_its_own)]
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_nothing_to_see_and_damaged_surfels_give_no_gradients(launcher: TensorLauncher) -> None:
    given = surfels(5)
    with torch.no_grad():
        given["centre"][:3] += torch.tensor([0.0, -50.0, 0.0])
        given["centre"][3, 0] = float("nan")
        given["tangent_u"][4] = 0
    maps = at(launcher.place, partial(there.rasterise, launcher))(**given, camera=camera())
    assert not maps.alpha.detach().any()
    (maps.features.sum() + maps.depth.sum()).backward()
    assert not any(v.grad.any() for v in given.values())


def test_more_pixels_than_a_device_counts_are_its_failure() -> None:
    with pytest.raises(DeviceError, match="4294967296 pixels"):
        there.starts(torch.tensor([1 << 31, 1 << 31]))
