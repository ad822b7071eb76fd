"""What lies near a crack, carried by the matter on its own side alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .bonds import Bonds, Cells
from .crack_nodes import warp
from .gmls import carry

Array = np.ndarray

#: The lattice is put beside the vertices by this part of a cell, so that none lies on a plane of it.
BESIDE = np.array([1.2247449e-5, 1.4142135e-5, 1.7320508e-5])


@dataclass(slots=True)
class Sides:
    """Carries points that are near a crack by the matter on their own side."""

    bonds: Bonds
    zone: Cells
    nodes: tuple[Array, Array]
    broken: Array
    now: Array
    gradients: Array

    def carried(self, points: Array) -> tuple[Array, Array, Array]:
        """Of (n, 3) points at rest: which have matter near, and of these places now and deformation gradients.

        All object space.
        """
        bonds = self.bonds
        rest = bonds.placed(points)
        places = rest + BESIDE
        warp(places, self.zone.size + 1, *self.nodes)
        cell = np.floor(places).astype(np.int64).clip(0, bonds.size - 1)
        owner = bonds.owners((cell[:, 0] * bonds.size[1] + cell[:, 1]) * bonds.size[2] + cell[:, 2])
        known = owner >= 0
        weights, _ = bonds.carriers(rest[known], owner[known], self.broken)
        at, turn, _ = carry(weights, self.now, self.gradients)
        return known, bonds.returned(at), bonds.returned_gradients(turn)


def believable(gradients: Array, most: Array) -> Array:
    """(n, 3, 3) deformation gradients that stretch no more than the bonds that are left say.

    Particles that have come apart keep counting what pulled them apart as stretch.
    """
    u, s, vt = np.linalg.svd(np.nan_to_num(gradients, posinf=0.0, neginf=0.0))
    found: Array = (u * np.minimum(s, most[:, None])[:, None, :]) @ vt
    return found


def within(points: Array, others: Array, band: float) -> Array:
    """(n,) bool: which of (n, 3) points are less than `band` from one of others."""
    from scipy.spatial import cKDTree  # an engine starts without

    low, high = others.min(axis=0) - band, others.max(axis=0) + band
    some = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    found = np.zeros(len(points), bool)
    found[some] = cKDTree(others).query(points[some], distance_upper_bound=band)[0] < np.inf
    return found
