"""What a denoiser has to know of shadow catchers, of which the film keeps nothing but their light."""

from __future__ import annotations

import numpy as np

from ...core.frame import Camera, RenderSettings
from ..camera import WIDTH, footprints
from ..gbuffer.gbuffer import GBuffer
from ..shading_points import CATCHER, Radiance
from .guides import Guides

Array = np.ndarray


class CatcherFilm:
    """Means over the points of catchers, of the camera's window.

    Attributes
    ----------
    variance : (h, w) array, optional
        Of the luminance that catchers reflect in the scene, by coverage; None: there are no catchers, or nothing is
        to be denoised.
    """

    def __init__(self, camera: Camera, settings: RenderSettings, parameters: Array) -> None:
        x0, y0, x1, y1 = camera.window
        self._size, self._origin, self._parameters = (y1 - y0, x1 - x0), (x0, y0), parameters
        self._wanted = settings.denoise != "none"
        self.variance: Array | None = None

    def add(self, buffer: GBuffer, radiance: Radiance) -> None:
        """Take the points of a strip."""
        if not self._wanted:
            return
        points = buffer.points
        caught = np.flatnonzero(points.flags & CATCHER)
        if not len(caught):
            return
        if self.variance is None:
            self.variance, self._weight, self._depth = (np.zeros(self._size) for _ in range(3))
            self._position, self._normal = (np.zeros((*self._size, 3)) for _ in range(2))
        (x0, y0), first = self._origin, buffer.rows[0]
        rows, columns = slice(first - y0, buffer.rows[1] - y0), self._size[1]
        row, column = np.divmod(points.pixel[caught], int(self._parameters[WIDTH]))
        place, weight = (row - first) * columns + column - x0, points.weight[caught].astype(float)

        def sums(values: Array) -> Array:
            return np.bincount(place, values, (rows.stop - rows.start) * columns).reshape(-1, columns)

        self._weight[rows] += sums(weight)
        self._depth[rows] += sums(weight * buffer.depth[caught])
        self.variance[rows] += sums(weight**2 * radiance.variance[caught].sum(axis=1))
        for k in range(3):
            self._position[rows, :, k] += sums(weight * buffer.position[caught, k])
            self._normal[rows, :, k] += sums(weight * points.normal[caught, k])

    def guides(self) -> Guides:
        """Guides by which light that catchers reflect can be denoised: all are one white, rough object."""
        weight = np.maximum(self._weight, 1e-12)
        length = np.maximum(np.linalg.norm(self._normal, axis=2), 1e-12)
        arrays = {
            "coverage": self._weight,
            "position": self._position / weight[..., None],
            "normal": self._normal / length[..., None],
            "albedo": np.ones_like(self._position),
            "roughness": np.ones_like(weight),
            "metallic": np.zeros_like(weight),
            "object": np.ones_like(weight),
            "footprint": footprints(self._depth / weight, self._parameters),
        }
        return Guides(**{name: values.astype(np.float32) for name, values in arrays.items()})
