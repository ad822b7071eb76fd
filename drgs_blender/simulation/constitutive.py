"""Plastic flow and Kirchhoff stress of one particle, whatever its deformation, in compiled code; also for devices.

Principal strains are found by the singular value decomposition, in double precision; the models are in `models`.
Stresses are kept as xx, yy, zz, xy, xz, yz.
"""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import inlined, njit
from ..core.sim_materials import COROTATED, ELASTIC, FIRST, FLUID, LAMBDA, MU, PLASTIC, SECOND, SNOW, THIRD
from .decompose import svd3
from .models import (
    corotated_stress,
    fluid_stress,
    hencky_stress,
    neo_hookean,
    plastic_flow,
    sand_flow,
    snow_flow,
    snow_stiffness,
)


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
        h = f[p, 0], f[p, 1], f[p, 2], f[p, 3], f[p, 4], f[p, 5], f[p, 6], f[p, 7], f[p, 8]
        tau[p, 0], tau[p, 1], tau[p, 2], tau[p, 3], tau[p, 4], tau[p, 5] = neo_hookean(
            h, parameters[p, MU], parameters[p, LAMBDA]
        )
        return
    mu, first, memory = float(parameters[p, MU]), float(parameters[p, LAMBDA]), float(memories[p])
    if kind == FLUID:
        g0, g1, g2, g3 = float(affine[p, 0]), float(affine[p, 1]), float(affine[p, 2]), float(affine[p, 3])
        g4, g5, g6, g7, g8 = affine[p, 4], affine[p, 5], affine[p, 6], affine[p, 7], affine[p, 8]
        stress, memory = fluid_stress(
            (g0, g1, g2, g3, g4, g5, g6, g7, g8), memory, (mu, first, float(parameters[p, FIRST])), dt
        )
        tau[p, 0], tau[p, 1], tau[p, 2], tau[p, 3], tau[p, 4], tau[p, 5] = stress
        memories[p] = np.float32(memory)
        return

    u, s, v = svd3(f, p)
    first_number, second, third = float(parameters[p, FIRST]), float(parameters[p, SECOND]), float(parameters[p, THIRD])
    if kind == COROTATED:
        x, y, z = corotated_stress(s[0] - 1.0, s[1] - 1.0, s[2] - 1.0, mu, first)
        _put(tau, p, u, x, y, z)
        return

    if kind == SNOW:
        a, b, c, memory = snow_flow(s[0] - 1.0, s[1] - 1.0, s[2] - 1.0, -first_number, second, memory)
        _compose(f, p, u, 1.0 + a, 1.0 + b, 1.0 + c, v)
        harder = snow_stiffness(memory, third)
        x, y, z = corotated_stress(a, b, c, harder * mu, harder * first)
    else:
        a, b, c = math.log(max(s[0], 1e-4)), math.log(max(s[1], 1e-4)), math.log(max(s[2], 1e-4))
        if kind == PLASTIC:
            stretch = (s[0] * s[0] + s[1] * s[1] + s[2] * s[2]) / 3.0
            x, y, z, memory = plastic_flow(a, b, c, stretch, (mu, first_number, second, third), memory, dt)
        else:
            x, y, z, memory = sand_flow(a, b, c, (mu, first, first_number, second), memory)
        a, b, c = a + x, b + y, c + z
        if x != 0.0 or y != 0.0 or z != 0.0:
            _compose(f, p, u, math.exp(a), math.exp(b), math.exp(c), v)
        x, y, z = hencky_stress(a, b, c, mu, first)
    _put(tau, p, u, x, y, z)
    memories[p] = np.float32(memory)
