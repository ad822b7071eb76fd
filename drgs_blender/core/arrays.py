"""Bitwise equality of arrays, their range, read-only arrays, and arrays that another process can map."""

from __future__ import annotations

import math
import mmap
import os
import sys
import weakref
from typing import Any

import numpy as np

Array = np.ndarray

#: Smaller arrays are copied: a file of their own is no gain.
SHARED_BYTES = 1 << 20
#: Most arrays that have a file; each takes two of the process's open files. Arrays below `LARGE_BYTES` take at most
#: half of them, so that images find some in scenes of many meshes.
SHARED_FILES = 128
LARGE_BYTES = 8 << 20


class SharedMemory(mmap.mmap):
    """The memory of one array that another process can map; `fd` is its file."""

    fd: int


_living: weakref.WeakSet[SharedMemory] = weakref.WeakSet()


def same_bits(a: Array, b: Array) -> bool:
    """Whether two arrays have equal dtype, shape and bytes (NaN equals NaN, -0 differs from 0)."""
    if a is b:
        return True
    if a.dtype != b.dtype or a.shape != b.shape or not (a.flags.c_contiguous and b.flags.c_contiguous):
        return False
    word = np.uint64 if a.nbytes % 8 == 0 else np.uint8
    return bool(np.array_equal(a.reshape(-1).view(word), b.reshape(-1).view(word)))


def outside(numbers: Array, high: int, low: int = 0) -> int | None:
    """The worst of integers that are not in low .. high - 1; None where all are."""
    if not numbers.size:
        return None
    least, most = int(numbers.min()), int(numbers.max())
    return least if least < low else most if most >= high else None


def frozen(array: Array) -> bool:
    """Whether nobody can write to `array`, so that its identity says whether its content changed."""
    return not array.flags.writeable and (array.base is None or isinstance(array.base, SharedMemory))


def keep(array: Array) -> Array:
    """`array` itself when it is frozen, else a read-only copy."""
    if frozen(array):
        return array
    copy = np.array(array, order="C")
    copy.flags.writeable = False
    return copy


def shareable(shape: tuple[int, ...], dtype: Any) -> Array:
    """A new array, of zeros, that is sent to the engine without a copy once it is read-only.

    An ordinary one where it is small, where there are many already or where the system has no such memory.
    """
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    most = SHARED_FILES if size >= LARGE_BYTES else SHARED_FILES // 2
    if sys.platform != "linux" or size < SHARED_BYTES or len(_living) >= most:
        return np.zeros(shape, dtype)
    import fcntl

    try:
        fd = os.memfd_create("drgs-array", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    except OSError:
        return np.zeros(shape, dtype)
    try:
        os.posix_fallocate(fd, 0, size)  # a sparse file on a full memory file system ends in SIGBUS
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        memory = SharedMemory(fd, size)
    except OSError:
        os.close(fd)
        return np.zeros(shape, dtype)
    memory.fd = fd
    weakref.finalize(memory, os.close, fd)
    _living.add(memory)
    return np.ndarray(shape, dtype, memory)


def shared_file(array: Array) -> int | None:
    """The open file that has the bytes of a frozen array of `shareable`, and nothing else; None for others."""
    memory = array.base
    if not isinstance(memory, SharedMemory) or not frozen(array) or not array.flags.c_contiguous:
        return None
    return memory.fd if memory.fd >= 0 and array.nbytes == len(memory) else None


def mapped(fd: int, shape: tuple[int, ...], dtype: np.dtype) -> Array:
    """The read-only array that another process has in a file of `shared_file`.

    Parameters
    ----------
    fd : int
        Closed in any case.
    shape : tuple of int
    dtype : dtype

    Returns
    -------
    array
        Frozen.

    Raises
    ------
    ValueError
        When the file may shrink or has another size.
    OSError
        When it cannot be mapped.
    """
    import fcntl

    try:
        size = math.prod(shape) * dtype.itemsize
        if not fcntl.fcntl(fd, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
            raise ValueError("an array's file may shrink")
        if size == 0 or os.fstat(fd).st_size != size:
            raise ValueError(f"an array of {size} bytes is announced in a file of {os.fstat(fd).st_size}")
        memory = SharedMemory(fd, size, mmap.MAP_SHARED, mmap.PROT_READ)
    finally:
        os.close(fd)
    memory.fd = -1
    return np.ndarray(shape, dtype, memory)
