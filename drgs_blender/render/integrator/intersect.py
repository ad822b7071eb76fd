"""Rays of the integrator: what they meet of meshes and, where there are any to meet, of the surfels of DR-GS objects.

With surfels a shadow ray brings what these let through, and a ray that looks for a surface meets the surfels in front
of the nearest mesh as one blended surface, see `surfels.surfel_tracer`. What they let through reaches the
environment; where a mesh lies behind them, chance decides which of the two the ray meets. Functions that end in
``_meshes`` are for meshes alone; a device has no others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ..sampling import ONE, ZERO, F, U, mix, unit
from ..scene.interaction import Tracer, nearest, shadowed, surface_at
from ..scene.ray import Hit, Ray
from ..scene.see_through import nearest_there, transmitted
from ..surfels.raster import GAP
from ..surfels.surfel_query import RayStart
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
    first_instance: int
    surfel_intersect: int
    surfel_occluded: int
    surfel_scene: int
    surface: int
    surfel_object: int


class MixedHit(NamedTuple):
    """`Hit` of a mesh, or of surfels as one blended surface: then face and instance are -1, and the rest describes it.

    Attributes
    ----------
    t, face, instance, u, v, gx, gy, gz : np.float32
        As of `Hit`.
    nx, ny, nz : np.float32
        Unit shading normal.
    r, g, b : np.float32
        Albedo, linear Rec.709.
    roughness, metallic : np.float32
        In [0, 1].
    size : np.float32
        Metres: mean larger standard deviation of the surfels.
    owner : np.int32
        Their object; -1: it is a mesh.
    """

    t: np.float32
    face: np.int32
    instance: np.int32
    u: np.float32
    v: np.float32
    gx: np.float32
    gy: np.float32
    gz: np.float32
    nx: np.float32
    ny: np.float32
    nz: np.float32
    r: np.float32
    g: np.float32
    b: np.float32
    roughness: np.float32
    metallic: np.float32
    size: np.float32
    owner: np.int32


def meshes_alone(meshes: Tracer) -> MixedTracer:
    """A tracer of no surfels."""
    return MixedTracer(*meshes, 0, 0, 0, 0, 0)


@njit
def ray_of(rays, slot, far, mask):  # type: ignore[no-untyped-def]
    """The `Ray` of a slot: from its position along its direction up to a distance.

    Parameters
    ----------
    rays : Batch
        OX to OZ (m) and LX to LZ (unit) are read, world.
    slot : int64
    far : float32
        Metres; its `tfar`. The ray's `tnear` is 0.
    mask : int32
        See `ray_masks`.

    Returns
    -------
    Ray
    """
    s, _ = rays
    i, _ = w.at(slot)
    origin, direction = (s[i + w.OX], s[i + w.OY], s[i + w.OZ]), (s[i + w.LX], s[i + w.LY], s[i + w.LZ])
    return Ray(origin, direction, ZERO, far, mask)


@njit
def shadow_ray_of(rays, slot, far, mask):  # type: ignore[no-untyped-def]
    """`ray_of` towards the same place from where `wavefront.terminate` lets it start.

    Parameters
    ----------
    rays, slot, far, mask : Batch, int64, float32 or int32
        As of `ray_of`; MOVED and H are read, too.

    Returns
    -------
    Ray
    """
    ray = ray_of(rays, slot, far, mask)
    s = rays.floats
    i, _ = w.at(slot)
    part = s[i + w.MOVED]
    if not part > ZERO:
        return ray
    hx, hy, hz = part * s[i + w.HX], part * s[i + w.HY], part * s[i + w.HZ]
    (ox, oy, oz), (dx, dy, dz) = ray.origin, ray.direction
    origin = ox + hx, oy + hy, oz + hz
    if not far < FAR:
        return Ray(origin, ray.direction, ZERO, far, mask)
    dx, dy, dz = far * dx - hx, far * dy - hy, far * dz - hz
    far = math.sqrt(dx * dx + dy * dy + dz * dz)
    scale = ONE / max(far, F(1e-30))
    return Ray(origin, (dx * scale, dy * scale, dz * scale), ZERO, far, mask)


@njit
def _start_of(rays, slot):  # type: ignore[no-untyped-def]
    """The surface that a slot's ray starts on."""
    s, ints = rays
    i, c = w.at(slot)
    return RayStart(np.int32(ints[c + w.OWN]), s[i + w.GX], s[i + w.GY], s[i + w.GZ], s[i + w.SIZE])


@njit
def passed_meshes(scene, rays, slot, far, mask):  # type: ignore[no-untyped-def]
    """`passed` where there are meshes alone.

    Parameters
    ----------
    scene : Scene
        Or a device's.
    rays, slot, far, mask : Batch, int64, float32 or int32
        As of `ray_of`.

    Returns
    -------
    float32
        Visibility; 0 or 1 where light passes no mesh.
    """
    ray = shadow_ray_of(rays, slot, far, mask)
    hidden = shadowed(scene.tracer, ray)
    if scene.traits.clear:
        if hidden:
            return ZERO
        return transmitted(scene.tracer, ray, scene.geometry)
    return ZERO if hidden else ONE


