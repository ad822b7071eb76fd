"""Motion vectors: where every visible surface point is at another time, on its mesh, in the world, in the picture.

A point is tied to the mesh by a face and barycentric coordinates. What stands off the mesh (a surfel is not quite on
it) keeps its coordinates in the basis of the face's two edges and unit normal, as surfels do when they are posed, so
that a seen point moves exactly as its surfel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from ...compute.threads import ELEMENTS, ROWS, over_range
from ..camera import CX, CY, FX, FY, ORTHOGRAPHIC, POSITION, WIDTH
from ..gbuffer.gbuffer import GBuffer
from ..panorama import EQUIRECTANGULAR, PANORAMA, panorama_place
from ..scene.interaction import position_at
from ..scene.trace_scene import TraceScene
from ..shading_points import CATCHER
from .film import SAME_SURFACE
from .surfel_motion import SurfelState

Array = np.ndarray


class SceneState(NamedTuple):
    """The state of a scene at one time: its shapes and camera.

    Attributes
    ----------
    vertices, instances : array
        Laid out as those of `scene.trace_scene.TraceScene`.
    parameters : array
        `camera.camera_parameters`.
    surfels : SurfelState, optional
        Of objects without a mesh.
    """

    vertices: Array
    instances: Array
    parameters: Array
    surfels: SurfelState | None = None


class Motion(NamedTuple):
    """The motion vector of each pixel: where its surface is at another time, mostly one frame earlier.

    Attributes
    ----------
    vector : (h, w, 2) float32 array
        Pixels, x to the right and y down: what must be added to a pixel's position to find its surface in the other
        frame; NaN where that is unknown (nothing covered, or it is behind the camera).
    previous : (h, w, 3) float32 array
        Metres, world space: where the surface at ``Position`` is then.
    """

    vector: Array
    previous: Array


def previous_positions(
    faces: Array, now: SceneState, then: SceneState, face: Array, instance: Array, barycentric: Array, position: Array
) -> Array:
    """World positions of surface points at another time.

    Parameters
    ----------
    faces : (m, 3) int32 array
    now, then : SceneState
    face : (n,) int32 array
        The face each point is tied to; negative for points that are tied to nothing and do not move.
    instance : (n,) int32 array
        The row of ``instances`` that the face stands in; negative for a face in world space.
    barycentric : (n, 2) float32 array
        Weights of the face's second and third corner, as Embree gives them.
    position : (n, 3) float32 array
        Where the points are now.

    Returns
    -------
    (n, 3) float32 array
    """
    out = np.empty((len(face), 3), np.float32)
    tied = face, instance, barycentric
    shapes = (state._replace(surfels=None) for state in (now, then))  # compiled code knows arrays alone
    over_range(_previous, len(face), faces, *shapes, *tied, position, out, fewest=ELEMENTS)
    return out


class MotionFilm:
    """Gathers the motion of a picture's samples strip by strip, as `film.Film` does their light.

    Parameters
    ----------
    shape : tuple of int
        (h, w) of the camera's window.
    origin : tuple of int
        (x0, y0) of it.
    now, then : SceneState
        This time and the other one.
    """

    def __init__(self, shape: tuple[int, int], origin: tuple[int, int], now: SceneState, then: SceneState) -> None:
        self.origin, self.now, self.then = origin, now, then
        self.displacement = np.zeros((*shape, 3), np.float32)

    def add(self, buffer: GBuffer, scene: TraceScene) -> None:
        """Take the samples of the strip `buffer`."""
        position, face = buffer.position, buffer.face
        moved = self.then.vertices is not self.now.vertices or self.then.instances is not self.now.instances
        previous = position
        if moved:
            tied = face, buffer.instance, buffer.barycentric
            previous = previous_positions(scene.faces, self.now, self.then, *tied, position)
        if self.now.surfels is not None and self.then.surfels is not None:
            previous = previous if moved else position.copy()
            carried = self.now.surfels.displace(self.then.surfels, buffer.object_index, face, position, previous)
            face = np.where(carried, np.int32(0), face)
            moved = moved or bool(carried.any())
        if moved:
            self.displace(buffer, previous, face)

    def displace(self, buffer: GBuffer, previous: Array, face: Array) -> None:
        """Take samples that are at `previous` (n, 3) at the other time; those with a negative `face` follow others."""
        x0, top = self.origin
        y0, y1 = buffer.rows
        points = buffer.point_rows(x0, int(self.now.parameters[WIDTH]))
        out = self.displacement[y0 - top : y1 - top]
        over_range(_displace, y1 - y0, points, self.now.parameters, face, previous, out, fewest=ROWS)

    def motion(self, position: Array, coverage: Array) -> Motion:
        """Motion of the picture whose passes are `position` and `coverage`."""
        return motion(position, position + self.displacement, coverage, self.now.parameters, self.then.parameters)


def motion(position: Array, previous: Array, coverage: Array, now: Array, then: Array) -> Motion:
    """Motion of surfaces seen at `position` (h, w, 3) that are at `previous` at the other time.

    `now` and `then` are the parameters of the cameras.
    """
    vector = np.full((*coverage.shape, 2), np.nan, np.float32)
    over_range(_vectors, len(coverage), now, then, position, previous, coverage, vector, fewest=ROWS)
    return Motion(vector, previous)


def vector_pass(before: Motion | None, after: Motion | None, shape: tuple[int, int]) -> Array:
    """(h, w, 4) float32: motion as Blender's Vector pass has it, zero where it is unknown.

    As Cycles writes it, in pixels, x to the right and y up: the place in the previous frame less that in this one, and
    the place in this frame less that in the next one.
    """
    out = np.zeros((*shape, 4), np.float32)
    for known, first, side in ((before, 0, 1.0), (after, 2, -1.0)):
        if known is not None:
            out[..., first : first + 2] = np.nan_to_num(known.vector * np.array([side, -side], np.float32), nan=0.0)
    return out


@inlined
def project(p, x, y, z):  # type: ignore[no-untyped-def]
    """Project a world-space point: the inverse of `camera_ray`.

    Parameters
    ----------
    p : (PARAMETERS,) float64 array
        `camera.camera_parameters`.
    x, y, z : float64
        World, m.

    Returns
    -------
    px, py : float64
        Pixels, from the upper left corner of the full picture.
    depth : float64
        Metres along the view axis; from the centre of a panoramic camera.
    """
    x, y, z = x - p[POSITION], y - p[POSITION + 1], z - p[POSITION + 2]
    depth = -(p[2] * x + p[5] * y + p[8] * z)
    right = p[0] * x + p[3] * y + p[6] * z
    up = p[1] * x + p[4] * y + p[7] * z
    if p[PANORAMA] != 0.0:
        u, v = panorama_place(p, right, up, depth)
        return p[CX] + p[FX] * u, p[CY] - p[FY] * v, np.sqrt(right * right + up * up + depth * depth)
    scale = 1.0 if p[ORTHOGRAPHIC] != 0.0 else 1.0 / depth
    return p[CX] + p[FX] * right * scale, p[CY] - p[FY] * up * scale, depth


@inlined
def _basis(v, faces, f):  # type: ignore[no-untyped-def]
    """First corner, two edges, unit normal (0 for a face without area) of face `f`, float64."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    x, y, z = np.float64(v[a, 0]), np.float64(v[a, 1]), np.float64(v[a, 2])
    ux, uy, uz = v[b, 0] - x, v[b, 1] - y, v[b, 2] - z
    wx, wy, wz = v[c, 0] - x, v[c, 1] - y, v[c, 2] - z
    nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    inverse = 1.0 / length if length > 0.0 else 0.0
    return x, y, z, ux, uy, uz, wx, wy, wz, nx * inverse, ny * inverse, nz * inverse, length


