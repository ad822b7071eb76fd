"""What deformation does to matter: plastic flow and Kirchhoff stress of one particle, in compiled code.

Return mappings: von Mises with viscosity after Simo and Hughes (Computational Inelasticity, ch. 3), sand after Klar et
al. 2016, snow after Stomakhin et al. 2013. Stresses are Kirchhoff's, tau = P F^T, kept as xx, yy, zz, xy, xz, yz.
"""

from __future__ import annotations

import math

import numpy as np

from ..jit import njit
from ..matter import COROTATED, ELASTIC, FIRST, FLUID, LAMBDA, MOST_HARDENING, MU, PLASTIC, SAND, SECOND, THIRD
from .decompose import svd3

Array = np.ndarray

_FLOOR = np.float32(0.02)  # of the volume ratio in logarithms and powers


@njit(inline="always")
def _put(tau, u, a, b, c):  # type: ignore[no-untyped-def]
    """tau = U diag(a, b, c) U^T."""
    tau[0] = a * u[0] * u[0] + b * u[1] * u[1] + c * u[2] * u[2]
    tau[1] = a * u[3] * u[3] + b * u[4] * u[4] + c * u[5] * u[5]
    tau[2] = a * u[6] * u[6] + b * u[7] * u[7] + c * u[8] * u[8]
    tau[3] = a * u[0] * u[3] + b * u[1] * u[4] + c * u[2] * u[5]
    tau[4] = a * u[0] * u[6] + b * u[1] * u[7] + c * u[2] * u[8]
    tau[5] = a * u[3] * u[6] + b * u[4] * u[7] + c * u[5] * u[8]


@njit(inline="always")
def _compose(f, u, a, b, c, v):  # type: ignore[no-untyped-def]
    """F = U diag(a, b, c) V^T."""
    for r in range(3):
        for k in range(3):
            f[3 * r + k] = a * u[3 * r] * v[3 * k] + b * u[3 * r + 1] * v[3 * k + 1] + c * u[3 * r + 2] * v[3 * k + 2]


@njit(inline="always")
def neo_hookean(f, mu, first, tau):  # type: ignore[no-untyped-def]
    """tau = mu (F F^T - 1) + lambda log(J) 1."""
    j = f[0] * (f[4] * f[8] - f[5] * f[7]) - f[1] * (f[3] * f[8] - f[5] * f[6]) + f[2] * (f[3] * f[7] - f[4] * f[6])
    pressure = first * np.log(max(j, _FLOOR)) - mu
    tau[0] = mu * (f[0] * f[0] + f[1] * f[1] + f[2] * f[2]) + pressure
    tau[1] = mu * (f[3] * f[3] + f[4] * f[4] + f[5] * f[5]) + pressure
    tau[2] = mu * (f[6] * f[6] + f[7] * f[7] + f[8] * f[8]) + pressure
    tau[3] = mu * (f[0] * f[3] + f[1] * f[4] + f[2] * f[5])
    tau[4] = mu * (f[0] * f[6] + f[1] * f[7] + f[2] * f[8])
    tau[5] = mu * (f[3] * f[6] + f[4] * f[7] + f[5] * f[8])


