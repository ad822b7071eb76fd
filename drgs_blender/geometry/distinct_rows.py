"""Indices of the distinct rows of a table of numbers."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def distinct_row_indices(*columns: Array) -> Array:
    """Index (n,) of each row in the sorted distinct rows.

    These are the indices that ``np.unique(rows, axis=0, return_inverse=True)`` returns second. Columns are ranked one
    by one, which is several times as fast as comparing whole rows.

    Parameters
    ----------
    *columns : (n,) arrays

    Examples
    --------
    >>> distinct_row_indices(np.array([2, 0, 2, 0]), np.array([1, 5, 0, 5]))
    array([2, 0, 1, 0])
    """
    number = np.unique(columns[0], return_inverse=True)[1]
    for column in columns[1:]:
        rank = np.unique(column, return_inverse=True)[1]
        number = np.unique(number * (int(rank.max(initial=0)) + 1) + rank, return_inverse=True)[1]
    return number
