"""The integrator: direct light by multiple importance sampling, then indirect light by path tracing.

See docs/rendering.md for the estimator. Everything here runs in blocks of points, in parallel, each block in batches of
rays (`wavefront`); a point's result depends on nothing but the point, the scene, the light, the settings, the seed and
the frame number.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...compute.jit import get_num_threads, njit, plain, prange
from ...core.color import LUMINANCE
from ...core.errors import UsageError
from ...core.frame import RenderSettings
from .. import sampling
from ..lights.environment import EnvironmentLight
from ..lights.lights import Lights
from ..points import CATCHER, SECOND, Radiance, ShadingPoints
from ..sampling import GOLDEN, ONE, ZERO, F, U, mix, unit
from ..scene import ray_masks
from ..scene.trace_scene import TraceScene
from ..surfels.surfel_bvh import SurfelBVH
from ..surfels.surfel_tracer import tracer_of
from . import brdf
from . import wavefront as w
from .direct import BATCH, KIND, KINDS, deliver, finish, trace_batch
from .indirect import FOUND, trace_paths
from .intersect import meshes_alone
from .sample_allocation import ALPHA, COUNTS, POINT_STATE, put_sample, write_point_states
from .variance import variances

Array = np.ndarray

#: Part of the samples that go to the light at most where rays of different kinds meet different objects: there the
#: picture follows from how strategies are weighed (docs/rendering.md), and this comes closest to Cycles.
_APART = F(0.25)
#: Points of a block.
_BLOCK = 64
#: Least share of the light samples that go to environment or lights when both shine.
_LEAST_SHARE = 0.1


class Kernel:
    """What shades points, and where it finds the scene: all threads here; `render.gpu` has the same for a card."""

    def tables(self, scene: TraceScene, environment: EnvironmentLight, lights: Lights) -> tuple[Any, Any, Any, Any]:
        """(tracer, geometry, environment, lights) as `shade` takes them; until the scene's next update."""
        return meshes_alone(scene.tracer), scene.geometry, environment.envmap, lights.tables

    def shade(self, *arguments: Any) -> None:
        """Shade all points; see `shade_points`."""
        _kernel(*arguments, 8 * get_num_threads())


