"""Surfels in an Embree tree: a user geometry whose primitives are the surfels' discs, tested by compiled callbacks.

A surfel is the disc u^2 + v^2 < 2 ln(255 opacity) of its plane c + u a + v b: beyond it opacity times kernel is below
1/255. Embree walks its tree of the discs' boxes and calls back for every disc whose box a ray passes; the callback
solves o + t d = c + u a + v b in double precision (Cramer's rule, as Moeller and Trumbore 1997 for triangles). So a
surfel is met at most once, exactly where it is, and there is no diagonal or edge between triangles to fall through.

Callbacks speak with the function that casts the ray through a block of memory behind Embree's ray context, laid out
below. A closest-hits callback keeps a list of the nearest contributions, sorted by (depth, index), and shortens the ray
when the list is full or opaque; a shadow callback multiplies transmittances, whatever the order, and ends the ray
when it is opaque.
"""

from __future__ import annotations

from ..jit import njit  # first of all: it sets Numba up before anything imports Numba

# isort: split
import ctypes
import functools
import math
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ..asset.model import PosedSurfels
from ..errors import DeviceError, UsageError
from .embree import QUALITY_LOW, QUALITY_REFIT, SCENE_DYNAMIC, address, device, library
from .tree import aligned, looseness, neighbours

Array = np.ndarray

#: Fainter contributions are skipped and stronger ones clamped, as in `raster`.
MIN_ALPHA, MAX_ALPHA = 1.0 / 255.0, 0.99
#: Light that is fainter than this is gone. Less than the rasteriser's 1e-4, so that what lies behind moves not even the
#: mean depth of a hit by more than 1e-4 of the distance to it.
MIN_TRANSMITTANCE = 2e-5
#: Contributions that one walk through the tree finds. With 32 rays are a tenth slower, with 16 a fifth.
CAPACITY = 64

#: A surfel of the object that a ray starts on is that ray's own surface, and not met, when it is met nearer than
#: OWN_REACH sizes, its plane passes within OWN_HEIGHT sizes of the start, and the cosine between its plane's normal and
#: the start's is above OWN_COSINE, either way up. A size is the mean of the start's and the surfel's.
OWN_REACH, OWN_HEIGHT, OWN_COSINE = 4.0, 1.0, 0.5

# Record of a surfel, 16 words: centre, scaled tangents, opacity, 2 ln(255 opacity) or 0 for one that is never met,
# larger standard deviation; as int32: object, mask.
_A, _B, _OPACITY, _CUT, _SIZE, _OBJECT, _MASK, _RECORD = 3, 6, 9, 10, 11, 12, 13, 16

# Columns of ``SurfelBVH.surface``: unit shading normal, albedo, roughness, metallic, larger standard deviation, unit
# normal of the plane; world space, linear Rec.709, metres.
NORMAL, ALBEDO, ROUGHNESS, METALLIC, SIZE, PLANE, SURFACE = 0, 3, 6, 7, 8, 9, 12

# Words of a ray as Embree lays it out.
_TNEAR, _DIRECTION, _TFAR, _RAY_MASK = 3, 4, 8, 9
# Words of a query: ray and hit, arguments, context; behind Embree's own part of the context, what callbacks read and
# write. PRODUCT is a double.
_ARGUMENTS, _CONTEXT = 32, 48
OWN, COUNT, LAST_INDEX, LAST_T, SCALE, START_NORMAL, PRODUCT = 4, 5, 6, 7, 8, 9, 12
DEPTHS = 16
ALPHAS, INDICES = DEPTHS + CAPACITY, DEPTHS + 2 * CAPACITY
_WORDS = _CONTEXT + DEPTHS + 3 * CAPACITY

_GEOMETRY_USER = 120
_ROBUST = 4  # a scene's flag: no box is missed by rounding
_DEGRADED = 2.0  # as in tree.py: rebuild when the boxes of once neighbouring discs have grown this much
_FARTHEST = 1e15  # coordinates beyond are as unusable as NaN

_word, _single, _double, _long = ir.IntType(32), ir.FloatType(), ir.DoubleType(), ir.IntType(64)


