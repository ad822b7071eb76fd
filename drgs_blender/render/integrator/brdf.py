"""The BRDF, all there is of a BSDF here: GGX over Lambert, in two models, as scalar functions for compiled code.

``paper`` (0): Cook-Torrance GGX with height-correlated Smith and Schlick Fresnel, F0 = 0.04 (1 - m) + m a; diffuse
(1 - m) a / pi. ``principled`` (1): Blender's Principled BSDF (distribution GGX, IOR 1.5, no other lobe): a metallic
lobe with Schlick F0 = a, a dielectric lobe with exact Fresnel, and a diffuse lobe below the latter that gets what
Cycles' estimate of the dielectric albedo leaves. Sources: Heitz 2014 (Smith), Eto and Tokuyoshi 2023 (bounded VNDF
sampling), Cycles' closures of Blender 5.0 (layering).
"""

from __future__ import annotations

import functools
import math

import numpy as np

from ...compute.jit import inlined, njit
from ..sampling import HALF, INVERSE_PI, ONE, PI, TWO, ZERO, F, sincos_turns

Array = np.ndarray

PAPER, PRINCIPLED = 0, 1
SHADING_MODELS = {"paper": PAPER, "principled": PRINCIPLED}

_IOR = 1.5
_F0 = F(0.04)
#: Metallic from which a surface is a metal and nothing else.
_METAL = F(1.0 - 1e-5)
_NODES = 16


@inlined
def alpha_squared(roughness):  # type: ignore[no-untyped-def]
    """Square of GGX's alpha = max(roughness^2, 1e-3).

    Parameters
    ----------
    roughness : float32
        In [0, 1].

    Returns
    -------
    float32
    """
    alpha = max(roughness * roughness, F(1e-3))
    return alpha * alpha


@inlined
def fresnel_dielectric(c):  # type: ignore[no-untyped-def]
    """Unpolarised Fresnel reflectance of a dielectric of IOR 1.5 from outside (PBRT 9.3.5).

    Parameters
    ----------
    c : float32
        Cosine between direction and (half vector's) normal, in [0, 1].

    Returns
    -------
    float32
        In [0, 1].
    """
    eta2 = F(_IOR * _IOR)
    g = math.sqrt(eta2 - ONE + c * c)
    a = (g - c) / (g + c)
    b = (c * (g + c) - ONE) / (c * (g - c) + ONE)
    return HALF * a * a * (ONE + b * b)


@njit
def layer_albedo(roughness, nv, table):  # type: ignore[no-untyped-def]
    """Cycles' estimate of the dielectric lobe's directional albedo: bilinear in (n . v, roughness).

    Parameters
    ----------
    roughness : float32
        In [0, 1]; clamped.
    nv : float32
        Cosine between normal and viewer; clamped to [0, 1].
    table : (16, 16) float32 array
        `layer_table`.

    Returns
    -------
    float32
        Directional albedo in [0, 1].
    """
    last = F(_NODES - 1)
    x, y = min(max(roughness, ZERO), ONE) * last, min(max(nv, ZERO), ONE) * last
    i, j = min(np.int32(x), np.int32(_NODES - 2)), min(np.int32(y), np.int32(_NODES - 2))
    a, b = x - F(i), y - F(j)
    low = table[j, i] + a * (table[j, i + 1] - table[j, i])
    high = table[j + 1, i] + a * (table[j + 1, i + 1] - table[j + 1, i])
    return low + b * (high - low)


@njit
def diffuse_weight(roughness, metallic, nv, shading_model, table):  # type: ignore[no-untyped-def]
    """Weight of the diffuse lobe: the factor of albedo / pi in it.

    Parameters
    ----------
    roughness, metallic : float32
        In [0, 1].
    nv : float32
        Cosine between normal of the specular lobe and viewer.
    shading_model : int64
        PAPER or PRINCIPLED.
    table : (16, 16) float32 array
        `layer_table`.

    Returns
    -------
    float32
        In [0, 1].
    """
    # Metals interpolated over a triangle are 1 to rounding, above or below: none has a diffuse lobe.
    rest = ONE - metallic if metallic < _METAL else ZERO
    if shading_model == PAPER:
        return rest
    return rest * (ONE - layer_albedo(roughness, nv, table))


