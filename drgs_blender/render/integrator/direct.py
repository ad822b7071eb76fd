"""Direct light: samples of one strategy in batches (draw, evaluate, pdfs, trace), joined by MIS (balance heuristic)."""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..lights.environment import envmap_radiance
from ..lights.light_shapes import DIFFUSE, GLOSSY
from ..lights.lights import emission_along, lights_along
from ..sampling import ONE, ZERO, F, luminance
from ..scene import ray_masks
from . import wavefront as w
from .indirect import CARRIED, INDIRECT, trace_paths
from .intersect import FAR, light_radiance, meet, passed, put_hit
from .sample_allocation import COSINE, ENVIRONMENT, GGX, LIGHTS

#: Rays of a batch: few enough for the second cache, enough to fill vectors.
BATCH = 512
#: Columns of a block's sums, once each for what samples of environment and lights find, indirect light, and light of
#: lights and surfaces that rays met: diffuse and glossy light, then sum and sum of squares of the luminance of each.
KINDS, KIND, MOMENTS = 3, 10, 6


@njit
def _add(sums, h, kind, qr, qg, qb, sr, sg, sb):  # type: ignore[no-untyped-def]
    """Add what one sample found, diffuse and glossy, to the sums of point h.

    The kinds of light are kept apart because they come in an order that depends on the neighbours.
    """
    k = KIND * kind
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
def _reflect(sums, s, ints, slot, kind, dr, dg, db, gr, gg, gb):  # type: ignore[no-untyped-def]
    """Add what a slot's point reflects of the light that its diffuse and its glossy lobe get along the ray."""
    i, c = w.at(slot)
    _add(
        sums, np.int64(ints[c + w.OWNER]), kind, s[i + w.QR] * dr, s[i + w.QG] * dg, s[i + w.QB] * db,
        s[i + w.SR] * gr, s[i + w.SG] * gg, s[i + w.SB] * gb,
    )  # fmt: skip


@njit
def deliver(count, found, limit, sums):  # type: ignore[no-untyped-def]
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


@njit
def _see_lights(slot, s, ints, reach, hit, cosine, ggx, lights, differ, glows, geometry, sums):  # type: ignore[no-untyped-def]
    """What lights between a point and what its ray hit shine, and what that emits; the BRDF is not yet weighed."""
    i, _ = w.at(slot)
    position, direction = (s[i + w.OX], s[i + w.OY], s[i + w.OZ]), (s[i + w.LX], s[i + w.LY], s[i + w.LZ])
    others, share = cosine * s[i + w.WC] * s[i + w.PC] + ggx * s[i + w.WG] * s[i + w.PG], s[i + w.WL]
    if not others > ZERO:
        return
    dr, dg, db = lights_along(*position, *direction, reach, others, share, DIFFUSE, *lights)
    gr, gg, gb = dr, dg, db
    if differ:
        gr, gg, gb = lights_along(*position, *direction, reach, others, share, GLOSSY, *lights)
    if glows:
        r, g, b, density, glossy = emission_along(*position, *direction, hit, geometry, *lights)
        weight, glossy = ONE / (others + share * density), ONE / (others + share * glossy)
        dr, dg, db = dr + weight * r, dg + weight * g, db + weight * b
        gr, gg, gb = gr + glossy * r, gg + glossy * g, gb + glossy * b
    if dr + dg + db + gr + gg + gb > ZERO:
        _reflect(sums, s, ints, slot, 2, dr, dg, db, gr, gg, gb)


@njit
def _trace_lights(count, s, ints, scene, lights, shading_model, apart, shift, sums):  # type: ignore[no-untyped-def]
    """Light samples: draw, trace, add."""
    w.light_directions(s, ints, count, lights)
    w.evaluate(s, count, shading_model)
    mask = np.int32(ray_masks.SHADOW << shift)
    for slot in range(count):
        i, _ = w.at(slot)
        others, glossy_others = s[i + w.WC] * s[i + w.PC], s[i + w.WG] * s[i + w.PG]
        if not apart:
            others = glossy_others = others + glossy_others
        dr, dg, db, gr, gg, gb = light_radiance(
            s, ints, slot, others, glossy_others, s[i + w.WL], lights, scene[0], mask
        )
        if dr + dg + db + gr + gg + gb > ZERO:
            _reflect(sums, s, ints, slot, 0, dr, dg, db, gr, gg, gb)


@njit
def _see_envmap(count, s, ints, envmap, sums):  # type: ignore[no-untyped-def]
    """Add what the environment sends along the slots' rays; LIVE is the share that gets through."""
    for slot in range(count):
        i, _ = w.at(slot)
        through = s[i + w.LIVE]
        if through > ZERO:
            r, g, b = envmap_radiance(s[i + w.MU], s[i + w.MV], envmap)
            r, g, b = r * through, g * through, b * through
            _reflect(sums, s, ints, slot, 0, r, g, b, r, g, b)


