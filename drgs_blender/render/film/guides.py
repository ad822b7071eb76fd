"""What tells surfaces apart for a denoiser."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import plain

Array = np.ndarray


class Guides(NamedTuple):
    """What tells the surfaces of a picture apart; float32.

    Attributes
    ----------
    coverage, roughness, metallic, pass_index : (h, w) array
        See `film.Pixels`, also for the next.
    position, normal, albedo : (h, w, 3) array
    footprint : (h, w) array
        Width of a pixel at the surface, metres.
    """

    coverage: Array
    position: Array
    normal: Array
    albedo: Array
    roughness: Array
    metallic: Array
    pass_index: Array
    footprint: Array

    def plain(self) -> Guides:
        """The same as kernels take it, see `compute.jit.plain`."""
        return Guides(*map(plain, self))
