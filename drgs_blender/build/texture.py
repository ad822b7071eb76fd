"""Materials of mesh files as functions of texture coordinates, looked up without aliasing in linear colour."""

from __future__ import annotations

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS, OPTIONAL_CHANNELS
from ..core.color import to_unit
from ..core.mip_pyramid import Pyramid, TrilinearTaps, magnification
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
                sizes[k] = min(sizes[k], 1 / (max(image.pixels.shape[:2]) * magnification(image).max()))
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
