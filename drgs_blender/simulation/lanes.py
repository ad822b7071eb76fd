"""Sixteen particles at once: how they deform, flow, and what stress they have.

They lie in a tile: rows of sixteen numbers, one for each particle. The models are those of `models`, in single
precision; principal strains are eigenvalues of F F^T - 1, in which small ones have all their digits. A row says which
particles are deformed too much for that: `constitutive.respond` is for them.
"""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.simd import LANES, load, select, some, spread, store, transpose
from ..core.sim_materials import COLUMNS, COROTATED, FIRST, FLUID, LAMBDA, MU, PLASTIC, SECOND, SNOW, THIRD
from ..core.sim_materials import ELASTIC as NEO_HOOKEAN
from .constitutive import respond
from .decompose import eigen16
from .models import (
    corotated_stress,
    deformed,
    exp_less,
    fluid_stress,
    green_strain,
    hencky_stress,
    log_more,
    neo_hookean,
    plastic_flow,
    sand_flow,
    snow_flow,
    snow_stiffness,
    volume_gain,
    yield_excess,
)
from .packed import ELASTIC, MASS, MEMORY, TAU, TOTAL, WIDTH

#: First rows of a tile: those of `packed`, what becomes of `strain`, and 1 where all is well or 0.
MOTION, STRAIN, MATTER, MADE, FINE, ROWS = 0, 16, 32, 48, 64, 65
H, FLOWED, TILE = STRAIN + ELASTIC, MADE + ELASTIC, ROWS * LANES

_LEAST, _ZERO, _ONE, _TWO, _THREE = map(np.float32, (-1.0, 0.0, 1.0, 2.0, 3.0))
#: Shares of `_series` of log(1 + e) / 2 and of sqrt(1 + e) - 1.
_LOGARITHM = tuple(np.float32(0.5 / k) for k in range(1, 7))
_ROOT = tuple(np.float32(k / 1024) for k in (512, 128, 64, 40, 28, 21))
#: Square of the strain up to which six terms of a logarithm's series have all digits.
_SMALL = np.float32(0.06**2)
#: Bounds of J - 1 where `log_more` holds, and of eigenvalues of F F^T - 1 where all of it does, or all but logarithms.
_GAINS = np.float32(-0.45), np.float32(0.8)
_STRAINS = np.float32(-0.69), np.float32(2.2)
_WIDE = np.float32(-0.9), np.float32(8.0)
#: Volume ratios of a fluid of which powers are found; it has at most 1.1.
_FLUID = np.float32(0.57), np.float32(1.2)
#: Change of a logarithmic strain in a step of which the exponential is found.
_CHANGE = np.float32(0.3)


@inlined
def _row(tile, row):  # type: ignore[no-untyped-def]
    return load(tile, LANES * row)


@inlined
def _put(tile, row, value):  # type: ignore[no-untyped-def]
    store(tile, LANES * row, value)


@inlined
def nine(tile, row):  # type: ignore[no-untyped-def]
    """Nine rows of a tile, from one on.

    Parameters
    ----------
    tile : (TILE,) float32 array
    row : int

    Returns
    -------
    tuple of Float32x16
    """
    return (
        _row(tile, row), _row(tile, row + 1), _row(tile, row + 2), _row(tile, row + 3), _row(tile, row + 4),
        _row(tile, row + 5), _row(tile, row + 6), _row(tile, row + 7), _row(tile, row + 8),
    )  # fmt: skip


@inlined
def put_nine(tile, row, values):  # type: ignore[no-untyped-def]
    """Write nine rows of a tile, from one on.

    Parameters
    ----------
    tile : (TILE,) float32 array
        Written.
    row : int
    values : tuple of Float32x16
    """
    a, b, c, d, e, f, g, h, i = values
    _put_six(tile, row, (a, b, c, d, e, f))
    _put(tile, row + 6, g)
    _put(tile, row + 7, h)
    _put(tile, row + 8, i)


@inlined
def velocity_gradient(tile):  # type: ignore[no-untyped-def]
    """Nine rows, row-major, 1/s.

    Parameters
    ----------
    tile : (TILE,) float32 array

    Returns
    -------
    tuple of Float32x16
    """
    return (
        _row(tile, 4), _row(tile, 8), _row(tile, 12), _row(tile, 5), _row(tile, 9), _row(tile, 13), _row(tile, 6),
        _row(tile, 10), _row(tile, 14),
    )  # fmt: skip


