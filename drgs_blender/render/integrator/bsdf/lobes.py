"""Lobes of a BSDF: layout of their records, evaluation, pdfs and sampling, for compiled code.

A lobe is a row of `LOBE` float32: its kind, its weight, a shading frame, and the parameters of its kind. The BSDF is
the sum of its lobes. Where one is a delta distribution, it is drawn by chance alone and has no pdf.

Sources: Walter et al. 2007 (rough glass), Zeltner et al. 2022 (sheen: a linearly transformed cosine), Fujii's improved
Oren-Nayar with multiple scattering (diffuse), Kutz et al. 2021 (F82-tint metals), as Cycles of Blender 5.0 has them.
"""

from __future__ import annotations

import math

from ....compute.jit import inlined, njit
from ...sampling import INVERSE_PI, ONE, PI, TWO, ZERO, F, cosine_hemisphere
from ...scene.material_rows import MOST_PARTS
from .microfacet import fresnel, normal_reflectance, reflection, refraction, visible_normal

#: Columns of a lobe: kind, weight, alphas, eta, normal, tangent, F0, slope of F82, tint of transmission, scale of the
#: value (energy that microfacets would lose), probability (until `normalise_probabilities` a weight), if it is a delta.
KIND, WEIGHT, AX, AY, ETA, NORMAL, TANGENT, F0, SLOPE, TRANSMISSION_TINT = 0, 1, 4, 5, 6, 7, 10, 13, 16, 19
SCALE, PROBABILITY, DELTA, _OWN = 22, 23, 24, 25
#: Columns of diffuse lobes: A and B of Oren-Nayar, colour of what is scattered more than once.
OREN_NAYAR_A, OREN_NAYAR_B, SCATTERED_AGAIN = _OWN, _OWN + 1, _OWN + 2
#: Columns of sheen: the linear transformation of its cosine.
SHEEN_A, SHEEN_B = _OWN, _OWN + 1
LOBE = _OWN + 5
#: Most lobes of a surface: sheen, coat, metal, glass, dielectric and diffuse lobe of each part.
MOST_LOBES = 6 * MOST_PARTS
#: Kinds: diffuse light on this and on the other side, and that of fibres; of microfacets, reflection by F82-tint and by
#: the Fresnel equations, glass, its refraction alone, and a thin-walled dielectric.
DIFFUSE, TRANSLUCENT, SHEEN, METAL, MIRROR, GLASS, REFRACTION, THIN_DIELECTRIC = (F(k) for k in range(8))
#: GGX's alpha below this is a delta of glass; mirrors have at least this.
SMOOTH = F(1e-3)
#: Classes of light, see `shading_points`.
DIFFUSE_CLASS, GLOSSY_CLASS, TRANSMITTED_CLASS = 0, 1, 2
_TINY = F(1e-30)


@inlined
def _dot(b, k, x, y, z):  # type: ignore[no-untyped-def]
    return b[k] * x + b[k + 1] * y + b[k + 2] * z


@inlined
def local(b, k, x, y, z):  # type: ignore[no-untyped-def]
    """A world vector in the frame of the lobe at `k`: along its tangent, its bitangent, its normal.

    Parameters
    ----------
    b : float32 array
        Lobes.
    k : int64
        Where the lobe starts.
    x, y, z : float32

    Returns
    -------
    x, y, z : float32
    """
    nx, ny, nz = b[k + NORMAL], b[k + NORMAL + 1], b[k + NORMAL + 2]
    tx, ty, tz = b[k + TANGENT], b[k + TANGENT + 1], b[k + TANGENT + 2]
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    return tx * x + ty * y + tz * z, bx * x + by * y + bz * z, nx * x + ny * y + nz * z


@inlined
def _world(b, k, x, y, z):  # type: ignore[no-untyped-def]
    """The other way round."""
    nx, ny, nz = b[k + NORMAL], b[k + NORMAL + 1], b[k + NORMAL + 2]
    tx, ty, tz = b[k + TANGENT], b[k + TANGENT + 1], b[k + TANGENT + 2]
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    return x * tx + y * bx + z * nx, x * ty + y * by + z * ny, x * tz + y * bz + z * nz