def _access(kind: Any, llvm: Any) -> tuple[Any, Any]:
    """Make ``load(address, index)`` and ``store(address, index, value)`` of items of one type, for compiled code."""

    def place(builder: Any, address: Any, index: Any) -> Any:
        return builder.gep(builder.inttoptr(address, llvm.as_pointer()), [index])

    @intrinsic
    def load(typing: Any, address: Any, index: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.load(place(builder, *arguments), align=4)

        return kind(types.int64, types.int64), codegen

    @intrinsic
    def store(typing: Any, address: Any, index: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            builder.store(arguments[2], place(builder, *arguments[:2]), align=4)
            return context.get_dummy_value()

        return types.void(types.int64, types.int64, kind), codegen

    return load, store


load_single, store_single = _access(types.float32, _single)
load_double, store_double = _access(types.float64, _double)
load_word, store_word = _access(types.int32, _word)
load_long, store_long = _access(types.int64, _long)


@intrinsic
def query_memory(typing: Any) -> Any:
    """Address of memory for one query on the stack of the calling function, for compiled code."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        memory = cgutils.alloca_once(builder, ir.ArrayType(_word, _WORDS))
        memory.align = 64
        return builder.ptrtoint(memory, _long)

    return types.int64(), codegen


@intrinsic
def _call(typing: Any, address: Any, scene: Any, ray: Any, settings: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer] * 3).as_pointer()
        function, *rest = arguments
        builder.call(builder.inttoptr(function, kind), [builder.inttoptr(a, pointer) for a in rest])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 4), codegen


@njit
def begin_query(query, ox, oy, oz, dx, dy, dz, mask, own, gx, gy, gz, scale):  # type: ignore[no-untyped-def]
    """Fill all of a query but its range; returns the address of the part that callbacks write."""
    context = query + 4 * _CONTEXT
    for index, value in ((0, ox), (1, oy), (2, oz), (4, dx), (5, dy), (6, dz), (7, np.float32(0.0))):
        store_single(query, index, value)
    store_word(query, _RAY_MASK, np.int32(mask))
    for index in (10, 11):
        store_word(query, index, np.int32(0))
    for index in (17, 18, 19, 20):
        store_word(query, index, np.int32(-1))
    settings = query + 4 * _ARGUMENTS
    for index in range(16):
        store_word(settings, index, np.int32(0))
    store_word(settings, 1, np.int32(-1))  # all features
    store_long(settings, 1, context)
    for index in range(4):
        store_word(context, index, np.int32(-1))
    store_word(context, OWN, np.int32(own))
    store_word(context, COUNT, np.int32(0))
    store_word(context, LAST_INDEX, np.int32(-1))
    store_single(context, LAST_T, np.float32(-np.inf))
    store_single(context, SCALE, scale)
    for index, value in ((START_NORMAL, gx), (START_NORMAL + 1, gy), (START_NORMAL + 2, gz)):
        store_single(context, index, value)
    store_double(context + 4 * PRODUCT, 0, 1.0)
    return context


@njit
def cast(address, scene, query, tnear, tfar):  # type: ignore[no-untyped-def]
    """Walk the tree once, `tnear` < t <= `tfar`; `address` is Embree's function."""
    store_single(query, _TNEAR, np.float32(tnear))
    store_single(query, _TFAR, np.float32(tfar))
    _call(address, scene, query, query + 4 * _ARGUMENTS)


@njit
def _meet(surfel, ray, context):  # type: ignore[no-untyped-def]
    """Depth and strength of a surfel on a ray; strength 0 where it is not met."""
    nothing = np.float32(0.0), np.float32(0.0)
    if load_word(surfel, _MASK) & load_word(ray, _RAY_MASK) == 0:
        return nothing
    mx = np.float64(load_single(ray, 0)) - np.float64(load_single(surfel, 0))
    my = np.float64(load_single(ray, 1)) - np.float64(load_single(surfel, 1))
    mz = np.float64(load_single(ray, 2)) - np.float64(load_single(surfel, 2))
    ax, ay = np.float64(load_single(surfel, _A)), np.float64(load_single(surfel, _A + 1))
    az, bx = np.float64(load_single(surfel, _A + 2)), np.float64(load_single(surfel, _B))
    by, bz = np.float64(load_single(surfel, _B + 1)), np.float64(load_single(surfel, _B + 2))
    dx, dy = np.float64(load_single(ray, _DIRECTION)), np.float64(load_single(ray, _DIRECTION + 1))
    dz = np.float64(load_single(ray, _DIRECTION + 2))
    px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    inverse = 1.0 / (ax * px + ay * py + az * pz)
    qx, qy, qz = my * az - mz * ay, mz * ax - mx * az, mx * ay - my * ax
    depth = np.float32((bx * qx + by * qy + bz * qz) * inverse)
    u, v = (mx * px + my * py + mz * pz) * inverse, (dx * qx + dy * qy + dz * qz) * inverse
    square = u * u + v * v
    # NaN and infinity, of rays in the surfel's plane and of surfels without area, fail these.
    if not (
        square < load_single(surfel, _CUT) and depth > load_single(ray, _TNEAR) and depth <= load_single(ray, _TFAR)
    ):
        return nothing
    if load_word(context, OWN) >= 0 and load_word(surfel, _OBJECT) == load_word(context, OWN):
        size = 0.5 * (np.float64(load_single(context, SCALE)) + np.float64(load_single(surfel, _SIZE)))
        if depth < OWN_REACH * size:
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            cosine = (
                nx * load_single(context, START_NORMAL)
                + ny * load_single(context, START_NORMAL + 1)
                + nz * load_single(context, START_NORMAL + 2)
            )
            if abs(cosine) > OWN_COSINE * length and abs(nx * mx + ny * my + nz * mz) < OWN_HEIGHT * size * length:
                return nothing
    alpha = np.float64(load_single(surfel, _OPACITY)) * math.exp(-0.5 * square)
    return depth, np.float32(min(alpha, MAX_ALPHA))


@njit
def _gather(call):  # type: ignore[no-untyped-def]
    """Callback of a ray that looks for its nearest contributions."""
    index = load_word(call, 4)
    surfel = load_long(call, 1) + 4 * _RECORD * np.int64(np.uint32(index))
    context, ray = load_long(call, 3), load_long(call, 4)
    depth, alpha = _meet(surfel, ray, context)
    if alpha == 0.0:
        return
    last = load_single(context, LAST_T)
    if depth < last or (depth == last and index <= load_word(context, LAST_INDEX)):
        return  # blended after an earlier walk
    count = np.int64(load_word(context, COUNT))
    product = load_double(context + 4 * PRODUCT, 0)
    if count == CAPACITY or product < MIN_TRANSMITTANCE:
        end = load_single(context, DEPTHS + count - 1)
        if depth > end or (depth == end and index > load_word(context, INDICES + count - 1)):
            return
        if count == CAPACITY:
            count -= 1
            product /= 1.0 - load_single(context, ALPHAS + count)
    at = count
    while at > 0:
        before = load_single(context, DEPTHS + at - 1)
        number = load_word(context, INDICES + at - 1)
        if before < depth or (before == depth and number < index):
            break
        store_single(context, DEPTHS + at, before)
        store_single(context, ALPHAS + at, load_single(context, ALPHAS + at - 1))
        store_word(context, INDICES + at, number)
        at -= 1
    store_single(context, DEPTHS + at, depth)
    store_single(context, ALPHAS + at, alpha)
    store_word(context, INDICES + at, index)
    count += 1
    product *= 1.0 - alpha
    # What lies behind opaque surfels is forgotten; the margin keeps rounding of the quotient from showing.
    while count > 1:
        without = product / (1.0 - load_single(context, ALPHAS + count - 1))
        if without >= 0.999999 * MIN_TRANSMITTANCE:
            break
        product = without
        count -= 1
    store_word(context, COUNT, np.int32(count))
    store_double(context + 4 * PRODUCT, 0, product)
    if count == CAPACITY or product < MIN_TRANSMITTANCE:
        # A little beyond the last one: those at an equal depth are told apart above, not by Embree's boxes.
        store_single(ray, _TFAR, beyond(load_single(context, DEPTHS + count - 1)))


@njit
def beyond(depth):  # type: ignore[no-untyped-def]
    """A few units in the last place more."""
    return np.float32(depth * np.float32(1.0000005))


@njit
def _shade(call):  # type: ignore[no-untyped-def]
    """Callback of a ray that asks for the transmittance alone."""
    index = load_word(call, 4)
    surfel = load_long(call, 1) + 4 * _RECORD * np.int64(np.uint32(index))
    context, ray = load_long(call, 3), load_long(call, 4)
    _, alpha = _meet(surfel, ray, context)
    if alpha == 0.0:
        return
    product = load_double(context + 4 * PRODUCT, 0) * (1.0 - alpha)
    store_double(context + 4 * PRODUCT, 0, product)
    if product < MIN_TRANSMITTANCE:
        store_single(ray, _TFAR, np.float32(-np.inf))


@njit
def _bound(call):  # type: ignore[no-untyped-def]
    """Callback that writes the box of a surfel's disc, widened by more than float32 rounds."""
    surfel = load_long(call, 0) + 4 * _RECORD * np.int64(np.uint32(load_word(call, 2)))
    box = load_long(call, 2)
    cut = np.float64(load_single(surfel, _CUT))
    for axis in range(3):
        a, b = np.float64(load_single(surfel, _A + axis)), np.float64(load_single(surfel, _B + axis))
        centre = np.float64(load_single(surfel, axis))
        reach = math.sqrt(cut * (a * a + b * b)) * 1.000001 + abs(centre) * 2e-7
        store_single(box, axis, np.float32(centre - reach))
        store_single(box, 4 + axis, np.float32(centre + reach))


@functools.cache
def _callbacks() -> tuple[Any, Any, Any]:
    """Compile (or load from the cache) what Embree calls: bounds, intersect, occluded."""
    make = numba.cfunc(types.void(types.int64), cache=True, error_model="numpy")
    return make(_bound.py_func), make(_gather.py_func), make(_shade.py_func)


@njit
def _record(  # type: ignore[no-untyped-def]
    centre, tangent_u, tangent_v, opacity, objects, masks, normal, albedo, roughness, metallic, words, boxes, surface
):
    """Fill records, boxes of the discs and what hits look like; returns how many surfels are not finite."""
    singles = words.view(np.float32)
    bad = 0
    for i in range(len(centre)):
        total = abs(opacity[i])
        uu = vv = 0.0
        for k in range(3):
            total += abs(centre[i, k]) + abs(tangent_u[i, k]) + abs(tangent_v[i, k])
            uu += np.float64(tangent_u[i, k]) ** 2
            vv += np.float64(tangent_v[i, k]) ** 2
        usable = total < _FARTHEST
        bad += not usable
        seen = usable and opacity[i] > MIN_ALPHA
        cut = 2.0 * math.log(opacity[i] / MIN_ALPHA) if seen else 0.0
        for k in range(3):
            c, a, b = centre[i, k], tangent_u[i, k], tangent_v[i, k]
            singles[i, k] = c if usable else 0.0
            singles[i, _A + k], singles[i, _B + k] = (a, b) if seen else (0.0, 0.0)
            reach = math.sqrt(cut * (a * a + b * b)) if seen else 0.0
            boxes[2 * i, k], boxes[2 * i + 1, k] = singles[i, k] - reach, singles[i, k] + reach
        singles[i, _OPACITY], singles[i, _CUT] = (opacity[i], cut) if seen else (0.0, 0.0)
        singles[i, _SIZE] = math.sqrt(max(uu, vv)) if seen else 0.0
        words[i, _OBJECT], words[i, _MASK] = objects[i], masks[objects[i]]
        for k in range(3):
            surface[i, NORMAL + k] = normal[i, k] if math.isfinite(normal[i, k]) else 0.0
            surface[i, ALBEDO + k] = _fraction(albedo[i, k])
        surface[i, ROUGHNESS], surface[i, METALLIC] = _fraction(roughness[i]), _fraction(metallic[i])
        surface[i, SIZE] = singles[i, _SIZE]
        ax, ay, az = np.float64(singles[i, _A]), np.float64(singles[i, _A + 1]), np.float64(singles[i, _A + 2])
        bx, by, bz = np.float64(singles[i, _B]), np.float64(singles[i, _B + 1]), np.float64(singles[i, _B + 2])
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = math.sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 0.0 else 0.0
        surface[i, PLANE], surface[i, PLANE + 1], surface[i, PLANE + 2] = x * scale, y * scale, z * scale
    return bad


@njit
def _fraction(x):  # type: ignore[no-untyped-def]
    """Clamp to [0, 1]; NaN becomes 0."""
    return min(max(x, np.float32(0.0)), np.float32(1.0)) if x > 0.0 else np.float32(0.0)


class SurfelBVH:
    """The surfels of a frame, ready for ray casting; they may move from frame to frame.

    Attributes
    ----------
    intersect_address, occluded_address, scene : int: what `trace_surfels` and `transmittance` take in compiled code
    surface : (n, SURFACE) float32: what is blended of each surfel, see the columns above
    objects : (n,) int32: index of each surfel's object
    rebuilds : how often the tree was built from scratch
    bad : how many surfels of the last update have a number that is not finite; they are never met
    """

    def __init__(self) -> None:
        lib = self._lib = library()
        pointer, unsigned = ctypes.c_void_p, ctypes.c_uint
        for name, arguments in (
            ("rtcSetGeometryUserPrimitiveCount", [pointer, unsigned]),
            ("rtcSetGeometryUserData", [pointer, pointer]),
            ("rtcSetGeometryBoundsFunction", [pointer, pointer, pointer]),
            ("rtcSetGeometryIntersectFunction", [pointer, pointer]),
            ("rtcSetGeometryOccludedFunction", [pointer, pointer]),
        ):
            function = getattr(lib, name)
            function.restype, function.argtypes = None, arguments
        self.intersect_address = address(lib.rtcIntersect1)
        self.occluded_address = address(lib.rtcOccluded1)
        self._device = device()
        self._geometry: int | None = None
        self.scene: int = 0
        self.surface: Array = np.empty((0, SURFACE), np.float32)
        self.objects: Array = np.empty(0, np.int32)
        self.rebuilds = self.bad = 0
        self._words: Array = np.empty((0, _RECORD), np.int32)
        self._runs: Array = np.empty((0, 0), np.int32)
        self._looseness = 0.0
        self._construct(np.empty((0, 3), np.float32))

    def __len__(self) -> int:
        return len(self._words)

    def update(self, posed: PosedSurfels, masks: Array | None = None) -> None:
        """Take the surfels of a new frame: refit when there are as many as before, rebuild otherwise.

        Parameters
        ----------
        posed : surfels in world space
        masks : (objects,) int32: a ray meets the surfels of an object when the two masks share a bit; None: all do

        Raises
        ------
        UsageError
            When a surfel's object has no mask.
        DeviceError
            When Embree fails (out of memory).
        """
        n = len(posed)
        highest = int(posed.object_index.max(initial=-1))
        if masks is None:
            masks = np.full(highest + 1, -1, np.int32)
        if highest >= len(masks) or posed.object_index.min(initial=0) < 0:
            raise UsageError("surfels", f"refer to object {highest} of {len(masks)}", "Give every object a mask")
        same = n == len(self._words)
        words = self._words if same else aligned(_RECORD * n, np.int32).reshape(n, _RECORD)
        boxes = np.empty((2 * n, 3), np.float32)
        self.surface = np.empty((n, SURFACE), np.float32)
        self.objects = np.ascontiguousarray(posed.object_index, np.int32)
        self.bad = int(
            _record(
                posed.centre, posed.tangent_u, posed.tangent_v, posed.opacity, self.objects,
                np.ascontiguousarray(masks, np.int32), posed.normal, posed.albedo, posed.roughness, posed.metallic,
                words, boxes, self.surface,
            )
        )  # fmt: skip
        self._words = words
        fresh = not same
        if same and len(self._runs):
            fresh = looseness(boxes, _corners(n), self._runs) > _DEGRADED * self._looseness
        if fresh:
            self._construct(boxes)
        elif n:
            self._commit()

    def _construct(self, boxes: Array) -> None:
        self._release_scene()
        lib, n = self._lib, len(self._words)
        self.scene = lib.rtcNewScene(self._device)
        # As in tree.py: only this combination keeps a tree that can be refitted.
        lib.rtcSetSceneFlags(self.scene, SCENE_DYNAMIC | _ROBUST)
        lib.rtcSetSceneBuildQuality(self.scene, QUALITY_LOW)
        geometry = self._geometry = lib.rtcNewGeometry(self._device, _GEOMETRY_USER)
        bound, intersect, occluded = _callbacks()
        lib.rtcSetGeometryUserPrimitiveCount(geometry, n)
        lib.rtcSetGeometryUserData(geometry, self._words.ctypes.data)
        lib.rtcSetGeometryBoundsFunction(geometry, bound.address, None)
        lib.rtcSetGeometryIntersectFunction(geometry, intersect.address)
        lib.rtcSetGeometryOccludedFunction(geometry, occluded.address)
        lib.rtcSetGeometryMask(geometry, 0xFFFFFFFF)  # masks are the surfels' own
        lib.rtcSetGeometryBuildQuality(geometry, QUALITY_REFIT)
        lib.rtcAttachGeometryByID(self.scene, geometry, 0)
        self._commit()
        self.rebuilds += 1
        self._runs = neighbours(boxes, _corners(n))
        self._looseness = looseness(boxes, _corners(n), self._runs)

    def _commit(self) -> None:
        self._lib.rtcCommitGeometry(self._geometry)
        self._lib.rtcCommitScene(self.scene)
        if error := self._lib.rtcGetDeviceError(self._device):
            raise DeviceError("Embree", f"failed with error {error} on {len(self)} surfels", "Use fewer surfels")

    def _release_scene(self) -> None:
        if self._geometry:
            self._lib.rtcReleaseGeometry(self._geometry)
        if self.scene:
            self._lib.rtcReleaseScene(self.scene)
        self._geometry, self.scene = None, 0

    def close(self) -> None:
        """Give the tree's memory back; the object cannot be used afterwards."""
        self._release_scene()

    def __del__(self) -> None:
        if getattr(self, "scene", 0):
            self._release_scene()


def _corners(n: int) -> Array:
    """(n, 3) int32 rows of `boxes`, as if each box were a triangle: what the measures of tree.py read."""
    first = 2 * np.arange(n, dtype=np.int32)
    return np.stack([first, first + 1, first], axis=1)
