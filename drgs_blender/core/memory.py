"""The memory that this process may use: that of the machine, or of a container (a cgroup of Linux), if that is less.

And arrays that take no more of it than is written.
"""

from __future__ import annotations

import math
import mmap
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

_ROOT = Path("/")
#: Pixels of a picture from which on its memory counts for more than the time of first writes: between HD and full HD.
_LARGE = 1_500_000


def total_memory(root: Path = _ROOT) -> float:
    """Memory of this machine or container.

    Parameters
    ----------
    root : Path
        Folder that holds `sys` and `proc`.

    Returns
    -------
    float
        Bytes; infinite where the system does not say.
    """
    total = float("inf")
    with suppress(AttributeError, OSError, ValueError):  # not every system has it
        total = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return min([total, _windows()[0], *(float(limit) for limit, _ in _cgroups(root))])


def available_memory(root: Path = _ROOT) -> float:
    """Memory that may be taken now without other programs or this one running out.

    Parameters
    ----------
    root : Path
        Folder that holds `sys` and `proc`.

    Returns
    -------
    float
        Bytes; infinite where the system does not say.
    """
    free = float("inf")
    with suppress(OSError, ValueError, StopIteration, IndexError):
        lines = (root / "proc/meminfo").read_text().splitlines()
        free = float(int(next(line for line in lines if line.startswith("MemAvailable")).split()[1]) << 10)
    return max(min([free, _windows()[1], *(float(limit - used) for limit, used in _cgroups(root))]), 0.0)


def give_back() -> None:
    """Return what was freed to the system: glibc keeps up to 64 MiB behind the last array in use, and all between them.

    It looks through the whole heap, some milliseconds: to be called where much was freed.
    """
    if sys.platform == "linux":
        import ctypes

        with suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


def sparse_zeros(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros of a picture, of which on Linux, where it is large, only those parts take memory that are written.

    All of it goes back when they go. NumPy asks for huge pages of 2 MiB for large arrays: who writes a part of each row
    of a picture takes memory for all of it. Here pages have the usual size, whose first write costs more time: 4 % of a
    frame of 800 x 800 pixels.

    Parameters
    ----------
    shape : tuple of int
        Rows, then columns and what a pixel has, in any order.

    Returns
    -------
    float32 array
    """
    if sys.platform == "linux" and shape[0] * max(shape[1:], default=0) >= _LARGE:
        with suppress(OSError):  # none left: NumPy says so in its own way
            pages = mmap.mmap(-1, 4 * math.prod(shape), mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
            with suppress(OSError):  # a kernel without huge pages
                pages.madvise(mmap.MADV_NOHUGEPAGE)
            return np.frombuffer(pages, np.float32).reshape(shape)
    return np.zeros(shape, np.float32)


def filled_columns(rows: np.ndarray) -> slice:
    """The columns of some rows of a picture, (h, w, c), from the first to the last that is not all 0."""
    filled = np.zeros(rows.shape[1], bool)
    for channel in range(rows.shape[2]):  # NumPy is slow over axes of three
        filled |= (rows[..., channel] != 0).any(axis=0)
    found = np.flatnonzero(filled)
    return slice(found[0], found[-1] + 1) if len(found) else slice(0, 0)


def _windows() -> tuple[float, float]:
    """Memory of a machine with Windows, and what of it is free; infinite on others."""
    if sys.platform != "win32":
        return float("inf"), float("inf")
    import ctypes

    status = (ctypes.c_uint64 * 8)(64)  # MEMORYSTATUSEX: its own size, all memory, what is free, and more
    done = ctypes.windll.kernel32.GlobalMemoryStatusEx(status)
    return (float(status[1]), float(status[2])) if done else (float("inf"), float("inf"))


def _cgroups(root: Path) -> Iterator[tuple[int, int]]:
    """Limit and use, in bytes, of the cgroup (version 2) of this process and of those around it, where limited."""
    group = Path()
    with suppress(OSError, StopIteration):
        lines = (root / "proc/self/cgroup").read_text().splitlines()
        group = Path(next(line for line in lines if line.startswith("0::")).removeprefix("0::").lstrip("/"))
    if ".." in group.parts:  # outside of what this process sees of the tree
        group = Path()
    for part in (group, *group.parents):
        folder = root / "sys/fs/cgroup" / part
        with suppress(OSError, ValueError):  # "max" is no limit
            yield int((folder / "memory.max").read_text()), int((folder / "memory.current").read_text())
