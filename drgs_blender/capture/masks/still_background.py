"""What stands still behind an object that was turned before a camera: its picture, and where something turned.

Pictures are laid over each other by features of their rims, so that the camera may have been held by hand. A pixel
turned where many pictures differ from their median; behind it is the value that most pictures agree on, as far as the
background is seen past the object in some of them, else what is around.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow
from scipy.ndimage import binary_fill_holes, binary_propagation, label

from ...core.arrays import Array
from ...core.errors import Cancelled
from ...formats.images import write_image
from ..features import Photo, Tell, mask_file
from .ground_picture import exposure_gain

#: Pixels of the longer side at which pictures are compared.
SIDE = 560
#: Part of a picture's side, from each edge, whose features say how the camera moved; fewest that agree, and how well.
_RIM, _FEWEST, _PIXELS = 0.25, 10, 2.0
#: Best match of a feature, in parts of the second best.
_RATIO = 0.75
#: Part of the pictures that a turned pixel differs in, and that must agree on what is behind one.
_DIFFERENT, _AGREED = 0.15, 0.3
#: Least difference (of 255), and in parts of that of the rims.
_FLOOR, _NOISES = 10.0, 3.0
#: Steps of what is behind, of 255 a pixel, at which the object is taken to begin: the larger of this and the quantile
#: of the background around.
_EDGE, _TEXTURE = 6.0, 0.9
#: Part of a neighbourhood that has such steps where it is a pattern.
_PATTERN = 0.4
#: Parts of what turned that are smaller than this part of the largest are passers-by.
_SMALL = 0.05
#: Half width of notches that are filled, in parts of the longer side: highlights at the object's rim stand still, too.
_NOTCH = 0.04
#: Pixels that the object in a picture is made wider by.
_MARGIN = 2
#: Difference from the background at the rims (of 255) above which a picture does not fit the others.
_UNFIT = 20.0
#: From there on a channel (of 255) may be clipped, and says nothing of exposure.
_WHITE = 250
#: In place of values of pixels that a picture does not show.
_NOTHING = 32767


@dataclass(slots=True)
class StillBackground:
    """What stood still in pictures, and where something turned, small.

    Attributes
    ----------
    behind : dict of str to (h, w, 3) uint8 array
        File -> what it would show without the object, sRGB.
    turned : dict of str to (h, w) bool array
        File -> where the object is, roughly, or what turned with it; texture that is like the background is missing.
    """

    behind: dict[str, Array] = field(default_factory=dict)
    turned: dict[str, Array] = field(default_factory=dict)


def find_still_background(cv2: Any, pictures: Mapping[str, Array], tell: Tell,
                          cancelled: Callable[[], bool]) -> StillBackground | None:  # fmt: skip
    """What stands still in pictures of an object that was turned; None where nothing turned, or all did.

    Pictures that do not fit the others have no entry.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    pictures : mapping of str to (h, w, 3) uint8 array
        Of one size, `SIDE` pixels on the longer side.
    tell, cancelled : callable

    Raises
    ------
    Cancelled
        `cancelled` said so.
    """
    files = list(pictures)
    to_reference = _moves(cv2, [pictures[file] for file in files], tell, cancelled)
    stack = np.stack([_laid(cv2, pictures[file], move) for file, move in zip(files, to_reference, strict=True)])
    rim = _rim(stack.shape[1:3])
    gains = _gains(stack, rim)
    _brighten(stack, gains)
    found = _sorted(stack)
    median = _median(*found)
    away = np.array([np.median(np.abs(one - median)[rim & (one[..., 0] >= 0)]) for one in stack])
    fit = away < _UNFIT
    if fit.sum() < _FEWEST:
        return None
    if not fit.all():
        stack = stack[fit]
        found = _sorted(stack)
        median = _median(*found)
    places = _turned(cv2, stack, median, rim)
    if places is None:
        return None
    tell("finding what turned", 0.9)
    turned, enclosed, least = places
    behind = _behind(cv2, *found, turned, enclosed)
    result = StillBackground()
    height, width = turned.shape
    for index, inside in zip(np.flatnonzero(fit), _objects(cv2, stack, behind, turned, least), strict=True):
        move, flags = to_reference[index], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        own = cv2.warpAffine(behind, move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        result.behind[files[index]] = np.clip(own / gains[index], 0, 255).round().astype(np.uint8)
        result.turned[files[index]] = cv2.warpAffine(inside, move, (width, height), flags=flags) > 0
    return result


def small_copies(copies: Path, photos: Sequence[Photo]) -> dict[str, Array]:
    """Working copies, (h, w, 3) uint8, `SIDE` pixels on the longer side: those of the size that most have."""
    size = Counter(photo.size for photo in photos).most_common(1)[0][0]
    factor = min(1.0, SIDE / max(size))
    small = max(1, round(factor * size[0])), max(1, round(factor * size[1]))
    found = {}
    for photo in photos:
        if photo.size == size:
            with Pillow.open(copies / photo.file) as image:
                found[photo.file] = np.asarray(image.convert("RGB").resize(small, Pillow.Resampling.BOX))
    return found


def write_turned(found: StillBackground, folder: Path, photos: Sequence[Photo]) -> Path:
    """`folder`, with where something turned in each picture as COLMAP's masks; black those that do not fit."""
    folder.mkdir(parents=True, exist_ok=True)
    for photo in photos:
        turned = found.turned.get(photo.file, np.zeros((1, 1), bool))
        mask = Pillow.fromarray(turned.astype(np.uint8) * 255).resize(photo.size, Pillow.Resampling.NEAREST)
        write_image(mask_file(folder, photo.file), mask)
    return folder