@inlined
def fresnel(vh, albedo, metal, dielectric, shading_model):  # type: ignore[no-untyped-def]
    """Fresnel reflectance of the specular lobes, dielectric and metallic together; metals end at white, as in Cycles.

    Parameters
    ----------
    vh : float32
        Cosine between viewer and half vector.
    albedo : tuple of float32
        Linear Rec.709; cut at 1.
    metal : tuple of float32
        Weight of the metal by channel: metallic, in [0, 1], or more of it (`multiscatter.lobe_weights`).
    dielectric : float32
        Weight of the dielectric, one minus metallic, or more of it.
    shading_model : int64
        PAPER or PRINCIPLED.

    Returns
    -------
    fr, fg, fb : float32
        Linear Rec.709; in [0, 1] where the weights add up to 1.
    """
    r, g, b = min(albedo[0], ONE), min(albedo[1], ONE), min(albedo[2], ONE)
    mr, mg, mb = metal
    x = max(ZERO, ONE - vh)
    s = x * x
    s = s * s * x
    if shading_model == PAPER:
        base = dielectric * _F0
        r, g, b = base + mr * r, base + mg * g, base + mb * b
        return r + (ONE - r) * s, g + (ONE - g) * s, b + (ONE - b) * s
    base = dielectric * fresnel_dielectric(vh)
    return (
        base + mr * (r + (ONE - r) * s),
        base + mg * (g + (ONE - g) * s),
        base + mb * (b + (ONE - b) * s),
    )


@njit
def glossy_normal(nx, ny, nz, gx, gy, gz, vx, vy, vz):  # type: ignore[no-untyped-def]
    """Shading normal of the specular lobe: turned until the mirror direction is just above the face.

    A smooth normal far from the geometric normal g would mirror the viewer v into the surface; Cycles turns it as far
    as needed (``ensure_valid_specular_reflection``), in the plane of both normals. All of unit length, g.v >= 0.

    Parameters
    ----------
    nx, ny, nz : float32
        Shading normal, unit, world.
    gx, gy, gz : float32
        Geometric normal, unit, world.
    vx, vy, vz : float32
        Direction towards the viewer, unit, world.

    Returns
    -------
    mx, my, mz : float32
        Unit, world.
    """
    nv = nx * vx + ny * vy + nz * vz
    gv = gx * vx + gy * vy + gz * vz
    ng = nx * gx + ny * gy + nz * gz
    least = min(F(0.9) * gv, F(0.01))
    if TWO * nv * ng - gv >= least or ng > F(0.999999):
        return nx, ny, nz
    tx, ty, tz = nx - ng * gx, ny - ng * gy, nz - ng * gz
    scale = ONE / math.sqrt(max(tx * tx + ty * ty + tz * tz, F(1e-30)))
    tx, ty, tz = tx * scale, ty * scale, tz * scale
    tv = tx * vx + ty * vy + tz * vz
    # With m = cos(a) g + sin(a) t, the mirror direction's height above the face is |(tv, gv)| cos(2 a - angle(tv, gv)).
    length = max(math.sqrt(tv * tv + gv * gv), F(1e-30))
    angle = HALF * (F(math.atan2(tv, gv)) + F(math.acos(min(ONE, least / length))))
    s, c = F(math.sin(angle)), F(math.cos(angle))
    return c * gx + s * tx, c * gy + s * ty, c * gz + s * tz


