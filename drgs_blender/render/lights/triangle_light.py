"""One emitting triangle: directions towards it, and the pdf with which they are drawn.

A triangle that is seen under a large solid angle is sampled by solid angle (Arvo 1995), in double, as it cancels;
others by area.
Compiled code takes the address of the rows, see `memory`.
"""

from __future__ import annotations

import math

import numpy as np

from ...compute.jit import njit
from ..memory import load_float
from ..sampling import ONE, TWO, ZERO, F, fast_atan2_turns

#: Columns of a row: corner, two edges that leave it, area, square of the longest edge, unit normal, mean luminance of
#: the emitted radiance, bits (``light_shapes``' and `ABSENT`).
CORNER, EDGE, SIDE, AREA, LONGEST, NORMAL, LUMINANCE, BITS = 0, 3, 6, 9, 10, 11, 14, 15
WIDTH = 16
#: Bits: does not shine in a world of shadow catchers alone; is of a closed surface, whose outside its normal is.
ABSENT, CLOSED = 16, 32
#: What a triangle of a closed surface is reckoned to send to where it turns its back; it may be seen from within.
BACK = F(0.02)

#: Triangles nearer than this many longest edges, and larger than this many steradians, are sampled by solid angle.
_NEAR, _LEAST_ANGLE = F(5.0), 1e-5
_THIRD, _FOUR_PI, _TINY = F(1.0 / 3.0), F(4.0 * math.pi), F(1e-30)
_LEAST_COSINE = F(1e-3)


@njit
def _vector(rows, k):  # type: ignore[no-untyped-def]
    return load_float(rows, k), load_float(rows, k + 1), load_float(rows, k + 2)


