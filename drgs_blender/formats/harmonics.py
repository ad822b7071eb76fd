"""Spherical harmonics of 3DGS: evaluation up to degree 4, and rotation.

Real basis with the Condon-Shortley phase of 3DGS, order (l, m) = (0, 0), (1, -1), (1, 0), (1, 1), (2, -2), ...
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

Array = np.ndarray

#: Value of the constant one.
SH_C0 = 0.28209479177387814
#: Splats rotated at once; bounds the memory of the intermediate bases.
_BLOCK = 1 << 16


def basis(directions: Array, degree: int) -> Array:
    """Basis functions (..., (degree + 1)^2) at unit directions (..., 3); float64."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    return np.stack(polynomials(x, y, z, np.ones_like(x), degree), axis=-1)


def polynomials(x: Any, y: Any, z: Any, one: Any, degree: int) -> list[Any]:
    """Basis functions of unit directions; arrays or tensors, `one` full of ones."""
    xx, yy, zz = x * x, y * y, z * z
    columns = [SH_C0 * one]
    if degree >= 1:
        a = 0.4886025119029199
        columns += [-a * y, a * z, -a * x]
    if degree >= 2:
        a, b, c = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
        columns += [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    if degree >= 3:
        a, b, c, d = 0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154
        columns += [
            -a * y * (3 * xx - yy),
            b * x * y * z,
            -c * y * (4 * zz - xx - yy),
            d * z * (2 * zz - 3 * xx - 3 * yy),
            -c * x * (4 * zz - xx - yy),
            0.5 * b * z * (xx - yy),
            -a * x * (xx - 3 * yy),
        ]
    if degree >= 4:
        a, b, c = 2.5033429417967046, 1.7701307697799304, 0.9461746957575601
        d, e, f = 0.6690465435572892, 0.10578554691520431, 0.47308734787878004
        columns += [
            a * x * y * (xx - yy),
            -b * y * z * (3 * xx - yy),
            c * x * y * (7 * zz - one),
            -d * y * z * (7 * zz - 3 * one),
            e * (zz * (35 * zz - 30 * one) + 3 * one),
            -d * x * z * (7 * zz - 3 * one),
            f * (xx - yy) * (7 * zz - one),
            -b * x * z * (xx - 3 * yy),
            0.25 * a * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return columns


def whole_bands(sh: Array, degree: int = 3) -> Array:
    """The coefficients (n, k, 3) of complete bands up to a degree of at most 4; a view."""
    return sh[:, : next(k for k in (25, 16, 9, 4, 1) if k <= min(sh.shape[1], (degree + 1) ** 2))]


def rotate_harmonics(sh: Array, rotation: Array) -> Array:
    """Turn functions on the sphere: the result at R d is what `sh` was at d.

    Parameters
    ----------
    sh : (n, k, 3) float32 array
        With k = 1, 4, 9, 16 or 25.
    rotation : (3, 3) or (n, 3, 3) array
        One for all functions, or one per function; orthogonal: it may mirror.

    Returns
    -------
    (n, k, 3) float32 array
        Each band stays within itself. Its matrix comes from the band's values at fixed directions and at the turned
        ones, exact because the directions determine the band.
    """
    degree = {1: 0, 4: 1, 9: 2, 16: 3, 25: 4}[sh.shape[1]]
    if degree == 0:
        return sh
    result = np.empty_like(sh)
    result[:, 0] = sh[:, 0]
    for start in range(0, len(sh), _BLOCK):
        rows = slice(start, start + _BLOCK)
        turn = np.asarray(rotation if np.ndim(rotation) == 2 else rotation[rows], np.float64)
        directions = _directions()
        turned = basis(directions @ turn, degree)  # R^T d, as rows
        for l in range(1, degree + 1):
            band = slice(l * l, (l + 1) * (l + 1))
            matrix = _inverse(l) @ turned[..., band]
            result[rows, band] = matrix.astype(np.float32) @ sh[rows, band]
    return result


@cache
def _directions() -> Array:
    """(16, 3) directions spread over the sphere (Fibonacci lattice), which determine every band up to degree 4."""
    turn = np.arange(16)
    z = 1 - (2 * turn + 1) / 16
    angle = turn * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


@cache
def _inverse(l: int) -> Array:
    """(2 l + 1, 16): coefficients of band l from its values at `_directions`."""
    return np.linalg.pinv(basis(_directions(), 4)[:, l * l : (l + 1) * (l + 1)])
