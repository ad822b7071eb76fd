"""Numba, set up once: cached compilation in a user folder, the `workqueue` layer, strict arithmetic.

Strict, because with fast-math the same source gave other last digits when a kernel came out of the cache than when it
had just been compiled, and a frame is the same picture either way; it costs nothing that could be measured.

Import ``njit``, ``prange`` and friends from here, never from numba, so that the settings below come first. One
parallel kernel may run at a time in a process (workqueue is not re-entrant).
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)
_MONTH = 30 * 24 * 3600.0
#: Folders without kernels, in which no kernel's folder may import (their rank is higher).
WITHOUT_KERNELS = ("engine", "evaluate", "cli")


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


def source_digest() -> str:
    """Digest of the package's sources, but for those above all kernels.

    Numba notices that a kernel's own file changed, but not the files of the functions that it calls: kernels of
    different sources must not share a cache.
    """
    package, digest = Path(__file__).parent.parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] not in WITHOUT_KERNELS:
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def current_cache() -> Path:
    """The part of `cache_folder` for these sources, marked as used; parts unused for a month are removed."""
    folder = cache_folder() / source_digest()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        for other in folder.parent.iterdir():
            if other.is_dir() and time.time() - other.stat().st_mtime > _MONTH:
                shutil.rmtree(other, ignore_errors=True)
    except OSError as error:
        log.info("compiled kernels cannot be kept in %s (%s)", folder, error)
    return folder


os.environ.setdefault("NUMBA_THREADING_LAYER", "workqueue")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba  # noqa: E402
from numba import get_num_threads, prange, set_num_threads  # noqa: E402
from numba.core.caching import Cache as _Cache  # noqa: E402
from numba.extending import overload as _overload  # noqa: E402

if "NUMBA_CACHE_DIR" not in os.environ:
    numba.config.CACHE_DIR = str(current_cache())


def _forgiving(method: Any) -> Any:
    """A cache that cannot be written, as its disk is full, or read, as the power went, costs time and nothing else."""

    @functools.wraps(method)
    def tried(cache: Any, *arguments: Any) -> Any:
        try:
            return method(cache, *arguments)
        except Exception as error:  # of what is damaged, unpickling makes anything
            log.info("compiled kernels in %s: %s: %s", cache.cache_path, type(error).__name__, error)
            with contextlib.suppress(OSError):
                cache.flush()
            return None

    return tried


for _name in ("load_overload", "save_overload"):
    setattr(_Cache, _name, _forgiving(getattr(_Cache, _name)))


def njit(function: Any = None, **options: Any) -> Any:
    """``numba.njit`` with caching, no division errors, no interpreter lock.

    Without the lock, the engine hears a cancel and shows that it is alive while a kernel runs.
    """
    options = {"cache": True, "nogil": True, "error_model": "numpy"} | options
    if function is None:
        return lambda f: numba.njit(f, **options)
    return numba.njit(function, **options)


def inlined(function: Any) -> Any:
    """`njit` for small arithmetic in loops that are to vectorise: no call is left of it wherever it is used."""
    return njit(function, forceinline=True)


def overload(function: Any) -> Any:
    """``numba.extending.overload`` with the options of `njit`, except for caching, which is the caller's."""
    return _overload(function, jit_options={"nogil": True, "error_model": "numpy"})


def use_threads(count: int) -> None:
    """Run kernels on `count` threads; 0 is all the threads Numba has."""
    limit = numba.config.NUMBA_NUM_THREADS
    set_num_threads(limit if count <= 0 else min(count, limit))


__all__ = [
    "cache_folder", "get_num_threads", "inlined", "njit", "overload", "prange", "set_num_threads", "source_digest",
    "use_threads",
]  # fmt: skip
