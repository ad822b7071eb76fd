"""One step of MLS-MPM: particles to grid, the grid's own step, grid to particles.

After Hu et al. 2018 (moving least squares MPM) with APIC (Jiang et al. 2015) and quadratic B-splines. A block's nodes
are gathered in a scratch of 8^3 nodes from cell -1 to 6 of the block, which lets particles drift by a cell.
Positions are double precision: single precision stalls slow motion.
"""

from __future__ import annotations

import numpy as np

from ..jit import njit, prange
from .stress import respond

Array = np.ndarray

_HALF, _ONE, _ONE_HALF = np.float32(0.5), np.float32(1.0), np.float32(1.5)

#: Share of a node's matter that is pinned from which on the node is. On a flat border between pinned and free matter
#: the last node held is then, over all positions of the grid, on average on the border itself.
_PINNED = np.float32(0.2)


@njit(inline="always")
def _weights(f):  # type: ignore[no-untyped-def]
    """Quadratic B-spline weights of three nodes, `f` from the first one in spacings; they sum to 1 as rounded."""
    a, c = _ONE_HALF - f, f - _HALF
    first, last = _HALF * a * a, _HALF * c * c
    return first, (_ONE - first) - last, last


@njit(inline="always")
def _cell(x, p, origin, scale):  # type: ignore[no-untyped-def]
    """The first of the three nodes around a particle along each axis, and how far after it the particle is."""
    gx, gy, gz = (x[p, 0] - origin[0]) * scale, (x[p, 1] - origin[1]) * scale, (x[p, 2] - origin[2]) * scale
    i, j, k = int(gx - 0.5), int(gy - 0.5), int(gz - 0.5)
    return i, j, k, np.float32(gx - i), np.float32(gy - j), np.float32(gz - k)


@njit(inline="always")
def _node(neighbour, b, i, j, k):  # type: ignore[no-untyped-def]
    """Where node (i, j, k) of block b's scratch is: slot and number in the grid, and offset in the scratch."""
    e = (((i + 3) >> 2) * 3 + ((j + 3) >> 2)) * 3 + ((k + 3) >> 2)
    n = (((i + 3) & 3) * 4 + ((j + 3) & 3)) * 4 + ((k + 3) & 3)
    return neighbour[b, e], n, ((i * 8 + j) * 8 + k) * 4


@njit(parallel=True)
def scatter(  # type: ignore[no-untyped-def]
    x, v, affine, tau, mass, volume, origin, spacing, dt, block, parity, start, neighbour, nodes
):  # fmt: skip
    """Particles to grid.

    Parameters
    ----------
    x (n, 3) float64; v (n, 3), affine (n, 9), tau (n, 6), mass (n,), volume (n,) float32
        In the order of the arrangement; volume is that at rest.
    nodes : (a, 64, 4) float32
        Written: momentum and mass of the nodes of active blocks.
    """
    scale = 1.0 / spacing
    h = np.float32(spacing)
    factor = np.float32(4.0 * dt * scale * scale)
    for s in prange(len(nodes)):
        nodes[s] = np.float32(0.0)
    for colour in range(8):
        for b in prange(parity[colour], parity[colour + 1]):
            scratch = np.zeros(2048, np.float32)
            cx, cy, cz = 4 * block[b, 0] - 1, 4 * block[b, 1] - 1, 4 * block[b, 2] - 1
            for p in range(start[b], start[b + 1]):
                m = mass[p]
                if m == np.float32(0.0):
                    continue
                i, j, k, fx, fy, fz = _cell(x, p, origin, scale)
                wx, wy, wz = _weights(fx), _weights(fy), _weights(fz)
                q = -factor * volume[p]
                # Momentum of a node: m v + (m C - factor V tau) d, with d from the particle to the node.
                a00, a01, a02 = (m * affine[p, 0] + q * tau[p, 0]) * h, (m * affine[p, 1] + q * tau[p, 3]) * h, (m * affine[p, 2] + q * tau[p, 4]) * h  # noqa: E501  # fmt: skip
                a10, a11, a12 = (m * affine[p, 3] + q * tau[p, 3]) * h, (m * affine[p, 4] + q * tau[p, 1]) * h, (m * affine[p, 5] + q * tau[p, 5]) * h  # noqa: E501  # fmt: skip
                a20, a21, a22 = (m * affine[p, 6] + q * tau[p, 4]) * h, (m * affine[p, 7] + q * tau[p, 5]) * h, (m * affine[p, 8] + q * tau[p, 2]) * h  # noqa: E501  # fmt: skip
                mx = m * v[p, 0] - a00 * fx - a01 * fy - a02 * fz
                my = m * v[p, 1] - a10 * fx - a11 * fy - a12 * fz
                mz = m * v[p, 2] - a20 * fx - a21 * fy - a22 * fz
                base = (((i - cx) * 8 + (j - cy)) * 8 + (k - cz)) * 4
                for ii in range(3):
                    di = np.float32(ii)
                    for jj in range(3):
                        dj = np.float32(jj)
                        w = wx[ii] * wy[jj]
                        nx = mx + di * a00 + dj * a01
                        ny = my + di * a10 + dj * a11
                        nz = mz + di * a20 + dj * a21
                        at = base + ii * 256 + jj * 32
                        for kk in range(3):
                            dk = np.float32(kk)
                            ww = w * wz[kk]
                            o = at + 4 * kk
                            scratch[o] += ww * (nx + dk * a02)
                            scratch[o + 1] += ww * (ny + dk * a12)
                            scratch[o + 2] += ww * (nz + dk * a22)
                            scratch[o + 3] += ww * m
            for i in range(8):
                for j in range(8):
                    for k in range(8):
                        s, n, o = _node(neighbour, b, i, j, k)
                        nodes[s, n, 0] += scratch[o]
                        nodes[s, n, 1] += scratch[o + 1]
                        nodes[s, n, 2] += scratch[o + 2]
                        nodes[s, n, 3] += scratch[o + 3]


