"""A step of learning on a device, on Warp's device "cpu": each piece and the whole, as this processor has them."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("warp", reason="warp-lang is not installed")

from capture_cases import balls  # noqa: E402
from cards import DEVICE, assert_same  # noqa: E402
from test_reconstruct_attributes import EYE, surfels  # noqa: E402
from test_reconstruct_patches import given as two_views  # noqa: E402

from drgs_blender.compute.warp.kernels import WarpKernel  # noqa: E402
from drgs_blender.compute.warp.runtime import parts_of  # noqa: E402
from drgs_blender.core.errors import DeviceError  # noqa: E402
from drgs_blender.reconstruct.backend import CPU, LearningBackend  # noqa: E402
from drgs_blender.reconstruct.capture.capture import Capture  # noqa: E402
from drgs_blender.reconstruct.capture.training_views import Target  # noqa: E402
from drgs_blender.reconstruct.gpu import appearance, kernels, losses, select_backend  # noqa: E402
from drgs_blender.reconstruct.gpu import raster as device_raster  # noqa: E402
from drgs_blender.reconstruct.gpu.warp_backend import DESCEND, WarpLearningBackend  # noqa: E402
from drgs_blender.reconstruct.losses.photometric import Photograph  # noqa: E402
from drgs_blender.reconstruct.meshing.visual_hull import Region, find_region  # noqa: E402
from drgs_blender.reconstruct.model.gaussians import Gaussians  # noqa: E402
from drgs_blender.reconstruct.model.reflection_probe import BARE, pyramid  # noqa: E402
from drgs_blender.reconstruct.optim.schedule import Schedule  # noqa: E402
from drgs_blender.reconstruct.optim.train import Training  # noqa: E402
from drgs_blender.reconstruct.pipeline import Settings, reconstruct  # noqa: E402

HEIGHT, WIDTH = 23, 31
#: Where a device fails, and of what, in fast tests.
FAST_FAULTS = {("forth", "device"), ("back", "memory")}


@pytest.fixture(scope="module")
def on_device() -> WarpLearningBackend:
    return WarpLearningBackend(DEVICE)


def random(*shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0) -> Any:
    return torch.tensor(np.random.default_rng([seed, *shape]).uniform(low, high, shape), dtype=torch.float32)


def at(by: LearningBackend, *values: Any) -> tuple[Any, ...]:
    """Tensors where the backend has them."""
    return tuple(value.to(by.device) for value in values)


def assert_alike(
    work: Callable[..., Any], inputs: list[Any], on_device: WarpLearningBackend, close: float = 1e-5
) -> None:
    """`work(processor, *inputs)` has the same values and gradients of all inputs on both processors."""
    results = []
    for by in (CPU, on_device):
        given = [value.clone().requires_grad_() for value in inputs]
        found = work(by, *at(by, *given))
        found = at(CPU, *(found if isinstance(found, tuple) else (found,)))
        sum((f * random(*f.shape, seed=9, low=-1)).sum() for f in found).backward()
        grads = [torch.zeros_like(g) if g.grad is None else g.grad for g in given]
        results.append([*(f.detach() for f in found), *grads])
    for k, (a, b) in enumerate(zip(*results, strict=True)):
        assert (a - b).norm() <= close * a.norm(), (k, float(a.norm()), float((a - b).norm()))


@pytest.mark.parametrize(("bands", "reflections"), [(0, True), (2, True), (1, False)])
def test_attributes(on_device: WarpLearningBackend, bands: int, reflections: bool) -> None:
    raw, centre = surfels()

    def work(by: LearningBackend, *values: Any) -> Any:
        return by.attributes(dict(zip(raw, values, strict=True)), *at(by, centre), EYE, bands, reflections)

    assert_alike(work, list(raw.values()), on_device)


def test_a_step_leaves_nothing_behind(on_device: WarpLearningBackend) -> None:
    """What backward needs goes with the graph, and not when the garbage collector finds a cycle, if it can."""
    raw, centre = surfels()
    gc.disable()
    try:
        values = {name: value.clone().to(on_device.device).requires_grad_() for name, value in raw.items()}
        found = on_device.attributes(values, *at(on_device, centre), EYE, 1, True)
        kept = [weakref.ref(tensor) for tensor in found]
        sum(tensor.sum() for tensor in found).backward()
        del found
        assert [tensor() for tensor in kept] == [None] * 4
    finally:
        gc.enable()


def test_what_is_mirrored(on_device: WarpLearningBackend) -> None:
    """Pixels hardly covered among them, and one without a normal."""
    features, alpha = random(HEIGHT, WIDTH, 10, low=-1), random(HEIGHT, WIDTH, seed=1)
    features[..., 6:] = 0.9 * alpha[..., None] * features[..., 6:].abs()
    alpha[:3] = 0.9 * float(BARE)
    features[4, 5, 3:6] = 0
    rays, cube = random(HEIGHT, WIDTH, 3, seed=2, low=-1), random(6, 3, 32, 32, seed=3, low=-2)
    assert_alike(lambda by, f, a, c: by.mirrored(f, a, *at(by, rays), pyramid(c)), [features, alpha, cube], on_device)


def test_gradients_of_shared_texels_do_not_depend_on_the_order(on_device: WarpLearningBackend) -> None:
    index, pull = at(on_device, torch.randint(0, 50, (4000,)), random(4000, 3, seed=1, low=-1e3, high=1e3))
    pull[7] = float("nan")  # of a surfel that is damaged: it must not spoil the others
    orders = at(on_device, torch.arange(4000), torch.randperm(4000))
    found = [appearance.sum_rows(index[order], pull[order], 50).cpu() for order in orders]
    index, pull = at(CPU, index, pull)
    assert torch.equal(*found)
    exact = torch.zeros(50, 3, dtype=torch.float64).index_add(0, index, torch.nan_to_num(pull).double())
    torch.testing.assert_close(found[0].double(), exact, rtol=1e-6, atol=1e-6)


def test_difference_from_a_photograph(on_device: WarpLearningBackend) -> None:
    """Saturated in part, where brighter is as good."""
    colour = random(HEIGHT, WIDTH, 3)
    colour[5:9] = 1.0
    target = Target(None, Photograph.of(colour.numpy()), None)  # type: ignore[arg-type]
    picture = random(HEIGHT, WIDTH, 3, seed=1, high=1.3)
    assert_alike(lambda by, p: by.difference(p, by.bring(target).photograph), [picture], on_device)


@pytest.mark.parametrize("weights", [(0.1, 0.0, 0.0), (0.0, 0.7, 0.0), (0.0, 0.0, 0.25)])
def test_losses_of_the_shape(on_device: WarpLearningBackend, weights: tuple[float, float, float]) -> None:
    alpha = random(HEIGHT, WIDTH, low=0.2)
    alpha[:4, :5] = 0
    maps = [alpha, alpha * (3 + 0.3 * random(HEIGHT, WIDTH, seed=1)), random(HEIGHT, WIDTH, seed=2)]
    normal, mask = random(HEIGHT, WIDTH, 3, seed=3, low=-0.7, high=0.7), random(HEIGHT, WIDTH, seed=4)
    rays, counts = random(HEIGHT, WIDTH, 3, seed=5, low=-1), random(HEIGHT, WIDTH, seed=6)
    work = lambda by, a, z, d, n: by.shape_loss(a, z, d, n, *at(by, mask, rays, counts), weights)  # noqa: E731
    assert_alike(work, [*maps, normal], on_device)


def test_patches_of_two_views(on_device: WarpLearningBackend) -> None:
    given = two_views()
    moving = [given.pop("depth"), given.pop("normal")]

    def loss(by: LearningBackend, depth: Any, normal: Any) -> Any:
        there = {k: at(by, v)[0] if isinstance(v, torch.Tensor) else v for k, v in given.items()}
        return by.patch_loss(depth, normal, **(there | {"greys": at(by, *given["greys"])}))

    assert_alike(loss, moving, on_device, close=1e-2)


def test_a_step_down(on_device: WarpLearningBackend) -> None:
    """To the last bit; gradients that are no numbers change nothing."""
    found = []
    for by in (CPU, on_device):
        value, first, second = at(by, random(50, 6), random(50, 6, seed=1), random(50, 6, seed=2))
        gradient = random(50, 6, seed=3, low=-1)
        gradient[3, 2] = float("nan")
        by.descend(value, *at(by, gradient), first, second, np.linspace(0.01, 0.06, 6, dtype=np.float32))
        found.append(torch.stack([value, first, second]).cpu())
    assert_same(found[1], found[0], 1e-6)
    assert found[1][0, 3, 2] == random(50, 6)[3, 2] != found[1][0, 3, 1]


# --- whole steps -----------------------------------------------------------------------------------------------------

SCHEDULE = Schedule(iterations=60, surfels=1200, rounds=4)


@pytest.fixture(scope="module")
def capture() -> Capture:
    return balls(count=8, size=40)


@pytest.fixture(scope="module")
def region(capture: Capture) -> Region:
    return find_region(capture)


def learned(capture: Capture, region: Region, by: LearningBackend, steps: int) -> Training:
    training = Training(capture, region, SCHEDULE, backend=by)
    for _ in range(steps):
        training.step()
    return training


def alike(a: Training, b: Training) -> float:
    """Largest relative difference of what was learned."""
    found, other = a.arrays(), b.arrays()
    assert list(found) == list(other)
    names = [name for name in found if name == "light" or name.startswith("value")]
    return max(float(np.linalg.norm(found[n] - other[n]) / max(np.linalg.norm(found[n]), 1e-9)) for n in names)


@pytest.mark.slow
@pytest.mark.parametrize("band", [0.0, 2.0])
def test_first_steps_are_the_processors(
    capture: Capture, region: Region, on_device: WarpLearningBackend, band: float
) -> None:
    """Also where masks may be wrong at their outlines."""
    capture = replace(capture, views=[replace(view, mask_band=band) for view in capture.views])
    here = learned(capture, region, CPU, 3)
    assert alike(here, learned(capture, region, on_device, 3)) < 1e-5
    assert (alike(here, learned(balls(count=8, size=40), region, CPU, 3)) > 1e-5) == bool(band)


@pytest.mark.slow
def test_a_device_learns_as_well_as_the_processor(
    capture: Capture, region: Region, on_device: WarpLearningBackend
) -> None:
    """All of it: surfels cut, reflections, shape. What begins as last digits grows, but leads no other way."""
    here, other = (learned(capture, region, by, SCHEDULE.iterations) for by in (CPU, on_device))
    assert here.densification.rounds == other.densification.rounds == SCHEDULE.rounds
    assert here.psnr > 20
    assert abs(here.psnr - other.psnr) < 0.1
    assert not other.fallback.failed
    assert other.gaussians.backend is on_device


def test_a_state_of_one_processor_is_of_use_to_the_other(
    capture: Capture, region: Region, on_device: WarpLearningBackend
) -> None:
    for one, other in ((CPU, on_device), (on_device, CPU)):
        begun = learned(capture, region, one, 20)
        going_on = Training(capture, region, SCHEDULE, backend=other)
        going_on.restore(begun.arrays())
        assert going_on.iteration == 20
        assert alike(begun, going_on) == 0
        begun.step(), going_on.step()
        assert alike(begun, going_on) < 1e-5


@pytest.mark.parametrize(
    ("kernel", "error"),
    [
        pytest.param(kernel, error, id=f"{name}-{word}", marks=[] if (name, word) in FAST_FAULTS else pytest.mark.slow)
        for name, kernel in {"forth": kernels.PROJECT, "back": kernels.SUM_PIXELS, "loss": losses.ROWS}.items()
        for word, error in {
            "device": DeviceError("device cuda", "failed"), "memory": RuntimeError("CUDA out of memory")
        }.items()
    ],
)  # fmt: skip
def test_a_device_that_fails_is_a_warning_and_the_processor_goes_on(
    capture: Capture, region: Region, kernel: WarpKernel, error: Exception, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """From where it failed: nothing is lost."""
    on_device = WarpLearningBackend(DEVICE)
    training = learned(capture, region, on_device, 10)
    expected = Training(capture, region, SCHEDULE)
    expected.restore(training.arrays())
    fail_at(kernel, on_device, error, monkeypatch)
    for _ in range(10):
        training.step()
        expected.step()
    (said,) = caplog.messages
    assert str(error) in said and "on the CPU from step 10 on" in said
    assert training.iteration == 20
    assert training.fallback.backend is CPU
    assert training.fallback.failed == str(error)

    assert alike(expected, training) == 0


def fail_at(
    kernel: WarpKernel, on_device: WarpLearningBackend, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Have the device fail at a kernel from now on."""
    launch = on_device.launcher.launch

    def failing(asked: WarpKernel, *arguments: Any) -> None:
        if asked is kernel:
            raise error
        launch(asked, *arguments)

    monkeypatch.setattr(on_device.launcher, "launch", failing)


