"""Direct light: samples of one strategy in batches (draw, evaluate, pdfs, trace), joined by MIS (balance heuristic).

Multiple importance sampling with the balance heuristic (the power heuristic with exponent 1): each sample is divided by
the sum of all strategies' pdfs.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..lights.environment import envmap_radiance
from ..lights.light_groups import group_of_environment, group_of_hit, group_of_sample
from ..lights.light_links import emits_to, lights_of
from ..lights.light_sampler import emission_along, lights_along
from ..lights.light_shapes import DIFFUSE, GLOSSY
from ..sampling import ONE, ZERO, F, luminance
from ..scene import ray_masks
from . import mis
from . import wavefront as w
from .group_sums import KIND, KINDS, credit_lamps_of_point, credit_point, deliver_groups, finish_groups
from .indirect import CARRIED, INDIRECT, begin_path, trace_paths
from .intersect import FAR, meet, passed
from .light_visibility import light_radiance
from .sample_allocation import COSINE, ENVIRONMENT, GGX, LIGHTS

#: Rays of a batch: few enough for the second cache, enough to fill vectors.
BATCH = 512
#: A block's sums have KIND columns for each kind of light: what samples of environment and lights find, indirect light,
#: and light of lights and surfaces that rays met. The first six are diffuse and glossy light; from this one on, sum and
#: sum of squares of the luminance of each follow.
_LUMINANCE = 6


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
def _reflect_sample(lights, sums, rays, slot, group, diffuse, glossy):  # type: ignore[no-untyped-def]
    """`_reflect` of a sample of the environment or of lights, and its share of the light's group."""
    _reflect(sums, rays, slot, 0, diffuse, glossy)
    credit_point(lights, sums, rays, slot, 0, group, diffuse, glossy)


@njit
def _reflect(sums, rays, slot, kind, diffuse, glossy):  # type: ignore[no-untyped-def]
    """Add what a slot's point reflects of the light that its diffuse and its glossy lobe get along the ray."""
    s, ints = rays
    (dr, dg, db), (gr, gg, gb) = diffuse, glossy
    i, c = w.at(slot)
    _add(
        sums, np.int64(ints[c + w.OWNER]), kind, s[i + w.QR] * dr, s[i + w.QG] * dg, s[i + w.QB] * db,
        s[i + w.SR] * gr, s[i + w.SG] * gg, s[i + w.SB] * gb,
    )  # fmt: skip


@njit
def deliver(count, found, limit, lights, sums):  # type: ignore[no-untyped-def]
    """Add the light of finished paths, times BRDF and cosine at their shading points, to these points' sums.

    Parameters
    ----------
    count : int64
        Paths.
    found : (capacity, FOUND) float32 array
        From CARRIED on: BRDF times cosine over pdf at the shading point, diffuse and glossy, and the point's row of
        `sums`. INDIRECT: radiance from `indirect.trace_paths`, linear Rec.709.
    limit : float32
        `clamp_indirect`, scaled to one sample: highest mean of its three channels; 0 for none.
    lights : LightTables, LinkedTables or GroupedTables
    sums : (points, KINDS * KIND) float32 array
        Added to, as light of kind 1 (indirect).
    """
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
        deliver_groups(lights, found, path, sums, h, ((fr + hr) * k, (fg + hg) * k, (fb + hb) * k))


@njit
def _see_lights(rays, slot, reach, hit, taking_part, scene, sums):  # type: ignore[no-untyped-def]
    """Add reflected light of the lights between a point and its ray's hit, and of the hit's emission, with MIS weights.

    Called before `mis.balance_heuristic_at`, while the BRDF of the slot is not yet divided by densities.

    `taking_part` says (1 or 0) whether cosine and GGX sampling do, as in `mis.balance_heuristic`.
    """
    s = rays.floats
    cosine, ggx = taking_part
    i, _ = w.at(slot)
    lights = lights_of(scene.lights, s[i + w.POINT_SET])
    position, direction = (s[i + w.OX], s[i + w.OY], s[i + w.OZ]), (s[i + w.LX], s[i + w.LY], s[i + w.LZ])
    others, share = w.brdf_pdf(s, i, cosine, ggx), s[i + w.WL]
    if not others > ZERO:
        return
    dr, dg, db = lights_along(position, direction, reach, others, share, DIFFUSE, lights)
    gr, gg, gb = dr, dg, db
    if scene.traits.lights_differ:
        gr, gg, gb = lights_along(position, direction, reach, others, share, GLOSSY, lights)
    if dr + dg + db + gr + gg + gb > ZERO:
        seen = position, direction, reach, others, share, DIFFUSE
        credit_lamps_of_point(scene.lights, lights, sums, rays, slot, seen, False)
        seen = position, direction, reach, others, share, GLOSSY
        credit_lamps_of_point(scene.lights, lights, sums, rays, slot, seen, True)
    if scene.traits.emissive and emits_to(scene.lights, s[i + w.POINT_SET], hit, scene.geometry):
        r, g, b, density, glossy = emission_along(position, direction, hit, scene.geometry, lights)
        weight, glossy = ONE / (others + share * density), ONE / (others + share * glossy)
        parts = (weight * r, weight * g, weight * b), (glossy * r, glossy * g, glossy * b)
        group = group_of_hit(scene.lights, hit, scene.geometry)
        credit_point(scene.lights, sums, rays, slot, 2, group, parts[0], parts[1])
        dr, dg, db = dr + weight * r, dg + weight * g, db + weight * b
        gr, gg, gb = gr + glossy * r, gg + glossy * g, gb + glossy * b
    if dr + dg + db + gr + gg + gb > ZERO:
        _reflect(sums, rays, slot, 2, (dr, dg, db), (gr, gg, gb))


