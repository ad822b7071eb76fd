"""Sixteen lanes against NumPy, to the last bit."""

from __future__ import annotations

import math

import numpy as np

from drgs_blender.compute.jit import njit
from drgs_blender.compute.simd import (
    fold,
    fold_four,
    keep_fourths,
    load,
    quads,
    repeat,
    select,
    shuffled,
    some,
    spread,
    spread_at,
    store,
    transpose,
)  # fmt: skip


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


_order = (3, -1, 0, 15, *range(12))
_reordered = shuffled(*_order)


@njit
def _more(a, b, c, d, limit, out):  # type: ignore[no-untyped-def]
    one, other = load(a, 0), load(b, 0)
    store(out, 0, fold_four(one, other, load(c, 0), load(d, 0)))
    store(out, 16, keep_fourths(one, other))
    store(out, 32, _reordered(one))
    store(out, 48, select(one > limit, math.sqrt(abs(other)), one / other))
    store(out, 64, select(one < other, limit, spread_at(a, 5) - one))
    return fold(one), fold(other), fold(load(c, 0)), fold(load(d, 0)), some(one > limit), some(one > one)


@njit
def _turned(a, out):  # type: ignore[no-untyped-def]
    transpose(a, 1, out, 2)


def test_more_of_lanes_are_those_of_numpy():
    four = np.random.default_rng(1).normal(size=(4, 16)).astype(np.float32)
    (a, b, _, _), limit, out = four, np.float32(0.2), np.zeros(80, np.float32)
    *sums, above, never = _more(*four, limit, out)
    folded, kept, ordered, chosen, less = out.reshape(5, 16)
    assert folded.tobytes() == np.float32(sums).tobytes()
    assert kept.tobytes() == np.where(np.arange(16) % 4 == 3, b, a).tobytes()
    assert ordered.tobytes() == np.where(np.array(_order) < 0, 0, a[list(_order)]).astype(np.float32).tobytes()
    assert chosen.tobytes() == np.where(a > limit, np.sqrt(np.abs(b)), a / b).tobytes()
    assert less.tobytes() == np.where(a < b, limit, a[5] - a).tobytes()
    assert above and not never


def test_rows_become_columns():
    a, out = np.random.default_rng(2).normal(size=258).astype(np.float32), np.zeros(259, np.float32)
    _turned(a, out)
    np.testing.assert_array_equal(out[2:258].reshape(16, 16), a[1:257].reshape(16, 16).T)
    assert not out[:2].any() and not out[258:].any()
