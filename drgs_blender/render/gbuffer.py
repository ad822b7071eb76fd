"""What the camera sees of a strip of rows, before light: the result of both primary stages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .points import ShadingPoints

Array = np.ndarray


@dataclass(slots=True)
class GBuffer:
    """Covered sub-pixel samples of the rows ``y0 .. y1`` of the camera's window, ordered by pixel, then sample.

    Attributes
    ----------
    rows : (y0, y1) in the full picture, half-open
    points : ShadingPoints, n of them, what the integrator eats
    position : (n, 3) float32, world space: the seen surface point (``points.origin`` lies on the traced mesh)
    depth : (n,) float32, metres along the view axis
    object_index : (n,) int32 index into Frame.objects
    alpha : (rows, width, aa) float32: coverage of each sub-pixel sample
    """

    rows: tuple[int, int]
    points: ShadingPoints
    position: Array
    depth: Array
    object_index: Array
    alpha: Array
