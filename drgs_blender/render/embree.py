"""Ray casting with Embree, callable from compiled kernels.

Embree is the shared library inside the embreex wheel. Kernels call it through plain function addresses that arrive as
run-time integers, so compiled code can be cached on disk and still finds the library wherever it is loaded next time.
"""

from __future__ import annotations

from ..jit import njit, prange  # first of all: it sets Numba up before anything imports Numba

# isort: split
import ctypes
import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ..errors import DeviceError, UsageError

Array = np.ndarray

_REMEDY = "Reinstall the engine's environment with embreex 4.4 or later"

# Constants of Embree 4's C interface (include/embree4/rtcore_*.h).
_VERSION_PROPERTY = 0
_GEOMETRY_TRIANGLE = 0
_BUFFER_INDEX, _BUFFER_VERTEX = 0, 1
_FORMAT_UINT3, _FORMAT_FLOAT3 = 0x5003, 0x9003
_QUALITY_LOW, _QUALITY_REFIT = 0, 3
_SCENE_DYNAMIC = 1

#: Rebuild when the boxes of neighbouring triangles have grown this much against the whole scene's box.
_DEGRADED = 2.0
_GROUP = 32  # neighbouring triangles in one box of that measure
_GROUPS = 2048  # boxes looked at


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
    """Load Embree once and check its version.

    Raises
    ------
    DeviceError
        When embreex is missing, holds no library, or holds another version than 4.4 or a later 4.x.
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
        ("rtcNewGeometry", pointer, [pointer, ctypes.c_int]),
        ("rtcReleaseGeometry", None, [pointer]),
        ("rtcSetGeometryBuildQuality", None, [pointer, ctypes.c_int]),
        ("rtcSetSharedGeometryBuffer", None, [pointer, ctypes.c_int, unsigned, ctypes.c_int, pointer] + [size] * 3),
        ("rtcUpdateGeometryBuffer", None, [pointer, ctypes.c_int, unsigned]),
        ("rtcCommitGeometry", None, [pointer]),
        ("rtcAttachGeometry", unsigned, [pointer, pointer]),
        ("rtcIntersect1", None, [pointer] * 3),
        ("rtcOccluded1", None, [pointer] * 3),
    ):
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    device = lib.rtcNewDevice(None)
    if not device:
        raise DeviceError("Embree", f"refuses to start (error {lib.rtcGetDeviceError(None)})", _REMEDY)
    version = lib.rtcGetDeviceProperty(device, _VERSION_PROPERTY)
    lib.rtcReleaseDevice(device)
    if not 40400 <= version < 50000:
        raise DeviceError("Embree", f"has version {version / 10000:.4f}, expected 4.4", _REMEDY)
    return lib


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


# RTCRayHit as 24 words: org 0-2, tnear 3, dir 4-6, time 7, tfar 8, mask 9, id 10, flags 11,
# Ng 12-14, u 15, v 16, primID 17, geomID 18, instID 19, instPrimID 20 (new in 4.4), padding to 16 bytes.
# Embree writes instPrimID on every hit: in a shorter structure it overwrites whatever lies behind on the stack.
_WORDS = 24
_MASK, _PRIMITIVE, _GEOMETRY, _INSTANCE = 9, 17, 18, 19
_TFAR = 8


def _emit_call(builder: Any, arguments: Any, words: int) -> Any:
    """Emit: fill a ray on the stack, call Embree at the given address; returns word pointers by type."""
    word, single, pointer = ir.IntType(32), ir.FloatType(), ir.IntType(8).as_pointer()
    address, scene, *ray = arguments
    memory = cgutils.alloca_once(builder, ir.ArrayType(word, words))
    memory.align = 64

    def slot(index: int, kind: Any) -> Any:
        place = builder.gep(memory, [ir.Constant(word, 0), ir.Constant(word, index)])
        return builder.bitcast(place, kind.as_pointer())

    ox, oy, oz, dx, dy, dz, tnear, tfar = ray
    for index, value in enumerate((ox, oy, oz, tnear, dx, dy, dz, ir.Constant(single, 0.0), tfar)):
        builder.store(value, slot(index, single))
    for index in (10, 11):
        builder.store(ir.Constant(word, 0), slot(index, word))
    for index in (_MASK, _PRIMITIVE, _GEOMETRY, _INSTANCE):
        if index < words:
            builder.store(ir.Constant(word, -1), slot(index, word))
    kind = ir.FunctionType(ir.VoidType(), [pointer, pointer, pointer]).as_pointer()
    builder.call(
        builder.inttoptr(address, kind),
        [builder.inttoptr(scene, pointer), builder.bitcast(memory, pointer), ir.Constant(pointer, None)],
    )
    return lambda index, kind: builder.load(slot(index, kind))


_ARGUMENTS = (types.int64, types.int64) + (types.float32,) * 8
_HIT = types.Tuple((types.float32, types.int32) + (types.float32,) * 5)


@intrinsic
def closest_hit(typing: Any, address: Any, scene: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any,
                tnear: Any, tfar: Any) -> Any:  # fmt: skip
    """Closest hit of one ray, for compiled code: ``(t, primitive, u, v, gx, gy, gz)``.

    `address` is ``TriangleBVH.intersect_address`` and `scene` ``TriangleBVH.scene``, both int64. ``primitive`` is the
    face index or -1 (then t is `tfar`). The hit is (1 - u - v) v0 + u v1 + v v2; (gx, gy, gz) is the geometric normal
    (v1 - v0) x (v2 - v0), **not** of unit length.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        load = _emit_call(builder, arguments, _WORDS)
        word, single = ir.IntType(32), ir.FloatType()
        values = [load(_TFAR, single), load(_PRIMITIVE, word)] + [load(i, single) for i in (15, 16, 12, 13, 14)]
        return context.make_tuple(builder, signature.return_type, values)

    return _HIT(*_ARGUMENTS), codegen


