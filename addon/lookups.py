"""What is looked up: what was made before, and the points that are nearest."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from mathutils.kdtree import KDTree

Array = np.ndarray
T = TypeVar("T")


def recall(known: list[T], fits: Callable[[T], bool], make: Callable[[], T], most: int) -> T:
    """The first of `known` that `fits`, else what `make` makes; it is put first, and no more than `most` are kept."""
    found = next((entry for entry in known if fits(entry)), None)
    entry = make() if found is None else found
    known[:] = [entry, *(other for other in known if other is not entry)][:most]
    return entry


def nearest(points: Array, places: Array, count: int) -> tuple[Array, Array]:
    """The `count` of (s, 3) points that are nearest to each of (n, 3) places, all where there are fewer.

    Returns
    -------
    (n, count) int, the nearest first; (n, count) float distances
    """
    tree = KDTree(len(points))
    for number, point in enumerate(points.tolist()):
        tree.insert(point, number)
    tree.balance()
    count = min(count, len(points))
    found = [tree.find_n(place, count) for place in places.tolist()]
    index = np.array([[hit[1] for hit in hits] for hits in found], int).reshape(-1, count)
    return index, np.array([[hit[2] for hit in hits] for hits in found]).reshape(-1, count)