@njit
def passed(scene, rays, slot, far, mask):  # type: ignore[no-untyped-def]
    """Shadow ray: the share of light that reaches a slot's position from its direction, from no farther than `far`.

    Parameters
    ----------
    scene : Scene
    rays, slot, far, mask : Batch, int64, float32 or int32
        As of `ray_of`.

    Returns
    -------
    float32
        0 behind an opaque mesh, else the transmittance of the surfels, see `surfel_tracer.transmittance`, and of
        meshes that light may pass.
    """
    tracer, ray = scene.tracer, shadow_ray_of(rays, slot, far, mask)
    if shadowed(tracer, ray):
        return ZERO
    share = ONE
    if scene.traits.clear:
        share = transmitted(tracer, ray, scene.geometry)
    if tracer.surfel_scene == 0 or share == ZERO:
        return share
    return share * transmittance(tracer, ray, _start_of(rays, slot))


@njit
def _nearest(scene, rays, slot, mask):  # type: ignore[no-untyped-def]
    """The mesh that a slot's ray meets."""
    ray = ray_of(rays, slot, FAR, mask)
    if scene.traits.clear:
        _, c = w.at(slot)
        number = unit(mix(U(rays.ints[c + w.KEY] + U(0x1B56C4E9))))
        t, face, instance, u, v, gx, gy, gz, _ = nearest_there(scene.tracer, ray, scene.geometry, number)
        return t, face, instance, u, v, gx, gy, gz
    t, face, instance, u, v, gx, gy, gz = nearest(scene.tracer, ray)
    return t, face, instance, u, v, gx, gy, gz


@njit
def meet_meshes(scene, rays, slot, mask):  # type: ignore[no-untyped-def]
    """`meet` where there are meshes alone.

    Parameters
    ----------
    scene : Scene
        Or a device's.
    rays, slot, mask : Batch, int64 or int32
        As of `ray_of`; KEY is read, too.

    Returns
    -------
    through : float32
        1 where nothing is met, else 0.
    reach : float32
        Distance of the hit, m.
    hit : Hit
    """
    t, face, instance, u, v, gx, gy, gz = _nearest(scene, rays, slot, mask)
    return (ONE if face < 0 else ZERO), t, Hit(t, face, instance, u, v, gx, gy, gz)


@njit
def meet(scene, rays, slot, mask):  # type: ignore[no-untyped-def]
    """Closest hit of a slot's ray, of meshes and surfels together.

    Parameters
    ----------
    scene : Scene
    rays, slot, mask : Batch, int64 or int32
        As of `ray_of`; KEY is read, too.

    Returns
    -------
    through : float32
        Share of light that comes from beyond everything: 1 where nothing is met, 0 behind a mesh.
    reach : float32
        Metres: lights nearer than this are seen.
    hit : MixedHit
        For `put_hit`; not to be used where `through` is 1.
    """
    tracer, ray = scene.tracer, ray_of(rays, slot, FAR, mask)
    t, face, instance, u, v, gx, gy, gz = _nearest(scene, rays, slot, mask)
    none = np.int32(-1)
    blank = (ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, none)
    if tracer.surfel_scene == 0:
        return (ONE if face < 0 else ZERO), t, MixedHit(t, face, instance, u, v, gx, gy, gz, *blank)
    _, c = w.at(slot)
    key = rays.ints[c + w.KEY]
    before = Ray(ray.origin, ray.direction, ZERO, t, mask)
    number = unit(mix(U(key + U(0x632BE59B))))
    through, depth, nx, ny, nz, px, py, pz, r, g, b, roughness, metallic, size, owner, reach = trace_surfels(
        tracer, before, _start_of(rays, slot), _GAP, number
    )
    if face >= 0:
        if owner < 0 or unit(mix(U(key + U(0x85157AF5)))) < through:
            return ZERO, reach, MixedHit(t, face, instance, u, v, gx, gy, gz, *blank)
        through = ZERO
    blended = (nx, ny, nz, r, g, b, roughness, metallic, size, owner)
    return through, reach, MixedHit(depth, none, none, ZERO, ZERO, px, py, pz, *blended)


@njit
def _put_face(rays, slot, start, hit, key, owner):  # type: ignore[no-untyped-def]
    s, ints = rays
    i, c = w.at(slot)
    (px, py, pz), (dx, dy, dz) = start
    t = hit.t
    s[i + w.OX], s[i + w.OY], s[i + w.OZ] = px + t * dx, py + t * dy, pz + t * dz
    s[i + w.VX], s[i + w.VY], s[i + w.VZ] = -dx, -dy, -dz
    s[i + w.GX], s[i + w.GY], s[i + w.GZ] = hit.gx, hit.gy, hit.gz
    s[i + w.MU], s[i + w.MV] = hit.u, hit.v
    ints[c + w.N0], ints[c + w.N1] = U(hit.face), U(hit.instance)
    ints[c + w.KEY], ints[c + w.OWNER] = key, U(owner)


