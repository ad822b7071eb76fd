"""Indirect light: paths continued in batches from the hits of direct samples.

Every path vertex takes next event estimation of environment and lights, one sample each, and one BRDF sample, combined
by multiple importance sampling (balance heuristic). The throughput is the path's weight so far. It starts at 1 at the
first hit: the BRDF of the visible surface is not in it, but in the columns from CARRIED on, and `direct.deliver`
multiplies by it. Russian roulette ends paths before their fourth vertex and all later ones; `_onwards` computes the
probability of survival, the largest channel of the throughput, 1 at most.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..lights.environment import envmap_pdf, envmap_radiance, height_in_map, map_at
from ..lights.light_groups import group_of_environment, group_of_hit, group_of_sample
from ..lights.light_links import emits_to, lights_of, set_of
from ..lights.light_sampler import emission_along, lights_along
from ..lights.light_shapes import DIFFUSE, GLOSSY
from ..lights.product_sampling import SIDE, product_row
from ..sampling import GOLDEN, ONE, ZERO, F, U, mix, unit
from ..scene import ray_masks
from ..scene.terminator import terminator_at
from . import brdf, mis
from . import wavefront as w
from .group_sums import clear_groups, credit_lamps_of_path, credit_path
from .intersect import FAR, meet, passed, put_hit, surface_of
from .light_visibility import light_radiance
from .multiscatter import has_multiscatter, lobe_weights
from .path_regularisation import least_alpha

Array = np.ndarray

#: Ray offset from the surface: relative to the point's own and to the scene's largest coordinate.
_OFFSET_POINT, _OFFSET_SCENE = F(1e-5), F(2e-6)
#: Russian roulette starts after this many bounces.
_SURE_BOUNCES = 3
#: Columns of `found`: indirect light, then the caller's; `FOUND` in all, before those of groups.
INDIRECT, CARRIED = 0, 3


@njit
def lifted(px, py, pz, gx, gy, gz, extent):  # type: ignore[no-untyped-def]
    """Lift a ray's origin off the surface by more than rounding can push it below.

    Parameters
    ----------
    px, py, pz : float32
        Point on the surface, world, m.
    gx, gy, gz : float32
        Unit geometric normal, on the side where the ray starts.
    extent : float32
        `Traits.extent`, m.

    Returns
    -------
    x, y, z : float32
        World, m.
    """
    lift = _OFFSET_POINT * max(abs(px), max(abs(py), abs(pz))) + _OFFSET_SCENE * extent
    return px + lift * gx, py + lift * gy, pz + lift * gz


@njit
def begin_path(tracer, paths, slot, start, hit, key, pdf, settings):  # type: ignore[no-untyped-def]
    """Put what a sample of a shading point met into a slot, where `trace_paths` goes on.

    Parameters
    ----------
    tracer : MixedTracer
    paths : Batch
    slot : int64
        Also the path's row of `found`.
    start : tuple of tuple
    hit : Hit or MixedHit
    key : uint32
        As of `intersect.put_hit`.
    pdf : float32
        Of `wavefront.mixture_pdf`, sr^-1; read under `filter_glossy` alone.
    settings : Settings
    """
    put_hit(tracer, paths, slot, start, hit, key, slot)
    i, _ = w.at(slot)
    paths.floats[i + w.LEAST_ALPHA] = least_alpha(pdf, settings.filter_glossy)


@njit
def _surfaces(rays, count, scene, settings):  # type: ignore[no-untyped-def]
    """Normals and materials where the rays hit. Emission was already added (`direct`, `_onwards`)."""
    s, ints = rays
    tracer, geometry, envmap, extent = scene.tracer, scene.geometry, scene.envmap, scene.traits.extent
    for slot in range(count):
        a, c = w.at(slot)
        vx, vy, vz = s[a + w.VX], s[a + w.VY], s[a + w.VZ]
        nx, ny, nz, gx, gy, gz, r, g, b, roughness, metallic, _, _, _, ux, uy, uz = surface_of(
            tracer, rays, slot, geometry
        )
        if scene.traits.detailed:
            s[a + w.UX], s[a + w.UY], s[a + w.UZ] = ux, uy, uz
        if geometry.terminators != 0:
            face, instance = np.int32(ints[c + w.N0]), np.int32(ints[c + w.N1])
            s[a + w.HX], s[a + w.HY], s[a + w.HZ], s[a + w.LIMIT] = terminator_at(
                face, instance, s[a + w.MU], s[a + w.MV], gx, gy, gz, geometry
            )
        mx, my, mz = brdf.glossy_normal(nx, ny, nz, gx, gy, gz, vx, vy, vz)
        s[a + w.NX], s[a + w.NY], s[a + w.NZ] = nx, ny, nz
        s[a + w.MX], s[a + w.MY], s[a + w.MZ] = mx, my, mz
        s[a + w.GX], s[a + w.GY], s[a + w.GZ] = gx, gy, gz
        ints[c + w.ROW] = U(product_row(nx, ny, nz, envmap))
        s[a + w.OX], s[a + w.OY], s[a + w.OZ] = lifted(s[a + w.OX], s[a + w.OY], s[a + w.OZ], gx, gy, gz, extent)
        s[a + w.AR], s[a + w.AG], s[a + w.AB] = r, g, b
        s[a + w.PATH_SET] = set_of(scene.lights, np.int32(ints[c + w.N0]), np.int32(ints[c + w.OWN]), geometry)
        least = s[a + w.LEAST_ALPHA]
        s[a + w.A2] = max(brdf.alpha_squared(roughness), least * least)
        multiscatter = scene.traits.multiscatter and has_multiscatter(np.int32(ints[c + w.N0]), geometry)
        s[a + w.KD], metal, s[a + w.FD] = lobe_weights(
            mx * vx + my * vy + mz * vz, roughness, metallic, (r, g, b), multiscatter, settings
        )
        s[a + w.FR], s[a + w.FG], s[a + w.FB] = metal


@njit
def _evaluate(rays, count, scene, shading_model):  # type: ignore[no-untyped-def]
    w.evaluate(rays, count, shading_model)
    if scene.traits.detailed:
        w.soften(rays, count)


@njit
def _find(lights, found, owner, group, r, g, b):  # type: ignore[no-untyped-def]
    """Add light that a path brings, to it and to the group that the light is of."""
    found[owner, INDIRECT] += r
    found[owner, INDIRECT + 1] += g
    found[owner, INDIRECT + 2] += b
    credit_path(lights, found, owner, group, r, g, b)


@njit
def _towards_envmap(rays, count, scene, shift, found):  # type: ignore[no-untyped-def]
    """The environment samples that `environment_directions` drew and `path_weights` weighed."""
    s, ints = rays
    envmap = scene.envmap
    for slot in range(count):
        i, c = w.at(slot)
        if not s[i + w.LIVE] > ZERO:
            continue
        red, green, blue = envmap_radiance(s[i + w.MU], s[i + w.MV], envmap)
        weight = ONE / s[i + w.PE]
        red, green, blue = red * s[i + w.QR] * weight, green * s[i + w.QG] * weight, blue * s[i + w.QB] * weight
        if red + green + blue > ZERO:
            through = passed(scene, rays, slot, FAR, np.int32(ray_masks.SHADOW << shift))
            owner, group = np.int64(ints[c + w.OWNER]), group_of_environment(scene.lights)
            _find(scene.lights, found, owner, group, red * through, green * through, blue * through)


@njit
def _towards_lights(rays, count, scene, shift, found):  # type: ignore[no-untyped-def]
    """The light samples that `light_directions` drew."""
    s, ints = rays
    for slot in range(count):
        i, c = w.at(slot)
        others = w.mixture_pdf(s, i)
        dr, dg, db, gr, gg, gb = light_radiance(
            rays, slot, others, others, (ONE, ONE), s[i + w.PATH_SET], scene, np.int32(ray_masks.SHADOW << shift)
        )
        if dr + dg + db + gr + gg + gb > ZERO:
            owner = np.int64(ints[c + w.OWNER])
            red = s[i + w.TR] * (s[i + w.QR] * dr + s[i + w.SR] * gr)
            green = s[i + w.TG] * (s[i + w.QG] * dg + s[i + w.SG] * gg)
            blue = s[i + w.TB] * (s[i + w.QB] * db + s[i + w.SB] * gb)
            group = group_of_sample(scene.lights, s[i + w.PATH_SET], np.int64(ints[c + w.CELL]))
            _find(scene.lights, found, owner, group, red, green, blue)


@njit
def _onwards(rays, count, bounce, last, scene, settings, found):  # type: ignore[no-untyped-def]
    """The BRDF samples; return how many paths go on, in slots 0, 1, ..."""
    s, ints = rays
    tracer, envmap, shift = scene.tracer, scene.envmap, settings.shift
    any_lights, emissive = scene.traits.lights, scene.traits.emissive
    going = 0
    for slot in range(count):
        i, c = w.at(slot)
        if not s[i + w.LIVE] > ZERO:
            continue
        position = (s[i + w.OX], s[i + w.OY], s[i + w.OZ])
        direction = (s[i + w.LX], s[i + w.LY], s[i + w.LZ])
        diffuse = ints[c + w.CELL] == U(1)
        mask = np.int32((ray_masks.DIFFUSE if diffuse else ray_masks.GLOSSY) << shift)
        ends = last and not any_lights and not emissive
        if ends:
            s[i + w.MOVED] = ZERO
            through = passed(scene, rays, slot, FAR, mask)
        else:
            through, reach, hit = meet(scene, rays, slot, mask)
        owner = np.int64(ints[c + w.OWNER])
        fr, fg, fb = s[i + w.QR], s[i + w.QG], s[i + w.QB]
        lights = lights_of(scene.lights, s[i + w.PATH_SET])
        if any_lights:
            seen_by = DIFFUSE if diffuse else GLOSSY
            red, green, blue = lights_along(position, direction, reach, s[i + w.PG], ONE, seen_by, lights)
            found[owner, INDIRECT] += fr * red
            found[owner, INDIRECT + 1] += fg * green
            found[owner, INDIRECT + 2] += fb * blue
            if red + green + blue > ZERO:
                seen = position, direction, reach, s[i + w.PG], ONE, seen_by
                credit_lamps_of_path(scene.lights, lights, found, owner, s[i + w.PATH_SET], (fr, fg, fb), seen)
        if emissive and emits_to(scene.lights, s[i + w.PATH_SET], hit, scene.geometry):
            red, green, blue, own, glossy = emission_along(position, direction, hit, scene.geometry, lights)
            weight = ONE / (s[i + w.PG] + (own if diffuse else glossy))
            group = group_of_hit(scene.lights, hit, scene.geometry)
            _find(scene.lights, found, owner, group, fr * red * weight, fg * green * weight, fb * blue * weight)
        if through > ZERO:
            u, v = map_at(*direction, envmap)
            red, green, blue = envmap_radiance(u, v, envmap)
            z = height_in_map(direction[0], direction[1], direction[2], envmap)
            density, light = s[i + w.PG], envmap_pdf(u, v, z, ints[c + w.ROW], envmap)
            weight = through / (density + light)
            if scene.geometry.terminators != 0 and w.grazing(s, i) > ZERO:
                light = envmap_pdf(u, v, z, U(SIDE * SIDE), envmap)
                weight = through * mis.power_heuristic(density, light) / density
            group = group_of_environment(scene.lights)
            _find(scene.lights, found, owner, group, fr * red * weight, fg * green * weight, fb * blue * weight)
        if through < ONE and not last:
            weight = (ONE - through) / s[i + w.PG]
            fr, fg, fb = fr * weight, fg * weight, fb * weight
            key = ints[c + w.KEY]
            if bounce + 1 >= _SURE_BOUNCES:
                # Russian roulette (PBRT 2.2.4): the probability of survival.
                survive = min(ONE, max(fr, max(fg, fb)))
                if not unit(mix(U(key + U(0x165667B1)))) < survive:
                    continue
                fr, fg, fb = fr / survive, fg / survive, fb / survive
            least = max(s[i + w.LEAST_ALPHA], least_alpha(s[i + w.PG], settings.filter_glossy))
            # The slots before this one are done with.
            put_hit(tracer, rays, going, (position, direction), hit, key, owner)
            i, _ = w.at(going)
            s[i + w.LEAST_ALPHA] = least
            s[i + w.TR], s[i + w.TG], s[i + w.TB] = fr, fg, fb
            going += 1
    return going


@njit
def trace_paths(rays, count, scene, settings, found):  # type: ignore[no-untyped-def]
    """Follow `count` paths that `begin_path` began in slots 0, 1, ...; their light goes to rows OWNER of `found`.

    Parameters
    ----------
    rays : Batch
    count : int
    scene : Scene
    settings : Settings
    found : (capacity, FOUND) float32 array
        INDIRECT is written.
    """
    s, ints = rays
    envmap, lights, shading_model, shift = scene.envmap, scene.lights, settings.shading_model, settings.shift
    for slot in range(count):
        i, c = w.at(slot)
        s[i + w.TR], s[i + w.TG], s[i + w.TB] = ONE, ONE, ONE
        owner = np.int64(ints[c + w.OWNER])
        for k in range(CARRIED):
            found[owner, k] = ZERO
        clear_groups(lights, found, owner)
    for bounce in range(settings.bounces):
        if count == 0:
            return
        _surfaces(rays, count, scene, settings)
        w.lobe_shares(rays, count, shading_model)
        if scene.traits.environment:
            w.fresh_numbers(rays, count, GOLDEN)
            w.environment_directions(rays, count, envmap)
            _evaluate(rays, count, scene, shading_model)
            if scene.geometry.terminators != 0:
                mis.terminator_weights(rays, count, settings, envmap)
                w.terminate(rays, count)
            mis.path_weights(rays, count, ONE)
            _towards_envmap(rays, count, scene, shift, found)
        if scene.traits.lights:
            w.fresh_numbers(rays, count, U(0x2C1B3C6D))
            w.light_directions(rays, count, lights, w.PATH_SET)
            _evaluate(rays, count, scene, shading_model)
            if scene.geometry.terminators != 0:
                w.terminate(rays, count)
            _towards_lights(rays, count, scene, shift, found)
        w.fresh_numbers(rays, count, U(0x7FEB352D))
        w.brdf_directions(rays, count)
        _evaluate(rays, count, scene, shading_model)
        mis.path_weights(rays, count, ZERO)
        count = _onwards(rays, count, bounce, bounce + 1 == settings.bounces, scene, settings, found)