@intrinsic
def occluded(typing: Any, address: Any, scene: Any, ox: Any, oy: Any, oz: Any, dx: Any, dy: Any, dz: Any,
             tnear: Any, tfar: Any) -> Any:  # fmt: skip
    """Return whether anything lies on the ray, for compiled code; `address` is ``TriangleBVH.occluded_address``."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        load = _emit_call(builder, arguments, 12)
        # Embree sets tfar to -inf when the ray is blocked.
        return builder.fcmp_ordered("<", load(_TFAR, ir.FloatType()), ir.Constant(ir.FloatType(), 0.0))

    return types.boolean(*_ARGUMENTS), codegen


@njit(parallel=True)
def _intersect(address, scene, origins, directions, tnear, tfar, t, primitive, u, v):  # type: ignore[no-untyped-def]
    n, block = len(origins), 512
    for b in prange((n + block - 1) // block):
        for i in range(b * block, min(n, (b + 1) * block)):
            o, d = origins[i], directions[i]
            hit = closest_hit(address, scene, o[0], o[1], o[2], d[0], d[1], d[2], tnear, tfar)
            t[i], primitive[i], u[i], v[i] = hit[0], hit[1], hit[2], hit[3]


@njit(parallel=True)
def _occluded(address, scene, origins, directions, tnear, tfar, blocked):  # type: ignore[no-untyped-def]
    n, block = len(origins), 512
    for b in prange((n + block - 1) // block):
        for i in range(b * block, min(n, (b + 1) * block)):
            o, d = origins[i], directions[i]
            blocked[i] = occluded(address, scene, o[0], o[1], o[2], d[0], d[1], d[2], tnear, tfar)


@njit
def _looseness(vertices, faces, groups):  # type: ignore[no-untyped-def]
    """Summed box surface of groups of once neighbouring triangles, relative to the box of them all."""
    total = 0.0
    lowest, highest = np.full(3, np.inf), np.full(3, -np.inf)
    low, high = np.empty(3), np.empty(3)
    for g in range(len(groups)):
        low[:], high[:] = np.inf, -np.inf
        for f in groups[g]:
            for c in range(3):
                for a in range(3):
                    x = vertices[faces[f, c], a]
                    low[a], high[a] = min(low[a], x), max(high[a], x)
        x, y, z = high[0] - low[0], high[1] - low[1], high[2] - low[2]
        total += x * y + y * z + z * x
        for a in range(3):
            lowest[a], highest[a] = min(lowest[a], low[a]), max(highest[a], high[a])
    x, y, z = highest[0] - lowest[0], highest[1] - lowest[1], highest[2] - lowest[2]
    whole = x * y + y * z + z * x
    return total / whole if whole > 0.0 else 0.0


def _neighbour_groups(vertices: Array, faces: Array) -> Array:
    """(g, 32) int32: runs of faces along a Morton curve through the centroids, evenly chosen."""
    m = len(faces)
    if m < 4 * _GROUP:
        return np.empty((0, _GROUP), np.int32)
    centre = vertices[faces].mean(axis=1)
    low, high = centre.min(axis=0), centre.max(axis=0)
    cell = ((centre - low) / np.maximum(high - low, 1e-30) * 1023).astype(np.uint32)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cell = (cell | cell << np.uint32(shift)) & np.uint32(mask)
    code = cell[:, 0] | cell[:, 1] << np.uint32(1) | cell[:, 2] << np.uint32(2)
    order = np.argsort(code, kind="stable").astype(np.int32)
    runs = order[: m // _GROUP * _GROUP].reshape(-1, _GROUP)
    return np.ascontiguousarray(runs[:: max(1, math.ceil(len(runs) / _GROUPS))])


def _aligned(count: int, kind: type) -> Array:
    """1-D array of 4-byte items on a 64-byte boundary, with room behind it for Embree's wide loads."""
    raw = np.zeros(count * 4 + 128, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + count * 4 + 16].view(kind)[:count]


