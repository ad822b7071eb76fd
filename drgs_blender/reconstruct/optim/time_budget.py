"""The time that learning takes, held against a limit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from .initialisation_trial import TRIAL


class TimeBudget:
    """Time spent on steps, and what part of a schedule that is.

    Parameters
    ----------
    limit : float, optional
        Seconds that the whole schedule may take; without, time does not count.
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

    def __init__(self, limit: float | None, now: Callable[[], float] = time.monotonic) -> None:
        self._limit, self.now = limit, now
        self.spent = self.tried = 0.0

    def part(self, trying: bool) -> float:
        """Fraction of the time limit that is spent, 0 without a limit.

        Parameters
        ----------
        trying : bool
            A trial of starts goes on: each of the two has half of the time.
        """
        if not self._limit:
            return 0.0
        # Both starts together get a trial's share of the time, and what comes after goes on from there.
        begun, left = (TRIAL, (self._limit - self.tried) / (1 - TRIAL)) if self.tried else (0.0, self._limit)
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
