"""Shadows on catchers without noise: both sums of light that they are the quotient of are filtered alike.

Where nothing throws a shadow both have the same samples, so their quotient is exactly 1, however noisy they are. It
stays 1 since each pixel is a sum of pixels with one set of weights for both; what denoises the rest of a picture may
be no such sum. A filter of the quotient would weigh dark samples as much as bright ones, and be wrong on average.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..film.catcher_film import CatcherFilm
from .svgf_spatial import denoise

Array = np.ndarray

#: Of the sums as channels: edges are told by luminance, which is to be that of the light in the scene, as the variance.
_SCALE = np.array([1, 1, 1e-3], np.float32)


def smooth_catchers(sums: Array, catchers: CatcherFilm, check: Callable[[], None] = lambda: None) -> None:
    """Filter the light of catchers in place.

    Parameters
    ----------
    sums : (h, w, 3) float32 array
        `film.Pixels.catcher`.
    catchers : CatcherFilm
    check : callable
        Called now and then; may raise to stop.
    """
    if catchers.variance is None:
        return
    variance = np.zeros((*catchers.variance.shape, 2), np.float32)
    variance[..., 0] = catchers.variance
    light = np.zeros((*catchers.variance.shape, 4, 3), np.float32)
    light[..., 0, :] = sums[..., [1, 1, 2]] * _SCALE
    smooth = denoise(light, variance, catchers.guides(), False, check)
    sums[..., 1:] = smooth[..., 0, [0, 2]] / _SCALE[1:]
