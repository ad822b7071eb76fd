"""What a particle gives to nodes, and how it deforms: translated functions of rows of arrays, see `steps`."""

from __future__ import annotations

from ..models import deformed


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


def update_deformation_gradient(f, p, step, gradient):  # type: ignore[no-untyped-def]
    """`deformed` of row `p` of an (n, 9) array, in place.

    Parameters
    ----------
    f : (n, 9) float32 array
    p : int64
        Particle.
    step : float32
        Seconds.
    gradient : tuple of float
    """
    h = f[p, 0], f[p, 1], f[p, 2], f[p, 3], f[p, 4], f[p, 5], f[p, 6], f[p, 7], f[p, 8]
    f[p, 0], f[p, 1], f[p, 2], f[p, 3], f[p, 4], f[p, 5], f[p, 6], f[p, 7], f[p, 8] = deformed(h, step, gradient)
