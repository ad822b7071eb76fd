"""MLS-MPM from frame to frame: time steps, sorting, checks.

What happens in a frame depends on the state at its beginning alone, in particles' own order, so that a bake that was
interrupted goes on with the same bits, on any number of threads.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from ..compute.warp.kernels import Launcher
from ..compute.warp.runtime import DEVICES, name_of
from ..core.errors import Cancelled, DeviceError, UsageError
from ..core.sim_materials import FLUID, SNOW, ParticleMaterials
from .body_contact import DEEPEST_RIM, RIM
from .colliders import Collider, MovingCollider, check_apart
from .contact import Plane, plane_rows
from .fields import FieldRows
from .grid import Forces, Grid, HostGrid, Limits, Scene
from .grid_blocks import Domain, outside_of
from .particles import Particles, Properties
from .stepper import Stepper

Array = np.ndarray
log = logging.getLogger(__name__)

#: Cells that particles may have moved since they were sorted; they may be one cell off at most.
DRIFT = 0.85
#: Cells that matter or a collider moves at most in a step.
FASTEST = 0.5
#: Share of the particles outside of the domain from which on nothing is left to simulate.
_MOST_LOST = 0.5
#: A step this many times shorter than the stiffness asks for means that the motion has run away.
RUNAWAY = 200.0


@dataclass(slots=True)
class Body:
    """Matter at rest.

    Attributes
    ----------
    points : (n, 3) float64 array
        Metres, world.
    volume : (n,) array
        Cubic metres.
    matter : ParticleMaterials
        Of the points.
    markers : (k, 3) float64 array
        Points without mass that move along.
    pinned : (n,) bool array, optional
        Points that are kinematic.
    velocity : (3,) or (n, 3) array or sequence of float
        m/s, at the start.
    way_out : (n, 3) array, optional
        From points to the nearest place of the body's surface, metres, for its contact with others.
    name : str
        In messages.
    """

    points: Array
    volume: Array
    matter: ParticleMaterials
    markers: Array = field(default_factory=lambda: np.empty((0, 3)))
    pinned: Array | None = None
    velocity: Array | Sequence[float] = (0.0, 0.0, 0.0)
    way_out: Array | None = None
    name: str = "the body"


class Solver(Stepper):
    """A body, what it is in and what it meets.

    Parameters
    ----------
    body : Body
    domain : Domain
        Where particles may be; those that leave it stay where they are, in nobody's way.
    forces : Forces, optional
        Forces on all matter.
    colliders : sequence of Collider
        Mesh obstacles.
    planes : sequence of Plane
        Plane obstacles.
    courant : float, optional
        The Courant number (CFL condition): time step in parts of what elastic waves and viscosity bear, by default
        `Material.courant`; above 1 is unstable.
    device : str
        One of `DEVICES`; what it cannot do is done by the CPU, with a warning.

    Attributes
    ----------
    state : Particles
        In the order of ``body.points`` and then ``body.markers``.
    scene : Scene
        What its grid needs to know.
    """

    def __init__(
        self,
        body: Body,
        domain: Domain,
        forces: Forces | None = None,
        colliders: Sequence[Collider] = (),
        planes: Sequence[Plane] = (),
        courant: float | None = None,
        device: str = "cpu",
    ) -> None:
        self.body, self.domain, self.forces = body, domain, forces or Forces()
        self.colliders = [MovingCollider(c, domain.spacing, domain.low, domain.high) for c in colliders]
        self.planes, self._fields = plane_rows(planes), FieldRows(self.forces.fields)
        n, markers = len(body.points), len(body.markers)
        matter = body.matter
        mass = np.concatenate([body.volume * matter.density, np.zeros(markers)]).astype(np.float32)
        volume = np.concatenate([body.volume, np.zeros(markers)]).astype(np.float32)

        def padded(values: Array) -> Array:
            return np.concatenate([values, np.zeros((markers, *values.shape[1:]), values.dtype)])

        self._model = padded(matter.model)
        self._reach = np.maximum(self._nearest(body.points, body.markers)[0], domain.spacing)
        self._pins = np.flatnonzero(body.pinned) if body.pinned is not None else np.empty(0, np.int64)
        properties = Properties(mass, volume, self._model, padded(matter.parameters), padded(matter.keeps_shape))
        self.scene = Scene(
            domain, self.forces, self._fields, self.colliders, self.planes, properties, self._pins,
            np.float32(1e-9 * mass[:n].min(initial=np.inf)), padded(self._rim()),
        )  # fmt: skip
        self.grid = self._grid_on(device)
        still = bool(len(self._pins) == n)
        h = domain.spacing
        courant_of = matter.courant if courant is None else courant
        fastest = float(((matter.wave_speed / h + 2 * matter.diffusivity / h**2) / courant_of).max())
        self.rate = 0.0 if still else fastest
        self.state = self._at_rest()
        self._check_start()

    def _rim(self) -> Array:
        """`Scene.rim`; of matter that flows nothing is known."""
        way, matter = self.body.way_out, self.body.matter
        rim = np.zeros((len(self.body.points), 4), np.float32)
        rim[:, 3] = RIM
        if way is not None:
            depth = np.linalg.norm(way, axis=1)
            cells = depth / self.domain.spacing
            rim[matter.keeps_shape, 3] = np.minimum(cells, DEEPEST_RIM)[matter.keeps_shape]
            near = matter.keeps_shape & (cells < DEEPEST_RIM) & (cells > 1e-6)
            rim[near, :3] = way[near] / depth[near, None]
        return rim

    def _grid_on(self, device: str) -> Grid:
        if device not in DEVICES:
            raise UsageError(f"device {device!r}", "is unknown", f"Choose from {', '.join(DEVICES)}")
        if device != "cpu":
            from .gpu.grid import DeviceGrid

            try:
                return DeviceGrid(self.scene, Launcher(name_of(device)))
            except DeviceError as error:
                log.warning("%s Simulated on the CPU", error)
        return HostGrid(self.scene)

    def _at_rest(self) -> Particles:
        body, n = self.body, len(self.body.points)
        x = np.concatenate([body.points, body.markers]).astype(np.float64)
        v = np.zeros((len(x), 3), np.float32)
        v[:n] = np.asarray(body.velocity, np.float32)
        if len(x) > n:
            v[n:] = v[:n].mean(axis=0)
        v[self._pins] = 0
        plastic = bool((body.matter.model > 1).any())
        memory = np.isin(self._model, (FLUID, SNOW)).astype(np.float32)
        total = np.zeros((len(x) if plastic else 0, 9), np.float32)
        affine, elastic = np.zeros((2, len(x), 9), np.float32)
        return Particles(x, v, affine, elastic, total, np.zeros((len(x), 6), np.float32), memory)

    def _check_start(self) -> None:
        """Refuse what cannot go well, with what to do about it."""
        if not len(self.body.points):
            raise UsageError("simulation", "has no particles", "Fill the mesh first")
        self._check_inside(self.state.x)
        check_apart(self.body.points, self.domain.spacing, self.colliders, self.planes, self.body.name)

    @property
    def launcher(self) -> Launcher | None:
        return self.grid.launcher

    @property
    def gradients(self) -> Array:
        total = self.state.total if len(self.state.total) else self.state.elastic
        return total[: len(self.body.points)].reshape(-1, 3, 3) + np.eye(3, dtype=np.float32)

    @property
    def points(self) -> Array:
        return self.state.x[: len(self.body.points)]

    @property
    def markers(self) -> Array:
        return self.state.x[len(self.body.points) :]

    def arrays(self) -> dict[str, Array]:
        return self.state._asdict()

    def _put(self, arrays: dict[str, Array]) -> None:
        self.state = Particles(**arrays)

    def _advance(
        self,
        seconds: float,
        pin_targets: Array | None,
        cancelled: Callable[[], bool] | None,
        progress: Callable[[float], None] | None,
    ) -> None:
        steps = self.steps
        try:
            self._advance_on(self.grid, seconds, pin_targets, cancelled, progress)
        except DeviceError as error:  # the state is still that at the beginning of the frame
            log.warning("%s Simulated on the CPU from frame %d on", error, self.first + self.frame + 1)
            self.grid, self.steps = HostGrid(self.scene), steps
            self._advance_on(self.grid, seconds, pin_targets, cancelled, progress)

    def _advance_on(
        self,
        grid: Grid,
        seconds: float,
        pin_targets: Array | None,
        cancelled: Callable[[], bool] | None,
        progress: Callable[[float], None] | None,
    ) -> None:
        h = self.domain.spacing
        speed, outside, push = self.enter(grid, seconds, pin_targets)
        usual = min(1 / self.rate if self.rate else np.inf, seconds)

        done, drift = 0.0, np.inf
        while done < seconds * (1 - 1e-9):
            if cancelled is not None and cancelled():
                raise Cancelled
            if drift > DRIFT:
                self.sort(grid)
                drift = 0.0
            longest = min(usual, FASTEST * h / max(speed + push * usual, 1e-12))
            if longest < usual / RUNAWAY and speed > outside:
                raise self.ran_away(speed)
            # As many as particles, as fast as they are now, need until they must be sorted again.
            most = min(grid.most, int((DRIFT - drift) * h / max(speed * longest, 1e-12)) + 2)
            times = self._times(seconds, done, longest, most if longest == usual else 1)
            limits = Limits(DRIFT - drift, FASTEST * h / usual - push * usual, outside)
            for (_, dt), top in zip(times, grid.step(times, limits)):
                if not np.isfinite(top):
                    raise self.became_infinite()
                speed = max(top, outside)
                drift += speed * dt / h
                done += dt
                self.steps += 1
            if progress is not None:
                progress(done / seconds)
        self.leave(grid)

    def enter(self, grid: Grid, seconds: float, pin_targets: Array | None) -> tuple[float, float, float]:
        """Begin a frame on a grid.

        Returns
        -------
        speed, outside : float
            m/s, the highest now, and that of what has a given motion.
        push : float
            m/s^2, of gravity and fields at most.
        """
        n = len(self.body.points)
        pin_velocity = np.zeros((len(self._pins), 3), np.float32)
        if pin_targets is not None:
            pin_velocity = ((pin_targets - self.state.x[self._pins]) / seconds).astype(np.float32)
        self._check_left(self.state.x)
        there = np.delete(self.state.x[:n], outside_of(self.state.x[:n], self.domain), axis=0)
        low, high = there.min(axis=0), there.max(axis=0)
        outside = 0.0
        for moving in self.colliders:
            moving.enter(self.frame, seconds, low, high)
            outside = max(outside, moving.speed)
        if len(pin_velocity):
            outside = max(outside, float(np.linalg.norm(pin_velocity, axis=1).max()))
        push = float(np.linalg.norm(np.asarray(self.forces.gravity, np.float64))) + self._fields.push(self.frame)
        speed = float(np.sqrt((self.state.v.astype(np.float64) ** 2).sum(axis=1).max(initial=0)))
        if not np.isfinite(speed):
            raise self._error("has velocities that are not finite", "Bake again from the start")
        grid.enter(self.state, self.frame, seconds, pin_velocity)
        return max(speed, outside), outside, push

    def sort(self, grid: Grid) -> None:
        """Sort the particles of a grid, and see how many are left."""
        lost = grid.sort()
        if lost and (len(self._pins) or lost > _MOST_LOST * len(self.body.points)):
            self._check_left(grid.state().x)

    def leave(self, grid: Grid) -> None:
        """End the frame: what is on the grid is the state."""
        self.state = grid.state()
        self._rejoin()
        self._check_left(self.state.x)
        self.state.v[outside_of(self.state.x, self.domain)] = 0

    @property
    def lost(self) -> int:
        return len(outside_of(self.points, self.domain))

    def ran_away(self, speed: float) -> UsageError:
        """The error of matter that is too fast, m/s."""
        remedy = "Make the material stiffer or the particles finer, or slow down what hits it"
        return self._error(f"ran away: matter moves at {speed:.3g} m/s", remedy)

    def became_infinite(self) -> UsageError:
        """The error of matter that is not finite."""
        return self._error("became infinite", "Use a lower Courant number (0.3) or finer particles")

    @staticmethod
    def _times(seconds: float, done: float, longest: float, most: int) -> list[tuple[float, float]]:
        """When the next steps begin and how long they take, as even as they come."""
        found: list[tuple[float, float]] = []
        while len(found) < most and done < seconds * (1 - 1e-9):
            dt = (seconds - done) / np.ceil((seconds - done) / longest - 1e-9)
            found.append((done, dt))
            done += dt
        return found

    @staticmethod
    def _nearest(points: Array, markers: Array) -> tuple[Array, Array]:
        """Distance (k,) of each marker from the particle nearest to it, and which that is."""
        if not len(markers):
            return np.empty(0), np.empty(0, np.int64)
        found: tuple[Array, Array] = cKDTree(points).query(markers, workers=-1)
        return found

    def _rejoin(self) -> None:
        """Bring markers that matter has left behind back to it: the nearest particle carries them."""
        n, state = len(self.body.points), self.state
        distance, nearest = self._nearest(state.x[:n], state.x[n:])
        lost = np.flatnonzero(distance > self._reach)
        if len(lost):
            at = state.x[nearest[lost]]
            state.x[n + lost] = at + (state.x[n + lost] - at) * (self._reach[lost] / distance[lost])[:, None]
            state.v[n + lost] = state.v[nearest[lost]]

    def _check_left(self, x: Array) -> None:
        """Refuse what cannot be gone on with: pins outside of the domain, most particles there, or no finite place."""
        lost = outside_of(x, self.domain)
        if len(lost):
            most = np.count_nonzero(lost < len(self.body.points)) > _MOST_LOST * len(self.body.points)
            if most or np.isin(lost, self._pins).any() or not np.isfinite(x[lost]).all():
                self._check_inside(x)

    def _check_inside(self, x: Array) -> None:
        """Refuse particles outside of the domain."""
        lost = outside_of(x, self.domain)
        if len(lost):
            where = x[lost[0]]
            finite = bool(np.isfinite(where).all())
            place = f"({where[0]:.3g}, {where[1]:.3g}, {where[2]:.3g})" if finite else "no finite place"
            low, high = (np.array2string(c, precision=3, separator=", ") for c in (self.domain.low, self.domain.high))
            raise self._error(
                f"has {len(lost)} particles outside the domain from {low} to {high}, one at {place}",
                "Give a larger domain, put a floor or a collider where it falls, or let the domain have walls"
                if finite
                else "Use a lower Courant number (0.3) or finer particles",
            )
