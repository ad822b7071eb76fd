"""Light at the visible points: multi-strategy direct light with ray-traced visibility, then paths traced on.

See docs/rendering.md for the estimator. Everything here runs in blocks of points, in parallel, each block in batches of
rays (`wave`); a point's result depends on nothing but the point, the scene, the light, the settings, the seed and the
frame number.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...colour import LUMINANCE
from ...errors import UsageError
from ...frame import RenderSettings
from ...jit import get_num_threads, njit, prange
from .. import sampling
from ..lights.lamp_shapes import DIFFUSE, GLOSSY
from ..lights.lamps import Lamps, lamps_along
from ..lights.light import EnvironmentLight, sky_radiance
from ..points import CATCHER, SECOND, Radiance, ShadingPoints
from ..sampling import GOLDEN, ONE, ZERO, F, U, luminance, mix, unit
from ..trace import masks
from ..trace.scene import TraceScene
from ..trace.surface import nearest
from . import brdf
from . import wave as w
from .paths import CARRIED, EMITTED, FOUND, INDIRECT, add_path, lifted, trace_paths

Array = np.ndarray

_FAR = F(np.inf)
#: Points of a block, and rays of a batch: few enough for the second cache, enough to fill vectors.
_BLOCK, _BATCH = 64, 512
#: Strategies in the order of ``RenderSettings``' counts; the samples of the last are divided between sky and lamps.
_COSINE, _GGX, _SKY, _LAMPS = range(4)
#: Columns of a block's sums, once each for light of the sky and lamp samples, indirect light, that of emitting surfaces
#: and of lamps that rays met: diffuse and glossy light, then sum and sum of squares of the luminance of each.
_KINDS, _KIND, _MOMENTS = 4, 10, 6
#: Least share of the light samples that go to sky or lamps when both shine.
_LEAST_SHARE = 0.1


def integrate(
    scene: TraceScene,
    light: EnvironmentLight,
    points: ShadingPoints,
    settings: RenderSettings,
    frame_number: int,
    lamps: Lamps | None = None,
    part: tuple[int, int] = (0, 1),
) -> Radiance:
    """Light that leaves `points` towards the camera.

    Parameters
    ----------
    scene, light, lamps : what rays meet, what they see when they meet nothing, and what shines in between
    points : visible points, world space
    settings : ``cosine``, ``ggx`` and ``environment`` samples a pixel, divided among its ``aa`` sub-samples;
        ``bounces``, ``look``, ``seed``, ``clamp_indirect``
    frame_number : int, part of the seed
    part : (i, n): only the i-th of n equal parts of each sub-sample's samples, which must be divisible by n; the mean
        over all parts is the whole

    Returns
    -------
    Radiance
        Linear Rec.709, never NaN or Inf. A point with a coordinate that is not finite stays black.

    Raises
    ------
    UsageError
        When settings are out of range.
    """
    counts = (settings.cosine, settings.ggx, settings.environment)
    if min(counts) < 0 or settings.bounces < 0 or settings.aa < 1:
        raise UsageError(
            "render settings", "samples, bounces or aa are negative", "Use counts of zero or more, aa >= 1"
        )
    if not (0.0 <= settings.clamp_indirect < np.inf and 0.0 <= settings.noise_threshold < np.inf):
        raise UsageError("render settings", "the clamp or the threshold is no number of at least 0", "Use 0 for none")
    if settings.look not in brdf.LOOKS:
        raise UsageError("render settings", f"look {settings.look!r} is unknown", "Use principled or paper")
    n = len(points)
    components, variance = np.zeros((n, 4, 3), np.float32), np.zeros((n, 2), np.float32)
    lamps = lamps or _NO_LAMPS
    glows = scene.materials.glows
    if n == 0 or sum(counts) == 0 or (light.black and not lamps.count and not glows):
        return Radiance(components, variance)
    share = sky_share(light, lamps)
    tables = (
        scene.tracer,
        scene.geometry,
        F(scene.extent),
        light.sky,
        (
            not light.black,
            U(min(share * 2.0**32, 2.0**32 - 1)),
            lamps.count > 0,
            not light.black and not scene.materials.glows,
        ),
        (lamps.table, lamps.pick),
        brdf.layer_table(),
        (
            sampling.sobol(max(counts)),
            np.array(counts, np.int32),
            np.array([(1 << (32 - max(0, (n - 1).bit_length()))) - 1 for n in counts], np.uint32),
        ),
    )
    samples = [count / settings.aa / part[1] for count in counts]
    # Where neither shines, nothing is drawn by its light, though surfaces may emit some.
    sky_samples, lamp_samples = samples[2] * share * (not light.black), samples[2] * (1.0 - share) * (lamps.count > 0)
    shares = (F(samples[0]), F(samples[1]), F(sky_samples), F(lamp_samples))
    rules = (
        settings.aa,
        part,
        shares,
        (settings.bounces, glows),
        brdf.LOOKS[settings.look],
        U(mixed(settings.seed, frame_number)),
        F(settings.clamp_indirect / max(1.0, sum(samples))),
        (lamps.rays_differ, scene.rays_differ and min(counts[:2]) > 0),
    )

    def run(some: ShadingPoints, shift: int, components: Array, variance: Array) -> None:
        _kernel(
            (some.pixel, some.sample, some.flags),
            (some.origin, some.normal, some.geometric_normal, some.view),
            (some.albedo, some.roughness, some.metallic),
            *tables,
            *rules,
            shift,
            8 * get_num_threads(),
            components,
            variance,
        )

    run(points, 0, components, variance)
    unshadowed = None
    caught = np.flatnonzero(points.flags & CATCHER)
    if len(caught):
        alone = np.zeros((len(caught), 4, 3), np.float32)
        run(points[caught], masks.WITHOUT, alone, np.zeros((len(caught), 2), np.float32))
        unshadowed = np.zeros(n, np.float32)
        unshadowed[caught] = alone.sum(axis=1) @ np.array(LUMINANCE, np.float32)
    return Radiance(components, variance, unshadowed)


def sky_share(light: EnvironmentLight, lamps: Lamps) -> float:
    """Part of the light samples that go to the environment; the others go to lamps."""
    if not lamps.count:
        return 1.0
    if light.black:
        return 0.0
    share = light.power / (light.power + lamps.power) if lamps.power > 0.0 else 1.0
    return float(min(max(share, _LEAST_SHARE), 1.0 - _LEAST_SHARE))


_NO_LAMPS = Lamps([])


def mixed(seed: int, frame_number: int) -> int:
    """One 32-bit key of the job's seed and the frame's number."""
    value = (seed * 0x9E3779B97F4A7C15 + (frame_number + 1) * 0xD1B54A32D192ED03) & (2**64 - 1)
    value ^= value >> 32
    value = value * 0xD6E8FEB86659FD93 & (2**64 - 1)
    return value >> 32


@njit
def _heads(first: Any, last: Any, frames: Any, surfaces: Any, extent: Any, look: Any, table: Any, head: Any) -> None:
    """What all samples of a point share: start of its rays, alpha squared (-1: unusable), diffuse weight, normal m."""
    origin, normal, flat, view = frames
    albedo, roughness, metallic = surfaces
    for i in range(first, last):
        h = i - first
        check = roughness[i] + metallic[i]
        for k in range(3):
            check += origin[i, k] + normal[i, k] + flat[i, k] + view[i, k] + albedo[i, k]
        if not abs(check) < F(1e18):
            head[h, 3] = -ONE
            continue
        gx, gy, gz, vx, vy, vz = flat[i, 0], flat[i, 1], flat[i, 2], view[i, 0], view[i, 1], view[i, 2]
        head[h, 0], head[h, 1], head[h, 2] = lifted(origin[i, 0], origin[i, 1], origin[i, 2], gx, gy, gz, extent)
        mx, my, mz = brdf.glossy_normal(normal[i, 0], normal[i, 1], normal[i, 2], gx, gy, gz, vx, vy, vz)
        head[h, 3] = brdf.alpha_squared(roughness[i])
        head[h, 4] = brdf.diffuse_weight(roughness[i], metallic[i], mx * vx + my * vy + mz * vz, look, table)
        head[h, 5], head[h, 6], head[h, 7] = mx, my, mz


@njit
def _put(s: Any, ints: Any, slot: Any, i: Any, h: Any, frames: Any, surfaces: Any, head: Any) -> None:
    """Copy point i, the h-th of its block, into a slot."""
    _, normal, flat, view = frames
    albedo, _, metallic = surfaces
    a, c = w.at(slot)
    s[a + w.OX], s[a + w.OY], s[a + w.OZ] = head[h, 0], head[h, 1], head[h, 2]
    s[a + w.NX], s[a + w.NY], s[a + w.NZ] = normal[i, 0], normal[i, 1], normal[i, 2]
    s[a + w.MX], s[a + w.MY], s[a + w.MZ] = head[h, 5], head[h, 6], head[h, 7]
    s[a + w.GX], s[a + w.GY], s[a + w.GZ] = flat[i, 0], flat[i, 1], flat[i, 2]
    s[a + w.VX], s[a + w.VY], s[a + w.VZ] = view[i, 0], view[i, 1], view[i, 2]
    s[a + w.AR], s[a + w.AG], s[a + w.AB] = albedo[i, 0], albedo[i, 1], albedo[i, 2]
    s[a + w.METALLIC], s[a + w.A2], s[a + w.KD] = metallic[i], head[h, 3], head[h, 4]
    ints[c + w.OWNER] = U(h)


@njit
def _add(sums: Any, h: Any, kind: Any, qr: Any, qg: Any, qb: Any, sr: Any, sg: Any, sb: Any) -> None:
    """Add what one sample found, diffuse and glossy, to the sums of point h.

    The kinds of light are kept apart because they come in an order that depends on the neighbours.
    """
    k = _KIND * kind
    sums[h, k] += qr
    sums[h, k + 1] += qg
    sums[h, k + 2] += qb
    sums[h, k + 3] += sr
    sums[h, k + 4] += sg
    sums[h, k + 5] += sb
    value = luminance(qr, qg, qb)
    sums[h, k + 6] += value
    sums[h, k + 7] += value * value
    value = luminance(sr, sg, sb)
    sums[h, k + 8] += value
    sums[h, k + 9] += value * value


@njit
def _reflect(
    sums: Any, s: Any, ints: Any, slot: Any, kind: Any, dr: Any, dg: Any, db: Any, gr: Any, gg: Any, gb: Any
) -> None:
    """Add what a slot's point reflects of the light that its diffuse and its glossy lobe get along the ray."""
    i, c = w.at(slot)
    _add(
        sums, np.int64(ints[c + w.OWNER]), kind, s[i + w.QR] * dr, s[i + w.QG] * dg, s[i + w.QB] * db,
        s[i + w.SR] * gr, s[i + w.SG] * gg, s[i + w.SB] * gb,
    )  # fmt: skip