def integrate(
    scene: TraceScene,
    environment: EnvironmentLight,
    points: ShadingPoints,
    settings: RenderSettings,
    noise_index: int,
    lights: Lights | None = None,
    part: tuple[int, int] = (0, 1),
    *,
    surfels: SurfelBVH | None = None,
    kernel: Kernel | None = None,
) -> Radiance:
    """Light that leaves `points` towards the camera.

    Parameters
    ----------
    scene : TraceScene
        What rays meet.
    environment : EnvironmentLight
        What rays see that meet nothing.
    points : ShadingPoints
        Visible points, world space.
    settings : RenderSettings
        Samples per pixel, divided among its ``subpixel_count`` places; bounces, shading model, seed, clamp.
    noise_index : int
        Part of the seed.
    lights : Lights, optional
        All other lights.
    part : tuple of int
        (i, n): only the i-th of n equal parts of each sub-sample's samples; the mean over all parts is the whole.
    surfels : SurfelBVH, optional
        What rays meet of DR-GS objects next to the scene's meshes; then `points` say which surfels are their own.
    kernel : Kernel, optional
        None: that of the CPU.

    Returns
    -------
    Radiance
        Linear Rec.709, never NaN or Inf. A point with a coordinate that is not finite stays black.

    Raises
    ------
    UsageError
        When settings are out of range.
    """
    auto = settings.strategy_samples is None
    counts = settings.strategy_samples or (settings.samples, 0, 0)
    if min(counts) < 0 or settings.bounces < 0 or settings.subpixel_samples < 0:
        problem = "samples, bounces or sub-pixel samples are negative"
        raise UsageError("render settings", problem, "Use counts of zero or more")
    if not (0.0 <= settings.clamp_indirect < np.inf and 0.0 <= settings.noise_threshold < np.inf):
        raise UsageError("render settings", "the clamp or the threshold is no number of at least 0", "Use 0 for none")
    if settings.shading_model not in brdf.SHADING_MODELS:
        problem = f"shading model {settings.shading_model!r} is unknown"
        raise UsageError("render settings", problem, "Use principled or paper")
    n = len(points)
    out = Radiance.dark(n)
    lights = lights or _NO_LIGHTS
    glows = scene.mesh_materials.table.glows
    if n == 0 or sum(counts) == 0 or (environment.black and not lights.count and not glows):
        return out
    share = environment_share(environment, lights)
    # Where neither shines, nothing is drawn by its light, though surfaces may emit some.
    environment_part, lights_part = share * (not environment.black), (1.0 - share) * (lights.count > 0)
    kernel = kernel or Kernel()
    tracer, geometry, envmap, light_tables = kernel.tables(scene, environment, lights)
    if surfels is not None:
        tracer = tracer._replace(**tracer_of(surfels)._asdict())
    tables = (
        tracer,
        geometry,
        F(scene.extent if surfels is None else max(scene.extent, surfels.extent)),
        envmap,
        (not environment.black, lights.count > 0),
        light_tables,
        brdf.layer_table(),
        sampling.point_set(sum(counts) + 1),
    )
    rules = (
        (auto, *map(F, counts), F(environment_part), F(lights_part), _APART if scene.rays_differ else ONE),
        settings.subpixel_count,
        part,
        (settings.bounces, glows),
        brdf.SHADING_MODELS[settings.shading_model],
        U(mixed(settings.seed, noise_index)),
        F(settings.clamp_indirect * settings.subpixel_count * part[1] / sum(counts)),
        (lights.rays_differ, scene.rays_differ and (auto or min(counts[:2]) > 0)),
    )

    def run(some: ShadingPoints, shift: int, found: Radiance) -> None:
        kernel.shade(
            tuple(map(plain, (some.pixel, some.sample, some.flags))),
            tuple(map(plain, (some.origin, some.normal, some.geometric_normal, some.view))),
            tuple(map(plain, (some.albedo, some.roughness, some.metallic, some.own, some.size))),
            *tables,
            *rules,
            shift,
            (found.components, found.moments),
        )

    run(points, 0, out)
    out.variance = variances(points.pixel, out.moments)
    caught = np.flatnonzero(points.flags & CATCHER)
    if len(caught):
        alone = Radiance.dark(len(caught))
        run(points[caught], ray_masks.WITHOUT, alone)
        out.unshadowed = np.zeros(n, np.float32)
        # Not a matrix product: BLAS rounds a row by how many rows there are.
        out.unshadowed[caught] = (alone.total * np.array(LUMINANCE, np.float32)).sum(axis=1)
    return out


def environment_share(environment: EnvironmentLight, lights: Lights) -> float:
    """Part of the light samples that go to the environment; the others go to lights."""
    if not lights.count:
        return 1.0
    if environment.black:
        return 0.0
    share = environment.power / (environment.power + lights.power) if lights.power > 0.0 else 1.0
    return float(min(max(share, _LEAST_SHARE), 1.0 - _LEAST_SHARE))


_NO_LIGHTS = Lights([])


def mixed(seed: int, noise_index: int) -> int:
    """One 32-bit key of the job's seed and the frame's number."""
    value = (seed * 0x9E3779B97F4A7C15 + (noise_index + 1) * 0xD1B54A32D192ED03) & (2**64 - 1)
    value ^= value >> 32
    value = value * 0xD6E8FEB86659FD93 & (2**64 - 1)
    return value >> 32