def _rim(shape: tuple[int, int]) -> Array:
    """(h, w) bool: where surroundings are."""
    found = np.ones(shape, bool)
    rows, columns = (max(2, round(_RIM * side)) for side in shape)
    found[rows:-rows, columns:-columns] = False
    return found


def _moves(cv2: Any, pictures: list[Array], tell: Tell, cancelled: Callable[[], bool]) -> list[Array]:
    """(2, 3) each: how a picture is turned, scaled and shifted to lie on the one in the middle of their order.

    A picture of whose rim too little is found moves as the one before it.
    """
    sift, matcher = cv2.SIFT_create(1500), cv2.BFMatcher()
    found = []
    for index, picture in enumerate(pictures):
        if cancelled():
            raise Cancelled
        tell("finding what turned", 0.8 * index / len(pictures))
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        found.append(sift.detectAndCompute(grey, _rim(grey.shape).astype(np.uint8)))
    points, descriptors = found[len(found) // 2]
    moves: list[Array] = []
    for own_points, own in found:
        move = None
        if own is not None and descriptors is not None and min(len(own), len(descriptors)) > _FEWEST:
            pairs = [a for a, b in matcher.knnMatch(own, descriptors, k=2) if a.distance < _RATIO * b.distance]
            if len(pairs) >= _FEWEST:
                start = np.array([own_points[pair.queryIdx].pt for pair in pairs], np.float32)
                end = np.array([points[pair.trainIdx].pt for pair in pairs], np.float32)
                move, agree = cv2.estimateAffinePartial2D(start, end, ransacReprojThreshold=_PIXELS)
                if move is not None and agree.sum() < _FEWEST:
                    move = None
        moves.append(move if move is not None else moves[-1] if moves else np.eye(2, 3))
    return moves


def _laid(cv2: Any, picture: Array, move: Array) -> Array:
    """(h, w, 3) int16 of a picture laid on the reference; -1 where it shows nothing."""
    height, width = picture.shape[:2]
    laid = cv2.warpAffine(picture, move, (width, height), flags=cv2.INTER_LINEAR).astype(np.int16)
    shown = cv2.warpAffine(np.full((height, width), 255, np.uint8), move, (width, height))
    laid[shown < 255] = -1
    return laid


def _gains(stack: Array, rim: Array) -> Array:
    """(n, 3) by which the exposure of pictures differs from the median, by their rims."""
    median = _median(*_sorted(stack))
    return np.stack([exposure_gain(one, median, rim & (one.max(axis=-1) < _WHITE)) for one in stack])


def _brighten(stack: Array, gains: Array) -> None:
    for one, gain in zip(stack, gains, strict=True):
        seen = one[..., 0] >= 0
        one[seen] = np.clip(one[seen] * gain, 0, 255).round()


def _sorted(stack: Array) -> tuple[Array, Array]:
    """Values of each pixel in their order, those that are not there last, and (h, w) how many there are."""
    order = np.sort(np.where(stack < 0, _NOTHING, stack).astype(np.int16), axis=0)
    return order, (stack[..., 0] >= 0).sum(axis=0)


def _at(order: Array, index: Array) -> Array:
    """The `index`-th (h, w) value of each pixel of what is sorted along the first axis."""
    index = index.reshape(1, *index.shape, *(1,) * (order.ndim - 1 - index.ndim))
    return np.take_along_axis(order, np.broadcast_to(index, (1, *order.shape[1:])), axis=0)[0]


def _median(order: Array, count: Array) -> Array:
    """(h, w, 3) float32 of pictures that `_sorted` has sorted."""
    return _at(order, np.maximum(count - 1, 0) // 2).astype(np.float32)


def _turned(cv2: Any, stack: Array, median: Array, rim: Array) -> tuple[Array, Array, float] | None:
    """(h, w) bool: where many pictures differ from the `median`, with what that encloses; of it the enclosed part.

    Third, the least difference that counts. None where it is nowhere, or nearly all.
    """
    off = _differences(cv2, stack, median)
    order = np.sort(np.where(off < 0, _NOTHING, off), axis=0)
    count = (off >= 0).sum(axis=0)
    away = _at(order, np.maximum(np.floor((1 - _DIFFERENT) * count).astype(int) - 1, 0))
    away = np.where(count * 2 >= len(stack), away, 0).astype(np.float32)
    least = max(_FLOOR, _NOISES * float(np.median(away[rim])))
    differs = _without_gaps(cv2, away > least)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(_NOTCH * max(rim.shape)) + 1,) * 2)
    padded = np.pad(differs.astype(np.uint8), len(around))  # or what lies at an edge of the picture would be cut
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, around)[len(around) : -len(around), len(around) : -len(around)]
    found = binary_fill_holes(closed)
    parts, number = label(found)
    if not number:
        return None
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    found = (sizes >= _SMALL * sizes.max())[parts]
    return (found, found & ~differs, least) if found.mean() < 0.9 else None


