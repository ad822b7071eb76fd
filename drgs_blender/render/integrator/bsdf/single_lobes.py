"""Single lobes: how records of lobes are filled, with what Cycles makes of their parameters."""

from __future__ import annotations

import math

from ....compute.jit import inlined, njit
from ...sampling import ONE, PI, TWO, ZERO, F, basis, luminance
from ..multiscatter import added_light, lobe_albedo, read_1d
from .albedo_tables import read_3d
from .lobes import (
    AX,
    AY,
    DIFFUSE,
    ETA,
    KIND,
    LOBE,
    NORMAL,
    OREN_NAYAR_A,
    OREN_NAYAR_B,
    PROBABILITY,
    REFRACTION,
    SCALE,
    SCATTERED_AGAIN,
    SHEEN,
    SHEEN_A,
    SHEEN_B,
    SMOOTH,
    TANGENT,
    TRANSLUCENT,
    TRANSMISSION_TINT,
    WEIGHT,
    fujii,
    reflectance,
)

_LEAST, _TINY = F(1e-5), F(1e-30)


@inlined
def brightness(r, g, b):  # type: ignore[no-untyped-def]
    """By which lobes are weighed for sampling: luminance and mean, so that no pure colour counts for nothing.

    Parameters
    ----------
    r, g, b : float32

    Returns
    -------
    float32
    """
    return F(0.5) * luminance(r, g, b) + F(1.0 / 6.0) * (r + g + b)


@njit
def begin_lobe(b, count, kind, weight, normal, tangent):  # type: ignore[no-untyped-def]
    """Start a lobe; returns where. There is room for all lobes of `MOST_PARTS` parts.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes; written.
    count : int64
        Lobes so far.
    kind : float32
        See `lobes`.
    weight : tuple of float32
        Linear Rec.709.
    normal, tangent : tuple of float32
        Unit, world.

    Returns
    -------
    int64
    """
    k = count * LOBE
    for i in range(LOBE):
        b[k + i] = ZERO
    b[k + KIND], b[k + SCALE], b[k + ETA] = kind, ONE, ONE
    for i in range(3):
        b[k + WEIGHT + i], b[k + NORMAL + i], b[k + TANGENT + i] = weight[i], normal[i], tangent[i]
        b[k + TRANSMISSION_TINT + i] = ONE
    return k


@njit
def frame_about(normal, along):  # type: ignore[no-untyped-def]
    """Tangent about a normal: the part of `along` across it; any where there is none.

    Parameters
    ----------
    normal, along : tuple of float32
        World.

    Returns
    -------
    x, y, z : float32
        Unit.
    """
    nx, ny, nz = normal
    x, y, z = along
    d = nx * x + ny * y + nz * z
    x, y, z = x - d * nx, y - d * ny, z - d * nz
    length2 = x * x + y * y + z * z
    if not (length2 > F(1e-12) and length2 < F(1e30)):
        x, y, z, _, _, _ = basis(nx, ny, nz)
        return x, y, z
    scale = ONE / math.sqrt(length2)
    return x * scale, y * scale, z * scale


@njit
def put_alphas(b, k, roughness, anisotropy, glossy):  # type: ignore[no-untyped-def]
    """Alphas of a mirror.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes; written.
    k : int64
        Where the lobe starts.
    roughness, anisotropy : float32
    glossy : bool
        Whether the anisotropy is that of the Glossy BSDF instead of the Principled one.
    """
    alpha = roughness * roughness
    if glossy:
        # Of the Glossy BSDF, whose anisotropy may be negative.
        a = min(max(anisotropy, F(-0.99)), F(0.99))
        if a < ZERO:
            ax, ay = alpha / (ONE + a), alpha * (ONE + a)
        else:
            ax, ay = alpha * (ONE - a), alpha / (ONE - a)
    else:
        aspect = math.sqrt(ONE - min(max(anisotropy, ZERO), ONE) * F(0.9))
        ax, ay = alpha / aspect, alpha * aspect
    b[k + AX], b[k + AY] = max(ax, SMOOTH), max(ay, SMOOTH)


@njit
def compensate_energy(b, k, mu, mean, tables):  # type: ignore[no-untyped-def]
    """Energy compensation of a mirror (Multiscatter GGX): scale its value by what is lost, colour its weight.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes; written.
    k : int64
        Where the lobe starts.
    mu : float32
        Cosine between its normal and the viewer.
    mean : tuple of float32
        Mean of Fresnel over the hemisphere, linear Rec.709; taken as 1 at most.
    tables : AlbedoTables
    """
    rough = math.sqrt(math.sqrt(b[k + AX] * b[k + AY]))
    e, average = lobe_albedo(mu, rough, tables), read_1d(tables.mean_energy, rough)
    missing = (ONE - e) / e
    b[k + SCALE] = ONE + missing
    for i in range(3):
        added = added_light(missing, min(max(mean[i], ZERO), ONE), average)
        b[k + WEIGHT + i] *= (ONE + added) / (ONE + missing)


@njit
def compensate_glass(b, k, mu, tables):  # type: ignore[no-untyped-def]
    """Energy compensation of glass (Multiscatter GGX): its value is scaled by what microfacets lose.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes; written.
    k : int64
        Where the lobe starts.
    mu : float32
        Cosine between its normal and the viewer.
    tables : AlbedoTables
    """
    eta = b[k + ETA]
    z = math.sqrt(abs((eta - ONE) / (eta + ONE)))
    e = read_3d(tables.glass[1 if eta < ONE else 0], z, mu, math.sqrt(math.sqrt(b[k + AX] * b[k + AY])))
    b[k + SCALE] = ONE / max(e, F(1e-3))