@njit
def _trace_envmap(count, s, ints, tracer, envmap, shading_model, apart, shift, sums):  # type: ignore[no-untyped-def]
    """Samples of the environment: draw, weigh, trace, add."""
    w.environment_directions(s, ints, count, envmap)
    w.evaluate(s, count, shading_model)
    if apart:
        w.weigh_apart(s, count)
    else:
        w.weigh(s, count, ONE, ONE)
    w.warm(s, count, envmap)
    mask = np.int32(ray_masks.SHADOW << shift)
    for slot in range(count):
        i, _ = w.at(slot)
        if s[i + w.LIVE] > ZERO:
            s[i + w.LIVE] = passed(tracer, s, ints, slot, FAR, mask)
    _see_envmap(count, s, ints, envmap, sums)


@njit
def trace_batch(  # type: ignore[no-untyped-def]
    strategy, count, rays, paths, begun, found, scene, illumination, table, bounces, shading_model, limit, differ,
    shift, sums,
):  # fmt: skip
    """Samples of one strategy: draw, weigh, trace, and add what they see; return the number of paths under way."""
    s, ints = rays
    p, path_ints = paths
    tracer = scene[0]
    envmap, envmap_shines, lights, any_lights = illumination
    lights_differ, apart = differ
    w.scramble(ints, count)
    if any_lights and strategy == LIGHTS:
        _trace_lights(count, s, ints, scene, lights, shading_model, apart, shift, sums)
        return begun
    if strategy == ENVIRONMENT:
        _trace_envmap(count, s, ints, tracer, envmap, shading_model, apart, shift, sums)
        return begun
    if strategy == COSINE:
        w.cosine_directions(s, ints, count)
        mask = np.int32(ray_masks.DIFFUSE << shift)
    else:
        w.ggx_directions(s, ints, count)
        mask = np.int32(ray_masks.GLOSSY << shift)
    w.evaluate(s, count, shading_model)
    w.look_up(s, ints, count, envmap)
    cosine = ggx = ONE
    if apart and strategy == COSINE:
        ggx = ZERO
        w.drop(s, count, w.SR)
    if apart and strategy == GGX:
        cosine = ZERO
        w.drop(s, count, w.QR)
    see_lights = any_lights or bounces[1]
    # Lights are seen before the BRDF is weighed, for they have densities of their own: such rays are traced first.
    if not see_lights:
        w.weigh(s, count, cosine, ggx)
    if envmap_shines:
        w.warm(s, count, envmap)
    for slot in range(count):
        i, c = w.at(slot)
        if not s[i + w.LIVE] > ZERO:
            continue
        position, direction = (s[i + w.OX], s[i + w.OY], s[i + w.OZ]), (s[i + w.LX], s[i + w.LY], s[i + w.LZ])
        through, reach, hit = meet(tracer, s, ints, slot, mask)
        if see_lights:
            _see_lights(slot, s, ints, reach, hit, cosine, ggx, lights, lights_differ, bounces[1], scene[1], sums)
            w.weigh_one(s, i, cosine, ggx)
        s[i + w.LIVE] = through
        if through == ONE or bounces[0] == 0:
            continue
        # Light of surfaces is found by these strategies alone: the density of the environment's samples goes out again.
        others = cosine * s[i + w.WC] * s[i + w.PC] + ggx * s[i + w.WG] * s[i + w.PG]
        rest = (ONE - through) * (ONE + s[i + w.WE] * s[i + w.PE] / max(others, F(1e-30)))
        if begun == BATCH:
            trace_paths(p, path_ints, begun, scene, illumination, shading_model, table, bounces, shift, found)
            deliver(begun, found, limit, sums)
            begun = np.int64(0)
        put_hit(tracer, p, path_ints, begun, *position, *direction, hit, ints[c + w.KEY], begun)
        found[begun, CARRIED], found[begun, CARRIED + 1], found[begun, CARRIED + 2] = (
            s[i + w.QR] * rest, s[i + w.QG] * rest, s[i + w.QB] * rest,
        )  # fmt: skip
        found[begun, CARRIED + 3], found[begun, CARRIED + 4], found[begun, CARRIED + 5] = (
            s[i + w.SR] * rest, s[i + w.SG] * rest, s[i + w.SB] * rest,
        )  # fmt: skip
        found[begun, CARRIED + 6] = F(ints[c + w.OWNER])
        begun += 1
    if envmap_shines:
        _see_envmap(count, s, ints, envmap, sums)
    return begun


@njit
def finish(sums, h, total, components, moments, i):  # type: ignore[no-untyped-def]
    """Write out point i: its light, and of either lobe sum and sum of squares of `total` samples' luminance."""
    for lobe in range(2):
        for k in range(3):
            c = 3 * lobe + k
            components[i, 2 * lobe, k] = sums[h, c] + sums[h, 2 * KIND + c]
            components[i, 2 * lobe + 1, k] = sums[h, KIND + c]
        m = MOMENTS + 2 * lobe
        mean, square = ZERO, ZERO
        for kind in range(KINDS):
            mean += sums[h, kind * KIND + m]
            square += sums[h, kind * KIND + m + 1]
        moments[i, 1 + 2 * lobe], moments[i, 2 + 2 * lobe] = mean, square
    moments[i, 0] = F(total)
