"""XPBD, the preview: an elastic body as a lattice of cubes, solved by positions.

XPBD (Macklin et al. 2016) in small steps of one iteration, with the stable neo-Hookean energy (Smith et al. 2018, as
constraints Macklin and Mueller 2021). Solved as their two constraints, shape is under tension at rest, which one
iteration integrates explicitly: at these steps that blows up above 1e5 Pa. So the nine constraints that make up the
shape's, which are linear, and that of the volume are solved at once, in closed form and without a decomposition: stable
at any stiffness, and no step turns what is not turned. A cube's deformation gradient is that at its
centre, which bends without locking; four places around it bear a fifth of the stress and keep it from folding. The
particles and their gradients are interpolated, so that what follows does not know which solver ran. Cubes of one parity
share no node: eight passes, always in the same order.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from ..compute.jit import njit
from ..compute.threads import ELEMENTS, get_num_threads, over_range
from ..core.errors import Cancelled, UsageError
from .colliders import Collider, MovingCollider, check_apart
from .contact import Plane, plane_rows
from .fields import FieldRows, blow
from .shell import Shell, push, push_planes
from .solver import Body, Forces
from .stepper import Stepper

Array = np.ndarray
log = logging.getLogger(__name__)

#: Fewest cubes for which another thread is worth while.
_FEW = 128
#: Cubes along the body's longest side.
CUBES = 14
#: Least mass of a node, in parts of the heaviest.
_LIGHTEST = 0.02
#: Corners of a cube, as offsets.
_CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
#: Quadrature points of a cube and their weights.
_PLACES = np.concatenate([[[0.5, 0.5, 0.5]], 0.5 + (_CORNERS[[0, 3, 5, 6]] - 0.5) / np.sqrt(3)])
_SHARES = np.array([0.8, 0.05, 0.05, 0.05, 0.05])


def _slopes(places: Array, size: float) -> Array:
    """(n, 8, 3) how corners make the deformation gradient at places in a cube, F = sum x_k slope_k^T, 1/m."""
    t = places[:, None]
    part = np.where(_CORNERS == 1, t, 1 - t)
    sign = np.where(_CORNERS == 1, 1.0, -1.0) / size
    return np.stack([sign[:, c] * part[..., c - 2] * part[..., c - 1] for c in range(3)], -1)


class Lattice(Stepper):
    """A body in a lattice.

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
    cubes : int
        Along the longest side.
    """

    rate = 720.0  #: each step is one iteration

    def __init__(
        self,
        body: Body,
        forces: Forces | None = None,
        colliders: Sequence[Collider] = (),
        planes: Sequence[Plane] = (),
        cubes: int = CUBES,
    ) -> None:
        if not body.matter.keeps_shape.all():
            raise UsageError("solver", "xpbd supports no sand and no fluids", "Use mpm for them")
        if (body.matter.model > 1).any():
            log.warning("xpbd shows all matter as elastic; mpm shows what bends and stays bent")
        self.body, self.forces = body, forces or Forces()
        points = body.points
        low = points.min(axis=0)
        size = float(np.ptp(points, axis=0).max()) / cubes * (1 + 1e-9)
        if size <= 0:
            raise UsageError("simulation", "has too few particles", "Use a higher resolution")
        self.spacing = size
        origin = low - 0.5 * size
        place = (points - origin) / size
        cube = np.floor(place).astype(np.int64)
        shape = cube.max(axis=0) + 2
        flat, self._cube_of = np.unique(np.ravel_multi_index(cube.T, shape), return_inverse=True)
        at = np.stack(np.unravel_index(flat, shape), -1)
        node, corners = np.unique(
            np.ravel_multi_index((at[:, None] + _CORNERS).reshape(-1, 3).T, shape + 1), return_inverse=True
        )
        self._corners = np.ascontiguousarray(corners.reshape(-1, 8), np.int32)
        rest = origin + np.stack(np.unravel_index(node, shape + 1), -1) * size
        parity = (at & 1) @ [4, 2, 1]
        order = np.argsort(parity, kind="stable")
        self._corners, back = np.ascontiguousarray(self._corners[order]), np.argsort(order)
        self._cube_of = back[self._cube_of.reshape(-1)]
        self._parity = np.concatenate([[0], np.cumsum(np.bincount(parity, minlength=8))]).astype(np.int64)
        self._inside = place - cube  # where in its cube each particle is, 0 to 1
        self._embed()
        self._stiffness(body, len(order), size)
        self.x = rest
        mass = np.asarray(body.volume, np.float64) * body.matter.density
        nodes = self._corners[self._cube_of]
        held, weight = np.zeros(len(rest)), np.zeros(len(rest))
        for c in range(8):
            share = mass * self._weights[:, c]
            weight += np.bincount(nodes[:, c], share, len(rest))
            if body.pinned is not None:
                held += np.bincount(nodes[:, c], share * body.pinned, len(rest))
        # The affine motion closest to the particles', which holds for nodes outside of them too.
        velocity = np.broadcast_to(np.asarray(body.velocity, np.float64), points.shape)
        centre = points.mean(axis=0)
        motion = np.linalg.lstsq(np.c_[points - centre, np.ones(len(points))], velocity, rcond=None)[0]
        self.v = np.c_[rest - centre, np.ones(len(rest))] @ motion
        # A node outside of the matter must not be so light that it flies.
        weight = np.maximum(weight, _LIGHTEST * weight.max())
        self._pins = np.flatnonzero(body.pinned) if body.pinned is not None else np.empty(0, np.int64)
        self._fixed = np.flatnonzero(held > 0.5 * weight)
        self._inverse_mass = 1.0 / weight
        self._inverse_mass[self._fixed] = 0.0
        self.v[self._fixed] = 0.0
        self._nearest_pin = self._match_pins()
        self._rest_fixed = rest[self._fixed].copy()
        self.planes, self._fields = plane_rows(planes), FieldRows(self.forces.fields)
        everywhere = points.min(axis=0) - 1e3 * size, points.max(axis=0) + 1e3 * size
        self.colliders = [MovingCollider(c, 0.5 * size, *everywhere) for c in colliders]
        self._shell = self._find_shell(place, shape)
        check_apart(points, 0.5 * size, self.colliders, self.planes)

    def _embed(self) -> None:
        """(n, 8) trilinear weights of the particles and (n, 8, 3) their slopes, 1/m."""
        t = self._inside[:, None]
        self._weights = np.where(_CORNERS == 1, t, 1 - t).prod(axis=2)
        self._slopes = _slopes(self._inside, self.spacing)

    def _stiffness(self, body: Body, count: int, size: float) -> None:
        """(cubes, 5, 2) stiffness of shape and volume, J, from a cube's particles and how full it is."""
        volume = np.bincount(self._cube_of, body.volume, count)
        moduli = body.volume[:, None] * body.matter.parameters[:, :2]
        mu = np.bincount(self._cube_of, moduli[:, 0], count) / volume
        first = np.bincount(self._cube_of, moduli[:, 1], count) / volume
        # The energy of Smith et al. has Lame's first parameter plus the shear modulus before the square of the volume.
        self._moduli = volume[:, None, None] * _SHARES[:, None] * np.stack([2 * mu, first + mu], -1)[:, None]
        self._gradient = _slopes(_PLACES, size)

    def _terms(self, dt: float) -> Array:
        """What `_solve` needs of each cube for steps of `dt`."""
        compliance = 1 / (self._moduli * dt**2)
        w = self._inverse_mass[self._corners]
        # One number for how corners move alike in all directions, the largest: then no step turns the cube.
        a = np.linalg.eigvalsh(np.einsum("qk,tki,tkj->qtij", w, self._gradient, self._gradient))[..., -1]
        b = 1 / (a + compliance[..., 0])
        return np.concatenate([compliance, b[..., None], (a * b)[..., None]], -1)

    def _match_pins(self) -> Array:
        """For each held node, the pinned point that it follows."""
        if not len(self._pins) or not len(self._fixed):
            return np.empty(0, np.int64)
        from scipy.spatial import cKDTree

        return cKDTree(self.body.points[self._pins]).query(self.x[self._fixed])[1]

    def _find_shell(self, place: Array, shape: Array) -> Array:
        """Particles in the outermost of their cells: what touches obstacles; at most some in a cube."""
        fine = np.floor(place * 4).astype(np.int64)
        full = np.zeros(shape * 4 + 2, bool)
        full[tuple((fine + 1).T)] = True
        inner = full.copy()
        for axis in range(3):
            inner &= np.roll(full, 1, axis) & np.roll(full, -1, axis)
        outer = np.flatnonzero(~inner[tuple((fine + 1).T)])
        cell = np.ravel_multi_index(fine[outer].T, shape * 4)
        one_each = outer[np.unique(cell, return_index=True)[1]]
        return np.sort(one_each)

    @property
    def points(self) -> Array:
        found = np.empty(self.body.points.shape)
        given = self.x, self._corners, self._cube_of, self._weights
        over_range(_embedded, len(found), *given, found, fewest=ELEMENTS)
        return found

    @property
    def markers(self) -> Array:
        return np.empty((0, 3))  # matter that keeps its shape needs none

    @property
    def gradients(self) -> Array:
        found = np.empty((len(self.body.points), 3, 3), np.float32)
        given = self.x, self._corners, self._cube_of, self._slopes
        over_range(_embedded_gradients, len(found), *given, found, fewest=ELEMENTS)
        return found

    def arrays(self) -> dict[str, Array]:
        return {"nodes": self.x, "node_velocities": self.v}

    def _put(self, arrays: dict[str, Array]) -> None:
        self.x, self.v = arrays["nodes"], arrays["node_velocities"]

    def _advance(
        self,
        seconds: float,
        pin_targets: Array | None,
        cancelled: Callable[[], bool] | None,
        progress: Callable[[float], None] | None,
    ) -> None:
        count = self.steps_of(seconds)
        dt = seconds / count
        terms = self._terms(dt)
        self.x, self.v = self.x.copy(), self.v.copy()
        forces = self.forces
        gravity, wind = np.asarray(forces.gravity, np.float64), np.asarray(forces.wind, np.float64)
        drag_factor, damping_factor = 1 - np.exp(-dt * forces.drag), np.exp(-dt * forces.damping)
        free = self._inverse_mass > 0
        pin_velocity = np.zeros((len(self._fixed), 3))
        if pin_targets is not None and len(self._fixed):
            moved = (pin_targets - self.body.points[self._pins])[self._nearest_pin]
            pin_velocity = (self._rest_fixed + moved - self.x[self._fixed]) / seconds
        points = self.points
        for moving in self.colliders:
            moving.enter(self.frame, seconds, points.min(axis=0), points.max(axis=0))
        shell_nodes = self._corners[self._cube_of[self._shell]]
        shell_weights = self._weights[self._shell]
        for step in range(count):
            if cancelled is not None and cancelled():
                raise Cancelled
            self.v[free] = damping_factor * (self.v[free] + dt * gravity)
            self.v[free] += drag_factor * (wind - self.v[free])
            if len(self._fields):
                blow(self.x, self.v, ~free, self._fields.at(self.frame, (step + 0.5) / count), dt)
            self.v[self._fixed] = pin_velocity
            start = self.x.copy()
            self.x += dt * self.v
            _solve(self.x, self._inverse_mass, self._corners, self._parity, self._gradient, terms)
            shell = Shell(self.x, start, self._inverse_mass, shell_nodes, shell_weights)
            push_planes(shell, self.planes)
            for moving in self.colliders:
                field, motion = moving.at((step + 1) / count)
                if field is not None:
                    push(shell, field, motion, moving.collider.surface, dt)
            self.v = (self.x - start) / dt
            self.steps += 1
            if progress is not None:
                progress((step + 1) / count)
        if not np.isfinite(self.x).all():
            raise self._error("became infinite", "Use mpm, or lower velocities")


