"""How much a sequence of pictures flickers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from judge import to_srgb
from scipy.ndimage import map_coordinates

from drgs_blender.core.color import LUMINANCE

Array = np.ndarray


def to_frame_before(passes: Mapping[str, Array]) -> Array:
    """(h, w, 2) `flicker`'s vectors, of passes with ``Vector``, whose Y points up."""
    return passes["Vector"][..., :2] * np.float32([1, -1])


def flicker(pictures: Array, mask: Array, vectors: Array | None = None, *, converged: Array | None = None) -> float:
    """Mean absolute second difference in time of what a surface point shows.

    A steady change (light that turns, a fade) has none; noise of deviation s, different in each frame, has about 2 s,
    and less where `vectors` lead between pixels, whose mean counts: .7 of that if neighbours' noise is independent.

    Parameters
    ----------
    pictures : (n, h, w, 3) linear, n >= 3
    mask : (n, h, w) bool, pixels to look at
    vectors : (n, h, w, 2) pixels, from each pixel to its surface's place in the frame before; pixels of which that
        is not known have to be NaN or outside of `mask`. None when nothing moves
    converged : (n, h, w, 3) linear, None for nothing
        What the pictures should show: flicker is then that of their error, which blur does not lower

    Returns
    -------
    float, in sRGB luminance; without `converged`, subtract that of a converged sequence to have what is beyond it
    """
    shown = [to_srgb(p[..., :3]) @ LUMINANCE for p in pictures]
    if converged is not None:
        shown = [p - to_srgb(q[..., :3]) @ LUMINANCE for p, q in zip(shown, converged, strict=True)]
    n, h, w = mask.shape
    total, count = 0.0, 0
    for t in range(2, n):
        y, x = np.mgrid[:h, :w].astype(np.float64)
        seen, usable = [shown[t]], mask[t].copy()
        for k in (t, t - 1):
            if vectors is not None:
                step = [map_coordinates(vectors[k, ..., i], (y, x), order=0, cval=np.nan) for i in (0, 1)]
                x, y = x + step[0], y + step[1]
            usable &= np.isfinite(x) & np.isfinite(y)
            place = np.where(usable, y, -1.0), np.where(usable, x, -1.0)
            usable &= map_coordinates(mask[k - 1].astype(np.float32), place, order=1, cval=0.0) > 0.999
            seen.append(map_coordinates(shown[k - 1], place, order=1))
            x, y = np.where(usable, x, -1.0), np.where(usable, y, -1.0)
        difference = np.abs(seen[0] - 2 * seen[1] + seen[2])[usable]
        total, count = total + float(difference.sum()), count + difference.size
    return total / max(count, 1)
