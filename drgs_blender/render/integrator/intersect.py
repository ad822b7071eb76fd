"""Rays of the integrator: what they meet of meshes and, where there are any to meet, of the surfels of DR-GS objects.

With surfels a shadow ray brings what these let through, and a ray that looks for a surface meets the surfels in front
of the nearest mesh as one blended surface, see `surfels.surfel_tracer`. What they let through reaches the
environment; where a
mesh lies behind them, chance decides which of the two the ray meets. Functions that end in ``_meshes`` are for meshes
alone; a device has no others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ..lights.light_shapes import DIFFUSE, GLOSSY
from ..lights.light_shapes import SHADOW as SHADOWED
from ..lights.lights import light_flags
from ..lights.triangle_light import ABSENT
from ..sampling import ONE, ZERO, F, U, mix, unit
from ..scene import ray_masks
from ..scene.interaction import Tracer, nearest, shadowed, surface_at
from ..surfels.raster import GAP
from ..surfels.surfel_query import Start
from ..surfels.surfel_tracer import trace_surfels, transmittance
from . import wavefront as w

FAR = F(np.inf)
_GAP, _SURFELS = F(GAP), U(0xFFFFFFFF)


class MixedTracer(NamedTuple):
    """`Tracer` of the meshes and `SurfelTracer` of the surfels, see there; without surfels the latter's are 0."""

    intersect: int
    occluded: int
    scene: int
    first_face: int
    first_place: int
    surfel_intersect: int
    surfel_occluded: int
    surfel_scene: int
    surface: int
    surfel_object: int


def meshes_alone(meshes: Tracer) -> MixedTracer:
    """A tracer of no surfels."""
    return MixedTracer(*meshes, 0, 0, 0, 0, 0)


@njit
def passed_meshes(tracer, s, ints, slot, far, mask):  # type: ignore[no-untyped-def]
    i, _ = w.at(slot)
    hidden = shadowed(
        tracer, s[i + w.OX], s[i + w.OY], s[i + w.OZ], s[i + w.LX], s[i + w.LY], s[i + w.LZ], ZERO, far, mask
    )
    return ZERO if hidden else ONE


@njit
def passed(tracer, s, ints, slot, far, mask):  # type: ignore[no-untyped-def]
    """Share of light that reaches a slot's position from its direction, from no farther than `far`."""
    i, c = w.at(slot)
    ox, oy, oz, lx, ly, lz = s[i + w.OX], s[i + w.OY], s[i + w.OZ], s[i + w.LX], s[i + w.LY], s[i + w.LZ]
    if shadowed(tracer, ox, oy, oz, lx, ly, lz, ZERO, far, mask):
        return ZERO
    if tracer.surfel_scene == 0:
        return ONE
    start = Start(np.int32(ints[c + w.OWN]), s[i + w.GX], s[i + w.GY], s[i + w.GZ], s[i + w.SIZE])
    return transmittance(tracer, (ox, oy, oz), (lx, ly, lz), ZERO, far, mask, start)


@njit
def meet_meshes(tracer, s, ints, slot, mask):  # type: ignore[no-untyped-def]
    i, _ = w.at(slot)
    hit = nearest(tracer, s[i + w.OX], s[i + w.OY], s[i + w.OZ], s[i + w.LX], s[i + w.LY], s[i + w.LZ], ZERO, FAR, mask)
    return (ONE if hit[1] < 0 else ZERO), hit[0], hit


@njit
def meet(tracer, s, ints, slot, mask):  # type: ignore[no-untyped-def]
    """Follow a slot's ray: ``(through, reach, hit)``.

    ``through`` is the share of light that comes from beyond everything: 1 where nothing is met, 0 behind a mesh. Lights
    nearer than ``reach`` are seen. ``hit`` is for `put_hit`, and not to be used where ``through`` is 1.
    """
    i, c = w.at(slot)
    ox, oy, oz, lx, ly, lz = s[i + w.OX], s[i + w.OY], s[i + w.OZ], s[i + w.LX], s[i + w.LY], s[i + w.LZ]
    t, face, place, u, v, gx, gy, gz = nearest(tracer, ox, oy, oz, lx, ly, lz, ZERO, FAR, mask)
    none = np.int32(-1)
    blank = (ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, none)
    if tracer.surfel_scene == 0:
        return (ONE if face < 0 else ZERO), t, (t, face, place, u, v, gx, gy, gz, *blank)
    key = ints[c + w.KEY]
    start = Start(np.int32(ints[c + w.OWN]), s[i + w.GX], s[i + w.GY], s[i + w.GZ], s[i + w.SIZE])
    number = unit(mix(U(key + U(0x632BE59B))))
    through, depth, nx, ny, nz, px, py, pz, r, g, b, roughness, metallic, size, owner, reach = trace_surfels(
        tracer, (ox, oy, oz), (lx, ly, lz), ZERO, t, mask, start, _GAP, number
    )
    if face >= 0:
        if owner < 0 or unit(mix(U(key + U(0x85157AF5)))) < through:
            return ZERO, reach, (t, face, place, u, v, gx, gy, gz, *blank)
        through = ZERO
    blended = (nx, ny, nz, r, g, b, roughness, metallic, size, owner)
    return through, reach, (depth, none, none, ZERO, ZERO, px, py, pz, *blended)


