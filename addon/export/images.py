"""Image datablocks -> pixels, remembered while an image does not change."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from ...drgs_blender.core.frame import Image

Array = np.ndarray
Warn = Callable[[str], None]

#: Colour spaces of 8-bit images that store linear light (or no colour).
LINEAR = {"Linear Rec.709", "Linear", "Non-Color", "Raw", "scene_linear"}
#: Those that are no colour.
DATA = {"Non-Color", "Raw"}
#: What Cycles shows for an image it cannot read.
MISSING = (1.0, 0.0, 1.0)
#: Exports for which an image that none of them used is remembered: view layers and scenes take turns.
KEPT_EXPORTS = 4

#: What was made of an image -> (the number of the export that used it last, result).
_known: dict[tuple[object, ...], tuple[int, Any]] = {}
_export = 0


def linear_pixels(image: bpy.types.Image, warn: Warn) -> Array | None:
    """(h, w, 3) float32 linear Rec.709, row 0 at the top, read-only; None when the image has no pixels.

    Blender keeps float images in scene-linear already; 8-bit ones are as in the file and decoded here. Values that are
    no light (NaN, infinite, negative) stay as they are: the engine takes such texels as black and warns with a count.
    """
    _check(image, warn)
    return _remembered(image, "light", _linear)


def export_image(image: bpy.types.Image, straight: bool, warn: Warn) -> Image | None:
    """Pixels of a texture; None when the image has none.

    Parameters
    ----------
    straight : keep the colours as they are where alpha is small. Cycles does so only for nodes whose Alpha is used;
        else the colours are multiplied with alpha (not those of data and of channel-packed images)
    """
    _check(image, warn)
    return _remembered(image, "straight" if straight else "associated", _straight if straight else _associated)


def mean_colour(picture: Image) -> Array:
    """(4,) linear mean of a picture, from at most some 65 thousand of its pixels."""
    some = _some(picture).astype(np.float64)
    if picture.pixels.dtype == np.uint8:
        some /= 255
    if picture.encoding == "srgb":
        some[:, :3] = srgb_to_linear(some[:, :3])
    some = some[np.isfinite(some).all(axis=1)]
    return some.mean(axis=0) if len(some) else np.zeros(4)


def _some(picture: Image) -> Array:
    """(n, 4) of its pixels, spread evenly."""
    steps = [max(1, n // 256) for n in picture.pixels.shape[:2]]
    return picture.pixels[:: steps[0], :: steps[1]].reshape(-1, 4)


def export_curved(
    image: bpy.types.Image, straight: bool, source: str, curve: bytes, warn: Warn, data: bool = False
) -> Image:
    """Pixels of an 8-bit texture whose bytes stand for other values.

    Parameters
    ----------
    source : channel whose bytes are looked up for red, green and blue; "rgb" is each of its own
    curve : (256, 3) float32 in [0, 1], linear, as bytes
    data : keep the values as they are; else colours are encoded as sRGB
    """
    plain = export_image(image, straight, warn)
    assert plain is not None, "a curve is made of pixels"
    values = np.frombuffer(curve, np.float32).reshape(256, 3)
    number = data or (bool((np.ptp(values, axis=1) < 1e-6).all()) and source != "rgb")
    table = np.rint(255 * (values if number else linear_to_srgb(values))).astype(np.uint8)

    def make(_: bpy.types.Image) -> Image:
        pixels = plain.pixels.copy()
        for i in range(3):
            pixels[..., i] = table[:, i][plain.pixels[..., i if source == "rgb" else "rgba".index(source)]]
        pixels.flags.writeable = False
        mark = hashlib.blake2b(source.encode() + b"data" * data + curve, digest_size=6).hexdigest()
        return Image(f"{plain.name} ({mark})", pixels, "linear" if number else "srgb")

    return _remembered(image, f"{straight} {source} {data} {hashlib.blake2b(curve).hexdigest()}", make)


def is_grey(picture: Image) -> bool:
    """Whether red, green and blue are the same, in some 65 thousand of its pixels at most."""
    some = _some(picture)
    return bool((some[:, 0] == some[:, 1]).all() and (some[:, 0] == some[:, 2]).all())


def end_export() -> None:
    """Drop what the last exports did not use."""
    global _export
    _export += 1
    for key in [k for k, (used, _) in _known.items() if used < _export - KEPT_EXPORTS]:
        del _known[key]


def forget() -> None:
    """Drop all remembered pixels."""
    _known.clear()


def _check(image: bpy.types.Image, warn: Warn) -> None:
    """Say what is not as in Cycles."""
    if image.source in ("MOVIE", "SEQUENCE"):
        warn(f'Image "{image.name}": of a {image.source.lower()} only the current picture is used')
    if image.source == "TILED" and len(image.tiles) > 1:
        warn(f'Image "{image.name}": of its {len(image.tiles)} UDIM tiles only the first is used')
    space = image.colorspace_settings.name
    if not image.is_float and space not in LINEAR and space != "sRGB":
        warn(f'Image "{image.name}": colour space {space} of an 8-bit image is read as sRGB')


def _read(image: bpy.types.Image) -> Array | None:
    """(h, w, c) float32 as Blender holds them, row 0 at the top; None when the image has no pixels."""
    width, height = image.size
    if width * height == 0 or len(image.pixels) == 0:
        return None
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, image.channels)[::-1]


def _is_srgb(image: bpy.types.Image) -> bool:
    return not image.is_float and image.colorspace_settings.name not in LINEAR


def _linear(image: bpy.types.Image) -> Array | None:
    pixels = _read(image)
    if pixels is None:
        return None
    pixels = pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    if _is_srgb(image):
        pixels = srgb_to_linear(pixels)
    pixels = np.array(pixels, np.float32, order="C")
    pixels.flags.writeable = False
    return pixels


def _straight(image: bpy.types.Image) -> Image | None:
    pixels = _rgba(image)
    if pixels is None:
        return None
    alpha = pixels[..., 3:]
    if image.is_float and _has_alpha(image):
        np.divide(pixels[..., :3], alpha, out=pixels[..., :3], where=alpha > 0)
    return _picture(image, f"{image.name_full} (straight)", pixels)


def _associated(image: bpy.types.Image) -> Image | None:
    pixels = _rgba(image)
    if pixels is None:
        return None
    if not image.is_float and _has_alpha(image) and (pixels[..., 3] != 255).any():
        # Of the encoded values and rounded down, as Cycles does.
        pixels[..., :3] = pixels[..., :3].astype(np.uint16) * pixels[..., 3:] // 255
    return _picture(image, image.name_full, pixels)


def _has_alpha(image: bpy.types.Image) -> bool:
    """Whether alpha belongs to the colours."""
    return image.alpha_mode in ("STRAIGHT", "PREMUL") and image.colorspace_settings.name not in DATA


def _rgba(image: bpy.types.Image) -> Array | None:
    """(h, w, 4) uint8 or float32, as Blender has them."""
    pixels = _read(image)
    if pixels is None:
        return None
    count = pixels.shape[2]
    rgba = np.ones((*pixels.shape[:2], 4), np.float32)
    rgba[..., : max(count, 3)] = pixels if count >= 3 else pixels[..., :1]
    if image.alpha_mode == "NONE":
        rgba[..., 3] = 1
    return rgba if image.is_float else np.rint(rgba * 255).astype(np.uint8)


def _picture(image: bpy.types.Image, name: str, pixels: Array) -> Image:
    pixels.flags.writeable = False  # so that its identity says whether it changed
    return Image(name, pixels, "srgb" if _is_srgb(image) else "linear")


def _remembered(image: bpy.types.Image, kind: str, make: Callable[[bpy.types.Image], Any]) -> Any:
    """What `make` makes of the image, from memory where the image did not change."""
    key = _key(image)
    if key is None:
        return make(image)
    key = (kind, *key)
    if key not in _known:
        _known[key] = _export, make(image)
    result = _known[key][1]
    _known[key] = _export, result
    return result


def _key(image: bpy.types.Image) -> tuple[object, ...] | None:
    """What the pixels depend on, or None where that is not known: painted, generated and moving images."""
    if image.source != "FILE" or image.is_dirty:
        return None
    path = bpy.path.abspath(image.filepath, library=image.library)
    try:
        changed = os.stat(path).st_mtime_ns
    except OSError:  # packed, or missing (then there are no pixels)
        changed = 0
    packed = hashlib.blake2b(image.packed_file.data).digest() if image.packed_file else b""
    settings = image.colorspace_settings.name, image.alpha_mode
    return image.session_uid, image.name_full, path, changed, packed, *settings, tuple(image.size)
