"""Several bodies that push each other: one time step for all, contact where they share nodes of the grid."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..core.errors import Cancelled
from .body_contact import Side, meet, shared_slots
from .contact import CONTACTS, Contact
from .grid import HostGrid
from .solver import DRIFT, FASTEST, RUNAWAY, Solver

Array = np.ndarray
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Touch:
    """How bodies move along each other: contact, as of colliders, and Coulomb's coefficient, of "separate"."""

    contact: Contact = "separate"
    friction: float = 0.5

    def with_other(self, other: Touch) -> Touch:
        """That of two bodies: the contact that holds more, and the geometric mean of their friction."""
        contact = max(self.contact, other.contact, key=CONTACTS.__getitem__)
        return Touch(contact, float(np.sqrt(self.friction * other.friction)))


class Coupled:
    """Bodies on grids of one domain, from frame to frame.

    Parameters
    ----------
    bodies : sequence of Solver
        Of the same domain, on the CPU. What each of them is in and meets counts for it alone.
    touches : dict, optional
        How two of them touch, by their numbers, the lower one first; `Touch()` for those that it does not name.

    Attributes
    ----------
    frame, steps : int
        Frames done, and time steps taken in all.
    """

    def __init__(self, bodies: Sequence[Solver], touches: dict[tuple[int, int], Touch] | None = None) -> None:
        self.bodies = list(bodies)
        self.domain = bodies[0].domain
        self.frame = self.steps = 0
        self._grids = [HostGrid(body.scene) for body in bodies]
        given = touches or {}
        self._rules = {pair: given.get(pair, Touch()) for pair in combinations(range(len(bodies)), 2)}
        self._slots: dict[tuple[int, int], Array] = {}

    @property
    def rate(self) -> float:
        """Time steps a second, at least: those of the stiffest body."""
        return max(body.rate for body in self.bodies)

    def arrays(self) -> dict[str, Array]:
        """The state of all bodies, those of each one after the other."""
        states = [body.arrays() for body in self.bodies]
        return {name: np.concatenate([state[name] for state in states]) for name in states[0]}

    def restore(self, frame: int, arrays: dict[str, Array]) -> bool:
        """Go on from `arrays` after `frame` frames; False, and nothing changed, where they do not fit."""
        states = [body.arrays() for body in self.bodies]
        if set(arrays) != set(states[0]):
            return False
        ends = {name: np.cumsum([len(state[name]) for state in states]) for name in arrays}
        if any(len(array) != ends[name][-1] for name, array in arrays.items()):
            return False
        parts = {name: np.split(array, ends[name][:-1]) for name, array in arrays.items()}
        for i, body in enumerate(self.bodies):
            if not body.restore(frame, {name: parts[name][i] for name in arrays}):
                for other, state in zip(self.bodies[:i], states, strict=False):
                    other.restore(self.frame, state)
                return False
        self.frame = frame
        return True

    def advance(
        self,
        seconds: float,
        pin_targets: Sequence[Array | None] | None = None,
        cancelled: Callable[[], bool] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> None:
        """Compute one frame of all bodies; what it takes and raises is as of `Stepper.advance`."""
        before = [body.state for body in self.bodies]
        try:
            self._advance(seconds, pin_targets or [None] * len(before), cancelled, progress)
        except BaseException:
            for body, state in zip(self.bodies, before, strict=True):
                body.state = state
            raise
        self.frame += 1
        for body in self.bodies:
            body.frame = self.frame

    def _advance(
        self,
        seconds: float,
        pin_targets: Sequence[Array | None],
        cancelled: Callable[[], bool] | None,
        progress: Callable[[float], None] | None,
    ) -> None:
        h, bodies, grids = self.domain.spacing, self.bodies, self._grids
        begun = [body.enter(grid, seconds, pins) for body, grid, pins in zip(bodies, grids, pin_targets, strict=True)]
        speeds, outside, push = (np.array(column) for column in zip(*begun, strict=True))
        usual = min(1 / self.rate if self.rate else np.inf, seconds)
        done, drift = 0.0, np.inf
        while done < seconds * (1 - 1e-9):
            if cancelled is not None and cancelled():
                raise Cancelled
            if drift > DRIFT:
                self._sort()
                drift = 0.0
            longest = min(usual, FASTEST * h / max(float((speeds + push * usual).max()), 1e-12))
            if longest < usual / RUNAWAY and (speeds > outside).any():
                raise bodies[int(speeds.argmax())].ran_away(float(speeds.max()))
            dt = (seconds - done) / np.ceil((seconds - done) / longest - 1e-9)
            self._step(done, dt, speeds)
            speeds = np.maximum(speeds, outside)
            drift += float(speeds.max()) * dt / h
            done += dt
            self.steps += 1
            if progress is not None:
                progress(done / seconds)
        for body, grid in zip(bodies, grids, strict=True):
            body.leave(grid)

    def _sort(self) -> None:
        for body, grid in zip(self.bodies, self._grids, strict=True):
            body.sort(grid)
        places = [grid.places for grid in self._grids]
        self._slots = {(i, j): shared_slots(places[i].active, places[i].slot, places[j].slot) for i, j in self._rules}

    def _step(self, done: float, dt: float, speeds: Array) -> None:
        """Take a step of `dt`; `speeds` is written."""
        for grid in self._grids:
            grid.to_nodes(done, dt)
        sides: dict[int, Side] = {}
        for (i, j), slots in self._slots.items():
            if len(slots):
                for k in (i, j):
                    sides[k] = sides.get(k) or self._grids[k].side()
                rule = self._rules[i, j]
                given = self.domain.origin, self.domain.spacing, dt, (CONTACTS[rule.contact], rule.friction)
                meet(slots, sides[i], sides[j], *given)
        for k, grid in enumerate(self._grids):
            speeds[k] = grid.from_nodes(done, dt)
            if not np.isfinite(speeds[k]):
                raise self.bodies[k].became_infinite()
