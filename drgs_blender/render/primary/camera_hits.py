"""Camera rays against meshes: what they meet first, and points to be lit there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...jit import njit, prange
from ..camera import AA, CLIP_END, CLIP_START, WIDTH, camera_ray, lattice, pixel_shift, sample_ray
from ..trace.scene import TraceScene
from ..trace.surface import nearest, position_at, surface_at
from .gbuffer import GBuffer, face_viewer

Array = np.ndarray


@dataclass(slots=True)
class MeshHits:
    """What camera rays through the sub-pixel samples of some rows meet first.

    Attributes
    ----------
    depth : (rows, width, aa) float32, metres along the view axis
    owner : (rows, width, aa) int32, object, or -1 where nothing is met; the other arrays are undefined there
    face, place : (rows, width, aa) int32
    where : (rows, width, aa, 5) float32: the hit's u and v, and its geometric normal as `surface_at` wants it
    """

    depth: Array
    owner: Array
    face: Array
    place: Array
    where: Array


def trace_camera(scene: TraceScene, parameters: Array, x0: int, y0: int, shape: tuple[int, ...], mask: int) -> MeshHits:
    """Closest hits of the camera's rays with what `mask` lets them meet.

    Parameters
    ----------
    parameters : `camera.camera_parameters`
    x0, y0 : full-picture pixel of the first sample
    shape : (rows, width, aa)
    """
    owner, face, place = (np.empty(shape, np.int32) for _ in range(3))
    hits = MeshHits(np.empty(shape, np.float32), owner, face, place, np.empty((*shape, 5), np.float32))
    if not mask:
        hits.owner[:] = -1
        return hits
    owners = scene.face_object, scene.place_object
    _trace(scene.tracer, parameters, x0, y0, np.int32(mask), *owners, hits.depth, hits.owner, hits.face, hits.place,
           hits.where)  # fmt: skip
    return hits


def shade_mesh(
    scene: TraceScene, hits: MeshHits, parameters: Array, x0: int, start: Array, buffer: GBuffer, layer: int
) -> None:
    """Fill the points of `buffer` that have the flags `layer` from `hits`; `start` is the first point of each row."""
    points = buffer.points
    _shade(
        parameters,
        x0,
        start,
        np.uint8(layer),
        hits.depth,
        hits.face,
        hits.place,
        hits.where,
        scene.geometry,
        scene.vertices,
        scene.faces,
        scene.places,
        points.pixel,
        points.sample,
        points.flags,
        points.origin,
        points.normal,
        points.geometric_normal,
        points.view,
        points.albedo,
        points.roughness,
        points.metallic,
        buffer.position,
        buffer.depth,
        buffer.object_index,
        buffer.emission,
        buffer.face,
        buffer.place,
        buffer.barycentric,
    )


@njit(parallel=True)
def _trace(
    tracer: Any,
    p: Any,
    x0: Any,
    y0: Any,
    mask: Any,
    face_object: Any,
    place_object: Any,
    depth: Any,
    owner: Any,
    face: Any,
    place: Any,
    where: Any,
) -> None:
    """Closest hits of all sub-pixel samples."""
    width = np.int64(p[WIDTH])
    rows, columns, aa = depth.shape
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    for y in prange(rows):
        for x in range(columns):
            shift_x, shift_y = pixel_shift(p, (y0 + y) * width + x0 + x)
            for k in range(aa):
                jx, jy = lattice(shift_x, shift_y, k, p[AA])
                ox, oy, oz, dx, dy, dz = camera_ray(p, x0 + x + jx, y0 + y + jy)
                t, f, i, u, v, gx, gy, gz = nearest(
                    tracer, np.float32(ox), np.float32(oy), np.float32(oz),
                    np.float32(dx), np.float32(dy), np.float32(dz), near, far, mask,
                )  # fmt: skip
                depth[y, x, k], face[y, x, k], place[y, x, k] = t, f, i
                where[y, x, k, 0], where[y, x, k, 1] = u, v
                where[y, x, k, 2], where[y, x, k, 3], where[y, x, k, 4] = gx, gy, gz
                owner[y, x, k] = -1 if f < 0 else (face_object[f] if i < 0 else place_object[i])


@njit(parallel=True)
def _shade(
    p: Any,
    x0: Any,
    start: Any,
    layer: Any,
    hit_depth: Any,
    hit_face: Any,
    hit_place: Any,
    where: Any,
    geometry: Any,
    vertices: Any,
    faces: Any,
    places: Any,
    pixel: Any,
    sample: Any,
    flags: Any,
    origin: Any,
    normal: Any,
    geometric: Any,
    view: Any,
    albedo: Any,
    roughness: Any,
    metallic: Any,
    position: Any,
    depth: Any,
    owner: Any,
    emission: Any,
    out_face: Any,
    out_place: Any,
    barycentric: Any,
) -> None:
    """Fill the shading points from the hits, row by row."""
    width = np.int64(p[WIDTH])
    for y in prange(len(start) - 1):
        for n in range(start[y], start[y + 1]):
            if flags[n] & layer != layer:
                continue
            x, k = pixel[n] % width - x0, sample[n]
            _, _, _, dx, dy, dz = sample_ray(p, pixel[n], sample[n])
            scale = -1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
            vx, vy, vz = scale * dx, scale * dy, scale * dz
            face, place, u, v = hit_face[y, x, k], hit_place[y, x, k], where[y, x, k, 0], where[y, x, k, 1]
            nx, ny, nz, gx, gy, gz, r, g, b, rough, metal, er, eg, eb, who = surface_at(
                face, place, u, v, where[y, x, k, 2], where[y, x, k, 3], where[y, x, k, 4],
                np.float32(-vx), np.float32(-vy), np.float32(-vz), geometry,
            )  # fmt: skip
            sx, sy, sz = face_viewer(
                np.float64(nx), np.float64(ny), np.float64(nz), np.float64(gx), np.float64(gy), np.float64(gz),
                vx, vy, vz,
            )  # fmt: skip
            px, py, pz = position_at(face, place, u, v, vertices, faces, places)
            origin[n, 0], origin[n, 1], origin[n, 2] = px, py, pz
            position[n, 0], position[n, 1], position[n, 2] = px, py, pz
            normal[n, 0], normal[n, 1], normal[n, 2] = sx, sy, sz
            geometric[n, 0], geometric[n, 1], geometric[n, 2] = gx, gy, gz
            view[n, 0], view[n, 1], view[n, 2] = vx, vy, vz
            albedo[n, 0], albedo[n, 1], albedo[n, 2] = r, g, b
            roughness[n], metallic[n] = rough, metal
            depth[n], owner[n] = hit_depth[y, x, k], who
            emission[n, 0], emission[n, 1], emission[n, 2] = er, eg, eb
            out_face[n], out_place[n], barycentric[n, 0], barycentric[n, 1] = face, place, u, v
