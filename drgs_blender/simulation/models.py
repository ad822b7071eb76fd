"""The constitutive models: functions of principal strains, of one particle or of sixteen at once (`compute.simd`).

Return mappings: von Mises with viscosity after Simo and Hughes (Computational Inelasticity, ch. 3), sand after Klar et
al. 2016, snow after Stomakhin et al. 2013. Stresses are Kirchhoff's, tau = P F^T. Deformation gradients are kept less
1: small strains have all digits of single precision then.
"""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import inlined, overload
from ..compute.simd import float32x16, select
from ..core.sim_materials import MOST_HARDENING

F = np.float32
_FLOOR = F(0.02)  # of the volume ratio in logarithms and powers
_NORM = F(math.sqrt(2 / 3))  # of a deviator per uniaxial stress, and of equivalent plastic strain per norm of a strain
_ZERO, _TENTH, _HALF, _TWO_THIRDS, _ONE, _TWO, _THREE, _FOUR = map(F, (0.0, 0.1, 0.5, 2 / 3, 1.0, 2.0, 3.0, 4.0))
_T3, _T5, _T7, _T9, _T11, _T13 = (F(1 / k) for k in (3, 5, 7, 9, 11, 13))
_SIXTEENTH, _SIXTH, _T24, _T120 = (F(1 / k) for k in (16, 6, 24, 120))
_FIFTH, _FULL = F(0.2), F(1.1)
_SOFTEST, _HARDEST = F(math.log(0.05)), F(math.log(MOST_HARDENING))


@inlined
def _largest(a, b):  # type: ignore[no-untyped-def]
    """The larger one of two numbers, or lane by lane."""
    return select(a > b, a, b)


@inlined
def _clamp(x, low, high):  # type: ignore[no-untyped-def]
    """x, or the bound that it is beyond."""
    x = select(x < low, low, x)
    return select(x > high, high, x)


@inlined
def deformed(h, step, gradient):  # type: ignore[no-untyped-def]
    """Update of the deformation gradient in a step: F becomes (1 + step grad v) F.

    Parameters
    ----------
    h : tuple of float
        Nine, F - 1, row-major; so all numbers here of one particle or of sixteen.
    step : float32
        Seconds.
    gradient : tuple of float
        Nine, of the velocity, 1/s, row-major.

    Returns
    -------
    tuple of float
        Nine, F - 1.
    """
    g0, g1, g2, g3, g4, g5, g6, g7, g8 = gradient
    h0, f1, f2, f3, h4, f5, f6, f7, h8 = h
    f0, f4, f8 = _ONE + h0, _ONE + h4, _ONE + h8
    return (
        h0 + step * (g0 * f0 + g1 * f3 + g2 * f6),
        f1 + step * (g0 * f1 + g1 * f4 + g2 * f7),
        f2 + step * (g0 * f2 + g1 * f5 + g2 * f8),
        f3 + step * (g3 * f0 + g4 * f3 + g5 * f6),
        h4 + step * (g3 * f1 + g4 * f4 + g5 * f7),
        f5 + step * (g3 * f2 + g4 * f5 + g5 * f8),
        f6 + step * (g6 * f0 + g7 * f3 + g8 * f6),
        f7 + step * (g6 * f1 + g7 * f4 + g8 * f7),
        h8 + step * (g6 * f2 + g7 * f5 + g8 * f8),
    )


@inlined
def volume_gain(h):  # type: ignore[no-untyped-def]
    """J - 1 of a deformation gradient less 1, (9,), with all digits where that is small.

    Parameters
    ----------
    h : tuple of float

    Returns
    -------
    float
    """
    a, b, c, d, e, g, i, j, k = h
    minor = e * k - g * j
    return a + e + k + (a * e - b * d) + (a * k - c * i) + minor + a * minor - b * (d * k - g * i) + c * (d * j - e * i)


@inlined
def green_strain(h):  # type: ignore[no-untyped-def]
    """F F^T - 1 of F - 1, (9,): xx, yy, zz, xy, xz, yz, with all digits where they are small.

    Parameters
    ----------
    h : tuple of float

    Returns
    -------
    tuple of float
    """
    a, b, c, d, e, g, i, j, k = h
    return (
        a + a + (a * a + b * b + c * c), e + e + (d * d + e * e + g * g), k + k + (i * i + j * j + k * k),
        b + d + (a * d + b * e + c * g), c + i + (a * i + b * j + c * k), g + j + (d * i + e * j + g * k),
    )  # fmt: skip


