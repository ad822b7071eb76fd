"""Camera raw files: developed to linear colours by rawpy, metadata by Pillow."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from ..core.arrays import Array
from ..core.errors import AssetError
from . import libraries
from .exif import Metadata, metadata_of

#: Extensions, lower case.
RAW = frozenset((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"))


def decode_raw(path: Path) -> Array:
    """(h, w, 3) float32 linear Rec.709, upright: the camera's white balance, its own brightness, 1 where it clips.

    Raises
    ------
    AssetError
        The file cannot be developed.
    DeviceError
        rawpy is not installed.
    """
    rawpy = libraries.load("rawpy")
    try:
        with rawpy.imread(str(path)) as raw:
            pixels = raw.postprocess(use_camera_wb=True, no_auto_bright=True, gamma=(1, 1), output_bps=16)
    except (rawpy.LibRawError, rawpy.NotSupportedError, OSError, ValueError) as error:
        remedy = "Develop it in another program, to TIFF or EXR"
        reason = error.args[0] if error.args else error
        said = reason.decode(errors="replace") if isinstance(reason, bytes) else error  # LibRaw's are bytes
        raise AssetError(str(path), f"cannot be developed ({said})", remedy) from error
    return np.asarray(pixels, np.float32) / np.float32(65535)


def read_raw_metadata(path: Path, size: tuple[int, int]) -> Metadata:
    """EXIF of a raw file in a TIFF container, such as DNG, NEF, ARW, CR2; none of others.

    Parameters
    ----------
    path : Path
    size : tuple of int
        Width and height of the developed picture, which is upright already: its orientation is 1.
    """
    exif = Pillow.Exif()
    with warnings.catch_warnings():  # what is missing is not used
        warnings.simplefilter("ignore")
        try:
            with path.open("rb") as file:
                exif.load_from_fp(file)
        except Exception:  # what is no TIFF, or damaged, raises almost anything
            return Metadata()
    return replace(metadata_of(exif, size), orientation=1, up=None)
