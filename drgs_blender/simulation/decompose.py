"""Decompositions of 3 x 3 matrices in compiled code: singular values of one, eigenvectors of sixteen."""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.simd import select, some, spread

_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-20)
#: Rotations in three planes each, at most; and of what is off the diagonal, the share that may stay.
_SWEEPS, _LEFT = 6, np.float32(1e-6)


@inlined
def _turn(spp, sqq, spq, spr, sqr):  # type: ignore[no-untyped-def]
    """One Jacobi rotation in the plane (p, q) that zeroes spq: (c, s, spp, sqq, spr, sqr)."""
    if abs(spq) <= 1e-14 * (abs(spp) + abs(sqq)):
        return 1.0, 0.0, spp, sqq, spr, sqr
    theta = (sqq - spp) / (2.0 * spq)
    t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
    t = -t if theta < 0.0 else t
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    return c, s, spp - t * spq, sqq + t * spq, c * spr - s * sqr, s * spr + c * sqr


@njit
def svd3(f, n):  # type: ignore[no-untyped-def]
    """Singular value decomposition A = U diag(sigma) V^T of a 3 x 3 matrix, by Jacobi rotations of A^T A, in double.

    Parameters
    ----------
    f : (k, 9) array
        Rows are A - 1, row-major.
    n : int64
        Row.

    Returns
    -------
    u, v : tuple of float
        Nine each, row-major. V is a rotation; where A mirrors or is singular, so does U or U has a made-up column.
    sigma : tuple of float
        Three, not sorted and not negative; between the two.
    """
    a, b, c = 1.0 + float(f[n, 0]), float(f[n, 1]), float(f[n, 2])
    d, e, g = float(f[n, 3]), 1.0 + float(f[n, 4]), float(f[n, 5])
    h, i, j = float(f[n, 6]), float(f[n, 7]), 1.0 + float(f[n, 8])
    xx, yy, zz = a * a + d * d + h * h, b * b + e * e + i * i, c * c + g * g + j * j
    xy, xz, yz = a * b + d * e + h * i, a * c + d * g + h * j, b * c + e * g + i * j
    v0, v1, v2, v3, v4, v5, v6, v7, v8 = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    for _ in range(8):
        if abs(xy) + abs(xz) + abs(yz) <= 1e-13 * (xx + yy + zz):
            break
        p, s, xx, yy, xz, yz = _turn(xx, yy, xy, xz, yz)
        xy = 0.0
        v0, v1, v3, v4, v6, v7 = p * v0 - s * v1, s * v0 + p * v1, p * v3 - s * v4, s * v3 + p * v4, p * v6 - s * v7, s * v6 + p * v7  # fmt: skip  # noqa: E501
        p, s, xx, zz, xy, yz = _turn(xx, zz, xz, xy, yz)
        xz = 0.0
        v0, v2, v3, v5, v6, v8 = p * v0 - s * v2, s * v0 + p * v2, p * v3 - s * v5, s * v3 + p * v5, p * v6 - s * v8, s * v6 + p * v8  # fmt: skip  # noqa: E501
        p, s, yy, zz, xy, xz = _turn(yy, zz, yz, xy, xz)
        yz = 0.0
        v1, v2, v4, v5, v7, v8 = p * v1 - s * v2, s * v1 + p * v2, p * v4 - s * v5, s * v4 + p * v5, p * v7 - s * v8, s * v7 + p * v8  # fmt: skip  # noqa: E501
    ux, uy, uz = a * v0 + b * v3 + c * v6, d * v0 + e * v3 + g * v6, h * v0 + i * v3 + j * v6
    wx, wy, wz = a * v1 + b * v4 + c * v7, d * v1 + e * v4 + g * v7, h * v1 + i * v4 + j * v7
    qx, qy, qz = a * v2 + b * v5 + c * v8, d * v2 + e * v5 + g * v8, h * v2 + i * v5 + j * v8
    s0, s1, s2 = (
        math.sqrt(ux * ux + uy * uy + uz * uz), math.sqrt(wx * wx + wy * wy + wz * wz),
        math.sqrt(qx * qx + qy * qy + qz * qz),
    )  # fmt: skip
    tiny = 1e-9 * (s0 + s1 + s2) + 1e-300
    # A direction that collapsed is made up from the other two; matter that is integrated well never has one.
    if s2 <= tiny:
        qx, qy, qz, r = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx, s0 * s1
    elif s1 <= tiny:
        wx, wy, wz = qy * uz - qz * uy, qz * ux - qx * uz, qx * uy - qy * ux
        r = s2
    elif s0 <= tiny:
        ux, uy, uz = wy * qz - wz * qy, wz * qx - wx * qz, wx * qy - wy * qx
        r = s2
    else:
        r = s2
    l0 = math.sqrt(ux * ux + uy * uy + uz * uz) + 1e-300
    l1 = math.sqrt(wx * wx + wy * wy + wz * wz) + 1e-300
    l2 = (r if s2 <= tiny else s2) + 1e-300
    u = (ux / l0, wx / l1, qx / l2, uy / l0, wy / l1, qy / l2, uz / l0, wz / l1, qz / l2)
    return u, (s0, s1, s2), (v0, v1, v2, v3, v4, v5, v6, v7, v8)


