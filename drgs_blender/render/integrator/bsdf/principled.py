"""Blender's Principled BSDF and its pure BSDFs: from parameters of a material to lobes, layer below layer.

The layers and their weights are those of Cycles (``svm_node_closure_bsdf`` of Blender 5.0): sheen over coat over metal,
glass, the dielectric's reflection and what is below it. Each takes from all below it the largest channel of its
estimated albedo; that of the coat is the Fresnel reflectance of its smooth surface. The colour of the coat absorbs on
the way in.
"""

from __future__ import annotations

import math

from ....compute.jit import njit
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
    PASSED,
    REFRACTION,
    SHEET,
    SLOPE,
    SMOOTH,
    WEIGHT,
)
from .microfacet import fresnel, mean_fresnel, normal_reflectance
from .single_lobes import (
    add_diffuse,
    add_sheen,
    add_translucent,
    begin_lobe,
    cosine_to,
    frame_about,
    make_up,
    put_alphas,
    settle,
)

#: Columns of a material's parameters.
(
    COLOUR, ROUGHNESS, METALLIC, IOR, LEVEL, TINT, ANISOTROPY, ROTATION, COAT, COAT_ROUGHNESS, COAT_IOR, COAT_TINT,
    SHEEN_WEIGHT, SHEEN_ROUGHNESS, SHEEN_TINT, TRANSMISSION, DIFFUSE_ROUGHNESS, PART_WEIGHT,
) = STARTS  # fmt: skip
#: Kinds of materials, in the order of `material_rows.KINDS`.
_PRINCIPLED, _GLASS, _REFRACTION, _GLOSSY, _DIFFUSE, _TRANSLUCENT, _SHEEN = range(7)
_LEAST, _TINY = F(1e-5), F(1e-30)


