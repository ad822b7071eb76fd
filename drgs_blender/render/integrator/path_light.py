"""Light at a vertex of a path: the environment and the light sample, and what a ray of the BSDF meets; for `paths`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ..lights.environment import (
    cell_at,
    cell_end,
    direction_in_cell,
    envmap_pdf,
    envmap_radiance,
    first_cell,
    height_in_map,
    map_at,
)
from ..lights.light_groups import group_of_environment, group_of_hit, group_of_sample
from ..lights.light_links import emits_to, lights_of
from ..lights.light_sampler import emission_along, lights_along, sample_light
from ..lights.light_shapes import DIFFUSE, GLOSSY
from ..lights.product_sampling import SIDE, block_of, in_cells_order
from ..sampling import ONE, TWO, ZERO, U, mix
from ..scene import ray_masks
from ..scene.terminator import terminator_at
from . import wavefront as w
from .bsdf.lobes import evaluate, evaluate_below
from .bsdf.surface_lobes import bump_shadow
from .group_sums import credit_lamps_of_path, credit_path
from .indirect import lifted
from .intersect import FAR, passed
from .light_visibility import light_radiance
from .mis import power_heuristic

Array = np.ndarray


class Scratch(NamedTuple):
    """Memory of one thread.

    Attributes
    ----------
    rays : Batch
        The ray at hand, in slot 0.
    lobes, parameters : float32 array
        See `bsdf`.
    value : (9,) float32 array
        BSDF times cosine by class of light.
    carried : (9,) float32 array
        BSDF times cosine over pdf at the shading point, by class of light.
    direct : (9,) float32 array
        Light that the shading point sends to the viewer, found straight from it.
    indirect : (3,) float32 array
        Light that its path brings.
    grouped : (2, columns) float32 array
        Light of light groups, laid out as that of paths in `group_sums`: row 0 is of `direct`, all classes together,
        row 1 of `indirect`.
    """

    rays: w.Batch
    lobes: Array
    parameters: Array
    value: Array
    carried: Array
    direct: Array
    indirect: Array
    grouped: Array


@njit
def gather(light, glossy, throughput, first, group, lights, scratch):  # type: ignore[no-untyped-def]
    """Add light that comes along a direction, times the BSDF there: diffuse lobes get `light`, others `glossy`.

    Parameters
    ----------
    light, glossy : tuple of float32
        Radiance with its MIS weight over its pdf, linear Rec.709.
    throughput : tuple of float32
        Of the path, linear Rec.709.
    first : bool
        Whether the vertex is the shading point.
    group : int64
        Light group, see `light_groups`; -1: credited elsewhere.
    lights : LightTables, LinkedTables or GroupedTables
    scratch : Scratch
    """
    value, direct, indirect = scratch.value, scratch.direct, scratch.indirect
    (lr, lg, lb), (gr, gg, gb) = light, glossy
    r = value[0] * lr + (value[3] + value[6]) * gr
    g = value[1] * lg + (value[4] + value[7]) * gg
    b = value[2] * lb + (value[5] + value[8]) * gb
    if first:
        for c in range(3):
            direct[c] += value[c] * light[c]
            direct[3 + c] += value[3 + c] * glossy[c]
            direct[6 + c] += value[6 + c] * glossy[c]
    else:
        r, g, b = throughput[0] * r, throughput[1] * g, throughput[2] * b
        indirect[0] += r
        indirect[1] += g
        indirect[2] += b
    if group >= 0:
        credit_path(lights, scratch.grouped, 0 if first else 1, group, r, g, b)


@njit
def aim(rays, position, facing, direction, extent):  # type: ignore[no-untyped-def]
    """Put a ray from a surface into slot 0, lifted off it on the side to which it goes.

    Parameters
    ----------
    rays : Batch
    position, facing, direction : tuple of float32
        World, m; geometric normal and direction of unit length.
    extent : float32
        `Traits.extent`, m.
    """
    s, _ = rays
    gx, gy, gz = facing
    dx, dy, dz = direction
    if gx * dx + gy * dy + gz * dz < ZERO:
        gx, gy, gz = -gx, -gy, -gz
    s[w.OX], s[w.OY], s[w.OZ] = lifted(position[0], position[1], position[2], gx, gy, gz, extent)
    s[w.LX], s[w.LY], s[w.LZ] = dx, dy, dz
    s[w.GX], s[w.GY], s[w.GZ] = gx, gy, gz


@njit
def weigh(scratch, count, view, facing, normals, direction, detailed):  # type: ignore[no-untyped-def]
    """BSDF times cosine along a direction into `value`; returns the pdf of BSDF sampling.

    Parameters
    ----------
    scratch : Scratch
    count : int64
        Lobes.
    view, facing, direction : tuple of float32
        Unit, world.
    normals : tuple of tuple
        Shading normal, and that without normal and bump maps.
    detailed : bool
        Whether there are such maps.

    Returns
    -------
    float32
        sr^-1.
    """
    value = scratch.value
    pdf = evaluate(scratch.lobes, count, view, direction, facing, value)
    if detailed:
        dx, dy, dz = direction
        if facing[0] * dx + facing[1] * dy + facing[2] * dz > ZERO:
            shadow = bump_shadow(normals[0], normals[1], direction)
            value[0], value[1], value[2] = value[0] * shadow, value[1] * shadow, value[2] * shadow
    return pdf


@njit
def weigh_lit(at, direction, scratch, count, scene):  # type: ignore[no-untyped-def]
    """`weigh` along a light sample, with its shadow ray in slot 0, whose start `wavefront.terminate` describes.

    As in Cycles, the start is moved for light that passes the surface, too, on the side where it goes.

    Parameters
    ----------
    at : tuple
        As of `towards_envmap`.
    direction : tuple of float32
        Unit, world.
    scratch : Scratch
    count : int64
        Lobes.
    scene : Scene

    Returns
    -------
    float32
        Pdf of BSDF sampling, sr^-1.
    """
    place, position, view, facing, normals = at
    s, value, extent, geometry = scratch.rays.floats, scratch.value, scene.traits.extent, scene.geometry
    pdf = weigh(scratch, count, view, facing, normals, direction, scene.traits.detailed)
    aim(scratch.rays, position, facing, direction, extent)
    s[w.MOVED] = s[w.LIMIT] = s[w.UX] = s[w.UY] = s[w.UZ] = ZERO
    s[w.PG] = pdf
    if geometry.terminators == 0:
        return pdf
    (gx, gy, gz), (dx, dy, dz), (ux, uy, uz) = facing, direction, normals[1]
    above, flat = ux * dx + uy * dy + uz * dz, gx * dx + gy * dy + gz * dz
    if above <= ZERO:
        gx, gy, gz, flat = -gx, -gy, -gz, -flat
    s[w.HX], s[w.HY], s[w.HZ], limit = terminator_at(place[0], place[1], place[2], place[3], gx, gy, gz, geometry)
    s[w.LIMIT], s[w.NX], s[w.NY], s[w.NZ] = limit, ux, uy, uz
    if not limit > ZERO:
        return pdf
    if above <= ZERO and flat <= ZERO:
        for c in range(9):
            value[c] = ZERO
        return pdf
    if flat <= ZERO:
        # Below the face, but above the smooth surface.
        s[w.OX], s[w.OY], s[w.OZ] = lifted(position[0], position[1], position[2], gx, gy, gz, extent)
        s[w.GX], s[w.GY], s[w.GZ] = gx, gy, gz
        if not pdf > ZERO:
            shadow = bump_shadow(normals[0], normals[1], direction) if scene.traits.detailed else ONE
            s[w.PG] = evaluate_below(scratch.lobes, count, view, direction, shadow, value)
    part = TWO - (flat + above) / limit if above < limit else ONE - flat / limit
    s[w.MOVED] = min(max(part, ZERO), ONE)
    return pdf


@njit
def is_bright(value):  # type: ignore[no-untyped-def]
    """Whether any light passes.

    Parameters
    ----------
    value : (9,) float32 array

    Returns
    -------
    bool
    """
    total = ZERO
    for c in range(9):
        total += value[c]
    return total > ZERO


@njit
def towards_envmap(numbers, at, row, throughput, first, scratch, count, scene, settings):  # type: ignore[no-untyped-def]
    """The environment sample.

    Parameters
    ----------
    numbers : tuple of uint32
        Random numbers.
    at : tuple
        Face, instance and barycentric coordinates; position (m), direction to the viewer, geometric normal, shading
        normal and that without maps, world.
    row : int32
        Of the environment's tables.
    throughput : tuple of float32
        Of the path, linear Rec.709.
    first : bool
        Whether the vertex is the shading point.
    scratch : Scratch
    count : int64
        Lobes.
    scene : Scene
    settings : Settings
    """
    envmap, s = scene.envmap, scratch.rays.floats
    n0, n1, n2 = numbers
    block = np.int64(block_of(row, n2, envmap))
    inside, ratio = in_cells_order(row, block, n2, mix(n2), envmap)
    cell = first_cell(inside, envmap)
    while inside > cell_end(cell, envmap):
        cell += 1
    column, upper, lower, a, b, c, d = cell_at(cell, envmap)
    dx, dy, dz, u, v, density = direction_in_cell(column, upper, lower, (a, b, c, d), n0, n1, envmap)
    pdf = weigh_lit(at, (dx, dy, dz), scratch, count, scene)
    own = density * ratio
    if not (own > ZERO and is_bright(scratch.value)):
        return
    r, g, b = envmap_radiance(u, v, envmap)
    if not r + g + b > ZERO:
        return
    through = passed(scene, scratch.rays, 0, FAR, np.int32(ray_masks.SHADOW << settings.shift))
    if through > ZERO:
        k = through / (own + pdf)
        if w.grazing(s, 0) > ZERO:
            k = through * power_heuristic(density, s[w.PG]) / own
        light = (r * k, g * k, b * k)
        gather(light, light, throughput, first, group_of_environment(scene.lights), scene.lights, scratch)


@njit
def towards_lights(numbers, at, receiver, throughput, first, scratch, count, scene, settings):  # type: ignore[no-untyped-def]
    """The light sample.

    Parameters
    ----------
    numbers : tuple of uint32
        Random numbers.
    at : tuple
        Face, instance and barycentric coordinates; position (m), direction to the viewer, geometric normal, shading
        normal and that without maps, world.
    receiver : float32
        Set of the surface, see `light_links`.
    throughput : tuple of float32
        Of the path, linear Rec.709.
    first : bool
        Whether the vertex is the shading point.
    scratch : Scratch
    count : int64
        Lobes.
    scene : Scene
    settings : Settings
    """
    rays = scratch.rays
    s, ints = rays
    n0, n1, n2 = numbers
    own = lights_of(scene.lights, receiver)
    (px, py, pz), (gx, gy, gz) = at[1], at[3]
    # From where rays start: else shadow rays reach surfaces that emit, and pdfs are not those of `light_along`.
    px, py, pz = lifted(px, py, pz, gx, gy, gz, scene.traits.extent)
    dx, dy, dz, distance, r, g, b, density, light = sample_light(n2, n0, n1, px, py, pz, own)
    if not (density != ZERO and r + g + b > ZERO):
        return
    pdf = weigh_lit(at, (dx, dy, dz), scratch, count, scene)
    if not is_bright(scratch.value):
        return
    # Of light from below, the ray starts on the other side.
    mx, my, mz = s[w.OX] - px, s[w.OY] - py, s[w.OZ] - pz
    distance -= math.sqrt(mx * mx + my * my + mz * mz)
    s[w.ER], s[w.EG], s[w.EB], s[w.MU], s[w.MV], s[w.LIVE] = r, g, b, distance, density, ONE
    ints[w.CELL] = U(max(light, 0))
    mask = np.int32(ray_masks.SHADOW << settings.shift)
    dr, dg, db, gr, gg, gb = light_radiance(rays, 0, pdf, pdf, (ONE, ONE), receiver, scene, mask)
    if dr + dg + db + gr + gg + gb > ZERO:
        group = group_of_sample(scene.lights, receiver, np.int64(ints[w.CELL]))
        gather((dr, dg, db), (gr, gg, gb), throughput, first, group, scene.lights, scratch)


@njit
def light_along(ray, densities, receiver, row, diffuse, throughput, first, scratch, scene):  # type: ignore[no-untyped-def]
    """Gather the light along a ray of the BSDF; `densities`: its pdf, and 1, or 0 for a delta.

    Parameters
    ----------
    ray : tuple
        Origin (m) and unit direction, world; distance (m) up to which lights are seen; the `MixedHit`; the share of
        light from beyond everything.
    densities : tuple of float32
    receiver : float32
        Set of the surface that the ray leaves.
    row : int32
        Of the environment's tables.
    diffuse : bool
        Whether the ray is of a diffuse lobe.
    throughput : tuple of float32
        Of the path, linear Rec.709.
    first : bool
        Whether the vertex is the shading point.
    scratch : Scratch
    scene : Scene
    """
    origin, direction, reach, hit, through = ray
    pdf, share = densities
    lights, value = scene.lights, scratch.value
    own = lights_of(lights, receiver)
    if scene.traits.lights:
        seen_by = DIFFUSE if diffuse else GLOSSY
        light = lights_along(origin, direction, reach, pdf, share, seen_by, own)
        if light[0] + light[1] + light[2] > ZERO:
            gather(light, light, throughput, first, np.int64(-1), lights, scratch)
            r, g, b = value[0] + value[3] + value[6], value[1] + value[4] + value[7], value[2] + value[5] + value[8]
            if not first:
                r, g, b = throughput[0] * r, throughput[1] * g, throughput[2] * b
            seen = origin, direction, reach, pdf, share, seen_by
            credit_lamps_of_path(lights, own, scratch.grouped, 0 if first else 1, receiver, (r, g, b), seen)
    if scene.traits.emissive and emits_to(lights, receiver, hit, scene.geometry):
        r, g, b, density, glossy = emission_along(origin, direction, hit, scene.geometry, own)
        k = ONE / (pdf + share * (density if diffuse else glossy))
        light = k * r, k * g, k * b
        if light[0] + light[1] + light[2] > ZERO:
            gather(light, light, throughput, first, group_of_hit(lights, hit, scene.geometry), lights, scratch)
    if through > ZERO and scene.traits.environment:
        u, v = map_at(direction[0], direction[1], direction[2], scene.envmap)
        r, g, b = envmap_radiance(u, v, scene.envmap)
        z = height_in_map(direction[0], direction[1], direction[2], scene.envmap)
        k = through / (pdf + share * envmap_pdf(u, v, z, row, scene.envmap))
        if share > ZERO and w.grazing(scratch.rays.floats, 0) > ZERO:
            k = through * (ONE - power_heuristic(envmap_pdf(u, v, z, U(SIDE * SIDE), scene.envmap), pdf)) / pdf
        light = k * r, k * g, k * b
        if light[0] + light[1] + light[2] > ZERO:
            gather(light, light, throughput, first, group_of_environment(lights), lights, scratch)