def _solve(x: Array, inverse_mass: Array, corners: Array, parity: Array, slopes: Array, terms: Array) -> None:
    """One iteration over all cubes: at each of their places, volume and shape at once.

    With w the inverse masses, s the slopes, F and P = cof F of a place, a the largest singular value of sum w s s^T,
    and compliances alpha of 2 mu and beta of lambda, a step in which the energy is mu ((F - P) : dF + |dF|^2) and the
    square of the volume moves corner k by w_k T s_k, where

        T = b (alpha h P - (F - P) / 2),    b = 1 / (a + alpha),    q = a b,
        h = (1 - J + q P : (F - P) / 2) / (beta + alpha q P : P).

    Parameters
    ----------
    x : (n, 3) float64 array
        Metres, of the nodes; changed.
    inverse_mass : (n,) float64 array
        1/kg; 0 of those that are held.
    corners : (cubes, 8) int32 array
        Nodes of the cubes, those of one parity together.
    parity : (9,) int64 array
        Where the cubes of each parity begin.
    slopes : (5, 8, 3) float64 array
        Of the places in a cube, see `_slopes`.
    terms : (cubes, 5, 4) float64 array
        Alpha, beta, b and q.
    """
    given = x, inverse_mass, corners, slopes, terms
    if get_num_threads() == 1 or len(corners) <= 8 * _FEW:  # cubes are in the order of the passes
        _solve_cubes(0, len(corners), 0, *given)
        return
    for begin, end in pairwise(parity.tolist()):
        over_range(_solve_cubes, end - begin, begin, *given, fewest=_FEW)


