"""Sixteen lanes against NumPy, to the last bit."""

from __future__ import annotations

import numpy as np

from drgs_blender.compute.jit import njit
from drgs_blender.compute.simd import fold, load, quads, repeat, spread, store


@njit
def _row(values, at, out, a, b, c, d, factor):  # type: ignore[no-untyped-def]
    row = factor * (load(values, at) + quads(a, b, c, d)) * repeat(a, b, c, d) - spread(d)
    store(out, at, row)
    return fold(row)


def test_lanes_are_those_of_numpy():
    values = np.random.default_rng(0).normal(size=40).astype(np.float32)
    four, factor = np.float32([0.1, -2.0, 3.7, 1e-3]), np.float32(0.3)
    out = np.zeros_like(values)
    sums = _row(values, 5, out, *four, factor)
    expected = factor * (values[5:21] + np.repeat(four, 4)) * np.tile(four, 4) - four[3]
    assert out[5:21].tobytes() == expected.tobytes()
    assert not out[:5].any() and not out[21:].any()
    folded = expected[:8] + expected[8:]
    assert np.float32(sums).tobytes() == (folded[:4] + folded[4:]).tobytes()
