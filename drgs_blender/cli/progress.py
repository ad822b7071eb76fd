"""Progress bars on stderr."""

from __future__ import annotations

import argparse
import contextlib
import threading
from collections.abc import Iterator
from typing import Any


def bar(args: argparse.Namespace, label: str, total: float | None = None, unit: str = "it", **options: Any) -> Any:
    """A tqdm bar: on a terminal, or when ``--progress`` asks for it; never with ``-q``."""
    from tqdm import tqdm

    wanted = args.progress
    disable = True if args.quiet or wanted is False else (False if wanted else None)
    return tqdm(total=total, desc=label, unit=unit, disable=disable, leave=False, dynamic_ncols=True, **options)


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