@njit(parallel=True)
def advance_nodes(nodes, least, dt, force, wind, drag, damping):  # type: ignore[no-untyped-def]
    """Momentum to velocity, in place, and what acts on all matter alike.

    Parameters
    ----------
    least : kg, below which a node is empty: momentum over a mass near underflow is noise
    force : (3,) m/s^2, acceleration
    wind : (3,) m/s, towards which `drag` (1/s) pulls
    damping : 1/s
    """
    pull, slow = np.float32(1.0 - np.exp(-dt * drag)), np.float32(np.exp(-dt * damping))
    gx, gy, gz = np.float32(dt * force[0]), np.float32(dt * force[1]), np.float32(dt * force[2])
    wx, wy, wz = np.float32(wind[0]), np.float32(wind[1]), np.float32(wind[2])
    for s in prange(len(nodes)):
        for n in range(64):
            m = nodes[s, n, 3]
            if m < least:
                nodes[s, n] = np.float32(0.0)
            else:
                r = _ONE / m
                x, y, z = nodes[s, n, 0] * r, nodes[s, n, 1] * r, nodes[s, n, 2] * r
                # All forces alike, so that damping does not change where matter comes to rest.
                x, y, z = slow * (x + gx), slow * (y + gy), slow * (z + gz)
                nodes[s, n, 0] = x + pull * (wx - x)
                nodes[s, n, 1] = y + pull * (wy - y)
                nodes[s, n, 2] = z + pull * (wz - z)


