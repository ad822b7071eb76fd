"""Where every visible surface point was in the frame before: on its mesh, in the world, in the picture.

A point is tied to the mesh by a face and barycentric coordinates. What stands off the mesh (a surfel is not quite on
it) keeps its coordinates in the basis of the face's two edges and unit normal, as surfels do when they are posed, so
that a seen point moves exactly as its surfel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...jit import njit, prange
from ..camera import CX, CY, FX, FY, ORTHOGRAPHIC, POSITION, WIDTH
from ..points import CATCHER
from ..primary.gbuffer import GBuffer
from .film import SAME_SURFACE

Array = np.ndarray


@dataclass(slots=True)
class Motion:
    """Where the surfaces of a picture come from.

    Attributes
    ----------
    vector : (h, w, 2) float32 pixels, x to the right and y down: what must be added to a pixel's position to find its
        surface in the frame before; NaN where that is unknown (nothing covered, or it was behind the camera)
    previous : (h, w, 3) float32 metres, world space: where the surface at ``Position`` was
    """

    vector: Array
    previous: Array


def previous_positions(
    faces: Array, vertices: Array, previous_vertices: Array, face: Array, barycentric: Array, position: Array
) -> Array:
    """World positions of surface points in the frame before.

    Parameters
    ----------
    faces : (m, 3) int32
    vertices, previous_vertices : (k, 3) float32 metres, world space: the mesh now and before
    face : (n,) int32, the face each point is tied to; negative for points that are tied to nothing and do not move
    barycentric : (n, 2) float32 weights of the face's second and third corner, as Embree gives them
    position : (n, 3) float32 where the points are now

    Returns
    -------
    (n, 3) float32
    """
    out = np.empty((len(face), 3), np.float32)
    _previous(faces, vertices, previous_vertices, face, barycentric, position, out)
    return out


class MotionFilm:
    """Gathers the motion of a picture's samples strip by strip, as `film.Film` does their light.

    Parameters
    ----------
    shape : (h, w) of the camera's window
    origin : (x0, y0) of it
    parameters : `camera.camera_parameters` of this frame
    """

    def __init__(self, shape: tuple[int, int], origin: tuple[int, int], parameters: Array) -> None:
        self.origin, self.parameters = origin, parameters
        self.displacement = np.zeros((*shape, 3), np.float32)

    def add(self, buffer: GBuffer, previous: Array) -> None:
        """Take the strip `buffer` whose samples were at `previous` (n, 3), see `previous_positions`."""
        x0, top = self.origin
        y0, y1 = buffer.rows
        points = buffer.points
        start = np.searchsorted(points.pixel, np.arange(y0, y1 + 1, dtype=np.int64) * int(self.parameters[WIDTH]))
        _displace(
            start, x0, self.parameters, points.pixel, points.weight, points.flags, buffer.depth, buffer.position,
            previous, self.displacement[y0 - top : y1 - top],
        )  # fmt: skip

    def motion(self, position: Array, coverage: Array, before: Array) -> Motion:
        """Motion of the picture whose passes are `position` and `coverage`; `before` are the parameters of the camera
        in the frame before."""
        vector = np.full((*coverage.shape, 2), np.nan, np.float32)
        previous = position + self.displacement
        _vectors(self.parameters, before, position, previous, coverage, vector)
        return Motion(vector, previous)


@njit(inline="always")
def project(p: Any, x: Any, y: Any, z: Any) -> Any:
    """Pixel position and depth of a world-space point through the camera of parameters `p`; inverse of `camera_ray`."""
    x, y, z = x - p[POSITION], y - p[POSITION + 1], z - p[POSITION + 2]
    depth = -(p[2] * x + p[5] * y + p[8] * z)
    right = p[0] * x + p[3] * y + p[6] * z
    up = p[1] * x + p[4] * y + p[7] * z
    scale = 1.0 if p[ORTHOGRAPHIC] != 0.0 else 1.0 / depth
    return p[CX] + p[FX] * right * scale, p[CY] - p[FY] * up * scale, depth


@njit(inline="always")
def _basis(v: Any, faces: Any, f: Any) -> Any:
    """First corner, two edges, unit normal (0 for a face without area) of face `f`, float64."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    x, y, z = np.float64(v[a, 0]), np.float64(v[a, 1]), np.float64(v[a, 2])
    ux, uy, uz = v[b, 0] - x, v[b, 1] - y, v[b, 2] - z
    wx, wy, wz = v[c, 0] - x, v[c, 1] - y, v[c, 2] - z
    nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    inverse = 1.0 / length if length > 0.0 else 0.0
    return x, y, z, ux, uy, uz, wx, wy, wz, nx * inverse, ny * inverse, nz * inverse, length


