"""Binary search in arrays of a device; translated where a kernel calls it."""

from __future__ import annotations

from typing import Any

import numpy as np


def first_of(keys: Any, count: Any, key: Any) -> Any:
    """Number of the `count` first keys, integers in rising order, that are lower (binary search)."""
    low, high = np.int64(0), np.int64(count)
    while low < high:
        middle = (low + high) // 2
        if np.int64(keys[middle]) < key:
            low = middle + 1
        else:
            high = middle
    return low
