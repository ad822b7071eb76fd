"""Numba, set up once: cached compilation in a user folder, strict arithmetic.

Strict, because with fast-math the same source gave other last digits when a kernel came out of the cache than when it
had just been compiled, and a frame is the same picture either way; it costs nothing that could be measured.

Import ``njit`` and friends from here, never from numba, so that the settings below come first. Kernels run on all
threads by `threads.over_range`.

What kernels take is in docs/kernels.md, with what Numba does to named tuples.
"""

from __future__ import annotations

import logging
import os
from typing import Any

import numpy as np

from . import targets
from .folders import cache_folder
from .numba_variables import check_numba_variables

check_numba_variables()
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba  # noqa: E402
from numba.core.ccallback import CFunc  # noqa: E402
from numba.extending import overload as _overload  # noqa: E402

from . import closure, kernel_compiler  # noqa: E402
from .kernel_cache import KernelCache  # noqa: E402

log = logging.getLogger(__name__)
closure.note_package()
targets.settle(numba.config)
_OWN_CACHE = kernel_compiler.is_tested() and not numba.config.DISABLE_JIT
if not kernel_compiler.is_tested():
    log.warning("Numba %s was not tested: kernels take longer to compile, when they are called", numba.__version__)
    if (folder := cache_folder().path) is not None:
        # Numba's own files tell one version of a kernel's file from another, but not of what that imports
        numba.config.CACHE_DIR = str(folder / f"numba-{closure.package_digest()}")


def njit(function: Any = None, *, cache: bool = True, **options: Any) -> Any:
    """``numba.njit`` with caching, no division errors, no interpreter lock.

    Without the lock, the engine hears a cancel and shows that it is alive while a kernel runs.
    """
    if function is None:
        return lambda f: njit(f, cache=cache, **options)
    options = {"nogil": True, "error_model": "numpy"} | options
    if not _OWN_CACHE:
        return numba.njit(function, cache=cache, **options)
    dispatcher = numba.njit(function, pipeline_class=kernel_compiler.KernelCompiler, **options)
    kernel_compiler.adopt(dispatcher)
    if cache:
        dispatcher._cache = KernelCache(function, options=options)
    return dispatcher


def inlined(function: Any) -> Any:
    """`njit` for small arithmetic in loops that are to vectorise: no call is left of it wherever it is used."""
    return njit(function, forceinline=True)


def overload(function: Any) -> Any:
    """``numba.extending.overload`` with the options of `njit`, except for caching, which is the caller's."""
    return _overload(function, jit_options={"nogil": True, "error_model": "numpy"})


def cfunc(signature: Any) -> Any:
    """``numba.cfunc`` with the options of `njit`: what C code calls back."""

    def make(function: Any) -> Any:
        compiler = {"pipeline_class": kernel_compiler.KernelCompiler} if _OWN_CACHE else {}
        wanted = tuple(signature.args), signature.return_type
        made: Any = CFunc(function, wanted, {}, {"error_model": "numpy"}, **compiler)
        if _OWN_CACHE:
            made._cache = KernelCache(function, "callback")
        else:
            made.enable_caching()
        made.compile()
        return made

    return make


class _Memory:
    """Memory of an array, by the protocol that numpy reads; holds the array."""

    def __init__(self, array: np.ndarray) -> None:
        interface = dict(array.__array_interface__)
        interface["data"] = (interface["data"][0], False)
        self.__array_interface__, self.array = interface, array


def plain(array: np.ndarray) -> np.ndarray:
    """`array` as a kernel that only reads it takes it: contiguous, not marked as read only; the same memory if it can.

    Numba compiles a kernel again for each order of axes and for arrays that are marked, as those of files and messages
    are.
    """
    array = np.ascontiguousarray(array)
    return array if array.flags.writeable else np.asarray(_Memory(array))


__all__ = ["cfunc", "inlined", "njit", "overload", "plain"]
