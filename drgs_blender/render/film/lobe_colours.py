"""Colours of surfaces with more lobes than a diffuse and a glossy one: albedos of their lobes, summed by kind."""

from __future__ import annotations

import math

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ELEMENTS, over_range
from ..integrator.bsdf.albedo_tables import albedo_tables, read_3d
from ..integrator.bsdf.lobes import (
    AX,
    AY,
    ETA,
    F0,
    GLASS,
    KIND,
    LOBE,
    METAL,
    MOST_LOBES,
    NORMAL,
    REFRACTION,
    THIN_DIELECTRIC,
    WEIGHT,
    reflectance,
)  # fmt: skip
from ..integrator.bsdf.surface_lobes import put_lobes
from ..integrator.multiscatter import read_2d
from ..memory import load_int32
from ..sampling import ONE, TWO, ZERO
from ..scene.interaction import Geometry
from ..scene.material_rows import MULTISCATTER, PARAMETER_COUNT, MaterialRows
from ..shading_points import ShadingPoints

Array = np.ndarray


def put_lobe_colours(
    points: ShadingPoints, geometry: Geometry, rows: MaterialRows, out: tuple[Array, Array, Array]
) -> None:
    """Write the colours at points on such surfaces; others keep theirs.

    Diffuse are those of sheen and of translucent surfaces, too, as in Cycles.

    Parameters
    ----------
    points : ShadingPoints
    geometry : Geometry
    rows : MaterialRows
    out : tuple of (n, 3) float32 array
        Of diffuse, glossy and transmitting lobes, linear Rec.709.
    """
    if not len(points.face):
        return
    tables = albedo_tables(bool(rows.ints[:, MULTISCATTER].any()))
    where = points.face, points.instance, points.place
    over_range(_many, len(points), points.arrays, where, geometry, rows, tables, out, fewest=ELEMENTS)


@njit
def _albedo(b, k, view, tables):  # type: ignore[no-untyped-def]
    """Reflected and transmitted part of a lobe of microfacets.

    As in Cycles, reflection is that of all microfacets: along the normal alone a tint of 0 would reflect nothing, and
    passes that are divided by it would have no limit.
    """
    nx, ny, nz = b[k + NORMAL], b[k + NORMAL + 1], b[k + NORMAL + 2]
    cosine = max(nx * view[0] + ny * view[1] + nz * view[2], ZERO)
    kind, eta, r, g, c = b[k + KIND], b[k + ETA], b[k + F0], b[k + F0 + 1], b[k + F0 + 2]
    if kind == REFRACTION:
        # Beyond the critical angle some microfacets still let light pass.
        return ZERO, ZERO, ZERO, ONE, ONE, ONE
    roughness = math.sqrt(math.sqrt(b[k + AX] * b[k + AY]))
    if kind == METAL:
        s = read_2d(tables.schlick, cosine, roughness)
    else:
        s = read_3d(tables.real, math.sqrt(abs((eta - ONE) / (eta + ONE))), cosine, roughness)
    r, g, c = r + (ONE - r) * s, g + (ONE - g) * s, c + (ONE - c) * s
    if kind < GLASS:
        return r, g, c, ZERO, ZERO, ZERO
    if kind == THIN_DIELECTRIC:
        r, g, c = TWO * r / (ONE + r), TWO * g / (ONE + g), TWO * c / (ONE + c)
    ar, ag, ab, tr, tg, tb = reflectance(b, k, cosine)
    if eta < ONE:
        # The table knows no total internal reflection.
        r, g, c = max(r, ar), max(g, ag), max(c, ab)
    return r, g, c, tr, tg, tb


@njit
def _many(first, last, points, where, geometry, rows, tables, out):  # type: ignore[no-untyped-def]
    faces, instances, places = where
    diffuse, glossy, passed = out
    parameters, b = np.zeros(PARAMETER_COUNT, np.float32), np.zeros(MOST_LOBES * LOBE, np.float32)
    flat, shading, smooths, viewer, albedo = (
        points.geometric_normal, points.normal, points.smooth, points.viewer, points.albedo,
    )  # fmt: skip
    for i in range(first, last):
        own = np.int64(faces[i]) - geometry.vertex_faces
        if faces[i] < 0 or own < 0 or rows.parts[np.int64(load_int32(geometry.material, own))] == 0:
            continue
        place = faces[i], instances[i], places[i, 0], places[i, 1]
        base = albedo[i, 0], albedo[i, 1], albedo[i, 2], points.roughness[i], points.metallic[i]
        facing, view = (flat[i, 0], flat[i, 1], flat[i, 2]), (viewer[i, 0], viewer[i, 1], viewer[i, 2])
        normal = shading[i, 0], shading[i, 1], shading[i, 2]
        smooth = normal
        if len(smooths) > 0:
            ux, uy, uz = smooths[i, 0], smooths[i, 1], smooths[i, 2]
            if ux * ux + uy * uy + uz * uz > ZERO:
                smooth = ux, uy, uz
        count, _ = put_lobes(place, base, (normal, smooth), facing, view, geometry, rows, tables, parameters, b)
        for c in range(3):
            diffuse[i, c] = glossy[i, c] = passed[i, c] = ZERO
        for lobe in range(count):
            k = lobe * LOBE
            wr, wg, wb = b[k + WEIGHT], b[k + WEIGHT + 1], b[k + WEIGHT + 2]
            if b[k + KIND] < METAL:
                diffuse[i, 0] += wr
                diffuse[i, 1] += wg
                diffuse[i, 2] += wb
                continue
            r, g, s, tr, tg, tb = _albedo(b, k, view, tables)
            glossy[i, 0] += wr * r
            glossy[i, 1] += wg * g
            glossy[i, 2] += wb * s
            passed[i, 0] += wr * tr
            passed[i, 1] += wg * tg
            passed[i, 2] += wb * tb
