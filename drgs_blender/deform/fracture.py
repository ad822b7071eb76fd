"""Fracture: faces that still join pieces of matter that have come apart, and are left out."""

from __future__ import annotations

import numpy as np

Array = np.ndarray

#: Stretch from which matter counts as apart: particles stand half a cell apart, and what is 1.5 cells away is not felt.
STRETCH = 3.0


def torn_faces(rest: Array, now: Array, faces: Array, gap: float) -> Array:
    """Faces that span a tear: one of their edges is longer by more than `gap`, and more than `STRETCH` times as long.

    Parameters
    ----------
    rest, now : (n, 3) float array
        Metres, the same space.
    faces : (m, 3) int array
    gap : float
        Metres.

    Returns
    -------
    (m,) bool array
        Faces with a vertex that is not finite are not among them.
    """
    torn = np.zeros(len(faces), bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            before, after = (np.linalg.norm(v[faces[:, a]] - v[faces[:, b]], axis=1) for v in (rest, now))
            torn |= np.isfinite(after) & (after > np.maximum(before + gap, STRETCH * before))
    return torn
