"""Ctrl+C and SIGTERM for work that has to save something first.

An exception that a signal raises may come in the middle of anything, also where it is swallowed: Numba compiles by
callbacks from C. So the first signal is only noted, for the work to ask about; the second one ends it at once.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from types import FrameType

from ..core.errors import EXIT_TERMINATED, Cancelled


@contextlib.contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Within it a signal to end is noted; what it gives says whether one came.

    Where `Cancelled` leaves it after SIGTERM, the exit code becomes that of SIGTERM.
    """
    came: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        came.append(number)
        if len(came) > 1:
            _end(number)
        with contextlib.suppress(OSError):  # not by sys.stderr, which may be in the middle of writing
            os.write(2, b"\ndrgs: stopping after the current step; again: at once\n")

    previous = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(came)
    except Cancelled:
        if came and came[-1] == signal.SIGTERM:
            _end(signal.SIGTERM)
        raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _end(number: int) -> None:
    if number == signal.SIGTERM:
        sys.exit(EXIT_TERMINATED)
    raise KeyboardInterrupt
