"""A small photograph with its camera: projection of points, rays of pixels, the picture without distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image as Pillow

from ...core.arrays import Array
from ...core.frame import Camera
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
    behind : (h, w, 3) uint8 array, optional
        What the photograph would show without the object, where that is known; of any size.
    """

    name: str
    pixels: Array
    matrix: Array
    lens: Lens
    behind: Array | None = None

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

    def _slopes(self) -> tuple[Array, Array]:
        """(h, w) each: x and y at unit depth of the pixels' centres, without the lens's distortion."""
        height, width = self.shape
        lens = self.lens
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        x, y = (column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy
        for _ in range(_STEPS if lens.distorts else 0):
            moved = distort(lens, x, y)
            x, y = x + (column - moved[0]) / lens.fx, y + (row - moved[1]) / lens.fy
        return x, y

    def rays(self) -> Array:
        """(h, w, 3) directions of the pixels' centres, world, not of unit length."""
        x, y = self._slopes()
        local = np.stack([x, y, np.ones_like(x)], axis=-1)
        return local @ (self.matrix @ OPENCV_TO_BLENDER)[:3, :3].T

    def pinhole(self, longest: int) -> Camera:
        """A camera without distortion that sees the same, `longest` pixels on its longer side."""
        height, width = self.shape
        factor = longest / max(width, height)
        w, h = max(1, round(width * factor)), max(1, round(height * factor))
        lens = self.lens.scaled(w, h)
        return Camera(self.matrix, w, h, lens.fx, lens.fy, lens.cx, lens.cy)

    def straightened(self, cv2: Any, longest: int) -> MaskView:
        """The picture as its `pinhole` camera sees it."""
        camera = self.pinhole(longest)
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        at = [(c - 0.5).astype(np.float32) for c in distort(self.lens, *np.meshgrid(x, y))]
        factor = self.shape[1] / camera.width

        def seen(pixels: Array) -> Array:
            if factor > 1:
                pixels = cv2.GaussianBlur(pixels, (0, 0), 0.4 * factor)
            return cv2.remap(pixels, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

        behind = self.behind
        if behind is not None:
            behind = seen(cv2.resize(behind, self.shape[::-1]))
        lens = Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        return MaskView(self.name, seen(self.pixels), self.matrix, lens, behind)

    def distorted(self, cv2: Any, camera: Camera, values: Array) -> Array:
        """(h, w) float32: values of the pixels of a `pinhole` camera at those of the picture."""
        x, y = self._slopes()
        at = [x * camera.fx + camera.cx - 0.5, y * camera.fy + camera.cy - 0.5]
        at = [np.asarray(c, np.float32) for c in at]
        return cv2.remap(values, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def cropped(self, window: tuple[int, int, int, int], longest: int) -> MaskView:
        """A part (left, top, right, bottom) of the picture, made `longest` pixels on its longer side."""
        left, top, right, bottom = window
        width, height = right - left, bottom - top
        factor = longest / max(width, height)
        size = max(1, round(width * factor)), max(1, round(height * factor))
        resampling = Pillow.Resampling.BOX if factor < 1 else Pillow.Resampling.BICUBIC
        part = Pillow.fromarray(self.pixels[top:bottom, left:right]).resize(size, resampling)
        behind = self.behind
        if behind is not None:
            own = behind.shape[1] / self.shape[1], behind.shape[0] / self.shape[0]
            edges = (left * own[0], top * own[1], right * own[0], bottom * own[1])
            behind = np.asarray(Pillow.fromarray(behind).resize(size, Pillow.Resampling.BILINEAR, box=edges))
        old = self.lens
        moved = Lens(width, height, old.fx, old.fy, old.cx - left, old.cy - top, old.model, old.coefficients)
        return MaskView(self.name, np.asarray(part), self.matrix, moved.scaled(*size), behind)

    def on_ground(self) -> Array:
        """(h, w, 2) where the pixels' rays meet the ground; NaN at and above the horizon."""
        rays = self.rays()
        down = np.where(rays[..., 2] < -1e-4, rays[..., 2], np.nan)
        along = -self.centre[2] / down
        return np.where(along[..., None] > 0, self.centre[:2] + along[..., None] * rays[..., :2], np.nan)
