"""Surface interactions, for compiled code: from a hit to shading normal, material, emission and object.

Two kinds of faces lie in one numbering. DR-GS faces come first; they carry materials at their vertices. Those of
ordinary meshes follow; they refer to materials, with textures. Faces of shapes that have instances are in object space,
and the hit names the instance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ..memory import load_float, load_int32, load_int64
from ..sampling import ONE, ZERO, F
from .detailed_normal import SLOTS, STEPS, detailed_normal
from .embree import blocked, trace
from .ray import Hit
from .texture_lookup import blend, emission_at, emits, material_at

_TINY = F(1e-30)


class Tracer(NamedTuple):
    """Ray tracer of the scene for compiled code; valid until the next update of the scene. All are int64.

    Attributes
    ----------
    intersect, occluded, scene : int
        Addresses, see `triangle_bvh.TriangleBVH`.
    first_face : int
        Address of (groups,) int32, the first face of each group.
    first_instance : int
        Address of (groups,) int32, the first row of each group's instances in ``Geometry.instance_*``.
    """

    intersect: int
    occluded: int
    scene: int
    first_face: int
    first_instance: int


class Geometry(NamedTuple):
    """Geometry and materials of the faces; valid until the next update of the scene. Addresses, save for two numbers.

    Attributes
    ----------
    shading_faces : int
        (m, 3) int32, rows of ``shading`` (faces below ``vertex_faces``) or of ``normals`` (the others).
    shading : int
        (k, 8) float32: unit normal, albedo, roughness, metallic.
    normals : int
        (r, 3) float32 unit; object space for faces of instances.
    face_object : int
        (m,) int32, object of each face; not used for faces of instances.
    vertex_faces : int
        How many faces carry materials at their vertices.
    material : int
        (m - vertex_faces,) int32, rows of ``materials``.
    uvs : int
        (m - vertex_faces, 3, 2) float32, or 0 when no mesh has any.
    instance_normal : int
        (p, 3, 3) float32, matrices of normals.
    instance_object : int
        (p,) int32.
    materials : int
        (12,) int64, ``mesh_materials.MeshMaterials.addresses``.
    terminators : int
        (4,) int64, addresses of `terminator`, or 0 where no object has an offset.
    """

    shading_faces: int
    shading: int
    normals: int
    face_object: int
    vertex_faces: int
    material: int
    uvs: int
    instance_normal: int
    instance_object: int
    materials: int
    terminators: int


@njit
def nearest(tracer, ray):  # type: ignore[no-untyped-def]
    """Closest hit of a ray among the meshes.

    Parameters
    ----------
    tracer : Tracer
        Or anything that has its fields.
    ray : Ray

    Returns
    -------
    Hit
    """
    t, group, face, instance, u, v, gx, gy, gz = trace(tracer.intersect, tracer.scene, ray)
    face, instance = numbered(tracer, group, face, instance)
    return Hit(t, face, instance, u, v, gx, gy, gz)


@njit
def numbered(tracer, group, face, instance):  # type: ignore[no-untyped-def]
    """Face and instance of a hit as the scene numbers them.

    Parameters
    ----------
    tracer : Tracer
        Or anything that has its fields.
    group, face, instance : int32
        As of `embree.trace`.

    Returns
    -------
    face, instance : int32
        -1 as they were: nothing is met, or no instance.
    """
    if group >= 0:
        face = np.int32(face + load_int32(tracer.first_face, group))
        if instance >= 0:
            instance = np.int32(instance + load_int32(tracer.first_instance, group))
    return face, instance


@njit
def shadowed(tracer, ray):  # type: ignore[no-untyped-def]
    """Whether a shadow `Ray` is blocked by anything that its mask includes.

    Parameters
    ----------
    tracer : Tracer
        Or anything that has its fields.
    ray : Ray

    Returns
    -------
    bool
    """
    return blocked(tracer.occluded, tracer.scene, ray)


@njit
def _turned(matrices, instance, x, y, z):  # type: ignore[no-untyped-def]
    """A normal of a shape as a unit vector in world space; (0, 0, 0) when it has no direction."""
    m = 9 * np.int64(instance)
    a = load_float(matrices, m) * x + load_float(matrices, m + 1) * y + load_float(matrices, m + 2) * z
    b = load_float(matrices, m + 3) * x + load_float(matrices, m + 4) * y + load_float(matrices, m + 5) * z
    c = load_float(matrices, m + 6) * x + load_float(matrices, m + 7) * y + load_float(matrices, m + 8) * z
    length = a * a + b * b + c * c
    scale = ONE / math.sqrt(length) if length > _TINY else ZERO
    return a * scale, b * scale, c * scale


@njit
def _normal_of_instance(normals, i, j, k, w, u, v, matrices, instance):  # type: ignore[no-untyped-def]
    """Each corner's normal is turned before they are blended, as it is for a mesh without instances."""
    ax, ay, az = _turned(
        matrices, instance, load_float(normals, i), load_float(normals, i + 1), load_float(normals, i + 2)
    )
    bx, by, bz = _turned(
        matrices, instance, load_float(normals, j), load_float(normals, j + 1), load_float(normals, j + 2)
    )
    cx, cy, cz = _turned(
        matrices, instance, load_float(normals, k), load_float(normals, k + 1), load_float(normals, k + 2)
    )
    return w * ax + u * bx + v * cx, w * ay + u * by + v * cy, w * az + u * bz + v * cz


