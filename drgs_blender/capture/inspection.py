"""What is wrong with photographs, said before the long work: blur, duplicates, brackets, exposures, too few."""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import laplace

from ..core.arrays import Array
from ..core.errors import AssetError, first_of
from .pictures import Picture

logger = logging.getLogger(__name__)

#: Fewer pictures give no shape; below the second number a warning says so.
FEWEST, SPARSE = 5, 20
#: Pixels of the longer side at which sharpness is measured: fine enough for blur, coarse enough to leave noise out.
SHARPNESS_SIZE = 640
#: Sharpness below this part of the median is blur. A variance: a fifth of the contrast of edges.
_BLURRED = 0.04
#: Stops by which exposures may differ; the same of brightness, which differs with what is seen, too.
_STOPS, _BRIGHTNESS = 0.5, 1.5
#: Sides of the reduced picture by which pictures are compared, and its greatest mean difference of equal ones.
_SIGNATURE, _SAME = 32, 0.004
#: The same after brightness is taken out: frames of one bracket, by correlation.
_BRACKET = 0.995


@dataclass(slots=True)
class Look:
    """What a reduced picture shows of itself.

    Attributes
    ----------
    sharpness : float
        Variance of the Laplacian over the variance of the picture, inside the mask where there is one.
    brightness : float
        Median of the linear luminance, 0..1.
    signature : (32, 32) float32 array
        Luminance, sRGB-encoded, 0..1.
    """

    sharpness: float
    brightness: float
    signature: Array


def look(pixels: Array, mask: Array | None = None) -> Look:
    """Measure one picture.

    Parameters
    ----------
    pixels : (h, w, 3) uint8 array
        sRGB, at most `SHARPNESS_SIZE` on the longer side.
    mask : (h, w) bool array, optional
        Where the object is.
    """
    grey = (pixels @ np.array([0.2126, 0.7152, 0.0722])) / 255
    edges = laplace(grey)
    inside = np.ones(grey.shape, bool) if mask is None or not mask.any() else mask
    sharpness = float(edges[inside].var() / max(grey[inside].var(), 1e-6))
    rows = np.linspace(0, grey.shape[0], _SIGNATURE + 1).astype(int)
    columns = np.linspace(0, grey.shape[1], _SIGNATURE + 1).astype(int)
    sums = np.add.reduceat(np.add.reduceat(grey, rows[:-1], axis=0), columns[:-1], axis=1)
    area = np.maximum(np.diff(rows), 1)[:, None] * np.maximum(np.diff(columns), 1)
    return Look(sharpness, float(np.median(grey[inside]) ** 2.2), (sums / area).astype(np.float32))


def inspect(pictures: Sequence[Picture], looks: Sequence[Look], subject: str) -> tuple[list[Picture], dict[str, str]]:
    """Pictures that are fit for use, and why the others are not; warnings name them.

    Returns
    -------
    fit : list of Picture
    left_out : dict of str to str
        File name -> reason.

    Raises
    ------
    AssetError
        Fewer than `FEWEST` are fit.
    """
    left_out: dict[str, str] = {}
    if pictures:
        _duplicates(pictures, looks, left_out)
    _blurred(pictures, looks, left_out)
    fit = [picture for picture in pictures if picture.path.name not in left_out]
    reasons = defaultdict(list)
    for name, reason in left_out.items():
        reasons[reason.partition(" of ")[0]].append(name)
    for reason, names in reasons.items():
        logger.warning("%s: %d pictures are left out, %s: %s", subject, len(names), reason, first_of(names))
    check_count(fit, subject)
    _tell_cameras(fit, subject)
    _tell_exposures(fit, [l for p, l in zip(pictures, looks) if p.path.name not in left_out], subject)
    return fit, left_out


def check_count(pictures: Sequence[Picture], subject: str) -> None:
    """Raise AssetError for fewer than `FEWEST` pictures; warn of few."""
    if len(pictures) < FEWEST:
        listed = first_of([picture.path.name for picture in pictures])
        problem = f"has {len(pictures)} usable pictures{f' ({listed})' if listed else ''}; shape needs {FEWEST} or more"
        raise AssetError(subject, problem, "Take 30 or more, each sharing most of its view with the next")
    if len(pictures) < SPARSE:
        logger.warning("%s: has %d pictures; 30 or more from all sides give a better shape", subject, len(pictures))


def _duplicates(pictures: Sequence[Picture], looks: Sequence[Look], left_out: dict[str, str]) -> None:
    """The same picture twice; of exposure brackets all but the middle exposure."""
    stack = np.stack([one.signature.ravel() for one in looks])
    shape = stack - stack.mean(axis=1, keepdims=True)
    shape /= np.maximum(np.linalg.norm(shape, axis=1, keepdims=True), 1e-6)
    taken = np.zeros(len(pictures), bool)
    for i, picture in enumerate(pictures):
        if taken[i]:
            continue
        near = (np.abs(stack[i:] - stack[i]).mean(axis=1) < _SAME) & ~taken[i:]
        alike = [int(j) + i for j in np.flatnonzero(near) if pictures[int(j) + i].size == picture.size]
        for j in alike[1:]:
            left_out[pictures[j].path.name] = f"the same as another one of them ({picture.path.name})"
        taken[alike] = True
        bracket = [i]
        for j in range(i + 1, len(pictures)):  # neighbours in time
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
                    left_out[pictures[j].path.name] = f"in the exposure bracket of {pictures[middle].path.name}"


def _blurred(pictures: Sequence[Picture], looks: Sequence[Look], left_out: dict[str, str]) -> None:
    sharpness = {p.path.name: one.sharpness for p, one in zip(pictures, looks) if p.path.name not in left_out}
    typical = float(np.median(list(sharpness.values()))) if sharpness else 0.0
    for name, value in sharpness.items():
        if value < _BLURRED * typical:
            left_out[name] = f"blurred (sharpness {value / typical:.1%} of the others)"


def _tell_cameras(pictures: Sequence[Picture], subject: str) -> None:
    """Name what differs between the lenses of pictures, and missing metadata."""
    unknown = [picture.path.name for picture in pictures if picture.exif.focal is None]
    if unknown:
        which = "no picture says" if len(unknown) == len(pictures) else f"{len(unknown)} pictures do not say"
        logger.info("%s: %s in EXIF how long the lens was; it is found from the pictures", subject, which)
    lenses = Counter(picture.lens for picture in pictures)
    if len(lenses) > 1:
        parts = [f"{n} of {w} x {h}{f' ({camera})' if camera else ''}" for (w, h, camera), n in lenses.most_common()]
        logger.warning(
            "%s: has pictures of %d sizes or lenses, each calibrated on its own: %s",
            subject,
            len(lenses),
            first_of(parts),
        )


def _tell_exposures(pictures: Sequence[Picture], looks: Sequence[Look], subject: str) -> None:
    known = [p.exif.exposure for p in pictures if p.exif.exposure is not None]
    if len(known) == len(pictures):
        spread, of = float(np.ptp(known)), "exposures (EXIF)"
    else:
        light = np.log2([max(one.brightness, 1e-4) for one in looks])
        spread, of = float(np.quantile(light, 0.95) - np.quantile(light, 0.05)) / 2, "brightness"
        if spread < _BRIGHTNESS:
            return
    if spread > _STOPS:
        logger.warning(
            "%s: pictures differ by %.1f stops in %s, which materials will show; lock exposure and white balance",
            subject, spread, of,
        )  # fmt: skip
