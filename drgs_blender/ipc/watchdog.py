"""Watchdog: timeouts for missed heartbeats (`Alive` messages) and for a stalled main thread."""

from __future__ import annotations

import time

from ..core.errors import EngineError
from .child_process import Child


class EngineLost(Exception):
    """The engine died, did not answer in time or sent invalid data; a new one is worth a try."""


class Watchdog:
    """Timeouts: how long the engine has been silent, and how long its main thread has made no progress.

    Time is counted in small steps, so that a pause of this process (a debugger, a suspended machine) is not taken
    for one of the engine.
    """

    def __init__(self, child: Child, silence: float, stall: float) -> None:
        self._child, self.silence, self._stall = child, silence, stall
        self._last = time.monotonic()
        self._last_counts = (child.reads, child.steps)
        self._quiet = self._still = 0.0

    def check(self) -> None:
        now = time.monotonic()
        passed, self._last = min(now - self._last, 0.5), now
        reads, steps = self._last_counts
        self._quiet = 0.0 if self._child.reads != reads else self._quiet + passed
        self._still = 0.0 if self._child.steps != steps else self._still + passed
        self._last_counts = (self._child.reads, self._child.steps)
        if self._quiet > self.silence:
            raise EngineLost(f"did not answer for {self.silence:g} s")
        if self._still > self._stall:
            raise EngineError(
                "engine", f"made no progress for {self._stall:g} s", "Try fewer samples or a smaller scene"
            )