@inlined
def ggx(nl, nv, nh2, sin2, a2):  # type: ignore[no-untyped-def]
    """GGX's microfacet distribution D with height-correlated Smith masking-shadowing G (Heitz 2014; PBRT 9.6).

    The sine comes apart, because 1 - cos^2 loses the whole lobe to rounding when alpha is small.

    Parameters
    ----------
    nl, nv : float32
        Cosines of normal and light, of normal and viewer.
    nh2, sin2 : float32
        Squares of cosine and sine between normal and half vector.
    a2 : float32
        `alpha_squared`.

    Returns
    -------
    value : float32
        D G / (4 nl nv), sr^-1: the specular BRDF without Fresnel.
    d : float32
        D, sr^-1.
    """
    k = a2 * nh2 + sin2
    d = a2 / (PI * k * k)
    smith = nl * math.sqrt(a2 + (ONE - a2) * nv * nv) + nv * math.sqrt(a2 + (ONE - a2) * nl * nl)
    return d * HALF / smith, d


@inlined
def vndf_terms(nv, a2):  # type: ignore[no-untyped-def]
    """Terms of the bounded sampling of GGX's visible normals and of its pdf (Eto and Tokuyoshi 2023).

    Parameters
    ----------
    nv : float32
        Cosine between normal and viewer, >= 0.
    a2 : float32
        `alpha_squared`.

    Returns
    -------
    bound : float32
        k, the factor of the spherical cap's lower bound.
    norm : float32
        Factor that turns D into the pdf per solid angle of the reflected directions.
    """
    s = ONE + math.sqrt(max(ZERO, ONE - nv * nv))
    s2 = s * s
    bound = (ONE - a2) * s2 / (s2 + a2 * nv * nv)
    return bound, HALF / (bound * nv + math.sqrt(a2 + (ONE - a2) * nv * nv))


@inlined
def sample_vndf(u, v, ix, iy, iz, alpha, bound):  # type: ignore[no-untyped-def]
    """GGX importance sampling: the direction mirrored by a visible normal (VNDF; Eto and Tokuyoshi 2023).

    Parameters
    ----------
    u, v : float32
        Random numbers in [0, 1): azimuth (in turns), height.
    ix, iy, iz : float32
        Direction towards the viewer, unit, in the tangent frame (z is the normal); iz > 0.
    alpha : float32
        GGX's alpha, root of `alpha_squared`.
    bound : float32
        Of `vndf_terms`.

    Returns
    -------
    ox, oy, oz : float32
        Direction towards the light, unit, in the tangent frame; may point below the surface.
    """
    x, y = ix * alpha, iy * alpha
    scale = ONE / math.sqrt(x * x + y * y + iz * iz)
    x, y, z = x * scale, y * scale, iz * scale
    edge = bound * z
    oz = (ONE - v) * (ONE + edge) - edge
    ring = math.sqrt(max(ZERO, ONE - oz * oz))
    s, c = sincos_turns(u)
    hx, hy, hz = alpha * (x + ring * c), alpha * (y + ring * s), z + oz
    scale = ONE / math.sqrt(max(hx * hx + hy * hy + hz * hz, F(1e-30)))
    hx, hy, hz = hx * scale, hy * scale, hz * scale
    twice = TWO * (ix * hx + iy * hy + iz * hz)
    return twice * hx - ix, twice * hy - iy, twice * hz - iz