class TriangleBVH:
    """One triangle mesh, ready for ray casting, whose vertices may move.

    Attributes
    ----------
    vertices : (n, 3) float32, metres, the coordinates Embree reads; write into them and call ``refit()``
    faces : (m, 3) int32
    intersect_address, occluded_address, scene : int: what ``closest_hit`` and ``occluded`` take in compiled code
    rebuilds : how often the tree was built from scratch
    """

    def __init__(self) -> None:
        self._lib = library()
        self.intersect_address = _address(self._lib.rtcIntersect1)
        self.occluded_address = _address(self._lib.rtcOccluded1)
        self._device = self._lib.rtcNewDevice(None)
        self._geometry: int | None = None
        self.scene: int = 0
        self.vertices: Array = np.empty((0, 3), np.float32)
        self.faces: Array = np.empty((0, 3), np.int32)
        self.rebuilds = 0
        self._groups = np.empty((0, _GROUP), np.int32)
        self._looseness = 0.0
        self.build(self.vertices, self.faces)

    def build(self, vertices: Array, faces: Array) -> None:
        """Build the tree anew from (n, 3) vertices and (m, 3) faces, both copied.

        Raises
        ------
        UsageError
            When a face refers to a vertex that does not exist.
        DeviceError
            When Embree fails (out of memory).
        """
        n, m = len(vertices), len(faces)
        if m and (np.min(faces) < 0 or np.max(faces) >= n):
            raise UsageError("mesh", f"faces refer to vertices outside 0..{n - 1}", "Check the mesh's indices")
        self._release_scene()
        self.vertices = _aligned(3 * n, np.float32).reshape(n, 3)
        self.faces = _aligned(3 * m, np.int32).reshape(m, 3)
        self.vertices[:] = vertices
        self.faces[:] = faces
        self._construct()

    def refit(self, vertices: Array | None = None) -> None:
        """Follow moved vertices ((n, 3), or those already written into ``self.vertices``); rebuild a worn-out tree."""
        if vertices is not None:
            self.vertices[:] = vertices
        if len(self._groups) and _looseness(self.vertices, self.faces, self._groups) > _DEGRADED * self._looseness:
            self._release_scene()
            self._construct()
            return
        lib = self._lib
        lib.rtcUpdateGeometryBuffer(self._geometry, _BUFFER_VERTEX, 0)
        self._commit()

    def _construct(self) -> None:
        lib = self._lib
        self.scene = lib.rtcNewScene(self._device)
        # Only a dynamic scene of low quality keeps one tree a geometry, and only such a tree is refitted; any other
        # scene silently builds anew at each commit. The geometry's own tree is of full quality either way.
        lib.rtcSetSceneFlags(self.scene, _SCENE_DYNAMIC)
        lib.rtcSetSceneBuildQuality(self.scene, _QUALITY_LOW)
        self._geometry = lib.rtcNewGeometry(self._device, _GEOMETRY_TRIANGLE)
        for kind, form, array in (
            (_BUFFER_VERTEX, _FORMAT_FLOAT3, self.vertices),
            (_BUFFER_INDEX, _FORMAT_UINT3, self.faces),
        ):
            lib.rtcSetSharedGeometryBuffer(self._geometry, kind, 0, form, array.ctypes.data, 0, 12, len(array))
        lib.rtcSetGeometryBuildQuality(self._geometry, _QUALITY_REFIT)
        lib.rtcAttachGeometry(self.scene, self._geometry)
        self._commit()
        self.rebuilds += 1
        self._groups = _neighbour_groups(self.vertices, self.faces)
        self._looseness = _looseness(self.vertices, self.faces, self._groups)

    def _commit(self) -> None:
        self._lib.rtcCommitGeometry(self._geometry)
        self._lib.rtcCommitScene(self.scene)
        if error := self._lib.rtcGetDeviceError(self._device):
            raise DeviceError(
                "Embree", f"failed with error {error} on {len(self.faces)} triangles", "Use a smaller mesh"
            )

    def intersect(
        self, origins: Array, directions: Array, tnear: float = 0.0, tfar: float = math.inf
    ) -> tuple[Array, Array, Array, Array]:
        """Closest hits of many rays: t (n,), face (n,) int32 or -1, u (n,), v (n,); t in units of the direction."""
        origins, directions = (np.ascontiguousarray(a, np.float32) for a in (origins, directions))
        t, u, v = np.empty((3, len(origins)), np.float32)
        face = np.empty(len(origins), np.int32)
        _intersect(self.intersect_address, self.scene, origins, directions, tnear, tfar, t, face, u, v)
        return t, face, u, v

    def occluded_many(self, origins: Array, directions: Array, tnear: float = 0.0, tfar: float = math.inf) -> Array:
        """(n,) bool: whether anything lies on each ray."""
        origins, directions = (np.ascontiguousarray(a, np.float32) for a in (origins, directions))
        blocked = np.empty(len(origins), np.bool_)
        _occluded(self.occluded_address, self.scene, origins, directions, tnear, tfar, blocked)
        return blocked

    def _release_scene(self) -> None:
        if self._geometry:
            self._lib.rtcReleaseGeometry(self._geometry)
        if self.scene:
            self._lib.rtcReleaseScene(self.scene)
        self._geometry, self.scene = None, 0

    def close(self) -> None:
        """Give the tree's memory back; the object cannot be used afterwards."""
        self._release_scene()
        if self._device:
            self._lib.rtcReleaseDevice(self._device)
            self._device = None

    def __del__(self) -> None:
        if getattr(self, "_device", None):
            self.close()