def log_more(gain):  # type: ignore[no-untyped-def]
    """log(1 + gain), of no less than `_FLOOR`; of sixteen particles `gain` must be within -0.45 and 0.8.

    Parameters
    ----------
    gain : float

    Returns
    -------
    float
    """
    return np.log(max(_ONE + gain, _FLOOR))


@inlined
def _log_series(gain):  # type: ignore[no-untyped-def]
    z = gain / (_TWO + gain)
    q = z * z
    series = _ONE + q * (_T3 + q * (_T5 + q * (_T7 + q * (_T9 + q * (_T11 + q * _T13)))))
    return (z + z) * series


@overload(log_more)
def _log_more(gain):  # type: ignore[no-untyped-def]
    return (lambda gain: _log_series(gain)) if gain is float32x16 else log_more


def exp_less(x):  # type: ignore[no-untyped-def]
    """exp(x) - 1; of sixteen particles, of x within -4 and 4.

    Parameters
    ----------
    x : float

    Returns
    -------
    float
    """
    return math.exp(x) - 1.0


@inlined
def _exp_series(x):  # type: ignore[no-untyped-def]
    x = _SIXTEENTH * x
    y = x * (_ONE + x * (_HALF + x * (_SIXTH + x * (_T24 + x * _T120))))
    # exp(2 x) - 1 of exp(x) - 1, four times: all digits of what is small stay.
    y = y * (_TWO + y)
    y = y * (_TWO + y)
    y = y * (_TWO + y)
    return y * (_TWO + y)


@overload(exp_less)
def _exp_less(x):  # type: ignore[no-untyped-def]
    return (lambda x: _exp_series(x)) if x is float32x16 else exp_less


@inlined
def neo_hookean(h, mu, first):  # type: ignore[no-untyped-def]
    """Neo-Hookean elasticity: Kirchhoff stress tau = mu (F F^T - 1) + lambda log(J) 1.

    Parameters
    ----------
    h : tuple of float
        Nine, F - 1, row-major; so all numbers here of one particle or of sixteen.
    mu, first : float
        Lame's mu and lambda, Pa.

    Returns
    -------
    xx, yy, zz, xy, xz, yz : float
        Pa.
    """
    xx, yy, zz, xy, xz, yz = green_strain(h)
    pressure = first * log_more(volume_gain(h))
    return mu * xx + pressure, mu * yy + pressure, mu * zz + pressure, mu * xy, mu * xz, mu * yz


@inlined
def corotated_stress(x, y, z, mu, first):  # type: ignore[no-untyped-def]
    """Principal stresses of fixed corotated matter, of stretches less 1.

    Parameters
    ----------
    x, y, z : float
        Principal stretches less 1.
    mu, first : float
        Lame's mu and lambda, Pa.

    Returns
    -------
    tuple of float
        Pa.
    """
    gain = x + y + z + (x * y + y * z + x * z) + x * y * z
    push = first * gain * (_ONE + gain)
    twice = _TWO * mu
    return twice * x * (_ONE + x) + push, twice * y * (_ONE + y) + push, twice * z * (_ONE + z) + push


@inlined
def hencky_stress(a, b, c, mu, first):  # type: ignore[no-untyped-def]
    """Principal stresses of logarithmic strains.

    Parameters
    ----------
    a, b, c : float
        Principal logarithmic strains.
    mu, first : float
        Lame's mu and lambda, Pa.

    Returns
    -------
    tuple of float
        Pa.
    """
    push, twice = first * (a + b + c), _TWO * mu
    return twice * a + push, twice * b + push, twice * c + push


@inlined
def yield_excess(length, numbers, memory):  # type: ignore[no-untyped-def]
    """By what the deviatoric stress of a deviatoric logarithmic strain of a length is beyond yield, Pa.

    Parameters
    ----------
    length : float
        Of the strain.
    numbers : tuple of float
        See `plastic_flow`.
    memory : float
        Equivalent plastic strain.

    Returns
    -------
    float
    """
    mu, limit, hardening, _ = numbers
    return _TWO * mu * length - _NORM * _largest(limit + hardening * memory, _TENTH * limit)


