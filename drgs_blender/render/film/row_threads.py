"""Rows of a picture on all threads, for kernels that are too long to be compiled as parallel ones.

Numba optimises the body of a parallel kernel about four times over. A plain kernel that lets go of the interpreter's
lock runs as fast on threads of our own, and the first picture comes that much sooner.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

from ...compute.jit import get_num_threads

#: Runs of rows a thread, so that those who are done early have something to take; fewest rows of a run, because handing
#: one over costs as much as some of them.
_RUNS, _FEWEST = 8, 24


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "drgs-rows")


def over_rows(kernel: Callable[..., Any], rows: int, *arguments: Any) -> None:
    """Call ``kernel(first, last, *arguments)`` for runs of rows that make up 0 .. `rows`, on `get_num_threads` threads.

    The kernel must write to its own rows only, and be compiled without the interpreter's lock.
    """
    threads = get_num_threads()
    if rows == 0:
        return
    if threads == 1:
        kernel(0, rows, *arguments)
        return
    size = max(-(-rows // (threads * _RUNS)), min(_FEWEST, -(-rows // threads)))
    kernel(0, 0, *arguments)  # compiled once, before the threads ask for it
    pool = _pool(threads)
    for done in [pool.submit(kernel, y, min(y + size, rows), *arguments) for y in range(0, rows, size)]:
        done.result()