@njit
def _dot(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ax * bx + ay * by + az * bz


@njit
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit
def _length(a):  # type: ignore[no-untyped-def]
    return math.sqrt(_dot(*a, *a))


@njit
def _plus(a, b):  # type: ignore[no-untyped-def]
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit
def _scaled(a, k):  # type: ignore[no-untyped-def]
    return a[0] * k, a[1] * k, a[2] * k


@njit
def _frame(i, px, py, pz, rows):  # type: ignore[no-untyped-def]
    """First corner and middle of a triangle as seen from a point, edges, squared distance of the middle, if it is near.

    Near is what is large in the environment.
    """
    k = WIDTH * np.int64(i)
    corner = _plus(_vector(rows, k + CORNER), (-px, -py, -pz))
    edge, side = _vector(rows, k + EDGE), _vector(rows, k + SIDE)
    middle = _plus(corner, _scaled(_plus(edge, side), _THIRD))
    square = _dot(*middle, *middle)
    return corner, middle, edge, side, square, square < _NEAR * _NEAR * load_float(rows, k + LONGEST)


@njit
def triangle_weight(i, px, py, pz, rows):  # type: ignore[no-untyped-def]
    """Estimated luminance that arrives at a point from a triangle, unshadowed: its weight in the pick; above 0.

    Parameters
    ----------
    i : int64
        Row of the triangle.
    px, py, pz : float32
        Point, world, m.
    rows : int64
        Address of (n, WIDTH) float32.

    Returns
    -------
    float32
        From all directions together, in the unit of the rows' LUMINANCE times sr.
    """
    k = WIDTH * np.int64(i)
    corner, middle, edge, side, square, near = _frame(i, px, py, pz, rows)
    normal, area, own = _vector(rows, k + NORMAL), load_float(rows, k + AREA), load_float(rows, k + LUMINANCE)
    if np.int32(load_float(rows, k + BITS)) & CLOSED and _dot(*middle, *normal) > ZERO:
        own *= BACK
    if not near:
        return own * area * max(abs(_dot(*middle, *normal)) / math.sqrt(square), _LEAST_COSINE) / square
    b, c = _plus(corner, edge), _plus(corner, side)
    x, y, z = _length(corner), _length(b), _length(c)
    volume = TWO * area * abs(_dot(*corner, *normal))
    below = x * y * z + _dot(*corner, *b) * z + _dot(*corner, *c) * y + _dot(*b, *c) * x
    return own * max(_FOUR_PI * fast_atan2_turns(volume, below), F(_LEAST_ANGLE))


@njit
def _unit(a):  # type: ignore[no-untyped-def]
    return _scaled(a, 1.0 / max(_length(a), 1e-30))


@njit
def _double(a):  # type: ignore[no-untyped-def]
    return np.float64(a[0]), np.float64(a[1]), np.float64(a[2])


@njit
def _single(a):  # type: ignore[no-untyped-def]
    return F(a[0]), F(a[1]), F(a[2])


@njit
def _angle(corner, edge, side, near):  # type: ignore[no-untyped-def]
    """Solid angle by which a triangle is sampled (Van Oosterom, Strackee 1983), 0: by area; corners' directions."""
    first = _double(corner)
    a, b, c = _unit(first), _unit(_plus(first, edge)), _unit(_plus(first, side))
    solid = 0.0
    if near:
        volume = abs(_dot(*a, *_cross(*b, *c)))
        solid = 2.0 * math.atan2(volume, 1.0 + _dot(*a, *b) + _dot(*b, *c) + _dot(*c, *a))
    return (solid if solid > _LEAST_ANGLE else 0.0), a, b, c


@njit
def _between(a, b, cosine):  # type: ignore[no-untyped-def]
    """The direction in the plane of two that encloses an angle of that cosine with the first."""
    across = _unit(_plus(b, _scaled(a, -_dot(*a, *b))))
    return _plus(_scaled(a, cosine), _scaled(across, math.sqrt(max(0.0, 1.0 - cosine * cosine))))


@njit
def _spherical(u, v, solid, a, b, c):  # type: ignore[no-untyped-def]
    """A direction, uniform over the spherical triangle between three (Arvo 1995)."""
    at_a = math.atan2(abs(_dot(*a, *_cross(*b, *c))), _dot(*_cross(*a, *b), *_cross(*a, *c)))
    s, t = math.sin(u * solid - at_a), math.cos(u * solid - at_a)
    cosine, sine = math.cos(at_a), math.sin(at_a)
    p, q = t - cosine, s + sine * _dot(*a, *b)
    below = (q * s + p * t) * sine
    reach = ((q * t - p * s) * cosine - q) / below if abs(below) > 1e-300 else 1.0
    edge = _between(a, c, min(max(reach, -1.0), 1.0))
    return _between(b, edge, min(max(1.0 - v * (1.0 - _dot(*edge, *b)), -1.0), 1.0))


@njit
def triangle_direction(i, n1, n2, px, py, pz, rows):  # type: ignore[no-untyped-def]
    """Sample a direction towards a triangle, by solid angle (Arvo 1995) or by area (PBRT 6.5.4).

    Parameters
    ----------
    i : int64
        Row of the triangle.
    n1, n2 : float32
        Random numbers in [0, 1).
    px, py, pz : float32
        Point, world, m.
    rows : int64
        Address of (n, WIDTH) float32.

    Returns
    -------
    lx, ly, lz : float32
        Unit, world.
    t : float32
        Distance, m; not positive when it is none: the triangle is seen from its edge.
    u, v : float32
        Barycentric coordinates of the second and third corner.
    density : float32
        Pdf per solid angle, sr^-1.
    """
    k = WIDTH * np.int64(i)
    corner, _, edge, side, _, near = _frame(i, px, py, pz, rows)
    normal, area = _vector(rows, k + NORMAL), load_float(rows, k + AREA)
    solid, a, b, c = _angle(corner, edge, side, near)
    if solid > 0.0:
        direction = _single(_spherical(np.float64(n1), np.float64(n2), solid, a, b, c))
        slope = _dot(*direction, *normal)
        t = _dot(*corner, *normal) / slope if slope != ZERO else -ONE
        # Where that is on the triangle, along both edges.
        place = _plus(_scaled(direction, t), _scaled(corner, -ONE))
        across = _cross(*edge, *side)
        u = _dot(*across, *_cross(*place, *side)) / (F(4.0) * area * area)
        v = _dot(*across, *_cross(*edge, *place)) / (F(4.0) * area * area)
        u = min(max(u, ZERO), ONE)
        return direction[0], direction[1], direction[2], t, u, min(max(v, ZERO), ONE - u), F(1.0 / solid)
    root = math.sqrt(n1)
    u, v = root * (ONE - n2), root * n2
    x, y, z = _plus(corner, _plus(_scaled(edge, u), _scaled(side, v)))
    t = math.sqrt(x * x + y * y + z * z)
    facing = abs(_dot(x, y, z, *normal))
    if not (t > _TINY and facing > ZERO):
        return ZERO, ZERO, ONE, -ONE, ZERO, ZERO, ZERO
    return x / t, y / t, z / t, t, u, v, t * t * t / (facing * area)


@njit
def triangle_density(i, px, py, pz, lx, ly, lz, t, rows):  # type: ignore[no-untyped-def]
    """The pdf per solid angle with which `triangle_direction` draws a direction that meets the triangle.

    Parameters
    ----------
    i : int64
        Row of the triangle.
    px, py, pz : float32
        Point, world, m.
    lx, ly, lz : float32
        Direction from it, unit, world.
    t : float32
        Distance at which it meets the triangle, m.
    rows : int64
        Address of (n, WIDTH) float32.

    Returns
    -------
    float32
        sr^-1.
    """
    k = WIDTH * np.int64(i)
    corner, _, edge, side, _, near = _frame(i, px, py, pz, rows)
    solid, _, _, _ = _angle(corner, edge, side, near)
    if solid > 0.0:
        return F(1.0 / solid)
    slope = abs(_dot(lx, ly, lz, *_vector(rows, k + NORMAL)))
    return t * t / (slope * load_float(rows, k + AREA)) if slope > ZERO else ZERO
