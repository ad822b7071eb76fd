"""What a ray meets, for compiled code: from a hit to normals, material, emission and object.

Two kinds of faces lie in one numbering. DR-GS faces come first; they carry materials at their vertices. Those of
ordinary meshes follow; they refer to materials, with textures. Faces of shapes that stand in several places are in
object space, and the hit says in which place it is.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..jit import njit
from .embree import blocked, trace
from .sampling import ONE, ZERO, F
from .textures import material_at

Array = np.ndarray

_TINY = F(1e-30)


class Tracer(NamedTuple):
    """How rays are cast; see `tree.TriangleBVH`.

    Attributes
    ----------
    intersect, occluded, scene : int64 addresses
    first_face : (groups,) int32, the first face of each group
    first_place : (groups,) int32, the first row of each group's places in ``Geometry.place_*``
    """

    intersect: int
    occluded: int
    scene: int
    first_face: Array
    first_place: Array


class Geometry(NamedTuple):
    """What lies behind the faces. Compiled code reads scalars of it only: a view of a row counts references.

    Attributes
    ----------
    shading_faces : (m, 3) int32, rows of ``shading`` (faces below ``vertex_faces``) or of ``normals`` (the others)
    shading : (k, 8) float32: unit normal, albedo, roughness, metallic
    normals : (r, 3) float32 unit; object space for faces of shapes in places
    face_object : (m,) int32, object of each face; not used for faces of shapes in places
    vertex_faces : how many faces carry materials at their vertices
    material : (m - vertex_faces,) int32, rows of ``materials``
    uvs : (m - vertex_faces, 3, 2) float32, or (0, 3, 2) when no mesh has any
    place_normal : (p, 3, 3) float32, matrices of normals
    place_object : (p,) int32
    materials : `textures.MaterialTable.addresses`
    """

    shading_faces: Array
    shading: Array
    normals: Array
    face_object: Array
    vertex_faces: int
    material: Array
    uvs: Array
    place_normal: Array
    place_object: Array
    materials: Any


@njit
def nearest(tracer, ox, oy, oz, dx, dy, dz, tnear, tfar, mask):  # type: ignore[no-untyped-def]
    """Closest hit of one ray: ``(t, face, place, u, v, gx, gy, gz)``, all float32 or int32.

    ``face`` is -1 when nothing is hit (t is then `tfar`), ``place`` -1 outside shapes in places. The hit is
    (1 - u - v) v0 + u v1 + v v2; g is for `surface_at`. `mask` (int32) tells what the ray meets, see `masks`.
    """
    t, group, primitive, instance, u, v, gx, gy, gz = trace(
        tracer.intersect, tracer.scene, ox, oy, oz, dx, dy, dz, tnear, tfar, mask
    )
    if group < 0:
        return t, np.int32(-1), np.int32(-1), u, v, gx, gy, gz
    face = np.int32(tracer.first_face[group] + primitive)
    place = np.int32(-1)
    if instance >= 0:
        place = np.int32(tracer.first_place[group] + instance)
    return t, face, place, u, v, gx, gy, gz


@njit
def shadowed(tracer, ox, oy, oz, dx, dy, dz, tnear, tfar, mask):  # type: ignore[no-untyped-def]
    """Whether anything lies on the ray that `mask` tells it to meet."""
    return blocked(tracer.occluded, tracer.scene, ox, oy, oz, dx, dy, dz, tnear, tfar, mask)


@njit
def _turned(place, x, y, z, matrices):  # type: ignore[no-untyped-def]
    """A normal of a shape as a unit vector in world space; (0, 0, 0) when it has no direction."""
    a = matrices[place, 0, 0] * x + matrices[place, 0, 1] * y + matrices[place, 0, 2] * z
    b = matrices[place, 1, 0] * x + matrices[place, 1, 1] * y + matrices[place, 1, 2] * z
    c = matrices[place, 2, 0] * x + matrices[place, 2, 1] * y + matrices[place, 2, 2] * z
    length = a * a + b * b + c * c
    scale = ONE / math.sqrt(length) if length > _TINY else ZERO
    return a * scale, b * scale, c * scale


@njit
def surface_at(face, place, u, v, gx, gy, gz, dx, dy, dz, geometry):  # type: ignore[no-untyped-def]
    """The surface at a hit of `nearest`, seen along the ray's direction d.

    Both sides are the same: the geometric normal faces the ray's origin, the shading normal follows it.

    Parameters
    ----------
    face, place, u, v, gx, gy, gz : of the hit; face >= 0
    dx, dy, dz : float32 direction of the ray
    geometry : Geometry

    Returns
    -------
    nx, ny, nz, gx, gy, gz, r, g, b, roughness, metallic, er, eg, eb : float32, object : int32
        Unit shading and geometric normal, albedo, emitted radiance; linear Rec.709.
    """
    faces = geometry.shading_faces
    i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
    w = ONE - u - v
    er = eg = eb = ZERO
    owner = geometry.face_object[face]
    if face < geometry.vertex_faces:
        rows = geometry.shading
        nx = w * rows[i, 0] + u * rows[j, 0] + v * rows[k, 0]
        ny = w * rows[i, 1] + u * rows[j, 1] + v * rows[k, 1]
        nz = w * rows[i, 2] + u * rows[j, 2] + v * rows[k, 2]
        r = w * rows[i, 3] + u * rows[j, 3] + v * rows[k, 3]
        g = w * rows[i, 4] + u * rows[j, 4] + v * rows[k, 4]
        b = w * rows[i, 5] + u * rows[j, 5] + v * rows[k, 5]
        roughness = w * rows[i, 6] + u * rows[j, 6] + v * rows[k, 6]
        metallic = w * rows[i, 7] + u * rows[j, 7] + v * rows[k, 7]
    else:
        own = face - geometry.vertex_faces
        s = t = ZERO
        if len(geometry.uvs) > 0:
            s = w * geometry.uvs[own, 0, 0] + u * geometry.uvs[own, 1, 0] + v * geometry.uvs[own, 2, 0]
            t = w * geometry.uvs[own, 0, 1] + u * geometry.uvs[own, 1, 1] + v * geometry.uvs[own, 2, 1]
        r, g, b, roughness, metallic, er, eg, eb = material_at(geometry.material[own], s, t, geometry.materials)
        n = geometry.normals
        if place < 0:
            nx = w * n[i, 0] + u * n[j, 0] + v * n[k, 0]
            ny = w * n[i, 1] + u * n[j, 1] + v * n[k, 1]
            nz = w * n[i, 2] + u * n[j, 2] + v * n[k, 2]
        else:
            # Each corner's normal is turned before they are blended, as it is for a mesh in a single place.
            matrices = geometry.place_normal
            ax, ay, az = _turned(place, n[i, 0], n[i, 1], n[i, 2], matrices)
            bx, by, bz = _turned(place, n[j, 0], n[j, 1], n[j, 2], matrices)
            cx, cy, cz = _turned(place, n[k, 0], n[k, 1], n[k, 2], matrices)
            nx, ny, nz = w * ax + u * bx + v * cx, w * ay + u * by + v * cy, w * az + u * bz + v * cz
            scale = ONE / max(abs(gx), max(abs(gy), max(abs(gz), _TINY)))
            gx, gy, gz = _turned(place, gx * scale, gy * scale, gz * scale, matrices)
            owner = geometry.place_object[place]
    scale = ONE / math.sqrt(max(gx * gx + gy * gy + gz * gz, _TINY))
    if gx * dx + gy * dy + gz * dz > ZERO:
        scale = -scale
    gx, gy, gz = gx * scale, gy * scale, gz * scale
    length = nx * nx + ny * ny + nz * nz
    if length > F(1e-12):
        scale = ONE / math.sqrt(length)
        if gx * nx + gy * ny + gz * nz < ZERO:
            scale = -scale
        nx, ny, nz = nx * scale, ny * scale, nz * scale
    else:
        nx, ny, nz = gx, gy, gz
    return nx, ny, nz, gx, gy, gz, r, g, b, roughness, metallic, er, eg, eb, owner


@njit
def position_at(face, place, u, v, vertices, faces, places):  # type: ignore[no-untyped-def]
    """World-space point of a hit, float64, blended from the corners: nearer to the face than origin + t direction.

    Parameters
    ----------
    vertices, faces : ``TriangleBVH``'s
    places : (p, 3, 4) float32, ``TraceScene.places``
    """
    w = 1.0 - np.float64(u) - np.float64(v)
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    x = w * vertices[a, 0] + u * vertices[b, 0] + v * vertices[c, 0]
    y = w * vertices[a, 1] + u * vertices[b, 1] + v * vertices[c, 1]
    z = w * vertices[a, 2] + u * vertices[b, 2] + v * vertices[c, 2]
    if place < 0:
        return x, y, z
    m = places
    return (
        m[place, 0, 0] * x + m[place, 0, 1] * y + m[place, 0, 2] * z + m[place, 0, 3],
        m[place, 1, 0] * x + m[place, 1, 1] * y + m[place, 1, 2] * z + m[place, 1, 3],
        m[place, 2, 0] * x + m[place, 2, 1] * y + m[place, 2, 2] * z + m[place, 2, 3],
    )
