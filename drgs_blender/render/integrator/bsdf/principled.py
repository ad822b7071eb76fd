"""Blender's Principled BSDF and its pure BSDFs: from parameters of a material to lobes, layer below layer.

The layers and their weights are those of Cycles (``svm_node_closure_bsdf`` of Blender 5.0): sheen over coat over metal,
glass, the dielectric's reflection and what is below it. Each takes from all below it the largest channel of its
estimated albedo; that of the coat is the Fresnel reflectance of its smooth surface. The colour of the coat absorbs on
the way in. A function per layer adds its lobe and returns what weight is left for those below.
"""

from __future__ import annotations

import math

from ....compute.jit import inlined, njit
from ...sampling import ONE, TWO, ZERO, F, sincos_turns
from ...scene.material_rows import STARTS
from .albedo_tables import read_3d
from .lobes import (
    AX,
    AY,
    DELTA,
    ETA,
    F0,
    GLASS,
    METAL,
    MIRROR,
    REFRACTION,
    SLOPE,
    SMOOTH,
    THIN_DIELECTRIC,
    TRANSMISSION_TINT,
    WEIGHT,
)
from .microfacet import fresnel, mean_fresnel, normal_reflectance
from .single_lobes import (
    add_diffuse,
    add_sheen,
    add_translucent,
    begin_lobe,
    compensate_energy,
    compensate_glass,
    cosine_to,
    frame_about,
    put_alphas,
    put_sampling_weight,
)

#: Columns of a material's parameters.
(
    COLOUR, ROUGHNESS, METALLIC, IOR, LEVEL, TINT, ANISOTROPY, ROTATION, COAT, COAT_ROUGHNESS, COAT_IOR, COAT_TINT,
    SHEEN_WEIGHT, SHEEN_ROUGHNESS, SHEEN_TINT, TRANSMISSION, DIFFUSE_ROUGHNESS, PART_WEIGHT,
) = STARTS  # fmt: skip
#: Kinds of materials, in the order of `material_rows.KINDS`, behind Principled.
_GLASS, _REFRACTION, _GLOSSY, _DIFFUSE, _TRANSLUCENT, _SHEEN = range(1, 7)
_LEAST, _TINY = F(1e-5), F(1e-30)


@inlined
def _times(weight, factor):  # type: ignore[no-untyped-def]
    return weight[0] * factor, weight[1] * factor, weight[2] * factor