@inlined
def _turn16(spp, sqq, spq, spr, sqr):  # type: ignore[no-untyped-def]
    """As `_turn`, of sixteen matrices."""
    d, twice = sqq - spp, spq + spq
    t = select(d < _ZERO, _ZERO - twice, twice) / (abs(d) + math.sqrt(d * d + twice * twice) + _TINY)
    c = _ONE / math.sqrt(_ONE + t * t)
    s = t * c
    return c, s, spp - t * spq, sqq + t * spq, c * spr - s * sqr, s * spr + c * sqr


@inlined
def eigen16(e):  # type: ignore[no-untyped-def]
    """Eigenvalues and eigenvectors of sixteen symmetric matrices, by Jacobi rotations, in single precision.

    Parameters
    ----------
    e : tuple of Float32x16
        xx, yy, zz, xy, xz, yz.

    Returns
    -------
    values : tuple of Float32x16
        Three, not sorted.
    vectors : tuple of Float32x16
        Nine; the columns of a row-major matrix.
    """
    xx, yy, zz, xy, xz, yz = e
    v0 = v4 = v8 = spread(_ONE)
    v1 = v2 = v3 = v5 = v6 = v7 = spread(_ZERO)
    for _ in range(_SWEEPS):
        if not some(abs(xy) + abs(xz) + abs(yz) > _LEFT * (abs(xx) + abs(yy) + abs(zz)) + _TINY):
            break
        c, s, xx, yy, xz, yz = _turn16(xx, yy, xy, xz, yz)
        v0, v1, v3, v4, v6, v7 = c * v0 - s * v1, s * v0 + c * v1, c * v3 - s * v4, s * v3 + c * v4, c * v6 - s * v7, s * v6 + c * v7  # fmt: skip  # noqa: E501
        c, s, xx, zz, xy, yz = _turn16(xx, zz, xz, spread(_ZERO), yz)
        v0, v2, v3, v5, v6, v8 = c * v0 - s * v2, s * v0 + c * v2, c * v3 - s * v5, s * v3 + c * v5, c * v6 - s * v8, s * v6 + c * v8  # fmt: skip  # noqa: E501
        c, s, yy, zz, xy, xz = _turn16(yy, zz, yz, xy, spread(_ZERO))
        yz = spread(_ZERO)
        v1, v2, v4, v5, v7, v8 = c * v1 - s * v2, s * v1 + c * v2, c * v4 - s * v5, s * v4 + c * v5, c * v7 - s * v8, s * v7 + c * v8  # fmt: skip  # noqa: E501
    return (xx, yy, zz), (v0, v1, v2, v3, v4, v5, v6, v7, v8)
