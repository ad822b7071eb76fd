"""One step of MLS-MPM: particles to grid (P2G), and after the grid's own step grid to particles (G2P).

After Hu et al. 2018 (moving least squares MPM) with APIC (Jiang et al. 2015) and quadratic B-splines. A block works on
a scratch of 8^3 nodes from cell -1 to 6 of the block, which lets particles drift by a cell.
Single precision stalls slow motion and slow strain: positions are double, and deformation gradients are kept less 1.
"""

from __future__ import annotations

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.simd import (
    LANES,
    fold_four,
    keep_fourths,
    load,
    quads,
    repeat,
    shuffled,
    spread,
    spread_at,
    store,
)
from ..compute.threads import over_range
from .grid_blocks import SLOTS, Arrangement, Nodes
from .lanes import TILE, room_for_one, update_lanes
from .packed import MASS, VOLUME, WIDTH, Packed

Array = np.ndarray

_ZERO, _HALF, _ONE, _ONE_HALF, _TWO = map(np.float32, (0.0, 0.5, 1.0, 1.5, 2.0))

_first, _second, _third, _fourth = (
    shuffled(*range(k, k + 4), *range(k, k + 4), *range(k, k + 4), *range(k, k + 4)) for k in (0, 4, 8, 12)
)
_three = shuffled(*range(12), -1, -1, -1, -1)
#: Columns of the stress in a row of `Packed.strain`, four numbers each as those of the velocity gradient.
_forces = shuffled(-1, -1, -1, -1, 9, 12, 13, -1, 12, 10, 14, -1, 13, 14, 11, -1)

#: 8^3 nodes of momentum (or velocity) and mass, and one more, as rows are loaded four nodes at a time.
SCRATCH = 2048 + 4

#: Where the nodes of the block before, of its own and of the block after it begin along an axis of a scratch.
_BOUNDS = (0, 1, 5, 8)

#: Share of the matter of the fullest node around below which a node says nothing about how a marker moves: the few
#: grains at its rim, pushed by all others, are no surface.
BARE = np.float32(0.1)

#: First rows, of sixteen numbers, about where particles are, after the distances from their first nodes. P2G: distances
#: from all three along x and y, weights along z and across; G2P: weights along x, y and z, and times the distances.
_DX, _DY, _WZ, _W = 3, 6, 9, 12
_WX, _SX, _WY, _SY, _ROWS = 12, 15, 18, 3, 21


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
def _locate(x, first, last, origin, scale, corner, base, near):  # type: ignore[no-untyped-def]
    """Where up to sixteen particles are: `base`, the first node around each in a scratch; `near`, distances from it.

    Apart from what is done with them, so that one need not wait for the other.
    """
    cx, cy, cz = corner
    for p in range(first, last):
        i, j, k, fx, fy, fz = cell_of(x, p, origin, scale)
        base[p - first] = (((i - cx) * 8 + (j - cy)) * 8 + (k - cz)) * 4
        near[p - first], near[LANES + p - first], near[2 * LANES + p - first] = fx, fy, fz


@inlined
def _put_three(near, row, three):  # type: ignore[no-untyped-def]
    a, b, c = three
    store(near, LANES * row, a)
    store(near, LANES * (row + 1), b)
    store(near, LANES * (row + 2), c)


@inlined
def _three_at(near, row, o):  # type: ignore[no-untyped-def]
    """Three rows from one on, of particle `o`."""
    return (
        spread_at(near, LANES * row + o),
        spread_at(near, LANES * (row + 1) + o),
        spread_at(near, LANES * (row + 2) + o),
    )


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


def p2g(rows: Packed, places: Arrangement, grid: Nodes, dt: float, scratch: Array) -> None:
    """Particles to grid: momentum and mass of its nodes are written.

    A particle gives m v + (m C - factor V tau) d, with d from it to the node, times the B-spline's weight.

    Parameters
    ----------
    rows : Packed
        In the order of the arrangement.
    places : Arrangement
    grid : Nodes
        Written.
    dt : float
        Seconds.
    scratch : (b, SCRATCH) float32 array
        A row per block with particles; overwritten.
    """
    parts = len(places.shares) - 1
    over_range(_sum_particles, parts, rows, places, grid.origin, grid.spacing, dt, scratch)
    sources = places.source, places.source_start
    over_range(_sum_blocks, len(grid.values), *sources, scratch, grid.values, fewest=SLOTS)