@njit
def _trace_lights(rays, count, scene, settings, sums):  # type: ignore[no-untyped-def]
    """Light samples: draw, trace, add."""
    s = rays.floats
    w.light_directions(rays, count, scene.lights, w.POINT_SET)
    w.evaluate(rays, count, settings.shading_model)
    if scene.traits.detailed:
        w.soften(rays, count)
    if scene.geometry.terminators != 0:
        w.terminate(rays, count)
    mask = np.int32(ray_masks.SHADOW << settings.shift)
    for slot in range(count):
        i, c = w.at(slot)
        others, glossy_others = s[i + w.WC] * s[i + w.PC], s[i + w.WG] * s[i + w.PG]
        if not scene.traits.lobes_apart:
            others = glossy_others = others + glossy_others
        receiver = s[i + w.POINT_SET]
        counts = s[i + w.WL], s[i + w.WC] + s[i + w.WG]
        dr, dg, db, gr, gg, gb = light_radiance(rays, slot, others, glossy_others, counts, receiver, scene, mask)
        if dr + dg + db + gr + gg + gb > ZERO:
            group = group_of_sample(scene.lights, receiver, np.int64(rays.ints[c + w.CELL]))
            _reflect_sample(scene.lights, sums, rays, slot, group, (dr, dg, db), (gr, gg, gb))


@njit
def _see_envmap(rays, count, scene, sums):  # type: ignore[no-untyped-def]
    """Add what the environment sends along the slots' rays; LIVE is the share that gets through."""
    s = rays.floats
    for slot in range(count):
        i, _ = w.at(slot)
        through = s[i + w.LIVE]
        if through > ZERO:
            r, g, b = envmap_radiance(s[i + w.MU], s[i + w.MV], scene.envmap)
            light = r * through, g * through, b * through
            _reflect_sample(scene.lights, sums, rays, slot, group_of_environment(scene.lights), light, light)


@njit
def _trace_envmap(rays, count, scene, settings, sums):  # type: ignore[no-untyped-def]
    """Samples of the environment: draw, weigh, trace, add."""
    s = rays.floats
    w.environment_directions(rays, count, scene.envmap)
    w.evaluate(rays, count, settings.shading_model)
    if scene.traits.detailed:
        w.soften(rays, count)
    if scene.geometry.terminators != 0:
        mis.terminator_weights(rays, count, settings, scene.envmap)
        w.terminate(rays, count)
    if scene.traits.lobes_apart:
        mis.balance_heuristic_per_lobe(rays, count)
    else:
        mis.balance_heuristic(rays, count, ONE, ONE)
    w.warm(rays, count, scene.envmap)
    mask = np.int32(ray_masks.SHADOW << settings.shift)
    for slot in range(count):
        i, _ = w.at(slot)
        if s[i + w.LIVE] > ZERO:
            s[i + w.LIVE] = passed(scene, rays, slot, FAR, mask)
    _see_envmap(rays, count, scene, sums)


