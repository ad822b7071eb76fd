"""Torch on one thread: what is left to it is so little that waking threads takes longer, and sums keep their order."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Without torch's threads. Of more than 32768 numbers each of them sums a part, so the sum depends on how many."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
