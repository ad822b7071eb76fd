"""Paths through any BSDF, one after the other: the integrator of scenes whose surfaces have more than two lobes.

Each sample of a shading point is a path. At each of its vertices there is one environment and one light sample (next
event estimation) and one BSDF sample over all lobes, joined by the balance heuristic (`mis`); smooth glass is drawn by
the BSDF alone. Shadow rays end at glass, as in Cycles: light behind it is found by paths that go through. A path may be
reflected as often as the settings' bounces say, and pass surfaces `TRANSMISSION_BOUNCES` times more. Everything else,
random numbers, Russian roulette, light linking, surfels and surfaces that are partly there, is as in `indirect`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...compute.jit import njit
from ...compute.threads import over_strided
from ..lights.light_links import set_of
from ..lights.product_sampling import SIDE, product_row
from ..sampling import GOLDEN, ONE, ZERO, F, U, luminance, mix, scrambled, unit
from ..scene import ray_masks
from ..scene.material_rows import MULTISCATTER, PARAMETER_COUNT, MaterialRows
from ..shading_points import RECEIVER, SECOND, Radiance, ShadingPoints
from . import wavefront as w
from .bsdf.albedo_tables import AlbedoTables, albedo_tables
from .bsdf.lobes import DELTA, GLOSSY_CLASS, LOBE, METAL, MOST_LOBES, TRANSMITTED_CLASS, sample
from .bsdf.lobes import KIND as LOBE_KIND
from .bsdf.surface_lobes import put_lobes
from .group_sums import FOUND, MOMENTS, clear_groups, group_columns
from .integrate import ShadingKernel
from .intersect import meet, put_hit, put_start, surface_of
from .path_light import Scratch, aim, is_bright, light_along, towards_envmap, towards_lights, weigh
from .path_regularisation import least_alpha, roughen
from .records import Sampler, Scene, Settings

Array = np.ndarray

#: How often a path may pass a surface: Blender's default.
TRANSMISSION_BOUNCES = 12
#: Reflections and passages after which Russian roulette begins.
_SURE_BOUNCES = 3
#: Points of a block.
_BLOCK = 16
#: What is added to a path's key for its environment, light and BSDF sample.
_ENVIRONMENT, _LIGHTS, _BSDF = U(0x51ED270B), U(0x2C1B3C6D), U(0x7FEB352D)


class Surfaces(NamedTuple):
    """Surfaces of the general BSDF, and where shading points lie on them.

    Attributes
    ----------
    rows : MaterialRows
    tables : AlbedoTables
    face, instance : (n,) int32 array
        Of each point, as `interaction.nearest` numbers them; face -1: of surfels.
    place : (n, 2) float32 array
        Barycentric coordinates of its face's second and third corner.
    """

    rows: MaterialRows
    tables: AlbedoTables
    face: Array
    instance: Array
    place: Array


class PathKernel(ShadingKernel):
    """The kernel of scenes whose surfaces have more than two lobes, on all CPU threads.

    Parameters
    ----------
    rows : MaterialRows
        Of the scene's materials.
    """

    def __init__(self, rows: MaterialRows) -> None:
        self._rows = rows

    def light(self, points: ShadingPoints, scene: Scene, settings: Settings, sampler: Sampler, found: Radiance) -> None:
        tables = albedo_tables(bool(self._rows.ints[:, MULTISCATTER].any()))
        surfaces = Surfaces(self._rows, tables, points.face, points.instance, points.place)
        found.transmitted = np.zeros((len(points), 2, 3), np.float32)
        blocks = -(-len(points) // _BLOCK)
        out = found.components, found.moments, found.transmitted
        over_strided(_kernel, blocks, points.arrays, surfaces, scene, settings, sampler, out)


@njit
def _numbers(key, sequence, turn, first):  # type: ignore[no-untyped-def]
    """Three random numbers: of the Sobol' point at the shading point, hashed behind it."""
    if first:
        return (
            scrambled(sequence[0], mix(U(turn + U(1)))),
            scrambled(sequence[1], mix(U(turn + U(2)))),
            scrambled(sequence[2], mix(U(turn + U(3)))),
        )
    return mix(key), mix(U(key + U(0x68E31DA4))), mix(U(key + U(0xB5297A4D)))


