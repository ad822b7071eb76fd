"""What the camera sees of a strip of rows, before light: the result of both primary stages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..jit import njit
from .camera import AA, WIDTH
from .points import ShadingPoints

Array = np.ndarray

#: Least cosine between a shading normal and the direction to the viewer.
LEAST_FACING = 0.02


@dataclass(slots=True)
class GBuffer:
    """Covered sub-pixel samples of the rows ``y0 .. y1`` of the camera's window, ordered by pixel, then sample.

    Attributes
    ----------
    rows : (y0, y1) in the full picture, half-open
    points : ShadingPoints, n of them, what the integrator eats
    position : (n, 3) float32, world space: the seen surface point (``points.origin`` lies on the traced mesh)
    depth : (n,) float32, metres along the view axis
    object_index : (n,) int32 index into Frame.objects
    alpha : (rows, width, aa) float32: coverage of each sub-pixel sample of the window's rows
    """

    rows: tuple[int, int]
    points: ShadingPoints
    position: Array
    depth: Array
    object_index: Array
    alpha: Array


def compact(alpha: Array, parameters: Array, x0: int, y0: int) -> tuple[GBuffer, Array]:
    """Make room for the samples with positive `alpha`, with pixel, sample and weight filled in.

    Parameters
    ----------
    alpha : (rows, width, aa) float32
    parameters : `camera.camera_parameters`
    x0, y0 : full-picture pixel of ``alpha[0, 0]``

    Returns
    -------
    the G-buffer, and (rows + 1,) int64: the first point of each row
    """
    start = np.zeros(len(alpha) + 1, np.int64)
    np.cumsum(np.count_nonzero(alpha, axis=(1, 2)), out=start[1:])
    n = int(start[-1])
    pixel, sample, owner = np.empty((3, n), np.int32)
    weight, roughness, metallic, depth = np.empty((4, n), np.float32)
    origin, normal, geometric, view, albedo, position = (np.empty((n, 3), np.float32) for _ in range(6))
    _number(alpha, parameters, x0, y0, pixel, sample, weight)
    points = ShadingPoints(pixel, sample, weight, origin, normal, geometric, view, albedo, roughness, metallic)
    return GBuffer((y0, y0 + len(alpha)), points, position, depth, owner, alpha), start


@njit
def _number(alpha: Any, p: Any, x0: Any, y0: Any, pixel: Any, sample: Any, weight: Any) -> None:
    """List the covered samples in order."""
    width = np.int64(p[WIDTH])
    share = np.float32(1.0 / p[AA])
    rows, columns, aa = alpha.shape
    n = 0
    for y in range(rows):
        for x in range(columns):
            for k in range(aa):
                if alpha[y, x, k] > np.float32(0.0):
                    pixel[n] = (y0 + y) * width + x0 + x
                    sample[n] = k
                    weight[n] = alpha[y, x, k] * share
                    n += 1


@njit(inline="always")
def face_viewer(nx: Any, ny: Any, nz: Any, gx: Any, gy: Any, gz: Any, vx: Any, vy: Any, vz: Any) -> Any:
    """Shading normal on the side of the geometric normal g, which faces the viewer at v, and visible from there.

    A smooth normal that looks away from the viewer near a silhouette is bent until it is just visible.
    """
    if nx * gx + ny * gy + nz * gz < 0.0:
        nx, ny, nz = -nx, -ny, -nz
    facing = nx * vx + ny * vy + nz * vz
    if facing < LEAST_FACING:
        lift = LEAST_FACING - facing
        nx, ny, nz = nx + lift * vx, ny + lift * vy, nz + lift * vz
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length < 1e-6:
            return gx, gy, gz
        k = 1.0 / length
        nx, ny, nz = nx * k, ny * k, nz * k
    return nx, ny, nz
