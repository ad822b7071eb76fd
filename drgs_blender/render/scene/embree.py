"""Ray casting with Embree, callable from compiled kernels.

Embree is the shared library inside the embreex wheel. Kernels call it through plain function addresses that arrive as
run-time integers, so compiled code can be cached on disk and still finds the library wherever it is loaded next time.
"""

from __future__ import annotations

from ...compute import jit  # first of all: it sets Numba up before anything imports Numba  # noqa: F401

# isort: split
import ctypes
import functools
import platform
from pathlib import Path
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ...core.errors import DeviceError
from .ray import Ray

_REMEDY = "Reinstall the engine's environment with embreex 4.4 or later"

# Constants of Embree 4's C interface (include/embree4/rtcore_*.h).
_VERSION_PROPERTY, _EIGHT_RAYS_PROPERTY, _RAY_MASK_PROPERTY = 0, 33, 64
GEOMETRY_TRIANGLE, GEOMETRY_INSTANCE_ARRAY = 0, 122
BUFFER_INDEX, BUFFER_VERTEX, BUFFER_TRANSFORM = 0, 1, 23
FORMAT_UINT3, FORMAT_FLOAT3, FORMAT_FLOAT3X4_ROW_MAJOR = 0x5003, 0x9003, 0x9134
QUALITY_LOW, QUALITY_REFIT = 0, 3
SCENE_DYNAMIC = 1
#: AVX2 at most: with AVX-512 a ray takes 2 to 10 % longer (AMD EPYC), and has other last digits than on other nodes.
_CONFIGURATION = b"max_isa=avx2" if platform.machine() in ("x86_64", "AMD64") else None


def _library_path() -> Path:
    import embreex.rtcore  # its own loader finds Embree's dependencies (TBB) first

    package = Path(embreex.rtcore.__file__).parent
    for folder, pattern in (
        (package.parent / "embreex.libs", "libembree4-*.so.4"),
        (package.parent / "embreex.libs", "embree4*.dll"),
        (package / ".dylibs", "libembree4*.dylib"),
    ):
        if found := sorted(folder.glob(pattern)):
            return found[0]
    raise DeviceError("Embree", f"no Embree library lies beside {package}", _REMEDY)


@functools.cache
def library() -> ctypes.CDLL:
    """Load Embree once.

    Raises
    ------
    DeviceError
        When embreex is missing or holds no library.
    """
    try:
        lib = ctypes.CDLL(str(_library_path()))
    except (ImportError, OSError) as error:
        raise DeviceError("Embree", f"cannot be loaded ({error})", _REMEDY) from error
    pointer, unsigned, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
    for name, result, arguments in (
        ("rtcNewDevice", pointer, [ctypes.c_char_p]),
        ("rtcReleaseDevice", None, [pointer]),
        ("rtcGetDeviceError", ctypes.c_int, [pointer]),
        ("rtcGetDeviceProperty", ctypes.c_ssize_t, [pointer, ctypes.c_int]),
        ("rtcNewScene", pointer, [pointer]),
        ("rtcReleaseScene", None, [pointer]),
        ("rtcSetSceneFlags", None, [pointer, ctypes.c_int]),
        ("rtcSetSceneBuildQuality", None, [pointer, ctypes.c_int]),
        ("rtcCommitScene", None, [pointer]),
        ("rtcGetSceneBounds", None, [pointer, pointer]),
        ("rtcNewGeometry", pointer, [pointer, ctypes.c_int]),
        ("rtcReleaseGeometry", None, [pointer]),
        ("rtcSetGeometryBuildQuality", None, [pointer, ctypes.c_int]),
        ("rtcSetSharedGeometryBuffer", None, [pointer, ctypes.c_int, unsigned, ctypes.c_int, pointer] + [size] * 3),
        ("rtcUpdateGeometryBuffer", None, [pointer, ctypes.c_int, unsigned]),
        ("rtcSetGeometryMask", None, [pointer, unsigned]),
        ("rtcSetGeometryInstancedScene", None, [pointer, pointer]),
        ("rtcCommitGeometry", None, [pointer]),
        ("rtcAttachGeometryByID", None, [pointer, pointer, unsigned]),
        ("rtcDetachGeometry", None, [pointer, unsigned]),
        ("rtcIntersect1", None, [pointer] * 3),
        ("rtcIntersect8", None, [pointer] * 4),
        ("rtcOccluded1", None, [pointer] * 3),
    ):
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    return lib