@njit
def _follow(start, numbers, receiver, surfaces, scene, settings, scratch):  # type: ignore[no-untyped-def]
    """Follow a path from a shading point whose ray is in slot 0; its light goes to `direct`, `indirect`, `carried`."""
    place, base, position, view, facing, normal, smooth = start
    sequence, key, turn = numbers
    rays, b, value = scratch.rays, scratch.lobes, scratch.value
    s, ints = rays
    geometry, envmap, extent = scene.geometry, scene.envmap, scene.traits.extent
    red = green = blue = ONE
    reflected = transmitted = 0
    least = ZERO  # of the alphas of surfaces, see `path_regularisation`
    first = True
    while True:
        normals = (normal, smooth)
        count, passes = put_lobes(
            place, base, normals, facing, view, geometry, surfaces.rows, surfaces.tables, scratch.parameters, b
        )
        if least > ZERO:
            roughen(b, count, least)
        row = np.int32(SIDE * SIDE)
        if not passes:
            row = product_row(normal[0], normal[1], normal[2], envmap)
        at = (place, position, view, facing, normals)
        throughput = (red, green, blue)
        if scene.traits.environment:
            drawn = _numbers(U(key + _ENVIRONMENT), sequence, U(turn + _ENVIRONMENT), first)
            ints[w.KEY] = U(key + _ENVIRONMENT)
            towards_envmap(drawn, at, row, throughput, first, scratch, count, scene, settings)
        if scene.traits.lights:
            drawn = _numbers(U(key + _LIGHTS), sequence, U(turn + _LIGHTS), first)
            ints[w.KEY] = U(key + _LIGHTS)
            towards_lights(drawn, at, receiver, throughput, first, scratch, count, scene, settings)
        n0, n1, n2 = _numbers(U(key + _BSDF), sequence, U(turn + _BSDF), first)
        dx, dy, dz, lobe, through_it, er, eg, eb = sample(b, count, view, unit(n0), unit(n1), unit(n2))
        if lobe < 0:
            return
        direction = (dx, dy, dz)
        delta = b[lobe + DELTA] > ZERO
        diffuse = b[lobe + LOBE_KIND] < METAL and not through_it
        below = facing[0] * dx + facing[1] * dy + facing[2] * dz <= ZERO
        if delta:
            if below != through_it:
                return
            for c in range(9):
                value[c] = ZERO
            k = 3 * (TRANSMITTED_CLASS if through_it else GLOSSY_CLASS)
            value[k], value[k + 1], value[k + 2] = er, eg, eb
            pdf, share = ONE, ZERO
        else:
            pdf, share = weigh(scratch, count, view, facing, normals, direction, scene.traits.detailed), ONE
            if not (pdf > ZERO and is_bright(value)):
                return
        aim(rays, position, facing, direction, extent)
        origin = (s[w.OX], s[w.OY], s[w.OZ])
        mask = ray_masks.DIFFUSE if diffuse else ray_masks.GLOSSY
        if through_it:
            mask = ray_masks.DIFFUSE | ray_masks.GLOSSY
        key = mix(U(key + GOLDEN))
        ints[w.KEY] = key
        through, reach, hit = meet(scene, rays, 0, np.int32(mask << settings.shift))
        seen = origin, direction, reach, hit, through
        light_along(seen, (pdf, share), receiver, row, diffuse, throughput, first, scratch, scene)
        if through_it:
            transmitted += 1
        else:
            reflected += 1
        if through == ONE or reflected > settings.bounces or transmitted > TRANSMISSION_BOUNCES:
            return
        if not delta:
            least = max(least, least_alpha(pdf, settings.filter_glossy))
        k = (ONE - through) / pdf
        if first:
            for i in range(9):
                scratch.carried[i] = value[i] * k
        else:
            red *= (value[0] + value[3] + value[6]) * k
            green *= (value[1] + value[4] + value[7]) * k
            blue *= (value[2] + value[5] + value[8]) * k
            if reflected + transmitted >= _SURE_BOUNCES:
                survive = min(ONE, max(red, max(green, blue)))
                if not unit(mix(U(key + U(0x165667B1)))) < survive:
                    return
                red, green, blue = red / survive, green / survive, blue / survive
        first = False
        put_hit(scene.tracer, rays, 0, (origin, direction), hit, key, 0)
        nx, ny, nz, gx, gy, gz, ar, ag, ab, rough, metal, _, _, _, ux, uy, uz = surface_of(
            scene.tracer, rays, 0, geometry
        )
        place, base = (hit.face, hit.instance, hit.u, hit.v), (ar, ag, ab, rough, metal)
        position, view = (s[w.OX], s[w.OY], s[w.OZ]), (-dx, -dy, -dz)
        facing, normal, smooth = (gx, gy, gz), (nx, ny, nz), (ux, uy, uz)
        receiver = set_of(scene.lights, hit.face, np.int32(ints[w.OWN]), geometry)


