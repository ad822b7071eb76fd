"""The base of the solvers: frames that are whole or not there, and states that are kept and taken up again."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from ..compute.warp.kernels import Launcher
from ..core.errors import UsageError
from .colliders import MovingCollider

Array = np.ndarray


class Stepper(ABC):
    """Computes frames.

    Attributes
    ----------
    frame : int
        Frames done.
    first : int
        Number of the frame in which all is at rest, in messages.
    subject : str
        What is simulated, in messages.
    steps : int
        Time steps taken in all.
    rate : float
        Time steps a second, at least.
    launcher : Launcher or None
        Of the device that computes frames, if that is not the CPU.
    colliders : list of MovingCollider
        Meshes that particles cannot enter.
    planes : array
        Planes that particles cannot pass: rows of `contact.plane_rows`.
    """

    frame = 0
    first = 0
    subject = "simulation"
    steps = 0
    rate: float
    colliders: list[MovingCollider]
    planes: Array

    @property
    def launcher(self) -> Launcher | None:
        return None

    @property
    def lost(self) -> int:
        """Particles that have left the domain, and stay where they left it."""
        return 0

    @property
    @abstractmethod
    def points(self) -> Array:
        """(n, 3) float64 points of the body now, world."""

    @property
    @abstractmethod
    def gradients(self) -> Array:
        """(n, 3, 3) float32 deformation gradient of each point since the start; matter without shape has none: 1."""

    @property
    @abstractmethod
    def markers(self) -> Array:
        """(k, 3) float64 points that ride along, world."""

    @abstractmethod
    def arrays(self) -> dict[str, Array]:
        """The state that `restore` needs to go on from here."""

    @abstractmethod
    def _put(self, arrays: dict[str, Array]) -> None:
        """Take over what `arrays` gave."""

    @abstractmethod
    def _advance(
        self,
        seconds: float,
        pin_targets: Array | None,
        cancelled: Callable[[], bool] | None,
        progress: Callable[[float], None] | None,
    ) -> None:
        """One frame; never changes arrays that `arrays` gave before."""

    def steps_of(self, seconds: float) -> int:
        """Least number of time steps in a time."""
        return max(1, int(np.ceil(seconds * self.rate)))

    def restore(self, frame: int, arrays: dict[str, Array]) -> bool:
        """Go on from `arrays` after `frame` frames; False, and nothing changed, where they do not fit."""
        now = self.arrays()
        if set(arrays) != set(now) or any(
            arrays[k].shape != now[k].shape or arrays[k].dtype != now[k].dtype for k in now
        ):
            return False
        self._put({name: np.array(array) for name, array in arrays.items()})
        self.frame = frame
        return True

    def advance(
        self,
        seconds: float,
        pin_targets: Array | None = None,
        cancelled: Callable[[], bool] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> None:
        """Compute one frame.

        Parameters
        ----------
        seconds : float
            Length of the frame.
        pin_targets : (k, 3) array, optional
            Where the pinned points are at its end; None holds them.
        cancelled : callable, optional
            Asked before each step.
        progress : callable, optional
            Called with the part of the frame that is done.

        Raises
        ------
        Cancelled
            The state is then that at the beginning of the frame.
        UsageError
            Most of the matter left the domain, or its motion ran away: with frame, cause and remedy.
        """
        before = self.arrays()
        try:
            self._advance(seconds, pin_targets, cancelled, progress)
        except BaseException:
            self._put(before)
            raise
        self.frame += 1

    def _error(self, problem: str, remedy: str) -> UsageError:
        return UsageError(f"{self.subject}, frame {self.first + self.frame + 1}", problem, remedy)
