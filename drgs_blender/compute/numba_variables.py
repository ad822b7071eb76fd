"""Variables of Numba with which it cannot be imported, or kernels cannot be called: refused in words."""

from __future__ import annotations

import contextlib
import os

from ..core.errors import UsageError

THREADS, DISABLED = "NUMBA_NUM_THREADS", "NUMBA_DISABLE_JIT"


def check_numba_variables() -> None:
    """Call it before Numba is imported.

    Raises
    ------
    UsageError
    """
    if _number(THREADS, 1) < 1:
        raise UsageError(THREADS, "is less than one thread", "Set it to 1 or more, or unset it")
    if _number(DISABLED, 0):
        raise UsageError(DISABLED, "is set, but kernels have to be compiled", "Set it to 0, or unset it")


def _number(name: str, default: int) -> int:
    """Value of a variable; `default` also where it is no number, of which Numba warns."""
    with contextlib.suppress(ValueError):
        return int(os.environ.get(name, default))
    return default
