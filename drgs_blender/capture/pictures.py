"""Pictures of a folder: found with their masks, decoded to upright sRGB, written as a capture's."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image as Pillow
from PIL import UnidentifiedImageError

from ..core.arrays import Array
from ..core.asset.archive import replace_by
from ..core.color import linear_to_srgb, to_unit
from ..core.errors import AssetError, first_of
from ..core.file_types import VIDEOS
from ..formats.exr import write_exr_picture
from ..formats.images import write_image, write_png
from ..reconstruct.readers.layout import PICTURES, decode_mask, find_mask, load_picture
from . import libraries
from .camera_raw import RAW, decode_raw, read_raw_metadata
from .exif import Metadata, read_exif, read_exr_metadata

logger = logging.getLogger(__name__)

#: Extensions, lower case.
PHOTOGRAPHS = frozenset(end.lower() for end in PICTURES)
LINEAR = frozenset((".exr",))
_TIFF = frozenset((".tif", ".tiff"))
#: Of other programs' photographs: named, not read.
UNREAD = frozenset((".heic", ".heif", ".avif", ".hdr", ".jxl"))
#: Where the photographs of a folder are, the first that has some.
FOLDERS = ("images", "photos", "input", ".")
#: Where their masks are.
MASKS = "masks"
_QUALITY = 97
#: Pixels of the shorter side of a picture, at least.
_SMALLEST = 4
#: Bytes of a picture's name without its extension, at most; file systems take 255 in all.
_LONGEST = 200
#: Part of the pixels that may be brighter than white and are written as white.
_SPECKS = 1e-5
#: EXIF orientation -> (quarter turns counter-clockwise, mirrored left to right afterwards); EXIF 2.3 figure 19.
_TURNS = {1: (0, 0), 2: (0, 1), 3: (2, 0), 4: (2, 1), 5: (3, 1), 6: (3, 0), 7: (1, 1), 8: (1, 0)}


@dataclass(slots=True)
class Picture:
    """One photograph of the input.

    Attributes
    ----------
    path : Path
        File.
    name : str
        Stem, unique in the input.
    mask : Path, optional
        File of its mask.
    mask_band : float
        See `reconstruct.capture.View`; pixels of `size`.
    exif : Metadata
    size : tuple of int
        Width and height, pixels, upright.
    notes : list of str
        What is unusual about it, for the report.
    alpha : bool
        Whether its alpha says what is the object; else it is left out.
    merged : tuple of str
        Names of the files of the exposure bracket that it was merged from; it is EXR then, and stays EXR.
    behind : (h, w, 3) uint8 array, optional
        What it would show without the object, small, where that is known.
    """

    path: Path
    name: str
    mask: Path | None = None
    exif: Metadata = field(default_factory=Metadata)
    size: tuple[int, int] = (0, 0)
    notes: list[str] = field(default_factory=list)
    alpha: bool = True
    merged: tuple[str, ...] = ()
    behind: Array | None = None
    mask_band: float = 0.0

    @property
    def lens(self) -> tuple[int, int, str]:
        """Pictures with equal values share one lens: size and camera."""
        return (*self.size, self.exif.camera)


def natural(name: str) -> list[tuple[int, str]]:
    """Sorting key by which r_2 comes before r_10."""
    return [(int(part or -1), text) for text, part in re.findall(r"(\D*)(\d*)", name)]


def find_video(source: Path) -> Path | None:
    """The video that is `source`, or the only one in that folder where it has no photographs."""
    if source.is_file():
        return source if source.suffix.lower() in VIDEOS else None
    if not source.is_dir() or _photographs(source):
        return None
    videos = [path for path in sorted(source.iterdir()) if path.suffix.lower() in VIDEOS]
    if len(videos) > 1:
        raise AssetError(str(source), f"has {len(videos)} videos ({first_of([v.name for v in videos])})", "Give one")
    return videos[0] if videos else None


def has_pictures(source: Path) -> bool:
    """Whether there are photographs, or a video, without cameras at `source`."""
    try:
        return bool(_photographs(source)) or find_video(source) is not None
    except (OSError, AssetError):
        return False


def check_pictures(source: Path) -> None:
    """Say of what has neither cameras nor pictures what is expected. Raises AssetError; not of what is not there."""
    more = "a video, or photographs with their cameras, as COLMAP and nerfstudio write them"
    expected = f"Give a folder with photographs in it or in its {', '.join(FOLDERS[:-2])} or {FOLDERS[-2]}, {more}"
    problem = "is neither a folder of photographs nor a video" if source.is_file() else "holds no pictures"
    if os.access(source, os.R_OK):
        raise AssetError(str(source), problem, expected)


def _photographs(source: Path) -> list[Path]:
    """The photographs of a folder, of the first of `FOLDERS` that has some, in the order of their names."""
    if not source.is_dir():
        return []
    for folder in (source / name for name in FOLDERS):
        if folder.is_dir():
            files = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
            found = [p for p in files if p.suffix.lower() in PHOTOGRAPHS | RAW | LINEAR]
            if found:
                return sorted(found, key=lambda path: natural(path.name))
    return []


def find_pictures(source: Path) -> list[Picture]:
    """The photographs of a folder (or of its `images`) with their masks (of `masks`).

    Raises
    ------
    AssetError
        There are none, or masks have another shape than their photographs.
    """
    paths = _photographs(source)
    if source.is_file():
        problem = f"is neither a folder of photographs nor a video ({', '.join(sorted(VIDEOS))})"
        raise AssetError(str(source), problem, "Give the folder of the photographs")
    if not paths:
        raise AssetError(
            str(source), "has no photographs", f"Known are {', '.join(sorted(PHOTOGRAPHS | LINEAR | RAW))}"
        )
    unread = [p.name for p in sorted(paths[0].parent.iterdir()) if p.suffix.lower() in UNREAD]
    if unread:
        logger.warning(
            "%s: %d files cannot be read and are left out: %s. Convert them to JPEG, PNG, TIFF or EXR",
            source, len(unread), first_of(unread),
        )  # fmt: skip
    raw = [path.name for path in paths if path.suffix.lower() in RAW]
    beside = {path.stem for path in paths if path.suffix.lower() not in RAW}
    paths = [path for path in paths if path.suffix.lower() not in RAW or path.stem not in beside]
    if raw and not libraries.is_there("rawpy"):
        logger.warning(
            "%s: %d camera raw files are left out%s: %s. Reading them needs rawpy (pip install rawpy)",
            source, len(raw), " where no developed picture is beside them" if beside else "", first_of(raw),
        )  # fmt: skip
        paths = [path for path in paths if path.suffix.lower() not in RAW]
    root = paths[0].parent.parent if paths and paths[0].parent.name in FOLDERS else source
    pictures, broken, names = [], [], set[str]()
    for path in paths:
        name = _name(path, names)
        names.add(name)
        mask = find_mask(root / MASKS, path) or find_mask(source / MASKS, path)
        try:
            picture = _described(Picture(path, name, mask))
            if min(picture.size) < _SMALLEST:
                raise AssetError(str(path), "is {} x {} pixels, too small".format(*picture.size))
            pictures.append(picture)
        except AssetError as error:
            broken.append(f"{path.name} ({error.problem})")
    if broken:
        if 2 * len(broken) > len(paths):
            raise AssetError(
                str(source), f"has {len(broken)} of {len(paths)} pictures that cannot be read: {first_of(broken)}"
            )
        logger.warning("%s: %d pictures cannot be read and are left out: %s", source, len(broken), first_of(broken))
    if noted := [picture for picture in pictures if picture.notes]:
        logger.warning(
            "%s: %d pictures are not used as they are stored, the first is %s: %s",
            source, len(noted), noted[0].path.name, "; ".join(noted[0].notes),
        )  # fmt: skip
    for masks in {root / MASKS, source / MASKS}:
        _tell_masks_alone(masks, paths[0].parent)
    _check_masks(pictures)
    return pictures


def _tell_masks_alone(masks: Path, folder: Path) -> None:
    """Name masks that belong to none of the files of a folder of pictures."""
    if not masks.is_dir():
        return
    known = {name for path in folder.iterdir() for name in (path.name, path.stem)}
    files = [path for path in masks.iterdir() if path.suffix.lower() in PHOTOGRAPHS and not path.name.startswith(".")]
    if alone := sorted(path.name for path in files if not {path.name, path.stem} & known):
        logger.warning(
            "%s: %d of %d masks belong to no picture in %s: %s. Name each as its picture",
            masks, len(alone), len(files), folder, first_of(alone),
        )  # fmt: skip


def _name(path: Path, taken: Collection[str]) -> str:
    """A name for a picture that is not `taken`: its stem, in UTF-8 and so short that more can be added to it."""
    stem = path.stem if path.stem not in taken else path.name.replace(".", "_")
    short = name = re.sub("[\ud800-\udfff]", "_", stem).encode()[:_LONGEST].decode(errors="ignore")
    number = 1
    while name in taken:
        number += 1
        name = f"{short}-{number}"
    return name


def _described(picture: Picture) -> Picture:
    """The picture with its metadata and size, from the header alone where that has them."""
    suffix = picture.path.suffix.lower()
    if suffix in LINEAR:
        pixels, picture.notes = load_picture(picture.path)
        picture.exif = read_exr_metadata(picture.path)
        picture.size = pixels.shape[1], pixels.shape[0]
        return picture
    if suffix in RAW:
        height, width = decode(picture).shape[:2]
        picture.size = width, height
        picture.exif = read_raw_metadata(picture.path, picture.size)
        return picture
    try:
        with Pillow.open(picture.path) as image:
            picture.exif = read_exif(image)
            width, height = image.size
    except UnidentifiedImageError:  # TIFF with floats
        height, width = decode(picture).shape[:2]
    except (OSError, ValueError, SyntaxError) as error:
        raise AssetError(str(picture.path), f"is no image that can be read ({error})") from error
    if suffix in _TIFF and picture.exif.orientation != 1:
        height, width = _stored(picture).shape[:2]  # versions of Pillow say one or the other
        picture.size = width, height
        return picture
    picture.size = (height, width) if picture.exif.orientation >= 5 else (width, height)
    return picture


def _check_masks(pictures: list[Picture]) -> None:
    """Raise AssetError where a mask has another shape than its photograph."""
    masked = [picture for picture in pictures if picture.mask]
    for picture in masked:
        assert picture.mask is not None
        height, width = decode_mask(picture.mask).shape
        w, h = picture.size
        if abs(width / w - height / h) * max(w, h) > 2:
            turned = abs(width / h - height / w) * max(w, h) <= 2
            problem = f"is {width} x {height} pixels, {picture.path.name} {w} x {h}"
            remedy = "Draw the mask over the turned picture" if turned else "Draw it over the whole photograph"
            raise AssetError(str(picture.mask), problem, remedy)


def decode(picture: Picture) -> Array:
    """(h, w, 3 or 4) uint8, uint16 (sRGB-encoded) or float32 (linear Rec.709), upright, row 0 at the top.

    Alpha is straight, and there only where it counts and is not opaque all over.

    Raises
    ------
    AssetError
        The file cannot be read.
    """
    if picture.path.suffix.lower() in RAW:
        return decode_raw(picture.path)
    pixels = _stored(picture)
    if pixels.shape[2] == 4 and not (picture.alpha and to_unit(pixels[..., 3].min()) < 1):
        pixels = np.ascontiguousarray(pixels[..., :3])
    return pixels


def _stored(picture: Picture) -> Array:
    """Pixels of the file with all its channels, upright."""
    pixels, _ = load_picture(picture.path)
    if picture.path.suffix.lower() in (*LINEAR, *_TIFF):
        return pixels  # Pillow and tifffile turn TIFF when they read it
    return upright(pixels, picture.exif.orientation)


class EmptyMask(AssetError):
    """A mask or an alpha that has nothing of the object."""


def mask_of_alpha(pixels: Array, subject: str) -> Array | None:
    """(h, w) float32 in 0..1: the alpha of `decode`; None without.

    Raises
    ------
    EmptyMask
        It is 0 everywhere.
    """
    if pixels.shape[2] < 4:
        return None
    alpha = np.clip(to_unit(pixels[..., 3]), 0, 1)
    if not alpha.max() > 0:
        remedy = "Take the alpha channel out, draw its mask, or give --masks none"
        raise EmptyMask(subject, "has an alpha that is 0 everywhere: nothing of it is seen", remedy)
    return alpha


def upright(pixels: Array, orientation: int) -> Array:
    """Pixels (h, w, ...) turned as EXIF's `orientation` says."""
    turns, mirrored = _TURNS[orientation]
    pixels = np.rot90(pixels, turns)
    return np.ascontiguousarray(pixels[:, ::-1] if mirrored else pixels)