@njit
def _previous(first, last, faces, now, then, face, instance, barycentric, position, out):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        f, stand = face[i], instance[i]
        if f < 0:
            out[i, 0], out[i, 1], out[i, 2] = position[i, 0], position[i, 1], position[i, 2]
            continue
        if stand >= 0:
            x, y, z = position_at(f, stand, barycentric[i, 0], barycentric[i, 1], now.vertices, faces, now.instances)
            u, v, w = position_at(f, stand, barycentric[i, 0], barycentric[i, 1], then.vertices, faces, then.instances)
            out[i, 0], out[i, 1], out[i, 2] = (
                position[i, 0] + (u - x),
                position[i, 1] + (v - y),
                position[i, 2] + (w - z),
            )
            continue
        b, c = np.float64(barycentric[i, 0]), np.float64(barycentric[i, 1])
        x, y, z, ux, uy, uz, wx, wy, wz, nx, ny, nz, size = _basis(now.vertices, faces, f)
        # What is left of the position beside the mesh point, in the face's basis.
        dx = position[i, 0] - (x + b * ux + c * wx)
        dy = position[i, 1] - (y + b * uy + c * wy)
        dz = position[i, 2] - (z + b * uz + c * wz)
        x, y, z, pux, puy, puz, pwx, pwy, pwz, pnx, pny, pnz, _ = _basis(then.vertices, faces, f)
        off = nx * dx + ny * dy + nz * dz
        if size > 0.0:
            # Along the edges: dual basis w x n / size and n x u / size.
            b += ((wy * nz - wz * ny) * dx + (wz * nx - wx * nz) * dy + (wx * ny - wy * nx) * dz) / size
            c += ((ny * uz - nz * uy) * dx + (nz * ux - nx * uz) * dy + (nx * uy - ny * ux) * dz) / size
            dx, dy, dz = off * pnx, off * pny, off * pnz
        out[i, 0] = x + b * pux + c * pwx + dx
        out[i, 1] = y + b * puy + c * pwy + dy
        out[i, 2] = z + b * puz + c * pwz + dz


