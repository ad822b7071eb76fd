"""Looking up textures at mesh corners without aliasing: mip pyramids, sampled trilinearly in linear colour."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS, OPTIONAL_CHANNELS
from ..core.color import srgb_to_linear, to_unit
from ..formats.files import Image, MaterialFile

Array = np.ndarray

#: Columns that sampled materials always have: albedo (linear Rec.709), roughness, metallic.
CHANNELS = 5
#: The alpha of materials that are cut out, among `Materials.columns`.
CUT = "cut"
#: Alpha below which there is no surface, where a material is cut out.
CUT_OUT = 0.5
#: A material is cut out where this part of its alpha is at most .1 or at least .9, and some of it the former.
CLEAR_CUT = 0.8
#: Points looked up at a time: what is found on the way stays in the processor's cache.
TOGETHER = 16384


class TrilinearTaps(NamedTuple):
    """Pixels between which points are interpolated, in pyramids of one layout.

    Attributes
    ----------
    fine, coarse : Corners
        In the level whose pixels are as large as the footprint, or smaller; in the next one, of some points.
    blended : (k,) int64 array
        The points of `coarse`.
    share : (k,) float32 array
        How much of the coarse level they take.
    """

    fine: Corners
    coarse: Corners
    blended: Array
    share: Array


class Corners(NamedTuple):
    """Four pixels around each of n points, and how far the point is from the first to the last.

    Attributes
    ----------
    pixel : (4, n) int64 array
        Number of the top left, top right, bottom left and bottom right pixel.
    x, y : (n,) float32 array
    """

    pixel: Array
    x: Array
    y: Array


class Pyramid:
    """An image and its halvings, float32 linear.

    Parameters
    ----------
    image : Image
        Texture of a file.

    Attributes
    ----------
    levels : list of (h, w, 3) array
        Level 0 is the image, each next one the mean of 2 x 2 pixels.
    layout : tuple
        Equal for images whose points are found at the same `taps`.
    """

    def __init__(self, image: Image) -> None:
        pixels = image.pixels[..., None] if image.pixels.ndim == 2 else image.pixels
        pixels = to_unit(np.repeat(pixels[..., :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[..., :3])
        self.image = image
        encoded = image.srgb and image.pixels.dtype.kind == "u"
        levels = [srgb_to_linear(pixels) if encoded else pixels]
        while max(levels[-1].shape[:2]) > 1:
            levels.append(_halve(levels[-1]))
        self._sizes = np.array([level.shape[1::-1] for level in levels])  # width and height
        self._starts = np.concatenate([[0], np.cumsum(self._sizes.prod(axis=1))])
        # All pixels of all levels, channel by channel: numpy is slow at rows of three numbers.
        self._planes = np.empty((3, self._starts[-1]), np.float32)
        self.levels = []
        for level, start, stop in zip(levels, self._starts, self._starts[1:]):
            self._planes[:, start:stop] = level.reshape(-1, 3).T
            self.levels.append(self._planes[:, start:stop].T.reshape(level.shape))
        self.layout = (levels[0].shape[:2], tuple(image.wrap), np.asarray(image.uv_transform, np.float64).tobytes())

    def texels(self, uvs: Array) -> Array:
        """Texture coordinates (..., 2), v up -> positions in pixels of level 0, row 0 at the top."""
        transform = np.asarray(self.image.uv_transform, np.float64)
        moved = uvs @ transform[:, :2].T + transform[:, 2]
        width, height = self._sizes[0]
        return np.stack([moved[..., 0] * width, (1 - moved[..., 1]) * height], -1)

    def sample(self, texels: Array, footprint: Array) -> Array:
        """Mean colour (n, 3) around positions; parameters are those of `taps`."""
        return self.look_up(self.taps(texels, footprint)).T

    def taps(self, texels: Array, footprint: Array) -> TrilinearTaps:
        """Find the pixels around positions.

        Parameters
        ----------
        texels : (n, 2) array
            From `texels`.
        footprint : (n,) array
            Width of the area to average, in pixels of level 0.
        """
        level = np.clip(np.log2(np.maximum(footprint, 1)), 0, len(self.levels) - 1)
        low = np.minimum(level.astype(np.int64), max(len(self.levels) - 2, 0))
        share = (level - low).astype(np.float32)
        x, y = np.ascontiguousarray(texels.T)
        blended = np.flatnonzero(share)
        coarse = self._corners(low[blended] + 1, x[blended], y[blended])
        return TrilinearTaps(self._corners(low, x, y), coarse, blended, share[blended])

    def taps_at(self, uvs: Array, scale: Array) -> TrilinearTaps:
        """Find the pixels around texture coordinates (n, 2), v up, to average over areas of width `scale` (n, 2)."""
        footprint = np.abs(scale) * self.levels[0].shape[1::-1] * _zoom(self.image)
        return self.taps(self.texels(uvs.astype(np.float64)), np.maximum(footprint[:, 0], footprint[:, 1]))

    def look_up(self, taps: TrilinearTaps, channels: slice = slice(0, 3)) -> Array:
        """Colours (channels, n) at `taps`, those of a pyramid of the same layout."""
        planes = self._planes[channels]
        result = np.empty((len(planes), len(taps.fine.x)), np.float32)
        for plane, colour in zip(planes, result):
            colour[:] = _bilinear(plane, taps.fine)
            if len(taps.blended):
                fine, coarse = colour[taps.blended], _bilinear(plane, taps.coarse)
                colour[taps.blended] = (1 - taps.share) * fine + taps.share * coarse
        return result

    def _corners(self, level: Array, x: Array, y: Array) -> Corners:
        """The pixels around positions in pixels of level 0, each in a level of its own."""
        scale = self._sizes / self._sizes[0]
        width, height = self._sizes[:, 0][level], self._sizes[:, 1][level]
        x, y = x * scale[:, 0][level] - 0.5, y * scale[:, 1][level] - 0.5
        left, top = np.floor(x), np.floor(y)
        part_x, part_y = (x - left).astype(np.float32), (y - top).astype(np.float32)
        columns = [_wrap(left.astype(np.int64) + k, width, self.image.wrap[0]) for k in (0, 1)]
        rows = [_wrap(top.astype(np.int64) + k, height, self.image.wrap[1]) for k in (0, 1)]
        pixel = np.empty((4, len(x)), np.int64)
        for k, row in enumerate(rows):
            first = self._starts[level] + row * width
            np.add(first, columns[0], out=pixel[2 * k])
            np.add(first, columns[1], out=pixel[2 * k + 1])
        return Corners(pixel, part_x, part_y)


class Materials:
    """The materials of a mesh file as functions of texture coordinates.

    Parameters
    ----------
    materials : list of MaterialFile
        Of the file.
    coloured : bool
        The vertices have colours: the base colour of faces without a material (-1) is then white.

    Attributes
    ----------
    textured, bumpy : (materials + 1,) bool array
        Which have images, and which normal maps.
    cut_out : (materials + 1,) bool array
        Whose alpha says where there is a surface.
    columns : dict of str to slice
        Where channels stand in what is sampled. Beside albedo, roughness and metallic these are `CUT` and the optional
        channels of an asset that any material needs.
    width : int
        Columns of `sample`.
    """

    def __init__(self, materials: list[MaterialFile], coloured: bool = False) -> None:
        self._pyramids: dict[int, Pyramid] = {}
        plain = MaterialFile("", base_colour=(1.0, 1.0, 1.0)) if coloured else MaterialFile("")
        self._materials = [*materials, plain]  # index -1 finds the last
        self.bumpy = np.array([m.normal_image is not None for m in self._materials])
        self.cut_out = np.array([_is_cut_out(m) for m in self._materials])
        self.columns = {"albedo": slice(0, 3), "roughness": slice(3, 4), "metallic": slice(4, 5)}
        self.width = CHANNELS
        for name, neutral in ((CUT, 1.0), *((name, MATERIAL_CHANNELS[name].neutral) for name in OPTIONAL_CHANNELS)):
            values = [np.asarray(self._factor(index, name)) for index in range(len(self._materials))]
            if any((value != neutral).any() for value in values) or self._has_image(name):
                self.columns[name] = slice(self.width, self.width + values[0].size)
                self.width += values[0].size
        self._limit = np.ones((self.width, 1), np.float32)
        if "emission" in self.columns:
            self._limit[self.columns["emission"]] = np.inf
        self.textured = np.array([bool(self._images(k)) for k in range(len(self._materials))])

    def sample(self, material: Array, uvs: Array, scale: Array) -> Array:
        """Values (n, width) of points, channel by channel in memory.

        Parameters
        ----------
        material : (n,) int array
            -1 is the default material.
        uvs : (n, 2) array
            v up.
        scale : (n, 2) array
            Width of the area to average, in texture coordinates.
        """
        result = np.empty((self.width, len(material)), np.float32)
        for index in np.unique(material):
            of_material = np.flatnonzero(material == index)
            for first in range(0, len(of_material), TOGETHER):
                rows = of_material[first : first + TOGETHER]
                result[:, rows] = self._of_material(index, uvs[rows], scale[rows])
        return self.clipped(result).T

    def clipped(self, values: Array) -> Array:
        """Values (width, n) within the limits of their channels, in place."""
        return np.clip(values, 0, self._limit, out=values)

    def perceived(self, values: Array) -> Array:
        """Values (width, n) in which equal steps look about equal: the square root of colours, of emission up to 1."""
        result = values.copy()
        result[:3] = np.sqrt(np.maximum(values[:3], 0))
        if (own := self.columns.get("emission")) is not None:
            radiance = np.maximum(values[own], 0)
            result[own] = np.sqrt(radiance / (1 + radiance))
        return result

    def _of_material(self, index: int, uvs: Array, scale: Array) -> Array:
        """Values (width, n) of points of one material."""
        m = self._materials[index]
        values = np.empty((self.width, len(uvs)), np.float32)
        values[:CHANNELS] = np.array((*m.base_colour, m.roughness, m.metallic))[:, None]
        for name, own in list(self.columns.items())[3:]:
            values[own] = np.reshape(self._factor(index, name), (-1, 1))
        taps: dict[tuple[object, ...], TrilinearTaps] = {}
        for image, columns, channels in self._images(index):
            pyramid = self._pyramid(image)
            if pyramid.layout not in taps:
                taps[pyramid.layout] = pyramid.taps_at(uvs, scale)
            values[columns] *= pyramid.look_up(taps[pyramid.layout], channels)
        return values

    def normals(self, material: Array, uvs: Array, scale: Array) -> Array | None:
        """Normals (n, 3) of the maps in tangent space, of length 1 at most; None where no material has any.

        Parameters are those of `sample`.
        """
        bumpy = [index for index in np.unique(material) if self.bumpy[index]]
        if not bumpy:
            return None
        result = np.zeros((3, len(material)))
        result[2] = 1
        for index in bumpy:
            m = self._materials[index]
            assert m.normal_image is not None
            rows = np.flatnonzero(material == index)
            pyramid = self._pyramid(m.normal_image)
            found = 2.0 * pyramid.look_up(pyramid.taps_at(uvs[rows], scale[rows])) - 1
            found[:2] *= m.normal_strength
            found[2] = 1 + (found[2] - 1) * min(max(m.normal_strength, 0), 1)
            result[:, rows] = found
        return result.T

    def texel_size(self, bumps: bool = False) -> Array:
        """Smallest texel of each material in texture coordinates, (materials + 1,); 1 where it has no texture.

        Parameters
        ----------
        bumps : bool
            Normal maps count, too.
        """
        sizes = np.ones(len(self._materials))
        for k, m in enumerate(self._materials):
            maps = [m.normal_image] if bumps and m.normal_image is not None else []
            for image in [*maps, *(image for image, _, _ in self._images(k))]:
                sizes[k] = min(sizes[k], 1 / (max(image.pixels.shape[:2]) * _zoom(image).max()))
        return sizes

    def _images(self, index: int) -> list[tuple[Image, slice, slice]]:
        """(image, columns of the values it multiplies, its channels) of a material."""
        m = self._materials[index]
        images = [
            (m.base_colour_image, slice(0, 3), slice(0, 3)),
            (m.metallic_roughness_image, slice(3, 5), slice(1, 3)),
        ]
        for name, own in list(self.columns.items())[3:]:
            images.append((self._image(index, name), own, slice(0, own.stop - own.start)))
        return [(image, columns, channels) for image, columns, channels in images if image is not None]

    def _factor(self, index: int, name: str) -> float | tuple[float, ...]:
        """What the image of a column of a material is multiplied by; the value where there is no image."""
        m = self._materials[index]
        if name in (CUT, "opacity"):
            return m.alpha if self.cut_out[index] == (name == CUT) else 1.0
        factor: float | tuple[float, ...] = getattr(m, name)
        return factor

    def _image(self, index: int, name: str) -> Image | None:
        """The image of a column of a material."""
        m = self._materials[index]
        if name in (CUT, "opacity"):
            return m.alpha_image if self.cut_out[index] == (name == CUT) else None
        image: Image | None = getattr(m, f"{name}_image")
        return image

    def _has_image(self, name: str) -> bool:
        """Whether a material has an image for a column that is not white."""
        images = [self._image(index, name) for index in range(len(self._materials))]
        if name == "opacity":
            return any(image is not None and to_unit(image.pixels).min(initial=1) < 1 for image in images)
        return any(image is not None for image in images)

    def _pyramid(self, image: Image) -> Pyramid:
        if id(image) not in self._pyramids:
            self._pyramids[id(image)] = Pyramid(image)
        return self._pyramids[id(image)]


def _alpha_of(m: MaterialFile) -> Array:
    """All alpha that a material has."""
    return np.array([m.alpha]) if m.alpha_image is None else m.alpha * to_unit(m.alpha_image.pixels)


def _is_cut_out(m: MaterialFile) -> bool:
    """Whether a material's alpha says where there is a surface, also where its file only says that it has alpha."""
    if m.cut_out:
        return m.alpha_image is not None or m.alpha < CUT_OUT
    if m.alpha_image is None:
        return False
    alpha = _alpha_of(m)
    return bool((alpha <= 0.1).any()) and float(((alpha <= 0.1) | (alpha >= 0.9)).mean()) >= CLEAR_CUT