def shown(pixels: Array) -> Array:
    """(h, w, 3) uint8 sRGB of `decode`: floats are clipped at white, alpha is laid on black."""
    if pixels.dtype.kind == "f":
        colour = linear_to_srgb(np.clip(pixels[..., :3], 0, 1))
    else:
        colour = to_unit(pixels[..., :3])
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:]
        colour = colour * (to_unit(alpha) if alpha.dtype.kind == "u" else np.clip(alpha, 0, 1))
    return np.asarray(colour * 255 + 0.5, np.uint8)


def reduced(pixels: Array, longest: int) -> Array:
    """(h, w, 3) uint8 at most `longest` pixels on the longer side, by area."""
    height, width = pixels.shape[:2]
    factor = longest / max(width, height)
    if factor >= 1:
        return pixels
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(Pillow.fromarray(pixels).resize(size, Pillow.Resampling.BOX))


def write_picture(picture: Picture, folder: Path) -> Path:
    """Write a photograph into `folder`, upright; the file's path.

    A file that is upright already is copied as it is, and so is one merged from brackets. Others stay JPEG, or become
    PNG, of more than 8 bits TIFF, or EXR where they are brighter than white. An alpha that does not count is left out.
    """
    suffix = picture.path.suffix.lower()
    plain = (suffix in PHOTOGRAPHS and picture.exif.orientation == 1) or bool(picture.merged)
    if plain and (picture.alpha or suffix in (".jpg", ".jpeg") or _stored(picture).shape[2] == 3):
        target = folder / f"{picture.name}{suffix}"
        replace_by(target, lambda path: shutil.copyfile(picture.path, path))
        return target
    pixels = decode(picture)
    if pixels.dtype == np.uint8 and suffix in (".jpg", ".jpeg"):
        target = folder / f"{picture.name}.jpg"
        write_image(target, Pillow.fromarray(pixels), "JPEG", quality=_QUALITY, subsampling=0)
        return target
    if pixels.dtype == np.uint8:
        target = folder / f"{picture.name}.png"
        write_png(target, pixels)
        return target
    if pixels.dtype.kind == "f":
        if float((pixels[..., :3].max(axis=2) > 1).mean()) > _SPECKS:
            target = folder / f"{picture.name}.exr"
            alpha = np.clip(pixels[..., 3:], 0, 1)
            write_exr_picture(target, np.dstack([pixels[..., :3] * alpha, alpha]) if alpha.size else pixels)
            return target
        colour = linear_to_srgb(np.clip(pixels[..., :3], 0, 1))
        pixels = np.asarray(np.dstack([colour, np.clip(pixels[..., 3:], 0, 1)]) * 65535 + 0.5, np.uint16)
    target = folder / f"{picture.name}.tif"
    extra = ["unassalpha"] if pixels.shape[2] == 4 else None
    replace_by(
        target, lambda path: tifffile.imwrite(path, pixels, photometric="rgb", compression="zlib", extrasamples=extra)
    )
    return target


def digest(pictures: list[Picture], *settings: object) -> str:
    """Fingerprint of the inputs: names, sizes and times of pictures and masks, and settings."""
    found = hashlib.sha256(repr(settings).encode())
    for picture in pictures:
        for path in (picture.path, picture.mask):
            if path is not None:
                stat = path.stat()
                found.update(
                    f"{path.resolve()}|{stat.st_size}|{stat.st_mtime_ns}|{picture.name}\n".encode(
                        errors="surrogateescape"
                    )
                )
    return found.hexdigest()
