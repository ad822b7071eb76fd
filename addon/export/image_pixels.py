"""Pixels of image datablocks as the engine takes them; see `images`, which remembers them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import bpy
import numpy as np

from ...drgs_blender.core.arrays import shareable
from ...drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from ...drgs_blender.core.file_integrity import crashes_blender, is_whole
from ...drgs_blender.core.materials import Image
from ..bakes import node_trees
from . import image_parts

Array = np.ndarray

#: Colour spaces of 8-bit images that store linear light (or no colour).
LINEAR = {"Linear Rec.709", "Linear", "Non-Color", "Raw", "scene_linear"}
#: Those that are no colour.
DATA = {"Non-Color", "Raw"}
#: Rows that are worked on at once: whole copies of a large image are larger than all the rest.
_STRIP = 32


def is_empty(image: bpy.types.Image) -> bool:
    """Whether Blender has no pixels of an image, or cannot be asked for them."""
    return bool(image_parts.ask_file(image, crashes_blender)) or 0 in image.size[:]


def problems(image: bpy.types.Image) -> list[str]:
    """What is wrong with an image that was just read, for the user."""
    if image_parts.ask_file(image, is_whole) is False:
        return ["its file is cut off; as much of it is shown as can be read. Copy or export it again"]
    if (times := _reduction(image)) > 1:
        size = " x ".join(map(str, image.size))
        return [f"its {size} pixels are more than Blender gives away; it is reduced {times} times. Use a smaller one"]
    return []


def _reduction(image: bpy.types.Image) -> int:
    """How many times an image has to be made smaller for Blender to hand out its pixels."""
    return math.ceil(math.sqrt(image.size[0] * image.size[1] * 4 / node_trees.MOST_NUMBERS))


def _read(image: bpy.types.Image) -> Array | None:
    """(h, w, c) float32 as Blender holds them, row 0 at the top; None when the image has no pixels."""
    if is_empty(image):
        return None
    if (times := _reduction(image)) > 1:
        with image_parts.copied(image) as smaller:
            smaller.scale(*(max(1, n // times) for n in image.size))
            return _given(smaller)
    return _given(image)


def _given(image: bpy.types.Image) -> Array | None:
    width, height = image.size
    if len(image.pixels) == 0:
        return None
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, image.channels)[::-1]


def _is_srgb(image: bpy.types.Image) -> bool:
    return not image.is_float and image.colorspace_settings.name not in LINEAR


def linear(image: bpy.types.Image) -> Array | None:
    pixels = _read(image)
    if pixels is None:
        return None
    if pixels.shape[2] == 4 and _is_taken(image) and image.alpha_mode == "STRAIGHT" and _has_alpha(image):
        pixels = pixels[..., :3] * pixels[..., 3:]
    pixels = pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    if _is_srgb(image):
        pixels = srgb_to_linear(pixels)
    pixels = np.array(pixels, np.float32, order="C")
    pixels.flags.writeable = False
    return pixels


def straight(image: bpy.types.Image) -> Image | None:
    pixels = _rgba(image)
    if pixels is None:
        return None
    alpha = pixels[..., 3:]
    taken = _is_taken(image)
    if image.is_float and _has_alpha(image) and not (taken and image.alpha_mode == "STRAIGHT"):
        np.divide(pixels[..., :3], alpha, out=pixels[..., :3], where=alpha > 0)
    elif taken and image.alpha_mode == "PREMUL" and pixels.shape[2] == 4 and _has_alpha(image):
        for part in _strips(pixels):
            part[..., :3] = np.minimum(part[..., :3].astype(np.uint32) * 255 // np.maximum(part[..., 3:], 1), 255)
    return _picture(image, pixels)


def associated(image: bpy.types.Image) -> Image | None:
    pixels = _rgba(image)
    if pixels is None:
        return None
    taken = _is_taken(image)
    multiply = image.alpha_mode == "STRAIGHT" if taken else not image.is_float or _is_encoded(image)
    if pixels.shape[2] == 4 and _has_alpha(image) and multiply:
        for part in _strips(pixels):
            colours, alpha = part[..., :3], part[..., 3:]
            # Of the encoded values, and bytes rounded down, as Cycles does.
            if image.is_float and taken:
                colours *= alpha
            elif image.is_float:
                straight = np.divide(colours, alpha, out=np.zeros_like(colours), where=alpha > 0)
                colours[:] = srgb_to_linear(linear_to_srgb(straight) * alpha)
            elif (alpha != 255).any():
                colours[:] = colours.astype(np.uint16) * alpha // 255
    return _picture(image, pixels)


def _is_taken(image: bpy.types.Image) -> bool:
    """Whether Cycles takes the pixels from Blender and believes the alpha mode, as it does from 5.2 on."""
    return bpy.app.version >= (5, 2) and (image.source == "GENERATED" or len(image.packed_files) > 0)


def _is_encoded(image: bpy.types.Image) -> bool:
    """Whether the file has 16 bits a channel, encoded as sRGB: Blender has them as linear floats, times alpha."""
    return image.file_format == "PNG" and image.colorspace_settings.name == "sRGB"


def _has_alpha(image: bpy.types.Image) -> bool:
    """Whether alpha belongs to the colours."""
    return image.alpha_mode in ("STRAIGHT", "PREMUL") and image.colorspace_settings.name not in DATA


def _rgba(image: bpy.types.Image) -> Array | None:
    """(h, w, 4) uint8 or float32, as Blender has them; bytes without the channels that say nothing, see `Image`."""
    pixels = _read(image)
    if pixels is None:
        return None
    count = pixels.shape[2]
    opaque = count < 4 or image.alpha_mode == "NONE"
    channels = 4 if image.is_float else _needed_channels(pixels, opaque)
    found = shareable((*pixels.shape[:2], channels), np.float32 if image.is_float else np.uint8)
    for first in range(0, len(found), _STRIP):
        part, into = pixels[first : first + _STRIP], found[first : first + _STRIP]
        if not image.is_float:
            part = part * 255
            np.rint(part, out=part)
        into[..., :3] = part[..., : min(channels, 3 if count >= 3 else 1)]
        if channels == 4:
            into[..., 3] = (1 if image.is_float else 255) if opaque else part[..., 3]
    return found


def _needed_channels(pixels: Array, opaque: bool) -> int:
    """How many channels of bytes say something: 4; 3 where all is opaque; 1 where it is grey, too."""
    if not opaque and any((part[..., 3] != 1).any() for part in _strips(pixels)):
        return 4
    if pixels.shape[2] < 3:
        return 1
    grey = all((p[..., 0] == p[..., 1]).all() and (p[..., 0] == p[..., 2]).all() for p in _strips(pixels))
    return 1 if grey else 3


def _strips(pixels: Array) -> Iterator[Array]:
    return (pixels[first : first + _STRIP] for first in range(0, len(pixels), _STRIP))


def _picture(image: bpy.types.Image, pixels: Array) -> Image:
    pixels.flags.writeable = False  # so that its identity says whether it changed
    return Image("", pixels, "srgb" if _is_srgb(image) else "linear")
