"""Path regularisation, Cycles' Filter Glossy: behind a bounce that was spread out, surfaces are rougher.

Light that a sharp reflection brings by way of a rough one (a caustic) is found by few samples, each of them a firefly.
Rougher, the reflection is found by more, and is darker and blurred: a bias, which no number of samples takes away.
What a lobe reflects in all stays as it was, as in Cycles: energy compensation and layers know the sharp alpha.
"""

from __future__ import annotations

import math

from ...compute.jit import njit
from ..sampling import ONE, ZERO, F
from .bsdf.lobes import AX, AY, DELTA, KIND, LOBE, METAL, SMOOTH

#: GGX's alpha at least where the bounces before were spread over all directions.
_MOST = F(0.5)


@njit
def least_alpha(pdf, filter_glossy):  # type: ignore[no-untyped-def]
    """GGX's alpha that a surface has at least which a bounce of the path has found.

    Parameters
    ----------
    pdf : float32
        Density of the bounce by the BSDF, sr^-1; along a path the least of all bounces counts.
    filter_glossy : float32
        Density below which surfaces are made rougher, sr^-1; 0: none are.

    Returns
    -------
    float32
    """
    if not filter_glossy > ZERO:
        return ZERO
    return _MOST * F(math.sqrt(max(ONE - pdf / filter_glossy, ZERO)))


@njit
def roughen(b, count, alpha):  # type: ignore[no-untyped-def]
    """Give the microfacets of lobes at least an alpha.

    Parameters
    ----------
    b : float32 array
        Lobes, see `bsdf.lobes`; written.
    count : int64
        How many there are.
    alpha : float32
        Of `least_alpha`.
    """
    for lobe in range(count):
        k = lobe * LOBE
        if b[k + KIND] >= METAL:
            b[k + AX], b[k + AY] = max(b[k + AX], alpha), max(b[k + AY], alpha)
            if b[k + AX] >= SMOOTH:
                b[k + DELTA] = ZERO
