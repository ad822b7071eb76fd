"""The grid of the particle solver and the particles on it, while a frame is computed: on the CPU's cores."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..compute.warp.kernels import Launcher
from .body_contact import Side
from .colliders import MovingCollider
from .contact import bound, collide
from .fields import FieldRows, ForceField, blow_nodes
from .grid_blocks import Arrangement, Domain, Nodes, arrange
from .node_forces import advance_nodes, hold_pins
from .p2g_g2p import SCRATCH, g2p, p2g
from .packed import ELASTIC, MASS, TOTAL, move, pack, room_for, unpacked
from .particles import Particles, Properties

Array = np.ndarray

_NO_MARKS = np.zeros((0, 64), np.bool_)


@dataclass(frozen=True, slots=True)
class Forces:
    """Forces on all matter: gravity (m/s^2), wind (m/s) that pulls with drag (1/s), damping (1/s), fields."""

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drag: float = 0.0
    damping: float = 0.0
    fields: tuple[ForceField, ...] = ()


@dataclass(frozen=True, slots=True)
class Scene:
    """Scene data that is the same in every frame.

    Attributes
    ----------
    properties : Properties
    pins : (k,) int64 array
        Particles that are kinematic.
    least : float
        kg, below which a node is empty.
    rim : (n, 4) float32 array
        Of particles: the unit normal of the surface that they lie at, at rest, 0 for none, and cells to it. Contact
        with other bodies needs it.
    """

    domain: Domain
    forces: Forces
    fields: FieldRows
    colliders: list[MovingCollider]
    planes: Array
    properties: Properties
    pins: Array
    least: np.float32
    rim: Array


@dataclass(frozen=True, slots=True)
class Limits:
    """When steps that were planned are no longer good, and others must be.

    Attributes
    ----------
    drift : float
        Cells that particles may still move until they must be sorted again.
    speed : float
        m/s, of the fastest, from which on a step must be shorter.
    outside : float
        m/s, of the fastest of what has a given motion.
    """

    drift: float
    speed: float
    outside: float


class Grid(ABC):
    """Computes time steps.

    Attributes
    ----------
    most : int
        Steps that it takes at once, at most.
    launcher : Launcher, optional
        Of the device that it works on, if that is not the CPU.
    """

    most = 1
    launcher: Launcher | None = None

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    @abstractmethod
    def enter(self, state: Particles, frame: int, seconds: float, pin_velocity: Array) -> None:
        """Begin a frame, which the colliders have entered; `state` itself is not changed.

        Parameters
        ----------
        state : Particles
        frame : int
            Counted from 0.
        seconds : float
            Its length.
        pin_velocity : (k, 3) float32 array
            m/s.
        """

    @abstractmethod
    def sort(self) -> int:
        """Sort particles; how many are outside of the domain or not finite.

        These stay where they are, and no pin may be one of them.
        """

    @abstractmethod
    def step(self, times: Sequence[tuple[float, float]], limits: Limits) -> list[float]:
        """Take steps, each given as the time at which it begins and its length, seconds, until limits are met.

        Returns
        -------
        list
            The highest speed at the end of each step that was taken, m/s; not finite where matter is not.
        """

    @abstractmethod
    def state(self) -> Particles:
        """The state now, in arrays that do not change later."""


class HostGrid(Grid):
    """On the CPU: particles lie in the order of the blocks."""

    _a: Arrangement
    _state: Particles | None  # of a frame that was entered and not sorted yet
    _order: Array

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        n = len(scene.properties.mass)
        self._rows, self._spare = room_for(n), room_for(n)

    def enter(self, state: Particles, frame: int, seconds: float, pin_velocity: Array) -> None:
        self._state, self._kept = state, len(state.total) > 0
        self._frame, self._seconds, self._pin_velocity = frame, seconds, pin_velocity

    def sort(self) -> int:
        scene = self._scene
        self._a, lost = arrange(self._rows.x if self._state is None else self._state.x, scene.domain)
        order = self._a.order
        if self._state is None:
            move(self._rows, order, self._spare)
            self._order = self._order[order]
        else:
            pack(self._state, scene.properties, order, self._spare)
            self._order = order
        self._rows, self._spare, self._state = self._spare, self._rows, None
        self._rim = scene.rim[self._order]
        self._pins = _inverse(self._order)[scene.pins]
        values = np.empty((len(self._a.active), 64, 4), np.float32)
        self._nodes = Nodes(values, self._a.active, scene.domain.origin, scene.domain.spacing)
        self._scratch = np.empty((len(self._a.block), SCRATCH), np.float32)
        self._held = np.zeros_like(values) if len(self._pins) else values[:0]
        self._fastest = np.empty(len(self._a.block), np.float32)
        return len(lost)

    def step(self, times: Sequence[tuple[float, float]], limits: Limits) -> list[float]:
        (done, dt), *_ = times
        self.to_nodes(done, dt)
        return [self.from_nodes(done, dt)]

    def to_nodes(self, done: float, dt: float) -> None:
        """The first half of a step of `dt` that begins at `done`: velocities of the nodes, which met nothing yet."""
        scene, forces, nodes = self._scene, self._scene.forces, self._nodes
        p2g(self._rows, self._a, nodes, dt, self._scratch)
        gravity, wind = np.asarray(forces.gravity, np.float64), np.asarray(forces.wind, np.float64)
        advance_nodes(nodes.values, scene.least, dt, gravity, wind, forces.drag, forces.damping)
        if len(scene.fields):
            blow_nodes(nodes, scene.fields.at(self._frame, (done + 0.5 * dt) / self._seconds), dt)

    def from_nodes(self, done: float, dt: float) -> float:
        """The second half: obstacles and pins, then the particles; the highest speed as `step` gives it."""
        scene, rows, a, nodes = self._scene, self._rows, self._a, self._nodes
        part = (done + 0.5 * dt) / self._seconds
        for moving in scene.colliders:
            field, motion = moving.at(part)
            if field is not None:
                collide(nodes, field, motion, moving.collider.surface)
        if len(scene.planes):
            bound(nodes, scene.planes)
        if len(self._pins):
            self._hold(_NO_MARKS)
            kept = rows.x[self._pins] + dt * self._pin_velocity
        g2p(rows, a, nodes, dt, self._fastest)
        if len(self._pins):
            rows.x[self._pins], rows.motion[self._pins, :MASS] = kept, self._pin_velocity
        return float(self._fastest.max())

    @property
    def places(self) -> Arrangement:
        """Blocks of particles and nodes, until the next sort."""
        return self._a

    def _hold(self, marks: Array) -> None:
        given = self._rows.x, self._rows.motion, self._pins, self._pin_velocity
        hold_pins(*given, self._a.slot, self._nodes, self._held, marks)

    def side(self) -> Side:
        """What other bodies meet, between the halves of a step; nodes that pins hold move as these do."""
        marks = np.zeros((len(self._a.active) if len(self._pins) else 0, 64), np.bool_)
        if len(marks):
            self._hold(marks)
        a, rows = self._a, self._rows
        gradient, first = (rows.matter, TOTAL) if self._kept else (rows.strain, ELASTIC)
        given = rows.x, rows.motion, self._rim, gradient, first
        return Side(*given, a.start, a.source, a.source_start, a.active, a.slot, self._nodes.values, marks)

    def state(self) -> Particles:
        return self._state or unpacked(self._rows, self._order, self._kept)


def _inverse(order: Array) -> Array:
    """Where each particle is in an order."""
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return place