@njit
def _deliver(count: Any, found: Any, limit: Any, sums: Any) -> None:
    """Add the light of finished paths to their points; `limit` bounds the mean of an indirect sample's channels."""
    for path in range(count):
        h = np.int64(found[path, CARRIED + 6])
        fr, fg, fb = found[path, CARRIED], found[path, CARRIED + 1], found[path, CARRIED + 2]
        hr, hg, hb = found[path, CARRIED + 3], found[path, CARRIED + 4], found[path, CARRIED + 5]
        r, g, b = found[path, INDIRECT], found[path, INDIRECT + 1], found[path, INDIRECT + 2]
        k = ONE
        if limit > ZERO:
            mean = (r * (fr + hr) + g * (fg + hg) + b * (fb + hb)) / F(3.0)
            k = limit / mean if mean > limit else ONE
        r, g, b = r * k, g * k, b * k
        _add(sums, h, 1, fr * r, fg * g, fb * b, hr * r, hg * g, hb * b)
        r, g, b = found[path, EMITTED], found[path, EMITTED + 1], found[path, EMITTED + 2]
        if r + g + b > ZERO:
            _add(sums, h, 2, fr * r, fg * g, fb * b, hr * r, hg * g, hb * b)


@njit
def _see_lamps(
    slot: Any, s: Any, ints: Any, distance: Any, cosine: Any, ggx: Any, share: Any, lamps: Any, differ: Any, sums: Any
) -> None:
    """Lamps between a point and what its ray hit; the BRDF is not yet weighed."""
    i, _ = w.at(slot)
    position, direction = (s[i + w.OX], s[i + w.OY], s[i + w.OZ]), (s[i + w.LX], s[i + w.LY], s[i + w.LZ])
    others = cosine * s[i + w.PC] + ggx * s[i + w.PG]
    if not others > ZERO:
        return
    dr, dg, db = lamps_along(*position, *direction, distance, others, share, DIFFUSE, *lamps)
    gr, gg, gb = dr, dg, db
    if differ:
        gr, gg, gb = lamps_along(*position, *direction, distance, others, share, GLOSSY, *lamps)
    if dr + dg + db + gr + gg + gb > ZERO:
        _reflect(sums, s, ints, slot, 3, dr, dg, db, gr, gg, gb)


