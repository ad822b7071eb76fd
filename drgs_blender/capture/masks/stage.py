"""The stage of the front end that makes masks of the object, or checks those that are given."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from ...core.arrays import Array
from ...core.errors import AssetError, DeviceError, first_of
from ...formats.images import write_image
from .. import libraries
from ..features import Tell, mask_file
from ..pictures import Picture
from ..registration import Registration
from ..world_alignment import GUESSED, LOWEST
from .contact_sheet import draw_contact_sheet
from .hull import VOXELS
from .hull_check import Fit, check_masks
from .mask_view import MaskView
from .segmentation_model import load_model, masks_by_model, model_file
from .settling import REMEDY, hull_of_masks, resized, whole

logger = logging.getLogger(__name__)

#: given: masks that are there are used; auto: where no picture has one they are made; none: neither. Any other mode is
#: a segmentation model, by which they are made.
MODES = ("given", "auto", "none")
CONTACT_SHEET = "masks.png"
ABOVE_LOWEST = (
    "Masks are made above the lowest points: they may hold parts of what the object stands on, or lack its foot. Look "
    "at {}"
)
ONLY_SOME = "%s: %d of %d pictures have masks: no others are made. Draw all, or remove these"
MODEL_UNUSED = "%s: has masks, or a background of one colour: %s is not used. Remove the masks to use it"


@dataclass(slots=True)
class Masked:
    """Masks that were made or checked: figures per view, lines for the report."""

    fits: list[Fit] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)


def check_mode(mode: str) -> None:
    """Raise an error where `mode` is neither one of `MODES` nor a model that can be loaded, or a library is absent."""
    if mode in ("given", "none"):
        return
    if mode not in MODES:
        model_file(mode, MODES)
    libraries.load("opencv")
    if mode == "auto":
        libraries.load("torch")
    else:
        load_model(mode)


def mode_on_ground(mode: str, given: Path | None, ground: str) -> tuple[str, str]:
    """`mode`, or "none" where masks would be made on a ground that is nothing but the cameras' guess; what to tell.

    Parameters
    ----------
    mode : str
        One of `MODES`.
    given : Path, optional
        Folder of given masks.
    ground : str
        What the ground rests on, `Alignment.ground_from`.

    Returns
    -------
    mode : str
    said : str
        What a guessed ground means for masks that are made; empty: nothing.
    """
    if mode != "auto" or given is not None:
        return mode, ""
    if ground == GUESSED:
        return "none", f"No masks are made. {REMEDY}"
    return mode, ABOVE_LOWEST.format(CONTACT_SHEET) if ground == LOWEST else ""


def make_or_check(mode: str, found: Registration, by_file: dict[str, Picture], copies: Path, work: Path, sheet: Path,
                  given: Path | None, subject: str, tell: Tell, cancelled: Callable[[], bool]) -> Masked:  # fmt: skip
    """Make masks where there are none, or check those that are given.

    `Picture.mask` and `Picture.mask_band` are set to what is made.

    Parameters
    ----------
    mode : str
        One of `MODES`, or a segmentation model.
    found : Registration
        Z up, ground at 0.
    by_file : dict of str to Picture
        Working copy -> picture.
    copies : Path
        Folder of working copies.
    work : Path
        Folder to write masks into.
    sheet : Path
        Contact sheet to write.
    given : Path, optional
        Folder of given masks as ``FILE.png``, of the working copies' size.
    subject : str
        For messages.
    tell, cancelled : callable

    Raises
    ------
    AssetError
        A given mask does not fit the others, or a model makes no masks.
    DeviceError
        Masks are to be made, and a library is absent, see `check_mode`.
    Cancelled
        `cancelled` said so.
    """
    sheet.unlink(missing_ok=True)
    if mode == "none" or (mode == "given" and given is None):
        return Masked()
    try:
        cv2: Any = libraries.load("opencv")
    except DeviceError as error:
        if given is None:
            raise
        logger.warning("%s: masks are not checked: %s", subject, error)
        return Masked()
    files = sorted(found.matrices)
    views = [_view(file, by_file[file], found, copies) for file in files]
    if given is not None:
        there = sum(mask_file(given, file).is_file() for file in files)
        if mode != "given" and there < len(files):
            logger.warning(ONLY_SOME, subject, there, len(files))
        elif mode not in MODES:
            logger.warning(MODEL_UNUSED, subject, mode)
        return _check_given(cv2, views, files, given, sheet, subject)
    pictures = [by_file[file] for file in files]
    drawn: Iterable[Array] | None
    if mode in MODES:
        drawn, fits = _learned(cv2, views, pictures, sheet, found, subject, tell, cancelled)
    else:
        drawn, fits = masks_by_model(load_model(mode), cv2, views, sheet, subject, tell, cancelled)
    if drawn is None:
        return Masked(fits, ["masks: none, those that were made do not fit each other" if fits else
                             "masks: none could be made"])  # fmt: skip
    work.mkdir(parents=True, exist_ok=True)
    for file, picture, mask in zip(files, pictures, drawn, strict=True):
        picture.mask = work / f"{file}.png"
        large = Pillow.fromarray(mask).resize(picture.size, Pillow.Resampling.BILINEAR)
        write_image(picture.mask, large)
    doubtful = [str(fit) for fit in fits if fit.doubtful and not fit.wrong]
    lines = [f"masks: made for {len(views)} pictures; look at {sheet.name}"]
    return Masked(fits, lines + _doubts(doubtful, subject, sheet))


def _view(file: str, picture: Picture, found: Registration, copies: Path) -> MaskView:
    with Pillow.open(copies / file) as image:
        pixels = np.asarray(image.convert("RGB"))
    lens = found.lenses[file].scaled(pixels.shape[1], pixels.shape[0])
    return MaskView(picture.path.name, pixels, found.matrices[file], lens, picture.behind)


def _learned(cv2: Any, views: list[MaskView], pictures: list[Picture], sheet: Path, found: Registration, subject: str,
             tell: Tell, cancelled: Callable[[], bool]) -> tuple[Iterator[Array] | None, list[Fit]]:  # fmt: skip
    """Masks of the learned object, drawn one by one, as those of many photographs are large.

    None, with a warning, where no object is found or they do not fit together.
    """
    from .making import make_masks  # with torch

    made, fits = make_masks(cv2, views, found.points, sheet, subject, tell, cancelled)
    if made is None:
        return None, fits
    for k, (view, picture) in enumerate(zip(views, pictures, strict=True)):
        picture.mask_band = made.band(k) * max(1.0, max(picture.size) / max(view.shape))
    return (made.whole(k, view.shape, pictures[k].size) for k, view in enumerate(views)), fits


def _doubts(doubtful: list[str], subject: str, sheet: Path) -> list[str]:
    if not doubtful:
        return []
    logger.warning("%s: %d masks are doubtful: %s. Look at %s", subject, len(doubtful), first_of(doubtful), sheet.name)
    return [f"doubtful masks: {first_of(doubtful)}"]


def _check_given(cv2: Any, views: list[MaskView], files: list[str], given: Path, sheet: Path,
                 subject: str) -> Masked:  # fmt: skip
    """Figures of given masks; AssetError where one cuts the object."""
    parts, masks = [], []
    for file, view in zip(files, views, strict=True):
        path = mask_file(given, file)
        if not path.is_file():
            continue
        small = whole(view)
        with Pillow.open(path) as image:
            masks.append(resized(np.asarray(image.convert("L")), small))
        parts.append(small)
    if len(parts) < 4:
        logger.warning("%s: only %d masks are there: they cannot be checked", subject, len(parts))
        return Masked()
    fits = check_given(cv2, parts, masks)
    if not fits:
        logger.warning("%s: the masks have no part of the space in common: they are not checked", subject)
        return Masked()
    draw_contact_sheet(sheet, parts, masks, fits)
    wrong = [str(fit) for fit in fits if fit.wrong]
    if wrong and 4 * len(wrong) <= len(fits):  # more than that: the hull is no judge
        raise AssetError(
            subject, f"has masks that do not fit the others: {first_of(wrong)}",
            f"Look at {sheet}; draw these masks again, or remove these pictures, or give --masks none",
        )  # fmt: skip
    doubtful = [str(fit) for fit in fits if fit.doubtful]
    return Masked(fits, [f"masks: {len(fits)} given ones fit each other", *_doubts(doubtful, subject, sheet)])


def check_given(cv2: Any, views: list[MaskView], masks: list[Array], voxels: int = VOXELS) -> list[Fit]:
    """Figures of masks against each other; none where they have no hull.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : list of MaskView
    masks : list of (h, w) bool arrays
    voxels : int
        Of the hull, along its longest side.
    """
    hull = hull_of_masks(cv2, views, masks, voxels)
    return [] if hull is None else check_masks(cv2, views, masks, hull)