@njit
def _finish(lights, scratch, scale, limit, components, transmitted, moments, i):  # type: ignore[no-untyped-def]
    """Add a sample's light to a point's sums."""
    direct, carried, indirect = scratch.direct, scratch.carried, scratch.indirect
    mean = ZERO
    for c in range(3):
        carried_all = carried[c] + carried[3 + c] + carried[6 + c]
        mean += carried_all * indirect[c]
    mean = mean * scale / F(3.0)
    k = limit / mean if limit > ZERO and mean > limit else ONE
    for column in range(group_columns(lights)):
        c = column % 3
        carried_all = (carried[c] + carried[3 + c] + carried[6 + c]) * k * scale
        direct_part, path_part = scratch.grouped[0, FOUND + column], scratch.grouped[1, FOUND + column]
        moments[i, MOMENTS + column] += direct_part * scale + path_part * carried_all
    seen = (ZERO, ZERO)
    for c in range(3):
        bounced = indirect[c] * k * scale
        d, g, t = direct[c] * scale, direct[3 + c] * scale, direct[6 + c] * scale
        di, gi, ti = carried[c] * bounced, carried[3 + c] * bounced, carried[6 + c] * bounced
        components[i, 0, c] += d
        components[i, 1, c] += di
        components[i, 2, c] += g + t
        components[i, 3, c] += gi + ti
        transmitted[i, 0, c] += t
        transmitted[i, 1, c] += ti
        share = luminance(F(c == 0), F(c == 1), F(c == 2))
        seen = (seen[0] + share * (d + di), seen[1] + share * (g + t + gi + ti))
    moments[i, 0] += ONE
    for lobe in range(2):
        moments[i, 1 + 2 * lobe] += seen[lobe]
        moments[i, 2 + 2 * lobe] += seen[lobe] * seen[lobe]


