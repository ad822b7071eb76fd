"""The schedule of inverse rendering: how far a run is, by steps and by time, and what begins there."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from ...core.arrays import Array
from .settings import Settings

#: Where the environment grows and normals begin to turn (light comes first); the last step size in parts of the first.
_GROWS, _NORMALS, _LAST_RATE = (0.2, 0.45), 0.4, 0.05
#: Where weights by what is shown begin: before, they let light that is much too bright stay so.
_BY_PREDICTION = 0.3
#: From here on metals and paint are distinguished well enough to say how bright and how plain they are.
_METALS = 0.2


class Schedule:
    """Steps and time of a run.

    Parameters
    ----------
    settings : Settings
    now : callable
        Monotonic clock, seconds. The run begins when this is made.

    Attributes
    ----------
    now : callable
    iteration : int
        Steps that are done.
    """

    def __init__(self, settings: Settings, now: Callable[[], float] = time.monotonic) -> None:
        self._settings, self.now = settings, now
        self._spent, self._began = 0.0, now()
        self.iteration = 0

    @property
    def elapsed(self) -> float:
        """Seconds, those before an interruption among them."""
        return self._spent + self.now() - self._began

    @property
    def part(self) -> float:
        """Fraction of the schedule that is done, more than 1 where time is over."""
        done = self.iteration / self._settings.iterations
        return max(done, self.elapsed / self._settings.seconds) if self._settings.seconds > 0 else done

    def going(self) -> bool:
        """Whether there are steps left; the first one is taken however short the time, or nothing would be known."""
        return self.iteration == 0 or self.part < 1

    def go_on(self, iteration: int, spent: float) -> None:
        """Go on after an interruption."""
        self.iteration, self._spent = iteration, spent

    def doublings_ahead(self, part: float) -> int:
        """Number of doublings of the environment's resolution that are still to come."""
        return sum(part < at for at in _GROWS) if self._settings.coarse_to_fine else 0

    def weighs_by_prediction(self) -> bool:
        """Whether differences are weighed by what is shown, else by the photographs."""
        return self._settings.weight_by_prediction and self.part >= _BY_PREDICTION

    def knows_metals(self) -> bool:
        """Whether metals and paint are distinguished."""
        return self.part >= _METALS

    def rates(self, part: float, names: Iterable[str]) -> dict[str, float | Array]:
        """Learning rate of each parameter at a part of the schedule."""
        s = self._settings
        rate = _LAST_RATE**part
        turning = 0.4 if part > _NORMALS else 0.0
        rates = {"light": s.light_rate, "normals": turning * s.rate, "exposure": 0.1 * s.rate}
        return {name: rate * rates.get(name, s.rate) for name in names}