@functools.cache
def device() -> int:
    """The one Embree device of this process, which all scenes share and nobody releases.

    Raises
    ------
    DeviceError
        When Embree refuses to start, has another version than 4.4 or a later 4.x, or was built without ray masks.
    """
    lib = library()
    made = lib.rtcNewDevice(_CONFIGURATION)
    if not made:
        raise DeviceError("Embree", f"refuses to start (error {lib.rtcGetDeviceError(None)})", _REMEDY)
    version = lib.rtcGetDeviceProperty(made, _VERSION_PROPERTY)
    if not 40400 <= version < 50000:
        raise DeviceError("Embree", f"has version {version / 10000:.4f}, expected 4.4", _REMEDY)
    if not lib.rtcGetDeviceProperty(made, _RAY_MASK_PROPERTY):
        raise DeviceError("Embree", "was built without ray masks", _REMEDY)
    return int(made)


@functools.cache
def packet_address() -> int:
    """Address of rtcIntersect8 for `trace_packet`; 0 where Embree does not trace eight rays at a time."""
    return address(library().rtcIntersect8) if library().rtcGetDeviceProperty(device(), _EIGHT_RAYS_PROPERTY) else 0


def address(function: Any) -> int:
    """Address of a function of `library` in this process."""
    return ctypes.cast(function, ctypes.c_void_p).value or 0


# RTCRayHit as 24 words: org 0-2, tnear 3, dir 4-6, time 7, tfar 8, mask 9, id 10, flags 11,
# Ng 12-14, u 15, v 16, primID 17, geomID 18, instID 19, instPrimID 20 (new in 4.4), padding to 16 bytes.
# Embree writes instPrimID on every hit: in a shorter structure it overwrites whatever lies behind on the stack.
_WORDS = 24
_TFAR, _MASK, _NORMAL, _U, _V = 8, 9, 12, 15, 16
_PRIMITIVE, _GEOMETRY, _INSTANCE, _INSTANCE_PRIMITIVE = 17, 18, 19, 20


def _emit_call(builder: Any, arguments: Any, words: int) -> Any:
    """Emit: fill a ray on the stack, call Embree at the given address; returns a loader of words by type."""
    word, single, pointer = ir.IntType(32), ir.FloatType(), ir.IntType(8).as_pointer()
    address, scene, ray = arguments
    memory = cgutils.alloca_once(builder, ir.ArrayType(word, words))
    memory.align = 64

    def slot(index: int, kind: Any) -> Any:
        place = builder.gep(memory, [ir.Constant(word, 0), ir.Constant(word, index)])
        return builder.bitcast(place, kind.as_pointer())

    origin, direction, tnear, tfar, mask = cgutils.unpack_tuple(builder, ray)
    (ox, oy, oz), (dx, dy, dz) = cgutils.unpack_tuple(builder, origin), cgutils.unpack_tuple(builder, direction)
    for index, value in enumerate((ox, oy, oz, tnear, dx, dy, dz, ir.Constant(single, 0.0), tfar)):
        builder.store(value, slot(index, single))
    builder.store(mask, slot(_MASK, word))
    for index in (10, 11):
        builder.store(ir.Constant(word, 0), slot(index, word))
    for index in (_PRIMITIVE, _GEOMETRY, _INSTANCE):
        if index < words:
            builder.store(ir.Constant(word, -1), slot(index, word))
    kind = ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer]).as_pointer()
    builder.call(
        builder.inttoptr(address, kind),
        [builder.inttoptr(scene, pointer), builder.bitcast(memory, pointer), ir.Constant(pointer, None)],
    )
    return lambda index, kind: builder.load(slot(index, kind))


_VECTOR = types.UniTuple(types.float32, 3)
_RAY = types.NamedTuple((_VECTOR, _VECTOR, types.float32, types.float32, types.int32), Ray)
_ARGUMENTS = (types.int64, types.int64, _RAY)
_TRACED = types.Tuple((types.float32,) + (types.int32,) * 3 + (types.float32,) * 5)