@njit
def trace_batch(strategy, count, begun, scratch, scene, settings):  # type: ignore[no-untyped-def]
    """Samples of one strategy: draw, weigh, trace, and add what they see; return the number of paths under way.

    Parameters
    ----------
    strategy : int
    count : int
        Samples, in slots 0, 1, ... of the scratch memory's `rays`.
    begun : int
        Paths under way, in its `paths`.
    scratch : Scratch
    scene : Scene
    settings : Settings
    """
    rays, paths, found, sums = scratch.rays, scratch.paths, scratch.found, scratch.sums
    s, ints = rays
    tracer, envmap, shading_model, shift = scene.tracer, scene.envmap, settings.shading_model, settings.shift
    w.scramble(rays, count)
    if scene.traits.lights and strategy == LIGHTS:
        _trace_lights(rays, count, scene, settings, sums)
        return begun
    if strategy == ENVIRONMENT:
        _trace_envmap(rays, count, scene, settings, sums)
        return begun
    if strategy == COSINE:
        w.cosine_directions(rays, count)
        mask = np.int32(ray_masks.DIFFUSE << shift)
    else:
        w.ggx_directions(rays, count)
        mask = np.int32(ray_masks.GLOSSY << shift)
    w.evaluate(rays, count, shading_model)
    if scene.traits.detailed:
        w.soften(rays, count)
    w.look_up(rays, count, envmap)
    cosine = ggx = ONE
    if scene.traits.lobes_apart and strategy == COSINE:
        ggx = ZERO
        w.drop(rays, count, w.SR)
    if scene.traits.lobes_apart and strategy == GGX:
        cosine = ZERO
        w.drop(rays, count, w.QR)
    see_lights = scene.traits.lights or scene.traits.emissive
    # Lights are seen before the BRDF is weighed, for they have densities of their own: such rays are traced first.
    if not see_lights:
        mis.balance_heuristic(rays, count, cosine, ggx)
    if settings.filter_glossy > ZERO:
        w.lobe_shares(rays, count, shading_model)
    if scene.traits.environment:
        w.warm(rays, count, envmap)
    for slot in range(count):
        i, c = w.at(slot)
        if not s[i + w.LIVE] > ZERO:
            continue
        position, direction = (s[i + w.OX], s[i + w.OY], s[i + w.OZ]), (s[i + w.LX], s[i + w.LY], s[i + w.LZ])
        through, reach, hit = meet(scene, rays, slot, mask)
        if see_lights:
            _see_lights(rays, slot, reach, hit, (cosine, ggx), scene, sums)
            mis.balance_heuristic_at(s, i, cosine, ggx)
        s[i + w.LIVE] = through
        if scene.geometry.terminators != 0:
            s[i + w.LIVE] *= mis.terminator_part(s, i, cosine, ggx, settings, envmap)
        if through == ONE or settings.bounces == 0:
            continue
        # Light of surfaces is found by these strategies alone: the density of the environment's samples goes out again.
        others = w.brdf_pdf(s, i, cosine, ggx)
        rest = (ONE - through) * (ONE + s[i + w.WE] * s[i + w.PE] / max(others, F(1e-30)))
        if begun == BATCH:
            trace_paths(paths, begun, scene, settings, found)
            deliver(begun, found, settings.clamp, scene.lights, sums)
            begun = np.int64(0)
        pdf = w.mixture_pdf(s, i)
        begin_path(tracer, paths, begun, (position, direction), hit, ints[c + w.KEY], pdf, settings)
        found[begun, CARRIED], found[begun, CARRIED + 1], found[begun, CARRIED + 2] = (
            s[i + w.QR] * rest, s[i + w.QG] * rest, s[i + w.QB] * rest,
        )  # fmt: skip
        found[begun, CARRIED + 3], found[begun, CARRIED + 4], found[begun, CARRIED + 5] = (
            s[i + w.SR] * rest, s[i + w.SG] * rest, s[i + w.SB] * rest,
        )  # fmt: skip
        found[begun, CARRIED + 6] = F(ints[c + w.OWNER])
        begun += 1
    if scene.traits.environment:
        _see_envmap(rays, count, scene, sums)
    return begun


@njit
def finish(lights, sums, h, total, components, moments, i):  # type: ignore[no-untyped-def]
    """Write out the light of a point, and for either lobe sum and sum of squares of its samples' luminance.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    sums : (points, KINDS * KIND) float32 array
        Of the block.
    h : int64
        The point's row of it.
    total : int64
        Its samples.
    components : (n, 4, 3) float32 array
        Row `i` is written, linear Rec.709, see ``Radiance.components``.
    moments : (n, 5 or more) float32 array
        Row `i` is written, see ``Radiance.moments``; behind its columns, those of light groups.
    i : int64
        The point among all.
    """
    for lobe in range(2):
        for k in range(3):
            c = 3 * lobe + k
            components[i, 2 * lobe, k] = sums[h, c] + sums[h, 2 * KIND + c]
            components[i, 2 * lobe + 1, k] = sums[h, KIND + c]
        m = _LUMINANCE + 2 * lobe
        mean, square = ZERO, ZERO
        for kind in range(KINDS):
            mean += sums[h, kind * KIND + m]
            square += sums[h, kind * KIND + m + 1]
        moments[i, 1 + 2 * lobe], moments[i, 2 + 2 * lobe] = mean, square
    moments[i, 0] = F(total)
    finish_groups(lights, sums, h, moments, i)