@njit
def _trace_lamps(
    count: Any, s: Any, ints: Any, scene: Any, lamps: Any, shares: Any, look: Any, apart: Any, shift: Any, sums: Any
) -> None:
    """Lamp samples: draw, trace, add."""
    w.lamp_directions(s, ints, count, lamps)
    w.evaluate(s, count, look)
    mask = np.int32(masks.SHADOW << shift)
    for slot in range(count):
        i, _ = w.at(slot)
        others, glossy_others = shares[_COSINE] * s[i + w.PC], shares[_GGX] * s[i + w.PG]
        if not apart:
            others = glossy_others = others + glossy_others
        dr, dg, db, gr, gg, gb = w.lamp_light(
            s, ints, slot, others, glossy_others, shares[_LAMPS], lamps, scene[0], mask
        )
        if dr + dg + db + gr + gg + gb > ZERO:
            _reflect(sums, s, ints, slot, 0, dr, dg, db, gr, gg, gb)


@njit
def _trace(
    strategy: Any, count: Any, rays: Any, paths: Any, begun: Any, found: Any, scene: Any, lights: Any, table: Any,
    shares: Any, bounces: Any, look: Any, below: Any, limit: Any, differ: Any, shift: Any, sums: Any,
) -> Any:  # fmt: skip
    """Samples of one strategy: draw, weigh, trace, and add what they see; return the number of paths under way."""
    s, ints = rays
    p, path_ints = paths
    tracer = scene[0]
    sky, sky_shines, lamps, _, any_lamps = lights
    lamps_differ, apart = differ
    w.jitter(ints, count, below)
    if strategy == _LAMPS:
        _trace_lamps(count, s, ints, scene, lamps, shares, look, apart, shift, sums)
        return begun
    cosine, ggx = shares[_COSINE], shares[_GGX]
    if strategy == _COSINE:
        w.cosine_directions(s, ints, count)
        mask = np.int32(masks.DIFFUSE << shift)
    elif strategy == _GGX:
        w.ggx_directions(s, ints, count)
        mask = np.int32(masks.GLOSSY << shift)
    else:
        w.light_directions(s, ints, count, sky)
        mask = np.int32(masks.SHADOW << shift)
    w.evaluate(s, count, look)
    if strategy != _SKY:
        w.look_up(s, count, sky)
    if apart and strategy == _COSINE:
        ggx = ZERO
        w.drop(s, count, w.SR)
    if apart and strategy == _GGX:
        cosine = ZERO
        w.drop(s, count, w.QR)
    see_lamps = strategy != _SKY and any_lamps
    # Lamps are seen before the BRDF is weighed, for they have densities of their own: such rays are traced first.
    if apart and strategy == _SKY:
        w.weigh_apart(s, count, cosine, ggx, shares[_SKY])
    elif not see_lamps:
        w.weigh(s, count, cosine, ggx, shares[_SKY])
    if sky_shines:
        w.warm(s, count, sky)
    for slot in range(count):
        i, c = w.at(slot)
        if not s[i + w.LIVE] > ZERO:
            continue
        position, direction = (s[i + w.OX], s[i + w.OY], s[i + w.OZ]), (s[i + w.LX], s[i + w.LY], s[i + w.LZ])
        hit = nearest(tracer, *position, *direction, ZERO, _FAR, mask)
        if see_lamps:
            _see_lamps(slot, s, ints, hit[0], cosine, ggx, shares[_LAMPS], lamps, lamps_differ, sums)
            w.weigh_one(s, i, cosine, ggx, shares[_SKY])
        if hit[1] < 0:
            continue
        s[i + w.LIVE] = ZERO
        if bounces[0] == 0 and not bounces[1]:
            continue
        if begun == _BATCH:
            trace_paths(p, path_ints, begun, scene, _path_lights(lights), look, table, bounces, shift, found)
            _deliver(begun, found, limit, sums)
            begun = np.int64(0)
        add_path(p, path_ints, begun, position, direction, hit, ints[c + w.KEY], begun)
        found[begun, CARRIED], found[begun, CARRIED + 1], found[begun, CARRIED + 2] = (
            s[i + w.QR], s[i + w.QG], s[i + w.QB],
        )  # fmt: skip
        found[begun, CARRIED + 3], found[begun, CARRIED + 4], found[begun, CARRIED + 5] = (
            s[i + w.SR], s[i + w.SG], s[i + w.SB],
        )  # fmt: skip
        found[begun, CARRIED + 6] = F(ints[c + w.OWNER])
        begun += 1
    if not sky_shines:
        return begun
    for slot in range(count):
        i, c = w.at(slot)
        if s[i + w.LIVE] > ZERO:
            r, g, b = sky_radiance(s[i + w.MU], s[i + w.MV], sky)
            _reflect(sums, s, ints, slot, 0, r, g, b, r, g, b)
    return begun