@inlined
def _put_six(tile, row, six):  # type: ignore[no-untyped-def]
    a, b, c, d, e, f = six
    _put(tile, row, a)
    _put(tile, row + 1, b)
    _put(tile, row + 2, c)
    _put(tile, row + 3, d)
    _put(tile, row + 4, e)
    _put(tile, row + 5, f)


@inlined
def _within(x, bounds):  # type: ignore[no-untyped-def]
    """1 where x is within bounds, 0 elsewhere and where it is not a number."""
    low, high = bounds
    return select(x > low, select(x < high, _ONE, _ZERO), _ZERO)


@inlined
def _symmetric(values, vectors):  # type: ignore[no-untyped-def]
    """N diag(values) N^T: xx, yy, zz, xy, xz, yz."""
    a, b, c = values
    n0, n1, n2, n3, n4, n5, n6, n7, n8 = vectors
    a0, b1, c2, a3, b4, c5 = a * n0, b * n1, c * n2, a * n3, b * n4, c * n5
    return (
        a0 * n0 + b1 * n1 + c2 * n2, a3 * n3 + b4 * n4 + c5 * n5, a * n6 * n6 + b * n7 * n7 + c * n8 * n8,
        a0 * n3 + b1 * n4 + c2 * n5, a0 * n6 + b1 * n7 + c2 * n8, a3 * n6 + b4 * n7 + c5 * n8,
    )  # fmt: skip


@inlined
def _flow_column(tile, k, more, f):  # type: ignore[no-untyped-def]
    """Column k of F, (a, b, c), and what is added by flow, with R = `more`."""
    xx, yy, zz, xy, xz, yz = more
    a, b, c = f
    _put(tile, FLOWED + k, _row(tile, H + k) + (xx * a + xy * b + xz * c))
    _put(tile, FLOWED + 3 + k, _row(tile, H + 3 + k) + (xy * a + yy * b + yz * c))
    _put(tile, FLOWED + 6 + k, _row(tile, H + 6 + k) + (xz * a + yz * b + zz * c))


@inlined
def _flow(tile, growth, vectors):  # type: ignore[no-untyped-def]
    """Stretch F along principal axes by 1 + growth; what does not flow stays the same to the last bit."""
    more = _symmetric(growth, vectors)
    h0, h1, h2, h3, h4, h5, h6, h7, h8 = nine(tile, H)
    _flow_column(tile, 0, more, (_ONE + h0, h3, h6))
    _flow_column(tile, 1, more, (h1, _ONE + h4, h7))
    _flow_column(tile, 2, more, (h2, h5, _ONE + h8))


@inlined
def _product(a, b):  # type: ignore[no-untyped-def]
    """Of symmetric matrices with the same principal axes."""
    a0, a1, a2, a3, a4, a5 = a
    b0, b1, b2, b3, b4, b5 = b
    return (
        a0 * b0 + a3 * b3 + a4 * b4, a3 * b3 + a1 * b1 + a5 * b5, a4 * b4 + a5 * b5 + a2 * b2,
        a0 * b3 + a3 * b1 + a4 * b5, a0 * b4 + a3 * b5 + a4 * b2, a3 * b4 + a1 * b5 + a5 * b2,
    )  # fmt: skip


@inlined
def _less_of_one(share, a):  # type: ignore[no-untyped-def]
    """share 1 - a."""
    a0, a1, a2, a3, a4, a5 = a
    return share - a0, share - a1, share - a2, _ZERO - a3, _ZERO - a4, _ZERO - a5


@inlined
def _times(a, factor):  # type: ignore[no-untyped-def]
    a0, a1, a2, a3, a4, a5 = a
    return factor * a0, factor * a1, factor * a2, factor * a3, factor * a4, factor * a5


@inlined
def _series(e, shares):  # type: ignore[no-untyped-def]
    """e (a - e (b - e (c - ...))) of small strains, with six shares."""
    a, b, c, d, f, g = shares
    series = _less_of_one(f, _times(e, g))
    series = _less_of_one(d, _product(e, series))
    series = _less_of_one(c, _product(e, series))
    series = _less_of_one(b, _product(e, series))
    series = _less_of_one(a, _product(e, series))
    return _product(e, series)


@inlined
def _size(a):  # type: ignore[no-untyped-def]
    """Square of the Frobenius norm."""
    a0, a1, a2, a3, a4, a5 = a
    return a0 * a0 + a1 * a1 + a2 * a2 + _TWO * (a3 * a3 + a4 * a4 + a5 * a5)


