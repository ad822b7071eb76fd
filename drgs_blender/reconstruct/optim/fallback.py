"""Work on a device that may fail: the state that outlives it, and the way back to this processor."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol, TypeVar

import numpy as np

from ...core.arrays import Array
from ...core.errors import DeviceError
from ..backend import CPU, LearningBackend

log = logging.getLogger(__name__)
_T = TypeVar("_T")

#: Seconds between two states that outlive the device.
KEEP_EVERY = 20.0


class Movable(Protocol):
    """What is learned, on one processor or another."""

    @property
    def iteration(self) -> int:
        """Steps that are done."""

    def move(self, backend: LearningBackend) -> None:
        """Have `backend` do the steps, from the first one."""

    def state(self) -> dict[str, Array]:
        """All that `take_up` needs to go on with any processor."""

    def take_up(self, state: dict[str, Array]) -> None:
        """Go on from a `state`."""


class Fallback:
    """Who does the steps, and this processor in its stead once it has failed.

    Parameters
    ----------
    learned : Movable
    now : callable
        Seconds since whenever.

    Attributes
    ----------
    backend : LearningBackend
        Who does the steps.
    failed : str
        Why another one than this processor is of no use any more, in words; empty while it is.
    """

    def __init__(self, learned: Movable, now: Callable[[], float] = time.monotonic) -> None:
        self._learned, self._now = learned, now
        self.backend, self.failed = CPU, ""
        self._kept: dict[str, Array] = {}
        self._kept_at = 0.0

    def begin(self, backend: LearningBackend) -> None:
        """Have `backend` do the steps from the first one, if it is of use."""
        self._move(CPU)
        if backend is not CPU:
            self.keep()
            self.attempt(lambda: None if self.failed else self._move(backend), whole=False)

    def attempt(self, work: Callable[[], _T], whole: bool = True) -> _T:
        """Have the processor do some work; where it fails, this one does it, and goes on.

        Parameters
        ----------
        work : callable
        whole : bool
            The state is of use when the work was left half-done; else the last one that was kept is.
        """
        try:
            return work()
        except (DeviceError, RuntimeError) as error:
            if self.backend is CPU:
                raise
            self.failed = (str(error).strip() or type(error).__name__).splitlines()[0]
            state = self._kept
            with suppress(DeviceError, RuntimeError):
                state = self._learned.state() if whole else state
            self._move(CPU)
            self._learned.take_up(state)
            log.warning("%s Learned on the CPU from step %d on", self.failed, self._learned.iteration)
        return work()

    def keep(self) -> None:
        """Remember the state as it is now, so that a device cannot take it along when it fails."""
        self.remember(self.attempt(self._learned.state))

    def keep_if_away(self, every: float = 0.0) -> None:
        """The same, where a device does the work and the last time was `every` seconds ago."""
        if self.backend is not CPU and self._now() >= self._kept_at + every:
            self.keep()

    def remember(self, state: dict[str, Array]) -> None:
        """Go on from this state when the device fails and loses its own."""
        self._kept = {name: np.array(value) for name, value in state.items()}
        self._kept_at = self._now()

    def _move(self, backend: LearningBackend) -> None:
        self.backend = backend  # before anything that may fail there
        self._learned.move(backend)
