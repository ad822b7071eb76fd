"""What the device has of its own: reading at addresses, and rays that meet triangles by Warp's tree."""

from __future__ import annotations

from typing import Any, NamedTuple

from ...device.translate import Native
from .. import memory
from ..shade import rays
from ..trace import surface


class MeshTracer(NamedTuple):
    """``trace.surface.Tracer`` of a device.

    Attributes
    ----------
    mesh : Warp's mesh of all triangles, world space; 0 when there is none
    masks : address of (k,) int32, which rays meet each triangle; 0: all do
    faces : address of (k, 2) int32, the scene's face and place of each triangle; 0: they are the scene's faces
    corners : address of (m, 3, 3) float32, corners of the scene's faces; read where a shape stands in places
    """

    mesh: int
    masks: int
    faces: int
    corners: int


def _load(name: str, kind: str, spelled: str) -> Native:
    source = f"""
@wp.func_native("return (({spelled} const*)address)[index];")
def {name}(address: wp.int64, index: wp.int64) -> wp.{kind}: ...
"""
    return Native(source, name, kind)


_NEAREST = """
@wp.func
def corner(tracer: MeshTracer, face: wp.int32, k: wp.int32):
    i = wp.int64(9) * wp.int64(face) + wp.int64(3 * k)
    return wp.vec3(
        load_float(tracer.corners, i), load_float(tracer.corners, i + wp.int64(1)),
        load_float(tracer.corners, i + wp.int64(2)),
    )


@wp.func
def nearest(
    tracer: MeshTracer, ox: wp.float32, oy: wp.float32, oz: wp.float32, dx: wp.float32, dy: wp.float32,
    dz: wp.float32, tnear: wp.float32, tfar: wp.float32, mask: wp.int32,
):
    origin, along = wp.vec3(ox, oy, oz), wp.vec3(dx, dy, dz)
    t = wp.float32(tnear)
    face = wp.int32(-1)
    place = wp.int32(-1)
    u = wp.float32(0.0)
    v = wp.float32(0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    while face < 0 and t < tfar and tracer.mesh != wp.int64(0):
        query = wp.mesh_query_ray(wp.uint64(tracer.mesh), origin + t * along, along, tfar - t)
        if not query.result:
            t = tfar
        else:
            t = t + query.t
            if tracer.masks == wp.int64(0):
                face = query.face
            else:
                if (load_int32(tracer.masks, wp.int64(query.face)) & mask) != 0:
                    face = query.face
            # Warp's coordinates belong to the first and the second corner, Embree's to the second and the third.
            u = query.v
            v = 1.0 - query.u - query.v
            normal = query.normal
            if face < 0:
                t = t * 1.000001 + 1.0e-7
    if face < 0:
        t = tfar
    if face >= 0 and tracer.faces != wp.int64(0):
        i = wp.int64(2) * wp.int64(face)
        face = load_int32(tracer.faces, i)
        place = load_int32(tracer.faces, i + wp.int64(1))
        if place >= 0:
            first = corner(tracer, face, 0)
            normal = wp.cross(corner(tracer, face, 1) - first, corner(tracer, face, 2) - first)
    return t, face, place, u, v, normal[0], normal[1], normal[2]
"""

_SHADOWED = """
@wp.func
def shadowed(
    tracer: MeshTracer, ox: wp.float32, oy: wp.float32, oz: wp.float32, dx: wp.float32, dy: wp.float32,
    dz: wp.float32, tnear: wp.float32, tfar: wp.float32, mask: wp.int32,
):
    if tracer.mesh == wp.int64(0):
        return wp.bool(False)
    if tracer.masks == wp.int64(0):
        origin, along = wp.vec3(ox, oy, oz), wp.vec3(dx, dy, dz)
        return wp.mesh_query_ray_anyhit(wp.uint64(tracer.mesh), origin + tnear * along, along, tfar - tnear)
    t, face, place, u, v, x, y, z = nearest(tracer, ox, oy, oz, dx, dy, dz, tnear, tfar, mask)
    return face >= 0
"""

_HIT = ("float32", "int32", "int32", "float32", "float32", "float32", "float32", "float32")

#: What stands for functions that are not translated.
NATIVES: dict[Any, Any] = {
    memory.load_float: _load("load_float", "float32", "float"),
    memory.load_double: _load("load_double", "float64", "double"),
    memory.load_int32: _load("load_int32", "int32", "int"),
    memory.load_uint32: _load("load_uint32", "uint32", "unsigned int"),
    memory.load_int64: _load("load_int64", "int64", "long long"),
    surface.nearest.py_func: Native(_NEAREST, "nearest", _HIT, (MeshTracer,), (memory.load_float, memory.load_int32)),
    surface.shadowed.py_func: Native(_SHADOWED, "shadowed", "bool", (MeshTracer,), (surface.nearest,)),
    # Rays meet meshes alone: `rays` has a function of each kind for them.
    **{
        getattr(rays, name): getattr(rays, f"_{name}")
        for name in ("passed", "meet", "put_hit", "surface_of", "put_start")
    },
}
