"""Looking up textures at mesh corners without aliasing: mip pyramids, sampled trilinearly in linear colour."""

from __future__ import annotations

import numpy as np

from ..core.color import srgb_to_linear, to_unit
from ..formats.files import Image, MaterialFile

Array = np.ndarray

#: Columns of sampled materials: albedo (linear Rec.709), roughness, metallic.
CHANNELS = 5


class Pyramid:
    """An image and its halvings, float32 linear.

    Parameters
    ----------
    image : Image
        Texture of a file.

    Attributes
    ----------
    levels : list of (h, w, c) array
        Level 0 is the image, each next one the mean of 2 x 2 pixels.
    """

    def __init__(self, image: Image) -> None:
        pixels = image.pixels[..., None] if image.pixels.ndim == 2 else image.pixels
        pixels = to_unit(np.repeat(pixels[..., :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[..., :3])
        self.image = image
        encoded = image.srgb and image.pixels.dtype.kind == "u"
        self.levels = [np.ascontiguousarray(srgb_to_linear(pixels) if encoded else pixels)]
        while max(self.levels[-1].shape[:2]) > 1:
            self.levels.append(_halve(self.levels[-1]))

    def texels(self, uvs: Array) -> Array:
        """Texture coordinates (..., 2), v up -> positions in pixels of level 0, row 0 at the top."""
        transform = np.asarray(self.image.uv_transform, np.float64)
        moved = uvs @ transform[:, :2].T + transform[:, 2]
        height, width = self.levels[0].shape[:2]
        return np.stack([moved[..., 0] * width, (1 - moved[..., 1]) * height], -1)

    def sample(self, texels: Array, footprint: Array) -> Array:
        """Mean colour (n, 3) around positions.

        Parameters
        ----------
        texels : (n, 2) array
            From `texels`.
        footprint : (n,) array
            Width of the area to average, in pixels of level 0.
        """
        level = np.clip(np.log2(np.maximum(footprint, 1)), 0, len(self.levels) - 1)
        low = np.minimum(level.astype(np.int64), max(len(self.levels) - 2, 0))
        part = (level - low).astype(np.float32)[:, None]
        result = np.zeros((len(texels), 3), np.float32)
        for k in np.unique(low):
            rows = np.flatnonzero(low == k)
            value = self._bilinear(k, texels[rows])
            blend = part[rows]
            if k + 1 < len(self.levels) and blend.any():
                value = (1 - blend) * value + blend * self._bilinear(k + 1, texels[rows])
            result[rows] = value
        return result

    def _bilinear(self, level: int, texels: Array) -> Array:
        pixels = self.levels[level]
        size = np.array(pixels.shape[1::-1])
        position = texels * (size / np.array(self.levels[0].shape[1::-1])) - 0.5
        start = np.floor(position)
        part = (position - start).astype(np.float32)
        start = start.astype(np.int64)
        x = [_wrap(start[:, 0] + k, int(size[0]), self.image.wrap[0]) for k in (0, 1)]
        y = [_wrap(start[:, 1] + k, int(size[1]), self.image.wrap[1]) for k in (0, 1)]
        fx, fy = part[:, :1], part[:, 1:]
        top = (1 - fx) * pixels[y[0], x[0]] + fx * pixels[y[0], x[1]]
        bottom = (1 - fx) * pixels[y[1], x[0]] + fx * pixels[y[1], x[1]]
        return (1 - fy) * top + fy * bottom


class Materials:
    """The materials of a mesh file as functions of texture coordinates.

    Parameters
    ----------
    materials : list of MaterialFile
        Of the file.
    coloured : bool
        The vertices have colours: the base colour of faces without a material (-1) is then white.
    """

    def __init__(self, materials: list[MaterialFile], coloured: bool = False) -> None:
        self._pyramids: dict[int, Pyramid] = {}
        plain = MaterialFile("", base_colour=(1.0, 1.0, 1.0)) if coloured else MaterialFile("")
        self._materials = [*materials, plain]  # index -1 finds the last
        self.textured = np.array([bool(self._images(m)) for m in self._materials])

    def sample(self, material: Array, uvs: Array, scale: Array) -> Array:
        """Values (n, CHANNELS) of points.

        Parameters
        ----------
        material : (n,) int array
            -1 is the default material.
        uvs : (n, 2) array
            v up.
        scale : (n, 2) array
            Width of the area to average, in texture coordinates.
        """
        result = np.empty((len(material), CHANNELS), np.float32)
        for index in np.unique(material):
            rows = np.flatnonzero(material == index)
            m = self._materials[index]
            values = np.empty((len(rows), CHANNELS), np.float32)
            values[:] = (*m.base_colour, m.roughness, m.metallic)
            for image, columns, channels in self._images(m):
                pyramid = self._pyramid(image)
                footprint = np.abs(scale[rows]) * pyramid.levels[0].shape[1::-1] * _zoom(image)
                colour = pyramid.sample(pyramid.texels(uvs[rows].astype(np.float64)), footprint.max(axis=1))
                values[:, columns] *= colour[:, channels]
            result[rows] = values
        return np.clip(result, 0, 1)

    def texel_size(self) -> Array:
        """Smallest texel of each material in texture coordinates, (materials + 1,); 1 where it has no texture."""
        sizes = np.ones(len(self._materials))
        for k, m in enumerate(self._materials):
            for image, _, _ in self._images(m):
                sizes[k] = min(sizes[k], 1 / (max(image.pixels.shape[:2]) * _zoom(image).max()))
        return sizes

    @staticmethod
    def _images(m: MaterialFile) -> list[tuple[Image, slice, slice]]:
        """(image, columns of the values it multiplies, its channels)."""
        images = (
            (m.base_colour_image, slice(0, 3), slice(0, 3)),
            (m.metallic_roughness_image, slice(3, 5), slice(1, 3)),
        )
        return [(image, columns, channels) for image, columns, channels in images if image is not None]

    def _pyramid(self, image: Image) -> Pyramid:
        if id(image) not in self._pyramids:
            self._pyramids[id(image)] = Pyramid(image)
        return self._pyramids[id(image)]


def _zoom(image: Image) -> Array:
    """How much the texture transform magnifies u and v, (2,)."""
    return np.linalg.norm(np.asarray(image.uv_transform, np.float64)[:, :2], axis=1)


def _halve(pixels: Array) -> Array:
    """Mean of 2 x 2 pixels; an odd last row or column counts twice."""
    h, w = pixels.shape[:2]
    padded = np.pad(pixels, ((0, h % 2 if h > 1 else 1), (0, w % 2 if w > 1 else 1), (0, 0)), mode="edge")
    return 0.25 * (padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2])


def _wrap(index: Array, size: int, mode: str) -> Array:
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        index = np.mod(index, 2 * size)
        return np.where(index < size, index, 2 * size - 1 - index)
    return np.mod(index, size)
