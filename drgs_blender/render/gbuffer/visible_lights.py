"""Lights that the camera sees.

Blender's lights are seen only where their ray visibility says so, and between the camera's clip distances (suns: at
any). They hide nothing: a ray gathers the light of each light it meets before a surface, and goes on. Where a sub-pixel
sample has several surfaces, or a surface that is not opaque, each part of it sees the lights before its own depth.
Lights in front of a holdout are hidden by it.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ...compute.threads import over_range
from ..camera import CLIP_END, CLIP_START, WIDTH, sample_ray
from ..lights.light_sampler import LightTables, lights_along, suns_along
from ..lights.light_shapes import CAMERA
from ..sampling import ONE, ZERO, F
from ..shading_points import CATCHER
from .gbuffer import GBuffer

Array = np.ndarray

_FAR = F(np.inf)


def visible_lights(lights: LightTables, parameters: Array, x0: int, buffer: GBuffer) -> Array:
    """Radiance of lights straight to the camera, mean over each pixel's samples.

    Parameters
    ----------
    lights : LightTables
    parameters : array
        `camera.camera_parameters`.
    x0 : int
        First column of the camera's window.
    buffer : GBuffer

    Returns
    -------
    (rows, width, 3) float32 array
        Linear Rec.709, of the buffer's rows.
    """
    out = np.zeros((*buffer.alpha.shape[:2], 3), np.float32)
    points = buffer.point_rows(x0, int(parameters[WIDTH]))
    over_range(_look, len(out), parameters, points, buffer.alpha, lights, out)
    return out


@njit
def _look(y0, y1, p, points, alpha, lights, out):  # type: ignore[no-untyped-def]
    pixel, weight, depth, near = points.pixel, points.weight, points.depth, p[CLIP_START]
    _, columns, subpixels = alpha.shape
    for y in range(y0, y1):
        n = points.start[y]
        for x in range(columns):
            place = (points.y0 + y) * points.width + points.x0 + x
            for k in range(subpixels):
                first = n
                while n < points.start[y + 1] and pixel[n] == place and points.sample[n] == k:
                    n += 1
                ox, oy, oz, dx, dy, dz = sample_ray(p, place, k)
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                if length == 0.0:  # beyond the picture of a fisheye lens
                    continue
                # As in Cycles, rays start at the clip distance: soft lights face that place.
                origin = F(ox + near * dx), F(oy + near * dy), F(oz + near * dz)
                direction = F(dx / length), F(dy / length), F(dz / length)
                end = F((p[CLIP_END] - near) * length)
                r, g, b = lights_along(origin, direction, end, ONE, ZERO, CAMERA, lights)
                s, t, u = suns_along(origin, direction, _FAR, ONE, ZERO, CAMERA, lights)
                r, g, b = r + s, g + t, b + u
                if not r + g + b > ZERO:
                    continue
                free = (ONE - alpha[y, x, k]) / F(subpixels)
                red, green, blue = free * r, free * g, free * b
                for i in range(first, n):
                    if points.flags[i] & CATCHER:
                        continue
                    reach = F((depth[i] - near) * length)
                    r, g, b = lights_along(origin, direction, reach, ONE, ZERO, CAMERA, lights)
                    red, green, blue = red + weight[i] * r, green + weight[i] * g, blue + weight[i] * b
                out[y, x, 0] += red
                out[y, x, 1] += green
                out[y, x, 2] += blue