@njit
def reflectance(b, k, cosine):  # type: ignore[no-untyped-def]
    """Fresnel reflectance of a microfacet of the lobe at `k`, and what it lets pass, both with their tints.

    Parameters
    ----------
    b : float32 array
        Lobes.
    k : int64
        Where the lobe starts.
    cosine : float32
        Between direction and microfacet's normal, in [0, 1].

    Returns
    -------
    rr, rg, rb, tr, tg, tb : float32
        Linear Rec.709.
    """
    kind = b[k + KIND]
    cosine = min(max(cosine, ZERO), ONE)
    if kind == METAL:
        m = ONE - cosine
        m5 = m * m
        m5 = m5 * m5 * m
        edge = cosine * m5 * m
        r = b[k + F0] + (ONE - b[k + F0]) * m5 - b[k + SLOPE] * edge
        g = b[k + F0 + 1] + (ONE - b[k + F0 + 1]) * m5 - b[k + SLOPE + 1] * edge
        c = b[k + F0 + 2] + (ONE - b[k + F0 + 2]) * m5 - b[k + SLOPE + 2] * edge
        return min(max(r, ZERO), ONE), min(max(g, ZERO), ONE), min(max(c, ZERO), ONE), ZERO, ZERO, ZERO
    real, _ = fresnel(cosine, b[k + ETA])
    if kind == REFRACTION:
        through = ONE if real < ONE else ZERO
        return ZERO, ZERO, ZERO, through, through, through
    base = normal_reflectance(b[k + ETA])
    s = min(max((real - base) / max(ONE - base, _TINY), ZERO), ONE)
    r, g, c = b[k + F0], b[k + F0 + 1], b[k + F0 + 2]
    r, g, c = r + (ONE - r) * s, g + (ONE - g) * s, c + (ONE - c) * s
    if kind == MIRROR:
        return r, g, c, ZERO, ZERO, ZERO
    tr, tg, tb = ONE - r, ONE - g, ONE - c
    if kind == THIN_DIELECTRIC:
        # All reflections between the two faces (PBRT 9.5.1).
        r, g, c = TWO * r / (ONE + r), TWO * g / (ONE + g), TWO * c / (ONE + c)
        tr, tg, tb = ONE - r, ONE - g, ONE - c
    return (
        r, g, c, tr * b[k + TRANSMISSION_TINT], tg * b[k + TRANSMISSION_TINT + 1], tb * b[k + TRANSMISSION_TINT + 2],
    )  # fmt: skip


@inlined
def _mirrored_share(rr, rg, rb, tr, tg, tb):  # type: ignore[no-untyped-def]
    """Probability of reflection."""
    r, t = rr + rg + rb, tr + tg + tb
    return r / (r + t) if r + t > ZERO else ONE


@njit
def fujii(cosine):  # type: ignore[no-untyped-def]
    """The function G of the directional albedo of the improved Oren-Nayar model.

    Parameters
    ----------
    cosine : float32

    Returns
    -------
    float32
    """
    two_thirds = F(2.0 / 3.0)
    if cosine < F(1e-6):
        return PI * F(0.5) - two_thirds - cosine
    sine = math.sqrt(max(ZERO, ONE - cosine * cosine))
    angle = math.acos(min(cosine, ONE))
    return sine * (angle - two_thirds - sine * cosine) + two_thirds * sine / cosine * (ONE - sine * sine * sine)


@njit
def _diffuse(b, k, vx, vy, vz, lx, ly, lz):  # type: ignore[no-untyped-def]
    """Value times cosine (RGB) and pdf of light on this side."""
    nl = _dot(b, k + NORMAL, lx, ly, lz)
    if not nl > ZERO:
        return ZERO, ZERO, ZERO, ZERO
    pdf = nl * INVERSE_PI
    slope = b[k + OREN_NAYAR_B]
    if slope == ZERO:
        return pdf, pdf, pdf, pdf
    base = b[k + OREN_NAYAR_A]
    nv = max(_dot(b, k + NORMAL, vx, vy, vz), ZERO)
    t = vx * lx + vy * ly + vz * lz - nl * nv
    t = t / (max(nl, nv) + _TINY) if t > ZERO else t
    single = base + slope * t
    rest = ONE - (base * PI + slope * fujii(nl))
    many = b[k + SCATTERED_AGAIN], b[k + SCATTERED_AGAIN + 1], b[k + SCATTERED_AGAIN + 2]
    return nl * (single + many[0] * rest), nl * (single + many[1] * rest), nl * (single + many[2] * rest), pdf


@njit
def _sheen(b, k, lx, ly, lz):  # type: ignore[no-untyped-def]
    """Value times cosine, and its pdf, which is the same."""
    x, y, z = local(b, k, lx, ly, lz)
    if not z > ZERO:
        return ZERO
    a, c = b[k + SHEEN_A], b[k + SHEEN_B]
    u, v = a * x + c * z, a * y
    length2 = u * u + v * v + z * z
    ratio = a / max(length2, _TINY)
    return INVERSE_PI * z * ratio * ratio


