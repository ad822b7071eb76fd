"""Camera rays against the mesh: the alternative to surfels, and what the mesh alone looks like."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..frame import Camera
from ..jit import njit, prange
from .camera import AA, CLIP_END, CLIP_START, WIDTH, camera_ray, lattice, pixel_shift, sample_ray
from .embree import closest_hit
from .gbuffer import GBuffer, compact, face_viewer
from .scene import TraceScene

Array = np.ndarray


def primary_mesh(scene: TraceScene, camera: Camera, parameters: Array, y0: int, y1: int) -> GBuffer:
    """Trace camera rays through the sub-pixel positions of the rows ``y0 .. y1`` (full-picture pixels).

    Normals and materials are interpolated over the face that is hit. Faces seen from behind are shown, with their
    normals turned to the viewer.

    Parameters
    ----------
    parameters : `camera.camera_parameters`
    """
    x0, _, x1, _ = camera.window
    shape = (y1 - y0, x1 - x0, int(parameters[AA]))
    alpha = np.empty(shape, np.float32)
    depth = np.empty(shape, np.float32)
    face = np.empty(shape, np.int32)
    barycentric = np.empty((*shape, 2), np.float32)
    bvh = scene.bvh
    _trace(bvh.intersect_address, bvh.scene, parameters, x0, y0, alpha, depth, face, barycentric)
    buffer, start = compact(alpha, parameters, x0, y0)
    points = buffer.points
    _shade(
        parameters,
        start,
        depth,
        face,
        barycentric,
        scene.vertices,
        scene.faces,
        scene.shading_faces,
        scene.shading,
        scene.face_object,
        alpha,
        points.pixel,
        points.sample,
        points.origin,
        points.normal,
        points.geometric_normal,
        points.view,
        points.albedo,
        points.roughness,
        points.metallic,
        buffer.depth,
        buffer.object_index,
    )
    buffer.position[:] = points.origin
    return buffer


@njit(parallel=True)
def _trace(
    address: Any, bvh: Any, p: Any, x0: Any, y0: Any, alpha: Any, depth: Any, face: Any, barycentric: Any
) -> None:
    """Closest hits of all sub-pixel samples; alpha is 1 where something is hit."""
    width = np.int64(p[WIDTH])
    rows, columns, aa = alpha.shape
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    for y in prange(rows):
        for x in range(columns):
            shift_x, shift_y = pixel_shift(p, (y0 + y) * width + x0 + x)
            for k in range(aa):
                jx, jy = lattice(shift_x, shift_y, k, p[AA])
                ox, oy, oz, dx, dy, dz = camera_ray(p, x0 + x + jx, y0 + y + jy)
                t, f, u, v, _, _, _ = closest_hit(
                    address, bvh, np.float32(ox), np.float32(oy), np.float32(oz),
                    np.float32(dx), np.float32(dy), np.float32(dz), near, far,
                )  # fmt: skip
                alpha[y, x, k] = np.float32(1.0) if f >= 0 else np.float32(0.0)
                depth[y, x, k], face[y, x, k] = t, f
                barycentric[y, x, k, 0], barycentric[y, x, k, 1] = u, v


@njit(inline="always")
def _face_normal(v: Any, a: Any, b: Any, c: Any) -> Any:
    """(v[b] - v[a]) x (v[c] - v[a]) in float64."""
    x, y, z = np.float64(v[a, 0]), np.float64(v[a, 1]), np.float64(v[a, 2])
    ux, uy, uz = v[b, 0] - x, v[b, 1] - y, v[b, 2] - z
    wx, wy, wz = v[c, 0] - x, v[c, 1] - y, v[c, 2] - z
    return uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx


@njit(parallel=True)
def _shade(
    p: Any,
    start: Any,
    hit_depth: Any,
    hit_face: Any,
    barycentric: Any,
    vertices: Any,
    faces: Any,
    shading_faces: Any,
    shading: Any,
    face_object: Any,
    alpha: Any,
    pixel: Any,
    sample: Any,
    origin: Any,
    normal: Any,
    geometric: Any,
    view: Any,
    albedo: Any,
    roughness: Any,
    metallic: Any,
    depth: Any,
    owner: Any,
) -> None:
    """Fill the shading points from the hits, row by row."""
    rows, columns, aa = alpha.shape
    for y in prange(rows):
        n = start[y]
        value = np.empty(8, np.float32)
        for x in range(columns):
            for k in range(aa):
                if alpha[y, x, k] == np.float32(0.0):
                    continue
                f = hit_face[y, x, k]
                u, v = barycentric[y, x, k, 0], barycentric[y, x, k, 1]
                w = np.float32(1.0) - u - v
                a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                for i in range(3):
                    # From the corners: nearer to the plane than origin + t direction for a distant camera.
                    origin[n, i] = w * vertices[a, i] + u * vertices[b, i] + v * vertices[c, i]
                _, _, _, dx, dy, dz = sample_ray(p, pixel[n], sample[n])
                scale = -1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
                vx, vy, vz = scale * dx, scale * dy, scale * dz
                gx, gy, gz = _face_normal(vertices, a, b, c)
                length = np.sqrt(gx * gx + gy * gy + gz * gz)
                if gx * vx + gy * vy + gz * vz < 0.0:
                    length = -length
                if length == 0.0:
                    gx, gy, gz, length = vx, vy, vz, 1.0
                gx, gy, gz = gx / length, gy / length, gz / length
                ra, rb, rc = shading_faces[f, 0], shading_faces[f, 1], shading_faces[f, 2]
                for i in range(8):
                    value[i] = w * shading[ra, i] + u * shading[rb, i] + v * shading[rc, i]
                sx, sy, sz = np.float64(value[0]), np.float64(value[1]), np.float64(value[2])
                size = np.sqrt(sx * sx + sy * sy + sz * sz)
                if size < 1e-6:
                    sx, sy, sz, size = gx, gy, gz, 1.0
                sx, sy, sz = face_viewer(sx / size, sy / size, sz / size, gx, gy, gz, vx, vy, vz)
                normal[n, 0], normal[n, 1], normal[n, 2] = sx, sy, sz
                geometric[n, 0], geometric[n, 1], geometric[n, 2] = gx, gy, gz
                view[n, 0], view[n, 1], view[n, 2] = vx, vy, vz
                albedo[n, 0], albedo[n, 1], albedo[n, 2] = value[3], value[4], value[5]
                roughness[n], metallic[n] = value[6], value[7]
                depth[n] = hit_depth[y, x, k]
                owner[n] = face_object[f]
                n += 1