def test_a_step_that_fails_half_done_is_done_again(
    capture: Capture, region: Region, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_device = WarpLearningBackend(DEVICE)
    training = learned(capture, region, on_device, 10)
    fail_at(DESCEND, on_device, RuntimeError("CUDA error"), monkeypatch)
    training.step()
    learner = training.learner
    assert training.iteration == learner.optimiser.steps == learner.light.steps == 11
    assert training.fallback.backend is CPU


def broken(*_: Any, **__: Any) -> None:
    raise RuntimeError("an illegal memory access was encountered")


def kept(capture: Capture, region: Region) -> tuple[Training, Training]:
    """A training on a device that has kept its state, and one of this processor with the same."""
    training, here = learned(capture, region, WarpLearningBackend(DEVICE), 7), Training(capture, region, SCHEDULE)
    training.fallback.save_state()
    here.restore(training.arrays())
    return training, here


def step_that_loses_all(training: Training, monkeypatch: pytest.MonkeyPatch) -> None:
    """One at which the device fails, and nothing can be read from it any more."""
    with monkeypatch.context() as patch:
        patch.setattr(training.fallback.backend, "rasterise", broken)
        patch.setattr(training.learner, "arrays", broken)
        training.step()


def test_a_device_whose_memory_is_lost_goes_back_to_the_last_state_kept(
    capture: Capture, region: Region, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After some failures of a card nothing can be read from it any more."""
    training, here = kept(capture, region)
    training.step()
    step_that_loses_all(training, monkeypatch)
    here.step()
    assert training.fallback.backend is CPU
    assert training.iteration == here.iteration == 8
    assert alike(here, training) == 0


def test_a_run_taken_up_on_a_device_goes_back_to_where_it_was_taken_up(
    capture: Capture, region: Region, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = learned(capture, region, CPU, 5)
    training = Training(capture, region, SCHEDULE, backend=WarpLearningBackend(DEVICE))
    training.restore(begun.arrays())
    step_that_loses_all(training, monkeypatch)
    begun.step()
    assert training.fallback.backend is CPU
    assert training.iteration == 6
    assert alike(begun, training) == 0


def test_a_device_that_fails_before_the_first_step_learns_nothing(
    capture: Capture, region: Region, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one does whose memory was lost in an earlier phase."""
    on = Gaussians.on

    def broken_there(self: Gaussians, by: LearningBackend) -> Gaussians:
        return on(self, by) if by is CPU else broken()

    monkeypatch.setattr(Gaussians, "on", broken_there)
    training = Training(capture, region, SCHEDULE, backend=WarpLearningBackend(DEVICE))
    assert training.fallback.backend is CPU
    assert "illegal memory" in training.fallback.failed
    training.step()


def test_a_device_that_fails_between_two_starts_loses_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second begins with its first step, not with the first one's last."""
    capture = balls(count=24, size=40)
    training = Training(capture, find_region(capture), SCHEDULE, backend=WarpLearningBackend(DEVICE))
    rival, on = training.trial.rival, Gaussians.on
    assert rival is not None
    while training.iteration < 11:
        training.step()

    def broken_there(self: Gaussians, by: LearningBackend) -> Gaussians:
        return on(self, by) if by is CPU else broken()

    monkeypatch.setattr(Gaussians, "on", broken_there)
    training.step()
    assert training.fallback.failed and training.fallback.backend is CPU
    assert training.trying and training.iteration == training.densification.rounds == 0
    assert len(training.gaussians) == training.densification.start == len(rival)
    while training.trying:
        training.step()
    assert training.iteration == 12


def test_surfels_half_cut_are_of_no_use(capture: Capture, region: Region, monkeypatch: pytest.MonkeyPatch) -> None:
    training, here = kept(capture, region)

    def half(rows: Any) -> None:
        training.learner.optimiser.first.clear()
        broken()

    monkeypatch.setattr(training.learner.optimiser, "reindex", half)
    training.learner.iteration = here.learner.iteration = 40
    training.densify_when_due()
    here.densify_when_due()
    assert training.fallback.backend is CPU
    assert len(training.gaussians) > 1.2 * training.densification.start
    assert training.densification.rounds == here.densification.rounds > 0
    assert alike(here, training) == 0


def test_without_a_card_the_processor_learns_and_a_warning_says_why(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def none(device: str) -> str:
        raise DeviceError("device cuda", "no NVIDIA card with a driver was found")

    monkeypatch.setattr(select_backend, "name_of", none)
    assert select_backend.select_backend("cuda") is CPU
    monkeypatch.setattr(select_backend, "name_of", lambda device: "cuda:0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert select_backend.select_backend("cuda") is CPU
    assert select_backend.select_backend("cpu") is CPU
    first, second = caplog.messages
    assert "no NVIDIA card" in first and "PyTorch" in second and "a build of it for CUDA" in second


def test_nothing_of_this_process_meets_what_is_on_a_device(
    capture: Capture, region: Region, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A whole step with tensors that have a place but no content: torch refuses what it would refuse on a card."""
    asked = []

    def launch(kernel: WarpKernel, pieces: int, arguments: Any, out: Any) -> None:
        tensors = [part for part in parts_of((arguments, out)) if isinstance(part, torch.Tensor)]
        assert {tensor.device.type for tensor in tensors} == {"meta"}, kernel.function.__name__
        asked.append(kernel)

    on_device = WarpLearningBackend(DEVICE)
    on_device.device = torch.device("meta")
    monkeypatch.setattr(on_device.launcher, "launch", launch)
    ends = lambda counts: (torch.nn.functional.pad(torch.cumsum(counts, 0), (1, 0)), 1000)  # noqa: E731
    monkeypatch.setattr(device_raster, "starts", ends)
    monkeypatch.setattr(torch, "nonzero", lambda x: torch.zeros(90, x.dim(), dtype=torch.int64, device=x.device))
    monkeypatch.setattr(torch.Tensor, "__float__", lambda _: 0.5)
    training = Training(capture, region, replace(SCHEDULE, reflections=0.0, shape=0.0))
    training.move(on_device)
    training.learner.step(training.views.of_step(0, half=True, without_held_out=False), 0.0)
    training.learner.optimiser.reindex(np.array([0, -1, 2]))
    training.gaussians.select(np.array([1, 2]))
    assert set(asked) >= {kernels.SUM_PIXELS, losses.ROWS, DESCEND}


@pytest.mark.slow
def test_an_asset_is_learned_on_the_device_asked_for(
    capture: Capture, on_device: WarpLearningBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Surfels, mesh, surfels on the mesh: as on this processor, but for what begins as last digits."""
    pytest.importorskip("skimage")
    monkeypatch.setattr(select_backend, "name_of", lambda device: DEVICE)
    used = []
    rasterise = WarpLearningBackend.rasterise
    monkeypatch.setattr(WarpLearningBackend, "rasterise", lambda *a, **k: used.append(1) or rasterise(*a, **k))
    settings = Settings(variant="m", schedule=SCHEDULE, mesh_resolution=32, materials=False)
    expected, found = (reconstruct(capture, replace(settings, device=device)) for device in ("cpu", "cuda"))
    assert len(used) >= 1.4 * SCHEDULE.iterations
    reports = [asset.provenance["report"] for asset in (expected, found)]
    assert abs(reports[0]["psnr"] - reports[1]["psnr"]) < 0.3
    assert reports[0]["psnr"] > 18


def test_a_tensor_of_another_device_is_refused(on_device: WarpLearningBackend) -> None:
    """A card would read its address in its own memory, and fail at everything from then on."""
    value = torch.zeros(3, 2, device="meta")
    with pytest.raises(ValueError, match="a tensor on meta for a kernel on"):
        on_device.launcher.launch(DESCEND, 3, (value, value), (value, value, value))
