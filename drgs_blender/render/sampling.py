"""Random numbers for Monte Carlo and the maps from the unit square, as small scalar functions for compiled code.

Every number is a pure function of (seed, frame, pixel, strategy, sample index, dimension): pictures do not depend on
strips, threads or order. The samples of one strategy in one pixel are a Sobol' point set, scrambled as Owen does by a
hash of the rest (Laine and Karras 2011, Burley 2020); deeper dimensions are hashed alone.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from ..compute.jit import inlined
from ..core.color import LUMINANCE

Array = np.ndarray

F = np.float32
U = np.uint32
ZERO, HALF, ONE, TWO, PI = F(0.0), F(0.5), F(1.0), F(2.0), F(math.pi)
INVERSE_PI = F(1.0 / math.pi)
GOLDEN = U(0x9E3779B9)
_UNIT = F(1.0 / 16777216.0)


@inlined
def luminance(r, g, b):  # type: ignore[no-untyped-def]
    """Luminance of a colour.

    Parameters
    ----------
    r, g, b : float32
        Linear Rec.709.

    Returns
    -------
    float32
    """
    return F(LUMINANCE[0]) * r + F(LUMINANCE[1]) * g + F(LUMINANCE[2]) * b


@inlined
def mix(x):  # type: ignore[no-untyped-def]
    """Hash of a uint32 (the "lowbias32" constants of C. Wellons' search).

    Parameters
    ----------
    x : uint32

    Returns
    -------
    uint32
    """
    x = U(x ^ (x >> U(16)))
    x = U(x * U(0x7FEB352D))
    x = U(x ^ (x >> U(15)))
    x = U(x * U(0x846CA68B))
    return U(x ^ (x >> U(16)))


@inlined
def unit(x):  # type: ignore[no-untyped-def]
    """Random number in [0, 1), of 24 bits.

    Parameters
    ----------
    x : uint32
        Of which the highest 24 bits count.

    Returns
    -------
    float32
    """
    return F(np.int32(x >> U(8))) * _UNIT


@inlined
def scrambled(number, key):  # type: ignore[no-untyped-def]
    """Owen scrambling of a number given with its bits reversed: each digit is flipped by a hash of those above it.

    The hash is Laine and Karras' (2011) with the constants of N. Vegdahl's search.

    Parameters
    ----------
    number : uint32
        Coordinate of a Sobol' point, bits reversed.
    key : uint32
        Of the point set and the dimension.

    Returns
    -------
    uint32
        Bits in their usual order.
    """
    x = U(number)
    x = U(x ^ U(x * U(0x3D20ADEA)))
    x = U(x + key)
    x = U(x * ((key >> U(16)) | U(1)))
    x = U(x ^ U(x * U(0x05526C56)))
    x = U(x ^ U(x * U(0x53A22864)))
    x = U(((x & U(0x55555555)) << U(1)) | ((x >> U(1)) & U(0x55555555)))
    x = U(((x & U(0x33333333)) << U(2)) | ((x >> U(2)) & U(0x33333333)))
    x = U(((x & U(0x0F0F0F0F)) << U(4)) | ((x >> U(4)) & U(0x0F0F0F0F)))
    x = U(((x & U(0x00FF00FF)) << U(8)) | ((x >> U(8)) & U(0x00FF00FF)))
    return U((x << U(16)) | (x >> U(16)))


def sobol(count: int) -> Array:
    """(count, 3) uint32: the first points of the three-dimensional Sobol' sequence (Joe and Kuo's numbers)."""
    bits = 32
    directions = np.zeros((3, bits), np.uint64)
    for i in range(bits):
        directions[0, i] = 1 << (bits - 1 - i)
    # Primitive polynomials x + 1 and x^2 + x + 1 with initial values 1 and 1, 3.
    for row, (degree, inner, initial) in enumerate(((1, 0, (1,)), (2, 1, (1, 3))), start=1):
        v = [m << (bits - 1 - i) for i, m in enumerate(initial)]
        for i in range(degree, bits):
            value = v[i - degree] ^ (v[i - degree] >> degree)
            for k in range(1, degree):
                if inner >> (degree - 1 - k) & 1:
                    value ^= v[i - k]
            v.append(value)
        directions[row] = v
    index = np.arange(count, dtype=np.uint64)
    points = np.zeros((count, 3), np.uint64)
    for i in range(max(1, count.bit_length())):
        points ^= np.where((index >> np.uint64(i) & np.uint64(1)).astype(bool)[:, None], directions[:, i], np.uint64(0))
    return points.astype(np.uint32)


def reversed_bits(numbers: Array) -> Array:
    """uint32 `numbers` with their bits in the opposite order, as `scrambled` takes them."""
    bits = np.unpackbits(np.ascontiguousarray(numbers, ">u4").view(np.uint8)[..., None], axis=-1)
    bits = bits.reshape(*numbers.shape, 32)[..., ::-1]
    return np.packbits(bits, axis=-1).view(">u4")[..., 0].astype(np.uint32)


@functools.lru_cache(maxsize=8)
def point_set(count: int) -> Array:
    """`sobol` for `scrambled`; the same array for every batch of a picture, not to be written to."""
    return reversed_bits(sobol(count))


@inlined
def sincos_turns(q):  # type: ignore[no-untyped-def]
    """Sine and cosine of an angle in turns, to 4e-7, by minimax polynomials on an eighth of a turn.

    Parameters
    ----------
    q : float32
        Turns, -2 < q < 2.

    Returns
    -------
    s, c : float32
    """
    turn = np.int32(q * F(4.0) + F(8.5)) - np.int32(8)
    x = q - F(turn) * F(0.25)
    y = x * x
    s = x * (F(6.28318783) + y * (F(-41.34295931) + y * (F(81.75866578) + y * F(-81.47826283))))
    c = ONE + y * (F(-19.73922825) + y * (F(64.9363831) + y * (F(-84.37502959) + y * F(6.99699888))))
    if turn & 1:
        s, c = c, -s
    if turn & 2:
        s, c = -s, -c
    return s, c


@inlined
def fast_acos(x):  # type: ignore[no-untyped-def]
    """acos to 1e-6 radians, by a minimax polynomial; arguments beyond [-1, 1] are clamped.

    Parameters
    ----------
    x : float32

    Returns
    -------
    float32
        Radians.
    """
    a = min(abs(x), ONE)
    p = F(0.08815665) + a * (F(-0.04588359) + a * (F(0.02056646) + a * F(-0.00488817)))
    y = math.sqrt(ONE - a) * (F(1.57079571) + a * (F(-0.21454126) + a * p))
    return y if x >= ZERO else PI - y


@inlined
def fast_atan2_turns(y, x):  # type: ignore[no-untyped-def]
    """atan2 / 2 pi in [-1/2, 1/2] to 3e-7 turns, by a minimax polynomial.

    Parameters
    ----------
    y, x : float32

    Returns
    -------
    float32
        Turns.
    """
    ax, ay = abs(x), abs(y)
    large = max(ax, ay)
    t = min(ax, ay) / large if large > ZERO else ZERO
    s = t * t
    p = F(0.03083551) + s * (F(-0.01860468) + s * (F(0.00845371) + s * F(-0.00189218)))
    r = t * (F(0.15915157) + s * (F(-0.05294417) + s * p))
    if ay > ax:
        r = F(0.25) - r
    if x < ZERO:
        r = HALF - r
    return r if y >= ZERO else -r


@inlined
def basis(nx, ny, nz):  # type: ignore[no-untyped-def]
    """Two unit tangents of a unit normal (Duff et al. 2017): the tangent frame.

    Parameters
    ----------
    nx, ny, nz : float32
        Unit.

    Returns
    -------
    ux, uy, uz, vx, vy, vz : float32
        Unit, in the frame of the normal; with it, a right-handed frame.
    """
    sign = ONE if nz >= ZERO else -ONE
    a = -ONE / (sign + nz)
    b = nx * ny * a
    return ONE + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny


@inlined
def cosine_hemisphere(u, v):  # type: ignore[no-untyped-def]
    """Cosine sampling: a direction with pdf z / pi (PBRT A.5.3).

    Parameters
    ----------
    u, v : float32
        Random numbers in [0, 1): azimuth (in turns), square of the radius.

    Returns
    -------
    x, y, z : float32
        Unit, tangent frame (z is the normal).
    """
    s, c = sincos_turns(u)
    r = math.sqrt(v)
    return r * c, r * s, math.sqrt(max(ZERO, ONE - v))
