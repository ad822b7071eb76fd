"""Native functions of a device: reading at addresses, and rays that meet triangles by Warp's BVH."""

from __future__ import annotations

from typing import Any, NamedTuple

from ...compute.warp.translate import Native
from ...compute.warp.types import Record
from .. import memory
from ..integrator import intersect
from ..scene import interaction
from ..scene.ray import Hit


class MeshTracer(NamedTuple):
    """``scene.interaction.Tracer`` of a device.

    Attributes
    ----------
    meshes : int
        Address of (kinds, 3) int64: Warp's mesh of triangles in world space, the rays that meet them, and the first of
        its rows in `faces`.
    kinds : int
        Of masks.
    faces : int
        Address of (k, 2) int32, the scene's face and instance of each triangle; 0: they are the scene's faces.
    corners : int
        Address of (m, 3, 3) float32, corners of the scene's faces; read where a shape has instances.
    """

    meshes: int
    kinds: int
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
    along = wp.vec3(dx, dy, dz)
    start = wp.vec3(ox, oy, oz) + tnear * along
    t = wp.float32(tfar)
    face = wp.int32(-1)
    instance = wp.int32(-1)
    u = wp.float32(0.0)
    v = wp.float32(0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    for k in range(wp.int32(tracer.kinds)):
        row = wp.int64(3 * k)
        if (wp.int32(load_int64(tracer.meshes, row + wp.int64(1))) & mask) != 0:
            query = wp.mesh_query_ray(wp.uint64(load_int64(tracer.meshes, row)), start, along, t - tnear)
            if query.result:
                t = tnear + query.t
                face = query.face + wp.int32(load_int64(tracer.meshes, row + wp.int64(2)))
                # Warp's coordinates belong to the first and the second corner, Embree's to the second and the third.
                u = query.v
                v = 1.0 - query.u - query.v
                normal = query.normal
    if face >= 0 and tracer.faces != wp.int64(0):
        i = wp.int64(2) * wp.int64(face)
        face = load_int32(tracer.faces, i)
        instance = load_int32(tracer.faces, i + wp.int64(1))
        if instance >= 0:
            first = corner(tracer, face, 0)
            normal = wp.cross(corner(tracer, face, 1) - first, corner(tracer, face, 2) - first)
    return t, face, instance, u, v, normal[0], normal[1], normal[2]
"""

_SHADOWED = """
@wp.func
def shadowed(
    tracer: MeshTracer, ox: wp.float32, oy: wp.float32, oz: wp.float32, dx: wp.float32, dy: wp.float32,
    dz: wp.float32, tnear: wp.float32, tfar: wp.float32, mask: wp.int32,
):
    along = wp.vec3(dx, dy, dz)
    start = wp.vec3(ox, oy, oz) + tnear * along
    hit = wp.bool(False)
    for k in range(wp.int32(tracer.kinds)):
        row = wp.int64(3 * k)
        if not hit and (wp.int32(load_int64(tracer.meshes, row + wp.int64(1))) & mask) != 0:
            hit = wp.mesh_query_ray_anyhit(wp.uint64(load_int64(tracer.meshes, row)), start, along, tfar - tnear)
    return hit
"""

_HIT = Record(Hit, ("float32", "int32", "int32", "float32", "float32", "float32", "float32", "float32"))

#: What stands for functions that are not translated.
NATIVES: dict[Any, Any] = {
    memory.load_float: _load("load_float", "float32", "float"),
    memory.load_double: _load("load_double", "float64", "double"),
    memory.load_uint8: _load("load_uint8", "uint8", "unsigned char"),
    memory.load_int32: _load("load_int32", "int32", "int"),
    memory.load_uint32: _load("load_uint32", "uint32", "unsigned int"),
    memory.load_int64: _load("load_int64", "int64", "long long"),
    interaction.nearest.py_func: Native(
        _NEAREST, "nearest", _HIT, (MeshTracer,), (memory.load_float, memory.load_int32, memory.load_int64)
    ),
    interaction.shadowed.py_func: Native(_SHADOWED, "shadowed", "bool", (MeshTracer,), (memory.load_int64,)),
    # Rays meet meshes alone.
    intersect.passed.py_func: intersect.passed_meshes.py_func,
    intersect.meet.py_func: intersect.meet_meshes.py_func,
    intersect.put_hit.py_func: intersect.put_hit_meshes.py_func,
    intersect.surface_of.py_func: intersect.surface_of_meshes.py_func,
    intersect.put_start.py_func: intersect.put_start_meshes.py_func,
}
