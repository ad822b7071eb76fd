"""The integrator: direct light by multiple importance sampling, then indirect light by path tracing.

See docs/rendering.md for the estimator. Everything here runs in blocks of points, in parallel, each block in batches of
rays (`wavefront`); a point's result depends on nothing but the point, the scene, the light, the settings, the seed and
the frame number.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...compute.jit import njit
from ...compute.threads import over_strided
from ...core.color import LUMINANCE
from ...core.errors import UsageError
from ...core.frame import RenderSettings
from .. import sampling
from ..lights.environment import EnvironmentLight
from ..lights.light_sampler import Lights
from ..sampling import GOLDEN, ONE, ZERO, F, U, mix, unit
from ..scene import ray_masks
from ..scene.trace_scene import TraceScene
from ..shading_points import CATCHER, RECEIVER, SECOND, PointArrays, Radiance, ShadingPoints
from ..surfels.surfel_bvh import SurfelBVH
from ..surfels.surfel_tracer import tracer_of
from . import brdf
from . import wavefront as w
from .direct import BATCH, KIND, KINDS, deliver, finish, trace_batch
from .group_sums import FOUND, MOMENTS, group_columns
from .indirect import trace_paths
from .intersect import meshes_alone
from .multiscatter import energy_tables
from .records import Sampler, Scene, Settings, Traits
from .sample_allocation import ALPHA, COUNTS, POINT_STATE, put_sample, write_point_states
from .variance import variances

Array = np.ndarray

#: Largest share of the samples that goes to the light where rays of different kinds meet different objects: there the
#: picture follows from how strategies are weighed (docs/rendering.md), and this comes closest to Cycles.
_MAX_LIGHT_SHARE = F(0.25)
#: Settings beyond are no float32.
_LARGEST = float(np.finfo(np.float32).max)
#: Points of a block.
_BLOCK = 64
#: Least share of the light samples that go to environment or lights when both shine.
_LEAST_SHARE = 0.1


class ShadingKernel:
    """The kernel that shades points, with its scene: on all CPU threads; `render.gpu` has the same for a card."""

    def tables(self, scene: TraceScene, environment: EnvironmentLight, lights: Lights) -> tuple[Any, Any, Any, Any]:
        """(tracer, geometry, environment, lights) as `shade` takes them; until the scene's next update."""
        return (
            meshes_alone(scene.tracer),
            scene.geometry,
            environment.envmap,
            lights.grouped or lights.linked or lights.tables,
        )

    def light(self, points: ShadingPoints, scene: Scene, settings: Settings, sampler: Sampler, found: Radiance) -> None:
        """Write the light of all points to `found`."""
        self.shade(points.arrays, scene, settings, sampler, (found.components, found.moments))

    def shade(
        self, points: PointArrays, scene: Scene, settings: Settings, sampler: Sampler, out: tuple[Array, Array]
    ) -> None:
        """Shade all points; see `shade_points`."""
        blocks = -(-len(points.pixel) // _BLOCK)
        over_strided(_kernel, blocks, points, scene, settings, sampler, out)


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
    kernel: ShadingKernel | None = None,
) -> Radiance:
    """Light that leaves `points` towards the camera.

    Parameters
    ----------
    scene : TraceScene
        Scene that rays are traced in.
    environment : EnvironmentLight
        Light of rays that meet nothing.
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
        Surfels of DR-GS objects, traced next to the meshes; then `points` say which surfels are their own.
    kernel : ShadingKernel, optional
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
    if not all(
        0.0 <= x < _LARGEST for x in (settings.clamp_indirect, settings.filter_glossy, settings.noise_threshold)
    ):
        problem = "Clamp Indirect, Filter Glossy or the noise threshold is no number of at least 0"
        raise UsageError("render settings", problem, "Use 0 for none")
    if settings.shading_model not in brdf.SHADING_MODELS:
        problem = f"shading model {settings.shading_model!r} is unknown"
        raise UsageError("render settings", problem, "Use principled or paper")
    n = len(points)
    out = Radiance.dark(n)
    lights = lights or _NO_LIGHTS
    emissive = scene.mesh_materials.table.emissive
    if n == 0 or sum(counts) == 0 or (environment.black and not lights.count and not emissive):
        return out
    share = environment_share(environment, lights)
    # Where neither shines, nothing is drawn by its light, though surfaces may emit some.
    environment_part, lights_part = share * (not environment.black), (1.0 - share) * (lights.count > 0)
    kernel = kernel or ShadingKernel()
    tracer, geometry, envmap, light_tables = kernel.tables(scene, environment, lights)
    if surfels is not None:
        tracer = tracer._replace(**tracer_of(surfels)._asdict())
    extent = F(scene.extent if surfels is None else max(scene.extent, surfels.extent))
    apart = scene.rays_differ and (auto or min(counts[:2]) > 0)
    shines = not environment.black, lights.count > 0, emissive
    table = scene.mesh_materials.table
    traits = Traits(extent, *shines, lights.rays_differ, apart, table.detailed, table.clear, table.multiscatter)
    given = Scene(tracer, geometry, envmap, light_tables, traits)
    limits = F(settings.clamp_indirect * settings.subpixel_count * part[1] / sum(counts)), F(settings.filter_glossy)
    tables = brdf.layer_table(), *energy_tables()
    how = Settings(settings.bounces, brdf.SHADING_MODELS[settings.shading_model], *tables, *limits)
    seed, sequence = U(hash_seed(settings.seed, noise_index)), sampling.point_set(sum(counts) + 1)
    shares = F(environment_part), F(lights_part), _MAX_LIGHT_SHARE if scene.rays_differ else ONE
    sampler = Sampler._make([seed, sequence, settings.subpixel_count, *part, auto, *map(F, counts), *shares])

    def run(some: ShadingPoints, shift: int, found: Radiance) -> None:
        kernel.light(some, given, how._replace(shift=shift), sampler, found)

    groups = 0 if lights.grouped is None else lights.grouped.number
    out.moments = np.zeros((n, MOMENTS + 3 * groups), np.float32)
    run(points, 0, out)
    if groups:
        out.groups = out.moments[:, MOMENTS:].reshape(n, groups, 3).copy()
        out.moments = np.ascontiguousarray(out.moments[:, :MOMENTS])
    out.variance = variances(points.pixel, out.moments)
    caught = np.flatnonzero(points.flags & CATCHER)
    if len(caught):
        alone = Radiance.dark(len(caught))
        alone.moments = np.zeros((len(caught), MOMENTS + 3 * groups), np.float32)
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


def hash_seed(seed: int, noise_index: int) -> int:
    """A 32-bit hash of the seed and the noise index."""
    value = (seed * 0x9E3779B97F4A7C15 + (noise_index + 1) * 0xD1B54A32D192ED03) & (2**64 - 1)
    value ^= value >> 32
    value = value * 0xD6E8FEB86659FD93 & (2**64 - 1)
    return value >> 32


class Scratch(NamedTuple):
    """Memory that `shade_points` works in.

    Attributes
    ----------
    rays : Batch
        Samples of points, BATCH of them.
    paths : Batch
        Paths that these begin.
    found : (BATCH, FOUND) float32 array
        Light of the paths, see `indirect`.
    sums : (block, KINDS * KIND) float32 array
        Light of the block's points, see `direct`; wider where lights have groups, as is `found`.
    state : (block, POINT_STATE) float32 array
        State shared by their samples, see `sample_allocation`.
    row : (block,) uint32 array
        Their rows in the environment's tables.
    total : (block,) int64 array
        Their samples.
    """

    rays: w.Batch
    paths: w.Batch
    found: Array
    sums: Array
    state: Array
    row: Array
    total: Array


@njit
def shade_points(thread, stride, scratch, points, scene, settings, sampler, out):  # type: ignore[no-untyped-def]
    """Shade every `stride`-th block of points, from the `thread`-th on.

    Parameters
    ----------
    thread, stride : int64
    scratch : Scratch
    points : PointArrays
    scene : Scene
    settings : Settings
    sampler : Sampler
    out : tuple of array
        Components (n, 4, 3) and moments (n, 5 or more, see `direct.finish`) of the points' `Radiance`.
    """
    components, moments = out
    n = len(points.pixel)
    blocks = (n + _BLOCK - 1) // _BLOCK
    rays, sums, state, total, seed = scratch.rays, scratch.sums, scratch.state, scratch.total, sampler.seed
    ints, part, parts = rays.ints, sampler.part, sampler.parts
    # Samples of a sub-sample's part lie next to each other among those of the pixel.
    rate = ONE / F(sampler.subpixels * parts)
    for block in range(thread, blocks, stride):
        start = block * _BLOCK
        end = min(n, start + _BLOCK)
        sums[:] = ZERO
        total[:] = 0
        write_point_states(start, end, points, scene, settings, sampler, scratch)
        begun = np.int64(0)
        for strategy in range(4):
            count = np.int64(0)
            for i in range(start, end):
                h = i - start
                if state[h, ALPHA] < ZERO or state[h, COUNTS + strategy] == ZERO:
                    continue
                own = U(seed ^ mix(U(points.pixel[i])))
                if points.flags[i] & SECOND:
                    own = U(own ^ U(0x5BD1E995))
                key = mix(U(mix(own) + U(U(strategy + 1) * GOLDEN)))
                step = state[h, COUNTS + strategy] * rate
                dither = unit(mix(U(key + U(4))))
                sample = points.sample[i]
                # Each position begins with another part, so that each part has samples at some positions of a pixel.
                turn = np.int64((np.uint64(U(U(sample) * GOLDEN)) * np.uint64(parts)) >> np.uint64(32))
                place = F(sample * parts + (part + turn) % parts)
                first, past = np.int64(place * step + dither), np.int64((place + ONE) * step + dither)
                for j in range(first, past):
                    if count == BATCH:
                        begun = trace_batch(strategy, count, begun, scratch, scene, settings)
                        count = np.int64(0)
                    total[h] += 1
                    put_sample(scene, rays, count, points, i, state, h, rate)
                    a, c = w.at(count)
                    rays.floats[a + w.POINT_SET] = F(points.flags[i] >> RECEIVER)
                    ints[c + w.KEY] = mix(U(key ^ U(U(j + 1) * U(0x85EBCA6B))))
                    ints[c + w.CELL], ints[c + w.ROW] = key, scratch.row[h]
                    sequence = sampler.sequence
                    ints[c + w.N0], ints[c + w.N1], ints[c + w.N2] = sequence[j, 0], sequence[j, 1], sequence[j, 2]
                    count += 1
            if count > 0:
                begun = trace_batch(strategy, count, begun, scratch, scene, settings)
        trace_paths(scratch.paths, begun, scene, settings, scratch.found)
        deliver(begun, scratch.found, settings.clamp, scene.lights, sums)
        for i in range(start, end):
            finish(scene.lights, sums, i - start, total[i - start], components, moments, i)


@njit
def _scratch(lights: Any) -> Any:
    groups = group_columns(lights)
    return Scratch(
        w.batch(BATCH),
        w.batch(BATCH),
        np.zeros((BATCH, FOUND + groups), np.float32),
        np.empty((_BLOCK, KINDS * KIND + KINDS * groups), np.float32),
        np.zeros((_BLOCK, POINT_STATE), np.float32),
        np.zeros(_BLOCK, np.uint32),
        np.empty(_BLOCK, np.int64),
    )


@njit
def _kernel(first, last, stride, points, scene, settings, sampler, out):  # type: ignore[no-untyped-def]
    # Every n-th block: none has all the costly ones.
    scratch = _scratch(scene.lights)
    for thread in range(first, last):
        shade_points(thread, stride, scratch, points, scene, settings, sampler, out)