@inlined
def _no_nodes():  # type: ignore[no-untyped-def]
    """Nine rows of nodes to which nothing was given yet."""
    none = spread(_ZERO)
    return none, none, none, none, none, none, none, none, none


@inlined
def _given(sums, here, per_x, per_y, near, o):  # type: ignore[no-untyped-def]
    """The same and what a particle gives: `here`, more of it along x and y, times the weights."""
    s0, s1, s2, s3, s4, s5, s6, s7, s8 = sums
    d0, d1, d2 = _three_at(near, _DX, o)
    e0, e1, e2 = _three_at(near, _DY, o)
    e0, e1, e2 = e0 * per_y, e1 * per_y, e2 * per_y
    a, b, c = here + d0 * per_x, here + d1 * per_x, here + d2 * per_x
    w0, w1, w2 = _three_at(near, _W, o)
    w3, w4, w5 = _three_at(near, _W + 3, o)
    w6, w7, w8 = _three_at(near, _W + 6, o)
    return (
        s0 + w0 * (a + e0), s1 + w1 * (a + e1), s2 + w2 * (a + e2), s3 + w3 * (b + e0), s4 + w4 * (b + e1),
        s5 + w5 * (b + e2), s6 + w6 * (c + e0), s7 + w7 * (c + e1), s8 + w8 * (c + e2),
    )  # fmt: skip


@inlined
def _add_nodes(scratch, at, sums):  # type: ignore[no-untyped-def]
    """Add nine rows of nodes to those from `at` on in a scratch."""
    s0, s1, s2, s3, s4, s5, s6, s7, s8 = sums
    for k, a, b, c in ((0, s0, s1, s2), (256, s3, s4, s5), (512, s6, s7, s8)):
        store(scratch, at + k, load(scratch, at + k) + a)
        store(scratch, at + k + 32, load(scratch, at + k + 32) + b)
        store(scratch, at + k + 64, load(scratch, at + k + 64) + c)


@njit
def _sum_particles(first, last, particles, places, origin, spacing, dt, scratches):  # type: ignore[no-untyped-def]
    """What the particles of each block in some shares give, in the block's scratch."""
    x, motion, strain = particles.x, particles.motion, particles.strain
    block, shares, start = places.block, places.shares, places.start
    scale = 1.0 / spacing
    h = np.float32(spacing)
    factor = np.float32(-4.0 * dt * scale)
    vectors = repeat(_ONE, _ONE, _ONE, _ZERO)
    masses = quads(_ONE, _ZERO, _ZERO, _ZERO) * repeat(_ZERO, _ZERO, _ZERO, _ONE)
    base, near = np.zeros(LANES, np.int64), np.zeros(LANES * _ROWS, np.float32)
    for b in range(shares[first], shares[last]):
        scratch = scratches[b]
        scratch[:] = _ZERO
        corner = 4 * block[b, 0] - 1, 4 * block[b, 1] - 1, 4 * block[b, 2] - 1
        at, sums = -1, _no_nodes()
        for q in range(start[b], start[b + 1], LANES):
            end = min(q + LANES, start[b + 1])
            _locate(x, q, end, origin, scale, corner, base, near)
            fx, fy, fz = load(near, 0), load(near, LANES), load(near, 2 * LANES)
            _put_three(near, _WZ, weights_of(fz))
            _put_three(near, _DX, (_ZERO - fx, _ONE - fx, _TWO - fx))
            _put_three(near, _DY, (_ZERO - fy, _ONE - fy, _TWO - fy))
            wx, (y0, y1, y2) = weights_of(fx), weights_of(fy)
            for ii in range(3):
                _put_three(near, _W + 3 * ii, (wx[ii] * y0, wx[ii] * y1, wx[ii] * y2))
            for p in range(q, end):
                m = motion[p, MASS]
                if m == _ZERO:
                    continue
                o = p - q
                # Momentum and mass, and what is added to them a spacing further along x, y and z, four numbers each.
                of_mass = vectors * quads(m, m * h, m * h, m * h) + masses
                forces = spread(factor * motion[p, VOLUME]) * _forces(load(strain, WIDTH * p))
                given = of_mass * load(motion, WIDTH * p) + forces
                # A row of nodes along z at once; the fourth has no weight.
                along = quads(near[_WZ * LANES + o], near[(_WZ + 1) * LANES + o], near[(_WZ + 2) * LANES + o], _ZERO)
                here = along * (_first(given) + (_steps() - spread_at(near, 2 * LANES + o)) * _fourth(given))
                per_x, per_y = along * _second(given), along * _third(given)
                if base[o] != at:
                    if at >= 0:
                        _add_nodes(scratch, at, sums)
                    at, sums = base[o], _no_nodes()
                sums = _given(sums, here, per_x, per_y, near, o)
        if at >= 0:
            _add_nodes(scratch, at, sums)