@njit
def _path_lights(lights: Any) -> Any:
    """Lights as `trace_paths` takes them: one sample of the lamps a vertex where there are any."""
    return lights[0], lights[1], lights[2], ONE if lights[4] else ZERO


@njit
def _finish(sums: Any, h: Any, total: Any, components: Any, variance: Any, i: Any) -> None:
    """Write out point i. Variance of a sum of `total` samples from their spread; from one sample alone, its square."""
    for lobe in range(2):
        for k in range(3):
            c = 3 * lobe + k
            components[i, 2 * lobe, k] = sums[h, c] + sums[h, 2 * _KIND + c] + sums[h, 3 * _KIND + c]
            components[i, 2 * lobe + 1, k] = sums[h, _KIND + c]
        m = _MOMENTS + 2 * lobe
        mean, square = ZERO, ZERO
        for kind in range(_KINDS):
            mean += sums[h, kind * _KIND + m]
            square += sums[h, kind * _KIND + m + 1]
        if total > 1:
            n = F(total)
            square = max(ZERO, square - mean * mean / n) * (n / (n - ONE))
        variance[i, lobe] = square


@njit
def _divided(number: Any, threshold: Any) -> Any:
    """Split a random number at a threshold: (whether it is below, a random number again)."""
    whole, n = np.uint64(threshold), np.uint64(number)
    if n < whole:
        return True, U((n << np.uint64(32)) // whole)
    return False, U(((n - whole) << np.uint64(32)) // (np.uint64(1 << 32) - whole))


@njit
def _lane(
    lane: Any, keys: Any, frames: Any, surfaces: Any, tracer: Any, geometry: Any, extent: Any, sky: Any, sky_rules: Any,
    lamps: Any, table: Any, numbers: Any, aa: Any, part: Any, shares: Any, bounces: Any, look: Any, seed: Any,
    limit: Any, differ: Any, shift: Any, lanes: Any, components: Any, variance: Any,
) -> None:  # fmt: skip
    """Every so-manyth block of points, from the `lane`-th on."""
    pixel, sample, flags = keys
    sequence, counts, strata = numbers
    n = len(pixel)
    blocks = (n + _BLOCK - 1) // _BLOCK
    scene, lights = (tracer, geometry, extent), (sky, sky_rules[0], lamps, sky_rules[1], sky_rules[2])
    rays, paths = w.batch(_BATCH), w.batch(_BATCH)
    s, ints = rays
    found = np.zeros((_BATCH, FOUND), np.float32)
    sums = np.empty((_BLOCK, _KINDS * _KIND), np.float32)
    head = np.empty((_BLOCK, 8), np.float32)
    total = np.empty(_BLOCK, np.int64)
    for block in range(lane, blocks, lanes):
        start = block * _BLOCK
        end = min(n, start + _BLOCK)
        sums[:] = ZERO
        total[:] = 0
        _heads(start, end, frames, surfaces, extent, look, table, head)
        begun = np.int64(0)
        for strategy in range(4):
            if strategy >= _SKY and shares[strategy] == ZERO:
                continue
            source = min(strategy, _SKY)
            both = strategy >= _SKY and shares[_SKY] > ZERO and shares[_LAMPS] > ZERO
            # The point set fills strata of 2^32 / n; below them every point is moved by itself.
            below = strata[source]
            step = F(counts[source]) / F(aa)
            count = np.int64(0)
            for i in range(start, end):
                h = i - start
                if head[h, 3] < ZERO:
                    continue
                own = U(seed ^ mix(U(pixel[i])))
                if flags[i] & SECOND:
                    own = U(own ^ U(0x5BD1E995))
                key = mix(U(mix(own) + U(U(source + 1) * GOLDEN)))
                shift_0, shift_1 = U(mix(U(key + U(1))) & ~below), U(mix(U(key + U(2))) & ~below)
                shift_2 = U(mix(U(key + U(3))) & ~below)
                # This sub-sample's part of the pixel's samples: n / aa on average, n over all sub-samples together.
                dither = unit(mix(U(key + U(4)))) if counts[source] % aa else ZERO
                first = np.int64(F(sample[i]) * step + dither)
                past = np.int64(F(sample[i] + 1) * step + dither)
                if sample[i] + 1 == aa:
                    past = np.int64(counts[source])
                if part[1] > 1:
                    size = past - first
                    first, past = first + size * part[0] // part[1], first + size * (part[0] + 1) // part[1]
                for j in range(first, past):
                    key_j = mix(U(key ^ U(U(j + 1) * U(0x85EBCA6B))))
                    number = U(0)
                    if strategy >= _SKY:
                        number = U((sequence[j, 2] ^ shift_2) + (mix(U(key_j + U(7))) & below))
                        if both:
                            towards_sky, number = _divided(number, lights[3])
                            if towards_sky != (strategy == _SKY):
                                continue
                    if count == _BATCH:
                        begun = _trace(
                            strategy, count, rays, paths, begun, found, scene, lights, table, shares, bounces,
                            look, below, limit, differ, shift, sums,
                        )  # fmt: skip
                        count = np.int64(0)
                    total[h] += 1
                    _put(s, ints, count, i, h, frames, surfaces, head)
                    _, c = w.at(count)
                    ints[c + w.KEY] = key_j
                    ints[c + w.N0] = U(sequence[j, 0] ^ shift_0)
                    ints[c + w.N1] = U(sequence[j, 1] ^ shift_1)
                    ints[c + w.N2] = number
                    count += 1
            begun = _trace(
                strategy, count, rays, paths, begun, found, scene, lights, table, shares, bounces, look, below,
                limit, differ, shift, sums,
            )  # fmt: skip
        trace_paths(paths[0], paths[1], begun, scene, _path_lights(lights), look, table, bounces, shift, found)
        _deliver(begun, found, limit, sums)
        for i in range(start, end):
            _finish(sums, i - start, total[i - start], components, variance, i)


@njit(parallel=True)
def _kernel(
    keys: Any, frames: Any, surfaces: Any, tracer: Any, geometry: Any, extent: Any, sky: Any, sky_rules: Any,
    lamps: Any, table: Any, numbers: Any, aa: Any, part: Any, shares: Any, bounces: Any, look: Any, seed: Any,
    limit: Any, differ: Any, shift: Any, lanes: Any, components: Any, variance: Any,
) -> None:  # fmt: skip
    # Threads get neighbouring lanes, lanes get every so-manyth block: no thread is left with all the costly ones.
    for lane in prange(lanes):
        _lane(
            np.int64(lane),
            keys,
            frames,
            surfaces,
            tracer,
            geometry,
            extent,
            sky,
            sky_rules,
            lamps,
            table,
            numbers,
            aa,
            part,
            shares,
            bounces,
            look,
            seed,
            limit,
            differ,
            shift,
            lanes,
            components,
            variance,
        )
