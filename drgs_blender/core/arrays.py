"""Bitwise equality of arrays, and read-only arrays."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def same_bits(a: Array, b: Array) -> bool:
    """Whether two arrays have equal dtype, shape and bytes (NaN equals NaN, -0 differs from 0)."""
    if a is b:
        return True
    if a.dtype != b.dtype or a.shape != b.shape or not (a.flags.c_contiguous and b.flags.c_contiguous):
        return False
    word = np.uint64 if a.nbytes % 8 == 0 else np.uint8
    return bool(np.array_equal(a.reshape(-1).view(word), b.reshape(-1).view(word)))


def frozen(array: Array) -> bool:
    """Whether nobody can write to `array`, so that its identity says whether its content changed."""
    return not array.flags.writeable and array.base is None


def keep(array: Array) -> Array:
    """`array` itself when it is frozen, else a read-only copy."""
    if frozen(array):
        return array
    copy = np.array(array, order="C")
    copy.flags.writeable = False
    return copy
