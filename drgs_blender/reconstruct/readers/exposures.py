"""Photographs of different exposures, brought to that of their median as they are read."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from ...core.color import linear_to_srgb, srgb_to_linear
from .layout import Photograph

Array = np.ndarray
logger = logging.getLogger(__name__)

#: Stops by which exposures may differ and are taken for one: what EXIF rounds.
_SAME = 0.1
#: Encoded values from which a channel counts as clipped: JPEG writes clipped ones a little lower, too.
_CLIPPED = 0.98


def find_gains(photographs: Sequence[Photograph], subject: str) -> list[float]:
    """Factor of the light of each photograph that brings it to the median exposure; 1 where its own is not known.

    All are 1 where the exposures differ by no more than a tenth of a stop; else one warning names the extremes.

    Parameters
    ----------
    photographs : sequence of Photograph
    subject : str
        The capture, for messages.
    """
    known = [photograph for photograph in photographs if photograph.exposure is not None]
    values = np.array([photograph.exposure for photograph in known], float)
    if not len(known) or np.ptp(values) <= _SAME:
        return [1.0] * len(photographs)
    middle = float(np.median(values))
    least, most = known[int(values.argmax())], known[int(values.argmin())]
    left = len(photographs) - len(known)
    logger.warning(
        "%s: exposures differ by %.1f stops (EXIF), from %s (least light) to %s: colours are brought to their median "
        "in linear light, as far as they are not clipped%s. Lock exposure when photographing",
        subject, np.ptp(values), least.image.name, most.image.name,
        f"; {left} photographs that do not say theirs stay as they are" if left else "",
    )  # fmt: skip
    return [1.0 if one.exposure is None else float(2.0 ** (one.exposure - middle)) for one in photographs]


def exposed(pixels: Array, gain: float) -> Array:
    """sRGB-encoded (..., 3) in 0..1 with `gain` times the light.

    Clipped channels stay clipped: how bright they were is not known.

    Examples
    --------
    >>> exposed(np.float32([0.5, 0.99]), 0.25).round(3)
    array([0.256, 1.   ], dtype=float32)
    """
    changed = np.clip(linear_to_srgb(srgb_to_linear(pixels) * np.float32(gain)), 0, 1)
    return np.where(pixels >= _CLIPPED, np.float32(1.0), changed)
