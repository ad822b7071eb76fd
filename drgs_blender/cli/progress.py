"""Progress bars on stderr."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any


def bar(args: argparse.Namespace, label: str, total: float | None = None, unit: str = "it", **options: Any) -> Any:
    """A tqdm bar: on a terminal, or when ``--progress`` asks for it; never with ``-q``."""
    from tqdm import tqdm

    wanted = args.progress
    disable = True if args.quiet or wanted is False else (False if wanted else None)
    width: dict[str, Any] = {"ncols": 80, "nrows": 24} if _unsized() else {"dynamic_ncols": True}
    return tqdm(total=total, desc=label, unit=unit, disable=disable, leave=False, **width, **options)


def _unsized() -> bool:
    """Whether stderr is a terminal that does not say how large it is: tqdm would draw nothing there."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return os.get_terminal_size(sys.stderr.fileno()).columns == 0
    return False


@contextlib.contextmanager
def clock(args: argparse.Namespace, label: str) -> Iterator[None]:
    """A running clock beside `label`, for work that cannot say how far it is."""
    with bar(args, label, bar_format="{desc} {elapsed}") as line:
        ended = threading.Event()

        def tick() -> None:
            while not ended.wait(0.5):
                line.refresh()

        thread = threading.Thread(target=tick, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


class FractionBar:
    """A bar for work that reports the fraction done; used as a context manager and called as (phase, fraction)."""

    def __init__(self, args: argparse.Namespace, label: str) -> None:
        layout = "{desc}{percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
        self._bar = bar(args, label, total=1.0, bar_format=layout)

    def __enter__(self) -> FractionBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, phase: str, fraction: float) -> None:
        """Show what is being done and the part of it that is done, in [0, 1]."""
        if phase:
            self._bar.set_description(phase, refresh=False)
        self._bar.update(max(0.0, min(1.0, fraction) - self._bar.n))