@njit
def respond_lanes(kind, tile, dt):  # type: ignore[no-untyped-def]
    """Let sixteen particles of one model flow, and find their stress, as `constitutive.respond`.

    Parameters
    ----------
    kind : int
        The model.
    tile : (TILE,) float32 array
        MADE and FINE are written.
    dt : float32
        Seconds.
    """
    mu, first = _row(tile, MATTER + MU), _row(tile, MATTER + LAMBDA)
    number, memory = _row(tile, MATTER + FIRST), _row(tile, STRAIN + MEMORY)
    h = nine(tile, H)
    if kind <= COROTATED or kind == FLUID:
        put_nine(tile, FLOWED, h)
    if kind == FLUID:
        stress, memory = fluid_stress(velocity_gradient(tile), memory, (mu, first, number), dt)
        _put_six(tile, MADE + TAU, stress)
        _put(tile, MADE + MEMORY, memory)
        _put(tile, FINE, _within(memory, _FLUID))
        return
    _put(tile, MADE + MEMORY, memory)
    if kind == NEO_HOOKEAN:
        _put_six(tile, MADE + TAU, neo_hookean(h, mu, first))
        _put(tile, FINE, _within(volume_gain(h), _GAINS))
        return
    strain = green_strain(h)
    # Most matter is strained little and does not yield: that takes no principal axes.
    small = _size(strain) < _SMALL
    twice = _TWO * mu
    if kind == COROTATED and not some(select(small, _ZERO, _ONE) > _ZERO):
        gain = volume_gain(h)
        push = first * gain * (_ONE + gain)
        r0, r1, r2, r3, r4, r5 = _series(strain, _ROOT)
        e0, e1, e2, e3, e4, e5 = strain
        _put_six(tile, MADE + TAU, (
            twice * (e0 - r0) + push, twice * (e1 - r1) + push, twice * (e2 - r2) + push,
            twice * (e3 - r3), twice * (e4 - r4), twice * (e5 - r5),
        ))  # fmt: skip
        _put(tile, FINE, spread(_ONE))
        return
    if kind == PLASTIC:
        a0, a1, a2, a3, a4, a5 = _series(strain, _LOGARITHM)
        third = (a0 + a1 + a2) / _THREE
        length = math.sqrt(_size((a0 - third, a1 - third, a2 - third, a3, a4, a5)))
        numbers = mu, number, _row(tile, MATTER + SECOND), _row(tile, MATTER + THIRD)
        if not some(select(small, yield_excess(length, numbers, memory), _ONE) > _ZERO):
            push = _THREE * first * third
            stress = twice * a0 + push, twice * a1 + push, twice * a2 + push, twice * a3, twice * a4, twice * a5
            put_nine(tile, FLOWED, h)
            _put_six(tile, MADE + TAU, stress)
            _put(tile, FINE, spread(_ONE))
            return
    (e0, e1, e2), vectors = eigen16(strain)
    s0, s1, s2 = math.sqrt(_ONE + e0), math.sqrt(_ONE + e1), math.sqrt(_ONE + e2)
    x, y, z = e0 / (_ONE + s0), e1 / (_ONE + s1), e2 / (_ONE + s2)
    fine = _within(e0, _WIDE) * _within(e1, _WIDE) * _within(e2, _WIDE)
    if kind == COROTATED:
        _put_six(tile, MADE + TAU, _symmetric(corotated_stress(x, y, z, mu, first), vectors))
        _put(tile, FINE, fine)
        return
    second, third = _row(tile, MATTER + SECOND), _row(tile, MATTER + THIRD)
    if kind == SNOW:
        a, b, c, memory = snow_flow(x, y, z, _ZERO - number, second, memory)
        growth = (a - x) / s0, (b - y) / s1, (c - z) / s2
        harder = snow_stiffness(memory, third)
        stress = corotated_stress(a, b, c, harder * mu, harder * first)
    else:
        a, b, c = log_more(x), log_more(y), log_more(z)
        if kind == PLASTIC:
            mean = (s0 * s0 + s1 * s1 + s2 * s2) / _THREE
            x, y, z, memory = plastic_flow(a, b, c, mean, (mu, number, second, third), memory, dt)
        else:
            x, y, z, memory = sand_flow(a, b, c, (mu, first, number, second), memory)
        fine = _within(e0, _STRAINS) * _within(e1, _STRAINS) * _within(e2, _STRAINS)
        fine = fine * _within(abs(x) + abs(y) + abs(z), (_LEAST, _CHANGE))
        growth = exp_less(x), exp_less(y), exp_less(z)
        stress = hencky_stress(a + x, b + y, c + z, mu, first)
    _put_six(tile, MADE + TAU, _symmetric(stress, vectors))
    _flow(tile, growth, vectors)
    _put(tile, MADE + MEMORY, memory)
    _put(tile, FINE, fine)


