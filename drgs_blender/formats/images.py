"""Decode texture files (PNG, JPEG, WebP, ...) with Pillow, with limits."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from ..core.asset.archive import replace_file
from ..core.errors import AssetError

Array = np.ndarray

#: Largest texture that is decoded, in pixels (16k x 16k).
PIXEL_LIMIT = 1 << 28
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF")


def decode_image(data: bytes, subject: str, limit: int = PIXEL_LIMIT) -> Array:
    """Decode an image file held in memory to (h, w, 3 or 4) uint8 or uint16, row 0 at the top.

    Raises
    ------
    AssetError
        The data are no image of a known format, damaged, or of more than `limit` pixels.
    """
    try:
        with Pillow.open(io.BytesIO(data), formats=_FORMATS) as image:
            if image.width * image.height > limit:
                raise AssetError(subject, f"is {image.width} x {image.height} pixels", "Use a smaller image")
            if image.mode.startswith("I"):  # 16-bit grey
                grey = np.asarray(image).clip(0, 65535).astype(np.uint16)
                return np.repeat(grey[..., None], 3, axis=2)
            alpha = "A" in image.mode or "transparency" in image.info
            return np.asarray(image.convert("RGBA" if alpha else "RGB"))
    except (OSError, ValueError, SyntaxError, EOFError, Pillow.DecompressionBombError) as error:
        raise AssetError(subject, f"is no image that can be read ({error})", "Convert it to PNG or JPEG") from error


def load_image(path: Path) -> Array:
    """Decode the image file at `path`; see `decode_image`."""
    try:
        return decode_image(path.read_bytes(), str(path))
    except OSError as error:
        raise AssetError(str(path), f"cannot be read ({error.strerror or error})", "Check the path") from error


def write_png(path: Path, pixels: Array) -> None:
    """Write a PNG file, atomically; `pixels` are (h, w, 3 or 4) uint8, sRGB, straight alpha."""
    encoded = io.BytesIO()
    Pillow.fromarray(pixels).save(encoded, "PNG")
    replace_file(path, [encoded.getvalue()])