@njit(parallel=True)
def gather(  # type: ignore[no-untyped-def]
    x, v, affine, elastic, total, tau, memory, model, parameters, mass, solid, origin, spacing, dt,
    block, start, neighbour, nodes, fastest,
):  # fmt: skip
    """Grid to particles: move them, deform them, and find their stress for the next step.

    Parameters
    ----------
    elastic, total : (n, 9) float32
        Deformation gradients; `total` has no rows where the two are the same for every particle. Matter that is not
        `solid` keeps the total it has.
    fastest : (b,) float32
        Written: the highest speed in each block, m/s; infinite where a particle is not finite.
    """
    scale = 1.0 / spacing
    to_gradient = np.float32(4.0 * scale)
    step = np.float32(dt)
    apart = len(total) > 0
    for b in prange(len(block)):
        scratch = np.empty(2048, np.float32)
        for i in range(8):
            for j in range(8):
                for k in range(8):
                    s, n, o = _node(neighbour, b, i, j, k)
                    scratch[o] = nodes[s, n, 0]
                    scratch[o + 1] = nodes[s, n, 1]
                    scratch[o + 2] = nodes[s, n, 2]
                    scratch[o + 3] = nodes[s, n, 3]
        cx, cy, cz = 4 * block[b, 0] - 1, 4 * block[b, 1] - 1, 4 * block[b, 2] - 1
        top = np.float32(0.0)
        for p in range(start[b], start[b + 1]):
            i, j, k, fx, fy, fz = _cell(x, p, origin, scale)
            wx, wy, wz = _weights(fx), _weights(fy), _weights(fz)
            base = (((i - cx) * 8 + (j - cy)) * 8 + (k - cz)) * 4
            zero = np.float32(0.0)
            vx = vy = vz = zero
            b0 = b1 = b2 = b3 = b4 = b5 = b6 = b7 = b8 = zero
            covered = zero
            for ii in range(3):
                di = np.float32(ii) - fx
                for jj in range(3):
                    dj = np.float32(jj) - fy
                    w = wx[ii] * wy[jj]
                    at = base + ii * 256 + jj * 32
                    sx = sy = sz = zero  # sums along the row, and the same times the offset along it
                    tx = ty = tz = zero
                    for kk in range(3):
                        o = at + 4 * kk
                        ww = w * wz[kk]
                        dk = np.float32(kk) - fz
                        px, py, pz = ww * scratch[o], ww * scratch[o + 1], ww * scratch[o + 2]
                        if scratch[o + 3] > zero:
                            covered += ww
                        sx, sy, sz = sx + px, sy + py, sz + pz
                        tx, ty, tz = tx + dk * px, ty + dk * py, tz + dk * pz
                    vx, vy, vz = vx + sx, vy + sy, vz + sz
                    b0, b1, b2 = b0 + di * sx, b1 + dj * sx, b2 + tx
                    b3, b4, b5 = b3 + di * sy, b4 + dj * sy, b5 + ty
                    b6, b7, b8 = b6 + di * sz, b7 + dj * sz, b8 + tz
            if mass[p] == zero:
                # Riders may be where some nodes have no matter: what there is counts fully; F follows no riders.
                if covered > np.float32(1e-6):
                    vx, vy, vz = vx / covered, vy / covered, vz / covered
                else:
                    vx, vy, vz = v[p, 0], v[p, 1], v[p, 2]
            v[p, 0], v[p, 1], v[p, 2] = vx, vy, vz
            x[p, 0] += dt * vx
            x[p, 1] += dt * vy
            x[p, 2] += dt * vz
            speed = vx * vx + vy * vy + vz * vz
            top = top if speed <= top or top != top else speed  # NaN stays
            if mass[p] == zero:
                continue
            g = to_gradient
            c = affine[p]
            c[0], c[1], c[2] = g * b0, g * b1, g * b2
            c[3], c[4], c[5] = g * b3, g * b4, g * b5
            c[6], c[7], c[8] = g * b6, g * b7, g * b8
            f = elastic[p]
            for column in range(3):
                f0, f1, f2 = f[column], f[3 + column], f[6 + column]
                f[column] = f0 + step * (c[0] * f0 + c[1] * f1 + c[2] * f2)
                f[3 + column] = f1 + step * (c[3] * f0 + c[4] * f1 + c[5] * f2)
                f[6 + column] = f2 + step * (c[6] * f0 + c[7] * f1 + c[8] * f2)
            if apart and solid[p]:
                f = total[p]
                for column in range(3):
                    f0, f1, f2 = f[column], f[3 + column], f[6 + column]
                    f[column] = f0 + step * (c[0] * f0 + c[1] * f1 + c[2] * f2)
                    f[3 + column] = f1 + step * (c[3] * f0 + c[4] * f1 + c[5] * f2)
                    f[6 + column] = f2 + step * (c[6] * f0 + c[7] * f1 + c[8] * f2)
            memory[p] = respond(model[p], parameters[p], elastic[p], tau[p], memory[p], c, dt)
        fastest[b] = np.sqrt(top)


@njit
def hold_pins(x, pinned, pin_velocity, mass, origin, spacing, slot, nodes, held):  # type: ignore[no-untyped-def]
    """Nodes with pinned matter move as the pins do.

    Parameters
    ----------
    pinned : (k,) int64, particles held
    pin_velocity : (k, 3) float32, m/s
    held : (a, 64, 4) float32, zero before and after: pinned momentum and mass
    """
    scale = 1.0 / spacing
    for turn in range(2):
        for q in range(len(pinned)):
            p = pinned[q]
            i, j, k, fx, fy, fz = _cell(x, p, origin, scale)
            wx, wy, wz = _weights(fx), _weights(fy), _weights(fz)
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
                            if m > _PINNED * nodes[s, n, 3]:
                                for c in range(3):
                                    nodes[s, n, c] = held[s, n, c] / m
                            held[s, n] = np.float32(0.0)
