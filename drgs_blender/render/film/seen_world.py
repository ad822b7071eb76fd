"""The world as the camera sees it: what the film adds behind the surfaces."""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ROWS, over_range
from ...core.memory import sparse_zeros
from ..camera import WIDTH, sample_ray
from ..gbuffer.gbuffer import GBuffer
from ..lights.environment import EnvironmentLight, envmap_radiance, map_at
from ..shading_points import CATCHER

Array = np.ndarray


class SeenWorld:
    """Light straight from the world, of the camera's window: the same in all films of the same samples.

    Parameters
    ----------
    size : tuple of int
        Rows and columns.

    Attributes
    ----------
    environment : (h, w, 3) float32 array
        Radiance times what the surfaces leave uncovered, as if catchers had no shadow.
    veiled : (h, w, 3) float32 array
        The part of it that is seen through catchers.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.environment, self.veiled = sparse_zeros((*size, 3)), sparse_zeros((*size, 3))

    def add(self, buffer: GBuffer, environment: EnvironmentLight, parameters: Array, origin: tuple[int, int]) -> None:
        """Take the samples of a strip.

        Parameters
        ----------
        buffer : GBuffer
        environment : EnvironmentLight
        parameters : array
            `camera.camera_parameters`.
        origin : tuple of int
            Left and top of the window in the full picture.
        """
        (x0, top), (y0, y1), points = origin, buffer.rows, buffer.points
        rows, envmap = slice(y0 - top, y1 - top), environment.envmap
        given = parameters, x0, y0, buffer.alpha, envmap, self.environment[rows]
        over_range(_uncovered, y1 - y0, *given, fewest=ROWS)
        caught = np.flatnonzero(points.flags & CATCHER)
        if len(caught):
            seen = points.pixel[caught], points.sample[caught], points.weight[caught]
            _through(parameters, x0, y0, *seen, envmap, self.veiled[rows])

    def behind(self, shadow: Array) -> Array:
        """(h, w, 3) float32: the light past (h, w) shadows on catchers, from 0 for none to 1."""
        return self.environment - self.veiled * shadow[..., None] if shadow.any() else self.environment


@njit
def _world(p, pixel, sample, envmap):  # type: ignore[no-untyped-def]
    """The world's radiance along the ray of a sub-pixel sample."""
    _, _, _, dx, dy, dz = sample_ray(p, pixel, sample)
    square = dx * dx + dy * dy + dz * dz
    if square == 0.0:  # beyond the picture of a fisheye lens
        return np.float32(0.0), np.float32(0.0), np.float32(0.0)
    scale = 1.0 / np.sqrt(square)
    u, v = map_at(np.float32(dx * scale), np.float32(dy * scale), np.float32(dz * scale), envmap)
    return envmap_radiance(u, v, envmap)


@njit
def _uncovered(first, last, p, x0, y0, alpha, envmap, out):  # type: ignore[no-untyped-def]
    """Add the world's radiance along every sub-pixel ray, weighted by what the surfaces leave uncovered."""
    width = np.int64(p[WIDTH])
    _, columns, subpixels = alpha.shape
    share = np.float32(1.0 / subpixels)
    for y in range(first, last):
        for x in range(columns):
            red = green = blue = np.float32(0.0)
            for k in range(subpixels):
                left = (np.float32(1.0) - alpha[y, x, k]) * share
                if left <= np.float32(0.0):
                    continue
                r, g, b = _world(p, (y0 + y) * width + x0 + x, k, envmap)
                red, green, blue = red + left * r, green + left * g, blue + left * b
            if red != np.float32(0.0) or green != np.float32(0.0) or blue != np.float32(0.0):
                out[y, x, 0], out[y, x, 1], out[y, x, 2] = red, green, blue


@njit
def _through(p, x0, y0, pixel, sample, weight, envmap, out):  # type: ignore[no-untyped-def]
    """Add the world's radiance behind some points, by weight."""
    width = np.int64(p[WIDTH])
    for i in range(len(pixel)):
        y, x = pixel[i] // width - y0, pixel[i] % width - x0
        r, g, b = _world(p, pixel[i], sample[i], envmap)
        out[y, x, 0] += weight[i] * r
        out[y, x, 1] += weight[i] * g
        out[y, x, 2] += weight[i] * b
