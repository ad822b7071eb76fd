"""Contact of an XPBD lattice with obstacles: its outer particles are pushed out, by the nodes that hold them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compute.jit import inlined, njit
from .contact import Field, Motion, Surface, surface_near

Array = np.ndarray


class Shell(NamedTuple):
    """Particles that touch obstacles, held by nodes of the lattice.

    Attributes
    ----------
    x : (n, 3) float64 array
        The nodes, metres, world; as `start`, changed by contact.
    start : (n, 3) float64 array
        Where they were when the step began.
    inverse_mass : (n,) float64 array
        1/kg, 0 where a node is held.
    nodes : (k, 8) int32 array
        Of each particle, those that hold it.
    weights : (k, 8) float64 array
        Of these nodes.
    """

    x: Array
    start: Array
    inverse_mass: Array
    nodes: Array
    weights: Array


@inlined
def _move(x, shell, p, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Move particle p of the shell by a vector, by moving the nodes x that hold it."""
    inverse_mass, nodes, weights = shell.inverse_mass, shell.nodes, shell.weights
    total = 0.0
    for k in range(8):
        total += weights[p, k] * weights[p, k] * inverse_mass[nodes[p, k]]
    if total > 0.0:
        for k in range(8):
            n = nodes[p, k]
            s = weights[p, k] * inverse_mass[n] / total
            x[n, 0] += s * dx
            x[n, 1] += s * dy
            x[n, 2] += s * dz


@inlined
def _contact(shell, p, depth, normal, moved, contact, friction):  # type: ignore[no-untyped-def]
    """Take particle p that is `depth` inside an obstacle out, which `moved` by (x, y, z) since the step began.

    Where it was inside before the step, the start of the step moves too: it gains no speed by that.
    """
    x, start, nodes, weights = shell.x, shell.start, shell.nodes, shell.weights
    nx, ny, nz = normal
    ux, uy, uz = moved
    rx, ry, rz = -ux, -uy, -uz
    for k in range(8):
        n = nodes[p, k]
        rx += weights[p, k] * (x[n, 0] - start[n, 0])
        ry += weights[p, k] * (x[n, 1] - start[n, 1])
        rz += weights[p, k] * (x[n, 2] - start[n, 2])
    along = rx * nx + ry * ny + rz * nz
    tx, ty, tz = rx - along * nx, ry - along * ny, rz - along * nz
    length = np.sqrt(tx * tx + ty * ty + tz * tz)
    before = depth + min(along, 0.0)
    if before > 0.0:
        _move(start, shell, p, before * nx, before * ny, before * nz)
    hold = 0.0
    if contact == 2:
        hold = 1.0
    elif contact == 0 and length > 1e-30:
        hold = min(1.0, friction * depth / length)
    _move(x, shell, p, depth * nx - hold * tx, depth * ny - hold * ty, depth * nz - hold * tz)


@njit
def push_planes(shell: Shell, planes: Array) -> None:
    """Take the shell out of planes, rows of `contact.plane_rows`."""
    x, nodes, weights = shell.x, shell.nodes, shell.weights
    for q in range(len(planes)):
        for p in range(len(nodes)):
            d = -planes[q, 3]
            for k in range(8):
                n = nodes[p, k]
                d += weights[p, k] * (planes[q, 0] * x[n, 0] + planes[q, 1] * x[n, 1] + planes[q, 2] * x[n, 2])
            if d < 0.0:
                normal = planes[q, 0], planes[q, 1], planes[q, 2]
                _contact(shell, p, -d, normal, (0.0, 0.0, 0.0), int(planes[q, 4]), planes[q, 5])


@njit
def push(shell: Shell, field: Field, motion: Motion, surface: Surface, dt: float) -> None:
    """Take the shell out of a collider; the step was of `dt` seconds."""
    x, nodes, weights, shift = shell.x, shell.nodes, shell.weights, motion.shift
    for p in range(len(nodes)):
        px, py, pz = -shift[0], -shift[1], -shift[2]
        for k in range(8):
            n = nodes[p, k]
            px, py, pz = px + weights[p, k] * x[n, 0], py + weights[p, k] * x[n, 1], pz + weights[p, k] * x[n, 2]
        d, nx, ny, nz, ux, uy, uz = surface_near((px, py, pz), field, motion)
        if d < surface.thickness:
            moved = dt * ux, dt * uy, dt * uz
            _contact(shell, p, surface.thickness - d, (nx, ny, nz), moved, surface.contact, surface.friction)
