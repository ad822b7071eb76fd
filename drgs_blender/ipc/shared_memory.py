"""Shared memory for bulk arrays: an anonymous memory file that both processes map, in place of a pipe.

One region a direction, created by the client, inherited by the engine as an open file: it has no name, so nothing
can be left behind and nobody else can open it. The writing side grows it with ``posix_fallocate`` (a sparse file on a
full memory file system ends in SIGBUS); it is sealed against shrinking, so the reader can trust a size it has seen.
Where the system has no such file (macOS, Windows) the arrays travel in the pipe instead.
"""

from __future__ import annotations

import contextlib
import logging
import mmap
import os
import sys

logger = logging.getLogger(__name__)

_MAX_BYTES = 512 << 20
_STEP = 1 << 20
#: What a message had beyond this is given back to the system once it is read.
_KEPT_BYTES = 64 << 20


class Region:
    """A growing memory file, mapped. One side writes, the other reads."""

    #: Messages above this size travel in the pipe, so that one huge picture does not hold memory for ever.
    max_bytes = _MAX_BYTES

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._map: mmap.mmap | None = None
        os.set_inheritable(fd, False)

    @classmethod
    def create(cls) -> Region | None:
        """A new, empty region, or None where the system cannot make one."""
        if sys.platform != "linux":
            return None
        import fcntl

        try:
            fd = os.memfd_create("drgs", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        except (OSError, AttributeError) as error:  # a system or a Python built without it
            logger.info("no shared memory (%s): arrays travel in the pipe", error)
            return None
        return cls(fd)

    def writable(self, size: int) -> memoryview | None:
        """The first `size` bytes to write to, growing the file; None when it cannot grow so far."""
        if sys.platform != "linux" or size > self.max_bytes:
            return None
        if self._map is None or len(self._map) < size:
            whole = -(-size // _STEP) * _STEP
            try:
                os.posix_fallocate(self.fd, 0, whole)
                self._remap(whole)
            except OSError as error:
                logger.info("shared memory cannot grow to %d bytes (%s): arrays travel in the pipe", whole, error)
                return None
        assert self._map is not None
        return memoryview(self._map)[:size]

    def readable(self, size: int) -> memoryview:
        """The first `size` bytes as the other side wrote them; ValueError when the file is not so large."""
        if self._map is None or len(self._map) < size:
            whole = os.fstat(self.fd).st_size
            if size > whole:
                raise ValueError(f"{size} bytes announced in a shared region of {whole}")
            self._remap(whole)
        assert self._map is not None
        return memoryview(self._map)[:size]

    def done(self, size: int) -> None:
        """Say that the first `size` bytes have been read: the memory of a large message is given back."""
        if self._map is not None and size > _KEPT_BYTES and sys.platform == "linux":
            with contextlib.suppress(OSError):
                self._map.madvise(mmap.MADV_REMOVE, _KEPT_BYTES, len(self._map) - _KEPT_BYTES)

    def _remap(self, size: int) -> None:
        self._map = mmap.mmap(self.fd, size)

    def close(self) -> None:
        """Give the file back; views handed out earlier stay valid until they are gone."""
        self._map = None
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
