"""Kernels over a range, on all threads.

A plain kernel that releases the interpreter's lock runs as fast on threads of our own as Numba's ``parallel=True``, and
compiles in about half the time: Numba infers the types of a parallel loop twice, and optimises its body about four
times over. Nor does it matter here that another thread runs kernels at the same time.

How many threads is a setting of each thread that calls kernels; ``NUMBA_NUM_THREADS`` is the most, by default one per
processor.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from typing import Any

from .jit import numba

#: Pieces per thread, so that threads that are done early have something to take.
_PIECES = 8
#: Fewest rows of a picture in a piece, because handing one over costs as much as some of them.
ROWS = 24
#: The same of elements of arrays: vertices, faces, surfels.
ELEMENTS = 4096

_setting = threading.local()


def get_num_threads() -> int:
    """Threads on which this thread's kernels run."""
    count: int = getattr(_setting, "count", numba.config.NUMBA_NUM_THREADS)
    return count


def use_threads(count: int) -> None:
    """Run this thread's kernels on `count` threads, or on as many as there are; 0 is all of them."""
    limit = numba.config.NUMBA_NUM_THREADS
    _setting.count = limit if count <= 0 else min(count, limit)


@contextlib.contextmanager
def interruptible(check: Callable[[], None]) -> Iterator[None]:
    """Ask `check` between the pieces of kernels that this thread runs meanwhile; what it raises ends them half way."""
    before, _setting.check = getattr(_setting, "check", None), check
    try:
        yield
    finally:
        _setting.check = before


def checkpoint() -> None:
    """Ask what `interruptible` says, for work that is no kernel."""
    check: Callable[[], None] | None = getattr(_setting, "check", None)
    if check is not None:
        check()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "drgs-kernels")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads are not inherited


def over_range(kernel: Callable[..., Any], count: int, *arguments: Any, fewest: int = 1) -> list[Any]:
    """Call ``kernel(first, last, *arguments)`` for pieces that make up 0 .. `count`, on `get_num_threads` threads.

    Parameters
    ----------
    kernel : callable
        Compiled without the interpreter's lock, as `jit.njit` does. It must write to its own piece only.
    count : int
        Number of elements.
    *arguments : object
        The same for every piece.
    fewest : int
        Elements of a piece at least, if there are more: `ROWS`, `ELEMENTS`, or 1 where each is long.

    Returns
    -------
    list
        What the kernel returned for each piece, in order; empty where `count` is 0.
    """
    if count <= 0:
        return []
    threads = get_num_threads()
    if count <= fewest or (threads == 1 and getattr(_setting, "check", None) is None):
        return [kernel(0, count, *arguments)]
    size = max(-(-count // (threads * _PIECES)), min(fewest, -(-count // threads)))
    starts = range(0, count, size)
    results: list[Any] = [None] * len(starts)
    pieces = iter(starts)  # its next value is taken by one thread at a time

    def work(check: Callable[[], None] | None = None) -> None:
        for first in pieces:
            if check is not None:
                check()
            results[first // size] = kernel(first, min(first + size, count), *arguments)

    others: list[Future[None]] = []
    try:
        for _ in range(min(threads, len(starts)) - 1):
            others.append(_pool(threads).submit(work))
        work(checkpoint)
    finally:
        for _ in pieces:  # where it ends half way, the others are to end, too
            pass
        begun = [other for other in others if not other.cancel()]  # threads may be at work for another call
        wait(begun)
    for other in begun:
        other.result()
    return results


def over_strided(kernel: Callable[..., Any], most: int, *arguments: Any, calls: int = 4) -> None:
    """Call ``kernel(first, last, stride, *arguments)`` for pieces of 0 .. `stride`; each is every `stride`-th item.

    For items of which neighbours cost alike: no thread is left with all the costly ones.

    Parameters
    ----------
    kernel : callable
        As of `over_range`.
    most : int
        Number of items: the stride is at most that.
    *arguments : object
        The same for every piece.
    calls : int
        Items of 0 .. `stride` per thread: few where each call makes scratch memory.
    """
    stride = min(most, calls * get_num_threads())
    over_range(kernel, stride, stride, *arguments)


__all__ = [
    "ELEMENTS", "ROWS", "checkpoint", "get_num_threads", "interruptible", "over_range", "over_strided", "use_threads",
]  # fmt: skip
