"""A small photograph with its camera: projection of points, rays of pixels, maps from the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image as Pillow

from ...core.arrays import Array
from ...reconstruct.readers.layout import OPENCV_TO_BLENDER, invert
from ...reconstruct.readers.lens import Lens, distort

#: Steps of the fixed-point inversion of a lens.
_STEPS = 12
_NEAR = 1e-6


@dataclass(slots=True)
class MaskView:
    """A photograph in the size at which masks are found.

    Attributes
    ----------
    name : str
        File name of the photograph, for messages.
    pixels : (h, w, 3) uint8 array
        sRGB.
    matrix : (4, 4) float64 array
        Camera to world, Blender's axes; Z up, ground at 0.
    lens : Lens
        Of `pixels`.
    """

    name: str
    pixels: Array
    matrix: Array
    lens: Lens

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def centre(self) -> Array:
        """(3,) place of the camera."""
        return self.matrix[:3, 3]

    def project(self, points: Array) -> tuple[Array, Array]:
        """(n, 2) pixels (centres at +0.5) and (n,) depths of (n, 3) points; NaN pixels for points behind the camera."""
        to_camera = invert(self.matrix @ OPENCV_TO_BLENDER)
        local = points @ to_camera[:3, :3].T + to_camera[:3, 3]
        depth = local[:, 2]
        safe = np.where(depth > _NEAR, depth, np.nan)
        x, y = local[:, 0] / safe, local[:, 1] / safe
        return np.stack(distort(self.lens, x, y), axis=1), depth

    def rays(self) -> Array:
        """(h, w, 3) directions of the pixels' centres, world, not of unit length."""
        height, width = self.shape
        lens = self.lens
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        x, y = (column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy
        for _ in range(_STEPS if lens.distorts else 0):
            moved = distort(lens, x, y)
            x, y = x + (column - moved[0]) / lens.fx, y + (row - moved[1]) / lens.fy
        local = np.stack([x, y, np.ones_like(x)], axis=-1)
        return local @ (self.matrix @ OPENCV_TO_BLENDER)[:3, :3].T

    def cropped(self, window: tuple[int, int, int, int], longest: int) -> MaskView:
        """A part (left, top, right, bottom) of the picture, made `longest` pixels on its longer side."""
        left, top, right, bottom = window
        width, height = right - left, bottom - top
        factor = longest / max(width, height)
        size = max(1, round(width * factor)), max(1, round(height * factor))
        resampling = Pillow.Resampling.BOX if factor < 1 else Pillow.Resampling.BICUBIC
        part = Pillow.fromarray(self.pixels[top:bottom, left:right]).resize(size, resampling)
        old = self.lens
        moved = Lens(width, height, old.fx, old.fy, old.cx - left, old.cy - top, old.model, old.coefficients)
        return MaskView(self.name, np.asarray(part), self.matrix, moved.scaled(*size))

    def on_ground(self) -> Array:
        """(h, w, 2) where the pixels' rays meet the ground; NaN at and above the horizon."""
        rays = self.rays()
        down = np.where(rays[..., 2] < -1e-4, rays[..., 2], np.nan)
        along = -self.centre[2] / down
        return np.where(along[..., None] > 0, self.centre[:2] + along[..., None] * rays[..., :2], np.nan)
