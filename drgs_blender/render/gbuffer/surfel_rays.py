"""Surfels that the camera sees along its rays, where its picture is curved and no screen takes them (`surfels.raster`).

They are blended as light meets them (`surfels.surfel_tracer`), the heaviest surface on each ray alone, without the
rasteriser's low-pass: a surfel smaller than a sample is met by some of the pixel's rays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ROWS, over_range
from ...core.frame import Camera
from ..camera import CLIP_END, CLIP_START, SUBPIXELS, WIDTH, sample_ray
from ..memory import address
from ..sampling import ONE, ZERO, F
from ..scene.ray import Ray
from ..scene.ray_masks import CAMERA
from ..surfel_columns import ALBEDO, METALLIC, NORMAL, ROUGHNESS, SAMPLE, SIZE
from ..surfels.raster import GAP, SurfelSamples
from ..surfels.surfel_bvh import SurfelBVH
from ..surfels.surfel_query import RayStart
from ..surfels.surfel_tracer import HEAVIEST, trace_surfels, tracer_of

Array = np.ndarray


class SurfelRays(NamedTuple):
    """The surfels of a frame and the camera that sees them; in the place of `surfels.splats.Splats`.

    Attributes
    ----------
    bvh : SurfelBVH
    parameters : array
        `camera.camera_parameters`.
    x0, x1 : int
        Columns of the camera's window, half-open.
    surface : (n, SURFEL) float32 array, optional
        In place of the tree's.
    """

    bvh: SurfelBVH
    parameters: Array
    x0: int
    x1: int
    surface: Array | None = None

    @classmethod
    def of(cls, bvh: SurfelBVH, camera: Camera, parameters: Array) -> SurfelRays:
        """The rays of `camera`."""
        return cls(bvh, parameters, camera.window[0], camera.window[2])


def blend_along_rays(rays: SurfelRays, y0: int, y1: int) -> SurfelSamples:
    """Blend the surfels on the rays of the rows ``y0 .. y1`` (full-picture pixels, inside the window).

    Depths are along the rays; normals are turned towards the camera.
    """
    shape = (y1 - y0, rays.x1 - rays.x0, int(rays.parameters[SUBPIXELS]))
    samples = SurfelSamples(
        np.zeros(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty((*shape, SAMPLE), np.float32),
        np.empty(shape, np.int32),
    )
    if len(rays.bvh):
        place = rays.parameters, rays.x0, y0
        tracer = tracer_of(rays.bvh)
        if rays.surface is not None:
            tracer = tracer._replace(surface=address(rays.surface))
        over_range(_blend, y1 - y0, tracer, place, np.int32(CAMERA), samples, fewest=ROWS)
    return samples


@njit
def _blend(first, last, tracer, place, mask, samples):  # type: ignore[no-untyped-def]
    p, x0, y0 = place
    alpha, depth, surface, owner = samples
    width = np.int64(p[WIDTH])
    _, columns, subpixels = alpha.shape
    near, far = F(p[CLIP_START]), F(p[CLIP_END])
    start = RayStart(np.int32(-1), ZERO, ZERO, ZERO, ZERO)
    for y in range(first, last):
        for x in range(columns):
            for k in range(subpixels):
                ox, oy, oz, dx, dy, dz = sample_ray(p, (y0 + y) * width + x0 + x, k)
                if dx * dx + dy * dy + dz * dz == 0.0:  # beyond the picture of a fisheye lens
                    continue
                ray = Ray((F(ox), F(oy), F(oz)), (F(dx), F(dy), F(dz)), near, far, mask)
                through, t, nx, ny, nz, _, _, _, red, green, blue, rough, metal, size, who, _ = trace_surfels(
                    tracer, ray, start, F(GAP), HEAVIEST
                )
                if who < 0:
                    continue
                alpha[y, x, k], depth[y, x, k], owner[y, x, k] = ONE - through, t, who
                out = surface[y, x, k]
                out[NORMAL], out[NORMAL + 1], out[NORMAL + 2] = nx, ny, nz
                out[ALBEDO], out[ALBEDO + 1], out[ALBEDO + 2] = red, green, blue
                out[ROUGHNESS], out[METALLIC], out[SIZE] = rough, metal, size
