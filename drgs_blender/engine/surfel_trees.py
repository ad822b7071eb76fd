"""The trees of surfels that rays meet, made again where other surfels are in them."""

from __future__ import annotations

import numpy as np

from ..render.surfels.surfel_bvh import SurfelBVH
from .cached_objects import CachedObject, surfel_mask
from .scene_objects import join


class SurfelTree:
    """The tree of the surfels of all objects, kept while they stay."""

    def __init__(self) -> None:
        self._tree: SurfelBVH | None = None
        self._objects: list[CachedObject] = []

    def of(self, objects: list[CachedObject]) -> SurfelBVH:
        """The tree of these objects."""
        known, self._tree = self._tree, None  # an update that fails half way leaves nothing to be taken for current
        same = len(objects) == len(self._objects) and all(a is b for a, b in zip(objects, self._objects))
        if known is None or not same:
            known = known or SurfelBVH()
            masks = [surfel_mask(item) for item in objects]
            known.update(join([item.posed for item in objects if item.posed is not None]), np.array(masks, np.int32))
        self._tree, self._objects = known, objects
        return known
