"""The grid of the particle solver and the particles on it, while a frame is computed: on this processor's cores."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from ..compute.warp.kernels import Launcher
from .blocks import Arrangement, Domain, arrange
from .colliders import MovingCollider
from .contact import CONTACTS, bound, collide
from .fields import FieldRows, ForceField, blow_nodes
from .p2g_g2p import advance_nodes, gather, hold_pins, scatter

Array = np.ndarray


@dataclass(frozen=True, slots=True)
class Forces:
    """What acts on all matter: gravity (m/s^2), wind (m/s) that pulls with drag (1/s), damping (1/s), fields."""

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drag: float = 0.0
    damping: float = 0.0
    fields: tuple[ForceField, ...] = ()


@dataclass(slots=True)
class State:
    """All that the future depends on, one row a particle.

    Attributes
    ----------
    x : (n, 3) float64 array
        Metres, world.
    v : (n, 3) float32 array
        m/s.
    affine : (n, 9) float32 array
        Velocity gradient of APIC, 1/s.
    elastic : (n, 9) float32 array
        Elastic deformation gradient less 1.
    total : (n, 9) float32 array
        Deformation gradient since the start less 1; no rows where no matter is plastic.
    tau : (n, 6) float32 array
        Kirchhoff stress, Pa: xx, yy, zz, xy, xz, yz.
    memory : (n,) float32 array
        See `constitutive.respond`.
    """

    x: Array
    v: Array
    affine: Array
    elastic: Array
    total: Array
    tau: Array
    memory: Array

    def taken(self, order: Array) -> State:
        """The rows in another order."""
        parts = (getattr(self, f.name) for f in fields(self))
        return State(*(a.take(order, axis=0) if len(a) else a for a in parts))


@dataclass(frozen=True, slots=True)
class Scene:
    """What is the same in every frame.

    Attributes
    ----------
    mass : (n,) float32 array
        kg; none: riders.
    volume : (n,) float32 array
        Cubic metres at rest.
    model : (n,) uint8 array
        See `matter`.
    parameters : (n, k) float32 array
        See `matter`.
    solid : (n,) bool array
        Matter that keeps its shape.
    pins : (k,) int64 array
        Particles that are kinematic.
    least : float
        kg, below which a node is empty.
    """

    domain: Domain
    forces: Forces
    fields: FieldRows
    colliders: list[MovingCollider]
    planes: Array
    mass: Array
    volume: Array
    model: Array
    parameters: Array
    solid: Array
    pins: Array
    least: np.float32


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
        Of the device that it works on, if that is not this processor.
    """

    most = 1
    launcher: Launcher | None = None

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    @abstractmethod
    def enter(self, state: State, frame: int, seconds: float, pin_velocity: Array) -> None:
        """Begin a frame, which the colliders have entered; `state` itself is not changed.

        Parameters
        ----------
        state : State
        frame : int
            Counted from 0.
        seconds : float
            Its length.
        pin_velocity : (k, 3) float32 array
            m/s.
        """

    @abstractmethod
    def sort(self) -> bool:
        """Sort particles; False, and they must not be moved, if one is outside of the domain or not finite."""

    @abstractmethod
    def step(self, times: Sequence[tuple[float, float]], limits: Limits) -> list[float]:
        """Take steps, each given as the time at which it begins and its length, seconds, until limits are met.

        Returns
        -------
        list
            The highest speed at the end of each step that was taken, m/s; not finite where matter is not.
        """

    @abstractmethod
    def state(self) -> State:
        """The state now, in arrays that do not change later."""


class HostGrid(Grid):
    """On this processor: particles lie in the order of the blocks."""

    _state: State
    _a: Arrangement

    def enter(self, state: State, frame: int, seconds: float, pin_velocity: Array) -> None:
        self._state, self._order = state, np.arange(len(state.x))
        self._frame, self._seconds, self._pin_velocity = frame, seconds, pin_velocity

    def sort(self) -> bool:
        scene = self._scene
        self._a, lost = arrange(self._state.x, scene.domain)
        if len(lost):
            return False
        self._state, self._order = self._state.taken(self._a.order), self._order[self._a.order]
        order = self._order
        self._mass, self._volume, self._solid = scene.mass[order], scene.volume[order], scene.solid[order]
        self._model, self._parameters = scene.model[order], scene.parameters[order]
        self._pins = _inverse(order)[scene.pins]
        self._nodes = np.empty((len(self._a.active), 64, 4), np.float32)
        self._held = np.zeros_like(self._nodes) if len(self._pins) else self._nodes[:0]
        self._fastest = np.empty(len(self._a.block), np.float32)
        return True

    def step(self, times: Sequence[tuple[float, float]], limits: Limits) -> list[float]:
        scene, forces, s, a, nodes = self._scene, self._scene.forces, self._state, self._a, self._nodes
        (done, dt), *_ = times
        part = (done + 0.5 * dt) / self._seconds
        h = scene.domain.spacing
        grid = (scene.domain.origin, h)
        places = a.block, a.shares, a.start, a.neighbour
        scatter(s.x, s.v, s.affine, s.tau, self._mass, self._volume, *grid, dt, *places, nodes)
        gravity, wind = np.asarray(forces.gravity, np.float64), np.asarray(forces.wind, np.float64)
        advance_nodes(nodes, scene.least, dt, gravity, wind, forces.drag, forces.damping)
        if len(scene.fields):
            blow_nodes(nodes, a.active, *grid, scene.fields.at(self._frame, part), dt)
        for moving in scene.colliders:
            self._touch(moving, part)
        if len(scene.planes):
            bound(nodes, a.active, *grid, scene.planes)
        if len(self._pins):
            hold_pins(s.x, self._pins, self._pin_velocity, self._mass, *grid, a.slot, nodes, self._held)
            kept = s.x[self._pins] + dt * self._pin_velocity
        gather(
            s.x, s.v, s.affine, s.elastic, s.total, s.tau, s.memory, self._model, self._parameters, self._mass,
            self._solid, *grid, dt, *places, nodes, self._fastest,
        )  # fmt: skip
        if len(self._pins):
            s.x[self._pins], s.v[self._pins] = kept, self._pin_velocity
        return [float(self._fastest.max())]

    def _touch(self, moving: MovingCollider, part: float) -> None:
        place, *motion = moving.at(part)
        if place is None:
            return
        c, domain = moving.collider, self._scene.domain
        collide(
            self._nodes, self._a.active, domain.origin, domain.spacing, place.distance, place.velocity, place.origin,
            place.spacing, *motion, c.thickness, CONTACTS[c.contact], c.friction,
        )  # fmt: skip

    def state(self) -> State:
        return self._state.taken(_inverse(self._order))


def _inverse(order: Array) -> Array:
    """Where each particle is in an order."""
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return place
