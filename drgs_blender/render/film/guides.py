"""Guides of the denoiser: normals, albedo, position and more, by which it keeps the edges between surfaces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import plain

Array = np.ndarray


class Guides(NamedTuple):
    """Images by which a denoiser distinguishes the surfaces of a picture (auxiliary features); float32.

    Attributes
    ----------
    coverage, roughness, metallic : (h, w) array
        In [0, 1].
    object : (h, w) array
        Number of the object, see `ObjectNumbers.name`.
    position : (h, w, 3) array
        World, m; 0 where the pixel is empty.
    normal : (h, w, 3) array
        Shading normal, unit, world; 0 where the pixel is empty.
    albedo : (h, w, 3) array
        Linear Rec.709.
    footprint : (h, w) array
        Width of a pixel at the surface, metres.
    """

    coverage: Array
    position: Array
    normal: Array
    albedo: Array
    roughness: Array
    metallic: Array
    object: Array
    footprint: Array

    def plain(self) -> Guides:
        """The same as plain arrays for kernels, see `compute.jit.plain`."""
        return Guides(*map(plain, self))