@njit
def _microfacets(b, k, i, o):  # type: ignore[no-untyped-def]
    """Value times cosine (RGB), pdf, and whether light passes, of a lobe of microfacets that is no delta."""
    kind, ax, ay = b[k + KIND], b[k + AX], b[k + AY]
    if not i[2] > ZERO or o[2] == ZERO:
        return ZERO, ZERO, ZERO, ZERO, False
    if o[2] > ZERO:
        if kind == REFRACTION:
            return ZERO, ZERO, ZERO, ZERO, False
        value, pdf, cosine = reflection(i, o, ax, ay)
        r, g, c, tr, tg, tb = reflectance(b, k, cosine)
        if kind in (GLASS, THIN_DIELECTRIC):
            pdf = pdf * _mirrored_share(r, g, c, tr, tg, tb)
        value = value * b[k + SCALE]
        return value * r, value * g, value * c, pdf, False
    if kind in (METAL, MIRROR):
        return ZERO, ZERO, ZERO, ZERO, True
    if kind == THIN_DIELECTRIC:
        value, pdf, cosine = reflection(i, (o[0], o[1], -o[2]), ax, ay)
    else:
        value, pdf, cosine = refraction(i, o, ax, ay, b[k + ETA])
    if not pdf > ZERO:
        return ZERO, ZERO, ZERO, ZERO, True
    r, g, c, tr, tg, tb = reflectance(b, k, cosine)
    value = value * b[k + SCALE]
    return value * tr, value * tg, value * tb, pdf * (ONE - _mirrored_share(r, g, c, tr, tg, tb)), True


@njit
def evaluate(b, count, view, light, facing, out):  # type: ignore[no-untyped-def]
    """All lobes but deltas: value times cosine by class of light, and the pdf of `sample`.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes.
    count : int64
        Number of lobes.
    view, light : tuple of float32
        Unit, world: towards the viewer; towards the light.
    facing : tuple of float32
        Geometric normal on the viewer's side: light counts on the same side of it as of the lobe's normal.
    out : (9,) float32 array
        Written: RGB of diffuse, glossy and transmitted light, sr^-1.

    Returns
    -------
    float32
        Pdf, sr^-1.
    """
    vx, vy, vz = view
    lx, ly, lz = light
    for c in range(9):
        out[c] = ZERO
    pdf = ZERO
    above = facing[0] * lx + facing[1] * ly + facing[2] * lz > ZERO
    for lobe in range(count):
        k = lobe * LOBE
        if b[k + DELTA] > ZERO:
            continue
        kind, place = b[k + KIND], 3 * DIFFUSE_CLASS
        passes = False
        if kind == DIFFUSE:
            r, g, c, own = _diffuse(b, k, vx, vy, vz, lx, ly, lz)
        elif kind == TRANSLUCENT:
            r = g = c = own = max(-_dot(b, k + NORMAL, lx, ly, lz), ZERO) * INVERSE_PI
            passes = True
        elif kind == SHEEN:
            r = g = c = own = _sheen(b, k, lx, ly, lz)
        else:
            r, g, c, own, passes = _microfacets(b, k, local(b, k, vx, vy, vz), local(b, k, lx, ly, lz))
            place = 3 * (TRANSMITTED_CLASS if passes else GLOSSY_CLASS)
        if above == passes or not own > ZERO:
            continue
        out[place] += b[k + WEIGHT] * r
        out[place + 1] += b[k + WEIGHT + 1] * g
        out[place + 2] += b[k + WEIGHT + 2] * c
        pdf += b[k + PROBABILITY] * own
    return pdf


@njit
def evaluate_below(b, count, view, light, share, out):  # type: ignore[no-untyped-def]
    """Add what lobes make of light below a face that is above their normal, a share of it of diffuse ones.

    Parameters
    ----------
    b, count, view, light, out : array, int64 or tuple
        As of `evaluate`; `sample` draws no such light.
    share : float32

    Returns
    -------
    float32
        Pdf that `evaluate` would give, sr^-1.
    """
    pdf = ZERO
    for lobe in range(count):
        k = lobe * LOBE
        kind, place, part = b[k + KIND], 3 * DIFFUSE_CLASS, share
        if kind == TRANSLUCENT or b[k + DELTA] > ZERO:
            continue
        if kind == DIFFUSE:
            r, g, c, own = _diffuse(b, k, view[0], view[1], view[2], light[0], light[1], light[2])
        elif kind == SHEEN:
            r = g = c = own = _sheen(b, k, light[0], light[1], light[2])
        else:
            r, g, c, own, passes = _microfacets(
                b, k, local(b, k, view[0], view[1], view[2]), local(b, k, light[0], light[1], light[2])
            )
            if passes:
                continue
            place, part = 3 * GLOSSY_CLASS, ONE
        if not own > ZERO:
            continue
        out[place] += part * b[k + WEIGHT] * r
        out[place + 1] += part * b[k + WEIGHT + 1] * g
        out[place + 2] += part * b[k + WEIGHT + 2] * c
        pdf += b[k + PROBABILITY] * own
    return pdf


