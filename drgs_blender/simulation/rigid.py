"""A rigid body, solved by impulses: it falls, tumbles and comes to rest in one piece.

It touches with the particles at its surface, each a small ball. Impulses of contacts are solved one after the other
until they agree (projected Gauss-Seidel, Catto 2005), those of friction within Coulomb's cone. What is inside of an
obstacle is pushed out without gaining speed (split impulses). Particles move along, so that what follows does not know
which solver ran.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ..compute.jit import inlined, njit
from ..core.errors import Cancelled
from .colliders import Collider, MovingCollider, check_apart, rigid_motion
from .contact import CONTACTS, Plane, plane_rows
from .fields import FieldRows, blow
from .solver import Body, Forces
from .stepper import Stepper

Array = np.ndarray

#: Steps in a frame at most.
_MOST_STEPS = 100_000
#: Times that all contacts of a step are looked at.
_ITERATIONS = 24
#: Radii of a ball by which it may stay inside of what it lies on, the part of the rest that it is pushed out in a step,
#: and radii a second at most.
_SLOP, _PUSH, _FASTEST_PUSH = 0.02, 0.2, 60.0
#: Particles that feel force fields.
_FELT = 256
#: Columns of a contact: arm, normal, velocity of the surface, gap, what it does (`CONTACTS`), friction.
_COLUMNS = 12


class Rigid(Stepper):
    """A rigid body; parts pinned lead all of it.

    Parameters
    ----------
    body : Body
        As of `solver.Solver`.
    forces : Forces, optional
        As of `solver.Solver`.
    colliders : sequence of Collider
        As of `solver.Solver`.
    planes : sequence of Plane
        As of `solver.Solver`.
    """

    rate = 480.0

    def __init__(
        self,
        body: Body,
        forces: Forces | None = None,
        colliders: Sequence[Collider] = (),
        planes: Sequence[Plane] = (),
    ) -> None:
        self.body, self.forces = body, forces or Forces()
        mass = np.asarray(body.volume, np.float64) * body.matter.density
        self._mass = float(mass.sum())
        self._centre = mass @ body.points / self._mass
        arm = body.points - self._centre
        spacing = float(np.cbrt(np.asarray(body.volume, np.float64).mean()))
        self._ball = 0.5 * spacing
        self._inertia = _moments(arm, mass) + self._mass * spacing**2 / 6 * np.eye(3)
        velocity = np.broadcast_to(np.asarray(body.velocity, np.float64), arm.shape)
        self.place, self.turn = self._centre.copy(), np.eye(3)
        self.motion = mass @ velocity / self._mass
        self.spin = np.linalg.solve(self._inertia, mass @ np.cross(arm, velocity))
        self._surface = arm[_outermost(body.points, spacing)]
        self._radius = float(np.linalg.norm(arm, axis=1).max()) + self._ball
        self._felt = arm[:: -(-len(arm) // _FELT)]
        self._pins = np.flatnonzero(body.pinned) if body.pinned is not None else np.empty(0, np.int64)
        if len(self._pins):
            self.motion, self.spin = np.zeros(3), np.zeros(3)
        self.planes, self._fields = plane_rows(planes), FieldRows(self.forces.fields)
        everywhere = body.points.min(axis=0) - 1e4 * spacing, body.points.max(axis=0) + 1e4 * spacing
        self.colliders = [MovingCollider(c, 2 * spacing, *everywhere) for c in colliders]
        check_apart(body.points, 2 * spacing, self.colliders, self.planes)

    @property
    def points(self) -> Array:
        return (self.body.points - self._centre) @ self.turn.T + self.place

    @property
    def gradients(self) -> Array:
        return np.tile(self.turn.astype(np.float32), (len(self.body.points), 1, 1))

    @property
    def markers(self) -> Array:
        return (self.body.markers - self._centre) @ self.turn.T + self.place

    def arrays(self) -> dict[str, Array]:
        return {"place": self.place, "turn": self.turn, "motion": self.motion, "spin": self.spin}

    def _put(self, arrays: dict[str, Array]) -> None:
        self.place, self.turn = arrays["place"], arrays["turn"]
        self.motion, self.spin = arrays["motion"], arrays["spin"]

    def _advance(
        self,
        seconds: float,
        pin_targets: Array | None,
        cancelled: Callable[[], bool] | None,
        progress: Callable[[float], None] | None,
    ) -> None:
        points = self.points
        speed = float(np.linalg.norm(self.motion)) + self._radius * float(np.linalg.norm(self.spin))
        speed += (float(np.linalg.norm(self.forces.gravity)) + self._fields.push(self.frame)) * seconds
        for moving in self.colliders:
            moving.enter(self.frame, seconds, points.min(axis=0), points.max(axis=0))
            speed += moving.speed
        if len(self._pins):
            if pin_targets is not None:
                self._led(pin_targets)
            self.steps += 1
            return
        count = max(self.steps_of(seconds), int(min(np.ceil(seconds * speed / self._ball), 1e9)))
        if count > _MOST_STEPS:
            raise self._error(f"moves at {speed:.3g} m/s", "Slow it down, or what hits it")
        dt = seconds / count
        for step in range(count):
            if cancelled is not None and cancelled():
                raise Cancelled
            self._step(dt, step / count, (step + 0.5) / count, 2 * speed * dt)
            self.steps += 1
            if progress is not None:
                progress((step + 1) / count)
        if not (np.isfinite(self.place).all() and np.isfinite(self.spin).all()):
            raise self._error("became infinite", "Lower the velocities")
        self.turn = Rotation.from_matrix(self.turn).as_matrix()

    def _step(self, dt: float, part: float, middle: float, reach: float) -> None:
        forces = self.forces
        damping_factor, drag_factor = np.exp(-dt * forces.damping), 1 - np.exp(-dt * forces.drag)
        self.motion = damping_factor * (self.motion + dt * np.asarray(forces.gravity, np.float64))
        self.motion = self.motion + drag_factor * (np.asarray(forces.wind, np.float64) - self.motion)
        self.spin = damping_factor * (1 - drag_factor) * self.spin
        inverse = np.linalg.inv(self.turn @ self._inertia @ self.turn.T)
        if len(self._fields):
            arm = self._felt @ self.turn.T
            v = self.motion + np.cross(self.spin, arm)
            before, free = v.copy(), np.zeros(len(arm), np.bool_)
            blow(self.place + arm, v, free, self._fields.at(self.frame, middle), dt)
            gained = (v - before) / len(arm)
            self.motion = self.motion + gained.sum(axis=0)
            self.spin = self.spin + self._mass * inverse @ np.cross(arm - arm.mean(axis=0), gained).sum(axis=0)
        rows = self._contacts(part, reach)
        out = np.zeros((2, 3))
        if len(rows):
            both = np.stack([self.motion, self.spin])
            _meet(rows, both, 1 / self._mass, inverse, dt, self._ball, _ITERATIONS)
            self.motion, self.spin = both
            _push_out(rows, out, 1 / self._mass, inverse, dt, self._ball, _ITERATIONS)
        self.place = self.place + dt * (self.motion + out[0])
        momentum = self.turn @ self._inertia @ self.turn.T @ self.spin
        self.turn = Rotation.from_rotvec(dt * (self.spin + out[1])).as_matrix() @ self.turn
        self.spin = np.linalg.solve(self.turn @ self._inertia @ self.turn.T, momentum)

    def _contacts(self, part: float, reach: float) -> Array:
        """Rows of what is nearer than `reach`."""
        arm = self._surface @ self.turn.T
        at = self.place + arm
        found = []
        for plane in self.planes:
            gap = at @ plane[:3] - plane[3] - self._ball
            near = gap < reach
            found.append(_rows(arm[near], plane[:3], np.zeros(3), gap[near], plane[4], plane[5]))
        for moving in self.colliders:
            seen = moving.look(at, part)
            if seen is None:
                continue
            c = moving.collider
            gap = seen[:, 0] - c.thickness - self._ball
            near = gap < reach
            found.append(_rows(arm[near], seen[near, 1:4], seen[near, 4:], gap[near], CONTACTS[c.contact], c.friction))
        return np.concatenate(found) if found else np.empty((0, _COLUMNS))

    def _led(self, targets: Array) -> None:
        rest = self.body.points[self._pins]
        if np.linalg.matrix_rank(rest - rest.mean(axis=0), tol=1e-3 * self._ball) < 2:
            turn, shift = self.turn, targets.mean(axis=0) - self.turn @ rest.mean(axis=0)
        else:
            turn, shift, _ = rigid_motion(rest, targets)
        self.place, self.turn = turn @ self._centre + shift, np.ascontiguousarray(turn)


def _moments(arm: Array, mass: Array) -> Array:
    """(3, 3) moments of inertia of points."""
    return np.eye(3) * (mass @ (arm**2).sum(axis=1)) - np.einsum("n,ni,nj->ij", mass, arm, arm)


def _outermost(points: Array, spacing: float) -> Array:
    """Which particles have an empty cell beside them."""
    cell = np.floor((points - points.min(axis=0)) / spacing + 0.5).astype(np.int64) + 1
    full = np.zeros(cell.max(axis=0) + 2, bool)
    full[tuple(cell.T)] = True
    inner = full.copy()
    for axis in range(3):
        inner &= np.roll(full, 1, axis) & np.roll(full, -1, axis)
    return np.flatnonzero(~inner[tuple(cell.T)])


def _rows(arm: Array, normal: Array, velocity: Array, gap: Array, contact: float, friction: float) -> Array:
    rows = np.empty((len(arm), _COLUMNS))
    rows[:, :3], rows[:, 3:6], rows[:, 6:9], rows[:, 9], rows[:, 10], rows[:, 11] = (
        arm, normal, velocity, gap, contact, friction,
    )  # fmt: skip
    return rows


@inlined
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def _speed(both, r):  # type: ignore[no-untyped-def]
    """Velocity of a point of the body."""
    x, y, z = _cross(both[1], r)
    return both[0, 0] + x, both[0, 1] + y, both[0, 2] + z


@inlined
def _yields(r, d, inverse_mass, inverse):  # type: ignore[no-untyped-def]
    """How much a point of the body gains of speed by an impulse along d, 1/kg."""
    c = _cross(r, d)
    return inverse_mass + c[0] * _dot(inverse[0], c) + c[1] * _dot(inverse[1], c) + c[2] * _dot(inverse[2], c)


@inlined
def _kick(both, r, impulse, inverse_mass, inverse):  # type: ignore[no-untyped-def]
    c = _cross(r, impulse)
    for i in range(3):
        both[0, i] += inverse_mass * impulse[i]
        both[1, i] += _dot(inverse[i], c)


@njit
def _meet(rows, both, inverse_mass, inverse, dt, ball, iterations):  # type: ignore[no-untyped-def]
    """Change motion and spin so that nothing enters an obstacle in the next `dt`."""
    pressed, rubbed = np.zeros(len(rows)), np.zeros((len(rows), 3))
    for _ in range(iterations):
        for c in range(len(rows)):
            r, n, u, gap, kind = rows[c, :3], rows[c, 3:6], rows[c, 6:9], rows[c, 9], rows[c, 10]
            touches = gap < 0.1 * ball
            holds = kind > 0.0 and touches
            wanted = _dot(u, n) if holds else _dot(u, n) - max(gap, 0.0) / dt
            change = (wanted - _dot(_speed(both, r), n)) / _yields(r, n, inverse_mass, inverse)
            if not holds:
                change = max(pressed[c] + change, 0.0) - pressed[c]
            pressed[c] += change
            _kick(both, r, (change * n[0], change * n[1], change * n[2]), inverse_mass, inverse)

            limit = rows[c, 11] * pressed[c]
            if kind > 0.0:
                limit = np.inf if kind > 1.0 and touches else 0.0
            own = rubbed[c]
            if limit <= 0.0 and own[0] == 0.0 and own[1] == 0.0 and own[2] == 0.0:
                continue
            v = _speed(both, r)
            x, y, z = v[0] - u[0], v[1] - u[1], v[2] - u[2]
            along = x * n[0] + y * n[1] + z * n[2]
            x, y, z = x - along * n[0], y - along * n[1], z - along * n[2]
            speed = np.sqrt(x * x + y * y + z * z)
            if speed < 1e-12:
                continue
            share = 1.0 / _yields(r, (x / speed, y / speed, z / speed), inverse_mass, inverse)
            x, y, z = own[0] - share * x, own[1] - share * y, own[2] - share * z
            length = np.sqrt(x * x + y * y + z * z)
            if length > limit:
                x, y, z = x * limit / length, y * limit / length, z * limit / length
            _kick(both, r, (x - own[0], y - own[1], z - own[2]), inverse_mass, inverse)
            own[0], own[1], own[2] = x, y, z


@njit
def _push_out(rows, both, inverse_mass, inverse, dt, ball, iterations):  # type: ignore[no-untyped-def]
    """Motion and spin, for the next `dt` alone, that take out what is inside."""
    pressed = np.zeros(len(rows))
    for _ in range(iterations):
        for c in range(len(rows)):
            r, n = rows[c, :3], rows[c, 3:6]
            wanted = min(_PUSH / dt * max(-rows[c, 9] - _SLOP * ball, 0.0), _FASTEST_PUSH * ball)
            change = (wanted - _dot(_speed(both, r), n)) / _yields(r, n, inverse_mass, inverse)
            change = max(pressed[c] + change, 0.0) - pressed[c]
            pressed[c] += change
            _kick(both, r, (change * n[0], change * n[1], change * n[2]), inverse_mass, inverse)
