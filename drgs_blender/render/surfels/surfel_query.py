"""Embree's callbacks for rays that come near surfels, and the query that a ray hands to them.

A surfel is the disc u^2 + v^2 < 2 ln(255 opacity) of its plane c + u a + v b: beyond it opacity times kernel is below
1/255. Embree walks its tree of the discs' boxes and calls back for every disc whose box a ray passes; the callback
solves o + t d = c + u a + v b in double precision (Cramer's rule, as Moeller and Trumbore 1997 for triangles). So a
surfel is met at most once, exactly where it is, and there is no diagonal or edge between triangles to fall through.

Here alpha and transmittance of rays are computed: alpha is opacity times exp(-(u^2 + v^2) / 2), 0.99 at most. It
differs from the rasteriser's (`raster`) in this: there is no low-pass filter, intersection and transmittance are in
double precision, and a ray ends at a transmittance of 2e-5, not 1e-4.

Callbacks speak with the function that casts the ray through a block of memory behind Embree's ray context, laid out
below. A closest-hits callback keeps a list of the nearest contributions, sorted by (depth, index), and shortens the ray
when the list is full or opaque; a shadow callback multiplies transmittances, whatever the order, and ends the ray
when it is opaque.
"""

from __future__ import annotations

from ...compute.jit import cfunc, njit  # first of all: it sets Numba up before anything imports Numba

# isort: split
import functools
import math
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .splats import MAX_ALPHA

#: Light that is fainter than this is gone. Less than the rasteriser's 1e-4, so that what lies behind moves not even the
#: mean depth of a hit by more than 1e-4 of the distance to it.
MIN_RAY_TRANSMITTANCE = 2e-5
#: Contributions that one walk through the tree finds. With 32 rays are a tenth slower, with 16 a fifth.
CAPACITY = 64

#: A surfel of the object that a ray starts on is that ray's own surface, and not met, when it is met nearer than
#: OWN_REACH sizes, its plane passes within OWN_HEIGHT sizes of the start, and the cosine between its plane's normal and
#: the start's is above OWN_COSINE, either way up. A size is the mean of the start's and the surfel's.
OWN_REACH, OWN_HEIGHT, OWN_COSINE = 4.0, 1.0, 0.5

# Record of a surfel, 16 words: centre, scaled tangents, opacity, 2 ln(255 opacity) or 0 for one that is never met,
# larger standard deviation; as int32: object, mask.
TANGENT_U, TANGENT_V, OPACITY, CUT, WIDTH, OBJECT, MASK, RECORD = 3, 6, 9, 10, 11, 12, 13, 16

# Words of a ray as Embree lays it out.
_TNEAR, _DIRECTION, _TFAR, _RAY_MASK = 3, 4, 8, 9
# Words of a query: ray and hit, arguments, context; behind Embree's own part of the context, what callbacks read and
# write. PRODUCT is a double.
_ARGUMENTS, _CONTEXT = 32, 48
OWN, COUNT, LAST_INDEX, LAST_T, SCALE, START_NORMAL, PRODUCT = 4, 5, 6, 7, 8, 9, 12
DEPTHS = 16
ALPHAS, INDICES = DEPTHS + CAPACITY, DEPTHS + 2 * CAPACITY
_WORDS = _CONTEXT + DEPTHS + 3 * CAPACITY


class RayStart(NamedTuple):
    """The surface that a ray starts on, so that it does not stop the ray.

    Attributes
    ----------
    own : int
        Its object, or -1; then the rest does not matter.
    x, y, z : float
        Its unit geometric normal, either side, world space.
    size : float
        Mean larger standard deviation of the surfels there, metres.
    """

    own: int
    x: float
    y: float
    z: float
    size: float


_word, _single, _double, _long = ir.IntType(32), ir.FloatType(), ir.DoubleType(), ir.IntType(64)


