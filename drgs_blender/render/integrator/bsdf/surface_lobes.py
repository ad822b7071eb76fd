"""Lobes at a point of a surface, for compiled code: its parameters, its normals, which side it is seen from."""

from __future__ import annotations

import math

import numpy as np

from ....compute.jit import inlined, njit
from ...memory import load_float, load_int32, load_int64
from ...sampling import ONE, ZERO, F
from ...scene.detailed_normal import FRAME, FRAME_INTS, FRAME_TABLE, NORMALS, SLOTS, TURNS
from ...scene.interaction import place_of, tables_of
from ...scene.material_rows import ALONG, COAT_DETAILS, MULTISCATTER, OF_POINT, THIN
from ...scene.material_rows import KIND as ROW_KIND
from ...scene.tangents import WORDS, tangent_at
from ...scene.texture_lookup import blend, layer_at
from .. import brdf
from ..multiscatter import has_multiscatter
from .lobes import DIFFUSE, KIND, LOBE, METAL, MIRROR, SHEEN, normalise_probabilities
from .principled import add_material
from .surface_parameters import parameters_at, plain_parameters, put_base


@njit
def _corners(face, geometry):  # type: ignore[no-untyped-def]
    """Where the normals of a face's corners lie."""
    corner = 3 * np.int64(face)
    return (
        3 * np.int64(load_int32(geometry.shading_faces, corner)),
        3 * np.int64(load_int32(geometry.shading_faces, corner + 1)),
        3 * np.int64(load_int32(geometry.shading_faces, corner + 2)),
    )


@njit
def _turned(matrices, instance, x, y, z):  # type: ignore[no-untyped-def]
    m = 9 * np.int64(max(instance, np.int32(0)))
    return (
        load_float(matrices, m) * x + load_float(matrices, m + 1) * y + load_float(matrices, m + 2) * z,
        load_float(matrices, m + 3) * x + load_float(matrices, m + 4) * y + load_float(matrices, m + 5) * z,
        load_float(matrices, m + 6) * x + load_float(matrices, m + 7) * y + load_float(matrices, m + 8) * z,
    )


@njit
def side_of(place, facing, geometry):  # type: ignore[no-untyped-def]
    """From which side a face of an ordinary mesh is seen: 1 from outside, where its normals point, -1 from inside.

    Parameters
    ----------
    place : tuple
        Face, instance, and barycentric coordinates of its second and third corner.
    facing : tuple of float32
        Geometric normal towards the viewer, world.
    geometry : Geometry

    Returns
    -------
    float32
    """
    face, instance, u, v = place
    i, j, k = _corners(face, geometry)
    rows, w = geometry.normals, ONE - u - v
    x = blend(rows, i, j, k, w, u, v)
    y = blend(rows, i + 1, j + 1, k + 1, w, u, v)
    z = blend(rows, i + 2, j + 2, k + 2, w, u, v)
    if instance >= 0:
        x, y, z = _turned(geometry.instance_normal, instance, x, y, z)
    return ONE if facing[0] * x + facing[1] * y + facing[2] * z >= ZERO else -ONE


@njit
def _along(row, material, place, instance, rows, geometry):  # type: ignore[no-untyped-def]
    """Direction that highlights follow, world."""
    layer = np.int64(rows.ints[row, ALONG])
    if layer < 0:
        return ZERO, ZERO, ZERO
    m = geometry.materials
    layers, frames = load_int64(m, 6), load_int64(m, FRAME_TABLE)
    frame = FRAME_INTS * np.int64(load_int32(load_int64(m, 1), SLOTS * material + FRAME))
    if load_int64(layers, 2 * layer + 1) == WORDS:
        corners = _corners(place[2] + geometry.vertex_faces, geometry)
        x, y, z, _ = tangent_at(layer, corners, place, load_int64(frames, frame + NORMALS), layers)
    else:
        x, y, z, _ = layer_at(layer, place, layers)
    return _turned(load_int64(frames, frame + TURNS), instance, x, y, z)