@njit
def place_of(face, u, v, geometry):  # type: ignore[no-untyped-def]
    """A point of a mesh's face as `texture_lookup` takes it.

    Parameters
    ----------
    face : int32
        Of the scene.
    u, v : float32
        Barycentric coordinates of the second and third corner.
    geometry : Geometry

    Returns
    -------
    tuple
    """
    own = np.int64(face) - geometry.vertex_faces
    if geometry.uvs == 0:
        return ZERO, ZERO, own, u, v
    c, w = 6 * own, ONE - u - v
    s = blend(geometry.uvs, c, c + 2, c + 4, w, u, v)
    return s, blend(geometry.uvs, c + 1, c + 3, c + 5, w, u, v), own, u, v


@njit
def tables_of(geometry):  # type: ignore[no-untyped-def]
    """Addresses of the tables as `texture_lookup` takes them.

    Parameters
    ----------
    geometry : Geometry

    Returns
    -------
    tuple of int64
    """
    m = geometry.materials
    return (
        load_int64(m, 0), load_int64(m, 1), load_int64(m, 2), load_int64(m, 3), load_int64(m, 4), load_int64(m, 5),
        load_int64(m, 6),
    )  # fmt: skip


@njit
def emitted(face, u, v, geometry):  # type: ignore[no-untyped-def]
    """Radiance that a point of a face emits, on both sides; as `surface_at` has it.

    Parameters
    ----------
    face : int32
        Of the scene.
    u, v : float32
        Barycentric coordinates of the second and third corner.
    geometry : Geometry

    Returns
    -------
    er, eg, eb : float32
        Linear Rec.709.
    """
    if face < geometry.vertex_faces:
        return ZERO, ZERO, ZERO
    own = np.int64(face) - geometry.vertex_faces
    material, tables = load_int32(geometry.material, own), tables_of(geometry)
    if not emits(material, tables):
        return ZERO, ZERO, ZERO
    return emission_at(material, place_of(face, u, v, geometry), tables)


