"""A time step on a device: functions that are translated and never run as they stand.

What they take comes in tuples, in the order in which they take them apart: `grid` is origin (x, y, z) and spacing,
`time` the clock and the times of all steps, `blocks` where particles and nodes are, see `gpu.cells`.

Each node gathers what the particles around it give it, in their order, so that the same bits come of any number of
threads. Particles keep their places in memory; `order` says which is where among those sorted by cells. Since then they
may have moved by a cell.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...compute.warp.kernels import WarpKernel
from ...compute.warp.translate import Native
from ...compute.warp.types import Array
from ..constitutive import respond
from ..contact import respond as slide
from ..contact import surface_near
from ..fields import push_of
from ..node_forces import PINNED, apply_forces
from ..p2g_g2p import BARE, cell_of, node_of, weights_of
from .updates import momentum_of, update_deformation_gradient

F = np.float32
ZERO, ONE = F(0.0), F(1.0)

#: What `clock` holds: the number of the step, cells that particles have drifted, whether the steps that were planned
#: are no longer good, at which drift and speed they are not (`grid.Limits`), and then the highest speed of each step.
STEP, DRIFT, STOPPED, MOST_DRIFT, MOST_SPEED, OUTSIDE, TOPS = range(7)
#: Columns of `times`: a step's length, the factors of drag and damping (`p2g_g2p.apply_forces`), and velocity gained
#: by gravity.
DT, DRAG_FACTOR, DAMPING_FACTOR, GAIN = 0, 1, 2, 3
#: Columns of a particle's packet: how far it is from its first node, mass, momentum and its growth from node to node.
OFFSET, MASS, MOMENTUM, GROWTH, PACKET = 0, 3, 4, 7, 16
#: Columns of `cell`: the first of the nodes around a particle, and which pin it is, or -1.
PIN, CELL = 3, 4
#: First node of a particle that gives nothing.
_NOWHERE = -9
#: Columns of `shapes` and of `contacts`, and rows of `vectors`, of a collider.
DISTANCE, VELOCITY, SIZE, SHAPE = 0, 1, 2, 5
CELLS, THICKNESS, CONTACT, FRICTION, SURFACE = 0, 1, 2, 3, 4
SHIFT, LINEAR, SPIN, ORIGIN, VECTORS = 0, 1, 2, 3, 4
#: Layers of cells along x that the particles around a node may have been in when they were sorted, and what a layer
#: gives: momentum (x, y, z) and mass, of all particles and of what is pinned.
LAYERS, SUMS = 5, 8
#: Places among which the highest speed is sought.
SLOTS = 32


def distances_at(address: Any, nx: Any, ny: Any, nz: Any) -> Any:
    """An array (nx, ny, nz) float32 in memory."""
    raise NotImplementedError


def velocities_at(address: Any, nx: Any, ny: Any, nz: Any) -> Any:
    """An array (nx, ny, nz, 3) float32 in memory."""
    raise NotImplementedError


def raise_to(bits: Any, at: Any, value: Any) -> None:
    """Raise an element of an array to a number that is not negative; not a number is the highest."""
    raise NotImplementedError


def number_of(bits: Any) -> Any:
    """The number that `raise_to` put."""
    raise NotImplementedError


def _view(name: str, shape: str, axes: int) -> Native:
    source = f"""
@wp.func
def {name}(address: wp.int64, nx: wp.int64, ny: wp.int64, nz: wp.int64):
    return wp.array(ptr=wp.uint64(address), shape=({shape}), dtype=wp.float32)
"""
    return Native(source, name, Array("float32", axes))


_SIDES = "wp.int32(nx), wp.int32(ny), wp.int32(nz)"
_RAISE = """
@wp.func
def raise_to(bits: wp.array(dtype=wp.int32), at: wp.int64, value: wp.float32):
    if value == value:
        wp.atomic_max(bits, wp.int32(at), wp.cast(value, wp.int32))
    else:
        wp.atomic_max(bits, wp.int32(at), wp.int32(0x7FC00000))
"""
_NUMBER = """
@wp.func
def number_of(bits: wp.int32):
    return wp.cast(bits, wp.float32)
