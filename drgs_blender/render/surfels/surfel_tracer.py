"""2D Gaussian ray tracing: rays that meet surfels instead of a mesh.

All surfels on a ray are blended in the order of depth, front to back, each with its opacity times its kernel at the
exact point where the ray meets its plane: the rasteriser's rule without its low-pass filter (Gu et al., "IRGS:
Inter-Reflective Gaussian Splatting with 2D Gaussian Ray Tracing", 2025). What comes back is a virtual hit: what the
surfels let through, and depth, normals and material of what they stop.

Surfels are two-sided: each one's normals are turned towards the ray before they are blended. Where the depth jumps by
more than `gap` times the mean of the sizes on both sides, a new surface begins, and the hit is the heaviest surface
alone, as in `raster`: no point lies in the air between two. An infinite gap blends the whole ray, as the paper does.
Light transport picks one of the surfaces by chance instead, each as often as its share of what is stopped.

Rays that start on surfels must not be stopped by those very surfels; see OWN_REACH in `surfel_query` for the rule,
which needs the object, normal and size of what the ray starts on. Only surfels of that object are ever left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import over_range
from ...core.asset.model import as_float
from ...core.errors import UsageError
from ..memory import address, load_float, load_int32
from ..sampling import ONE, ZERO, F
from ..scene.ray import Rays, ray_at
from ..surfel_columns import ALBEDO, METALLIC, NORMAL, PLANE, ROUGHNESS, SIZE, SURFEL
from .raster import GAP
from .surfel_bvh import SurfelBVH
from .surfel_query import (
    ALPHAS,
    CAPACITY,
    COUNT,
    DEPTHS,
    INDICES,
    LAST_INDEX,
    LAST_T,
    MIN_RAY_TRANSMITTANCE,
    PRODUCT,
    RayStart,
    begin_query,
    cast,
    load_double,
    load_single,
    load_word,
    query_memory,
    store_double,
    store_single,
    store_word,
)

Array = np.ndarray

_BEFORE, _TINY = F(1.0 - 5e-7), F(1e-30)
_NOTHING = (ZERO,) * 14
#: Rays that one thread traces at least.
_FEW = 64
#: In place of a random number: the heaviest surface on a ray, not one by chance.
HEAVIEST = F(-1.0)


class SurfelTracer(NamedTuple):
    """Ray tracer of surfels for compiled code; valid until the next update of the tree. All are int64.

    Attributes
    ----------
    surfel_intersect, surfel_occluded, surfel_scene : int
        Addresses, see `SurfelBVH`.
    surface : int
        Address of (n, SURFEL) float32, ``SurfelBVH.surface``.
    surfel_object : int
        Address of (n,) int32, ``SurfelBVH.objects``.
    """

    surfel_intersect: int
    surfel_occluded: int
    surfel_scene: int
    surface: int
    surfel_object: int


def tracer_of(bvh: SurfelBVH) -> SurfelTracer:
    """The tracer of the surfels of `bvh` for compiled code; until its next update."""
    tables = address(bvh.surface), address(bvh.objects)
    return SurfelTracer(bvh.intersect_address, bvh.occluded_address, bvh.scene, *tables)


@njit
def transmittance(tracer, ray, start):  # type: ignore[no-untyped-def]
    """Share of light that passes the surfels on a ray, 0 where that is below MIN_RAY_TRANSMITTANCE.

    Parameters
    ----------
    tracer : SurfelTracer
        Or anything that has its fields.
    ray : Ray
        Its direction is a unit vector; for its mask see ``SurfelBVH.update``, -1 meets all.
    start : RayStart
    """
    query = query_memory()
    context = begin_query(query, ray, start)
    cast(tracer.surfel_occluded, tracer.surfel_scene, query, ray.tnear, ray.tfar)
    product = load_double(context + 4 * PRODUCT, 0)
    return F(product) if product >= MIN_RAY_TRANSMITTANCE else ZERO


@njit
def trace_surfels(tracer, ray, start, gap, number):  # type: ignore[no-untyped-def]
    """Closest hit of a ray among surfels: these alpha-blended front to back into one virtual surface (Gu et al. 2025).

    Parameters
    ----------
    tracer, ray, start : SurfelTracer, Ray or RayStart
        As of `transmittance`.
    gap : float32
        Jump of depth that separates surfaces, in sizes; infinite: none does.
    number : float32
        Random number in [0, 1) that picks one of the surfaces by its weight, or HEAVIEST.

    Returns
    -------
    through : float32
        Transmittance of all surfels on the ray; 1 where nothing is met.
    t : float32
        Mean depth by weight, m; `tfar` where nothing is met.
    nx, ny, nz : float32
        Shading normal, unit, world.
    px, py, pz : float32
        Geometric normal, unit, world, towards the ray's origin.
    red, green, blue : float32
        Albedo, linear Rec.709.
    roughness, metallic : float32
        In [0, 1].
    size : float32
        Mean larger standard deviation, m.
    object : int32
        Of the heaviest surfel; -1 where nothing is met.
    stop : float32
        Depth at which the transmittance falls to `number`, else `tfar`: P(stop > t) equals the transmittance
        to depth t.
    """
    query = query_memory()
    context = begin_query(query, ray, start)
    tnear, tfar = ray.tnear, ray.tfar
    through, total, pick = 1.0, ZERO, number
    near, last, last_size, heaviest, stop = tnear, ZERO, ZERO, ZERO, F(tfar)
    index = owner = best_owner = np.int32(-1)
    sums = best = _NOTHING
    while True:
        cast(tracer.surfel_intersect, tracer.surfel_scene, query, near, tfar)
        count = np.int64(load_word(context, COUNT))
        for k in range(count):
            index = load_word(context, INDICES + k)
            t, alpha = load_single(context, DEPTHS + k), load_single(context, ALPHAS + k)
            row = tracer.surface + 4 * SURFEL * np.int64(index)
            wide = load_float(row, SIZE)
            if sums[0] > ZERO and t - last > F(0.5) * gap * (wide + last_size):
                better, pick, total = _prefer(sums[0], best[0], pick, total)
                if better:
                    best, best_owner = sums, owner
                sums, heaviest = _NOTHING, ZERO
            weight = F(through) * alpha
            sums = _add(sums, row, weight, t, ray.direction)
            if weight > heaviest:
                heaviest, owner = weight, load_int32(tracer.surfel_object, np.int64(index))
            last, last_size = t, wide
            before, through = through, through * (1.0 - alpha)
            if before > number >= through:
                stop = t
            if through < MIN_RAY_TRANSMITTANCE:
                break
        if count < CAPACITY or through < MIN_RAY_TRANSMITTANCE:
            break
        # The list was full: go on behind its last entry.
        near = max(tnear, last * _BEFORE)
        store_single(context, LAST_T, last)
        store_word(context, LAST_INDEX, index)
        store_word(context, COUNT, np.int32(0))
        store_double(context + 4 * PRODUCT, 0, through)
    if sums[0] > ZERO and _prefer(sums[0], best[0], pick, total)[0]:
        best, best_owner = sums, owner
    weight, t, nx, ny, nz, px, py, pz, red, green, blue, roughness, metallic, wide = best
    if weight <= ZERO:
        return (
            ONE, F(tfar), ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, np.int32(-1), stop,
        )  # fmt: skip
    left = F(through) if through >= MIN_RAY_TRANSMITTANCE else ZERO
    inverse = ONE / weight
    scale = ONE / math.sqrt(max(px * px + py * py + pz * pz, _TINY))
    px, py, pz = px * scale, py * scale, pz * scale
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length > F(1e-3) * weight:
        scale = ONE / length
        nx, ny, nz = nx * scale, ny * scale, nz * scale
    else:
        nx, ny, nz = px, py, pz
    return (
        left, t * inverse, nx, ny, nz, px, py, pz, red * inverse, green * inverse, blue * inverse,
        roughness * inverse, metallic * inverse, wide * inverse, best_owner, stop,
    )  # fmt: skip


@inlined
def _prefer(weight, best, pick, total):  # type: ignore[no-untyped-def]
    """Whether a surface takes the place of the one chosen so far; the random number, reuse_equal; all weight so far.

    Of a row of surfaces each is chosen in proportion to its weight; the heaviest when `pick` is negative.
    """
    total += weight
    if pick < ZERO:
        return weight > best, pick, total
    share = weight / total
    if pick < share:
        return True, pick / share, total
    return False, (pick - share) / (ONE - share), total


@inlined
def _add(sums, row, w, t, direction):  # type: ignore[no-untyped-def]
    """Add a contribution of weight w at depth t: sums of one, depth, normals towards the ray, material, size."""
    weight, depth, nx, ny, nz, px, py, pz, red, green, blue, roughness, metallic, wide = sums
    dx, dy, dz = direction
    fx, fy, fz = load_float(row, PLANE), load_float(row, PLANE + 1), load_float(row, PLANE + 2)
    mx, my, mz = load_float(row, NORMAL), load_float(row, NORMAL + 1), load_float(row, NORMAL + 2)
    side = -w if fx * dx + fy * dy + fz * dz > ZERO else w
    px, py, pz = px + side * fx, py + side * fy, pz + side * fz
    if mx * fx + my * fy + mz * fz < ZERO:
        side = -side
    return (
        weight + w, depth + w * t, nx + side * mx, ny + side * my, nz + side * mz, px, py, pz,
        red + w * load_float(row, ALBEDO), green + w * load_float(row, ALBEDO + 1),
        blue + w * load_float(row, ALBEDO + 2), roughness + w * load_float(row, ROUGHNESS),
        metallic + w * load_float(row, METALLIC), wide + w * load_float(row, SIZE),
    )  # fmt: skip


@dataclass(slots=True)
class SurfelHits:
    """Hits of many rays; where ``object_index`` is -1 the rest but ``through`` is undefined.

    Attributes
    ----------
    through : (n,) float32 array
        Share of light that passes.
    depth : (n,) float32 array
        In units of the direction.
    normal, geometric_normal : (n, 3) float32 array
        Unit, world space.
    albedo : (n, 3) float32 array
        In [0, 1]; linear Rec.709.
    roughness, metallic : (n,) float32 array
        In [0, 1].
    size : (n,) float32 array
        Metres: mean larger standard deviation of the surfels.
    object_index : (n,) int32 array
    """

    through: Array
    depth: Array
    normal: Array
    geometric_normal: Array
    albedo: Array
    roughness: Array
    metallic: Array
    size: Array
    object_index: Array


@dataclass(slots=True)
class RayStarts:
    """The surfaces that rays start on, so that these do not stop them.

    Attributes
    ----------
    object_index : (n,) int32 array
        -1 for rays that start anywhere else.
    normal : (n, 3) float32 array
        Unit geometric normals, either side, world space.
    size : (n,) float32 array
        Metres: mean larger standard deviation of the surfels there.
    """

    object_index: Array
    normal: Array
    size: Array

    def __post_init__(self) -> None:
        self.object_index = np.ascontiguousarray(self.object_index, np.int32)
        self.normal = as_float(self.normal, (len(self.object_index), 3), "normals of starts")
        self.size = as_float(self.size, (len(self.object_index),), "sizes of starts")

    @property
    def arrays(self) -> tuple[Array, Array, Array]:
        """All of them, as kernels take them."""
        return self.object_index, self.normal, self.size


def trace(
    bvh: SurfelBVH,
    origins: Array,
    directions: Array,
    tnear: float = 0.0,
    tfar: float = math.inf,
    *,
    mask: int = -1,
    starts: RayStarts | None = None,
    gap: float = GAP,
) -> SurfelHits:
    """Blend the surfels on many rays; origins and unit directions (n, 3), world space. See `trace_surfels`."""
    origins, directions, starts = _checked(origins, directions, starts)
    n = len(origins)
    numbers, index = np.empty((n, 14), np.float32), np.empty(n, np.int32)
    rays = Rays.of(origins, directions, tnear, tfar, mask)
    over_range(_trace, n, tracer_of(bvh), rays, starts.arrays, F(gap), numbers, index, fewest=_FEW)
    return SurfelHits(
        numbers[:, 0], numbers[:, 1], numbers[:, 2:5], numbers[:, 5:8], numbers[:, 8:11], numbers[:, 11],
        numbers[:, 12], numbers[:, 13], index,
    )  # fmt: skip


def transmittance_many(
    bvh: SurfelBVH,
    origins: Array,
    directions: Array,
    tnear: float = 0.0,
    tfar: float = math.inf,
    *,
    mask: int = -1,
    starts: RayStarts | None = None,
) -> Array:
    """(n,) float32: the share of light that passes along many rays. See `transmittance`."""
    origins, directions, starts = _checked(origins, directions, starts)
    out = np.empty(len(origins), np.float32)
    rays = Rays.of(origins, directions, tnear, tfar, mask)
    over_range(_shadow, len(out), tracer_of(bvh), rays, starts.arrays, out, fewest=_FEW)
    return out


def _checked(origins: Array, directions: Array, starts: RayStarts | None) -> tuple[Array, Array, RayStarts]:
    origins = as_float(origins, (-1, 3), "ray origins")
    n = len(origins)
    if starts is None:
        starts = RayStarts(np.full(n, -1), np.zeros((n, 3)), np.zeros(n))
    if len(starts.object_index) != n:
        raise UsageError("ray starts", f"are {len(starts.object_index)} for {n} rays", "Give one start a ray")
    return origins, as_float(directions, (n, 3), "ray directions"), starts


@njit
def _start(starts, i):  # type: ignore[no-untyped-def]
    own, normal, size = starts
    return RayStart(own[i], normal[i, 0], normal[i, 1], normal[i, 2], size[i])


@njit
def _trace(first, last, tracer, rays, starts, gap, numbers, index):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        hit = trace_surfels(tracer, ray_at(rays, i), _start(starts, i), gap, HEAVIEST)
        values = hit[:14]
        for k in range(14):
            numbers[i, k] = values[k]
        index[i] = hit[14]


@njit
def _shadow(first, last, tracer, rays, starts, out):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        out[i] = transmittance(tracer, ray_at(rays, i), _start(starts, i))