@njit
def cosine_to(normal, view):  # type: ignore[no-untyped-def]
    """Cosine between a normal and the viewer, within [0, 1].

    Parameters
    ----------
    normal, view : tuple of float32
        Unit, world.

    Returns
    -------
    float32
    """
    return min(max(normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2], ZERO), ONE)


@njit
def add_sheen(b, count, weight, roughness, normal, view):  # type: ignore[no-untyped-def]
    """Sheen (Zeltner et al. 2022, by the rational fits of S. Hill in MaterialX); returns lobes and its albedo.

    Parameters
    ----------
    b, count : array, int64
        Lobes.
    weight : tuple of float32
        Linear Rec.709.
    roughness : float32
    normal, view : tuple of float32
        Unit, world.

    Returns
    -------
    count : int64
    albedo : float32
        Without the weight.
    """
    x, y = cosine_to(normal, view), min(max(roughness, F(1e-3)), ONE)
    s = y * (F(0.0206607) + F(1.58491) * y) / (F(0.0379424) + y * (F(1.32227) + y))
    m = y * (F(-0.193854) + y * (F(-1.14885) + y * (F(1.7932) - F(0.95943) * y * y))) / (F(0.046391) + y)
    o = y * (F(0.000654023) + (F(-0.0207818) + F(0.119681) * y) * y) / (F(1.26264) + y * (F(-1.92021) + y))
    d = (x - m) / s
    albedo = min(max(math.exp(F(-0.5) * d * d) / (s * math.sqrt(TWO * PI)) + o, ZERO), ONE)
    a = (F(2.58126) * x + F(0.813703) * y) * y / (ONE + F(0.310327) * x * x + F(2.60994) * x * y)
    c = math.sqrt(ONE - x) * (y - ONE) * y * y * y
    c = c / (F(0.0000254053) + F(1.71228) * x - F(1.71506) * x * y + F(1.34174) * y * y)
    if not (a > _LEAST and albedo > _LEAST):
        return count, ZERO
    k = begin_lobe(b, count, SHEEN, (weight[0] * albedo, weight[1] * albedo, weight[2] * albedo), normal, normal)
    b[k + TANGENT], b[k + TANGENT + 1], b[k + TANGENT + 2] = frame_about(normal, view)
    b[k + SHEEN_A], b[k + SHEEN_B] = a, c
    b[k + PROBABILITY] = brightness(b[k + WEIGHT], b[k + WEIGHT + 1], b[k + WEIGHT + 2])
    return count + 1, albedo


@njit
def put_sampling_weight(b, k, view):  # type: ignore[no-untyped-def]
    """Estimate what a lobe of microfacets sends to the viewer: its weight for sampling.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes; written.
    k : int64
        Where the lobe starts.
    view : tuple of float32
        Unit, world.
    """
    c = b[k + NORMAL] * view[0] + b[k + NORMAL + 1] * view[1] + b[k + NORMAL + 2] * view[2]
    r, g, s, tr, tg, tb = reflectance(b, k, max(c, ZERO))
    if b[k + KIND] == REFRACTION:
        # Beyond the critical angle some microfacets still let light pass.
        tr = tg = tb = ONE
    b[k + PROBABILITY] = brightness(
        b[k + WEIGHT] * (r + tr), b[k + WEIGHT + 1] * (g + tg), b[k + WEIGHT + 2] * (s + tb)
    )
    if not c > ZERO:
        b[k + PROBABILITY] = ZERO


@njit
def add_diffuse(b, count, weight, roughness, colour, normal, view):  # type: ignore[no-untyped-def]
    """Lambert or, with a roughness, Oren-Nayar as improved by Fujii, with light that is scattered more than once.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes; written.
    count : int64
        Lobes so far.
    weight : tuple of float32
        Linear Rec.709, with the colour.
    roughness : float32
    colour : tuple of float32
        Linear Rec.709.
    normal, view : tuple of float32
        Unit, world.

    Returns
    -------
    int64
        Lobes.
    """
    k = begin_lobe(b, count, DIFFUSE, weight, normal, frame_about(normal, normal))
    sigma = min(max(roughness, ZERO), ONE)
    if sigma > _LEAST:
        a = ONE / (PI + sigma * (PI * F(0.5) - F(2.0 / 3.0)))
        slope = sigma * a
        mean = a * PI + (TWO * PI - F(5.6)) / F(3.0) * slope
        rest = ONE - (a * PI + slope * fujii(cosine_to(normal, view)))
        b[k + OREN_NAYAR_A], b[k + OREN_NAYAR_B] = a, slope
        for i in range(3):
            c = min(max(colour[i], ZERO), ONE)
            many = c * c * (mean / (ONE - mean)) / max(ONE - c * (ONE - mean), _TINY) / PI
            b[k + SCATTERED_AGAIN + i] = many * rest
    b[k + PROBABILITY] = brightness(weight[0], weight[1], weight[2])
    return count + 1


@njit
def add_translucent(b, count, weight, normal):  # type: ignore[no-untyped-def]
    """Diffuse light from the other side.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes; written.
    count : int64
        Lobes so far.
    weight : tuple of float32
        Linear Rec.709.
    normal : tuple of float32
        Unit, world.

    Returns
    -------
    int64
        Lobes.
    """
    k = begin_lobe(b, count, TRANSLUCENT, weight, normal, frame_about(normal, normal))
    b[k + PROBABILITY] = brightness(weight[0], weight[1], weight[2])
    return count + 1
