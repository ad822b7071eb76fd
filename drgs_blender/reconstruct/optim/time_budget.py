"""The time budget of training: seconds spent on steps, as a part of those allowed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from .initialisation_trial import TRIAL


class TimeBudget:
    """Time spent on steps, and what part of a schedule that is.

    Parameters
    ----------
    seconds : float, optional
        The time budget of the whole schedule; None: time does not count.
    now : callable
        Monotonic clock, seconds.

    Attributes
    ----------
    now : callable
    spent : float
        Seconds of the steps so far, in a trial of starts those of the present one.
    tried : float
        Seconds that the trial of starts took, 0 before its end and without one.
    """

    def __init__(self, seconds: float | None, now: Callable[[], float] = time.monotonic) -> None:
        self._budget, self.now = seconds, now
        self.spent = self.tried = 0.0

    def part(self, trying: bool) -> float:
        """Fraction of the time budget that is spent, 0 without one.

        Parameters
        ----------
        trying : bool
            A trial of starts goes on: each of the two has half of the time.
        """
        if not self._budget:
            return 0.0
        # Both starts together get a trial's share of the time, and what comes after goes on from there.
        begun, left = (TRIAL, (self._budget - self.tried) / (1 - TRIAL)) if self.tried else (0.0, self._budget)
        return begun + (self.spent - self.tried) / max(left / 2 if trying else left, 1e-3)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count what is done in this context, unless it fails."""
        started = self.now()
        yield
        self.spent += self.now() - started

    def restart(self) -> None:
        """Begin with a start: the time of another one is not counted."""
        self.spent = 0.0

    def end_trial(self, seconds: float) -> None:
        """Count what a trial of starts took, for both together."""
        self.spent = self.tried = seconds
