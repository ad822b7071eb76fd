"""Camera rays against meshes: what they meet first, and points to be lit there."""

from __future__ import annotations

import math

import numpy as np

from ...compute.jit import njit
from ...compute.threads import over_strided
from ..camera import CLIP_END, CLIP_START, WIDTH, pixel_shift, sample_ray
from ..sampling import F
from ..scene.embree import PACKET, packet_address
from ..scene.interaction import nearest, position_at, surface_at
from ..scene.ray import Hit, Ray
from ..scene.see_through import MOST, nearest_there
from ..scene.trace_scene import TraceScene
from .camera_packets import trace_packets
from .gbuffer import GBuffer, face_viewer
from .mesh_hits import BLOCK, MeshHits, put_hit

Array = np.ndarray

#: Step of the third coordinate of a pixel's lattice, and what makes another hash of its first.
_SILVER, _HASHED = 0.41421356237309503, 65521.0
_BELOW_ONE = F(1.0 - 2.0**-24)


def trace_camera(scene: TraceScene, parameters: Array, x0: int, y0: int, shape: tuple[int, ...], mask: int) -> MeshHits:
    """Closest hits of the camera's rays with what `mask` lets them meet.

    Parameters
    ----------
    scene : TraceScene
    parameters : array
        `camera.camera_parameters`.
    x0, y0 : int
        Full-picture pixel of the first sample.
    shape : tuple of int
        (rows, width, subpixels).
    mask : int
    """
    owner, face, instance = (np.empty(shape, np.int32) for _ in range(3))
    hits = MeshHits(np.empty(shape, np.float32), owner, face, instance, np.empty((*shape, 5), np.float32))
    if not mask:
        hits.owner[:] = -1
        return hits
    owners = scene.face_object, scene.instance_object
    blocks = -(-owner.size // BLOCK)
    view_of = parameters, x0, y0
    if scene.mesh_materials.table.clear:
        # Another kernel, so that scenes without see-through surfaces do not wait for it to be compiled.
        cut = np.zeros(len(scene.pass_index), np.int32)
        seen = scene.tracer, scene.geometry
        over_strided(_trace_through, blocks, seen, view_of, np.int32(mask), owners, (*hits.arrays, cut), calls=8)
        scene.cut.update(np.flatnonzero(cut).tolist())
        return hits
    entry = packet_address() if shape[2] % PACKET == 0 else 0
    over_strided(_trace, blocks, entry, scene.tracer, view_of, np.int32(mask), owners, hits.arrays, calls=8)
    return hits


def shade_mesh(scene: TraceScene, hits: MeshHits, parameters: Array, x0: int, buffer: GBuffer, layer: int) -> None:
    """Fill the points of `buffer` that have the flags `layer` from `hits`."""
    moving = scene.vertices, scene.faces, scene.instances
    view_of = parameters, x0, buffer.rows[0]
    keys, out = arrays_of(buffer)
    blocks = -(-len(keys[0]) // BLOCK)
    over_strided(_shade, blocks, scene.geometry, moving, view_of, layer, hits.arrays, keys, out, calls=8)


def arrays_of(buffer: GBuffer) -> tuple[tuple[Array, ...], tuple[tuple[Array, ...], ...]]:
    """Pixel, sample and flags of its points, and in three groups the arrays that `shade_hits` fills."""
    points = buffer.points
    frames = points.origin, points.normal, points.geometric_normal, points.view, points.smooth
    materials = points.albedo, points.roughness, points.metallic
    seen = buffer.position, buffer.depth, buffer.object_index, buffer.emission
    tied = buffer.face, buffer.instance, buffer.barycentric
    return (points.pixel, points.sample, points.flags), (frames, materials, (*seen, *tied))


@njit
def _trace(first, last, stride, entry, tracer, view_of, mask, owners, out):  # type: ignore[no-untyped-def]
    for thread in range(first, last):
        if entry != 0:
            trace_packets(thread, stride, entry, tracer, view_of, mask, owners, out)
        else:
            trace_samples(thread, stride, None, tracer, view_of, mask, owners, out)


@njit
def _trace_through(first, last, stride, seen, view_of, mask, owners, out):  # type: ignore[no-untyped-def]
    for thread in range(first, last):
        trace_through_samples(thread, stride, None, seen, view_of, mask, owners, out)


@njit
def _shade(first, last, stride, geometry, moving, view_of, layer, hits, keys, out):  # type: ignore[no-untyped-def]
    for thread in range(first, last):
        shade_hits(thread, stride, None, geometry, moving, view_of, layer, hits, keys, out)


@njit
def trace_samples(thread, stride, scratch, tracer, view_of, mask, owners, out):  # type: ignore[no-untyped-def]
    """Closest hits of every `stride`-th block of sub-pixel samples, from the `thread`-th on.

    Parameters
    ----------
    thread, stride : int64
    scratch : tuple
        Not used.
    tracer : Tracer
    view_of : tuple
        `camera.camera_parameters`, column and row of the first sample.
    mask : int32
        Of the camera's rays, see `ray_masks`.
    owners : tuple of array
        Object of each face and of each instance.
    out : tuple
        `MeshHits.arrays`.
    """
    p, x0, y0 = view_of
    owner = out[1]
    width = np.int64(p[WIDTH])
    rows, columns, subpixels = owner.shape
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    count = rows * columns * subpixels
    for block in range(thread, (count + BLOCK - 1) // BLOCK, stride):
        for n in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            x, y, k = n // subpixels % columns, n // (subpixels * columns), n % subpixels
            ox, oy, oz, dx, dy, dz = sample_ray(p, (y0 + y) * width + x0 + x, k)
            if dx * dx + dy * dy + dz * dz == 0.0:  # beyond the picture of a fisheye lens
                owner[y, x, k] = -1
                continue
            start, along = (F(ox), F(oy), F(oz)), (F(dx), F(dy), F(dz))
            put_hit((y, x, k), nearest(tracer, Ray(start, along, near, far, mask)), owners, out)


@njit
def trace_through_samples(thread, stride, scratch, seen, view_of, mask, owners, out):  # type: ignore[no-untyped-def]
    """`trace_samples` in a scene with surfaces that light may pass: by chance, a sample sees what is behind them.

    The numbers of a pixel's samples are a lattice with the two of their positions, see `camera`.

    Parameters
    ----------
    thread, stride, scratch, view_of, mask, owners : int64, tuple or int32
        As of `trace_samples`.
    seen : tuple
        Tracer and geometry.
    out : tuple
        `MeshHits.arrays`, and (objects,) int32, 1 where samples end for having passed too many surfaces.
    """
    tracer, geometry = seen
    p, x0, y0 = view_of
    depth, owner, face, instance, where, cut = out
    found = depth, owner, face, instance, where
    width = np.int64(p[WIDTH])
    rows, columns, subpixels = owner.shape
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    count = rows * columns * subpixels
    for block in range(thread, (count + BLOCK - 1) // BLOCK, stride):
        for n in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            x, y, k = n // subpixels % columns, n // (subpixels * columns), n % subpixels
            pixel = (y0 + y) * width + x0 + x
            ox, oy, oz, dx, dy, dz = sample_ray(p, pixel, k)
            if dx * dx + dy * dy + dz * dz == 0.0:  # beyond the picture of a fisheye lens
                owner[y, x, k] = -1
                continue
            number = pixel_shift(p, pixel)[0] * _HASHED + k * _SILVER
            number = number - math.floor(number)
            ray = Ray((F(ox), F(oy), F(oz)), (F(dx), F(dy), F(dz)), near, far, mask)
            t, f, i, u, v, gx, gy, gz, passed = nearest_there(tracer, ray, geometry, min(F(number), _BELOW_ONE))
            who = put_hit((y, x, k), Hit(t, f, i, u, v, gx, gy, gz), owners, found)
            if who >= 0 and passed >= MOST:
                cut[who] = 1


@njit
def shade_hits(thread, stride, scratch, geometry, moving, view_of, layer, hits, keys, out):  # type: ignore[no-untyped-def]
    """Fill every `stride`-th block of points from their hits, from the `thread`-th on.

    Parameters
    ----------
    thread, stride : int64
    scratch : tuple
        Not used.
    geometry, moving : tuple
        The scene's, and its vertices, faces and instances.
    view_of : tuple
        As of `trace_samples`.
    layer : int
        Flags that points must have.
    hits : tuple
        `MeshHits.arrays`.
    keys, out : tuple
        `arrays_of`.
    """
    vertices, faces, instances = moving
    p, x0, y0 = view_of
    hit_depth, _, hit_face, hit_instance, where = hits
    pixel, sample, flags = keys
    frames, materials, seen = out
    origin, normal, geometric, view, smooth = frames
    albedo, roughness, metallic = materials
    position, depth, owner, emission, out_face, out_instance, barycentric = seen
    width = np.int64(p[WIDTH])
    for block in range(thread, (len(pixel) + BLOCK - 1) // BLOCK, stride):
        for n in range(block * BLOCK, min((block + 1) * BLOCK, len(pixel))):
            if flags[n] & layer != layer:
                continue
            y, x, k = pixel[n] // width - y0, pixel[n] % width - x0, sample[n]
            _, _, _, dx, dy, dz = sample_ray(p, pixel[n], sample[n])
            scale = -1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
            vx, vy, vz = scale * dx, scale * dy, scale * dz
            instance, u, v = hit_instance[y, x, k], where[y, x, k, 0], where[y, x, k, 1]
            # Points that a device found and has lost are traced again, where a ray along an edge may meet nothing.
            face = max(hit_face[y, x, k], np.int32(0))
            hit = Hit(hit_depth[y, x, k], face, instance, u, v, where[y, x, k, 2], where[y, x, k, 3], where[y, x, k, 4])
            nx, ny, nz, gx, gy, gz, r, g, b, rough, metal, er, eg, eb, ux, uy, uz, who = surface_at(
                hit, (F(-vx), F(-vy), F(-vz)), geometry
            )
            sx, sy, sz = np.float64(nx), np.float64(ny), np.float64(nz)
            # A normal of a map may look away from the viewer, as in Cycles.
            if nx == ux and ny == uy and nz == uz:
                sx, sy, sz = face_viewer(sx, sy, sz, np.float64(gx), np.float64(gy), np.float64(gz), vx, vy, vz)
            elif len(smooth) > 0:
                smooth[n, 0], smooth[n, 1], smooth[n, 2] = ux, uy, uz
            px, py, pz = position_at(face, instance, u, v, vertices, faces, instances)
            origin[n, 0], origin[n, 1], origin[n, 2] = px, py, pz
            position[n, 0], position[n, 1], position[n, 2] = px, py, pz
            normal[n, 0], normal[n, 1], normal[n, 2] = sx, sy, sz
            geometric[n, 0], geometric[n, 1], geometric[n, 2] = gx, gy, gz
            view[n, 0], view[n, 1], view[n, 2] = vx, vy, vz
            albedo[n, 0], albedo[n, 1], albedo[n, 2] = r, g, b
            roughness[n], metallic[n] = rough, metal
            depth[n], owner[n] = hit_depth[y, x, k], who
            emission[n, 0], emission[n, 1], emission[n, 2] = er, eg, eb
            out_face[n], out_instance[n], barycentric[n, 0], barycentric[n, 1] = face, instance, u, v