@inlined
def _product(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inlined
def _colour(p, start):  # type: ignore[no-untyped-def]
    return p[start], p[start + 1], p[start + 2]


@inlined
def _rest(share):  # type: ignore[no-untyped-def]
    """What a share leaves for the layers below; nothing where it is whole."""
    return ONE - share if share < F(1.0 - 1e-5) else ZERO


@njit
def _rotated(p, frame):  # type: ignore[no-untyped-def]
    """The tangent of a frame turned about its normal by the material's rotation."""
    (nx, ny, nz), (tx, ty, tz) = frame
    s, c = sincos_turns(p[ROTATION] - math.floor(p[ROTATION]))
    return c * tx + s * (ny * tz - nz * ty), c * ty + s * (nz * tx - nx * tz), c * tz + s * (nx * ty - ny * tx)


@njit
def _add_sheen_layer(b, count, weight, p, normal, coated, view):  # type: ignore[no-untyped-def]
    """Sheen, about the coat's normal as far as there is a coat."""
    share = min(p[COAT], ONE)
    nx = normal[0] + share * (coated[0] - normal[0])
    ny = normal[1] + share * (coated[1] - normal[1])
    nz = normal[2] + share * (coated[2] - normal[2])
    length2 = nx * nx + ny * ny + nz * nz
    scale = ONE / math.sqrt(max(length2, _TINY))
    own = (nx * scale, ny * scale, nz * scale) if length2 > F(1e-12) else normal
    tint = _times(_colour(p, SHEEN_TINT), p[SHEEN_WEIGHT])
    count, albedo = add_sheen(b, count, _product(tint, weight), p[SHEEN_ROUGHNESS], own, view)
    rest = min(max(ONE - albedo * max(tint[0], max(tint[1], tint[2])), ZERO), ONE)
    return count, _times(weight, rest)


@njit
def _add_coat(b, count, weight, p, coated, view):  # type: ignore[no-untyped-def]
    w, cosine, eta = p[COAT], cosine_to(coated, view), max(p[COAT_IOR], ONE)
    k = begin_lobe(b, count, MIRROR, _times(weight, w), coated, frame_about(coated, coated))
    put_alphas(b, k, p[COAT_ROUGHNESS], ZERO, False)
    b[k + ETA] = eta
    b[k + F0] = b[k + F0 + 1] = b[k + F0 + 2] = normal_reflectance(eta)
    put_sampling_weight(b, k, view)
    reflected, _ = fresnel(cosine, eta)
    r, g, c = _times(weight, min(max(ONE - w * reflected, ZERO), ONE))
    inverse = ONE / eta
    way = ONE / math.sqrt(max(ONE - inverse * inverse * (ONE - cosine * cosine), _TINY))
    r *= ONE + w * (max(p[COAT_TINT], ZERO) ** way - ONE)
    g *= ONE + w * (max(p[COAT_TINT + 1], ZERO) ** way - ONE)
    c *= ONE + w * (max(p[COAT_TINT + 2], ZERO) ** way - ONE)
    return count + 1, (r, g, c)


@inlined
def _f82(base, tint):  # type: ignore[no-untyped-def]
    """Slope of an F82-tint metal (Kutz et al. 2021), and the mean of its reflectance over the hemisphere."""
    schlick = base + (ONE - base) * F((6.0 / 7.0) ** 5)
    slope = schlick * F(7.0 / (6.0 / 7.0) ** 6) * (ONE - min(max(tint, ZERO), ONE))
    return slope, min(max(base + (ONE - base) / F(21.0) - slope / F(126.0), ZERO), ONE)


@njit
def _add_metal(b, count, weight, p, base, frame, view, multiscatter, tables):  # type: ignore[no-untyped-def]
    share = min(p[METALLIC], ONE)
    k = begin_lobe(b, count, METAL, _times(weight, share), frame[0], frame[1])
    put_alphas(b, k, p[ROUGHNESS], p[ANISOTROPY], False)
    b[k + F0], b[k + F0 + 1], b[k + F0 + 2] = base
    b[k + SLOPE], mr = _f82(base[0], p[TINT])
    b[k + SLOPE + 1], mg = _f82(base[1], p[TINT + 1])
    b[k + SLOPE + 2], mb = _f82(base[2], p[TINT + 2])
    if multiscatter:
        compensate_energy(b, k, cosine_to(frame[0], view), (mr, mg, mb), tables)
    put_sampling_weight(b, k, view)
    return count + 1, _times(weight, _rest(share))


@njit
def _add_glass(b, count, kind, weight, p, colour, frame, seen, multiscatter, tables):  # type: ignore[no-untyped-def]
    """Glass, thin-walled or not, or its refraction alone; `colour` tints what passes, `p` gives F0 its tint."""
    normal, tangent = frame
    view, side = seen
    k = begin_lobe(b, count, kind, weight, normal, tangent)
    ior = max(p[IOR], F(1e-5))
    eta = ONE / ior if side < ZERO and kind != THIN_DIELECTRIC else ior
    if abs(eta - ONE) < F(1e-4):
        eta = F(1.0001)
    b[k + ETA] = eta
    base = normal_reflectance(eta)
    for i in range(3):
        b[k + F0 + i] = min(base * p[TINT + i], ONE)
        b[k + TRANSMISSION_TINT + i] = colour[i]
    alpha = p[ROUGHNESS] * p[ROUGHNESS]
    b[k + AX] = b[k + AY] = alpha
    if alpha < SMOOTH:
        b[k + DELTA] = ONE
    elif multiscatter and kind == GLASS:
        compensate_glass(b, k, cosine_to(normal, view), tables)
    put_sampling_weight(b, k, view)
    return count + 1


@njit
def _add_glossy(b, count, weight, p, colour, frame, view, multiscatter, tables):  # type: ignore[no-untyped-def]
    """Microfacets that reflect all light, times a colour."""
    k = begin_lobe(b, count, MIRROR, _product(weight, colour), frame[0], frame[1])
    put_alphas(b, k, p[ROUGHNESS], p[ANISOTROPY], True)
    b[k + ETA] = F(1.5)
    b[k + F0] = b[k + F0 + 1] = b[k + F0 + 2] = ONE
    if multiscatter:
        compensate_energy(b, k, cosine_to(frame[0], view), colour, tables)
    put_sampling_weight(b, k, view)
    return count + 1


@njit
def _add_dielectric(b, count, weight, p, frame, view, multiscatter, tables):  # type: ignore[no-untyped-def]
    """The reflection of the surface of what is not metallic."""
    wr, wg, wb = weight
    eta = max(p[IOR], F(1e-5))
    base = normal_reflectance(eta)
    if p[LEVEL] != F(0.5):
        base = min(base * TWO * p[LEVEL], F(0.9999))
        root = math.sqrt(base)
        raised = (ONE + root) / (ONE - root)
        eta = ONE / raised if eta < ONE else raised
    if eta == ONE:
        return count, weight
    k = begin_lobe(b, count, MIRROR, weight, frame[0], frame[1])
    put_alphas(b, k, p[ROUGHNESS], p[ANISOTROPY], False)
    b[k + ETA] = eta
    cosine = cosine_to(frame[0], view)
    fr, fg, fb = min(base * p[TINT], ONE), min(base * p[TINT + 1], ONE), min(base * p[TINT + 2], ONE)
    b[k + F0], b[k + F0 + 1], b[k + F0 + 2] = fr, fg, fb
    if multiscatter:
        part = min(max((mean_fresnel(eta) - base) / max(ONE - base, _TINY), ZERO), ONE)
        mean = fr + (ONE - fr) * part, fg + (ONE - fg) * part, fb + (ONE - fb) * part
        compensate_energy(b, k, cosine, mean, tables)
    put_sampling_weight(b, k, view)
    z = math.sqrt(abs((eta - ONE) / (eta + ONE)))
    s = read_3d(tables.real, z, cosine, math.sqrt(math.sqrt(b[k + AX] * b[k + AY])))
    ar = b[k + WEIGHT] / max(wr, _TINY) * (fr + (ONE - fr) * s)
    ag = b[k + WEIGHT + 1] / max(wg, _TINY) * (fg + (ONE - fg) * s)
    ab = b[k + WEIGHT + 2] / max(wb, _TINY) * (fb + (ONE - fb) * s)
    return count + 1, _times(weight, min(max(ONE - max(ar, max(ag, ab)), ZERO), ONE))


@njit
def _add_principled(b, count, p, flags, normals, frame, view, side, tables):  # type: ignore[no-untyped-def]
    """All layers of the Principled BSDF."""
    thin, multiscatter = flags
    normal, _, coated = normals
    weight, colour = _colour(p, PART_WEIGHT), _colour(p, COLOUR)
    # Metals and glass end at white, diffuse colours do not.
    r, g, c = min(colour[0], ONE), min(colour[1], ONE), min(colour[2], ONE)
    if p[SHEEN_WEIGHT] > _LEAST:
        count, weight = _add_sheen_layer(b, count, weight, p, normal, coated, view)
    if p[COAT] > _LEAST:
        count, weight = _add_coat(b, count, weight, p, coated, view)
    if p[METALLIC] > _LEAST:
        count, weight = _add_metal(b, count, weight, p, (r, g, c), frame, view, multiscatter, tables)
    share = min(p[TRANSMISSION], ONE)
    if share > _LEAST and weight[0] + weight[1] + weight[2] > ZERO:
        through = (r, g, c) if thin else (math.sqrt(r), math.sqrt(g), math.sqrt(c))
        shape, own = THIN_DIELECTRIC if thin else GLASS, _times(weight, share)
        count = _add_glass(b, count, shape, own, p, through, frame, (view, side), multiscatter, tables)
        weight = _times(weight, _rest(share))
    if not weight[0] + weight[1] + weight[2] > ZERO:
        return count
    count, weight = _add_dielectric(b, count, weight, p, frame, view, multiscatter, tables)
    return add_diffuse(b, count, _product(weight, colour), p[DIFFUSE_ROUGHNESS], colour, normal, view)


@njit
def add_material(b, count, p, kind, flags, normals, along, view, side, tables):  # type: ignore[no-untyped-def]
    """Add the lobes of a material.

    Parameters
    ----------
    b : (MOST_LOBES * LOBE,) float32 array
        Lobes; added to.
    count : int64
        Lobes so far.
    p : (PARAMETER_COUNT,) float32 array
        Parameters, within their limits.
    kind : int64
        Of `KINDS`.
    flags : tuple of bool
        Whether it is thin-walled, and whether GGX is Multiscatter GGX.
    normals : tuple of tuple
        Shading normal of diffuse light, that of specular light, and that of the coat, unit, world.
    along : tuple of float32
        Direction that highlights follow, world; any length.
    view : tuple of float32
        Unit, world.
    side : float32
        1 where the viewer is outside, -1 where inside.
    tables : AlbedoTables

    Returns
    -------
    int64
        Lobes.
    """
    thin, multiscatter = flags
    normal, specular, _ = normals
    weight, colour = _colour(p, PART_WEIGHT), _colour(p, COLOUR)
    tinted = _product(weight, colour)
    tangent = frame_about(specular, along)
    if p[ROTATION] != ZERO:
        tangent = _rotated(p, (specular, tangent))
    frame = specular, tangent
    if kind in (_GLASS, _REFRACTION):
        shape, white = THIN_DIELECTRIC if thin else (GLASS if kind == _GLASS else REFRACTION), (ONE, ONE, ONE)
        p[TINT], p[TINT + 1], p[TINT + 2] = white
        return _add_glass(b, count, shape, tinted, p, white, frame, (view, side), multiscatter, tables)
    if kind == _GLOSSY:
        return _add_glossy(b, count, weight, p, colour, frame, view, multiscatter, tables)
    if kind == _DIFFUSE:
        return add_diffuse(b, count, tinted, p[DIFFUSE_ROUGHNESS], colour, normal, view)
    if kind == _TRANSLUCENT:
        return add_translucent(b, count, tinted, normal)
    if kind == _SHEEN:
        count, _ = add_sheen(b, count, tinted, p[SHEEN_ROUGHNESS], normal, view)
        return count
    return _add_principled(b, count, p, flags, normals, frame, view, side, tables)