@njit
def _solve_cubes(first, last, begin, x, inverse_mass, corners, slopes, terms):  # type: ignore[no-untyped-def]
    """`_solve` of cubes, counted from `begin` on."""
    f, p, r, own = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((8, 3))
    for q in range(begin + first, begin + last):
        for k in range(8):
            for c in range(3):
                own[k, c] = x[corners[q, k], c] - x[corners[q, 0], c]
        for t in range(len(slopes)):
            f[:] = 0.0
            for k in range(8):
                for i in range(3):
                    for c in range(3):
                        f[i, c] += own[k, i] * slopes[t, k, c]
            for i in range(3):
                j, m = (i + 1) % 3, (i + 2) % 3
                p[i, 0] = f[j, 1] * f[m, 2] - f[j, 2] * f[m, 1]
                p[i, 1] = f[j, 2] * f[m, 0] - f[j, 0] * f[m, 2]
                p[i, 2] = f[j, 0] * f[m, 1] - f[j, 1] * f[m, 0]
            volume = f[0, 0] * p[0, 0] + f[0, 1] * p[0, 1] + f[0, 2] * p[0, 2]
            alpha, beta, scale, share = terms[q, t]
            pr = pp = 0.0
            for i in range(3):
                for c in range(3):
                    r[i, c] = 0.5 * (f[i, c] - p[i, c])
                    pr += p[i, c] * r[i, c]
                    pp += p[i, c] * p[i, c]
            h = alpha * (1.0 - volume + share * pr) / (beta + alpha * share * pp)
            for i in range(3):
                u, v, w = h * p[i, 0] - r[i, 0], h * p[i, 1] - r[i, 1], h * p[i, 2] - r[i, 2]
                for k in range(8):
                    own[k, i] += (scale * inverse_mass[corners[q, k]]) * (
                        u * slopes[t, k, 0] + v * slopes[t, k, 1] + w * slopes[t, k, 2]
                    )
        for i in range(3):
            at = x[corners[q, 0], i]
            for k in range(8):
                x[corners[q, k], i] = at + own[k, i]


@njit
def _embedded(first, last, x, corners, cube, weights, points):  # type: ignore[no-untyped-def]
    """Points (n, 3) inside their cubes, written."""
    for i in range(first, last):
        for c in range(3):
            total = 0.0
            for k in range(8):
                total += weights[i, k] * x[corners[cube[i], k], c]
            points[i, c] = total


@njit
def _embedded_gradients(first, last, x, corners, cube, slopes, out):  # type: ignore[no-untyped-def]
    """Deformation gradients (n, 3, 3) float32 of points inside their cubes, written."""
    for i in range(first, last):
        for r in range(3):
            a = b = c = 0.0
            for k in range(8):
                at = x[corners[cube[i], k], r]
                a, b, c = a + at * slopes[i, k, 0], b + at * slopes[i, k, 1], c + at * slopes[i, k, 2]
            out[i, r, 0], out[i, r, 1], out[i, r, 2] = a, b, c
