"""Results of readers of captures: where the photographs are, and what is known about each."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from ...core.color import to_unit
from ...core.errors import AssetError, first_of
from ...formats.exr import exr_size, read_exr
from ...formats.images import image_size, load_image
from .lens import Lens

Array = np.ndarray

#: Folder of what `drgs capture` needs to go on; removed when the capture is complete.
WORK = "registration"
#: Camera axes: OpenCV's (x right, y down, z forward) to Blender's and OpenGL's (y up, z backward), applied from the
#: right to a camera-to-world matrix.
OPENCV_TO_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])
#: Extensions of photographs, in the order in which they are looked for.
PICTURES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".JPEG", ".webp", ".tif", ".tiff", ".bmp")
#: Of pictures in high dynamic range, which are read where a capture names them.
EXR = ".exr"
#: Bytes of a JSON file; 10,000 frames take about 10 MB.
LARGEST_JSON = 256 << 20
#: Cameras farther from the origin than this are a program's slip: what follows from such distances overflows.
_FARTHEST = 1e15


def decode_mask(path: Path) -> Array:
    """(h, w) float32 in 0..1 of a mask file: alpha where it has one that says something, else brightness."""
    pixels = np.clip(to_unit(load_image(path)), 0, 1)
    if pixels.shape[2] == 4 and pixels[..., 3].min() < 1:
        return pixels[..., 3]
    return pixels[..., :3].mean(axis=-1)


@dataclass(slots=True)
class Photograph:
    """One photograph, not yet read.

    Attributes
    ----------
    name : str
        Unique.
    image : Path
        File.
    matrix : (4, 4) float64 array
        Camera-to-world, rigid, Blender's camera convention, world of the capture.
    lens : Lens
        Calibrated for a picture that may have another size than `image`, not another shape.
    mask : Path, optional
        File.
    test : bool
        A test view of the capture: not used in training.
    exposure : float, optional
        Exposure value, stops; larger lets in less light. None: not known, or of no account.
    mask_band : float
        `View.mask_band`, pixels of `lens`.
    """

    name: str
    image: Path
    matrix: Array
    lens: Lens
    mask: Path | None = None
    test: bool = False
    exposure: float | None = None
    mask_band: float = 0.0


@dataclass(slots=True)
class Layout:
    """A capture, not yet read.

    Attributes
    ----------
    photographs : list of Photograph
        At least one.
    upright : bool
        The world is known to be Z up; else "up" is found from the cameras.
    points : (n, 3) float64 array, optional
        Sparse points in the capture's world.
    decode_mask : callable
        Reads a mask file to (h, w) float32 in 0..1.
    notes : list of (Path, str)
        What was changed of photographs when they were read, filled as they are.
    guessed : dict of str to str
        What is assumed of the world, not found ("scale", "up", "ground"), and what it rests on, as the capture says.
    """

    photographs: list[Photograph]
    upright: bool
    points: Array | None = None
    decode_mask: Callable[[Path], Array] = decode_mask
    notes: list[tuple[Path, str]] = field(default_factory=list)
    guessed: dict[str, str] = field(default_factory=dict)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises AssetError."""
    try:
        if path.stat().st_size > LARGEST_JSON:
            raise AssetError(str(path), f"has {path.stat().st_size >> 20} MiB", "Choose the file of a capture")
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AssetError(str(path), f"cannot be read ({error.strerror or error})", "Check the path") from error
    except (ValueError, RecursionError) as error:
        raise AssetError(str(path), f"is not JSON ({error})", "Export the capture again") from error
    if not isinstance(data, dict):
        raise AssetError(str(path), "is not a JSON object", "Export the capture again")
    return data


def rigid(values: Any, subject: str) -> Array:
    """(4, 4) float64 camera-to-world from numbers in rows, (3, 4) or (4, 4); a common scale is taken out.

    Raises
    ------
    AssetError
        Not such a matrix, or it mirrors or shears.
    """
    try:
        matrix = np.array(values, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise AssetError(subject, "has no camera matrix of 4 rows of 4 finite numbers", "Export the cameras again")
    if (largest := np.abs(matrix[:3]).max()) > _FARTHEST:
        raise AssetError(subject, f"has a camera matrix with {largest:.0e} in it", "Export the cameras again")
    matrix = np.vstack([matrix[:3], [0, 0, 0, 1]])
    rotation = matrix[:3, :3]
    size = abs(np.linalg.det(rotation)) ** (1 / 3)
    if size < 1e-9 or not np.allclose(rotation @ rotation.T, size**2 * np.eye(3), atol=2e-2 * size**2):
        raise AssetError(subject, "has a camera matrix that is no rotation (sheared?)", "Export the cameras again")
    if np.linalg.det(rotation) < 0:
        raise AssetError(subject, "has a camera matrix that mirrors", "Export the cameras in a right-handed system")
    u, _, v = np.linalg.svd(rotation)  # the closest rotation: files often hold few digits
    matrix[:3, :3] = u @ v
    return matrix


def invert(matrix: Array) -> Array:
    """Inverse of a rigid (4, 4) matrix."""
    out = np.eye(4)
    out[:3, :3] = matrix[:3, :3].T
    out[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return out


def turned_by_exif(path: Path) -> bool:
    """Whether viewers show the image file `path`, which can be read, otherwise than its pixels are stored."""
    try:
        image = Image.open(path)
    except UnidentifiedImageError:  # TIFF with floats, which is turned when it is read
        return False
    with image:
        try:
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        except Exception:  # damaged metadata raise almost anything; the pixels are sound
            return False
    return orientation in range(2, 9)


def find_picture(stem: Path) -> Path | None:
    """The image file `stem`, with its extension or without; None where there is none."""
    # Not Path.is_file, which raises where a name is too long.
    if stem.suffix and os.path.isfile(stem):
        return stem
    ends = (*PICTURES, EXR)
    return next((found for end in ends if os.path.isfile(found := stem.with_name(stem.name + end))), None)


def load_picture(path: Path) -> tuple[Array, list[str]]:
    """((h, w, c) pixels of a photograph, notes): whole numbers are sRGB-encoded, floats linear. Raises AssetError.

    Alpha is straight, as in PNG.
    """
    if path.suffix.lower() != EXR:
        return load_image(path), []
    pixels, _, notes = read_exr(path, alpha=True)
    if pixels.shape[2] == 4:
        cover = np.clip(pixels[..., 3:], 0, 1)
        pixels = np.concatenate([pixels[..., :3] / np.where(cover > 0, cover, 1), cover], axis=2)
    return pixels, notes


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) of a photograph, from its header. Raises AssetError."""
    return exr_size(path) if path.suffix.lower() == EXR else image_size(path)


def find_mask(folder: Path, image: Path, relative: str = "") -> Path | None:
    """The mask of `image` in `folder`: the same name, the same stem, or COLMAP's NAME.png."""
    if not folder.is_dir():
        return None
    name = Path(relative or image.name)
    candidates = [folder / name, folder / f"{name}.png", *(folder / name.with_suffix(end) for end in PICTURES)]
    return next((found for found in candidates if os.path.isfile(found)), None)


def complain_of_missing(subject: str, missing: list[str], total: int) -> None:
    """Raise AssetError where photographs are absent."""
    if missing:
        named = first_of([name[:200] for name in missing])
        problem = f"names {len(missing)} of {total} images that are not there: {named}"
        raise AssetError(subject, problem, "Put the images back, or take their frames out of the file")
