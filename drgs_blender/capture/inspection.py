"""What is wrong with photographs, said before the long work: blur, duplicates, brackets, exposures, too few."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image as Pillow
from scipy.ndimage import gaussian_filter

from ..core.arrays import Array
from ..core.color import srgb_to_linear
from ..core.errors import AssetError, first_of
from ..reconstruct.capture.capture import Capture
from .left_out import Cause, Reason, lines
from .pictures import Picture, reduced

logger = logging.getLogger(__name__)

#: Fewer pictures give no shape; below the second number a warning says so.
FEWEST, SPARSE = 5, 20
#: Pixels of the longer side at which sharpness is measured: fine enough for blur, coarse enough to leave noise out.
SHARPNESS_SIZE = 640
#: Sharpness below this part of the median is blur. A variance: a third of the contrast of edges. Of sharp pictures of
#: one object from all sides it is .44 or more, of those that moved by 1.5 % of the longer side .07 or less.
_BLURRED = 0.12
#: Stops by which exposures may differ; the same of brightness of whole pictures and inside masks, which differs with
#: what is seen, too: by half a stop and by three.
_STOPS, _BRIGHTNESS = 0.5, (2.0, 3.5)
#: Sides of the reduced picture by which pictures are compared, and its greatest mean difference of equal ones.
_SIGNATURE, _SAME = 32, 0.004
#: Then their details are: pixels of the longer side, of a tile's side; variance of noise and compression; least
#: similarity of a tile. A small object that turned by 3 degrees has .6, a picture that was compressed again .84.
_DETAIL, _TILE, _NOISE, _SIMILAR = 320, 16, 3e-4, 0.8
#: The same after brightness is taken out: frames of one bracket, by correlation.
_BRACKET = 0.995


@dataclass(slots=True)
class Look:
    """What a reduced picture shows of itself.

    Attributes
    ----------
    sharpness : float
        Least variance of second differences over four directions, over the variance of the picture, inside the mask
        where there is one. Motion blurs along its direction alone, defocus along all.
    brightness : float
        Median of the linear luminance, 0..1.
    masked : bool
        Whether these are of the inside of a mask.
    signature : (32, 32) float32 array
        Luminance, sRGB-encoded, 0..1.
    detail : (rows, columns, 256) float32 array
        Its details in tiles of 16 x 16 pixels.
    """

    sharpness: float
    brightness: float
    masked: bool
    signature: Array
    detail: Array


def look(pixels: Array, mask: Array | None = None) -> Look:
    """Measure one picture.

    Parameters
    ----------
    pixels : (h, w, 3) uint8 array
        sRGB.
    mask : (h, w) bool array, optional
        Where the object is.
    """
    pixels = reduced(pixels, SHARPNESS_SIZE)
    grey = (pixels @ np.array([0.2126, 0.7152, 0.0722])) / 255
    height, width = grey.shape
    inside = np.ones(grey.shape, bool)
    if mask is not None:
        drawn = Pillow.fromarray(mask.astype(np.uint8)).resize((width, height), Pillow.Resampling.NEAREST)
        inside = np.asarray(drawn) > 0
    masked = mask is not None and bool(inside.any())
    if not masked:
        inside[:] = True
    sharpness = _along_the_bluntest(grey, inside) / max(float(grey[inside].var()), 1e-6)
    rows = np.linspace(0, height, _SIGNATURE + 1).astype(int)
    columns = np.linspace(0, width, _SIGNATURE + 1).astype(int)
    sums = np.add.reduceat(np.add.reduceat(grey, rows[:-1], axis=0), columns[:-1], axis=1)
    area = np.maximum(np.diff(rows), 1)[:, None] * np.maximum(np.diff(columns), 1)
    brightness = float(np.median(srgb_to_linear(grey[inside])))
    return Look(sharpness, brightness, masked, (sums / area).astype(np.float32), _tiles(grey))


def _along_the_bluntest(grey: Array, inside: Array) -> float:
    """Variance of second differences along rows, columns or diagonals, the least of them."""
    h, w = grey.shape
    middle, found = grey[1 : h - 1, 1 : w - 1], []
    within = inside[1 : h - 1, 1 : w - 1]
    if not within.any():
        within = np.ones_like(within)
    for y, x in ((0, 1), (1, 0), (1, 1), (1, -1)):
        beside = grey[1 + y : h - 1 + y, 1 + x : w - 1 + x] + grey[1 - y : h - 1 - y, 1 - x : w - 1 - x]
        found.append(float((beside - 2 * middle)[within].var()))
    return min(found)


def _tiles(grey: Array) -> Array:
    """(rows, columns, 256) float32: what a picture has of details, in tiles; at least one."""
    factor = _DETAIL / max(grey.shape)
    size = [max(_TILE, round(side * factor)) for side in grey.shape[::-1]]
    small = np.asarray(Pillow.fromarray(grey.astype(np.float32)).resize(size, Pillow.Resampling.BILINEAR))
    small = small - gaussian_filter(small, 2.0)
    h, w = (side // _TILE for side in small.shape)
    tiles = small[: h * _TILE, : w * _TILE].reshape(h, _TILE, w, _TILE).swapaxes(1, 2)
    return np.ascontiguousarray(tiles.reshape(h, w, _TILE * _TILE), np.float32)


def inspect(pictures: Sequence[Picture], looks: Sequence[Look], subject: str) -> tuple[list[Picture], dict[str, Cause]]:
    """Pictures that are fit for use, and why the others are not; warnings name them.

    Returns
    -------
    fit : list of Picture
    left_out : dict of str to Cause
        File name -> cause.

    Raises
    ------
    AssetError
        Fewer than `FEWEST` are fit.
    """
    left_out: dict[str, Cause] = {}
    if pictures:
        _same_or_bracketed(pictures, looks, left_out)
    rest = [(p, one) for p, one in zip(pictures, looks, strict=True) if p.path.name not in left_out]
    for i, part in find_blurred([one for _, one in rest]).items():
        left_out[rest[i][0].path.name] = Cause(Reason.BLURRED, f"sharpness {part:.1%} of the others")
    fit = [picture for picture in pictures if picture.path.name not in left_out]
    for line in lines(left_out):
        logger.warning("%s: of %d pictures left out: %s", subject, len(pictures), line)
    check_count(fit, subject)
    _tell_cameras(fit, subject)
    _tell_exposures(fit, [one for p, one in rest if p.path.name not in left_out], subject)
    return fit, left_out


def check_count(pictures: Sequence[Picture], subject: str) -> None:
    """Raise AssetError for fewer than `FEWEST` pictures; warn of few."""
    if len(pictures) < FEWEST:
        listed = first_of([picture.path.name for picture in pictures])
        problem = f"has {len(pictures)} usable pictures{f' ({listed})' if listed else ''}; shape needs {FEWEST} or more"
        raise AssetError(subject, problem, "Take 30 or more, each sharing most of its view with the next")
    if len(pictures) < SPARSE:
        logger.warning("%s: has %d pictures; 30 or more from all sides give a better shape", subject, len(pictures))


def find_duplicates(looks: Sequence[Look]) -> dict[int, int]:
    """Number of a picture that shows the same as one before it -> number of that one.

    Small objects before a plain backdrop change little of the whole: of pictures that are alike the details are held
    against each other, by their structural similarity (Wang et al. 2004) in the tile where it is least.
    """
    stack = np.stack([one.signature.ravel() for one in looks])
    found: dict[int, int] = {}
    for i, one in enumerate(looks):
        if i in found:
            continue
        for j in np.flatnonzero(np.abs(stack[i + 1 :] - stack[i]).mean(axis=1) < _SAME) + i + 1:
            other = looks[int(j)].detail
            if int(j) not in found and one.detail.shape == other.shape:
                common = 2 * (one.detail * other).mean(axis=2) + _NOISE
                energy = np.square(one.detail).mean(axis=2) + np.square(other).mean(axis=2) + _NOISE
                if (common / energy).min() >= _SIMILAR:
                    found[int(j)] = i
    return found


def _same_or_bracketed(pictures: Sequence[Picture], looks: Sequence[Look], left_out: dict[str, Cause]) -> None:
    """The same picture twice, of which the largest is kept, or one with a mask; of brackets the middle exposure."""
    groups: dict[int, list[int]] = defaultdict(list)
    for copy, first in find_duplicates(looks).items():
        groups[first].append(copy)
    taken = np.zeros(len(pictures), bool)
    for first, copies in groups.items():
        kept = max([first, *copies], key=lambda i: (pictures[i].size[0], pictures[i].mask is not None, -i))
        for j in {first, *copies} - {kept}:
            left_out[pictures[j].path.name] = Cause(Reason.DUPLICATE, pictures[kept].path.name)
        taken[[first, *copies]] = True
    stack = np.stack([one.signature.ravel() for one in looks])
    shape = stack - stack.mean(axis=1, keepdims=True)
    shape /= np.maximum(np.linalg.norm(shape, axis=1, keepdims=True), 1e-6)
    for i, picture in enumerate(pictures):
        bracket = [] if taken[i] else [i]
        for j in range(i + 1, len(pictures) if bracket else 0):  # neighbours in time
            ours, other = picture.exif.exposure, pictures[j].exif.exposure
            if taken[j] or ours is None or other is None or abs(other - ours) < 0.5 or shape[j] @ shape[i] < _BRACKET:
                break
            bracket.append(j)
        if len(bracket) > 1:
            taken[bracket] = True
            bracket.sort(key=lambda j: pictures[j].exif.exposure or 0.0)
            middle = bracket[len(bracket) // 2]
            for j in bracket:
                if j != middle:
                    left_out[pictures[j].path.name] = Cause(Reason.BRACKET, f"of {pictures[middle].path.name}")


def find_blurred(looks: Sequence[Look]) -> dict[int, float]:
    """Number of a blurred picture -> its sharpness in parts of the median."""
    typical = float(np.median([one.sharpness for one in looks])) if looks else 0.0
    return {i: one.sharpness / typical for i, one in enumerate(looks) if one.sharpness < _BLURRED * typical}


def tell_of_views(capture: Capture) -> None:
    """Warn of views that are blurred or there twice, by name, and leave them where they are: they have cameras."""
    views = capture.training
    looks = [look(np.asarray(v.colour * 255 + 0.5, np.uint8), None if v.mask is None else v.mask > 0.5) for v in views]
    blurred = [f"{views[i].name} ({part:.0%})" for i, part in find_blurred(looks).items()]
    if blurred:
        logger.warning(
            "%s: %d photographs are blurred (sharpness in parts of the others'), and what they show will be: %s. "
            "Take them out", capture.source, len(blurred), first_of(blurred),
        )  # fmt: skip
    copies = [f"{views[i].name} ({views[j].name})" for i, j in find_duplicates(looks).items()] if looks else []
    if copies:
        logger.warning(
            "%s: %d photographs show the same as another one of them, which counts twice: %s. Take them out, or check "
            "the export", capture.source, len(copies), first_of(copies),
        )  # fmt: skip


def _tell_cameras(pictures: Sequence[Picture], subject: str) -> None:
    """Name what differs between the lenses of pictures, and missing metadata."""
    unknown = [picture.path.name for picture in pictures if picture.exif.focal is None]
    if unknown:
        logger.warning(
            "%s: %d of %d pictures do not say in EXIF how long their lens was, which begins as a guess and is found "
            "from what they show: %s. Views from many sides settle it", subject, len(unknown), len(pictures),
            first_of(unknown),
        )  # fmt: skip
    lenses: dict[tuple[int, int, str], list[str]] = defaultdict(list)
    for picture in pictures:
        lenses[picture.lens].append(picture.path.name)
    if len(lenses) > 1:
        most = sorted(lenses.items(), key=lambda item: -len(item[1]))
        parts = [
            f"{len(names)} of {w} x {h}{f' ({camera})' if camera else ''}: {first_of(names)}"
            for (w, h, camera), names in most
        ]
        logger.warning(
            "%s: has pictures of %d sizes or lenses, each calibrated on its own: %s%s",
            subject, len(lenses), "; ".join(parts[:3]), "; ..." if len(parts) > 3 else "",
        )  # fmt: skip


def _tell_exposures(pictures: Sequence[Picture], looks: Sequence[Look], subject: str) -> None:
    """Warn of different exposures by EXIF of the pictures that have it, else of different brightness."""
    known = {p.path.name: p.exif.exposure for p in pictures if p.exif.exposure is not None}
    if known and max(known.values()) - min(known.values()) > _STOPS:
        least, most = max(known, key=known.__getitem__), min(known, key=known.__getitem__)
        unknown = len(pictures) - len(known)
        logger.warning(
            "%s: exposures differ by %.1f stops (EXIF), from %s (least light) to %s. drgs reconstruct evens them out "
            "by EXIF, but for what is clipped or in noise%s; lock exposure and white balance",
            subject, known[least] - known[most], least, most,
            f", and for {unknown} pictures that do not say theirs" if unknown else "",
        )  # fmt: skip
        return
    if len(known) == len(pictures):
        return
    light = np.log2([max(one.brightness, 1e-4) for one in looks])
    dark, bright = int(light.argmin()), int(light.argmax())
    if light[bright] - light[dark] > _BRIGHTNESS[any(one.masked for one in looks)]:
        logger.warning(
            "%s: pictures differ by %.1f stops in brightness, from %s (darkest) to %s, and not all say their "
            "exposures: if light and object do not explain it, materials will show it; lock exposure and white balance",
            subject, light[bright] - light[dark], pictures[dark].path.name, pictures[bright].path.name,
        )  # fmt: skip