@inlined
def _specular(normal, facing, view):  # type: ignore[no-untyped-def]
    return brdf.glossy_normal(
        normal[0], normal[1], normal[2], facing[0], facing[1], facing[2], view[0], view[1], view[2]
    )


@njit
def put_lobes(place, base, normals, facing, view, geometry, rows, tables, p, b):  # type: ignore[no-untyped-def]
    """The lobes at a point.

    Parameters
    ----------
    place : tuple
        Face, instance, and barycentric coordinates of its second and third corner; a face below 0 is of surfels.
    base : tuple of float32
        Albedo, roughness and metallic of a surface without further lobes, or of one that has those of its points.
    normals : tuple of tuple
        Shading normal, and that without normal and bump maps; unit, world.
    facing, view : tuple of float32
        Geometric normal towards the viewer; direction towards the viewer; unit, world.
    geometry : Geometry
    rows : MaterialRows
    tables : AlbedoTables
    p : (PARAMETER_COUNT,) float32 array
        Scratch memory.
    b : (MOST_LOBES * LOBE,) float32 array
        Written.

    Returns
    -------
    count : int64
        Lobes.
    passes : bool
        Whether light passes any.
    """
    face, instance, u, v = place
    normal, smooth = normals
    specular = _specular(normal, facing, view)
    count, own = np.int64(0), np.int64(face) - geometry.vertex_faces
    parts = 0
    material = np.int64(0)
    if face >= 0 and own >= 0:
        material = np.int64(load_int32(geometry.material, own))
        parts = rows.parts[material]
    if parts == 0:
        plain_parameters(base[0], base[1], base[2], base[3], base[4], rows, p)
        all_normals, nowhere = (normal, specular, specular), (ZERO, ZERO, ZERO)
        never = parts < 0  # of the types of the other call, so that one form of `add_material` is compiled
        flags = (never, has_multiscatter(face, geometry))
        count = add_material(b, count, p, np.int32(0), flags, all_normals, nowhere, view, ONE, tables)
        normalise_probabilities(b, count)
        return count, False
    side = side_of(place, facing, geometry)
    where, addresses = place_of(face, u, v, geometry), tables_of(geometry)
    for part in range(parts):
        row = np.int64(rows.first[material]) + part
        parameters_at(row, where, addresses, rows, p)
        if rows.ints[row, OF_POINT] == 1:
            put_base(base, p)
        coated = specular if rows.ints[row, COAT_DETAILS] == 1 else _specular(smooth, facing, view)
        flags = (rows.ints[row, THIN] == 1, rows.ints[row, MULTISCATTER] == 1)
        along = _along(row, material, where, instance, rows, geometry)
        kind = rows.ints[row, ROW_KIND]
        count = add_material(b, count, p, kind, flags, (normal, specular, coated), along, view, side, tables)
    normalise_probabilities(b, count)
    passes = False
    for lobe in range(count):
        kind = b[lobe * LOBE + KIND]
        if kind not in (DIFFUSE, SHEEN, METAL, MIRROR):
            passes = True
    return count, passes


@njit
def bump_shadow(normal, smooth, light):  # type: ignore[no-untyped-def]
    """Share of diffuse light where a map sees what the smooth surface turns away from (Estevez et al. 2019).

    Parameters
    ----------
    normal, smooth, light : tuple of float32
        Shading normal, that without maps, direction towards the light; unit, world.

    Returns
    -------
    float32
        1 where the two normals are one.
    """
    facing = normal[0] * smooth[0] + normal[1] * smooth[1] + normal[2] * smooth[2]
    if facing >= ONE:
        return ONE
    if not facing > ZERO:
        return ZERO
    up = max(smooth[0] * light[0] + smooth[1] * light[1] + smooth[2] * light[2], F(1e-6))
    tilt, up = facing * facing, min(up * up, ONE)
    a2 = min(F(0.125) * (ONE - tilt) / max(tilt, F(1e-6)), ONE)
    return F(2.0) / (ONE + math.sqrt(ONE + a2 * (ONE - up) / up))
