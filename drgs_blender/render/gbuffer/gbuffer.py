"""The G-buffer of a strip of rows: what the camera sees before it is lit; the result of surfels and meshes alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...compute.jit import inlined, njit
from ..camera import SUBPIXELS, WIDTH
from ..scene.ray_masks import CATCHER as CATCHER_OBJECT
from ..shading_points import CATCHER, SECOND, ShadingPoints

Array = np.ndarray

#: Least cosine between a shading normal and the direction to the viewer.
LEAST_FACING = 0.02


class PointRows(NamedTuple):
    """The points of a strip as kernels go through them: row by row, pixel by pixel, sample by sample.

    Attributes
    ----------
    start : (rows + 1,) int64 array
        First point of each row; at last their number.
    x0, y0, width : int
        Full-picture pixel of the strip's first one, and the picture's width.
    pixel, sample, weight, flags : array
        As of `ShadingPoints`.
    depth, position : array
        As of `GBuffer`.
    """

    start: Array
    x0: int
    y0: int
    width: int
    pixel: Array
    sample: Array
    weight: Array
    flags: Array
    depth: Array
    position: Array


class PointSurfaces(NamedTuple):
    """Surfaces at the shading points of a strip.

    Attributes
    ----------
    normal, albedo, roughness, metallic : array
        As of `ShadingPoints`.
    emission, object_index : array
        As of `GBuffer`.
    """

    normal: Array
    albedo: Array
    roughness: Array
    metallic: Array
    emission: Array
    object_index: Array


@dataclass(slots=True)
class GBuffer:
    """Covered sub-pixel samples of the rows ``y0 .. y1`` of the camera's window, ordered by pixel, then sample.

    Attributes
    ----------
    rows : tuple of int
        (y0, y1) in the full picture, half-open.
    points : ShadingPoints
        n of them, what the integrator eats.
    position : (n, 3) float32 array
        World space: the seen surface point (``points.origin`` lies on the traced mesh).
    depth : (n,) float32 array
        Metres along the view axis.
    object_index : (n,) int32 array
        As numbered by `scene.TraceScene`.
    emission : (n, 3) float32 array
        Radiance that the surface itself sends to the camera.
    face, instance : (n,) int32 array
        Face and instance at the point, as `interaction.nearest` numbers them; face -1 for a surfel off all meshes.
    barycentric : (n, 2) float32 array
        Weights of the face's second and third corner.
    alpha : (rows, width, subpixels) float32 array
        Share of each sub-pixel sample that hides the background; shadow catchers do not.
    """

    rows: tuple[int, int]
    points: ShadingPoints
    position: Array
    depth: Array
    object_index: Array
    emission: Array
    face: Array
    instance: Array
    barycentric: Array
    alpha: Array

    def point_rows(self, x0: int, width: int) -> PointRows:
        """Its points, row by row, where the window begins at column `x0` of a picture of `width` columns."""
        points, (y0, y1) = self.points, self.rows
        start = np.searchsorted(points.pixel, np.arange(y0, y1 + 1, dtype=np.int64) * width)
        keys = points.pixel, points.sample, points.weight, points.flags
        return PointRows(start, x0, y0, width, *keys, self.depth, self.position)

    def surfaces(self) -> PointSurfaces:
        """Surfaces at its shading points."""
        points = self.points
        materials = points.albedo, points.roughness, points.metallic
        return PointSurfaces(points.normal, *materials, self.emission, self.object_index)

    def mark_catchers(self, object_flags: Array) -> None:
        """Flag the points of shadow catchers."""
        if (object_flags & CATCHER_OBJECT).any():
            self.points.flags |= np.where(object_flags[self.object_index] & CATCHER_OBJECT, CATCHER, 0).astype(np.uint8)


def compact(
    alpha: Array, parameters: Array, x0: int, y0: int, second: Array | None = None, detailed: bool = False
) -> GBuffer:
    """Make room for the samples with positive `alpha`, with pixel, sample, weight and flags filled in.

    Parameters
    ----------
    alpha : (rows, width, subpixels) float32 array
    parameters : array
        `camera.camera_parameters`.
    x0, y0 : int
        Full-picture pixel of ``alpha[0, 0]``.
    second : (rows, width, subpixels) float32 array, optional
        Of a second layer, or None: its points follow those of their samples.
    detailed : bool
        Whether there are normal or bump maps, so that points have smooth normals apart.
    """
    n = np.count_nonzero(alpha) + (0 if second is None else np.count_nonzero(second))
    pixel, sample, owner, face, instance = np.empty((5, n), np.int32)
    weight, roughness, metallic, depth = np.empty((4, n), np.float32)
    origin, normal, geometric, view, albedo, position = (np.empty((n, 3), np.float32) for _ in range(6))
    flags = np.zeros(n, np.uint8)
    none = np.empty((0, 0, 0), np.float32)
    _number(alpha, none if second is None else second, parameters, x0, y0, pixel, sample, weight, flags)
    points = ShadingPoints(pixel, sample, weight, origin, normal, geometric, view, albedo, roughness, metallic, flags)
    points.smooth = np.zeros((n if detailed else 0, 3), np.float32)
    emission = np.zeros((n, 3), np.float32)
    tied = face, instance, np.empty((n, 2), np.float32)
    points.face, points.instance, points.place = tied
    return GBuffer((y0, y0 + len(alpha)), points, position, depth, owner, emission, *tied, alpha)


@njit
def _number(alpha, second, p, x0, y0, pixel, sample, weight, flags):  # type: ignore[no-untyped-def]
    """List the covered samples in order."""
    width = np.int64(p[WIDTH])
    share = np.float32(1.0 / p[SUBPIXELS])
    rows, columns, subpixels = alpha.shape
    layers = 2 if len(second) == rows else 1
    n = 0
    for y in range(rows):
        for x in range(columns):
            for k in range(subpixels):
                for layer in range(layers):
                    a = second[y, x, k] if layer else alpha[y, x, k]
                    if a > np.float32(0.0):
                        pixel[n] = (y0 + y) * width + x0 + x
                        sample[n] = k
                        weight[n] = a * share
                        flags[n] = SECOND if layer else 0
                        n += 1


@inlined
def face_viewer(nx, ny, nz, gx, gy, gz, vx, vy, vz):  # type: ignore[no-untyped-def]
    """Shading normal on the side of the geometric normal g, which faces the viewer at v, and visible from there.

    A smooth normal that looks away from the viewer near a silhouette is bent until it is just visible.

    Parameters
    ----------
    nx, ny, nz : float
        Shading normal, unit, world.
    gx, gy, gz : float
        Geometric normal, unit, world.
    vx, vy, vz : float
        Direction towards the viewer, unit, world.

    Returns
    -------
    nx, ny, nz : float
        Unit, world.
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
