"""Quaternions of packed files: the largest component is left out, since the length is 1 and its sign is free."""

from __future__ import annotations

import numpy as np

Array = np.ndarray

#: For each component that is left out, the three that are stored, in ascending order.
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def from_smallest_three(largest: Array, others: Array) -> Array:
    """Quaternions (n, 4) float32 from the index (n,) of what was left out and the other three (n, 3), ascending."""
    rotation = np.empty((len(largest), 4), np.float32)
    for k in range(4):
        here = np.flatnonzero(largest == k)
        three = others[here]
        rotation[here[:, None], OTHERS[k]] = three
        rotation[here, k] = np.sqrt(np.maximum(1.0 - np.square(three).sum(axis=1), 0.0))
    return rotation


def to_smallest_three(rotation: Array) -> tuple[Array, Array]:
    """(largest (n,), others (n, 3)) of unit quaternions (n, 4), turned so that the largest component is positive."""
    largest = np.abs(rotation).argmax(axis=1)
    sign = np.where(np.take_along_axis(rotation, largest[:, None], axis=1) < 0, -1, 1).astype(rotation.dtype)
    return largest, np.take_along_axis(rotation, OTHERS[largest], axis=1) * sign