@inlined
def plastic_flow(a, b, c, stretch, numbers, memory, dt):  # type: ignore[no-untyped-def]
    """Von Mises flow with hardening and viscosity.

    Parameters
    ----------
    a, b, c : float
        Principal logarithmic strains.
    stretch : float
        Mean of the squared stretches.
    numbers : tuple of float
        mu, yield stress, hardening (Pa), viscosity (Pa s).
    memory : float
        Equivalent plastic strain.
    dt : float
        Seconds.

    Returns
    -------
    x, y, z : float
        What is added to the strains: 0 where nothing flows.
    memory : float
    """
    mu, _, hardening, viscosity = numbers
    mean = (a + b + c) / _THREE
    x, y, z = a - mean, b - mean, c - mean
    length = math.sqrt(x * x + y * y + z * z)
    excess = yield_excess(length, numbers, memory)
    slower = _ONE + viscosity / (_TWO * mu * stretch * dt)
    step = excess / (_TWO * mu * slower + _TWO_THIRDS * _largest(hardening, _ZERO))
    step = select(excess > _ZERO, step, _ZERO)
    part = _ZERO - step / select(excess > _ZERO, length, _ONE)
    return part * x, part * y, part * z, memory + _NORM * step


@inlined
def sand_flow(a, b, c, numbers, memory):  # type: ignore[no-untyped-def]
    """Drucker-Prager flow, as `plastic_flow`; `memory` is volume lost or gained, taken up before new stress arises.

    Parameters
    ----------
    a, b, c : float
        Principal logarithmic strains.
    numbers : tuple of float
        mu, lambda, slope of the cone, and volumetric strain at which it comes apart.
    memory : float

    Returns
    -------
    x, y, z, memory : float
        As of `plastic_flow`.
    """
    mu, first, slope, cohesion = numbers
    given = memory / _THREE
    volume = a + b + c + memory
    trace, mean = volume - cohesion, (a + b + c) / _THREE
    x, y, z = a - mean, b - mean, c - mean
    length = math.sqrt(x * x + y * y + z * z)
    step = length + (_THREE * first + _TWO * mu) / (_TWO * mu) * trace * slope
    part = select(step > _ZERO, step, _ZERO) / select(step > _ZERO, length, _ONE)
    apart = trace < _ZERO
    x, y, z = given - part * x, given - part * y, given - part * z
    memory = select(apart, _ZERO, volume)
    return select(apart, x, _ZERO - a), select(apart, y, _ZERO - b), select(apart, z, _ZERO - c), memory


@inlined
def snow_flow(x, y, z, low, high, memory):  # type: ignore[no-untyped-def]
    """Strain beyond critical ones becomes plastic: principal stretches less 1 that stay, and the plastic volume.

    Parameters
    ----------
    x, y, z : float
        Principal stretches less 1.
    low, high : float
        Critical ones less 1.
    memory : float
        Plastic volume.

    Returns
    -------
    tuple of float
    """
    a, b, c = _clamp(x, low, high), _clamp(y, low, high), _clamp(z, low, high)
    before, after = (_ONE + x) * (_ONE + y) * (_ONE + z), (_ONE + a) * (_ONE + b) * (_ONE + c)
    return a, b, c, _clamp(memory * before / after, _TENTH, _FOUR)


@inlined
def snow_stiffness(plastic, exponent):  # type: ignore[no-untyped-def]
    """By what its plastic volume stiffens snow, or softens it.

    Parameters
    ----------
    plastic : float
        Plastic volume.
    exponent : float

    Returns
    -------
    float
    """
    return _ONE + exp_less(_clamp(exponent * (_ONE - plastic), _SOFTEST, _HARDEST))


@inlined
def fluid_stress(gradient, memory, numbers, dt):  # type: ignore[no-untyped-def]
    """Stress (six) and volume ratio of a fluid that is sheared and squeezed, of its viscosity, bulk modulus and power.

    Equation of state p = K / g (J^-g - 1); J alone is remembered.

    Parameters
    ----------
    gradient : tuple of float
        Nine, of the velocity, 1/s, row-major.
    memory : float
        Volume ratio.
    numbers : tuple of float
        Viscosity (Pa s), bulk modulus (Pa), power.
    dt : float
        Seconds.

    Returns
    -------
    stress : tuple of float
        Pa.
    memory : float
    """
    g0, g1, g2, g3, g4, g5, g6, g7, g8 = gradient
    viscosity, bulk, power = numbers
    trace = g0 + g4 + g8
    j = _clamp(memory * (_ONE + dt * trace), _FIFTH, _FULL)
    pressure = _ZERO - bulk / power * exp_less(_ZERO - power * log_more(j - _ONE)) * j
    shear, third = viscosity * j, trace / _THREE
    twice = _TWO * shear
    return (
        pressure + twice * (g0 - third), pressure + twice * (g4 - third), pressure + twice * (g8 - third),
        shear * (g1 + g3), shear * (g2 + g6), shear * (g5 + g7),
    ), j  # fmt: skip
