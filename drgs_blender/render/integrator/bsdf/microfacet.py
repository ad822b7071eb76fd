"""Fresnel equations and anisotropic GGX, as scalar functions for compiled code.

Directions are unit vectors in the lobe's frame: z along its normal, x along its tangent. Those towards the viewer and
towards the light both point away from the point; ``eta`` is the IOR beyond the surface over that on the viewer's side.
Sources: PBRT 9.3 and 9.7 (Fresnel equations, rough dielectrics after Walter et al. 2007), Heitz 2014 (Smith), Dupuy and
Benyoub 2023 (visible normals by spherical caps).
"""

from __future__ import annotations

import math

from ....compute.jit import inlined, njit
from ...sampling import HALF, ONE, PI, ZERO, F, sincos_turns

_TINY = F(1e-30)


@inlined
def fresnel(c, eta):  # type: ignore[no-untyped-def]
    """Unpolarised Fresnel reflectance of a dielectric (PBRT 9.3.5).

    Parameters
    ----------
    c : float32
        Cosine between direction and normal, in [0, 1].
    eta : float32
        IOR beyond the surface over that on the direction's side.

    Returns
    -------
    reflectance : float32
        1 at total internal reflection.
    t : float32
        Cosine of the refracted direction; 0 at total internal reflection.
    """
    sin2 = (ONE - c * c) / (eta * eta)
    t = math.sqrt(max(ONE - sin2, ZERO))
    across, along = (c - eta * t) / max(c + eta * t, _TINY), (eta * c - t) / max(eta * c + t, _TINY)
    reflectance = HALF * (across * across + along * along)
    return (reflectance if sin2 < ONE else ONE), t


@inlined
def normal_reflectance(eta):  # type: ignore[no-untyped-def]
    """F0: reflectance of a dielectric along its normal.

    Parameters
    ----------
    eta : float32

    Returns
    -------
    float32
    """
    r = (eta - ONE) / (eta + ONE)
    return r * r


@inlined
def mean_fresnel(eta):  # type: ignore[no-untyped-def]
    """Mean of a dielectric's reflectance over the hemisphere, weighted by the cosine (fits of Kulla and Conty 2017).

    Parameters
    ----------
    eta : float32

    Returns
    -------
    float32
    """
    if eta < ONE:
        return F(0.997118) + eta * (F(0.1014) - eta * (F(0.965241) + eta * F(0.130607)))
    return (eta - ONE) / (F(4.08567) + F(1.00071) * eta)


@inlined
def smith_lambda(x, y, z, ax, ay):  # type: ignore[no-untyped-def]
    """Smith's Lambda of GGX (Heitz 2014).

    Parameters
    ----------
    x, y, z : float32
        Direction; z is not 0.
    ax, ay : float32
        Alpha along x and y.

    Returns
    -------
    float32
    """
    slope = (ax * ax * x * x + ay * ay * y * y) / max(z * z, _TINY)
    return HALF * (math.sqrt(ONE + slope) - ONE)


@inlined
def distribution(hx, hy, hz, ax, ay):  # type: ignore[no-untyped-def]
    """GGX's distribution of normals D.

    Parameters
    ----------
    hx, hy, hz : float32
        Microfacet normal, unit.
    ax, ay : float32
        Alpha along x and y.

    Returns
    -------
    float32
        sr^-1.
    """
    x, y = hx / ax, hy / ay
    k = x * x + y * y + hz * hz
    return ONE / max(PI * ax * ay * k * k, _TINY)


@njit
def visible_normal(u, v, ix, iy, iz, ax, ay):  # type: ignore[no-untyped-def]
    """A microfacet normal visible from a direction, with density D G1 (i.h) / i.z (Dupuy and Benyoub 2023).

    Parameters
    ----------
    u, v : float32
        Random numbers in [0, 1).
    ix, iy, iz : float32
        Direction towards the viewer, iz > 0.
    ax, ay : float32
        Alpha along x and y.

    Returns
    -------
    hx, hy, hz : float32
        Unit.
    """
    x, y, z = ax * ix, ay * iy, iz
    scale = ONE / math.sqrt(max(x * x + y * y + z * z, _TINY))
    x, y, z = x * scale, y * scale, z * scale
    cz = (ONE - v) * (ONE + z) - z
    ring = math.sqrt(max(ZERO, ONE - cz * cz))
    s, c = sincos_turns(u)
    hx, hy, hz = ax * (ring * c + x), ay * (ring * s + y), cz + z
    scale = ONE / math.sqrt(max(hx * hx + hy * hy + hz * hz, _TINY))
    return hx * scale, hy * scale, max(hz * scale, ZERO)


@njit
def reflection(i, o, ax, ay):  # type: ignore[no-untyped-def]
    """Reflection by microfacets that reflect all light.

    Parameters
    ----------
    i, o : tuple of float32
        Directions towards viewer and light, both above the surface.
    ax, ay : float32
        Alpha along x and y.

    Returns
    -------
    value : float32
        BRDF times cosine towards the light, sr^-1.
    pdf : float32
        With which mirroring at a `visible_normal` draws the direction, sr^-1.
    cosine : float32
        Between either direction and the microfacet's normal.
    """
    ix, iy, iz = i
    ox, oy, oz = o
    hx, hy, hz = ix + ox, iy + oy, iz + oz
    length2 = hx * hx + hy * hy + hz * hz
    scale = ONE / math.sqrt(max(length2, _TINY))
    hx, hy, hz = hx * scale, hy * scale, hz * scale
    seen, lit = smith_lambda(ix, iy, iz, ax, ay), smith_lambda(ox, oy, oz, ax, ay)
    common = distribution(hx, hy, hz, ax, ay) / max(F(4.0) * iz, _TINY)
    return common / (ONE + seen + lit), common / (ONE + seen), ix * hx + iy * hy + iz * hz


@njit
def refraction(i, o, ax, ay, eta):  # type: ignore[no-untyped-def]
    """Refraction by microfacets that let all light pass (Walter et al. 2007).

    Radiance is not scaled by the square of the IORs: what a path gains as it enters it loses as it leaves.

    Parameters
    ----------
    i, o : tuple of float32
        Directions towards the viewer, above the surface, and towards the light, below it.
    ax, ay : float32
        Alpha along x and y.
    eta : float32

    Returns
    -------
    value : float32
        BTDF times cosine towards the light, sr^-1; 0 where no microfacet refracts the one into the other.
    pdf : float32
        With which refraction at a `visible_normal` draws the direction, sr^-1.
    cosine : float32
        Between the direction towards the viewer and the microfacet's normal.
    """
    ix, iy, iz = i
    ox, oy, oz = o
    hx, hy, hz = ix + eta * ox, iy + eta * oy, iz + eta * oz
    length2 = hx * hx + hy * hy + hz * hz
    scale = ONE / math.sqrt(max(length2, _TINY))
    scale = scale if hz >= ZERO else -scale
    hx, hy, hz = hx * scale, hy * scale, hz * scale
    ih, oh = ix * hx + iy * hy + iz * hz, ox * hx + oy * hy + oz * hz
    if not (ih > ZERO and oh < ZERO):
        return ZERO, ZERO, ZERO
    seen, lit = smith_lambda(ix, iy, iz, ax, ay), smith_lambda(ox, oy, oz, ax, ay)
    jacobian = eta * eta * -oh / max(length2, _TINY)
    common = distribution(hx, hy, hz, ax, ay) * ih * jacobian / max(iz, _TINY)
    return common / (ONE + seen + lit), common / (ONE + seen), ih
