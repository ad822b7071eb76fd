"""Stage (i): surfels optimised until they look like the photographs and lie on one surface.

Each step renders one view. The loss is L1 and SSIM of the picture, the mask, distortion and the agreement of the
surfels' normals with those of the depth map (Huang et al. 2024, "2D Gaussian Splatting"), the last two once shape has
begun to form. A first part may run at half size, where a step costs a quarter.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ...core.arrays import Array
from ..backend import CPU, LearningBackend
from ..capture.capture import Capture
from ..capture.neighbours import neighbours
from ..capture.training_views import background_of, full_targets
from ..meshing.visual_hull import Region
from ..model.gaussians import Gaussians
from ..model.initialisation import inside_hull, on_hull, surfel_limit
from .cpu_fallback import SAVE_EVERY, Fallback
from .densification_schedule import DensificationSchedule
from .initialisation_trial import MIN_VIEWS, Trial
from .learner import Learner
from .schedule import Schedule
from .time_budget import TimeBudget
from .views import Views

_T = TypeVar("_T")


class Training:
    """Stage (i), one `step` at a time: what each part of it does, and when.

    Parameters
    ----------
    capture : Capture
        Its training views are learned from.
    region : Region
        Where the object is.
    schedule : Schedule
    gaussians : Gaussians, optional
        To go on with; without, both of `initialisation` are tried.
    seconds : float, optional
        Time budget; where the steps would take longer, the schedule runs by the time spent.
    backend : LearningBackend
        Backend of the steps; where it fails, they go on on the CPU.
    now : callable
        Monotonic clock, seconds.

    Attributes
    ----------
    region : Region
    schedule : Schedule
    surfels : int
        Their largest number, of the schedule and the photographs.
    targets : list of Target
        Training views in full size.
    time_budget : TimeBudget
    trial : Trial
        Of the starts.
    fallback : Fallback
        Backend of the steps, with its fallback to the CPU.
    densification : DensificationSchedule
    views : Views
    learner : Learner
        Of the present start.
    """

    def __init__(
        self,
        capture: Capture,
        region: Region,
        schedule: Schedule,
        gaussians: Gaussians | None = None,
        seconds: float | None = None,
        backend: LearningBackend = CPU,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.region, self.targets, self._background = region, full_targets(capture), background_of(capture)
        self.schedule = schedule
        self.surfels = surfel_limit(self.targets, schedule.surfels, seconds)
        if schedule.patches:
            self._near = neighbours(capture.training, region.centre)
        rival = None
        if gaussians is None:
            gaussians = on_hull(capture, region, self.surfels, schedule.bands, schedule.seed)
            if len(capture.training) >= MIN_VIEWS:
                rival = inside_hull(gaussians, capture, region, schedule.bands, schedule.seed)
        self.time_budget, self.trial, self.fallback = TimeBudget(seconds, now), Trial(rival), Fallback(self, now)
        self._begin(gaussians, backend)

    def _begin(self, gaussians: Gaussians, backend: LearningBackend) -> None:
        """Learn these from the first step on."""
        self._begun, self.densification = gaussians, DensificationSchedule(self.schedule, len(gaussians), self.surfels)
        self.time_budget.restart()
        self.fallback.begin(backend)

    @property
    def gaussians(self) -> Gaussians:
        """The surfels as trained so far."""
        return self.learner.gaussians

    @property
    def iteration(self) -> int:
        """Steps that are done, of the present start."""
        return self.learner.iteration

    @property
    def trying(self) -> bool:
        """Two starts are being tried."""
        return self.trial.goes_on

    @property
    def part(self) -> float:
        """Fraction of the schedule that is done, 0..1."""
        return min(max(self.iteration / self.schedule.iterations, self.time_budget.part(self.trying)), 1.0)

    @property
    def finished(self) -> bool:
        """Whether the schedule is done."""
        return self.part >= 1 and not self.trying

    @property
    def psnr(self) -> float | None:
        """PSNR of the latest training views, decibels; None before the first step."""
        return None if not self.iteration else -10 * float(np.log10(max(self.learner.error, 1e-10)))

    def step(self) -> None:
        """One view."""
        with self.time_budget.running():
            self.attempt(self._learn)
            self.densify_when_due()
            self._decide_when_due()
            self.fallback.save_gpu_state(SAVE_EVERY)

    def attempt(self, work: Callable[[], _T], interruptible: bool = True) -> _T:
        """Run `work`, if need be on the CPU: see `Fallback.attempt`."""
        return self.fallback.attempt(work, interruptible)

    def _learn(self) -> None:
        part = self.part
        half = part < self.schedule.coarse
        target, beside = self.views.of_step(self.iteration, half, without_held_out=self.trying), None
        if self.schedule.patches and part >= self.schedule.patches_from:
            beside = self.views.beside(self.iteration, half, self.trying, self._near)
        self.learner.step(target, part, beside)

    def densify_when_due(self) -> None:
        """Cut surfels where the schedule has a round of it now."""
        part = self.part
        due = self.densification.due(part)
        if due <= self.densification.rounds:
            return
        budget = self.densification.budget(part)
        self.fallback.save_gpu_state()
        self.attempt(lambda: self.learner.densify(budget), interruptible=False)
        self.densification.rounds = due

    def _decide_when_due(self) -> None:
        """At the end of a trial's turn: the other start's, or on with the better one."""
        if not self.trial.is_due(self.part, self.iteration):
            return
        error = self.attempt(lambda: self.learner.error_of(self.views.held_out()))
        first = self.trial.first
        if first is None:
            self._begin(self.trial.store_first(self.attempt(self.state), error), self.fallback.backend)
            return
        spent = self.time_budget.spent + float(first["numbers"][1])
        better = self.trial.decide(error)
        if better is not None:
            self.attempt(lambda: self.load_state(better), interruptible=False)
        self.time_budget.end_trial(spent)

    def arrays(self) -> dict[str, Array]:
        """All that `restore` needs to go on, with any backend; with the same one bit for bit."""
        return self.attempt(self.state) | self.trial.arrays()

    def restore(self, state: dict[str, Array]) -> None:
        """Go on from what `arrays` returned."""
        self.trial.restore(state)
        self.load_state(state)

    def move(self, backend: LearningBackend) -> None:
        """Run the steps on `backend`, from the first one: see `Fallback`."""
        self.views = Views(self.targets, self._background, backend, self.schedule.seed)
        self.learner = Learner(self._begun, self.schedule, self.region.radius, self.views.background, backend)

    def state(self) -> dict[str, Array]:
        """All of the present start that `load_state` needs."""
        learner, densification = self.learner, self.densification
        counts = [
            learner.iteration,
            learner.optimiser.steps,
            densification.start,
            densification.rounds,
            learner.light.steps,
        ]
        numbers = [learner.error, self.time_budget.spent, self.time_budget.tried]
        return learner.arrays() | {"counts": np.array(counts, np.int64), "numbers": np.array(numbers)}

    def load_state(self, state: dict[str, Array]) -> None:
        """Go on from a `state`, with the trial as it is."""
        learner, densification = self.learner, self.densification
        learner.restore(state)
        learner.iteration, learner.optimiser.steps, densification.start, densification.rounds, learner.light.steps = (
            map(int, state["counts"])
        )
        learner.error, self.time_budget.spent, self.time_budget.tried = (float(x) for x in state["numbers"])
        self.fallback.remember(state)