@njit
def respond(model, q, f, tau, memory, affine, dt):  # type: ignore[no-untyped-def]
    """Let one particle flow and find its stress.

    Parameters
    ----------
    model, q : its model and row of parameters
    f : (9,) float32, elastic deformation gradient, changed in place where matter flows
    tau : (6,) float32, written
    memory : what the model remembers: plastic strain (plastic), volume correction (sand), plastic volume (snow),
        volume ratio (fluid)
    affine : (9,) float32 velocity gradient, 1/s
    dt : seconds

    Returns
    -------
    float
        The new memory.
    """
    mu, first = float(q[MU]), float(q[LAMBDA])
    if model == ELASTIC:
        neo_hookean(f, q[MU], q[LAMBDA], tau)
        return memory
    if model == FLUID:
        # Equation of state p = K / g (J^-g - 1); J alone is remembered.
        trace = float(affine[0] + affine[4] + affine[8])
        j = min(max(float(memory) * (1.0 + dt * trace), 0.2), 1.1)
        gamma = float(q[FIRST])
        pressure = -first / gamma * (j ** (-gamma) - 1.0) * j
        for k in range(3):
            tau[k] = pressure + 2.0 * mu * j * (affine[4 * k] - trace / 3.0)
        tau[3] = mu * j * (affine[1] + affine[3])
        tau[4] = mu * j * (affine[2] + affine[6])
        tau[5] = mu * j * (affine[5] + affine[7])
        return np.float32(j)

    u, s, v = svd3(f)
    if model == COROTATED:
        j = s[0] * s[1] * s[2]
        p = first * (j - 1.0) * j
        _put(tau, u, 2 * mu * (s[0] - 1) * s[0] + p, 2 * mu * (s[1] - 1) * s[1] + p, 2 * mu * (s[2] - 1) * s[2] + p)
        return memory

    if model in (PLASTIC, SAND):
        a, b, c = math.log(max(s[0], 1e-4)), math.log(max(s[1], 1e-4)), math.log(max(s[2], 1e-4))
        flows = False
        if model == PLASTIC:
            mean = (a + b + c) / 3.0
            x, y, z = a - mean, b - mean, c - mean
            length = math.sqrt(x * x + y * y + z * z)
            strength = max(float(q[FIRST]) + float(q[SECOND]) * memory, 0.1 * float(q[FIRST]))
            excess = 2.0 * mu * length - 0.816496580927726 * strength
            if excess > 0.0:
                flows = True
                stiff = 2.0 * mu * (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]) / 3.0
                step = excess / (2.0 * mu) / (1.0 + float(q[THIRD]) / (stiff * dt))
                keep = 1.0 - step / length
                a, b, c = mean + keep * x, mean + keep * y, mean + keep * z
                memory = np.float32(memory + step)
        else:
            # Volume lost or gained in earlier flow is taken up before new stress arises.
            given = float(memory) / 3.0
            a, b, c = a + given, b + given, c + given
            trace = a + b + c - float(q[SECOND])
            mean = (a + b + c) / 3.0
            x, y, z = a - mean, b - mean, c - mean
            length = math.sqrt(x * x + y * y + z * z)
            flows = True
            if trace >= 0.0:
                memory = np.float32(a + b + c)
                a = b = c = 0.0
            else:
                memory = np.float32(0.0)
                step = length + (3.0 * first + 2.0 * mu) / (2.0 * mu) * trace * float(q[FIRST])
                if step > 0.0:
                    keep = 1.0 - step / length
                    a, b, c = mean + keep * x, mean + keep * y, mean + keep * z
        if flows:
            _compose(f, u, math.exp(a), math.exp(b), math.exp(c), v)
        p = first * (a + b + c)
        _put(tau, u, 2 * mu * a + p, 2 * mu * b + p, 2 * mu * c + p)
        return memory

    # Snow: strain beyond the critical compression and stretch becomes plastic, and hardens or softens.
    low, high = 1.0 - float(q[FIRST]), 1.0 + float(q[SECOND])
    a, b, c = min(max(s[0], low), high), min(max(s[1], low), high), min(max(s[2], low), high)
    j = a * b * c
    plastic = min(max(float(memory) * s[0] * s[1] * s[2] / j, 0.1), 4.0)
    _compose(f, u, a, b, c, v)
    harder = min(max(math.exp(float(q[THIRD]) * (1.0 - plastic)), 0.05), MOST_HARDENING)
    mu, first = mu * harder, first * harder
    p = first * (j - 1.0) * j
    _put(tau, u, 2 * mu * (a - 1) * a + p, 2 * mu * (b - 1) * b + p, 2 * mu * (c - 1) * c + p)
    return np.float32(plastic)
