"""Vector quantisation: codebooks of numbers and palettes of rows, for formats that store indices."""

from __future__ import annotations

import heapq
from typing import Any

import numpy as np

from ..compute.jit import njit

Array = np.ndarray

#: Bins between the least and the greatest value, in which a codebook is made, and rounds of Lloyd's algorithm.
_BINS, _ROUNDS = 1 << 16, 24
#: Rows that give the principal axes, and axes along which the rows are cut.
_SAMPLE, _AXES = 1 << 16, 12


def codebook(values: Array, size: int = 256) -> tuple[Array, Array]:
    """The `size` numbers that stand for `values` with the least squared error (Lloyd, 1982), and which for which.

    Parameters
    ----------
    values : float32 array
        Any shape, finite.
    size : int

    Returns
    -------
    book : (size,) float32 array
        Ascending.
    index : uint8 array
        Shape of `values`.
    """
    low, high = (float(f(initial=np.inf * s)) for f, s in ((values.min, 1), (values.max, -1)))
    if not low < high:
        return np.full(size, low if values.size else 0.0, np.float32), np.zeros(values.shape, np.uint8)
    bins = np.multiply(values - np.float32(low), np.float32((_BINS - 1) / (high - low)), dtype=np.float32)
    bins = (bins + np.float32(0.5)).astype(np.uint16)
    count = np.bincount(bins.reshape(-1), minlength=_BINS).astype(np.float64)
    place = np.linspace(low, high, _BINS)
    counts, sums = (np.concatenate([[0.0], np.cumsum(v)]) for v in (count, count * place))
    # The best book has about the cube root of the density of the values (Panter and Dite, 1951).
    spread = np.cumsum(np.cbrt(np.convolve(count, np.ones(257) / 257, "same")))
    book = place[np.searchsorted(spread, (np.arange(size) + 0.5) / size * spread[-1])]
    for _ in range(_ROUNDS):
        edge = np.searchsorted(place, np.concatenate([[-np.inf], 0.5 * (book[1:] + book[:-1]), [np.inf]]))
        many = np.diff(counts[edge])
        book = np.where(many > 0, np.diff(sums[edge]) / np.maximum(many, 1), book)
    nearest = np.searchsorted(0.5 * (book[1:] + book[:-1]), place).astype(np.uint8)
    return book.astype(np.float32), nearest[bins]


def palette(rows: Array, size: int) -> tuple[Array, Array]:
    """At most `size` rows that stand for all, and which for which.

    The rows are cut where they differ most, the part with the greatest squared error first, across its widest principal
    axis at its mean (Wu, 1991, without his optimal cut).

    Parameters
    ----------
    rows : (n, c) float32 array
        Finite.
    size : int

    Returns
    -------
    entries : (k, c) float32 array
        k <= size.
    index : (n,) int32 array
    """
    n = len(rows)
    if n <= size:
        return rows, np.arange(n, dtype=np.int32)
    some = rows[:: -(-n // _SAMPLE)].astype(np.float64)
    _, axes = np.linalg.eigh(np.cov(some, rowvar=False).reshape(rows.shape[1], -1))
    seen = np.ascontiguousarray(rows @ axes[:, : -_AXES - 1 : -1].astype(np.float32))
    order = np.arange(n, dtype=np.int32)
    starts = _cut(seen, order, size)
    index = np.empty(n, np.int32)
    index[order] = np.repeat(np.arange(len(starts), dtype=np.int32), np.diff(starts, append=n))
    entries = np.empty((len(starts), rows.shape[1]), np.float32)
    many = np.bincount(index).astype(np.float64)
    for column in range(rows.shape[1]):
        entries[:, column] = np.bincount(index, rows[:, column]) / many
    return entries, index


@njit
def _cut(seen: Any, order: Any, size: int) -> Any:
    """Sort `order` so that the rows of a part are neighbours; return where the parts start, (k,) ascending."""
    n = len(order)
    queue = [(-1.0, 0, n, 0, 0.0)]  # squared error, first, one past the last, axis, where to cut
    queue[0] = _part(seen, order, 0, n)
    starts = np.zeros(size, np.int64)
    done = 1
    while done < size and queue[0][0] < 0.0:
        _, first, last, axis, place = heapq.heappop(queue)
        low, high = first, last - 1
        while low <= high:
            if seen[order[low], axis] < place:
                low += 1
            else:
                order[low], order[high] = order[high], order[low]
                high -= 1
        starts[done] = low
        done += 1
        heapq.heappush(queue, _part(seen, order, first, low))
        heapq.heappush(queue, _part(seen, order, low, last))
    return np.sort(starts[:done])


@njit
def _part(seen: Any, order: Any, first: int, last: int) -> Any:
    """An entry of the queue; its error is 0 where nothing can be cut."""
    width = seen.shape[1]
    total, squares = np.zeros(width), np.zeros(width)
    for i in range(first, last):
        row = order[i]
        for k in range(width):
            value = seen[row, k]
            total[k] += value
            squares[k] += value * value
    many = last - first
    error, widest, axis = 0.0, -1.0, 0
    for k in range(width):
        own = squares[k] - total[k] * total[k] / many
        error += max(own, 0.0)
        if own > widest:
            widest, axis = own, k
    place = total[axis] / many
    below = 0
    for i in range(first, last):
        below += seen[order[i], axis] < place
    if below == 0 or below == many or widest <= 0.0:
        error = 0.0
    return -error, first, last, axis, place