"""
NATIVES = {
    distances_at: _view("distances_at", _SIDES, 3),
    velocities_at: _view("velocities_at", f"{_SIDES}, 3", 4),
    raise_to: Native(_RAISE, "raise_to", None),
    number_of: Native(_NUMBER, "number_of", "float32"),
}


def prepare_particles(  # type: ignore[no-untyped-def]
    thread, stride, scratch, order, particles, properties, grid, time, out
):
    """P2G contribution of each particle to the nodes around it.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`; so of all kernels here.
    order : array
        Particles, sorted by cells.
    particles : tuple of array
        Position, velocity, `affine` and `tau`, see `Particles`.
    properties : tuple of array
        Mass (kg), volume (m^3) and pin (-1: none) of each particle.
    grid, time : tuple
        See this module's head.
    out : tuple of array
        (n, CELL) int32 and (n, PACKET) float32, in the order of `order`; written.
    """
    x, v, affine, tau = particles
    mass, volume, pin = properties
    origin, spacing = grid
    clock, times = time
    cell, packet = out
    if clock[STOPPED] != 0.0:
        return
    dt = times[int(clock[STEP]), DT]
    scale = 1.0 / spacing
    h, factor = F(spacing), F(4.0 * dt * scale * scale)
    for at in range(thread, len(mass), stride):
        p = np.int64(order[at])
        m = mass[p]
        if m == ZERO:
            cell[at, 0] = np.int32(_NOWHERE)
            continue
        i, j, k, fx, fy, fz = cell_of(x, p, origin, scale)
        mx, my, mz, a00, a01, a02, a10, a11, a12, a20, a21, a22 = momentum_of(
            p, v, affine, tau, m, -factor * volume[p], h, fx, fy, fz
        )
        cell[at, 0], cell[at, 1], cell[at, 2], cell[at, PIN] = np.int32(i), np.int32(j), np.int32(k), pin[p]
        packet[at, 0], packet[at, 1], packet[at, 2], packet[at, MASS] = fx, fy, fz, m
        packet[at, 4], packet[at, 5], packet[at, 6] = mx, my, mz
        packet[at, 7], packet[at, 8], packet[at, 9] = a00, a01, a02
        packet[at, 10], packet[at, 11], packet[at, 12] = a10, a11, a12
        packet[at, 13], packet[at, 14], packet[at, 15] = a20, a21, a22


def chosen(weights: Any, which: Any) -> Any:
    """One of three."""
    return weights[0] if which == 0 else (weights[1] if which == 1 else weights[2])


def gathered(i: Any, j: Any, k: Any, s: Any, ci: Any, blocks: Any, given: Any, pins: Any) -> Any:
    """Momentum and mass of node (i, j, k) of active block s, from the cells at `ci` along x, and of what is pinned.

    `given` is what `prepare_particles` wrote.
    """
    first, neighbour = blocks
    cell, packet = given
    pin_velocity, pinned = pins
    px, py, pz, m = ZERO, ZERO, ZERO, ZERO
    hx, hy, hz, held = ZERO, ZERO, ZERO, ZERO
    # Cells that the particles around the node may have been in when they were sorted; along z they are in two blocks.
    for cj in range(j - 3, j + 2):
        column = ((ci & 3) * 4 + (cj & 3)) * 4
        e = (((ci >> 2) - (i >> 2) + 1) * 3 + (cj >> 2) - (j >> 2) + 1) * 3 + 1 - (k >> 2)
        for half in range(2):
            ck = k - 3 if half == 0 else k + 1
            b = np.int64(neighbour[s, e + (ck >> 2)])
            if b < 0:
                continue
            low, high = (ck & 3 if half == 0 else 0), (4 if half == 0 else (ck & 3) + 1)
            for p in range(first[b, column + low], first[b, column + high]):
                ii, jj, kk = i - cell[p, 0], j - cell[p, 1], k - cell[p, 2]
                if ii < 0 or ii > 2 or jj < 0 or jj > 2 or kk < 0 or kk > 2:
                    continue
                w = chosen(weights_of(packet[p, 0]), ii) * chosen(weights_of(packet[p, 1]), jj)
                w = w * chosen(weights_of(packet[p, 2]), kk)
                a, c, d = F(ii), F(jj), F(kk)
                px += w * (packet[p, 4] + a * packet[p, 7] + c * packet[p, 8] + d * packet[p, 9])
                py += w * (packet[p, 5] + a * packet[p, 10] + c * packet[p, 11] + d * packet[p, 12])
                pz += w * (packet[p, 6] + a * packet[p, 13] + c * packet[p, 14] + d * packet[p, 15])
                m += w * packet[p, MASS]
                if pinned and cell[p, PIN] >= 0:
                    q = np.int64(cell[p, PIN])
                    own = w * packet[p, MASS]
                    hx += own * pin_velocity[q, 0]
                    hy += own * pin_velocity[q, 1]
                    hz += own * pin_velocity[q, 2]
                    held += own
    return px, py, pz, m, hx, hy, hz, held


def gather_nodes(thread, stride, scratch, blocks, given, pins, clock, out):  # type: ignore[no-untyped-def]
    """Particles to grid: what each layer of cells along x gives to the nodes of active blocks.

    A thread takes one layer of a node: nodes alone are too few to fill a card.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    blocks : tuple
    given : tuple of array
        Output of `prepare_particles`.
    pins : tuple
        Velocities of pins and whether there are any.
    clock : array
    out : tuple of array
        Sums of each layer, (LAYERS, slots * 64, SUMS) float32; written.
    """
    sizes, active, first, neighbour = blocks
    (sums,) = out
    if clock[STOPPED] != 0.0:
        return
    total = sizes[0] * 64
    for at in range(thread, total * LAYERS, stride):
        layer, node = at // total, at % total
        s, n = node // 64, node % 64
        i, j, k = 4 * active[s, 0] + n // 16, 4 * active[s, 1] + n // 4 % 4, 4 * active[s, 2] + n % 4
        px, py, pz, m, hx, hy, hz, held = gathered(i, j, k, s, i - 3 + layer, (first, neighbour), given, pins)
        sums[layer, node, 0], sums[layer, node, 1], sums[layer, node, 2], sums[layer, node, 3] = px, py, pz, m
        sums[layer, node, 4], sums[layer, node, 5], sums[layer, node, 6], sums[layer, node, 7] = hx, hy, hz, held


def touched_by(v: Any, place: Any, step: Any, c: Any, colliders: Any) -> Any:
    """Velocity (x, y, z) of a node at a place (x, y, z) after it has met collider c, as `contact.collide` has it."""
    shapes, turns, vectors, contacts = colliders
    vx, vy, vz = v
    gx, gy, gz = place
    nx, ny, nz = shapes[c, SIZE], shapes[c, SIZE + 1], shapes[c, SIZE + 2]
    some = 1 if shapes[c, VELOCITY] != 0 else 0
    shift = vectors[step, c, SHIFT]
    distance = distances_at(shapes[c, DISTANCE], nx, ny, nz)
    velocity = velocities_at(shapes[c, VELOCITY], nx * some, ny * some, nz * some)
    d, mx, my, mz, ux, uy, uz = surface_near(
        (gx - shift[0], gy - shift[1], gz - shift[2]),
        (vectors[step, c, ORIGIN], contacts[c, CELLS], distance, velocity),
        (turns[step, c], shift, vectors[step, c, LINEAR], vectors[step, c, SPIN]),
    )
    if d < contacts[c, THICKNESS]:
        x, y, z = slide(v, (ux, uy, uz), (mx, my, mz), int(contacts[c, CONTACT]), contacts[c, FRICTION])
        return F(x), F(y), F(z)
    return vx, vy, vz


def bounded_by(v: Any, place: Any, spacing: Any, planes: Any, q: Any) -> Any:
    """Velocity bounded by a plane, as `contact.bound` has it."""
    vx, vy, vz = v
    gx, gy, gz = place
    ax, ay, az = planes[q, 0], planes[q, 1], planes[q, 2]
    if ax * gx + ay * gy + az * gz - planes[q, 3] <= 1e-9 * spacing:
        x, y, z = slide(v, (0.0, 0.0, 0.0), (ax, ay, az), int(planes[q, 4]), planes[q, 5])
        return F(x), F(y), F(z)
    return vx, vy, vz


def solve_nodes(thread, stride, scratch, blocks, sums, grid, time, obstacles, forces, out):  # type: ignore[no-untyped-def]
    """The grid's own step: velocities of all nodes of active blocks.

    Parameters
    ----------
    thread, stride : int
    scratch : object
        Not used.
    blocks : tuple
    sums : array
        Output of `gather_nodes`.
    grid : tuple
    time : tuple of array
    obstacles : tuple
        Colliders and whether there are any; planes and whether; whether there are pins.
    forces : tuple
        kg, below which a node is empty; wind; rows of fields and whether there are any.
    out : tuple of array
        Nodes.
    """
    sizes, active, _, _ = blocks
    origin, spacing = grid
    clock, times = time
    colliders, touched, planes, bounded, pinned = obstacles
    least, wind, rows, blown = forces
    (nodes,) = out
    if clock[STOPPED] != 0.0:
        return
    step = int(clock[STEP])
    dt = times[step, DT]
    for at in range(thread, sizes[0] * 64, stride):
        s, n = at // 64, at % 64
        i, j, k = 4 * active[s, 0] + n // 16, 4 * active[s, 1] + n // 4 % 4, 4 * active[s, 2] + n % 4
        px, py, pz, m = ZERO, ZERO, ZERO, ZERO
        hx, hy, hz, held = ZERO, ZERO, ZERO, ZERO
        for layer in range(LAYERS):
            px, py, pz = px + sums[layer, at, 0], py + sums[layer, at, 1], pz + sums[layer, at, 2]
            m += sums[layer, at, 3]
            if pinned:
                hx, hy, hz = hx + sums[layer, at, 4], hy + sums[layer, at, 5], hz + sums[layer, at, 6]
                held += sums[layer, at, 7]
        if m < least or m == ZERO:
            nodes[at, 0], nodes[at, 1], nodes[at, 2], nodes[at, 3] = ZERO, ZERO, ZERO, ZERO
            continue
        r = ONE / m
        vx, vy, vz = apply_forces(
            (px * r, py * r, pz * r),
            (F(times[step, GAIN]), F(times[step, GAIN + 1]), F(times[step, GAIN + 2])),
            F(times[step, DAMPING_FACTOR]),
            F(times[step, DRAG_FACTOR]),
            (F(wind[0]), F(wind[1]), F(wind[2])),
        )
        gx, gy, gz = origin[0] + spacing * i, origin[1] + spacing * j, origin[2] + spacing * k
        if blown:
            for f in range(rows.shape[1]):
                ax, ay, az, flow = push_of(rows[step, f], gx, gy, gz)
                damping_factor = 1.0 / (1.0 + dt * flow)
                vx, vy = F((vx + dt * ax) * damping_factor), F((vy + dt * ay) * damping_factor)
                vz = F((vz + dt * az) * damping_factor)
        if touched:
            for c in range(colliders[0].shape[0]):
                if colliders[0][c, DISTANCE] != 0:
                    vx, vy, vz = touched_by((vx, vy, vz), (gx, gy, gz), step, c, colliders)
        if bounded:
            for q in range(planes.shape[0]):
                vx, vy, vz = bounded_by((vx, vy, vz), (gx, gy, gz), spacing, planes, q)
        if pinned and held > PINNED * m:
            vx, vy, vz = hx / held, hy / held, hz / held
        nodes[at, 0], nodes[at, 1], nodes[at, 2], nodes[at, 3] = vx, vy, vz, m


def carried(nodes: Any, neighbour: Any, b: Any, i: Any, j: Any, k: Any, wx: Any, wy: Any, wz: Any) -> Any:
    """Velocity that matter gives to a marker, and the weight of the nodes it comes from, as `p2g_g2p._carried`."""
    heaviest = ZERO
    for e in range(27):
        s, n, _ = node_of(neighbour, b, i + e // 9, j + e // 3 % 3, k + e % 3)
        heaviest = max(heaviest, nodes[s * 64 + n, 3])
    x, y, z, weight = ZERO, ZERO, ZERO, ZERO
    for e in range(27):
        s, n, _ = node_of(neighbour, b, i + e // 9, j + e // 3 % 3, k + e % 3)
        at = s * 64 + n
        if nodes[at, 3] > BARE * heaviest:
            w = chosen(wx, e // 9) * chosen(wy, e // 3 % 3) * chosen(wz, e % 3)
            x, y, z, weight = x + w * nodes[at, 0], y + w * nodes[at, 1], z + w * nodes[at, 2], weight + w
    if weight > ZERO:
        x, y, z = x / weight, y / weight, z / weight
    return x, y, z, weight


def move_particles(thread, stride, scratch, blocks, nodes, properties, pins, grid, time, out):  # type: ignore[no-untyped-def]
    """Grid to particles: move them, deform them, and find their stress, as `p2g_g2p.g2p`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    blocks : tuple of array
        Order of the particles, slot of each in that order (-1: it stays), places of the slots and slots around them.
    nodes : (slots * 64, 4) float32 array
        Velocity (m/s) and mass (kg).
    properties : tuple
        Mass, model, parameters and solid, see `Properties`; whether `total` is kept.
    pins : tuple
        Pin of each particle (-1: none), velocity of each pin (m/s), whether there are any.
    grid, time : tuple
        See this module's head.
    out : tuple of array
        The fields of `Particles` and (SLOTS,) bits of the highest speed; written.
    """
    order, home, active, neighbour = blocks
    mass, model, parameters, solid, apart = properties
    pin, pin_velocity, pinned = pins
    origin, spacing = grid
    clock, times = time
    x, v, affine, elastic, total, tau, memory, fastest = out
    if clock[STOPPED] != 0.0:
        return
    dt = times[int(clock[STEP]), DT]
    scale = 1.0 / spacing
    to_gradient, length = F(4.0 * scale), F(dt)
    top = ZERO
    for at in range(thread, len(mass), stride):
        p, b = np.int64(order[at]), np.int64(home[at])
        if b < 0:
            continue
        i, j, k, fx, fy, fz = cell_of(x, p, origin, scale)
        i, j, k = i - 4 * active[b, 0] + 1, j - 4 * active[b, 1] + 1, k - 4 * active[b, 2] + 1
        wx, wy, wz = weights_of(fx), weights_of(fy), weights_of(fz)
        vx, vy, vz = ZERO, ZERO, ZERO
        marker = mass[p] == ZERO
        if marker:
            vx, vy, vz, weight = carried(nodes, neighbour, b, i, j, k, wx, wy, wz)
            if weight <= ZERO:
                vx, vy, vz = v[p, 0], v[p, 1], v[p, 2]
        else:
            g0, g1, g2, g3, g4, g5, g6, g7, g8 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
            for ii in range(3):
                for jj in range(3):
                    across = chosen(wx, ii) * chosen(wy, jj)
                    for kk in range(3):
                        s, m, _ = node_of(neighbour, b, i + ii, j + jj, k + kk)
                        w = across * chosen(wz, kk)
                        ux, uy, uz = w * nodes[s * 64 + m, 0], w * nodes[s * 64 + m, 1], w * nodes[s * 64 + m, 2]
                        dx, dy, dz = F(ii) - fx, F(jj) - fy, F(kk) - fz
                        vx, vy, vz = vx + ux, vy + uy, vz + uz
                        g0, g1, g2 = g0 + dx * ux, g1 + dy * ux, g2 + dz * ux
                        g3, g4, g5 = g3 + dx * uy, g4 + dy * uy, g5 + dz * uy
                        g6, g7, g8 = g6 + dx * uz, g7 + dy * uz, g8 + dz * uz
            g0, g1, g2 = to_gradient * g0, to_gradient * g1, to_gradient * g2
            g3, g4, g5 = to_gradient * g3, to_gradient * g4, to_gradient * g5
            g6, g7, g8 = to_gradient * g6, to_gradient * g7, to_gradient * g8
            affine[p, 0], affine[p, 1], affine[p, 2] = g0, g1, g2
            affine[p, 3], affine[p, 4], affine[p, 5] = g3, g4, g5
            affine[p, 6], affine[p, 7], affine[p, 8] = g6, g7, g8
            gradient = g0, g1, g2, g3, g4, g5, g6, g7, g8
            update_deformation_gradient(elastic, p, length, gradient)
            if apart and solid[p] != 0:
                update_deformation_gradient(total, p, length, gradient)
            respond(p, model, parameters, elastic, tau, memory, affine, dt)
        speed = vx * vx + vy * vy + vz * vz
        top = top if speed <= top or top != top else speed  # NaN stays
        if pinned and pin[p] >= 0:
            q = np.int64(pin[p])
            vx, vy, vz = pin_velocity[q, 0], pin_velocity[q, 1], pin_velocity[q, 2]
        v[p, 0], v[p, 1], v[p, 2] = vx, vy, vz
        x[p, 0] += dt * vx
        x[p, 1] += dt * vy
        x[p, 2] += dt * vz
    raise_to(fastest, thread % SLOTS, top)


def end_step(thread, stride, scratch, spacing, times, out):  # type: ignore[no-untyped-def]
    """End a step: note the highest speed, and see whether the next one is still as it was planned.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
    spacing : float
        Metres.
    times : array
        A row per step: DT, DRAG_FACTOR, DAMPING_FACTOR, GAIN.
    out : tuple of array
        The clock, and (SLOTS,) bits of the highest speed, which are reset.
    """
    clock, fastest = out
    if clock[STOPPED] != 0.0:
        return
    bits = np.int32(0)
    for i in range(SLOTS):
        bits = max(bits, fastest[i])
        fastest[i] = np.int32(0)
    top = float(math.sqrt(number_of(bits)))
    step = int(clock[STEP])
    clock[TOPS + step] = top
    clock[STEP] = step + 1
    speed = max(top, clock[OUTSIDE])
    clock[DRIFT] += speed * times[step, DT] / spacing
    if not (speed < clock[MOST_SPEED] and clock[DRIFT] <= clock[MOST_DRIFT]):  # as for NaN
        clock[STOPPED] = 1.0


PREPARE = WarpKernel(prepare_particles, (), NATIVES)
GATHER = WarpKernel(gather_nodes, (), NATIVES)
SOLVE = WarpKernel(solve_nodes, (), NATIVES)
MOVE = WarpKernel(move_particles, (), NATIVES)
END_STEP = WarpKernel(end_step, (), NATIVES)