@njit
def put_hit_meshes(tracer, rays, slot, start, hit, key, owner):  # type: ignore[no-untyped-def]
    """`put_hit` where there are meshes alone.

    Parameters
    ----------
    tracer : MixedTracer
        Not used.
    rays, slot, start, hit, key, owner : Batch, int64, tuple, Hit or uint32
        As of `put_hit`.
    """
    _put_face(rays, slot, start, hit, key, owner)


@njit
def put_hit(tracer, rays, slot, start, hit, key, owner):  # type: ignore[no-untyped-def]
    """Put what a ray met into a slot, as `surface_of` reads it.

    Parameters
    ----------
    tracer : MixedTracer
    rays : Batch
        Written: position and viewer of the hit, its normals and materials or its face, KEY, OWNER and OWN.
    slot : int64
    start : tuple of tuple
        Origin (m) and unit direction of the ray, (x, y, z) float32 each, world.
    hit : MixedHit
        As `meet` returns it.
    key : uint32
        Key of the path's random numbers.
    owner : int64
        The path: its row of `found`, see `indirect.trace_paths`.
    """
    _put_face(rays, slot, start, hit, key, owner)
    if tracer.surfel_scene == 0:
        return
    s, ints = rays
    i, c = w.at(slot)
    s[i + w.NX], s[i + w.NY], s[i + w.NZ] = hit.nx, hit.ny, hit.nz
    s[i + w.AR], s[i + w.AG], s[i + w.AB] = hit.r, hit.g, hit.b
    s[i + w.A2], s[i + w.FR], s[i + w.SIZE] = hit.roughness, hit.metallic, hit.size
    ints[c + w.OWN] = U(hit.owner)


@njit
def _face_of(rays, slot, geometry):  # type: ignore[no-untyped-def]
    s, ints = rays
    i, c = w.at(slot)
    face, instance = np.int32(ints[c + w.N0]), np.int32(ints[c + w.N1])
    hit = Hit(ZERO, face, instance, s[i + w.MU], s[i + w.MV], s[i + w.GX], s[i + w.GY], s[i + w.GZ])
    return surface_at(hit, (-s[i + w.VX], -s[i + w.VY], -s[i + w.VZ]), geometry)[:17]


@njit
def surface_of_meshes(tracer, rays, slot, geometry):  # type: ignore[no-untyped-def]
    """`surface_of` where there are meshes alone.

    Parameters
    ----------
    tracer : MixedTracer
        Not used.
    rays, slot, geometry : Batch, int64 or Geometry
        As of `surface_of`.

    Returns
    -------
    nx, ny, nz, gx, gy, gz, r, g, b, roughness, metallic, er, eg, eb, ux, uy, uz : float32
        As of `surface_of`.
    """
    return _face_of(rays, slot, geometry)


@njit
def surface_of(tracer, rays, slot, geometry):  # type: ignore[no-untyped-def]
    """Surface (`surface_at`) of the hit that `put_hit` put into a slot.

    Parameters
    ----------
    tracer : MixedTracer
        Not used.
    rays : Batch
    slot : int64
    geometry : Geometry

    Returns
    -------
    nx, ny, nz, gx, gy, gz : float32
        Unit shading and geometric normal, world.
    r, g, b : float32
        Albedo, linear Rec.709.
    roughness, metallic : float32
        In [0, 1].
    er, eg, eb : float32
        Emitted radiance, linear Rec.709; 0 of surfels.
    ux, uy, uz : float32
        Unit shading normal without normal and bump maps, world.
    """
    s, ints = rays
    i, c = w.at(slot)
    if ints[c + w.N0] != _SURFELS:
        return _face_of(rays, slot, geometry)
    return (
        s[i + w.NX], s[i + w.NY], s[i + w.NZ], s[i + w.GX], s[i + w.GY], s[i + w.GZ],
        s[i + w.AR], s[i + w.AG], s[i + w.AB], s[i + w.A2], s[i + w.FR], ZERO, ZERO, ZERO,
        s[i + w.NX], s[i + w.NY], s[i + w.NZ],
    )  # fmt: skip


@njit
def put_start_meshes(tracer, rays, slot, points, point):  # type: ignore[no-untyped-def]
    """`put_start` where there are meshes alone: nothing to do.

    Parameters
    ----------
    tracer, rays, slot, points, point : MixedTracer, Batch, int64 or PointArrays
        As of `put_start`; not used.
    """


@njit
def put_start(tracer, rays, slot, points, point):  # type: ignore[no-untyped-def]
    """Put into a slot which surfels are a shading point's own, so that they do not stop its rays.

    Parameters
    ----------
    tracer : MixedTracer
    rays : Batch
        SIZE (m) and OWN (object) are written; nothing without surfels.
    slot : int64
    points : PointArrays
        `own` and `size` are read, see ``ShadingPoints``.
    point : int64
        Row of the points.
    """
    if tracer.surfel_scene == 0:
        return
    s, ints = rays
    i, c = w.at(slot)
    s[i + w.SIZE] = points.size[point]
    ints[c + w.OWN] = U(points.own[point])
