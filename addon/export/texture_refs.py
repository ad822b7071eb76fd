"""Images on surfaces: which, where and how, and what nodes made of their values.

A node between image and socket that works on each channel alone, such as Invert, Color Ramp or Map Range, is a curve of
256 values for an 8-bit image. The image is sent with the curve applied.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import bpy
import numpy as np

from ...drgs_blender.core.color import srgb_to_linear
from ...drgs_blender.core.materials import Image, Texture
from . import images
from .layers import LayerRef
from .nodes import LUMINANCE

Array = np.ndarray
Warn = Callable[[str], None]
Channel = Literal["rgb", "r", "g", "b", "a", "luminance"]

_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}
#: Bytes with which a function is probed for working on each channel alone.
_PROBES = np.array(((10, 100, 200), (200, 50, 120), (0, 255, 128)))


@dataclass(frozen=True, slots=True)
class TextureRef:
    """An image on a surface; all that materials.Texture says, and the datablock.

    Attributes
    ----------
    straight : as of images.export_image
    channel : of the picture, after the curve
    curve : (256, 3) float32 as bytes, the value that each byte stands for; empty where it stands for itself
    layer : coordinates that place it, before `matrix`
    matrix, interpolation, extension : of the picture that is exported
    source : channel of the image whose bytes the curve is of; "rgb" is each of its own
    data : values that are no colours, such as normals: a curve of them is not encoded as sRGB
    lookup : as of images.export_image
    """

    image: bpy.types.Image
    straight: bool
    channel: Channel
    layer: LayerRef
    matrix: tuple[tuple[float, ...], ...]
    interpolation: Literal["linear", "closest"]
    extension: Literal["repeat", "extend", "clip", "mirror"]
    curve: bytes = b""
    source: str = "rgb"
    data: bool = False
    lookup: images.Lookup = images.PLAIN

    def export(self, warn: Warn) -> Image:
        """The pixels."""
        if not self.curve:
            return self._plain(warn)
        return images.export_curved(self.image, self.straight, self.source, self.curve, warn, self.data, self.lookup)

    def _plain(self, warn: Warn) -> Image:
        """The pixels before the curve, which whoever made the `TextureRef` has seen."""
        return images.export_image(self.image, self.straight, warn, self.lookup) or images.LOST

    def texture(self, name: str, layer: str = "") -> Texture:
        """What it is on the surface; `name` is that of the exported image, `layer` that of the exported layer."""
        matrix = np.array(self.matrix)[:2, (0, 1, 3)]
        return Texture(name, self.channel, matrix, self.interpolation, self.extension, layer)

    def mean(self, warn: Warn) -> Array:
        """(3,) linear mean; of one channel three times the same."""
        mean = images.mean_colour(self.export(warn))
        if self.channel == "rgb":
            return mean[:3]
        return np.full(3, mean[:3] @ LUMINANCE if self.channel == "luminance" else mean[_CHANNELS[self.channel]])

    def only(self, channel: Channel) -> TextureRef:
        """One channel or the luminance; of what is one channel already, itself."""
        return replace(self, channel=channel) if self.channel == "rgb" else self

    def curved(self, function: Callable[[Array], Array], warn: Warn) -> tuple[TextureRef, float] | None:
        """The picture with `function` of (n, 3) colours done to its values, and a factor for it to stay below 1.

        None where that is no curve: the image is not of bytes, or channels are mixed.
        """
        values, source = self._values(warn)
        if values is None:
            return None
        made = np.asarray(function(values))
        if source == "rgb" and not np.allclose(
            function(values[_PROBES, (0, 1, 2)]), made[_PROBES, (0, 1, 2)], rtol=1e-4, atol=1e-5
        ):
            return None
        made = np.maximum(np.nan_to_num(made), 0)
        factor = max(1.0, float(made.max()))
        curve = (made / factor).astype(np.float32)
        channel: Channel = "r" if source != "rgb" and (np.ptp(curve, axis=1) < 1e-6).all() else "rgb"
        return replace(self, channel=channel, curve=curve.tobytes(), source=source), factor

    def _values(self, warn: Warn) -> tuple[Array | None, str]:
        """(256, 3): the values that the picture's bytes stand for, and the channel that they are of."""
        plain = self._plain(warn)
        if plain.pixels.dtype != np.uint8:
            return None, ""
        if self.curve:
            values = np.frombuffer(self.curve, np.float32).reshape(256, 3).astype(np.float64)
        else:
            values = np.repeat(np.arange(256)[:, None] / 255, 3, axis=1)
            if plain.encoding == "srgb" and self.channel != "a":
                values = srgb_to_linear(values)
        if self.channel == "rgb":
            return values, self.source
        if self.channel == "luminance":
            if self.source != "rgb":
                return np.repeat((values @ LUMINANCE)[:, None], 3, axis=1), self.source
            if self.curve or not images.is_grey(plain):
                return None, ""
            return values, "r"
        index = min(_CHANNELS[self.channel], 2)
        return np.repeat(values[:, index : index + 1], 3, axis=1), self.channel if self.source == "rgb" else self.source