@intrinsic
def trace(typing, address, scene, ray):  # type: ignore[no-untyped-def]
    """Closest hit of one ray, for compiled code; the ray meets groups that have one of its mask's bits.

    Parameters
    ----------
    address, scene : int64
        ``TriangleBVH.intersect_address`` and ``TriangleBVH.scene``.
    ray : Ray
        Its numbers must be of exactly the types that `Ray` states.

    Returns
    -------
    t : float32
        Distance in lengths of the direction; `tfar` when nothing is hit.
    group : int32
        -1 when nothing is hit.
    primitive : int32
        Face, from the group's first one on.
    instance : int32
        Number among the group's instances; -1 for a group without instances, in world space.
    u, v : float32
        Barycentric coordinates: the hit is (1 - u - v) v0 + u v1 + v v2.
    gx, gy, gz : float32
        Geometric normal (v1 - v0) x (v2 - v0), **not** of unit length, before the instance's matrix.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        load = _emit_call(builder, arguments, _WORDS)
        word, single = ir.IntType(32), ir.FloatType()
        none = ir.Constant(word, -1)
        owner = load(_INSTANCE, word)
        instanced = builder.icmp_signed("!=", owner, none)
        group = builder.select(instanced, owner, load(_GEOMETRY, word))
        # Embree leaves the place unwritten for hits without instance.
        place = builder.select(instanced, load(_INSTANCE_PRIMITIVE, word), none)
        values = [load(_TFAR, single), group, load(_PRIMITIVE, word), place]
        values += [load(i, single) for i in (_U, _V, _NORMAL, _NORMAL + 1, _NORMAL + 2)]
        return context.make_tuple(builder, signature.return_type, values)

    return _TRACED(*_ARGUMENTS), codegen


@intrinsic
def blocked(typing, address, scene, ray):  # type: ignore[no-untyped-def]
    """Shadow ray: whether anything that has a bit of the ray's mask lies on it; see `trace`.

    Parameters
    ----------
    address, scene : int64
        ``TriangleBVH.occluded_address`` and ``TriangleBVH.scene``.
    ray : Ray

    Returns
    -------
    bool
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        load = _emit_call(builder, arguments, 12)
        # Embree sets tfar to -inf when the ray is blocked.
        return builder.fcmp_ordered("<", load(_TFAR, ir.FloatType()), ir.Constant(ir.FloatType(), 0.0))

    return types.boolean(*_ARGUMENTS), codegen


#: Rays of a packet. Words of its memory: RTCRayHit8, whose fields are those of RTCRayHit up to instPrimID, and for
#: each ray whether it counts.
PACKET = 8
PACKET_WORDS, PACKET_VALID = 22 * PACKET, 21 * PACKET
#: Where fields of `trace_packet`'s memory begin; vectors have three.
ORIGIN, TNEAR, DIRECTION, TFAR, MASK, NORMAL, U, V = (
    PACKET * i for i in (0, 3, 4, _TFAR, _MASK, _NORMAL, _U, _V)
)  # fmt: skip
PRIMITIVE, GEOMETRY, INSTANCE, INSTANCE_PRIMITIVE = (
    PACKET * i for i in (_PRIMITIVE, _GEOMETRY, _INSTANCE, _INSTANCE_PRIMITIVE)
)
#: RTC_RAY_QUERY_FLAG_COHERENT, and all features.
_COHERENT, _FEATURES = 1 << 16, -1


@intrinsic
def trace_packet(typing, address, scene, memory):  # type: ignore[no-untyped-def]
    """Closest hits of eight rays that go much the same way, for compiled code.

    To the bit those of `trace`, but for which of several surfaces in one place is met: that may depend on all eight.

    Parameters
    ----------
    address, scene : int64
        `packet_address`, which is not 0, and ``TriangleBVH.scene``.
    memory : int64
        Address of `PACKET_WORDS` words, a multiple of 64: RTCRayHit8, then -1 for each ray that counts, else 0. Of
        rays that hit, tfar and the fields of the hit are written.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word, pointer = ir.IntType(32), ir.IntType(8).as_pointer()
        function, scene, memory = arguments
        # RTCIntersectArguments: flags, features, context, filter, intersect.
        query = cgutils.alloca_once(builder, ir.LiteralStructType([word, word, pointer, pointer, pointer]))
        fields = [ir.Constant(word, value) for value in (_COHERENT, _FEATURES)] + [ir.Constant(pointer, None)] * 3
        for index, value in enumerate(fields):
            builder.store(value, builder.gep(query, [ir.Constant(word, 0), ir.Constant(word, index)]))
        valid = builder.add(memory, ir.Constant(memory.type, 4 * PACKET_VALID))
        kind = ir.FunctionType(ir.VoidType(), [pointer] * 4).as_pointer()
        places = [builder.inttoptr(place, pointer) for place in (valid, scene, memory)]
        builder.call(builder.inttoptr(function, kind), [*places, builder.bitcast(query, pointer)])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen
