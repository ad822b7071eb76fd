"""One step of MLS-MPM: particles to grid (P2G), the grid's own step, grid to particles (G2P).

After Hu et al. 2018 (moving least squares MPM) with APIC (Jiang et al. 2015) and quadratic B-splines. A block works on
a scratch of 8^3 nodes from cell -1 to 6 of the block, which lets particles drift by a cell.
Single precision stalls slow motion and slow strain: positions are double, and deformation gradients are kept less 1.
"""

from __future__ import annotations

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.simd import fold, load, quads, repeat, spread, store
from ..compute.threads import over_range
from ..core.sim_materials import ELASTIC, LAMBDA, MU
from .constitutive import neo_hookean, respond
from .grid_blocks import SLOTS, Arrangement, Nodes
from .particles import Particles, Properties

Array = np.ndarray

_ZERO, _HALF, _ONE, _ONE_HALF = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(1.5)

#: 8^3 nodes of momentum (or velocity) and mass, and one more, as rows are loaded four nodes at a time.
SCRATCH = 2048 + 4

#: Where the nodes of the block before, of its own and of the block after it begin along an axis of a scratch.
_BOUNDS = (0, 1, 5, 8)

#: Share of a node's matter that is pinned from which on the node is. On a flat border between pinned and free matter
#: the last node held is then, over all positions of the grid, on average on the border itself.
PINNED = np.float32(0.2)

#: Share of the matter of the fullest node around below which a node says nothing about how a marker moves: the few
#: grains at its rim, pushed by all others, are no surface.
BARE = np.float32(0.1)


@inlined
def weights_of(f):  # type: ignore[no-untyped-def]
    """Quadratic B-spline weights of three nodes along an axis; they sum to 1 as rounded.

    Parameters
    ----------
    f : float32
        Distance from the first node, in grid spacings, 0.5 to 1.5.

    Returns
    -------
    first, middle, last : float32
    """
    a, c = _ONE_HALF - f, f - _HALF
    first, last = _HALF * a * a, _HALF * c * c
    return first, (_ONE - first) - last, last


@inlined
def cell_of(x, p, origin, scale):  # type: ignore[no-untyped-def]
    """The first of the three nodes around a particle along each axis.

    Parameters
    ----------
    x : (n, 3) float64 array
        Positions, world, m.
    p : int64
        Particle.
    origin : (3,) float64 array
        `Domain.origin`, m.
    scale : float64
        1 / spacing, 1/m.

    Returns
    -------
    i, j, k : int64
        Node of the domain.
    fx, fy, fz : float32
        Distance of the particle from it, in grid spacings.
    """
    gx, gy, gz = (x[p, 0] - origin[0]) * scale, (x[p, 1] - origin[1]) * scale, (x[p, 2] - origin[2]) * scale
    i, j, k = int(gx - 0.5), int(gy - 0.5), int(gz - 0.5)
    return i, j, k, np.float32(gx - i), np.float32(gy - j), np.float32(gz - k)


@inlined
def node_of(neighbour, b, i, j, k):  # type: ignore[no-untyped-def]
    """Where a node of a block's scratch lies in the grid and in the scratch.

    Parameters
    ----------
    neighbour : (b, 27) int32 array
        `Arrangement.neighbour`.
    b : int64
        Block.
    i, j, k : int64
        Node of the scratch, 0 to 7.

    Returns
    -------
    slot : int32
        Of `Nodes.values`.
    number : int64
        Node of the slot, 0 to 63.
    offset : int64
        In the scratch.
    """
    e = (((i + 3) >> 2) * 3 + ((j + 3) >> 2)) * 3 + ((k + 3) >> 2)
    n = (((i + 3) & 3) * 4 + ((j + 3) & 3)) * 4 + ((k + 3) & 3)
    return neighbour[b, e], n, ((i * 8 + j) * 8 + k) * 4


@inlined
def _steps():  # type: ignore[no-untyped-def]
    """How many spacings each node of a row is from its first."""
    return quads(_ZERO, _ONE, np.float32(2.0), np.float32(3.0))


@inlined
def _carried(scratch, base, wx, wy, wz):  # type: ignore[no-untyped-def]
    """Velocity that matter gives to a marker, and the weight of the nodes it comes from: 0 where there is no matter."""
    heaviest = _ZERO
    for ii in range(3):
        for jj in range(3):
            for kk in range(3):
                heaviest = max(heaviest, scratch[base + ii * 256 + jj * 32 + 4 * kk + 3])
    x = y = z = weight = _ZERO
    for ii in range(3):
        for jj in range(3):
            for kk in range(3):
                n = base + ii * 256 + jj * 32 + 4 * kk
                if scratch[n + 3] > BARE * heaviest:
                    w = wx[ii] * wy[jj] * wz[kk]
                    x, y, z, weight = x + w * scratch[n], y + w * scratch[n + 1], z + w * scratch[n + 2], weight + w
    if weight > _ZERO:
        x, y, z = x / weight, y / weight, z / weight
    return x, y, z, weight


@inlined
def update_deformation_gradient(f, p, step, gradient):  # type: ignore[no-untyped-def]
    """Update of the deformation gradient in a step: F becomes (1 + step grad v) F, in place.

    Parameters
    ----------
    f : (n, 9) float32 array
        F - 1, row-major; row `p` is written.
    p : int64
        Particle.
    step : float32
        Seconds.
    gradient : tuple of float
        Nine, of the velocity, 1/s, row-major.
    """
    g0, g1, g2, g3, g4, g5, g6, g7, g8 = gradient
    h0, h4, h8 = f[p, 0], f[p, 4], f[p, 8]
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = _ONE + h0, f[p, 1], f[p, 2], f[p, 3], _ONE + h4, f[p, 5], f[p, 6], f[p, 7], _ONE + h8  # noqa: E501  # fmt: skip
    f[p, 0] = h0 + step * (g0 * f0 + g1 * f3 + g2 * f6)
    f[p, 1] = f1 + step * (g0 * f1 + g1 * f4 + g2 * f7)
    f[p, 2] = f2 + step * (g0 * f2 + g1 * f5 + g2 * f8)
    f[p, 3] = f3 + step * (g3 * f0 + g4 * f3 + g5 * f6)
    f[p, 4] = h4 + step * (g3 * f1 + g4 * f4 + g5 * f7)
    f[p, 5] = f5 + step * (g3 * f2 + g4 * f5 + g5 * f8)
    f[p, 6] = f6 + step * (g6 * f0 + g7 * f3 + g8 * f6)
    f[p, 7] = f7 + step * (g6 * f1 + g7 * f4 + g8 * f7)
    f[p, 8] = h8 + step * (g6 * f2 + g7 * f5 + g8 * f8)


@inlined
def momentum_of(p, v, affine, tau, m, q, h, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Momentum that a particle gives to the nodes around it (MLS-MPM, Hu et al. 2018), before the B-spline weights.

    It is m v + (m C - factor V tau) d, with d from the particle to the node: linear in the node.

    Parameters
    ----------
    p : int64
        Particle.
    v, affine, tau : array
        (n, 3), (n, 9) and (n, 6) float32, see `Particles`.
    m : float32
        Mass, kg.
    q : float32
        -factor V, with factor = 4 dt / spacing^2.
    h : float32
        Grid spacing, m.
    fx, fy, fz : float32
        Distance of the particle from the first node, in grid spacings.

    Returns
    -------
    mx, my, mz : float32
        For the first node, kg m/s.
    a00, a01, a02, a10, a11, a12, a20, a21, a22 : float32
        What is added per node along x, y and z (columns), row by row, kg m/s.
    """
    a00, a01, a02 = (m * affine[p, 0] + q * tau[p, 0]) * h, (m * affine[p, 1] + q * tau[p, 3]) * h, (m * affine[p, 2] + q * tau[p, 4]) * h  # noqa: E501  # fmt: skip
    a10, a11, a12 = (m * affine[p, 3] + q * tau[p, 3]) * h, (m * affine[p, 4] + q * tau[p, 1]) * h, (m * affine[p, 5] + q * tau[p, 5]) * h  # noqa: E501  # fmt: skip
    a20, a21, a22 = (m * affine[p, 6] + q * tau[p, 4]) * h, (m * affine[p, 7] + q * tau[p, 5]) * h, (m * affine[p, 8] + q * tau[p, 2]) * h  # noqa: E501  # fmt: skip
    mx = m * v[p, 0] - a00 * fx - a01 * fy - a02 * fz
    my = m * v[p, 1] - a10 * fx - a11 * fy - a12 * fz
    mz = m * v[p, 2] - a20 * fx - a21 * fy - a22 * fz
    return mx, my, mz, a00, a01, a02, a10, a11, a12, a20, a21, a22


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


def p2g(
    particles: Particles, properties: Properties, places: Arrangement, grid: Nodes, dt: float, scratch: Array
) -> None:
    """Particles to grid: momentum and mass of its nodes are written.

    Parameters
    ----------
    particles : Particles
        In the order of the arrangement.
    properties : Properties
    places : Arrangement
    grid : Nodes
        Written.
    dt : float
        Seconds.
    scratch : (b, SCRATCH) float32 array
        A row per block with particles; overwritten.
    """
    parts = len(places.shares) - 1
    over_range(_sum_particles, parts, particles, properties, places, grid.origin, grid.spacing, dt, scratch)
    sources = places.source, places.source_start
    over_range(_sum_blocks, len(grid.values), *sources, scratch, grid.values, fewest=SLOTS)


@njit
def _sum_particles(first, last, particles, properties, places, origin, spacing, dt, scratches):  # type: ignore[no-untyped-def]
    """What the particles of each block in some shares give, in the block's scratch."""
    x, v, affine, tau = particles.x, particles.v, particles.affine, particles.tau
    mass, volume = properties.mass, properties.volume
    block, shares, start = places.block, places.shares, places.start
    scale = 1.0 / spacing
    h = np.float32(spacing)
    factor = np.float32(4.0 * dt * scale * scale)
    for b in range(shares[first], shares[last]):
        scratch = scratches[b]
        scratch[:] = _ZERO
        cx, cy, cz = 4 * block[b, 0] - 1, 4 * block[b, 1] - 1, 4 * block[b, 2] - 1
        for p in range(start[b], start[b + 1]):
            m = mass[p]
            if m == np.float32(0.0):
                continue
            i, j, k, fx, fy, fz = cell_of(x, p, origin, scale)
            wx, wy, wz = weights_of(fx), weights_of(fy), weights_of(fz)
            q = -factor * volume[p]
            mx, my, mz, a00, a01, a02, a10, a11, a12, a20, a21, a22 = momentum_of(
                p, v, affine, tau, m, q, h, fx, fy, fz
            )
            base = (((i - cx) * 8 + (j - cy)) * 8 + (k - cz)) * 4
            # A row of nodes along z at once; the fourth has no weight.
            along = quads(wz[0], wz[1], wz[2], _ZERO)
            here = along * (repeat(mx, my, mz, m) + _steps() * repeat(a02, a12, a22, _ZERO))
            per_x, per_y = along * repeat(a00, a10, a20, _ZERO), along * repeat(a01, a11, a21, _ZERO)
            for ii in range(3):
                line = here + np.float32(ii) * per_x
                for jj in range(3):
                    at = base + ii * 256 + jj * 32
                    row = (wx[ii] * wy[jj]) * (line + np.float32(jj) * per_y)
                    store(scratch, at, load(scratch, at) + row)


@njit
def _sum_blocks(first, last, source, source_start, scratch, nodes):  # type: ignore[no-untyped-def]
    """What the blocks around give to the nodes of some slots, in the order of the blocks."""
    for s in range(first, last):
        values = nodes[s].reshape(256)
        values[:] = _ZERO
        for q in range(source_start[s], source_start[s + 1]):
            b, e = source[q] // 27, source[q] % 27
            i0, j0, k0 = _BOUNDS[e // 9], _BOUNDS[e // 3 % 3], _BOUNDS[e % 3]
            i1, j1, k1 = _BOUNDS[e // 9 + 1], _BOUNDS[e // 3 % 3 + 1], _BOUNDS[e % 3 + 1]
            for i in range(i0, i1):
                for j in range(j0, j1):
                    to, at = (((i + 3) & 3) * 4 + ((j + 3) & 3)) * 16 + ((k0 + 3) & 3) * 4, ((i * 8 + j) * 8 + k0) * 4
                    for c in range(4 * (k1 - k0)):
                        values[to + c] += scratch[b, at + c]


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


def g2p(
    particles: Particles, properties: Properties, places: Arrangement, grid: Nodes, dt: float, fastest: Array
) -> None:
    """Grid to particles: move them, deform them, and find their stress for the next step.

    Parameters
    ----------
    particles : Particles
        In the order of the arrangement; written.
    properties : Properties
    places : Arrangement
    grid : Nodes
        Velocities.
    dt : float
        Seconds.
    fastest : (b,) float32 array
        Written: the highest speed in each block, m/s; infinite where a particle is not finite.
    """
    over_range(_move_particles, len(places.shares) - 1, particles, properties, places, grid, dt, fastest)


@njit
def _move_particles(first, last, particles, properties, places, grid, dt, fastest):  # type: ignore[no-untyped-def]
    """`g2p` of the particles in some shares."""
    x, v, affine, elastic, total, tau, memory = particles
    mass, model, parameters, solid = properties.mass, properties.model, properties.parameters, properties.solid
    block, shares, start, neighbour = places.block, places.shares, places.start, places.neighbour
    nodes, origin, spacing = grid.values, grid.origin, grid.spacing
    scale = 1.0 / spacing
    to_gradient = np.float32(4.0 * scale)
    step = np.float32(dt)
    apart = len(total) > 0
    scratch = np.zeros(SCRATCH, np.float32)
    for b in range(shares[first], shares[last]):
        for i in range(8):
            for j in range(8):
                for k in range(8):
                    s, n, o = node_of(neighbour, b, i, j, k)
                    scratch[o] = nodes[s, n, 0]
                    scratch[o + 1] = nodes[s, n, 1]
                    scratch[o + 2] = nodes[s, n, 2]
                    scratch[o + 3] = nodes[s, n, 3]
        cx, cy, cz = 4 * block[b, 0] - 1, 4 * block[b, 1] - 1, 4 * block[b, 2] - 1
        top = np.float32(0.0)
        for p in range(start[b], start[b + 1]):
            i, j, k, fx, fy, fz = cell_of(x, p, origin, scale)
            wx, wy, wz = weights_of(fx), weights_of(fy), weights_of(fz)
            base = (((i - cx) * 8 + (j - cy)) * 8 + (k - cz)) * 4
            blend = per_x = per_y = spread(_ZERO)
            for ii in range(3):
                for jj in range(3):
                    row = (wx[ii] * wy[jj]) * load(scratch, base + ii * 256 + jj * 32)
                    blend = blend + row
                    per_x = per_x + (np.float32(ii) - fx) * row
                    per_y = per_y + (np.float32(jj) - fy) * row
            along = quads(wz[0], wz[1], wz[2], _ZERO)
            blend = along * blend
            vx, vy, vz, _ = fold(blend)
            if mass[p] == _ZERO:
                # Markers may be where some nodes have no matter: what there is counts fully; F follows no markers.
                vx, vy, vz, weight = _carried(scratch, base, wx, wy, wz)
                if weight <= _ZERO:
                    vx, vy, vz = v[p, 0], v[p, 1], v[p, 2]
            v[p, 0], v[p, 1], v[p, 2] = vx, vy, vz
            x[p, 0] += dt * vx
            x[p, 1] += dt * vy
            x[p, 2] += dt * vz
            speed = vx * vx + vy * vy + vz * vz
            top = top if speed <= top or top != top else speed  # NaN stays
            if mass[p] == _ZERO:
                continue
            b0, b3, b6, _ = fold(along * per_x)
            b1, b4, b7, _ = fold(along * per_y)
            b2, b5, b8, _ = fold((_steps() - spread(fz)) * blend)
            g0, g1, g2 = to_gradient * b0, to_gradient * b1, to_gradient * b2
            g3, g4, g5 = to_gradient * b3, to_gradient * b4, to_gradient * b5
            g6, g7, g8 = to_gradient * b6, to_gradient * b7, to_gradient * b8
            affine[p, 0], affine[p, 1], affine[p, 2] = g0, g1, g2
            affine[p, 3], affine[p, 4], affine[p, 5] = g3, g4, g5
            affine[p, 6], affine[p, 7], affine[p, 8] = g6, g7, g8
            gradient = g0, g1, g2, g3, g4, g5, g6, g7, g8
            update_deformation_gradient(elastic, p, step, gradient)
            if apart and solid[p]:
                update_deformation_gradient(total, p, step, gradient)
            if model[p] == ELASTIC:
                neo_hookean(elastic, p, parameters[p, MU], parameters[p, LAMBDA], tau)
            else:
                respond(p, model, parameters, elastic, tau, memory, affine, dt)
        fastest[b] = np.sqrt(top)


@njit
def hold_pins(
    x: Array, mass: Array, pinned: Array, pin_velocity: Array, slot: Array, grid: Nodes, held: Array, marks: Array
) -> None:
    """Nodes with pinned matter move as the pins do.

    Parameters
    ----------
    x : (n, 3) float64 array
        See `Particles`.
    mass : (n,) float32 array
        See `Properties`.
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
                            w = wx[ii] * wy[jj] * wz[kk] * mass[p]
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