@njit
def surface_at(hit, direction, geometry):  # type: ignore[no-untyped-def]
    """The surface at a hit of `nearest`, seen along the ray's direction.

    Both sides are the same: the geometric normal faces the ray's origin, the shading normal follows it.

    Parameters
    ----------
    hit : Hit
        Of a face; `t` is not read.
    direction : tuple of float
        Of the ray, world, of any length.
    geometry : Geometry

    Returns
    -------
    nx, ny, nz, gx, gy, gz : float32
        Unit shading and geometric normal, world.
    r, g, b : float32
        Albedo, linear Rec.709.
    roughness, metallic : float32
        In [0, 1].
    er, eg, eb : float32
        Emitted radiance, linear Rec.709.
    ux, uy, uz : float32
        Unit shading normal without normal and bump maps, world.
    object : int32
    """
    _, face, instance, u, v, gx, gy, gz = hit
    dx, dy, dz = direction
    corner = 3 * np.int64(face)
    i = np.int64(load_int32(geometry.shading_faces, corner))
    j = np.int64(load_int32(geometry.shading_faces, corner + 1))
    k = np.int64(load_int32(geometry.shading_faces, corner + 2))
    w = ONE - u - v
    er = eg = eb = ZERO
    material = np.int32(-1)
    owner = load_int32(geometry.face_object, np.int64(face))
    if face < geometry.vertex_faces:
        rows = geometry.shading
        i, j, k = 8 * i, 8 * j, 8 * k
        nx = blend(rows, i, j, k, w, u, v)
        ny = blend(rows, i + 1, j + 1, k + 1, w, u, v)
        nz = blend(rows, i + 2, j + 2, k + 2, w, u, v)
        r = blend(rows, i + 3, j + 3, k + 3, w, u, v)
        g = blend(rows, i + 4, j + 4, k + 4, w, u, v)
        b = blend(rows, i + 5, j + 5, k + 5, w, u, v)
        roughness = blend(rows, i + 6, j + 6, k + 6, w, u, v)
        metallic = blend(rows, i + 7, j + 7, k + 7, w, u, v)
    else:
        place = place_of(face, u, v, geometry)
        material = load_int32(geometry.material, place[2])
        r, g, b, roughness, metallic, er, eg, eb = material_at(material, place, tables_of(geometry))
        rows = geometry.normals
        i, j, k = 3 * i, 3 * j, 3 * k
        if instance < 0:
            nx = blend(rows, i, j, k, w, u, v)
            ny = blend(rows, i + 1, j + 1, k + 1, w, u, v)
            nz = blend(rows, i + 2, j + 2, k + 2, w, u, v)
        else:
            nx, ny, nz = _normal_of_instance(rows, i, j, k, w, u, v, geometry.instance_normal, instance)
            scale = ONE / max(abs(gx), max(abs(gy), max(abs(gz), _TINY)))
            gx, gy, gz = _turned(geometry.instance_normal, instance, gx * scale, gy * scale, gz * scale)
            owner = load_int32(geometry.instance_object, np.int64(instance))
    scale = ONE / math.sqrt(max(gx * gx + gy * gy + gz * gz, _TINY))
    if gx * dx + gy * dy + gz * dz > ZERO:
        scale = -scale
    gx, gy, gz = gx * scale, gy * scale, gz * scale
    length = nx * nx + ny * ny + nz * nz
    side = ONE
    if length > F(1e-12):
        scale = ONE / math.sqrt(length)
        if gx * nx + gy * ny + gz * nz < ZERO:
            scale, side = -scale, -ONE
        nx, ny, nz = nx * scale, ny * scale, nz * scale
    else:
        nx, ny, nz = gx, gy, gz
    ux, uy, uz = nx, ny, nz
    if material >= 0:
        slots = load_int64(geometry.materials, 1)
        if load_int32(slots, SLOTS * np.int64(material) + STEPS) > 0:
            place = place_of(face, u, v, geometry)
            nx, ny, nz = detailed_normal(material, (i, j, k), place, instance, (ux, uy, uz), side, geometry)
    return nx, ny, nz, gx, gy, gz, r, g, b, roughness, metallic, er, eg, eb, ux, uy, uz, owner


@njit
def position_at(face, instance, u, v, vertices, faces, instances):  # type: ignore[no-untyped-def]
    """World-space point of a hit, float64, blended from the corners: nearer to the face than origin + t direction.

    Parameters
    ----------
    face, instance : int32
        As of `Hit`.
    u, v : float32
        Barycentric coordinates of the second and third corner.
    vertices, faces : array
        ``TriangleBVH``'s: (n, 3) float32, m, and (m, 3) int32.
    instances : (p, 3, 4) float32 array
        ``TraceScene.instances``.

    Returns
    -------
    x, y, z : float64
        World, m.
    """
    w = 1.0 - np.float64(u) - np.float64(v)
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    x = w * vertices[a, 0] + u * vertices[b, 0] + v * vertices[c, 0]
    y = w * vertices[a, 1] + u * vertices[b, 1] + v * vertices[c, 1]
    z = w * vertices[a, 2] + u * vertices[b, 2] + v * vertices[c, 2]
    if instance < 0:
        return x, y, z
    m = instances
    return (
        m[instance, 0, 0] * x + m[instance, 0, 1] * y + m[instance, 0, 2] * z + m[instance, 0, 3],
        m[instance, 1, 0] * x + m[instance, 1, 1] * y + m[instance, 1, 2] * z + m[instance, 1, 3],
        m[instance, 2, 0] * x + m[instance, 2, 1] * y + m[instance, 2, 2] * z + m[instance, 2, 3],
    )
