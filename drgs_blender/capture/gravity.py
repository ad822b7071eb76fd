"""Up as phones measured it: the acceleration in the maker notes of Apple's phones, which agree or are not used."""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..reconstruct.readers.world_frame import direction_up
from .registration import Registration

logger = logging.getLogger(__name__)

#: A vector in a picture's frame: right, up, towards the camera.
Vector = tuple[float, float, float]
#: How Apple's maker notes begin; the IFD follows the byte order, offsets count from the beginning.
_APPLE, _ORDER, _IFD = b"Apple iOS\0", 12, 14
#: The acceleration vector: three signed rationals, parts of g (ExifTool, Apple tags).
_TAG, _SRATIONAL = 0x0008, 10
#: Sizes of an acceleration, g, that are gravity and not the hand's.
_STILL = (0.9, 1.1)
#: EXIF orientation -> (right, up) of the upright picture in the phone's frame (right, top), for the camera on its back.
#: Held upright it is 6; 1 with its top to the left.
_HELD = {6: ((1, 0), (0, 1)), 1: ((0, -1), (1, 0)), 3: ((0, 1), (-1, 0)), 8: ((-1, 0), (0, -1))}
#: Pictures that must have it, also as part of all; degrees by which they may differ from each other in the middle, and
#: from up as the cameras were held.
_FEWEST, _PART = 3, 0.5
_AGREE, _HELD_WITHIN = 4.0, 50.0


def up_of_maker_note(note: Any, orientation: int, lens: str) -> Vector | None:
    """Up in the frame of the upright picture, by the maker note of a phone's photograph; None where it has none.

    Parameters
    ----------
    note : bytes
        Of another type it is no maker note.
    orientation : int
        EXIF's.
    lens : str
        Model of the lens: pictures of the front camera are left out.
    """
    if (
        not isinstance(note, bytes)
        or not note.startswith(_APPLE)
        or orientation not in _HELD
        or "front" in lens.lower()
    ):
        return None
    order = {b"MM": ">", b"II": "<"}.get(note[_ORDER:_IFD])
    vector = None if order is None else _rationals(note, order)
    if vector is None or not _STILL[0] <= math.hypot(*vector) <= _STILL[1]:
        return None
    # What it says points down: (0, -1, 0) of a phone held upright, x right, y to its top, z out of its screen.
    right, up = _HELD[orientation]
    x, y, z = (-value / math.hypot(*vector) for value in vector)
    return x * right[0] + y * right[1], x * up[0] + y * up[1], z


def _rationals(note: bytes, order: str) -> Vector | None:
    """The three numbers of the tag; None where it is absent or damaged."""
    try:
        (count,) = struct.unpack_from(f"{order}H", note, _IFD)
        for index in range(min(count, 200)):
            tag, kind, values, offset = struct.unpack_from(f"{order}HHII", note, _IFD + 2 + 12 * index)
            if tag == _TAG:
                if (kind, values) != (_SRATIONAL, 3):
                    return None
                a, b, c, d, e, f = struct.unpack_from(f"{order}6i", note, offset)
                return a / b, c / d, e / f
    except (struct.error, ZeroDivisionError):
        pass
    return None


def measured_up(found: Registration, ups: Mapping[str, Vector], subject: str) -> Array | None:
    """Up in the world of cameras (3,), as phones measured it; None where they did not, or do not agree, with a warning.

    Parameters
    ----------
    found : Registration
    ups : mapping of str to tuple
        File -> up in the frame of its picture.
    subject : str
        For messages.
    """
    files = [file for file in ups if file in found.matrices]
    if len(files) < max(_FEWEST, _PART * len(found.matrices)):
        return None
    each = np.stack([found.matrices[file][:3, :3] @ np.array(ups[file]) for file in files])
    up = each.mean(axis=0)
    for _ in range(10):  # towards the median direction: some were moved
        distance = np.linalg.norm(each - up, axis=1)
        up = np.average(each, axis=0, weights=1 / np.maximum(distance, 0.01))
    length = float(np.linalg.norm(up))
    up = up / max(length, 1e-9)
    apart = np.degrees(np.arccos(np.clip(each @ up, -1, 1)))
    held = direction_up(np.stack(list(found.matrices.values())))
    if float(np.median(apart)) > _AGREE:
        logger.warning(
            "%s: gravity in the metadata of %d pictures does not fit their cameras (%.0f degrees apart): not used",
            subject, len(files), float(np.median(apart)),
        )  # fmt: skip
        return None
    if held is not None and held @ up < math.cos(math.radians(_HELD_WITHIN)):
        logger.warning(
            "%s: gravity in the metadata of %d pictures is %.0f degrees from how the cameras were held: not used",
            subject, len(files), math.degrees(math.acos(max(-1.0, min(1.0, float(held @ up))))),
        )  # fmt: skip
        return None
    return up
