"""The constitutive models: plastic flow and Kirchhoff stress of one particle, in compiled code.

Return mappings: von Mises with viscosity after Simo and Hughes (Computational Inelasticity, ch. 3), sand after Klar et
al. 2016, snow after Stomakhin et al. 2013. Stresses are Kirchhoff's, tau = P F^T, kept as xx, yy, zz, xy, xz, yz.
Deformation gradients are kept less 1: small strains have all digits of single precision then.
"""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import inlined, njit
from ..core.sim_materials import (
    COROTATED,
    ELASTIC,
    FIRST,
    FLUID,
    LAMBDA,
    MOST_HARDENING,
    MU,
    PLASTIC,
    SAND,
    SECOND,
    THIRD,
)
from .decompose import svd3

Array = np.ndarray

_FLOOR = np.float32(0.02)  # of the volume ratio in logarithms and powers
_NORM = math.sqrt(2 / 3)  # of a deviator per uniaxial stress, and of equivalent plastic strain per norm of a strain


@inlined
def _put(tau, p, u, a, b, c):  # type: ignore[no-untyped-def]
    """tau = U diag(a, b, c) U^T."""
    tau[p, 0] = a * u[0] * u[0] + b * u[1] * u[1] + c * u[2] * u[2]
    tau[p, 1] = a * u[3] * u[3] + b * u[4] * u[4] + c * u[5] * u[5]
    tau[p, 2] = a * u[6] * u[6] + b * u[7] * u[7] + c * u[8] * u[8]
    tau[p, 3] = a * u[0] * u[3] + b * u[1] * u[4] + c * u[2] * u[5]
    tau[p, 4] = a * u[0] * u[6] + b * u[1] * u[7] + c * u[2] * u[8]
    tau[p, 5] = a * u[3] * u[6] + b * u[4] * u[7] + c * u[5] * u[8]


@inlined
def _compose(f, p, u, a, b, c, v):  # type: ignore[no-untyped-def]
    """F = U diag(a, b, c) V^T, where `f` holds F - 1."""
    f[p, 0] = a * u[0] * v[0] + b * u[1] * v[1] + c * u[2] * v[2] - 1.0
    f[p, 1] = a * u[0] * v[3] + b * u[1] * v[4] + c * u[2] * v[5]
    f[p, 2] = a * u[0] * v[6] + b * u[1] * v[7] + c * u[2] * v[8]
    f[p, 3] = a * u[3] * v[0] + b * u[4] * v[1] + c * u[5] * v[2]
    f[p, 4] = a * u[3] * v[3] + b * u[4] * v[4] + c * u[5] * v[5] - 1.0
    f[p, 5] = a * u[3] * v[6] + b * u[4] * v[7] + c * u[5] * v[8]
    f[p, 6] = a * u[6] * v[0] + b * u[7] * v[1] + c * u[8] * v[2]
    f[p, 7] = a * u[6] * v[3] + b * u[7] * v[4] + c * u[8] * v[5]
    f[p, 8] = a * u[6] * v[6] + b * u[7] * v[7] + c * u[8] * v[8] - 1.0


@inlined
def neo_hookean(f, p, mu, first, tau):  # type: ignore[no-untyped-def]
    """Neo-Hookean elasticity: Kirchhoff stress tau = mu (F F^T - 1) + lambda log(J) 1 of one particle.

    Parameters
    ----------
    f : (n, 9) float32 array
        Elastic deformation gradient less 1, row-major.
    p : int64
        Particle.
    mu, first : float32
        Lame's mu and lambda, Pa.
    tau : (n, 6) float32 array
        Row `p` is written, Pa: xx, yy, zz, xy, xz, yz.
    """
    one = np.float32(1.0)
    a, b, c, d, e, g, h, i, k = one + f[p, 0], f[p, 1], f[p, 2], f[p, 3], one + f[p, 4], f[p, 5], f[p, 6], f[p, 7], one + f[p, 8]  # noqa: E501  # fmt: skip
    j = a * (e * k - g * i) - b * (d * k - g * h) + c * (d * i - e * h)
    pressure = first * np.log(max(j, _FLOOR)) - mu
    tau[p, 0] = mu * (a * a + b * b + c * c) + pressure
    tau[p, 1] = mu * (d * d + e * e + g * g) + pressure
    tau[p, 2] = mu * (h * h + i * i + k * k) + pressure
    tau[p, 3] = mu * (a * d + b * e + c * g)
    tau[p, 4] = mu * (a * h + b * i + c * k)
    tau[p, 5] = mu * (d * h + e * i + g * k)


@njit
def respond(p, model, parameters, f, tau, memories, affine, dt):  # type: ignore[no-untyped-def]
    """Let particle p flow and find its stress. Arrays are whole: rows of them would be counted, by both threads.

    Parameters
    ----------
    p : int
    model : (n,) uint8 array
    parameters : (n, k) float32 array
    f : (n, 9) float32 array
        Elastic deformation gradient less 1, changed in place where matter flows.
    tau : (n, 6) float32 array
        Written.
    memories : (n,) float32 array
        Changed: what the model remembers: equivalent plastic strain (plastic), volume correction (sand), plastic volume
        (snow), volume ratio (fluid).
    affine : (n, 9) float32 array
        Velocity gradient, 1/s.
    dt : float
        Seconds.
    """
    kind = model[p]
    if kind == ELASTIC:
        neo_hookean(f, p, parameters[p, MU], parameters[p, LAMBDA], tau)
        return
    mu, first, memory = float(parameters[p, MU]), float(parameters[p, LAMBDA]), memories[p]
    if kind == FLUID:
        # Equation of state p = K / g (J^-g - 1); J alone is remembered.
        trace = float(affine[p, 0] + affine[p, 4] + affine[p, 8])
        j = min(max(float(memory) * (1.0 + dt * trace), 0.2), 1.1)
        gamma = float(parameters[p, FIRST])
        pressure = -first / gamma * (j ** (-gamma) - 1.0) * j
        for k in range(3):
            tau[p, k] = pressure + 2.0 * mu * j * (affine[p, 4 * k] - trace / 3.0)
        tau[p, 3] = mu * j * (affine[p, 1] + affine[p, 3])
        tau[p, 4] = mu * j * (affine[p, 2] + affine[p, 6])
        tau[p, 5] = mu * j * (affine[p, 5] + affine[p, 7])
        memories[p] = np.float32(j)
        return

    u, s, v = svd3(f, p)
    if kind == COROTATED:
        j = s[0] * s[1] * s[2]
        push = first * (j - 1.0) * j
        _put(
            tau,
            p,
            u,
            2 * mu * (s[0] - 1) * s[0] + push,
            2 * mu * (s[1] - 1) * s[1] + push,
            2 * mu * (s[2] - 1) * s[2] + push,
        )
        memories[p] = memory
        return

    if kind in (PLASTIC, SAND):
        a, b, c = math.log(max(s[0], 1e-4)), math.log(max(s[1], 1e-4)), math.log(max(s[2], 1e-4))
        flows = False
        if kind == PLASTIC:
            mean = (a + b + c) / 3.0
            x, y, z = a - mean, b - mean, c - mean
            length = math.sqrt(x * x + y * y + z * z)
            strength = max(
                float(parameters[p, FIRST]) + float(parameters[p, SECOND]) * memory, 0.1 * float(parameters[p, FIRST])
            )
            excess = 2.0 * mu * length - _NORM * strength
            if excess > 0.0:
                flows = True
                stiff = 2.0 * mu * (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]) / 3.0
                slower = 1.0 + float(parameters[p, THIRD]) / (stiff * dt)
                step = excess / (2.0 * mu * slower + 2.0 / 3.0 * max(float(parameters[p, SECOND]), 0.0))
                keep = 1.0 - step / length
                a, b, c = mean + keep * x, mean + keep * y, mean + keep * z
                memory = np.float32(memory + _NORM * step)
        else:
            # Volume lost or gained in earlier flow is taken up before new stress arises.
            given = float(memory) / 3.0
            a, b, c = a + given, b + given, c + given
            trace = a + b + c - float(parameters[p, SECOND])
            mean = (a + b + c) / 3.0
            x, y, z = a - mean, b - mean, c - mean
            length = math.sqrt(x * x + y * y + z * z)
            flows = True
            if trace >= 0.0:
                memory = np.float32(a + b + c)
                a = b = c = 0.0
            else:
                memory = np.float32(0.0)
                step = length + (3.0 * first + 2.0 * mu) / (2.0 * mu) * trace * float(parameters[p, FIRST])
                if step > 0.0:
                    keep = 1.0 - step / length
                    a, b, c = mean + keep * x, mean + keep * y, mean + keep * z
        if flows:
            _compose(f, p, u, math.exp(a), math.exp(b), math.exp(c), v)
        push = first * (a + b + c)
        _put(tau, p, u, 2 * mu * a + push, 2 * mu * b + push, 2 * mu * c + push)
        memories[p] = memory
        return

    # Snow: strain beyond the critical compression and stretch becomes plastic, and hardens or softens.
    low, high = 1.0 - float(parameters[p, FIRST]), 1.0 + float(parameters[p, SECOND])
    a, b, c = min(max(s[0], low), high), min(max(s[1], low), high), min(max(s[2], low), high)
    j = a * b * c
    plastic = min(max(float(memory) * s[0] * s[1] * s[2] / j, 0.1), 4.0)
    _compose(f, p, u, a, b, c, v)
    harder = min(max(math.exp(float(parameters[p, THIRD]) * (1.0 - plastic)), 0.05), MOST_HARDENING)
    mu, first = mu * harder, first * harder
    push = first * (j - 1.0) * j
    _put(tau, p, u, 2 * mu * (a - 1) * a + push, 2 * mu * (b - 1) * b + push, 2 * mu * (c - 1) * c + push)
    memories[p] = np.float32(plastic)
