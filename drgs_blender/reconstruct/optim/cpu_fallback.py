"""Fallback to the CPU when a GPU fails during training."""

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

#: Seconds between two copies of the state, from which training goes on after a failure.
SAVE_EVERY = 20.0


class Movable(Protocol):
    """Training that can be moved between CPU and GPU."""

    @property
    def iteration(self) -> int:
        """Steps that are done."""

    def move(self, backend: LearningBackend) -> None:
        """Run the steps on `backend`, from the first one."""

    def state(self) -> dict[str, Array]:
        """All that `load_state` needs to go on with any backend."""

    def load_state(self, state: dict[str, Array]) -> None:
        """Go on from a `state`."""


class Fallback:
    """The backend of the steps: a GPU, and the CPU once the GPU has failed.

    Parameters
    ----------
    training : Movable
    now : callable
        Monotonic clock, seconds.

    Attributes
    ----------
    backend : LearningBackend
        Where the steps run.
    failed : str
        Why the GPU is not used any more; empty while it is.
    """

    def __init__(self, training: Movable, now: Callable[[], float] = time.monotonic) -> None:
        self._training, self._now = training, now
        self.backend, self.failed = CPU, ""
        self._saved: dict[str, Array] = {}
        self._saved_at = 0.0

    def begin(self, backend: LearningBackend) -> None:
        """Run the steps on `backend` from the first one, unless it has failed before."""
        self._move(CPU)
        if backend is not CPU:
            self.save_state()
            self.attempt(lambda: None if self.failed else self._move(backend), interruptible=False)

    def attempt(self, work: Callable[[], _T], interruptible: bool = True) -> _T:
        """Run `work` on the present backend; where that fails, run it and all that follows on the CPU.

        Parameters
        ----------
        work : callable
        interruptible : bool
            The state is valid after an interruption of the work; otherwise the last copy is loaded.
        """
        try:
            return work()
        except (DeviceError, RuntimeError) as error:
            if self.backend is CPU:
                raise
            self.failed = (str(error).strip() or type(error).__name__).splitlines()[0]
            state = self._saved
            with suppress(DeviceError, RuntimeError):
                state = self._training.state() if interruptible else state
            self._move(CPU)
            self._training.load_state(state)
            log.warning("%s Learned on the CPU from step %d on", self.failed, self._training.iteration)
        return work()

    def save_state(self) -> None:
        """Copy the present state, so that it is not lost when the GPU fails."""
        self.remember(self.attempt(self._training.state))

    def save_gpu_state(self, every: float = 0.0) -> None:
        """Copy the state where the steps run on a GPU and the last copy is `every` seconds old."""
        if self.backend is not CPU and self._now() >= self._saved_at + every:
            self.save_state()

    def remember(self, state: dict[str, Array]) -> None:
        """Go on from this state when the GPU fails and its own is lost."""
        self._saved = {name: np.array(value) for name, value in state.items()}
        self._saved_at = self._now()

    def _move(self, backend: LearningBackend) -> None:
        self.backend = backend  # before anything that may fail there
        self._training.move(backend)
