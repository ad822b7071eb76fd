"""Parameters of the general BSDF at points of surfaces, for compiled code."""

from __future__ import annotations

import numpy as np

from ....compute.jit import njit
from ...sampling import ONE, ZERO
from ...scene.material_rows import HIGH, INVERTED, LOW, PARAMETER_COUNT, STARTS, TEXTURES, WIDTHS
from ...scene.texture_lookup import colour_at, number_at
from .principled import COLOUR, METALLIC, ROUGHNESS


@njit
def parameters_at(row, place, addresses, rows, p):  # type: ignore[no-untyped-def]
    """Parameters of a row at a place.

    Parameters
    ----------
    row : int64
    place : tuple
        See `texture_lookup`.
    addresses : tuple of int
        ``MaterialTable.addresses``.
    rows : MaterialRows
    p : (PARAMETER_COUNT,) float32 array
        Written.
    """
    values, ints = rows.values, rows.ints
    for i in range(PARAMETER_COUNT):
        p[i] = values[row, i]
    for i in range(len(STARTS)):
        texture = np.int64(ints[row, TEXTURES + i])
        if texture < 0:
            continue
        start, low, high = STARTS[i], LOW[i], HIGH[i]
        if WIDTHS[i] == 1:
            x = p[start] * number_at(texture, place, addresses)
            p[start] = min(max(x, low), high) if x == x else low
            continue
        r, g, b = colour_at(texture, place, addresses)
        if i == len(STARTS) - 1 and ints[row, INVERTED] == 1:
            r, g, b = ONE - r, ONE - g, ONE - b
        r, g, b = p[start] * r, p[start + 1] * g, p[start + 2] * b
        p[start] = min(r, high) if r > ZERO else ZERO
        p[start + 1] = min(g, high) if g > ZERO else ZERO
        p[start + 2] = min(b, high) if b > ZERO else ZERO


@njit
def plain_parameters(r, g, b, roughness, metallic, rows, p):  # type: ignore[no-untyped-def]
    """Parameters of a surface without a row.

    Parameters
    ----------
    r, g, b, roughness, metallic : float32
        Of its material.
    rows : MaterialRows
    p : (PARAMETER_COUNT,) float32 array
        Written.
    """
    for i in range(PARAMETER_COUNT):
        p[i] = rows.neutral[i]
    put_base((r, g, b, roughness, metallic), p)


@njit
def put_base(base, p):  # type: ignore[no-untyped-def]
    """Put base colour, roughness and metallic among parameters.

    Parameters
    ----------
    base : tuple of float32
    p : (PARAMETER_COUNT,) float32 array
        Written.
    """
    p[COLOUR], p[COLOUR + 1], p[COLOUR + 2] = base[0], base[1], base[2]
    p[ROUGHNESS], p[METALLIC] = base[3], base[4]