@njit
def _put_face(s, ints, slot, px, py, pz, dx, dy, dz, hit, key, owner):  # type: ignore[no-untyped-def]
    i, c = w.at(slot)
    t = hit[0]
    s[i + w.OX], s[i + w.OY], s[i + w.OZ] = px + t * dx, py + t * dy, pz + t * dz
    s[i + w.VX], s[i + w.VY], s[i + w.VZ] = -dx, -dy, -dz
    s[i + w.GX], s[i + w.GY], s[i + w.GZ] = hit[5], hit[6], hit[7]
    s[i + w.MU], s[i + w.MV] = hit[3], hit[4]
    ints[c + w.N0], ints[c + w.N1] = U(hit[1]), U(hit[2])
    ints[c + w.KEY], ints[c + w.OWNER] = key, U(owner)


@njit
def put_hit_meshes(tracer, s, ints, slot, px, py, pz, dx, dy, dz, hit, key, owner):  # type: ignore[no-untyped-def]
    _put_face(s, ints, slot, px, py, pz, dx, dy, dz, hit, key, owner)


@njit
def put_hit(tracer, s, ints, slot, px, py, pz, dx, dy, dz, hit, key, owner):  # type: ignore[no-untyped-def]
    """Put what a ray from p along d met (a hit of `meet`) into a slot, as `surface_of` reads it."""
    _put_face(s, ints, slot, px, py, pz, dx, dy, dz, hit, key, owner)
    if tracer.surfel_scene == 0:
        return
    i, c = w.at(slot)
    s[i + w.NX], s[i + w.NY], s[i + w.NZ] = hit[8], hit[9], hit[10]
    s[i + w.AR], s[i + w.AG], s[i + w.AB] = hit[11], hit[12], hit[13]
    s[i + w.A2], s[i + w.METALLIC], s[i + w.SIZE] = hit[14], hit[15], hit[16]
    ints[c + w.OWN] = U(hit[17])


@njit
def _face_of(s, ints, slot, geometry):  # type: ignore[no-untyped-def]
    i, c = w.at(slot)
    return surface_at(
        np.int32(ints[c + w.N0]), np.int32(ints[c + w.N1]), s[i + w.MU], s[i + w.MV],
        s[i + w.GX], s[i + w.GY], s[i + w.GZ], -s[i + w.VX], -s[i + w.VY], -s[i + w.VZ], geometry,
    )[:14]  # fmt: skip


@njit
def surface_of_meshes(tracer, s, ints, slot, geometry):  # type: ignore[no-untyped-def]
    return _face_of(s, ints, slot, geometry)


@njit
def surface_of(tracer, s, ints, slot, geometry):  # type: ignore[no-untyped-def]
    """What `surface_at` says of the hit in a slot, save for its object."""
    i, c = w.at(slot)
    if ints[c + w.N0] != _SURFELS:
        return _face_of(s, ints, slot, geometry)
    return (
        s[i + w.NX], s[i + w.NY], s[i + w.NZ], s[i + w.GX], s[i + w.GY], s[i + w.GZ],
        s[i + w.AR], s[i + w.AG], s[i + w.AB], s[i + w.A2], s[i + w.METALLIC], ZERO, ZERO, ZERO,
    )  # fmt: skip


@njit
def put_start_meshes(tracer, s, ints, slot, own, size, point):  # type: ignore[no-untyped-def]
    pass


@njit
def put_start(tracer, s, ints, slot, own, size, point):  # type: ignore[no-untyped-def]
    """Put into a slot which surfels are the `point`-th shading point's own; see ``ShadingPoints``."""
    if tracer.surfel_scene == 0:
        return
    i, c = w.at(slot)
    s[i + w.SIZE] = size[point]
    ints[c + w.OWN] = U(own[point])


@njit
def light_radiance(s, ints, slot, others, glossy_others, share, lights, tracer, mask):  # type: ignore[no-untyped-def]
    """What a light sample brings: radiance over density for the diffuse and for the glossy lobe, 0 when in shadow.

    `others` and `share` are the balance heuristic's densities of other strategies, for the diffuse and for the glossy
    lobe, and number of light samples.
    """
    i, c = w.at(slot)
    density = s[i + w.MV]
    r, g, b = s[i + w.ER], s[i + w.EG], s[i + w.EB]
    if not (s[i + w.LIVE] > ZERO and r + g + b > ZERO and density != ZERO):
        return ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    flags = light_flags(np.int64(ints[c + w.CELL]), lights[0], lights[2])
    if flags & ABSENT and mask >> ray_masks.WITHOUT:
        return ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    bright = ONE
    if flags & SHADOWED:
        bright = passed(tracer, s, ints, slot, s[i + w.MU] * F(0.9999), mask)
        if not bright > ZERO:
            return ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    if density < ZERO:
        others = glossy_others = ZERO
    density = share * abs(density)
    diffuse = bright / (others + density) if flags & DIFFUSE else ZERO
    glossy = bright / (glossy_others + density) if flags & GLOSSY else ZERO
    return r * diffuse, g * diffuse, b * diffuse, r * glossy, g * glossy, b * glossy
