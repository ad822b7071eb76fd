"""A camera that stood still before an object that was turned: what is around it is then the same in all pictures.

Features of such pictures without masks are mostly those of the room, by which all cameras stand in one place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import Array
from ..reconstruct.capture.turntable import PAIRS, Surroundings, correlation, detail_of

#: Part of a picture's side, from each edge, that counts as surroundings.
_RIM = 0.16
#: Blurs are of pictures of 64 pixels there, of half as many here.
_SCALE = 0.5
#: Correlation from which on the surroundings are the same: where the camera went around, .35 or less.
_SAME = 0.6


def likeness_of_rims(pictures: Sequence[Array]) -> float | None:
    """Median correlation of the rims of pictures from far apart in their order; None: too few, or nothing to see.

    Parameters
    ----------
    pictures : sequence of (h, w) float32 array
        Small, luminance, sRGB-encoded.
    """
    rims = [_rim(picture) for picture in pictures]
    found = []
    for stride in {len(rims) // 2, len(rims) // 3}:
        for first in range(len(rims)):
            second = (first + stride) % len(rims)
            if first != second and rims[first].known.shape == rims[second].known.shape:
                found.append(correlation(rims[first], rims[second]))
    known = [value for value in found if value is not None]
    return float(np.median(known)) if len(known) >= PAIRS else None


def stood_still(pictures: Sequence[Array]) -> bool:
    """Whether what is around the middle of the pictures is the same in all; see `likeness_of_rims`."""
    likeness = likeness_of_rims(pictures)
    return likeness is not None and likeness > _SAME


def _rim(picture: Array) -> Surroundings:
    known = np.ones(picture.shape)
    rows, columns = (max(2, round(_RIM * side)) for side in picture.shape)
    known[rows:-rows, columns:-columns] = 0
    return detail_of(picture, known, _SCALE)