def _access(kind: Any, llvm: Any) -> tuple[Any, Any]:
    """Make ``load(address, index)`` and ``store(address, index, value)`` of items of one type, for compiled code."""

    def place(builder: Any, address: Any, index: Any) -> Any:
        return builder.gep(builder.inttoptr(address, llvm.as_pointer()), [index])

    @intrinsic
    def load(typing, address, index):  # type: ignore[no-untyped-def]
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.load(place(builder, *arguments), align=4)

        return kind(types.int64, types.int64), codegen

    @intrinsic
    def store(typing, address, index, value):  # type: ignore[no-untyped-def]
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
def query_memory(typing):  # type: ignore[no-untyped-def]
    """Address of memory for one query on the stack of the calling function, for compiled code.

    Returns
    -------
    int64
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        memory = cgutils.alloca_once(builder, ir.ArrayType(_word, _WORDS))
        memory.align = 64
        return builder.ptrtoint(memory, _long)

    return types.int64(), codegen


@intrinsic
def _call(typing, address, scene, ray, settings):  # type: ignore[no-untyped-def]
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer] * 3).as_pointer()
        function, *rest = arguments
        builder.call(builder.inttoptr(function, kind), [builder.inttoptr(a, pointer) for a in rest])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 4), codegen


@njit
def begin_query(query, ray, start):  # type: ignore[no-untyped-def]
    """Fill all of a query but its range.

    Parameters
    ----------
    query : int64
        Address, `query_memory`.
    ray : Ray
        World; direction unit; mask as of ``SurfelBVH.update``.
    start : RayStart

    Returns
    -------
    int64
        Address of the part that callbacks write: COUNT, DEPTHS, ALPHAS, INDICES, PRODUCT.
    """
    (ox, oy, oz), (dx, dy, dz) = ray.origin, ray.direction
    context = query + 4 * _CONTEXT
    for index, value in ((0, ox), (1, oy), (2, oz), (4, dx), (5, dy), (6, dz), (7, np.float32(0.0))):
        store_single(query, index, value)
    store_word(query, _RAY_MASK, np.int32(ray.mask))
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
    store_word(context, OWN, np.int32(start.own))
    store_word(context, COUNT, np.int32(0))
    store_word(context, LAST_INDEX, np.int32(-1))
    store_single(context, LAST_T, np.float32(-np.inf))
    store_single(context, SCALE, start.size)
    for index, value in ((START_NORMAL, start.x), (START_NORMAL + 1, start.y), (START_NORMAL + 2, start.z)):
        store_single(context, index, value)
    store_double(context + 4 * PRODUCT, 0, 1.0)
    return context


@njit
def cast(address, scene, query, tnear, tfar):  # type: ignore[no-untyped-def]
    """Walk Embree's tree once along a query's ray.

    Parameters
    ----------
    address : int64
        Of Embree's function: ``SurfelBVH.intersect_address`` or ``occluded_address``.
    scene : int64
        ``SurfelBVH.scene``.
    query : int64
        Address, after `begin_query`.
    tnear, tfar : float32
        Range of depth, m: tnear < t <= tfar.
    """
    store_single(query, _TNEAR, np.float32(tnear))
    store_single(query, _TFAR, np.float32(tfar))
    _call(address, scene, query, query + 4 * _ARGUMENTS)


@njit
def _meet(surfel, ray, context):  # type: ignore[no-untyped-def]
    """Depth and strength of a surfel on a ray; strength 0 where it is not met."""
    nothing = np.float32(0.0), np.float32(0.0)
    if load_word(surfel, MASK) & load_word(ray, _RAY_MASK) == 0:
        return nothing
    mx = np.float64(load_single(ray, 0)) - np.float64(load_single(surfel, 0))
    my = np.float64(load_single(ray, 1)) - np.float64(load_single(surfel, 1))
    mz = np.float64(load_single(ray, 2)) - np.float64(load_single(surfel, 2))
    ax, ay = np.float64(load_single(surfel, TANGENT_U)), np.float64(load_single(surfel, TANGENT_U + 1))
    az, bx = np.float64(load_single(surfel, TANGENT_U + 2)), np.float64(load_single(surfel, TANGENT_V))
    by, bz = np.float64(load_single(surfel, TANGENT_V + 1)), np.float64(load_single(surfel, TANGENT_V + 2))
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
        square < load_single(surfel, CUT) and depth > load_single(ray, _TNEAR) and depth <= load_single(ray, _TFAR)
    ):
        return nothing
    if load_word(context, OWN) >= 0 and load_word(surfel, OBJECT) == load_word(context, OWN):
        size = 0.5 * (np.float64(load_single(context, SCALE)) + np.float64(load_single(surfel, WIDTH)))
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
    alpha = np.float64(load_single(surfel, OPACITY)) * math.exp(-0.5 * square)
    return depth, np.float32(min(alpha, MAX_ALPHA))


@njit
def _gather(call):  # type: ignore[no-untyped-def]
    """Callback of a ray that looks for its nearest contributions."""
    index = load_word(call, 4)
    surfel = load_long(call, 1) + 4 * RECORD * np.int64(np.uint32(index))
    context, ray = load_long(call, 3), load_long(call, 4)
    depth, alpha = _meet(surfel, ray, context)
    if alpha == 0.0:
        return
    last = load_single(context, LAST_T)
    if depth < last or (depth == last and index <= load_word(context, LAST_INDEX)):
        return  # blended after an earlier walk
    count = np.int64(load_word(context, COUNT))
    product = load_double(context + 4 * PRODUCT, 0)
    if count == CAPACITY or product < MIN_RAY_TRANSMITTANCE:
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
        if without >= 0.999999 * MIN_RAY_TRANSMITTANCE:
            break
        product = without
        count -= 1
    store_word(context, COUNT, np.int32(count))
    store_double(context + 4 * PRODUCT, 0, product)
    if count == CAPACITY or product < MIN_RAY_TRANSMITTANCE:
        # A little beyond the last one: those at an equal depth are distinguished above, not by Embree's boxes.
        store_single(ray, _TFAR, beyond(load_single(context, DEPTHS + count - 1)))


@njit
def beyond(depth):  # type: ignore[no-untyped-def]
    """A depth a few units in the last place farther.

    Parameters
    ----------
    depth : float32
        Metres.

    Returns
    -------
    float32
    """
    return np.float32(depth * np.float32(1.0000005))


@njit
def _shade(call):  # type: ignore[no-untyped-def]
    """Callback of a ray that asks for the transmittance alone."""
    index = load_word(call, 4)
    surfel = load_long(call, 1) + 4 * RECORD * np.int64(np.uint32(index))
    context, ray = load_long(call, 3), load_long(call, 4)
    _, alpha = _meet(surfel, ray, context)
    if alpha == 0.0:
        return
    product = load_double(context + 4 * PRODUCT, 0) * (1.0 - alpha)
    store_double(context + 4 * PRODUCT, 0, product)
    if product < MIN_RAY_TRANSMITTANCE:
        store_single(ray, _TFAR, np.float32(-np.inf))


@njit
def _bound(call):  # type: ignore[no-untyped-def]
    """Callback that writes the box of a surfel's disc, widened by more than float32 rounds."""
    surfel = load_long(call, 0) + 4 * RECORD * np.int64(np.uint32(load_word(call, 2)))
    box = load_long(call, 2)
    cut = np.float64(load_single(surfel, CUT))
    for axis in range(3):
        a, b = np.float64(load_single(surfel, TANGENT_U + axis)), np.float64(load_single(surfel, TANGENT_V + axis))
        centre = np.float64(load_single(surfel, axis))
        reach = math.sqrt(cut * (a * a + b * b)) * 1.000001 + abs(centre) * 2e-7
        store_single(box, axis, np.float32(centre - reach))
        store_single(box, 4 + axis, np.float32(centre + reach))


@functools.cache
def callbacks() -> tuple[Any, Any, Any]:
    """Compile (or load from the cache) what Embree calls: bounds, intersect, occluded."""
    make = cfunc(types.void(types.int64))
    return make(_bound.py_func), make(_gather.py_func), make(_shade.py_func)
