"""Small bodies for the tests and the benchmark of the particle solver."""

from __future__ import annotations

from typing import Any

import numpy as np

from drgs_blender.core.sim_materials import make_material, particle_materials
from drgs_blender.simulation.grid_blocks import Domain
from drgs_blender.simulation.solver import Body, Forces, Solver


def lattice(size: tuple[float, float, float], spacing: float) -> np.ndarray:
    """Particles of a box from the origin, in the middle of cells of `spacing`."""
    axes = [(np.arange(round(s / spacing)) + 0.5) * spacing for s in size]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def aligned(low: Any, high: Any, h: float) -> Domain:
    """A domain with nodes at whole multiples of `h`."""
    low = (np.floor(np.asarray(low, float) / h) - 0.5) * h
    return Domain.around(low, np.asarray(high, float), h)


def solver_of(
    points: np.ndarray,
    h: float,
    material: str = "jelly",
    *,
    low: Any = None,
    high: Any = None,
    gravity: tuple[float, float, float] = (0, 0, 0),
    damping: float = 0.0,
    velocity: Any = (0, 0, 0),
    pinned: np.ndarray | None = None,
    markers: Any = (),
    colliders: Any = (),
    planes: Any = (),
    courant: float | None = 0.5,
    domain: Domain | None = None,
    way_out: np.ndarray | None = None,
    **numbers: float,
) -> Solver:
    """A body of two particles a cell and axis."""
    matter = particle_materials([make_material(material, numbers)], np.zeros(len(points), int))
    low = points.min(axis=0) - 8 * h if low is None else low
    high = points.max(axis=0) + 8 * h if high is None else high
    volume = np.full(len(points), (h / 2) ** 3, np.float32)
    body = Body(points, volume, matter, np.reshape(markers, (-1, 3)), pinned, velocity, way_out)
    forces = Forces(gravity=gravity, damping=damping)
    return Solver(body, domain or aligned(low, high, h), forces, colliders, planes, courant)


def cantilever(
    per: int,
    *,
    length: float = 1.0,
    height: float = 0.125,
    youngs_modulus: float = 1e6,
    offset: float = 0.0,
    **more: Any,
) -> Solver:
    """A beam along x, clamped at x < 0, `per` cells high; the clamp is `offset` cells before a node of the grid."""
    h = height / per
    points = lattice((length + 2 * h, height, height), h / 2) - [2 * h, 0, 0]
    low, high = (-4 * h, -2 * h, -length), (1.2 * length + h, height + 2 * h, height + 0.3 * length)
    domain = Domain.around(np.add(aligned(low, high, h).low, [offset * h, 0, 0]), np.asarray(high), h)
    return solver_of(
        points,
        h,
        domain=domain,
        pinned=points[:, 0] < 0,
        youngs_modulus=youngs_modulus,
        poisson=0.3,
        density=1000,
        **more,
    )


def timoshenko(load: float, *, length: float = 1.0, height: float = 0.125, youngs_modulus: float = 1e6) -> float:
    """Droop of the tip of a square cantilever under its own weight `load` = density x gravity, metres."""
    weight, area, inertia = load * height**2, height**2, height**4 / 12
    shear = 10 * 1.3 / (12 + 11 * 0.3) * area * youngs_modulus / 2.6
    return weight * length**4 / (8 * youngs_modulus * inertia) + weight * length**2 / (2 * shear)


def masses(solver: Solver) -> np.ndarray:
    return (solver.body.volume * solver.body.matter.density).astype(np.float64)


def momenta(solver: Solver) -> tuple[np.ndarray, np.ndarray]:
    """Linear momentum, and angular momentum with the affine velocities' share."""
    m, s = masses(solver)[:, None], solver.state
    v = s.v.astype(np.float64)
    c = s.affine.astype(np.float64).reshape(-1, 3, 3)
    spin = np.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], -1)
    own = solver.domain.spacing**2 / 4 * spin
    return (m * v).sum(axis=0), (m * (np.cross(s.x, v) + own)).sum(axis=0)


def energy(solver: Solver) -> tuple[float, float]:
    """Kinetic (with the affine share) and neo-Hookean energy, J."""
    m, s = masses(solver), solver.state
    c, v = s.affine.astype(np.float64), s.v.astype(np.float64)
    kinetic = 0.5 * (m * ((v**2).sum(axis=1) + solver.domain.spacing**2 / 4 * (c**2).sum(axis=1))).sum()
    f = s.elastic.astype(np.float64).reshape(-1, 3, 3) + np.eye(3)
    mu, first = solver.body.matter.parameters[0, :2].astype(np.float64)
    log = np.log(np.linalg.det(f))
    density = 0.5 * mu * ((f**2).sum(axis=(1, 2)) - 3) - mu * log + 0.5 * first * log**2
    return float(kinetic), float((solver.body.volume * density).sum())