@njit(parallel=True)
def _previous(
    faces: Any, vertices: Any, before: Any, face: Any, barycentric: Any, position: Any, out: Any
) -> None:  # fmt: skip
    for i in prange(len(face)):
        f = face[i]
        if f < 0:
            out[i, 0], out[i, 1], out[i, 2] = position[i, 0], position[i, 1], position[i, 2]
            continue
        b, c = np.float64(barycentric[i, 0]), np.float64(barycentric[i, 1])
        x, y, z, ux, uy, uz, wx, wy, wz, nx, ny, nz, size = _basis(vertices, faces, f)
        # What is left of the position beside the mesh point, in the face's basis.
        dx = position[i, 0] - (x + b * ux + c * wx)
        dy = position[i, 1] - (y + b * uy + c * wy)
        dz = position[i, 2] - (z + b * uz + c * wz)
        x, y, z, pux, puy, puz, pwx, pwy, pwz, pnx, pny, pnz, _ = _basis(before, faces, f)
        off = nx * dx + ny * dy + nz * dz
        if size > 0.0:
            # Along the edges: dual basis w x n / size and n x u / size.
            b += ((wy * nz - wz * ny) * dx + (wz * nx - wx * nz) * dy + (wx * ny - wy * nx) * dz) / size
            c += ((ny * uz - nz * uy) * dx + (nz * ux - nx * uz) * dy + (nx * uy - ny * ux) * dz) / size
            dx, dy, dz = off * pnx, off * pny, off * pnz
        out[i, 0] = x + b * pux + c * pwx + dx
        out[i, 1] = y + b * puy + c * pwy + dy
        out[i, 2] = z + b * puz + c * pwz + dz


@njit(parallel=True)
def _displace(
    start: Any, x0: Any, p: Any, pixel: Any, weight: Any, flags: Any, depth: Any, position: Any, previous: Any, out: Any
) -> None:
    """Mean displacement of the samples on the surface nearest to the camera, the same that make up Position."""
    width = np.int64(p[WIDTH])
    flat = p[ORTHOGRAPHIC] != 0.0
    slope = SAME_SURFACE / min(p[FX], p[FY])
    per_depth, fixed = np.float32(0.0 if flat else slope), np.float32(slope if flat else 0.0)
    for y in prange(len(start) - 1):
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
                if depth[i] <= limit and not flags[i] & CATCHER:
                    w = weight[i]
                    total += w
                    dx += w * (previous[i, 0] - position[i, 0])
                    dy += w * (previous[i, 1] - position[i, 1])
                    dz += w * (previous[i, 2] - position[i, 2])
            if total > np.float32(0.0):
                x = pixel[first] % width - x0
                out[y, x, 0], out[y, x, 1], out[y, x, 2] = dx / total, dy / total, dz / total
            first = last


@njit(parallel=True)
def _vectors(now: Any, before: Any, position: Any, previous: Any, coverage: Any, vector: Any) -> None:
    """Difference of the two projections, zero to the last bit where nothing moved."""
    h, w = coverage.shape
    for y in prange(h):
        for x in range(w):
            if not coverage[y, x] > np.float32(0.0):
                continue
            ax, ay, _ = project(
                now, np.float64(position[y, x, 0]), np.float64(position[y, x, 1]), np.float64(position[y, x, 2])
            )
            bx, by, depth = project(
                before, np.float64(previous[y, x, 0]), np.float64(previous[y, x, 1]), np.float64(previous[y, x, 2])
            )
            if depth > 0.0 or before[ORTHOGRAPHIC] != 0.0:
                vector[y, x, 0], vector[y, x, 1] = np.float32(bx - ax), np.float32(by - ay)
