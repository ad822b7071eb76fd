"""What a step does to the nodes of the grid: momentum to velocity, forces on all matter alike, pins."""

from __future__ import annotations

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.threads import over_range
from .grid_blocks import SLOTS, Nodes
from .p2g_g2p import cell_of, weights_of
from .packed import MASS

Array = np.ndarray

_ONE = np.float32(1.0)

#: Share of a node's matter that is pinned from which on the node is. On a flat border between pinned and free matter
#: the last node held is then, over all positions of the grid, on average on the border itself.
PINNED = np.float32(0.2)


@inlined
def apply_forces(velocity, gain, damping_factor, drag_factor, wind):  # type: ignore[no-untyped-def]
    """A velocity after a step of the forces that act on all matter alike: gravity, damping, drag.

    Parameters
    ----------
    velocity : tuple of float
        (x, y, z), world, m/s; so the other vectors.
    gain : tuple of float
        What gravity adds in the step.
    damping_factor : float32
        Share of the velocity that damping leaves, exp(-dt damping).
    drag_factor : float32
        Share of the velocity relative to the wind that drag takes, 1 - exp(-dt drag).
    wind : tuple of float

    Returns
    -------
    x, y, z : float32
        World, m/s.
    """
    x, y, z = velocity
    gx, gy, gz = gain
    wx, wy, wz = wind
    # All forces alike, so that damping does not change where matter comes to rest.
    x, y, z = damping_factor * (x + gx), damping_factor * (y + gy), damping_factor * (z + gz)
    return x + drag_factor * (wx - x), y + drag_factor * (wy - y), z + drag_factor * (wz - z)


def advance_nodes(
    nodes: Array, least: np.float32, dt: float, force: Array, wind: Array, drag: float, damping: float
) -> None:
    """Momentum to velocity, in place, and what acts on all matter alike.

    Parameters
    ----------
    nodes : (a, 64, 4) float32 array
        Values of `Nodes`.
    least : np.float32
        kg, below which a node is empty: momentum over a mass near underflow is noise.
    dt : float
        Seconds.
    force : (3,) array
        m/s^2, acceleration.
    wind : (3,) array
        m/s, towards which `drag` pulls.
    drag : float
        1/s.
    damping : float
        1/s.
    """
    over_range(_advance_nodes, len(nodes), nodes, least, dt, force, wind, drag, damping, fewest=SLOTS)


@njit
def _advance_nodes(first, last, nodes, least, dt, force, wind, drag, damping):  # type: ignore[no-untyped-def]
    drag_factor, damping_factor = np.float32(1.0 - np.exp(-dt * drag)), np.float32(np.exp(-dt * damping))
    gain = np.float32(dt * force[0]), np.float32(dt * force[1]), np.float32(dt * force[2])
    flow = np.float32(wind[0]), np.float32(wind[1]), np.float32(wind[2])
    for s in range(first, last):
        for n in range(64):
            m = nodes[s, n, 3]
            if m < least:
                nodes[s, n] = np.float32(0.0)
            else:
                r = _ONE / m
                v = nodes[s, n, 0] * r, nodes[s, n, 1] * r, nodes[s, n, 2] * r
                v = apply_forces(v, gain, damping_factor, drag_factor, flow)
                nodes[s, n, 0], nodes[s, n, 1], nodes[s, n, 2] = v


@njit
def hold_pins(
    x: Array, motion: Array, pinned: Array, pin_velocity: Array, slot: Array, grid: Nodes, held: Array, marks: Array
) -> None:
    """Nodes with pinned matter move as the pins do.

    Parameters
    ----------
    x : (n, 3) float64 array
        See `Particles`.
    motion : (n, WIDTH) float32 array
        See `Packed`.
    pinned : (k,) int64 array
        Particles held.
    pin_velocity : (k, 3) float32 array
        m/s.
    slot : (bx, by, bz) int32 array
        See `Arrangement`.
    grid : Nodes
        Velocities; changed.
    held : (a, 64, 4) float32 array
        Zero before and after: pinned momentum and mass.
    marks : (a, 64) bool array
        Set where a node moves as the pins do; without rows nothing is said.
    """
    nodes, origin, spacing = grid.values, grid.origin, grid.spacing
    scale = 1.0 / spacing
    for turn in range(2):
        for q in range(len(pinned)):
            p = pinned[q]
            i, j, k, fx, fy, fz = cell_of(x, p, origin, scale)
            wx, wy, wz = weights_of(fx), weights_of(fy), weights_of(fz)
            for ii in range(3):
                for jj in range(3):
                    for kk in range(3):
                        s = slot[(i + ii) >> 2, (j + jj) >> 2, (k + kk) >> 2]
                        n = (((i + ii) & 3) * 4 + ((j + jj) & 3)) * 4 + ((k + kk) & 3)
                        if turn == 0:
                            w = wx[ii] * wy[jj] * wz[kk] * motion[p, MASS]
                            held[s, n, 3] += w
                            for c in range(3):
                                held[s, n, c] += w * pin_velocity[q, c]
                        else:
                            m = held[s, n, 3]
                            if m > PINNED * nodes[s, n, 3]:
                                for c in range(3):
                                    nodes[s, n, c] = held[s, n, c] / m
                                if len(marks):
                                    marks[s, n] = True
                            held[s, n] = np.float32(0.0)
