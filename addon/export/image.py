"""An image datablock -> linear Rec.709 pixels, remembered while the image does not change."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable

import bpy
import numpy as np

Array = np.ndarray

#: Colour spaces of 8-bit images that store linear light (or no colour).
LINEAR = {"Linear Rec.709", "Linear", "Non-Color", "Raw", "scene_linear"}
#: Images kept; one world uses one, a second one covers going back and forth.
KEPT = 2

_known: dict[tuple[object, ...], Array] = {}


def linear_pixels(image: bpy.types.Image, warn: Callable[[str], None]) -> Array | None:
    """(h, w, 3) float32 linear Rec.709, row 0 at the top, read-only; None when the image has no pixels.

    Blender keeps float images in scene-linear already; 8-bit ones are as in the file and decoded here. Values that are
    no light (NaN, infinite, negative) stay as they are: the engine takes such texels as black and warns with a count.
    """
    if image.source in ("MOVIE", "SEQUENCE"):
        warn(f'Image "{image.name}": of a {image.source.lower()} only the current picture lights the scene')
    key = _key(image)
    if key is not None and key in _known:
        return _known[key]
    width, height = image.size
    if not image.has_data and width * height == 0:
        return None
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, image.channels)[::-1, :, :3]
    if pixels.shape[2] < 3:
        pixels = np.repeat(pixels[..., :1], 3, axis=2)
    space = image.colorspace_settings.name
    if not image.is_float and space not in LINEAR:
        if space != "sRGB":
            warn(f'Image "{image.name}": colour space {space} of an 8-bit image is read as sRGB')
        pixels = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)
    pixels = np.array(pixels, np.float32, order="C")
    pixels.flags.writeable = False
    if key is not None:
        while len(_known) >= KEPT:
            del _known[next(iter(_known))]
        _known[key] = pixels
    return pixels


def forget() -> None:
    """Drop all remembered pixels."""
    _known.clear()


def _key(image: bpy.types.Image) -> tuple[object, ...] | None:
    """What the pixels depend on, or None where that cannot be told: painted, generated and moving images."""
    if image.source != "FILE" or image.is_dirty:
        return None
    path = bpy.path.abspath(image.filepath, library=image.library)
    try:
        changed = os.stat(path).st_mtime_ns
    except OSError:  # packed, or missing (then there are no pixels)
        changed = 0
    packed = hashlib.blake2b(image.packed_file.data).digest() if image.packed_file else b""
    return image.session_uid, path, changed, packed, image.colorspace_settings.name, tuple(image.size)