@inlined
def evaluate(angles, albedo, weights, a2, norm, shading_model):  # type: ignore[no-untyped-def]
    """Diffuse and specular (RGB each) BRDF values and the pdf of ``sample_vndf``; all without the cosine.

    Without branches, so that loops over it vectorise.

    Parameters
    ----------
    angles : tuple of float
        (nl, nv, vl, nh2, sin2): cosines of normal n, light l and view v, and squares of cosine and sine between the
        half vector and n. nl > 0; where nv <= 0 the specular lobe is black, as in Cycles.
    albedo : tuple of float
        (r, g, b), linear Rec.709.
    weights : tuple
        (kd, metal, dielectric): `diffuse_weight`, and the weights of `fresnel`.
    a2 : float32
        `alpha_squared`.
    norm : float32
        Of `vndf_terms`.
    shading_model : int64
        PAPER or PRINCIPLED.

    Returns
    -------
    qr, qg, qb, sr, sg, sb : float32
        Diffuse and specular BRDF, sr^-1, linear Rec.709.
    pdf : float32
        Of ``sample_vndf``, sr^-1.
    """
    nl, nv, vl, nh2, sin2 = angles
    r, g, b = albedo
    kd, metal, dielectric = weights
    k = kd * INVERSE_PI
    value, d = ggx(nl, nv, nh2, sin2, a2)
    value, d = value if nv > ZERO else ZERO, d if nv > ZERO else ZERO
    fr, fg, fb = fresnel(math.sqrt(max(ZERO, HALF + HALF * vl)), albedo, metal, dielectric, shading_model)
    return k * r, k * g, k * b, value * fr, value * fg, value * fb, d * norm


@functools.cache
def layer_table() -> Array:
    """(16, 16) float32, rows n . v, columns roughness: albedo of the dielectric layer as Cycles estimates it.

    Cycles tabulates s = mean over visible normals of (F - F0) / (1 - F0), where reflections below the horizon count as
    0, at 16 values each of roughness, cosine and z = F0^(1/4), and returns F0 + (1 - F0) s. For IOR 1.5, z lies between
    the sixth and the seventh value.
    """
    vh, above = _reflections()
    lower, part = divmod(0.04**0.25 * (_NODES - 1), 1.0)
    s = np.zeros(vh.shape[:2])
    for node, share in ((lower, 1 - part), (lower + 1, part)):
        f0 = (node / (_NODES - 1)) ** 4
        eta = (1 + math.sqrt(f0)) / (1 - math.sqrt(f0))
        g = np.sqrt(eta * eta - 1 + vh * vh)
        f = 0.5 * ((g - vh) / (g + vh)) ** 2 * (1 + ((vh * (g + vh) - 1) / (vh * (g - vh) + 1)) ** 2)
        s += share * np.where(above, (f - f0) / (1 - f0), 0.0).mean(axis=-1)
    return (0.04 + 0.96 * np.clip(s, 0, 1)).astype(np.float32)


@functools.cache
def schlick_table() -> Array:
    """(16, 16) float32, rows n . v, columns roughness: mean of Schlick's (1 - v . h)^5 over visible normals."""
    vh, above = _reflections()
    return np.where(above, np.maximum(0, 1 - vh) ** 5, 0.0).mean(axis=-1).astype(np.float32)


def _reflections() -> tuple[Array, Array]:
    """Cosines of viewer and visible normals, (16, 16, n) by n . v and roughness, and whether reflections stay above."""
    n = 2048
    i = np.arange(n)
    u = (i + 0.5) / n
    angle = 2 * np.pi * ((i * 0.6180339887498949) % 1.0)
    nodes = np.clip(np.arange(_NODES) / (_NODES - 1), 1e-4, 1.0)
    mu, rough = np.meshgrid(nodes, nodes, indexing="ij")
    alpha = (rough**2)[..., None]
    vx, vz = np.sqrt(1 - mu**2)[..., None], mu[..., None]
    # Visible normals by a uniform spherical cap (Dupuy and Benyoub 2023).
    length = np.sqrt((alpha * vx) ** 2 + vz**2)
    sx, sz = alpha * vx / length, vz / length
    z = (1 - u) * (1 + sz) - sz
    ring = np.sqrt(np.maximum(0, 1 - z * z))
    hx, hy, hz = alpha * (sx + ring * np.cos(angle)), alpha * ring * np.sin(angle), sz + z
    length = np.sqrt(hx**2 + hy**2 + hz**2)
    vh = (vx * hx + vz * hz) / length
    return vh, 2 * vh * hz / length - vz > 0