@njit
def _displace(y0, y1, points, p, face, previous, out):  # type: ignore[no-untyped-def]
    """Mean displacement of the samples on the surface nearest to the camera, the same that make up Position.

    Samples that are tied to no face follow the others.
    """
    start, pixel, weight, flags, depth = points.start, points.pixel, points.weight, points.flags, points.depth
    position = points.position
    flat = p[ORTHOGRAPHIC] != 0.0
    slope = SAME_SURFACE / min(p[FX], p[FY])
    per_depth, fixed = np.float32(0.0 if flat else slope), np.float32(slope if flat else 0.0)
    for y in range(y0, y1):
        first = start[y]
        while first < start[y + 1]:
            last = first
            nearest = np.float32(np.inf)
            while last < start[y + 1] and pixel[last] == pixel[first]:
                if not flags[last] & CATCHER:
                    nearest = min(nearest, depth[last])
                last += 1
            limit = nearest * (np.float32(1.0) + per_depth) + fixed
            total = dx = dy = dz = np.float32(0.0)
            for i in range(first, last):
                if depth[i] <= limit and face[i] >= 0 and not flags[i] & CATCHER:
                    w = weight[i]
                    total += w
                    dx += w * (previous[i, 0] - position[i, 0])
                    dy += w * (previous[i, 1] - position[i, 1])
                    dz += w * (previous[i, 2] - position[i, 2])
            if total > np.float32(0.0):
                x = pixel[first] % points.width - points.x0
                out[y, x, 0], out[y, x, 1], out[y, x, 2] = dx / total, dy / total, dz / total
            first = last


@njit
def _vectors(first, last, now, before, position, previous, coverage, vector):  # type: ignore[no-untyped-def]
    """Difference of the two projections, zero to the last bit where nothing moved."""
    for y in range(first, last):
        for x in range(coverage.shape[1]):
            if not coverage[y, x] > np.float32(0.0):
                continue
            ax, ay, _ = project(
                now, np.float64(position[y, x, 0]), np.float64(position[y, x, 1]), np.float64(position[y, x, 2])
            )
            bx, by, depth = project(
                before, np.float64(previous[y, x, 0]), np.float64(previous[y, x, 1]), np.float64(previous[y, x, 2])
            )
            if before[PANORAMA] == EQUIRECTANGULAR:  # the shorter way round
                turn = 2.0 * math.pi * before[FX]
                bx -= turn * np.rint((bx - ax) / turn)
            if depth > 0.0 or before[ORTHOGRAPHIC] != 0.0:
                vector[y, x, 0], vector[y, x, 1] = np.float32(bx - ax), np.float32(by - ay)