@njit
def _draw(b, k, i, u0, u1, u2):  # type: ignore[no-untyped-def]
    """A direction of a lobe, in its frame; whether it passes, the cosine at the microfacet, its probability."""
    kind, ax, ay = b[k + KIND], b[k + AX], b[k + AY]
    if kind in (DIFFUSE, TRANSLUCENT):
        x, y, z = cosine_hemisphere(u0, u1)
        return x, y, (z if kind == DIFFUSE else -z), kind == TRANSLUCENT, ZERO, ONE
    if kind == SHEEN:
        x, y, z = cosine_hemisphere(u0, u1)
        a, c = b[k + SHEEN_A], b[k + SHEEN_B]
        x, y, z = x - z * c, y, z * a
        scale = ONE / math.sqrt(max(x * x + y * y + z * z, _TINY))
        return x * scale, y * scale, z * scale, False, ZERO, ONE
    ix, iy, iz = i
    hx, hy, hz = ZERO, ZERO, ONE
    if not b[k + DELTA] > ZERO:
        hx, hy, hz = visible_normal(u0, u1, ix, iy, iz, ax, ay)
    cosine = ix * hx + iy * hy + iz * hz
    share = ONE
    if kind == REFRACTION:
        share = ZERO
    elif kind in (GLASS, THIN_DIELECTRIC):
        r, g, c, tr, tg, tb = reflectance(b, k, cosine)
        share = _mirrored_share(r, g, c, tr, tg, tb)
    if u2 < share or kind == THIN_DIELECTRIC:
        twice = TWO * cosine
        x, y, z = twice * hx - ix, twice * hy - iy, twice * hz - iz
        if u2 < share:
            return x, y, z, False, cosine, share
        return x, y, -z, True, cosine, ONE - share
    _, t = fresnel(cosine, b[k + ETA])
    if not t > ZERO:
        return ZERO, ZERO, ONE, True, cosine, ONE  # reflected whole: no direction
    inverse = ONE / b[k + ETA]
    turn = inverse * cosine - t
    return turn * hx - inverse * ix, turn * hy - inverse * iy, turn * hz - inverse * iz, True, cosine, ONE - share


@njit
def sample(b, count, view, u0, u1, u2):  # type: ignore[no-untyped-def]
    """Draw a direction: a lobe by its probability, then a direction of that lobe.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes.
    count : int64
        Number of lobes.
    view : tuple of float32
        Unit, world.
    u0, u1, u2 : float32
        Random numbers in [0, 1).

    Returns
    -------
    x, y, z : float32
        Unit, world; for `evaluate`, unless the lobe is a delta.
    lobe : int64
        Where the lobe starts; -1: none.
    passes : bool
        Whether the lobe lets light through.
    r, g, b : float32
        Of a delta: value over probability, linear Rec.709.
    """
    chosen, rest = -1, u2
    for lobe in range(count):
        share = b[lobe * LOBE + PROBABILITY]
        if not share > ZERO:
            continue
        chosen = lobe * LOBE
        if rest < share:
            break
        rest = rest - share
    if chosen < 0:
        return ZERO, ZERO, ONE, -1, False, ZERO, ZERO, ZERO
    k = chosen
    share = b[k + PROBABILITY]
    rest = min(max(rest / share, ZERO), F(1.0 - 2.0**-24))
    i = local(b, k, view[0], view[1], view[2])
    kind = b[k + KIND]
    if kind >= METAL and not i[2] > ZERO:
        return ZERO, ZERO, ONE, -1, False, ZERO, ZERO, ZERO
    x, y, z, passes, cosine, part = _draw(b, k, i, u0, u1, rest)
    if (z < ZERO) != passes:
        return ZERO, ZERO, ONE, -1, False, ZERO, ZERO, ZERO
    x, y, z = _world(b, k, x, y, z)
    scale = ONE / math.sqrt(max(x * x + y * y + z * z, _TINY))
    r = g = c = ZERO
    if b[k + DELTA] > ZERO:
        rr, rg, rb, tr, tg, tb = reflectance(b, k, cosine)
        if passes:
            rr, rg, rb = tr, tg, tb
        weight = b[k + SCALE] / max(share * part, _TINY)
        r, g, c = b[k + WEIGHT] * rr * weight, b[k + WEIGHT + 1] * rg * weight, b[k + WEIGHT + 2] * rb * weight
    return x * scale, y * scale, z * scale, k, passes, r, g, c


@njit
def normalise_probabilities(b, count):  # type: ignore[no-untyped-def]
    """Turn the sampling weights in PROBABILITY into probabilities.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
    count : int64
    """
    total = ZERO
    for lobe in range(count):
        total += b[lobe * LOBE + PROBABILITY]
    scale = ONE / total if total > ZERO else ZERO
    for lobe in range(count):
        b[lobe * LOBE + PROBABILITY] *= scale