def _zoom(image: Image) -> Array:
    """How much the texture transform magnifies u and v, (2,)."""
    return np.linalg.norm(np.asarray(image.uv_transform, np.float64)[:, :2], axis=1)


def _halve(pixels: Array) -> Array:
    """Mean of 2 x 2 pixels; an odd last row or column counts twice."""
    h, w = pixels.shape[:2]
    padded = np.pad(pixels, ((0, h % 2 if h > 1 else 1), (0, w % 2 if w > 1 else 1), (0, 0)), mode="edge")
    return 0.25 * (padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2])


def _bilinear(plane: Array, corners: Corners) -> Array:
    """One channel at each point, between its four pixels."""
    pixel, x, y = corners
    other_x = 1 - x
    top = other_x * plane.take(pixel[0]) + x * plane.take(pixel[1])
    bottom = other_x * plane.take(pixel[2]) + x * plane.take(pixel[3])
    return (1 - y) * top + y * bottom


def _wrap(index: Array, size: Array, mode: str) -> Array:
    """Bring indices back into an image; each has a size of its own."""
    outside = np.flatnonzero((index < 0) | (index >= size))
    if not len(outside):
        return index
    out, size = index[outside], size[outside]
    if mode == "clamp":
        index[outside] = np.clip(out, 0, size - 1)
    elif mode == "mirror":
        out = np.mod(out, 2 * size)
        index[outside] = np.where(out < size, out, 2 * size - 1 - out)
    else:
        index[outside] = np.mod(out, size)
    return index
