"""Filters of a whole picture that need no second one: in bands of rows, each written when what reads it is made."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...compute.threads import ROWS, get_num_threads, over_range
from ...core.memory import sparse_zeros
from .demodulation import CERTAINTY, LIGHT, PAD, Signal

Array = np.ndarray

#: Fewest rows of a band that is filtered at once.
_BAND = 96


def over_rows(kernel: Callable[..., None], first: int, last: int, *arguments: object) -> None:
    """`over_range` of a kernel from row `first` to `last` - 1 of its arrays, whose other rows it only reads."""

    def work(begin: int, end: int, *given: object) -> None:
        kernel(first + begin, first + end, *given)

    over_range(work, last - first, *arguments, fewest=ROWS)


def filter_in_place(kernel: Callable[..., None], reach: int, signal: Signal, *arguments: object) -> None:
    """Write what a kernel makes of light over it, in bands of rows: a second picture of light would double the memory.

    A band is written when the next one, which reads of its rows, has been made.

    Parameters
    ----------
    kernel : callable
        ``kernel(first, last, *arguments, guide, spans, light, out)``.
    reach : int
        Rows above and below its own that the kernel reads.
    signal : Signal
    *arguments : int
    """
    guide, light, spans = signal.guide, signal.light, signal.spans
    height = max(_BAND, reach, 4 * ROWS * get_num_threads())
    buffers = [sparse_zeros((min(height + reach, len(light)), *light.shape[1:])) for _ in range(2)]
    made: list[tuple[int, Array]] = []  # of the band before: its first row and what is to be written from there on
    for y0 in range(0, len(light), height):
        y1 = min(y0 + height, len(light))
        low = max(y0 - reach, 0)
        near, out = slice(low, y1 + reach), buffers[y0 // height % 2]

        over_rows(kernel, y0 - low, y1 - low, *arguments, guide[near], spans[near], light[near], out)
        made.append((y0, out[y0 - low : y1 - low]))
        if len(made) == 2:
            _write_rows(*made.pop(0), signal)
    for rows in made:
        _write_rows(*rows, signal)


def _write_rows(first: int, rows: Array, signal: Signal) -> None:
    """Write what is covered of some rows over a signal's light, but for the planes that `_weigh` makes."""
    for y, row in enumerate(rows, first):
        columns = slice(signal.spans[y, 0] + PAD, signal.spans[y, 1] + PAD)
        for planes in (slice(CERTAINTY), slice(LIGHT, None)):
            signal.light[y, planes, columns] = row[planes, columns]