def _without_gaps(cv2: Any, differs: Array) -> Array:
    """(h, w) bool: pixels that differ, without specks, and with the gaps between them."""
    found = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)) > 0


def _differences(cv2: Any, stack: Array, background: Array) -> Array:
    """(n, h, w) int16: how far pictures are from a background whose edges may lie a pixel off; -1: they show none."""
    box = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(background, box), cv2.dilate(background, box)
    off = np.full(stack.shape[:3], -1, np.int16)
    for one, away in zip(stack, off, strict=True):
        seen = one[..., 0] >= 0
        away[seen] = np.maximum(one - high, low - one).max(axis=-1).clip(0)[seen].astype(np.int16)
    return off


def _objects(cv2: Any, stack: Array, behind: Array, turned: Array, least: float) -> list[Array]:
    """(h, w) uint8 each: what of a picture is not the background, with what it encloses and a margin."""
    found = []
    for off in _differences(cv2, stack, behind):
        own = binary_fill_holes(_without_gaps(cv2, (off > least) & turned))
        found.append(cv2.dilate(own.astype(np.uint8), np.ones((2 * _MARGIN + 1,) * 2, np.uint8)))
    return found


def _behind(cv2: Any, order: Array, count: Array, turned: Array, enclosed: Array) -> Array:
    """(h, w, 3) float32: the background of pictures that `_sorted` has sorted, also where something `turned`.

    There, the values that `_AGREED` of the pictures agree on best, where these go on from the background around, or are
    a pattern, as none that turns stays the same; else what is around. What is `enclosed` by what turned is never seen
    past it, but for a pattern.
    """
    most = max(2, int(np.ceil(_AGREED * len(order))))
    widths = order[most - 1 :].astype(np.int32) - order[: 1 - most]
    widths[order[most - 1 :] == _NOTHING] = _NOTHING
    first = widths.argmin(axis=0)[None]
    width = np.take_along_axis(widths, first, axis=0)[0].max(axis=-1)
    ends = (np.take_along_axis(order, first + more, axis=0)[0].astype(np.float32) for more in (0, most - 1))
    middle = _median(order, count)
    behind = np.clip(np.where((count < most)[..., None], middle, sum(ends) / 2), 0, 255).astype(np.float32)
    steady = width <= max(_FLOOR, _NOISES * float(np.median(width[~turned])))
    smooth = cv2.GaussianBlur(behind, (0, 0), 1.0)
    slope = np.hypot(*(cv2.Sobel(smooth, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))).max(axis=-1)
    edge = max(_EDGE, float(np.quantile(slope[~turned], _TEXTURE)))
    passable = ~turned | (steady & ~enclosed & (slope < edge))
    known = binary_propagation(~turned, mask=passable) | _patterned(cv2, steady & turned, slope)
    hidden = cv2.dilate((~known).astype(np.uint8), np.ones((5, 5), np.uint8)) & turned.astype(np.uint8)
    hidden |= (count == 0).astype(np.uint8)
    return cv2.inpaint(behind.round().astype(np.uint8), hidden, 4, cv2.INPAINT_TELEA).astype(np.float32)


def _patterned(cv2: Any, steady: Array, slope: Array) -> Array:
    """(h, w) bool: what is `steady` amid steps that are everywhere, not in lines as at an object's outline."""
    side = 2 * round(_NOTCH * max(slope.shape) / 2) + 1
    steps = cv2.boxFilter((steady & (slope > _EDGE)).astype(np.float32), -1, (side, side))
    return steady & (steps > _PATTERN)