@njit
def shade_points(  # type: ignore[no-untyped-def]
    lane, lanes, room, keys, frames, surfaces, tracer, geometry, extent, envmap, lit_by, lights, table, sequence, split,
    subpixels, part, bounces, shading_model, seed, limit, differ, shift, out,
):  # fmt: skip
    """Shade every so-manyth (`lanes`) block of points, from the `lane`-th on.

    Parameters
    ----------
    room : tuple
        Scratch memory, see `_room`.
    keys, frames, surfaces : tuple of array
        Of the points.
    out : tuple of array
        Components and moments of their `Radiance`.
    """
    pixel, sample, flags = keys
    components, moments = out
    n = len(pixel)
    blocks = (n + _BLOCK - 1) // _BLOCK
    scene, illumination = (tracer, geometry, extent), (envmap, lit_by[0], lights, lit_by[1])
    rays, paths, found, sums, state, row, total = room
    s, ints = rays
    # Samples of a sub-sample's part lie next to each other among those of the pixel.
    rate = ONE / F(subpixels * part[1])
    for block in range(lane, blocks, lanes):
        start = block * _BLOCK
        end = min(n, start + _BLOCK)
        sums[:] = ZERO
        total[:] = 0
        write_point_states(start, end, frames, surfaces, extent, envmap, shading_model, table, split, state, row)
        begun = np.int64(0)
        for strategy in range(4):
            count = np.int64(0)
            for i in range(start, end):
                h = i - start
                if state[h, ALPHA] < ZERO or state[h, COUNTS + strategy] == ZERO:
                    continue
                own = U(seed ^ mix(U(pixel[i])))
                if flags[i] & SECOND:
                    own = U(own ^ U(0x5BD1E995))
                key = mix(U(mix(own) + U(U(strategy + 1) * GOLDEN)))
                step = state[h, COUNTS + strategy] * rate
                dither = unit(mix(U(key + U(4))))
                # Each position begins with another part, lest a part have samples at all positions of a pixel or none.
                turn = np.int64((np.uint64(U(U(sample[i]) * GOLDEN)) * np.uint64(part[1])) >> np.uint64(32))
                place = F(sample[i] * part[1] + (part[0] + turn) % part[1])
                first, past = np.int64(place * step + dither), np.int64((place + ONE) * step + dither)
                for j in range(first, past):
                    if count == BATCH:
                        begun = trace_batch(
                            strategy, count, rays, paths, begun, found, scene, illumination, table, bounces,
                            shading_model,
                            limit,
                            differ, shift, sums,
                        )  # fmt: skip
                        count = np.int64(0)
                    total[h] += 1
                    put_sample(tracer, s, ints, count, i, h, frames, surfaces, state, rate)
                    _, c = w.at(count)
                    ints[c + w.KEY] = mix(U(key ^ U(U(j + 1) * U(0x85EBCA6B))))
                    ints[c + w.CELL], ints[c + w.ROW] = key, row[h]
                    ints[c + w.N0], ints[c + w.N1], ints[c + w.N2] = sequence[j, 0], sequence[j, 1], sequence[j, 2]
                    count += 1
            if count > 0:
                begun = trace_batch(
                    strategy, count, rays, paths, begun, found, scene, illumination, table, bounces, shading_model,
                    limit,
                    differ,
                    shift, sums,
                )  # fmt: skip
        trace_paths(paths[0], paths[1], begun, scene, illumination, shading_model, table, bounces, shift, found)
        deliver(begun, found, limit, sums)
        for i in range(start, end):
            finish(sums, i - start, total[i - start], components, moments, i)


@njit
def _room() -> Any:
    """Scratch memory of `shade_points`."""
    return (
        w.batch(BATCH),
        w.batch(BATCH),
        np.zeros((BATCH, FOUND), np.float32),
        np.empty((_BLOCK, KINDS * KIND), np.float32),
        np.zeros((_BLOCK, POINT_STATE), np.float32),
        np.zeros(_BLOCK, np.uint32),
        np.empty(_BLOCK, np.int64),
    )


@njit(parallel=True)
def _kernel(  # type: ignore[no-untyped-def]
    keys, frames, surfaces, tracer, geometry, extent, envmap, lit_by, lights, table, sequence, split, subpixels, part,
    bounces, shading_model, seed, limit, differ, shift, out, lanes,
):  # fmt: skip
    # Threads get neighbouring lanes, lanes get every so-manyth block: no thread is left with all the costly ones.
    for lane in prange(lanes):
        shade_points(
            np.int64(lane), lanes, _room(), keys, frames, surfaces, tracer, geometry, extent, envmap, lit_by, lights,
            table, sequence, split, subpixels, part, bounces, shading_model, seed, limit, differ, shift, out,
        )  # fmt: skip