@njit
def _add_glass(b, count, kind, weight, p, colour, frame, seen, multiscatter, tables):  # type: ignore[no-untyped-def]
    """Glass, what it only lets pass, or a sheet; `colour` tints what passes, `p` gives F0 its tint."""
    normal, tangent = frame
    view, side = seen
    k = begin_lobe(b, count, kind, weight, normal, tangent)
    ior = max(p[IOR], F(1e-5))
    eta = ONE / ior if side < ZERO and kind != SHEET else ior
    if abs(eta - ONE) < F(1e-4):
        eta = F(1.0001)
    b[k + ETA] = eta
    base = normal_reflectance(eta)
    for i in range(3):
        b[k + F0 + i] = min(base * p[TINT + i], ONE)
        b[k + PASSED + i] = colour[i]
    alpha = p[ROUGHNESS] * p[ROUGHNESS]
    b[k + AX] = b[k + AY] = alpha
    if alpha < SMOOTH:
        b[k + DELTA] = ONE
    elif multiscatter and kind == GLASS:
        make_up(b, k, cosine_to(normal, view), weight, tables)
    settle(b, k, view)
    return count + 1


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
    normal, specular, coated = normals
    wr, wg, wb = p[PART_WEIGHT], p[PART_WEIGHT + 1], p[PART_WEIGHT + 2]
    cr, cg, cb = p[COLOUR], p[COLOUR + 1], p[COLOUR + 2]
    tangent = frame_about(specular, along)
    if p[ROTATION] != ZERO:
        s, c = sincos_turns(p[ROTATION] - math.floor(p[ROTATION]))
        tx, ty, tz = tangent
        nx, ny, nz = specular
        tangent = c * tx + s * (ny * tz - nz * ty), c * ty + s * (nz * tx - nx * tz), c * tz + s * (nx * ty - ny * tx)
    frame = specular, tangent
    nv = cosine_to(specular, view)
    if kind in (_GLASS, _REFRACTION):
        shape = SHEET if thin else (GLASS if kind == _GLASS else REFRACTION)
        white = (ONE, ONE, ONE)
        tinted = (wr * cr, wg * cg, wb * cb)
        for i in range(3):
            p[TINT + i] = ONE
        return _add_glass(b, count, shape, tinted, p, white, frame, (view, side), multiscatter, tables)
    if kind == _GLOSSY:
        k = begin_lobe(b, count, MIRROR, (wr * cr, wg * cg, wb * cb), specular, tangent)
        put_alphas(b, k, p[ROUGHNESS], p[ANISOTROPY], True)
        b[k + ETA] = F(1.5)
        for i in range(3):
            b[k + F0 + i] = ONE
        if multiscatter:
            make_up(b, k, nv, (cr, cg, cb), tables)
        settle(b, k, view)
        return count + 1
    if kind == _DIFFUSE:
        return add_diffuse(b, count, (wr * cr, wg * cg, wb * cb), p[DIFFUSE_ROUGHNESS], (cr, cg, cb), normal, view)
    if kind == _TRANSLUCENT:
        return add_translucent(b, count, (wr * cr, wg * cg, wb * cb), normal)
    if kind == _SHEEN:
        count, _ = add_sheen(b, count, (wr * cr, wg * cg, wb * cb), p[SHEEN_ROUGHNESS], normal, view)
        return count
    # Metals and glass end at white, diffuse colours do not.
    hr, hg, hb = min(cr, ONE), min(cg, ONE), min(cb, ONE)
    if p[SHEEN_WEIGHT] > _LEAST:
        w = p[SHEEN_WEIGHT]
        tr, tg, tb = w * p[SHEEN_TINT], w * p[SHEEN_TINT + 1], w * p[SHEEN_TINT + 2]
        share = min(p[COAT], ONE)
        nx = normal[0] + share * (coated[0] - normal[0])
        ny = normal[1] + share * (coated[1] - normal[1])
        nz = normal[2] + share * (coated[2] - normal[2])
        length2 = nx * nx + ny * ny + nz * nz
        scale = ONE / math.sqrt(max(length2, _TINY))
        own = (nx * scale, ny * scale, nz * scale) if length2 > F(1e-12) else normal
        count, albedo = add_sheen(b, count, (tr * wr, tg * wg, tb * wb), p[SHEEN_ROUGHNESS], own, view)
        rest = min(max(ONE - albedo * max(tr, max(tg, tb)), ZERO), ONE)
        wr, wg, wb = wr * rest, wg * rest, wb * rest
    if p[COAT] > _LEAST:
        w = p[COAT]
        cosine = cosine_to(coated, view)
        eta = max(p[COAT_IOR], ONE)
        k = begin_lobe(b, count, MIRROR, (w * wr, w * wg, w * wb), coated, frame_about(coated, coated))
        put_alphas(b, k, p[COAT_ROUGHNESS], ZERO, False)
        b[k + ETA] = eta
        base = normal_reflectance(eta)
        b[k + F0] = b[k + F0 + 1] = b[k + F0 + 2] = base
        settle(b, k, view)
        count += 1
        reflected, _ = fresnel(cosine, eta)
        rest = min(max(ONE - w * reflected, ZERO), ONE)
        wr, wg, wb = wr * rest, wg * rest, wb * rest
        inverse = ONE / eta
        way = ONE / math.sqrt(max(ONE - inverse * inverse * (ONE - cosine * cosine), _TINY))
        wr *= ONE + w * (max(p[COAT_TINT], ZERO) ** way - ONE)
        wg *= ONE + w * (max(p[COAT_TINT + 1], ZERO) ** way - ONE)
        wb *= ONE + w * (max(p[COAT_TINT + 2], ZERO) ** way - ONE)
    metal = min(p[METALLIC], ONE)
    if metal > _LEAST:
        k = begin_lobe(b, count, METAL, (metal * wr, metal * wg, metal * wb), specular, tangent)
        put_alphas(b, k, p[ROUGHNESS], p[ANISOTROPY], False)
        edge = F((6.0 / 7.0) ** 5)
        base = (hr, hg, hb)
        mr = mg = mb = ZERO
        for i in range(3):
            f82 = min(max(p[TINT + i], ZERO), ONE)
            schlick = base[i] + (ONE - base[i]) * edge
            slope = schlick * F(7.0 / (6.0 / 7.0) ** 6) * (ONE - f82)
            b[k + F0 + i], b[k + SLOPE + i] = base[i], slope
            mean = min(max(base[i] + (ONE - base[i]) / F(21.0) - slope / F(126.0), ZERO), ONE)
            mr, mg, mb = (mean if i == 0 else mr), (mean if i == 1 else mg), (mean if i == 2 else mb)
        if multiscatter:
            make_up(b, k, nv, (mr, mg, mb), tables)
        settle(b, k, view)
        count += 1
        rest = ONE - metal if metal < F(1.0 - 1e-5) else ZERO
        wr, wg, wb = wr * rest, wg * rest, wb * rest
    glass = min(p[TRANSMISSION], ONE)
    if glass > _LEAST and wr + wg + wb > ZERO:
        through = (hr, hg, hb) if thin else (math.sqrt(hr), math.sqrt(hg), math.sqrt(hb))
        shape = SHEET if thin else GLASS
        own = (glass * wr, glass * wg, glass * wb)
        count = _add_glass(b, count, shape, own, p, through, frame, (view, side), multiscatter, tables)
        rest = ONE - glass if glass < F(1.0 - 1e-5) else ZERO
        wr, wg, wb = wr * rest, wg * rest, wb * rest
    if not wr + wg + wb > ZERO:
        return count
    eta = max(p[IOR], F(1e-5))
    base = normal_reflectance(eta)
    if p[LEVEL] != F(0.5):
        base = min(base * TWO * p[LEVEL], F(0.9999))
        root = math.sqrt(base)
        raised = (ONE + root) / (ONE - root)
        eta = ONE / raised if eta < ONE else raised
    if eta != ONE:
        k = begin_lobe(b, count, MIRROR, (wr, wg, wb), specular, tangent)
        put_alphas(b, k, p[ROUGHNESS], p[ANISOTROPY], False)
        b[k + ETA] = eta
        z = math.sqrt(abs((eta - ONE) / (eta + ONE)))
        rough = math.sqrt(math.sqrt(b[k + AX] * b[k + AY]))
        s = read_3d(tables.real, z, nv, rough)
        part = min(max((mean_fresnel(eta) - base) / max(ONE - base, _TINY), ZERO), ONE)
        fr, fg, fb = min(base * p[TINT], ONE), min(base * p[TINT + 1], ONE), min(base * p[TINT + 2], ONE)
        b[k + F0], b[k + F0 + 1], b[k + F0 + 2] = fr, fg, fb
        if multiscatter:
            make_up(b, k, nv, (fr + (ONE - fr) * part, fg + (ONE - fg) * part, fb + (ONE - fb) * part), tables)
        settle(b, k, view)
        count += 1
        ar = b[k + WEIGHT] / max(wr, _TINY) * (fr + (ONE - fr) * s)
        ag = b[k + WEIGHT + 1] / max(wg, _TINY) * (fg + (ONE - fg) * s)
        ab = b[k + WEIGHT + 2] / max(wb, _TINY) * (fb + (ONE - fb) * s)
        rest = min(max(ONE - max(ar, max(ag, ab)), ZERO), ONE)
        wr, wg, wb = wr * rest, wg * rest, wb * rest
    own = (wr * cr, wg * cg, wb * cb)
    return add_diffuse(b, count, own, p[DIFFUSE_ROUGHNESS], (cr, cg, cb), normal, view)
