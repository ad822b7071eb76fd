"""Neighbouring views: those that show much of the same from another place."""

from __future__ import annotations

import logging

import numpy as np

from ...core.arrays import Array
from .capture import View

log = logging.getLogger(__name__)

#: How many neighbours a view has at most.
NEIGHBOURS = 4
#: Parallax, degrees: less shows no depth, more shows another side.
LEAST, MOST = 2.0, 45.0


def neighbours(views: list[View], centre: Array) -> list[list[int]]:
    """For each view the numbers of its neighbours, by the parallax at the object's `centre` (3,), the least first.

    Views without any are told of.
    """
    away = np.stack([np.asarray(view.camera.matrix_world, np.float64)[:3, 3] for view in views]) - centre
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    parallax = np.degrees(np.arccos(np.clip(away @ away.T, -1, 1)))
    near = [
        [int(k) for k in np.argsort(row, kind="stable") if LEAST <= row[k] <= MOST][:NEIGHBOURS] for row in parallax
    ]
    alone = [view.name for view, found in zip(views, near, strict=True) if not found]
    if alone:
        names = ", ".join(alone[:3]) + (", ..." if len(alone) > 3 else "")
        log.warning(
            "%d of %d photographs (%s) have no other within %g to %g degrees around the object: their patches are not "
            "compared. Take them %g to %g degrees apart around the object",
            len(alone), len(views), names, LEAST, MOST, LEAST, MOST,
        )  # fmt: skip
    return near