@njit
def _sum_blocks(first, last, source, source_start, scratch, nodes):  # type: ignore[no-untyped-def]
    """What the blocks around give to the nodes of some slots, in the order of the blocks."""
    for s in range(first, last):
        values = nodes[s].reshape(256)
        values[:] = _ZERO
        for q in range(source_start[s], source_start[s + 1]):
            b, e = source[q] // 27, source[q] % 27
            i0, j0, k0 = _BOUNDS[e // 9], _BOUNDS[e // 3 % 3], _BOUNDS[e % 3]
            i1, j1 = _BOUNDS[e // 9 + 1], _BOUNDS[e // 3 % 3 + 1]
            for i in range(i0, i1):
                for j in range(j0, j1):
                    to, at = (((i + 3) & 3) * 4 + ((j + 3) & 3)) * 16 + ((k0 + 3) & 3) * 4, ((i * 8 + j) * 8 + k0) * 4
                    if k0 > 0:
                        row = load(scratch, b * SCRATCH + at)
                        store(values, to, load(values, to) + (row if k0 == 1 else _three(row)))
                        continue
                    for c in range(4):
                        values[to + c] += scratch[b, at + c]


def g2p(rows: Packed, places: Arrangement, grid: Nodes, dt: float, fastest: Array) -> None:
    """Grid to particles: move them, deform them, and find their stress for the next step.

    Parameters
    ----------
    rows : Packed
        In the order of the arrangement; written.
    places : Arrangement
    grid : Nodes
        Velocities.
    dt : float
        Seconds.
    fastest : (b,) float32 array
        Written: the highest speed in each block, m/s; infinite where a particle is not finite.
    """
    over_range(_move_particles, len(places.shares) - 1, rows, places, grid, dt, fastest)


@inlined
def _fill(scratch, nodes, neighbour, b):  # type: ignore[no-untyped-def]
    """Nodes that particles of a block may need: of a row along z one of a slot, four of the next, three of the last."""
    for i in range(8):
        for j in range(8):
            e, n = ((i + 3 >> 2) * 3 + (j + 3 >> 2)) * 3, ((i + 3 & 3) * 4 + (j + 3 & 3)) * 16
            before, own, after = neighbour[b, e], neighbour[b, e + 1], neighbour[b, e + 2]
            o = (i * 8 + j) * 32
            for c in range(4):
                scratch[o + c] = nodes[before, n // 4 + 3, c]
            store(scratch, o + 4, load(nodes, 256 * own + n))
            store(scratch, o + 20, load(nodes, 256 * after + n))  # and four numbers that come next


@inlined
def _put_blend(near):  # type: ignore[no-untyped-def]
    """Weights of three nodes along each axis, and along x and y those times the distances from them."""
    fx, fy, fz = load(near, 0), load(near, LANES), load(near, 2 * LANES)
    (x0, x1, x2), (y0, y1, y2) = weights_of(fx), weights_of(fy)
    _put_three(near, _WX, (x0, x1, x2))
    _put_three(near, _SX, (x0 * (_ZERO - fx), x1 * (_ONE - fx), x2 * (_TWO - fx)))
    _put_three(near, _WY, (y0, y1, y2))
    _put_three(near, _SY, (y0 * (_ZERO - fy), y1 * (_ONE - fy), y2 * (_TWO - fy)))
    _put_three(near, _WZ, weights_of(fz))


@inlined
def _gathered(scratch, base, near, o):  # type: ignore[no-untyped-def]
    """Velocity of particle `o`, and along x, y and z its gradient less 4 / spacing, of three rows of nodes each way."""
    w0, w1, w2 = _three_at(near, _WY, o)
    d0, d1, d2 = _three_at(near, _SY, o)
    blend = per_x = per_y = spread(_ZERO)
    for ii in range(3):
        at = base + ii * 256
        n0, n1, n2 = load(scratch, at), load(scratch, at + 32), load(scratch, at + 64)
        line = w0 * n0 + w1 * n1 + w2 * n2
        slope = d0 * n0 + d1 * n1 + d2 * n2
        w = spread_at(near, (_WX + ii) * LANES + o)
        blend = blend + w * line
        per_x = per_x + spread_at(near, (_SX + ii) * LANES + o) * line
        per_y = per_y + w * slope
    along = quads(near[_WZ * LANES + o], near[(_WZ + 1) * LANES + o], near[(_WZ + 2) * LANES + o], _ZERO)
    blend = along * blend
    return fold_four(blend, along * per_x, along * per_y, (_steps() - spread_at(near, 2 * LANES + o)) * blend)


@njit
def _move_particles(first, last, particles, places, grid, dt, fastest):  # type: ignore[no-untyped-def]
    """`g2p` of the particles in some shares, sixteen at a time."""
    x, motion = particles.x, particles.motion
    block, shares, start, neighbour = places.block, places.shares, places.start, places.neighbour
    nodes, origin, spacing = grid.values, grid.origin, grid.spacing
    scale = 1.0 / spacing
    to_gradient, step = np.float32(4.0 * scale), np.float32(dt)
    units = quads(_ONE, to_gradient, to_gradient, to_gradient)
    scratch, tile, turned = np.zeros(SCRATCH, np.float32), np.zeros(TILE, np.float32), np.zeros(TILE, np.float32)
    own, base, near = room_for_one(), np.zeros(LANES, np.int64), np.zeros(LANES * _ROWS, np.float32)
    for b in range(shares[first], shares[last]):
        _fill(scratch, nodes, neighbour, b)
        corner = 4 * block[b, 0] - 1, 4 * block[b, 1] - 1, 4 * block[b, 2] - 1
        top = _ZERO
        for q in range(start[b], start[b + 1], LANES):
            end = min(q + LANES, start[b + 1])
            _locate(x, q, end, origin, scale, corner, base, near)
            _put_blend(near)
            markers = False
            for p in range(q, end):
                if motion[p, MASS] != _ZERO:
                    now = units * _gathered(scratch, base[p - q], near, p - q)
                    store(motion, WIDTH * p, keep_fourths(now, load(motion, WIDTH * p)))
                else:
                    markers = True
            if markers:
                _carry_markers(x, motion, q, end, scratch, base, near)
            for p in range(q, end):
                vx, vy, vz = motion[p, 0], motion[p, 1], motion[p, 2]
                x[p, 0] += dt * vx
                x[p, 1] += dt * vy
                x[p, 2] += dt * vz
                speed = vx * vx + vy * vy + vz * vz
                top = top if speed <= top or top != top else speed  # NaN stays
            update_lanes(particles, q, end, step, tile, turned, own)
        fastest[b] = np.sqrt(top)


@njit
def _carry_markers(x, motion, first, last, scratch, base, near):  # type: ignore[no-untyped-def]
    """Velocities of markers, which may be where some nodes have no matter: what there is counts fully."""
    for p in range(first, last):
        if motion[p, MASS] == _ZERO:
            o = p - first
            wx = weights_of(near[o])
            wy, wz = weights_of(near[LANES + o]), weights_of(near[2 * LANES + o])
            vx, vy, vz, weight = _carried(scratch, base[o], wx, wy, wz)
            if weight > _ZERO:
                motion[p, 0], motion[p, 1], motion[p, 2] = vx, vy, vz
