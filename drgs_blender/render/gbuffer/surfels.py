"""Blended surfels to shading points whose secondary rays are safe.

Rays that light a surfel meet the mesh, and the mesh is not where the surfels are: a ray that starts at a surfel below
the mesh is blocked by its own surface, one that starts above misses contact shadows. Every point is therefore moved to
the mesh point that belongs to it:

1. along the camera ray, within a window of depths around the surfel: the first face that is turned as the surfel is,
   and to the viewer, unless the surfel is clearly seen from behind and no face before it is turned to the viewer;
2. else the first face along it that is turned to the viewer: the surfel overhangs a fold, and what is seen beyond the
   fold is lit as the face there, with that face's normal;
3. else (the surfel overhangs the mesh's silhouette) within the window along its normal, inwards, then outwards;
4. else where the way back to the viewer leaves the mesh, however far: the surfel lies deep inside of it, or behind a
   wall that the mesh has and the surfels have not;
5. else the nearest face along the camera ray within the window, whichever way it is turned;
6. else (no mesh near) the point stays where it is, lifted by the window along its normal.

Where light meets the surfels themselves, points stay where they are, and say which surfels are their own. Those of an
object whose light meets sheets (`surfels.sheets`) are lifted by the window along their normals: sheets lie at all
angles, and would shade each other.

A surfel's normal that is turned away from its face by more than 60 degrees would lose most of the light between both;
the face's own is used then.

The window is `WINDOW_SCALES` standard deviations of the surfels or `WINDOW_EDGES` mean edge lengths of the object's
mesh, whichever is larger. The seen position and depth stay those of the surfels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import over_strided
from ...core.frame import Camera
from ..camera import WIDTH, sample_ray
from ..sampling import F
from ..scene.interaction import nearest
from ..scene.ray import Ray
from ..scene.ray_masks import SURFELS
from ..scene.trace_scene import TraceScene
from ..shading_points import SECOND, UNLIT
from ..surfel_columns import ALBEDO, METALLIC, NORMAL, ROUGHNESS, SIZE
from ..surfels.captured import CapturedSamples
from ..surfels.raster import SurfelSamples, rasterise
from ..surfels.splats import Splats
from .camera_hits import shade_mesh, trace_camera
from .gbuffer import GBuffer, compact, face_viewer
from .layers import combine
from .mesh_hits import MeshHits
from .surfel_rays import SurfelRays

Array = np.ndarray

WINDOW_SCALES = 4.0
WINDOW_EDGES = 2.0
#: A surfel off the mesh's silhouette counts as seen from behind only when this cosine says so clearly.
RIM = 0.3
#: Cosine between a surfel's normal and a face's from which they are turned alike.
ALIKE = 0.5

#: Points of a block.
_BLOCK = 256

# How a surfel's mesh point was found.
NOWHERE, ALONG_VIEW, ALONG_NORMAL, ANY_SIDE, FACING = 0, 1, 2, 3, 4
#: Part of the way to the viewer along which the outside of a mesh is sought, and faces that are passed on it.
_BACK, _WALLS = 0.999, 3


def snap_windows(scene: TraceScene, object_count: int) -> Array:
    """(max(object_count, 1),) float32 metres: `WINDOW_EDGES` times the mean edge length of each object's mesh.

    Negative where light meets sheets of the object's surfels: points are not tied to the mesh.
    """
    total, count = np.zeros((2, max(object_count, 1)))
    _edge_lengths(scene.vertices, scene.faces, scene.face_object, total, count)
    sheeted = scene.sheeted[: len(total)]
    total[: len(sheeted)][sheeted] *= -1
    return (WINDOW_EDGES * total / np.maximum(count, 1)).astype(np.float32)


def primary_surfels(
    splats: Splats | SurfelRays,
    scene: TraceScene,
    windows: Array,
    camera: Camera,
    y0: int,
    y1: int,
    tied: bool = True,
    stages: Stages | None = None,
) -> GBuffer:
    """Blend the surfels of the rows ``y0 .. y1`` (full-picture pixels) and tie them to the mesh.

    Parameters
    ----------
    splats : Splats or SurfelRays
        `prepare` of this frame; of a panoramic camera `SurfelRays`, which the stages must blend.
    scene : TraceScene
    windows : array
        `snap_windows` of this frame.
    camera : Camera
    y0, y1 : int
    tied : bool
        False: rays meet surfels, and nothing is tied.
    stages : Stages, optional
        Functions of a backend; None: the CPU's.
    """
    stages = stages or Stages()
    samples = stages.rasterise(splats, y0, y1)
    layers = combine(samples, scene, splats.parameters, camera.window[0], y0, stages.trace)
    detailed = scene.mesh_materials.table.detailed
    buffer = compact(layers.first, splats.parameters, camera.window[0], y0, layers.second, detailed)
    buffer.alpha = layers.opaque
    points = buffer.points
    stages.tie(
        scene,
        (tied, scene.any_drgs),
        (splats.parameters, windows, camera.window[0], y0),
        (samples.depth, samples.surface, samples.object_index),
        (points.pixel, points.sample, points.flags),
        (points.origin, points.normal, points.geometric_normal, points.view),
        (points.albedo, points.roughness, points.metallic),
        (buffer.position, buffer.depth, buffer.object_index, buffer.face, buffer.instance, buffer.barycentric),
    )
    if not tied:
        row, column = np.divmod(points.pixel, splats.parameters[WIDTH].astype(np.int64))
        points.own = np.where(points.flags & SECOND, -1, buffer.object_index).astype(np.int32)
        points.size = samples.surface[row - y0, column - camera.window[0], points.sample, SIZE]
    if layers.hits is not None:
        stages.shade(scene, layers.hits, splats.parameters, camera.window[0], buffer, SECOND)
    buffer.mark_catchers(scene.object_flags)
    return buffer


def show_captured(buffer: GBuffer, blended: CapturedSamples, x0: int, width: int) -> None:
    """Have the points of captured objects emit what was captured, and reflect nothing.

    Parameters
    ----------
    buffer : GBuffer
        Of `primary_surfels` with these samples; written.
    blended : CapturedSamples
    x0, width : int
        First column of the window, and columns of the picture.
    """
    points = buffer.points
    row, column = np.divmod(points.pixel, width)
    where = row - buffer.rows[0], column - x0, points.sample
    shown = np.flatnonzero(blended.captured[where] & (points.flags & SECOND == 0))
    buffer.emission[shown] = blended.radiance[tuple(index[shown] for index in where)]
    points.flags[shown] |= UNLIT


def show_emission(buffer: GBuffer, emitted: SurfelSamples, x0: int, width: int) -> None:
    """Have the points of surfels emit.

    Parameters
    ----------
    buffer : GBuffer
        Of `primary_surfels`; written.
    emitted : SurfelSamples
        The same samples of surfels that have radiance in place of their albedo.
    x0, width : int
        First column of the window, and columns of the picture.
    """
    points = buffer.points
    shown = np.flatnonzero(points.flags & (SECOND | UNLIT) == 0)
    row, column = np.divmod(points.pixel[shown], width)
    own = emitted.surface[row - buffer.rows[0], column - x0, points.sample[shown]]
    buffer.emission[shown] = own[:, ALBEDO : ALBEDO + 3]


@njit
def _edge_lengths(vertices, faces, face_object, total, count):  # type: ignore[no-untyped-def]
    """Sum and number of edge lengths an object, from at most about 100,000 evenly chosen faces."""
    step = max(1, len(faces) // 100_000)
    for f in range(0, len(faces), step):
        owner = face_object[f]
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            x = vertices[b, 0] - vertices[a, 0]
            y = vertices[b, 1] - vertices[a, 1]
            z = vertices[b, 2] - vertices[a, 2]
            if owner < len(total):
                total[owner] += np.sqrt(x * x + y * y + z * z)
                count[owner] += 1


@inlined
def _shoot(tracer, x, y, z, dx, dy, dz, reach):  # type: ignore[no-untyped-def]
    """Closest hit on the segment from (x, y, z) along (dx, dy, dz): its parameter, unit face normal, face and u, v.

    The face is -1 when nothing is hit.

    Short segments that start near the surface keep float32 exact where a ray from a distant camera would not.
    """
    origin, direction = (F(x), F(y), F(z)), (F(dx), F(dy), F(dz))
    ray = Ray(origin, direction, F(0.0), F(reach), np.int32(SURFELS))
    t, face, _, u, v, gx, gy, gz = nearest(tracer, ray)
    length = np.sqrt(np.float64(gx) * gx + np.float64(gy) * gy + np.float64(gz) * gz)
    if face < 0 or length == 0.0:
        return np.float64(0.0), 0.0, 0.0, 0.0, np.int32(-1), u, v
    return np.float64(t), gx / length, gy / length, gz / length, face, u, v


@inlined
def _find(tracer, point, normal, view, ahead, window, away):  # type: ignore[no-untyped-def]
    """Mesh point of a surfel's `point` and `normal`, seen from the direction `view` and from `away`, metres.

    How it was found, point, face normal, and the face with u and v (-1: none).
    """
    x, y, z = point
    nx, ny, nz = normal
    vx, vy, vz = view
    how = NOWHERE
    face, a, b = np.int32(-1), np.float32(0.0), np.float32(0.0)
    hx, hy, hz, gx, gy, gz = x, y, z, nx, ny, nz
    turned = nx * vx + ny * vy + nz * vz < -RIM
    left = ahead + window
    sx, sy, sz = x + ahead * vx, y + ahead * vy, z + ahead * vz
    for _ in range(3):
        t, fx, fy, fz, hit, u, v = _shoot(tracer, sx, sy, sz, -vx, -vy, -vz, left)
        if hit < 0:
            break
        sx, sy, sz = sx - t * vx, sy - t * vy, sz - t * vz
        facing = fx * vx + fy * vy + fz * vz > 0.0
        # behind a face that is turned to the viewer lies the inside: a surfel seen from behind there is a wrong one
        agrees = fx * nx + fy * ny + fz * nz > ALIKE and (facing or (turned and how != FACING))
        if agrees or how == NOWHERE or (facing and how == ANY_SIDE):
            how = ALONG_VIEW if agrees else FACING if facing else ANY_SIDE
            hx, hy, hz, gx, gy, gz = sx, sy, sz, fx, fy, fz
            face, a, b = hit, u, v
        past = 1e-3 * window
        left -= t + past
        if agrees or left <= 0.0:
            break
        sx, sy, sz = sx - past * vx, sy - past * vy, sz - past * vz
    if how != ALONG_VIEW and how != FACING:
        for turn in range(2):
            side = 2.0 * turn - 1.0
            t, fx, fy, fz, hit, u, v = _shoot(tracer, x, y, z, side * nx, side * ny, side * nz, window)
            if hit >= 0 and fx * nx + fy * ny + fz * nz > ALIKE:
                t *= side
                return ALONG_NORMAL, x + t * nx, y + t * ny, z + t * nz, fx, fy, fz, hit, u, v
    if how in (NOWHERE, ANY_SIDE):
        sx, sy, sz, left = x, y, z, _BACK * away
        for _ in range(_WALLS):
            t, fx, fy, fz, hit, u, v = _shoot(tracer, sx, sy, sz, vx, vy, vz, left)
            if hit < 0:
                break
            sx, sy, sz = sx + t * vx, sy + t * vy, sz + t * vz
            if fx * vx + fy * vy + fz * vz > 0.0:
                return FACING, sx, sy, sz, fx, fy, fz, hit, u, v
            past = 1e-3 * window
            left -= t + past
            sx, sy, sz = sx + past * vx, sy + past * vy, sz + past * vz
    return how, hx, hy, hz, gx, gy, gz, face, a, b


@njit
def attach_points(thread, stride, scratch, tracer, rules, view_of, samples, keys, out):  # type: ignore[no-untyped-def]
    """Fill every `stride`-th block of shading points, from the `thread`-th on; see the module's head.

    Parameters
    ----------
    thread, stride : int64
    scratch : tuple
        Not used.
    tracer : Tracer
    rules, view_of, samples, keys, out : tuple
        As of `tie_to_mesh`; the last is its three groups of arrays to be filled.
    """
    tied, any_mesh = rules
    p, windows, x0, y0 = view_of
    sample_depth, surface, sample_object = samples
    pixel, sample, flags = keys
    frames, materials, seen = out
    origin, normal, geometric, view = frames
    albedo, roughness, metallic = materials
    position, depth, owner, tied_face, tied_place, barycentric = seen
    width = np.int64(p[WIDTH])
    for block in range(thread, (len(pixel) + _BLOCK - 1) // _BLOCK, stride):
        for n in range(block * _BLOCK, min((block + 1) * _BLOCK, len(pixel))):
            if flags[n] & SECOND:
                continue
            row, column, k = pixel[n] // width - y0, pixel[n] % width - x0, sample[n]
            s = np.float64(sample_depth[row, column, k])
            who = sample_object[row, column, k]
            ox, oy, oz, dx, dy, dz = sample_ray(p, pixel[n], sample[n])
            x, y, z = ox + s * dx, oy + s * dy, oz + s * dz
            slope = np.sqrt(dx * dx + dy * dy + dz * dz)
            vx, vy, vz = -dx / slope, -dy / slope, -dz / slope
            nx, ny, nz = (
                np.float64(surface[row, column, k, NORMAL]),
                np.float64(surface[row, column, k, NORMAL + 1]),
                np.float64(surface[row, column, k, NORMAL + 2]),
            )
            if nx * nx + ny * ny + nz * nz < 0.5:
                nx, ny, nz = vx, vy, vz
            window = np.float64(WINDOW_SCALES) * surface[row, column, k, SIZE]
            loose = not tied
            if who < len(windows):
                window = max(window, abs(np.float64(windows[who])))
                loose = loose or windows[who] < 0.0
            # The window starts in front of the surfel, yet not behind the camera.
            ahead = min(window, 0.999 * s * slope)
            how = NOWHERE
            hx, hy, hz, gx, gy, gz = x, y, z, nx, ny, nz
            face, u, v = np.int32(-1), np.float32(0.0), np.float32(0.0)
            if any_mesh:
                how, hx, hy, hz, gx, gy, gz, face, u, v = _find(
                    tracer, (x, y, z), (nx, ny, nz), (vx, vy, vz), ahead, window, s * slope
                )  # fmt: skip
            if loose:  # the face says how the point moves, nothing else
                how, hx, hy, hz, gx, gy, gz = NOWHERE, x, y, z, nx, ny, nz
            # A face met by the camera ray shows which side is seen; else the surfel does, save at its rim.
            if how in (ALONG_VIEW, ANY_SIDE, FACING):
                behind = gx * vx + gy * vy + gz * vz < 0.0
            else:
                # Without a mesh it may be a leaf, of which the back is as good as the front.
                closed = who < len(windows) and (windows[who] > 0.0 if tied else windows[who] != 0.0)
                behind = nx * vx + ny * vy + nz * vz < (-RIM if closed else 0.0)
            if behind:
                gx, gy, gz = -gx, -gy, -gz
            gx, gy, gz = face_viewer(gx, gy, gz, gx, gy, gz, vx, vy, vz)
            nx, ny, nz = face_viewer(nx, ny, nz, gx, gy, gz, vx, vy, vz)
            if nx * gx + ny * gy + nz * gz < ALIKE:
                nx, ny, nz = gx, gy, gz
            if tied and how == NOWHERE:
                hx, hy, hz = x + window * gx, y + window * gy, z + window * gz
            origin[n, 0], origin[n, 1], origin[n, 2] = hx, hy, hz
            normal[n, 0], normal[n, 1], normal[n, 2] = nx, ny, nz
            geometric[n, 0], geometric[n, 1], geometric[n, 2] = gx, gy, gz
            view[n, 0], view[n, 1], view[n, 2] = vx, vy, vz
            albedo[n, 0], albedo[n, 1], albedo[n, 2] = (
                surface[row, column, k, ALBEDO],
                surface[row, column, k, ALBEDO + 1],
                surface[row, column, k, ALBEDO + 2],
            )
            roughness[n], metallic[n] = surface[row, column, k, ROUGHNESS], surface[row, column, k, METALLIC]
            position[n, 0], position[n, 1], position[n, 2] = x, y, z
            depth[n], owner[n] = s, who
            tied_face[n], tied_place[n], barycentric[n, 0], barycentric[n, 1] = face, -1, u, v


@njit
def _attach(first, last, stride, tracer, rules, view_of, samples, keys, out):  # type: ignore[no-untyped-def]
    for thread in range(first, last):
        attach_points(thread, stride, None, tracer, rules, view_of, samples, keys, out)


def tie_to_mesh(scene: TraceScene, *arguments: Any) -> None:
    """Tie shading points to the mesh.

    Parameters
    ----------
    scene : TraceScene
    *arguments : tuple
        Whether points are tied at all, and whether there is a mesh; parameters of the camera, windows, and the first
        column and row of the samples; depth, surface and object of these; pixel, sample and flags of the points; and
        the arrays to be filled: origin, normal, geometric normal and view; albedo, roughness and metallic; position,
        depth, object, face, instance and barycentric coordinates.
    """
    *inwards, keys, frames, materials, seen = arguments
    out = frames, materials, seen
    over_strided(_attach, -(-len(keys[0]) // _BLOCK), scene.tracer, *inwards, keys, out, calls=8)


class Stages(NamedTuple):
    """Functions for the stages of `primary_surfels`.

    Attributes
    ----------
    rasterise : callable
        Blends the surfels.
    tie : callable
        Ties their points to the mesh.
    trace, shade : callable
        As of `mesh.primary_mesh`, for ordinary meshes next to the surfels.
    """

    rasterise: Callable[[Any, int, int], SurfelSamples] = rasterise
    tie: Callable[..., None] = tie_to_mesh
    trace: Callable[..., MeshHits] = trace_camera
    shade: Callable[..., None] = shade_mesh
