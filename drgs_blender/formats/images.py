"""Decode texture files (PNG, JPEG, WebP, TIFF, ...) with Pillow, with limits, in their full depth."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
from PIL import Image as Pillow
from PIL import UnidentifiedImageError
from PIL.TiffImagePlugin import BITSPERSAMPLE, PLANAR_CONFIGURATION, TiffImageFile

from ..core.asset.archive import replace_file
from ..core.errors import AssetError
from .tiff import MAGIC as TIFF
from .tiff import decode_tiff, tiff_size

Array = np.ndarray

#: Largest texture that is decoded, in pixels (16k x 16k).
PIXEL_LIMIT = 1 << 28
#: Most pixels per byte of a large file: more is a bomb, not a picture.
RATIO_LIMIT = 2000
#: Pillow's own limit is lower than that, and its words do not say what to do.
Pillow.MAX_IMAGE_PIXELS = None
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF")
#: What Pillow raises of files it cannot read.
_UNREADABLE = (OSError, ValueError, SyntaxError, EOFError, Pillow.DecompressionBombError)
#: Pillow keeps the first byte of 16-bit colours in the order that it takes them to be in: in the other order, the
#: second.
_HIGH = {"B": "BL", "L": "LB", "N": "LB" if sys.byteorder == "little" else "BL"}


def decode_image(data: bytes, subject: str, limit: int = PIXEL_LIMIT) -> Array:
    """Decode an image file held in memory to (h, w, 3 or 4), row 0 at the top, straight alpha.

    Integers, uint8 or uint16, are display-referred; float32 (from TIFF) is finite and linear.

    Raises
    ------
    AssetError
        The data are no image of a known format, damaged, or of more than `limit` pixels.
    """
    try:
        with Pillow.open(io.BytesIO(data), formats=_FORMATS) as image:
            if image.width * image.height > limit:
                raise AssetError(subject, f"is {image.width} x {image.height} pixels", "Use a smaller image")
            if image.width * image.height > max(1 << 26, RATIO_LIMIT * len(data)):
                size = f"{image.width} x {image.height} pixels in {len(data)} bytes"
                raise AssetError(subject, f"is {size}, which no picture is", "Use a smaller image")
            if _is_deep(image):
                return _deep(image, data, subject, limit)
            if image.mode.startswith("I"):  # 16-bit grey
                grey = np.asarray(image).clip(0, 65535).astype(np.uint16)
                return np.repeat(grey[..., None], 3, axis=2)
            alpha = "A" in image.mode or "transparency" in image.info
            return np.asarray(image.convert("RGBA" if alpha else "RGB"))
    except UnidentifiedImageError as error:
        if data.startswith(TIFF):
            return decode_tiff(data, subject, limit)
        raise AssetError(subject, "is no image that can be read", "Convert it to PNG or JPEG") from error
    except _UNREADABLE as error:
        raise AssetError(subject, f"is no image that can be read ({error})", "Convert it to PNG or JPEG") from error


def _is_deep(image: Pillow.Image) -> bool:
    """Whether Pillow would leave bits of an open image out, or take floats and large integers for 16 bits."""
    if isinstance(image, TiffImageFile):
        bits = image.tag_v2.get(BITSPERSAMPLE, (1,))
        return image.mode in ("I", "F") or (image.mode in ("RGB", "RGBA", "RGBX", "LA") and max(bits) > 8)
    return image.mode in ("RGB", "RGBA", "LA") and ";16" in _raw(image)


def _raw(image: Pillow.Image) -> str:
    """How the pixels of an image file lie in it, as Pillow calls it."""
    arguments = {t.args if isinstance(t.args, str) else t.args[0] for t in getattr(image, "tile", ()) if t.args}
    return str(arguments.pop()) if len(arguments) == 1 else ""


def _deep(image: Pillow.Image, data: bytes, subject: str, limit: int) -> Array:
    """Pixels of more than 8 bits a channel, of an image that is open."""
    raw = _raw(image)
    planes = isinstance(image, TiffImageFile) and image.tag_v2.get(PLANAR_CONFIGURATION, 1) != 1
    if planes:  # of which Pillow's libtiff takes the first bytes, whatever the raw mode
        return decode_tiff(data, subject, limit)
    if raw in ("RGB;16B", "RGB;16L", "RGB;16N", "RGBA;16B", "RGBA;16L", "RGBA;16N"):
        high, low = (_pixels(data, raw[:-1] + order).astype(np.uint16) for order in _HIGH[raw[-1]])
        pixels: Array = high << 8 | low
    elif raw == "LA;16B":  # four bytes a pixel, too
        pixels = _pixels(data, "RGBA").copy().view(">u2").astype(np.uint16)[..., [0, 0, 0, 1]]
    else:
        return decode_tiff(data, subject, limit)
    clear = image.info.get("transparency")  # the one colour that is not there
    if pixels.shape[2] == 3 and isinstance(clear, tuple):
        seen = (pixels != np.array(clear)).any(axis=2, keepdims=True)
        pixels = np.concatenate([pixels, seen * np.uint16(65535)], axis=2)
    return pixels


def _pixels(data: bytes, raw: str) -> Array:
    """Bytes of an image file whose pixels are taken to lie in it as `raw` says."""
    with Pillow.open(io.BytesIO(data), formats=_FORMATS) as image:
        image.tile = [t._replace(args=(raw, *t.args[1:]) if isinstance(t.args, tuple) else raw) for t in image.tile]
        return np.asarray(image)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header of an image file. Raises AssetError."""
    try:
        with Pillow.open(path) as image:
            return image.size
    except _UNREADABLE as error:
        try:
            data = path.read_bytes() if isinstance(error, UnidentifiedImageError) else b""
        except OSError:
            data = b""
        if data.startswith(TIFF):
            return tiff_size(data, str(path))
        raise AssetError(str(path), f"is no image that can be read ({error})", "Convert it to PNG or JPEG") from error


def load_image(path: Path) -> Array:
    """Decode the image file at `path`; see `decode_image`."""
    try:
        return decode_image(path.read_bytes(), str(path))
    except OSError as error:
        raise AssetError(str(path), f"cannot be read ({error.strerror or error})", "Check the path") from error


def write_png(path: Path, pixels: Array) -> None:
    """Write a PNG file, atomically; `pixels` are (h, w, 3 or 4) uint8, sRGB, straight alpha."""
    write_image(path, Pillow.fromarray(pixels))


def write_image(path: Path, image: Pillow.Image, kind: str = "PNG", **options: object) -> None:
    """Write an image file, atomically.

    It is encoded in memory: Pillow does not tell of a full disk where it writes into a file itself.

    Parameters
    ----------
    path : Path
    image : Image
    kind : str
        Pillow's name of the format.
    **options : object
        Of Pillow's `save`.

    Raises
    ------
    WriteError
        Naming `path`, whatever stopped the write.
    """
    encoded = io.BytesIO()
    image.save(encoded, kind, **options)
    replace_file(path, [encoded.getvalue()])
