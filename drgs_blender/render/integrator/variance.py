"""Sample variance of the radiance: of a point, or of all points of its pixel where each has few samples."""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..sampling import ONE, ZERO, F

Array = np.ndarray

#: Samples of a point from which its own spread is believed.
_FEW = F(4.0)


def variances(pixel: Array, moments: Array) -> Array:
    """(n, 2) float32 variance of the luminance of each point's diffuse and glossy light.

    Where points have few samples, those of a pixel are taken as samples of one surface: its detail counts as noise.
    From one sample alone it is its square.

    Parameters
    ----------
    pixel : (n,) array
        Of each point, ordered: only points of one call are taken together.
    moments : (n, 5) float32 array
        See ``Radiance``.
    """
    out = np.zeros((len(pixel), 2), np.float32)
    _spread(pixel, moments, out)
    return out


@njit
def _spread(pixel, moments, variance):  # type: ignore[no-untyped-def]
    n = len(pixel)
    start = 0
    while start < n:
        end = start + 1
        while end < n and pixel[end] == pixel[start]:
            end += 1
        least = moments[start, 0]
        for i in range(start, end):
            least = min(least, moments[i, 0])
        first = start
        while first < end:
            last = end if least < _FEW else first + 1
            for lobe in range(2):
                count, mean, square = ZERO, ZERO, ZERO
                for i in range(first, last):
                    count += moments[i, 0]
                    mean += moments[i, 1 + 2 * lobe]
                    square += moments[i, 2 + 2 * lobe]
                if count > ONE:
                    square = max(ZERO, square - mean * mean / count) * (count / (count - ONE))
                for i in range(first, last):
                    variance[i, lobe] = square * moments[i, 0] / max(count, ONE)
            first = last
        start = end
