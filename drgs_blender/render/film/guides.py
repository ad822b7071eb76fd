"""What tells surfaces apart for a denoiser."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ...compute.jit import plain

Array = np.ndarray


@dataclass(slots=True)
class Guides:
    """What tells surfaces apart, (h, w) or (h, w, 3) float32; see `film.Film`.

    ``footprint`` (h, w) is the width of a pixel at the surface, metres.
    """

    coverage: Array
    position: Array
    normal: Array
    albedo: Array
    roughness: Array
    metallic: Array
    index: Array
    footprint: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All of them, in this order, as kernels take them."""
        return tuple(plain(getattr(self, f.name)) for f in fields(self))