@njit
def shade_points_by_paths(thread, stride, scratch, points, surfaces, scene, settings, sampler, out):  # type: ignore[no-untyped-def]
    """Shade every `stride`-th block of points, from the `thread`-th on.

    Parameters
    ----------
    thread, stride : int64
    scratch : Scratch
    points : PointArrays
    surfaces : Surfaces
    scene : Scene
    settings : Settings
    sampler : Sampler
    out : tuple of array
        Components (n, 4, 3) and moments (n, 5 or more) of the points' `Radiance`, and the transmitted part (n, 2, 3);
        all 0.
    """
    components, moments, transmitted = out
    n = len(points.pixel)
    parts, rays = sampler.parts, scratch.rays
    rate = ONE / F(sampler.subpixels * parts)
    step = (sampler.cosine + sampler.ggx + sampler.light) * rate
    scale = ONE / step
    lobes_start = (np.int32(-1), np.int32(-1), ZERO, ZERO)
    for block in range(thread, (n + _BLOCK - 1) // _BLOCK, stride):
        for i in range(block * _BLOCK, min(n, (block + 1) * _BLOCK)):
            check = points.roughness[i] + points.metallic[i]
            for k in range(3):
                check += points.origin[i, k] + points.normal[i, k] + points.geometric_normal[i, k]
                check += points.viewer[i, k] + points.albedo[i, k]
            if not abs(check) < F(1e18):
                continue
            own = U(sampler.seed ^ mix(U(points.pixel[i])))
            if points.flags[i] & SECOND:
                own = U(own ^ U(0x5BD1E995))
            key = mix(U(mix(own) + U(U(5) * GOLDEN)))
            dither = unit(mix(U(key + U(4))))
            number = points.sample[i]
            turn = np.int64((np.uint64(U(U(number) * GOLDEN)) * np.uint64(parts)) >> np.uint64(32))
            where = F(number * parts + (sampler.part + turn) % parts)
            place = lobes_start
            if len(surfaces.face) > 0:
                place = surfaces.face[i], surfaces.instance[i], surfaces.place[i, 0], surfaces.place[i, 1]
            base = (
                points.albedo[i, 0], points.albedo[i, 1], points.albedo[i, 2], points.roughness[i], points.metallic[i],
            )  # fmt: skip
            position = points.origin[i, 0], points.origin[i, 1], points.origin[i, 2]
            view = points.viewer[i, 0], points.viewer[i, 1], points.viewer[i, 2]
            facing = points.geometric_normal[i, 0], points.geometric_normal[i, 1], points.geometric_normal[i, 2]
            normal = points.normal[i, 0], points.normal[i, 1], points.normal[i, 2]
            smooth = normal
            if len(points.smooth) > 0:
                ux, uy, uz = points.smooth[i, 0], points.smooth[i, 1], points.smooth[i, 2]
                if ux * ux + uy * uy + uz * uz > ZERO:
                    smooth = ux, uy, uz
            start = place, base, position, view, facing, normal, smooth
            receiver = F(points.flags[i] >> RECEIVER)
            for j in range(np.int64(where * step + dither), np.int64((where + ONE) * step + dither)):
                put_start(scene.tracer, rays, 0, points, i)
                for c in range(9):
                    scratch.direct[c] = scratch.carried[c] = ZERO
                for c in range(3):
                    scratch.indirect[c] = ZERO
                clear_groups(scene.lights, scratch.grouped, 0)
                clear_groups(scene.lights, scratch.grouped, 1)
                sequence = sampler.sequence[j, 0], sampler.sequence[j, 1], sampler.sequence[j, 2]
                path = mix(U(key ^ U(U(j + 1) * U(0x85EBCA6B))))
                _follow(start, (sequence, path, key), receiver, surfaces, scene, settings, scratch)
                _finish(scene.lights, scratch, scale, settings.clamp, components, transmitted, moments, i)


@njit
def _scratch(lights: Any) -> Any:
    return Scratch(
        w.batch(1),
        np.zeros(MOST_LOBES * LOBE, np.float32),
        np.zeros(PARAMETER_COUNT, np.float32),
        np.zeros(9, np.float32),
        np.zeros(9, np.float32),
        np.zeros(9, np.float32),
        np.zeros(3, np.float32),
        np.zeros((2, FOUND + group_columns(lights)), np.float32),
    )


@njit
def _kernel(first, last, stride, points, surfaces, scene, settings, sampler, out):  # type: ignore[no-untyped-def]
    scratch = _scratch(scene.lights)
    for thread in range(first, last):
        shade_points_by_paths(thread, stride, scratch, points, surfaces, scene, settings, sampler, out)
