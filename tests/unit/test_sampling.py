"""Random numbers of the integrator: scrambled, and still evenly spread."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.render.sampling import mix, reversed_bits, scrambled, sobol


def points(count: int, seed: int) -> np.ndarray:
    """(count, 3) uint32 of the scrambled sequence, as `shade.wave` makes them."""
    raw = reversed_bits(sobol(count))
    keys = [np.uint32(mix(np.uint32(seed * 1000 + k))) for k in range(3)]
    return np.array([[scrambled(number, key) for number, key in zip(row, keys)] for row in raw], np.uint32)


@pytest.mark.parametrize("seed", range(4))
def test_scrambling_keeps_every_stratum(seed: int) -> None:
    """Of 2^k points each elementary interval of volume 2^-k has one: a (0, k, 2)-net in the first two dimensions."""
    found = points(256, seed).astype(np.uint64)
    for count in (16, 64, 256):
        bits = count.bit_length() - 1
        for part in (found[:count], found[256 - count :]):  # consecutive runs of the sequence too
            for k in range(3):
                assert len(np.unique(part[:, k] >> np.uint64(32 - bits))) == count
            for a in range(1, bits):
                cell = part[:, 0] >> np.uint64(32 - a) << np.uint64(bits - a) | part[:, 1] >> np.uint64(32 - bits + a)
                assert len(np.unique(cell)) == count


def test_scrambling_is_more_than_a_shift() -> None:
    """Digits below depend on those above, so two points do not keep their distance; every number is as likely."""
    a, b = points(64, 1), points(64, 2)
    assert len(np.unique(a[:, 0] ^ b[:, 0])) > 32 and len(np.unique(a[:, 0] - b[:, 0])) > 32
    first = np.array([scrambled(np.uint32(0), np.uint32(mix(np.uint32(k)))) for k in range(4000)]) * 2.0**-32
    assert np.abs(np.histogram(first, 16, (0, 1))[0] - 250).max() < 5 * np.sqrt(250)


def test_bits_are_reversed() -> None:
    numbers = np.array([[0, 1, 0x80000000], [0xF0000001, 2**32 - 1, 6]], np.uint32)
    expected = [[int(f"{n:032b}"[::-1], 2) for n in row] for row in numbers.tolist()]
    np.testing.assert_array_equal(reversed_bits(numbers), expected)
