"""Working copies of pictures: small, upright, 8-bit, with masks, looks and markers found on the way."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from ..core.arrays import Array
from ..core.errors import AssetError, Cancelled, DeviceError, first_of
from ..formats.images import write_image
from ..reconstruct.readers.layout import decode_mask
from .features import Photo, Tell, mask_file
from .inspection import Look, look
from .left_out import Cause, Reason
from .marker_sheet import detect
from .pictures import EmptyMask, Picture, decode, mask_of_alpha, reduced, shown

logger = logging.getLogger(__name__)

#: Part of a picture's edges that a mask of an object seldom is at.
_AT_EDGES = 0.9


@dataclass(slots=True)
class Prepared:
    """Working copies of pictures, in the order of the pictures.

    Attributes
    ----------
    pictures : list of Picture
        Those that could be read.
    photos : list of Photo
        Files in `folder`.
    looks : list of Look
    markers : dict of str to dict of int to (4, 2) float64 array
        File -> number -> corners, pixels of the working copy.
    folder : Path
    masks : Path, optional
        Folder of masks as COLMAP names them; None where no picture has one.
    broken : dict of str to Cause
        File name -> why it cannot be used.
    """

    folder: Path
    masks: Path | None = None
    pictures: list[Picture] = field(default_factory=list)
    photos: list[Photo] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)
    markers: dict[str, dict[int, Array]] = field(default_factory=dict)
    broken: dict[str, Cause] = field(default_factory=dict)


def prepare(pictures: Sequence[Picture], work: Path, size: int, seek_markers: bool, tell: Tell,
            cancelled: Callable[[], bool]) -> Prepared:  # fmt: skip
    """Make working copies of pictures, of at most `size` pixels on the longer side; those that are there are kept.

    Parameters
    ----------
    pictures : sequence of Picture
    work : Path
        Folder; `pictures` and `masks` in it are written.
    size : int
    seek_markers : bool
        Also find the markers of sheets, where OpenCV is installed.
    tell, cancelled : callable

    Raises
    ------
    Cancelled
        `cancelled` said so.
    """
    folder, masks = work / "pictures", work / "masks"
    folder.mkdir(parents=True, exist_ok=True)
    masks.mkdir(parents=True, exist_ok=True)
    result = Prepared(folder)
    unmasked, edges = [], []
    files = copy_names([picture.name for picture in pictures])
    for index, (picture, file) in enumerate(zip(pictures, files, strict=True)):
        if cancelled():
            raise Cancelled
        tell("reading pictures", index / len(pictures))
        try:
            small, mask = _small(picture, folder / file, mask_file(masks, file), size)
        except AssetError as error:
            reason = Reason.EMPTY_MASK if isinstance(error, EmptyMask) else Reason.UNREADABLE
            result.broken[picture.path.name] = Cause(reason, error.problem)
            logger.warning("%s", error)
            continue
        height, width = small.shape[:2]
        result.pictures.append(picture)
        result.photos.append(Photo(file, picture.lens, picture.exif.focal, (width, height), picture.path.name))
        result.looks.append(look(small, mask))
        if mask is not None:
            result.masks = masks
            edges.append(np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean() > _AT_EDGES)
        else:
            unmasked.append(picture)
        if seek_markers:
            try:
                result.markers[file] = detect(np.asarray(Pillow.fromarray(small).convert("L")))
            except DeviceError as error:
                logger.warning("marker sheets are not looked for: %s", error)
                seek_markers = False
    _tell_unmasked(result, unmasked)
    if 2 * sum(edges) > len(edges):
        logger.warning(
            "%s: %d of %d masks are white along the edges of their pictures: are they inverted? White is the object, "
            "black is left out", pictures[0].path.parent, sum(edges), len(edges),
        )  # fmt: skip
    return result


def copy_names(names: Sequence[str]) -> list[str]:
    """File names of working copies, each another one.

    In COLMAP's lists of pairs a blank ends a name, a line ends a pair, and a line that begins with # says nothing.

    Examples
    --------
    >>> copy_names(["IMG 1", "IMG_1", "#2"])
    ['IMG_1.jpg', 'IMG_1-2.jpg', '_2.jpg']
    """
    found: set[str] = set()
    files = []
    for name in names:
        plain = re.sub(r"[\s#\x00-\x1f\x7f]", "_", name)
        number, file = 1, f"{plain}.jpg"
        while file.lower() in found:  # some file systems take both for one
            number += 1
            file = f"{plain}-{number}.jpg"
        found.add(file.lower())
        files.append(file)
    return files


def _tell_unmasked(result: Prepared, unmasked: list[Picture]) -> None:
    """Name pictures without a mask where others have one."""
    of_alpha = len(result.pictures) - len(unmasked) - sum(picture.mask is not None for picture in result.pictures)
    if unmasked and result.masks is not None:
        logger.warning(
            "%s: %d of %d pictures have neither a mask nor an alpha that is one: %s. drgs reconstruct leaves them out "
            "where they are fewer, else it uses no masks. Draw all or none",
            unmasked[0].path.parent, len(unmasked), len(result.pictures), first_of([p.path.name for p in unmasked]),
        )  # fmt: skip
    if of_alpha:
        logger.info("the alpha of %d pictures is their mask", of_alpha)


def _small(picture: Picture, copy: Path, mask_copy: Path, size: int) -> tuple[Array, Array | None]:
    """((h, w, 3) uint8, (h, w) bool mask or None) of a picture, from its working copies where they are there."""
    if not copy.is_file():
        pixels = decode(picture)
        colour = reduced(shown(pixels), size)
        mask = mask_of_alpha(pixels, str(picture.path)) if picture.mask is None else decode_mask(picture.mask)
        if picture.mask is not None and mask is not None and not mask.max() > 0.5:
            remedy = "Draw it white on the object, leave the picture out, or give --masks none"
            raise EmptyMask(str(picture.mask), "is black all over: nothing of it is the object", remedy)
        if mask is not None:
            drawn = Pillow.fromarray(np.asarray(mask > 0.5).astype(np.uint8) * 255)
            drawn = drawn.resize((colour.shape[1], colour.shape[0]), Pillow.Resampling.NEAREST)
            write_image(mask_copy, drawn)
        write_image(copy, Pillow.fromarray(colour), "JPEG", quality=95, subsampling=0)
    with Pillow.open(copy) as image:
        small = np.asarray(image.convert("RGB"))
    if not mask_copy.is_file():
        return small, None
    with Pillow.open(mask_copy) as image:
        return small, np.asarray(image.convert("L")) > 127
