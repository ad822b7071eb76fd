"""Bodies that push each other, for the tests and the benchmark of their contact."""

from __future__ import annotations

from typing import Any

import igl
import numpy as np
import trimesh
from simulation_cases import aligned, lattice, masses, momenta, solver_of

from drgs_blender.core.asset.model import Mesh
from drgs_blender.simulation.coupled import Coupled, Touch
from drgs_blender.simulation.fill import fill
from drgs_blender.simulation.solver import Solver


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    n = len(shape.vertices)
    return Mesh(shape.vertices, np.asarray(shape.faces), np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))


def ball(radius: float, centre: Any, h: float) -> np.ndarray:
    points = lattice((2 * radius,) * 3, h / 2) - radius
    return points[np.linalg.norm(points, axis=1) < radius] + centre


def balls(h: float, *, aside: float = 0.0, youngs_modulus: float = 1e6, **touch: Any) -> Coupled:
    """Two balls of 0.3 m that fly at each other at 1 m/s each, one `aside` of the other's way."""
    domain = aligned((-1.4, -0.8, -0.8), (1.4, 0.8, 0.8), h)
    bodies = [
        solver_of(ball(0.3, (-0.32, 0, 0), h), h, velocity=(1, 0, 0), domain=domain, youngs_modulus=youngs_modulus),
        solver_of(ball(0.3, (0.32, aside, 0), h), h, velocity=(-1, 0, 0), domain=domain, youngs_modulus=youngs_modulus),
    ]
    return Coupled(bodies, {(0, 1): Touch(**touch)})


def momentum(coupled: Coupled) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular, of all bodies."""
    parts = [momenta(body) for body in coupled.bodies]
    return sum(p for p, _ in parts), sum(a for _, a in parts)


def mean_velocity(body: Solver) -> np.ndarray:
    mass = masses(body)
    return (mass[:, None] * body.state.v).sum(axis=0) / mass.sum()


class Slope:
    """A block on the top of a plate that is pinned and leans by an angle, in degrees; all of it on an even grid.

    Attributes
    ----------
    down : (3,) array
        Along the slope.
    """

    gravity = 9.81

    def __init__(self, degrees: float, h: float, contact: str = "separate", friction: float = 0.0, up: bool = False):
        angle = np.radians(degrees)
        domain = aligned((-1.6, -0.8, -1.8), (2.4, 0.8, 1.4), h)
        self.down, self.out = np.array([np.cos(angle), 0, -np.sin(angle)]), np.array([np.sin(angle), 0, np.cos(angle)])
        bodies = []
        for size, at in (((2.4, 0.5, 0.2), (0.4, 0, -0.1)), ((0.4, 0.3, 0.3), (-0.3, 0, 0.15))):
            shape = trimesh.creation.box(size)
            shape.apply_translation(at)
            shape.apply_transform(trimesh.transformations.rotation_matrix(angle, (0, 1, 0)))
            points = fill(shape.vertices, shape.faces, h / 2).points
            way = igl.point_mesh_squared_distance(points, np.array(shape.vertices), np.array(shape.faces))[2] - points
            more = {"pinned": np.ones(len(points), bool)} if not bodies else {}
            gravity = (0, 0, self.gravity if up else -self.gravity)
            bodies.append(solver_of(points, h, domain=domain, gravity=gravity, youngs_modulus=1e6, way_out=way, **more))
        self.coupled = Coupled(bodies, {(0, 1): Touch(contact, friction)})
        self._start = bodies[1].points.copy()

    def slid(self) -> float:
        """Metres along the slope."""
        return float(((self.coupled.bodies[1].points - self._start) @ self.down).mean())

    def lifted(self) -> float:
        """Metres off it."""
        return float(((self.coupled.bodies[1].points - self._start) @ self.out).mean())
