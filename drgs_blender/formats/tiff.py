"""TIFF pictures that Pillow does not read in full depth, with tifffile: floats, and 16-bit colours in planes."""

from __future__ import annotations

import io
import logging
import math
import struct
import zlib
from typing import Any

import numpy as np

from ..core.asset.archive import first_reason
from ..core.errors import AssetError

Array = np.ndarray
log = logging.getLogger(__name__)

#: Classic and big files, either order of bytes.
MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
#: No compression that is read without further packages packs better.
_RATIO = 1100
_GREY, _RGB = 1, 2
_DEFLATE = (8, 32946)
_DAMAGED = "Export the picture again, or restore it from a copy"
_KINDS = "Save it as 16-bit or 32-bit float RGB, uncompressed or with Deflate"


def tiff_size(data: bytes, subject: str) -> tuple[int, int]:
    """(width, height) of the first picture of a TIFF file held in memory. Raises AssetError."""
    return _attempt(data, subject, lambda page: (int(page.imagewidth), int(page.imagelength)))


def decode_tiff(data: bytes, subject: str, limit: int) -> Array:
    """Decode the first picture of a TIFF file held in memory.

    Parameters
    ----------
    data : bytes
        The file.
    subject : str
        Name in errors.
    limit : int
        Pixels at most.

    Returns
    -------
    Array
        (h, w, 3 or 4), row 0 at the top: uint8 or uint16, or float32 that is finite; straight alpha.

    Raises
    ------
    AssetError
        The file is damaged, of more than `limit` pixels, or of a kind that is not read.
    """
    return _attempt(data, subject, lambda page: _decode(page, data, subject, limit))


def _attempt(data: bytes, subject: str, use: Any) -> Any:
    """What `use` makes of the first page."""
    import tifffile

    noisy = logging.getLogger("tifffile")  # says again, and at length, what is wrong with a file
    was, noisy.disabled = noisy.disabled, True
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            return use(file.pages.first)
    except (AssetError, MemoryError):
        raise
    except Exception as error:  # tifffile raises of damaged files what its Python happens to run into
        if "imagecodecs" in str(error):
            problem = "is compressed in a way that needs the package imagecodecs"
            raise AssetError(subject, problem, f"Install it: pip install imagecodecs. Or: {_KINDS}") from error
        said = first_reason(str(error) or type(error).__name__)
        raise AssetError(subject, f"is no TIFF that can be read ({said})", _DAMAGED) from error
    finally:
        noisy.disabled = was


def _decode(page: Any, data: bytes, subject: str, limit: int) -> Array:
    kind = np.dtype(page.dtype) if page.dtype is not None else np.dtype(np.void)
    if page.imagewidth * page.imagelength > limit:
        raise AssetError(subject, f"is {page.imagewidth} x {page.imagelength} pixels", "Use a smaller image")
    if kind.kind not in "uf" or (kind.kind == "u" and kind.itemsize > 2):
        raise AssetError(subject, f"holds numbers of the kind {kind.name}, which are no colours", _KINDS)
    if page.photometric not in (_GREY, _RGB) or page.axes not in ("YX", "YXS", "SYX"):
        raise AssetError(subject, "is neither grey nor RGB", _KINDS)
    if page.nbytes > _RATIO * len(data):
        raise AssetError(
            subject, f"declares {page.imagewidth} x {page.imagelength} pixels, more than it holds", _DAMAGED
        )
    _check_packed(page, data, subject)
    pixels = np.asarray(page.asarray(maxworkers=1))
    pixels = np.moveaxis(pixels, 0, 2) if page.axes == "SYX" else pixels
    pixels = pixels if pixels.ndim == 3 else pixels[..., None]
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            pixels = pixels.astype(np.float32)
        if lost := int(np.count_nonzero(~np.isfinite(pixels))):
            log.warning("%s: %d values that are NaN or infinite set to 0", subject, lost)
            pixels = np.nan_to_num(pixels, nan=0.0, posinf=0.0, neginf=0.0)
    colours = 3 if page.photometric == _RGB else 1
    if pixels.shape[2] < colours:
        raise AssetError(subject, f"has {pixels.shape[2]} channels, fewer than its colours", _DAMAGED)
    extra = [int(e) for e in page.extrasamples or ()]
    colour = np.repeat(pixels[..., :1], 3, axis=2) if colours == 1 else pixels[..., :3]
    if extra[:1] in ([1], [2]) and pixels.shape[2] > colours:
        alpha = pixels[..., colours : colours + 1]
        colour = _straight(colour, alpha) if extra[0] == 1 else colour
        colour = np.concatenate([colour, alpha], axis=2)
    tag = page.tags.get(274)
    return np.ascontiguousarray(_upright(colour, int(tag.value) if tag is not None else 1))


def _check_packed(page: Any, data: bytes, subject: str) -> None:
    """Refuse Deflate that unpacks to more than its part of the picture: tifffile would unpack all of it."""
    most = math.prod(page.chunks) * page.dtype.itemsize
    if page.compression not in _DEFLATE:
        return
    for offset, count in zip(page.dataoffsets, page.databytecounts):
        try:
            unpacked = zlib.decompressobj().decompress(data[offset : offset + count], most + 1)
        except (zlib.error, struct.error) as error:
            raise AssetError(subject, f"is damaged: its pixels cannot be unpacked ({error})", _DAMAGED) from error
        if len(unpacked) > most:
            raise AssetError(subject, "unpacks to more than its pixels", _DAMAGED)


def _straight(colour: Array, alpha: Array) -> Array:
    """Colours that were multiplied by `alpha`, divided by it."""
    most = np.iinfo(colour.dtype).max if colour.dtype.kind == "u" else 1.0
    divided = np.divide(colour * float(most), alpha, out=np.zeros(colour.shape), where=alpha > 0)
    if colour.dtype.kind == "u":
        divided = np.rint(np.clip(divided, 0, most))
    return divided.astype(colour.dtype)


def _upright(pixels: Array, orientation: int) -> Array:
    """Row 0 at the top and column 0 at the left, from the tag Orientation."""
    if orientation in (5, 6, 7, 8):  # rows of the file are columns
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels[:, ::-1] if orientation in (2, 3, 6, 7) else pixels
