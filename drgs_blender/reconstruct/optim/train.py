"""Stage (i): surfels optimised until they look like the photographs and lie on one surface.

Each step renders one view. The loss is L1 and SSIM of the picture, the mask, distortion and the agreement of the
surfels' normals with those of the depth map (Huang et al. 2024, "2D Gaussian Splatting"), the last two once shape has
begun to form. The first part runs at half size, where a step costs a quarter.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ...core.arrays import Array
from ...core.errors import DeviceError
from ..backend import HERE, Processor
from ..capture.capture import Capture
from ..capture.training_views import Target, background_of, pixel_rays, targets
from ..meshing.visual_hull import Region
from ..model.attributes import TINT
from ..model.densification import densify
from ..model.gaussians import Gaussians, Look
from ..model.initialisation import enough, inside_hull, on_hull
from ..model.raster import Tally
from .adam import Adam

log = logging.getLogger(__name__)
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Schedule:
    """How surfels are learned.

    Attributes
    ----------
    iterations : steps, one view each
    surfels : how many there are at the end of densification, at most: see `enough`
    coarse : part of the steps that is done at half size
    densify : parts of the steps between which surfels are cut; `rounds` times
    shape : part of the steps after which distortion and normals count
    mask, distortion, consistency : weights of the losses
    mirrors : part of the steps after which reflections are learned; 1 never
    bands : highest band of the colour's harmonics
    """

    iterations: int = 3000
    surfels: int = 16000
    coarse: float = 0.3
    densify: tuple[float, float] = (0.08, 0.6)
    rounds: int = 16
    shape: float = 0.15
    mask: float = 0.1
    distortion: float = 1.0
    consistency: float = 0.25
    mirrors: float = 0.1
    bands: int = 2
    seed: int = 0

    def on_mesh(self, part: float) -> Schedule:
        """For surfels that have their place: `part` of the steps, in full size, and no more surfels."""
        return replace(
            self, iterations=max(int(part * self.iterations), 1), coarse=0.0, rounds=0, shape=0.0, mirrors=0.0
        )


#: Part of the schedule that both starts of `initialisation` are tried for, by views of which every n-th is kept aside;
#: decibels there that surfels inside the hull must bring. At least so many views leave some to keep aside.
TRIAL, ASIDE, WORTH, MANY = 0.2, 8, 0.75, 16
#: Part of the weight of `Schedule.consistency` that matte pixels have, and what the tint of mirrors adds to it.
MATTE, MIRRORED = 0.2, 5.0
#: Learning rates at the start, and what is left of them at the end; of centres a part of the object's radius.
RATES = {"centre": (1.5e-3, 0.01), "scale": (8e-3, 0.2), "rotation": (4e-3, 0.2), "opacity": (4e-2, 0.3)}
RATES |= {"tint": (6e-2, 0.2), "blur": (6e-2, 0.2)}
LIGHT_RATE = (4e-2, 0.1)
COLOUR_RATE, HIGHER_BANDS = (2e-2, 0.1), 0.1
#: Seconds between two states that outlive the device.  Pixels of all views up to which these stay there, 16 bytes each.
KEEP_EVERY, KEPT_THERE = 20.0, 100_000_000


class Training:
    """The state of stage (i), one `step` at a time.

    Parameters
    ----------
    capture : its training views are learned from
    region : where the object is
    schedule : how
    gaussians : to go on with; None tries both of `initialisation`
    seconds : where the steps would take longer, the schedule runs by the clock
    by : who does the steps; what it fails at, and all that follows, is done here

    Attributes
    ----------
    failed : why another one than this processor is of no use any more, in words
    """

    def __init__(
        self,
        capture: Capture,
        region: Region,
        schedule: Schedule,
        gaussians: Gaussians | None = None,
        seconds: float | None = None,
        by: Processor = HERE,
    ) -> None:
        self.region, self.limit = region, seconds
        self.targets = targets(capture)
        self.schedule = schedule = replace(schedule, surfels=min(schedule.surfels, enough(self.targets[0])))
        self._behind = background_of(capture)
        self._pixels = sum(view.camera.width * view.camera.height for views in self.targets for view in views)
        self._rival: Gaussians | None = None
        self._before: dict[str, Array] | None = None  # state of the first start, and its error in views kept "aside"
        if gaussians is None:
            gaussians = on_hull(capture, region, schedule.surfels, schedule.bands, schedule.seed)
            if len(capture.training) >= MANY:
                self._rival = inside_hull(gaussians, capture, region, schedule.bands, schedule.seed)
        self._tried = 0.0  # seconds that a trial took
        self.failed = ""
        self._begin(gaussians, by)

    def _begin(self, gaussians: Gaussians, by: Processor) -> None:
        """Learn these from the first step on."""
        self._begun = gaussians
        self.start = len(gaussians)
        self.iteration, self.seconds, self.rounds = 0, 0.0, 0
        self.error = 0.0  # running mean of the squared error
        self._take_on(HERE)
        if by is not HERE:
            self._keep()
            self.attempt(lambda: None if self.failed else self._take_on(by), whole=False)

    def _take_on(self, by: Processor) -> None:
        """Have `by` do the steps, from the first one."""
        self.by = by  # before anything that may fail there
        self.gaussians = self._begun.on(by)
        self.optimiser = Adam(self.gaussians.parameters, by.descend)
        light = self.gaussians.light
        self.light = Adam({} if light is None else {"light": light}, by.descend)
        self.tally = Tally.of(len(self.gaussians), by.place)
        self.background = torch.tensor(self._behind, dtype=torch.float32, device=by.place)
        few = self._pixels <= KEPT_THERE
        self._views = [[by.bring(view) for view in views] for views in self.targets] if few else self.targets

    def attempt(self, work: Callable[[], _T], whole: bool = True) -> _T:
        """Have the processor do some work; where it fails, this one does it, and goes on.

        Parameters
        ----------
        whole : the state is of use when the work was left half-done; else the last one that was kept is
        """
        try:
            return work()
        except (DeviceError, RuntimeError) as error:
            if self.by is HERE:
                raise
            self.failed = (str(error).strip() or type(error).__name__).splitlines()[0]
            state = self._kept
            with suppress(DeviceError, RuntimeError):
                state = self._state() if whole else state
            self._take_on(HERE)
            self._restore(state)
            log.warning("%s Learned on the CPU from step %d on", self.failed, self.iteration)
        return work()

    def _keep(self) -> None:
        """Remember a state that the device cannot take along when it fails."""
        self._remember(self.attempt(self._state))

    def _remember(self, state: dict[str, Array]) -> None:
        self._kept = {name: np.array(value) for name, value in state.items()}
        self._kept_at = time.monotonic()

    @property
    def trying(self) -> bool:
        """Two starts are being tried."""
        return self._rival is not None

    @property
    def part(self) -> float:
        """What is done of the schedule, 0..1."""
        by_steps, by_clock = self.iteration / self.schedule.iterations, 0.0
        if self.limit:
            # Both starts together get a trial's share of the time, and what comes after goes on from there.
            begun, left = (TRIAL, (self.limit - self._tried) / (1 - TRIAL)) if self._tried else (0.0, self.limit)
            by_clock = begun + (self.seconds - self._tried) / max(left / 2 if self.trying else left, 1e-3)
        return min(max(by_steps, by_clock), 1.0)

    @property
    def finished(self) -> bool:
        """Nothing is left to do."""
        return self.part >= 1 and not self.trying

    def step(self) -> None:
        """One view."""
        started = time.monotonic()
        with _one_thread():
            self.attempt(self._learn)
        self.iteration += 1
        self._maybe_densify()
        self._maybe_decide()
        if self.by is not HERE and time.monotonic() > self._kept_at + KEEP_EVERY:
            self._keep()
        self.seconds += time.monotonic() - started

    def _learn(self) -> None:
        # Also when done again, after a device has left it half-done.
        self.optimiser.steps = self.light.steps = self.iteration
        schedule, part = self.schedule, self.part
        target = self._next()
        rays = pixel_rays(target.camera, self.by.place)
        bands = min(schedule.bands, int(part * 8))
        growing = part < schedule.densify[1]
        mirrors = part >= schedule.mirrors < 1
        tally = self.tally if growing else None
        look = self.gaussians.look(target.camera, self.background, bands, tally, rays, mirrors)
        loss = self._loss(look, target, rays, part)
        loss.backward()
        self.optimiser.step(self.gaussians.parameters, self._rates(part))
        if self.gaussians.light is not None:
            self.light.step({"light": self.gaussians.light}, {"light": LIGHT_RATE[0] * LIGHT_RATE[1] ** part})
        squared = _squared_error(look, target)
        self.error = squared if not self.iteration else 0.98 * self.error + 0.02 * squared

    @property
    def psnr(self) -> float | None:
        """Of the latest training views, decibels; None before the first step."""
        return None if not self.iteration else -10 * float(np.log10(max(self.error, 1e-10)))

    def _next(self) -> Target:
        """The view of this step: all in turn, in an order drawn anew each time."""
        scale = 1 if self.part < self.schedule.coarse else 0
        views = self._views[scale]
        if self.trying:
            views = [view for k, view in enumerate(views) if not _aside(k)]
        turn, place = divmod(self.iteration, len(views))
        return self.by.bring(views[np.random.default_rng([self.schedule.seed, turn]).permutation(len(views))[place]])

    def _loss(self, look: Look, target: Target, rays: Tensor, part: float) -> Tensor:
        schedule, maps = self.schedule, look.maps
        shaped = part >= schedule.shape
        weights = (
            schedule.mask,
            schedule.distortion / self.region.radius**2 if shaped else 0.0,
            schedule.consistency if shaped else 0.0,
        )
        counts = _importance(maps.features)
        shape = self.by.shape_loss(
            maps.alpha, maps.depth, maps.distortion, look.normal, target.mask, rays, counts, weights
        )
        return self.by.difference(look.colour, target.photograph) + shape

    def _rates(self, part: float) -> dict[str, float | Array]:
        rates: dict[str, float | Array] = {k: first * rest**part for k, (first, rest) in RATES.items()}
        rates["centre"] = float(rates["centre"]) * self.region.radius
        rates["offset"] = RATES["centre"][0] * RATES["centre"][1] ** part * 30
        colour = COLOUR_RATE[0] * COLOUR_RATE[1] ** part
        count = self.gaussians.parameters["sh"].shape[1]
        rates["sh"] = np.repeat(np.where(np.arange(count) == 0, colour, HIGHER_BANDS * colour), 3)
        return rates

    def _maybe_densify(self) -> None:
        schedule = self.schedule
        begin, end = schedule.densify
        grown = min(max((self.part - begin) / (end - begin), 0.0), 1.0)
        due = int(grown * schedule.rounds)
        if due <= self.rounds:
            return
        budget = int(self.start + (schedule.surfels - self.start) * grown)
        if self.by is not HERE:
            self._keep()
        self.attempt(lambda: self._densify(budget), whole=False)
        self.rounds = due

    def _densify(self, budget: int) -> None:
        self.gaussians, report = densify(
            self.gaussians, self.optimiser, self.tally, budget, 0.5 * self.region.radius, 1e-3 * self.region.radius
        )
        self.tally = Tally.of(len(self.gaussians), self.by.place)
        log.debug("step %d: %d surfels, %s", self.iteration, len(self.gaussians), report)

    def _maybe_decide(self) -> None:
        """At the end of a trial: the other start's, or on with the better one."""
        # No more steps than the first had: compiling falls to it, and by the clock that would be counted against it.
        even = self._before is not None and self.iteration >= self._before["counts"][0]
        if self._rival is None or (self.part < TRIAL and not even):
            return
        error = self.attempt(self._error_aside)
        if self._before is None:
            self._before = self.attempt(self._state) | {"aside": np.array([error])}
            self._begin(self._rival, self.by)
            return
        state, spent = self._before, self.seconds + float(self._before["numbers"][1])
        gain = 10 * math.log10(max(float(state["aside"][0]), 1e-10) / max(error, 1e-10))
        log.info("surfels inside the hull: %+.2f dB in views kept aside", gain)
        self._rival, self._before = None, None
        if not gain >= WORTH:  # nor what is no number
            self.attempt(lambda: self._restore(state), whole=False)
        self.seconds = self._tried = spent

    def _error_aside(self) -> float:
        """Mean squared error of the views that are kept aside, in half size."""
        errors = []
        for target in (self.by.bring(view) for k, view in enumerate(self._views[1]) if _aside(k)):
            with torch.no_grad():
                errors.append(_squared_error(self.gaussians.look(target.camera, self.background), target))
        return float(np.mean(errors))

    def arrays(self) -> dict[str, Array]:
        """All that `restore` needs to go on, with any processor; with the same one bit for bit."""
        state = self.attempt(self._state)
        if self.trying:
            state |= {"trying": np.ones(1, np.int64)} | {f"before.{k}": v for k, v in (self._before or {}).items()}
        return state

    def _state(self) -> dict[str, Array]:
        tensors = {"travel": self.tally.travel, "views": self.tally.views}
        tensors |= {f"first.{k}": v for k, v in self.optimiser.first.items()}
        tensors |= {f"second.{k}": v for k, v in self.optimiser.second.items()}
        if self.gaussians.light is not None:
            tensors |= {"light": self.gaussians.light, "light.first": self.light.first["light"]}
            tensors["light.second"] = self.light.second["light"]
        state = {f"value.{k}": v for k, v in self.gaussians.arrays().items()}
        state |= {k: v.numpy(force=True) for k, v in tensors.items()}
        state["counts"] = np.array(
            [self.iteration, self.optimiser.steps, self.start, self.rounds, self.light.steps], np.int64
        )
        state["numbers"] = np.array([self.error, self.seconds, self._tried])
        return state

    def restore(self, state: dict[str, Array]) -> None:
        """Go on from what `arrays` returned."""
        if "trying" not in state:
            self._rival = None
        before = {k.removeprefix("before."): v for k, v in state.items() if k.startswith("before.")}
        self._before = before if self.trying and before else None
        self._restore(state)

    def _restore(self, state: dict[str, Array]) -> None:
        there = lambda name: torch.tensor(state[name], device=self.by.place)  # noqa: E731
        part = lambda name: {k.removeprefix(name): there(k) for k in state if k.startswith(name)}  # noqa: E731
        if self.gaussians.light is not None:
            self.gaussians.light = there("light").requires_grad_(True)
            self.light.first, self.light.second = {"light": there("light.first")}, {"light": there("light.second")}
        self.gaussians = self.gaussians.like(part("value."))
        self.optimiser.first, self.optimiser.second = part("first."), part("second.")
        self.tally = Tally(there("travel"), there("views"))
        self.iteration, self.optimiser.steps, self.start, self.rounds, self.light.steps = map(int, state["counts"])
        self.error, self.seconds, self._tried = (float(x) for x in state["numbers"])
        self._remember(state)


def _squared_error(look: Look, target: Target) -> float:
    """Mean over the picture."""
    return float((look.colour.detach().clamp(0, 1) - target.colour).square().mean())


def _aside(view: int) -> bool:
    """Whether a trial keeps this view for its end."""
    return view % ASIDE == ASIDE // 2


def _importance(features: Tensor) -> Tensor:
    """(h, w) float32 in 0..1, what the agreement of normals counts: where a surface mirrors, they decide its colour.

    Where it does not, the agreement mostly rounds off edges: on the toy bulldozer of NeRF-synthetic it cost 0.7 dB.
    """
    # A sum: the mean of no channels is none.
    return (MATTE + MIRRORED / 3 * features.detach()[..., TINT : TINT + 3].sum(-1)).clamp(max=1)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Without torch's threads: what is left to it is so little that waking them takes longer."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
