"""Numba, set up once: cached compilation in a user folder, the `workqueue` layer, no fast-math on NaN.

Import ``njit``, ``prange`` and friends from here, never from numba, so that the settings below come first. One
parallel kernel may run at a time in a process (workqueue is not re-entrant).
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any


def cache_folder() -> Path:
    """Folder of compiled kernels: ``DRGS_CACHE_DIR``, else the system's user cache folder + ``drgs/numba``."""
    if override := os.environ.get("DRGS_CACHE_DIR"):
        return Path(override)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library/Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "drgs" / "numba"


os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder()))
os.environ.setdefault("NUMBA_THREADING_LAYER", "workqueue")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba  # noqa: E402
from numba import get_num_threads, prange, set_num_threads  # noqa: E402

#: Floating-point freedoms that keep NaN and Inf: reassociation, contraction (FMA), reciprocals, no signed zeros.
#: Caution: `isfinite` of a sum becomes True (it is x - x == 0, which reassociation cancels); compare `abs(x) < limit`.
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}


def njit(function: Any = None, **options: Any) -> Any:
    """``numba.njit`` with caching, `FAST` arithmetic, no division errors, no interpreter lock.

    Without the lock, the engine hears a cancel and shows that it is alive while a kernel runs.
    """
    options = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": FAST} | options
    if function is None:
        return lambda f: numba.njit(f, **options)
    return numba.njit(function, **options)


def use_threads(count: int) -> None:
    """Run kernels on `count` threads; 0 is all the threads Numba has."""
    limit = numba.config.NUMBA_NUM_THREADS
    set_num_threads(limit if count <= 0 else min(count, limit))


__all__ = ["FAST", "cache_folder", "get_num_threads", "njit", "prange", "set_num_threads", "use_threads"]
