"""The device that stands for a graphics card in tests: Warp's "cpu", or what DRGS_TEST_DEVICE names, as "cuda:0"."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

DEVICE = os.environ.get("DRGS_TEST_DEVICE", "cpu")
#: Whether it is a card: its compiler fuses multiplications and additions, so that last bits differ from the CPU's.
IS_CARD = DEVICE != "cpu"


def host(value: Any) -> np.ndarray:
    """An array of the device as one of this process."""
    return np.asarray(value if isinstance(value, np.ndarray) else value.numpy())


def assert_same(found: Any, expected: Any, of_a_card: float, name: str = "") -> None:
    """The same bits; of a card, as near as `of_a_card` times the largest value."""
    found, expected = np.asarray(found), np.asarray(expected)
    if IS_CARD:
        np.testing.assert_allclose(found, expected, rtol=0, atol=of_a_card * np.abs(expected).max(), err_msg=name)
    else:
        np.testing.assert_array_equal(found, expected, name)


def assert_near(found: Any, expected: Any, rtol: float = 1e-7, atol: float = 0.0, name: str = "") -> None:
    """As `np.testing.assert_allclose`; of a card one value of a thousand may differ: a surfel before the other."""
    if IS_CARD:
        far = ~np.isclose(found, expected, rtol, atol)
        assert far.mean() <= 1e-3, f"{name}: {far.sum()} of {far.size}"
    else:
        np.testing.assert_allclose(found, expected, rtol, atol, err_msg=name)
