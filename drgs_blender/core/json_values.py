"""Numbers of JSON files, checked without overflow: JSON has integers of any length, and NaN where Python wrote it."""

from __future__ import annotations

import json
from typing import Any

import numpy as np


def is_number(value: Any, low: float, high: float) -> bool:
    """Whether a value of JSON is a number from `low` to `high`, both included; true and false are none.

    Examples
    --------
    >>> is_number(2, 0, 3), is_number(10**400, 0, 1e300), is_number(True, 0, 3), is_number(float("nan"), 0, 3)
    (True, False, False, False)
    """
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(low <= value <= high)


def number_array(value: Any, shape: tuple[int | None, ...], limit: float) -> np.ndarray | None:
    """Nested lists of JSON as an array; None where they are not of that shape, or not of numbers.

    Parameters
    ----------
    value : object
        Lists, or tuples, of lists of numbers.
    shape : tuple of int or None
        Length along each axis; None is any but 0.
    limit : float
        Largest magnitude of a number.

    Returns
    -------
    float64 array or None

    Examples
    --------
    >>> number_array([[1, 2], [3, 4]], (None, 2), 1e9).tolist()
    [[1.0, 2.0], [3.0, 4.0]]
    >>> number_array([1, "2", True], (3,), 1e9) is None
    True
    """
    return np.array(value, np.float64) if _fits(value, shape, limit) else None


def _fits(value: Any, shape: tuple[int | None, ...], limit: float) -> bool:
    if not shape:
        return is_number(value, -limit, limit)
    if not isinstance(value, list | tuple) or not value or shape[0] not in (None, len(value)):
        return False
    return all(_fits(item, shape[1:], limit) for item in value)


def excerpt(value: Any, longest: int = 80) -> str:
    """A value as JSON, cut after `longest` characters, for a message."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):  # not of JSON, or an integer of more digits than Python writes
        text = f"a {type(value).__name__}"
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
