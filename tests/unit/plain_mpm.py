"""MLS-MPM of neo-Hookean matter in plain numpy, double precision: what the compiled solver must do, written again."""

from __future__ import annotations

import numpy as np


class PlainMpm:
    """Particles that start from a solver's state and meet nothing.

    Parameters
    ----------
    solver : of neo-Hookean matter; its state, grid and matter are copied
    """

    def __init__(self, solver) -> None:
        s, body = solver.state, solver.body
        self.x = s.x.astype(float)
        self.v = s.v.astype(float)
        self.c = s.affine.astype(float).reshape(-1, 3, 3)
        self.f = s.elastic.astype(float).reshape(-1, 3, 3) + np.eye(3)
        self.mu, self.lam = body.matter.parameters[:, :2].astype(float).T
        self.volume = body.volume.astype(float)
        self.mass = self.volume * body.matter.density
        self.origin, self.h = solver.domain.origin, solver.domain.spacing
        self.size = 4 * np.array(solver.domain.blocks)
        self.gravity = np.array(solver.forces.gravity)

    def step(self, dt: float) -> None:
        h, one = self.h, np.eye(3)
        j = np.linalg.det(self.f)[:, None, None]
        tau = self.mu[:, None, None] * (self.f @ self.f.transpose(0, 2, 1) - one)
        tau += self.lam[:, None, None] * np.log(j) * one
        affine = self.mass[:, None, None] * self.c - (4 * dt / h**2) * self.volume[:, None, None] * tau
        at = (self.x - self.origin) / h
        base = np.floor(at - 0.5).astype(int)
        t = at - base
        weights = [0.5 * (1.5 - t) ** 2, 0.75 - (t - 1) ** 2, 0.5 * (t - 0.5) ** 2]
        near = np.array([(i, k, m) for i in range(3) for k in range(3) for m in range(3)])
        w = np.prod([np.stack(weights)[near[:, axis], :, axis] for axis in range(3)], axis=0)  # (27, n)
        d = (near[:, None] - t) * h
        node = np.ravel_multi_index(np.moveaxis(base + near[:, None], 2, 0), self.size)
        count = self.size.prod()
        mass = np.bincount(node.ravel(), (w * self.mass).ravel(), count)
        p = w[..., None] * (self.mass[:, None] * self.v + np.einsum("nij,knj->kni", affine, d))
        momentum = np.stack([np.bincount(node.ravel(), p[..., axis].ravel(), count) for axis in range(3)], -1)
        velocity = momentum / np.maximum(mass, 1e-300)[:, None] + dt * self.gravity
        v = w[..., None] * velocity[node]
        self.v = v.sum(axis=0)
        self.c = 4 / h**2 * np.einsum("kni,knj->nij", v, d)
        self.x = self.x + dt * self.v
        self.f = self.f + dt * self.c @ self.f