@njit
def respond_alone(kind, tile, at, dt, own):  # type: ignore[no-untyped-def]
    """The same of one particle, whatever its deformation.

    Parameters
    ----------
    kind : int
    tile : (TILE,) float32 array
    at : int
        Which of the sixteen.
    dt : float32
    own : tuple of array
        Of `room_for_one`; overwritten.
    """
    model, parameters, f, tau, memory, gradient = own
    model[0], memory[0] = kind, tile[(STRAIN + MEMORY) * LANES + at]
    for k in range(COLUMNS):
        parameters[0, k] = tile[(MATTER + k) * LANES + at]
    for k in range(9):
        f[0, k] = tile[(H + k) * LANES + at]
        gradient[0, k] = tile[(MOTION + 4 + 4 * (k % 3) + k // 3) * LANES + at]
    respond(0, model, parameters, f, tau, memory, gradient, float(dt))
    for k in range(9):
        tile[(FLOWED + k) * LANES + at] = f[0, k]
    for k in range(6):
        tile[(MADE + TAU + k) * LANES + at] = tau[0, k]
    tile[(MADE + MEMORY) * LANES + at] = memory[0]


@inlined
def room_for_one():  # type: ignore[no-untyped-def]
    """Arrays that `constitutive.respond` takes for one particle."""
    f = np.float32
    return (
        np.zeros(1, np.uint8), np.zeros((1, COLUMNS), f), np.zeros((1, 9), f), np.zeros((1, 6), f), np.zeros(1, f),
        np.zeros((1, 9), f),
    )  # fmt: skip


@njit
def update_lanes(particles, first, last, step, tile, turned, own):  # type: ignore[no-untyped-def]
    """Deform up to sixteen particles, neighbours in memory, by their velocity gradients, and find their stress.

    Parameters
    ----------
    particles : Packed
        Written.
    first, last : int
    step : float32
        Seconds.
    tile, turned : (TILE,) float32 array
        Overwritten.
    own : tuple of array
        Of `room_for_one`; overwritten.
    """
    _, motion, strain, matter, model, solid = particles
    kinds, count, kept = 0, 0, False
    for p in range(first, last):
        if motion[p, MASS] != _ZERO:
            kinds, count, kept = kinds | 1 << model[p], count + 1, kept or solid[p]
    if kinds == 0:
        return
    if last == first + LANES:
        transpose(motion, WIDTH * first, tile, LANES * MOTION)
        transpose(strain, WIDTH * first, tile, LANES * STRAIN)
        transpose(matter, WIDTH * first, tile, LANES * MATTER)
    else:
        turned[:] = _ZERO
        for p in range(first, last):
            at = LANES * (p - first)
            store(turned, LANES * MOTION + at, load(motion, WIDTH * p))
            store(turned, LANES * STRAIN + at, load(strain, WIDTH * p))
            store(turned, LANES * MATTER + at, load(matter, WIDTH * p))
        for row in (MOTION, STRAIN, MATTER):
            transpose(turned, LANES * row, tile, LANES * row)
    gradient = velocity_gradient(tile)
    put_nine(tile, H, deformed(nine(tile, H), step, gradient))
    if kept:
        put_nine(tile, MATTER + TOTAL, deformed(nine(tile, MATTER + TOTAL), step, gradient))
        transpose(tile, LANES * MATTER, turned, LANES * MATTER)
    for kind in range(FLUID + 1):
        if kinds >> kind & 1 == 0:
            continue
        respond_lanes(kind, tile, step)
        for p in range(first, last):
            if tile[FINE * LANES + p - first] != _ONE and model[p] == kind and motion[p, MASS] != _ZERO:
                respond_alone(kind, tile, p - first, step, own)
        if count == LANES and kinds == 1 << kind:
            transpose(tile, LANES * MADE, strain, WIDTH * first)
        else:
            transpose(tile, LANES * MADE, turned, LANES * MADE)
            for p in range(first, last):
                if model[p] == kind and motion[p, MASS] != _ZERO:
                    store(strain, WIDTH * p, load(turned, LANES * (MADE + p - first)))
    if kept:
        for p in range(first, last):
            if solid[p] and motion[p, MASS] != _ZERO:
                store(matter, WIDTH * p, load(turned, LANES * (MATTER + p - first)))
