"""Locks on files between processes, which the system releases when their process ends."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import time
from pathlib import Path

_POLL_SECONDS = 0.01

if sys.platform == "win32":
    import msvcrt

    def _lock(file: int) -> bool:
        """Lock an open file; False while another process has it."""
        os.lseek(file, 0, os.SEEK_SET)
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EDEADLK):  # another process has it
                return False
            raise
        return True

    def _unlock(file: int) -> None:
        os.lseek(file, 0, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_UNLCK, 1)

else:
    import fcntl

    def _lock(file: int) -> bool:
        """Lock an open file; False while another process has it."""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def _unlock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_UN)  # a child may have the file open as well


class FileLock:
    """An exclusive lock on a file, made where it is not there; its content does not matter.

    Parameters
    ----------
    path : Path

    Raises
    ------
    OSError
        The file can be neither opened nor made.
    """

    _file: int | None = None

    def __init__(self, path: Path) -> None:
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOINHERIT", 0)
        self._file, self._process = os.open(path, flags, 0o600), os.getpid()

    def acquire(self, patience: float = 0.0) -> bool:
        """Lock the file, and say whether that was possible within `patience` seconds.

        Raises
        ------
        OSError
            Files cannot be locked here, as on some network drives.
        """
        assert self._file is not None, "closed"
        deadline = time.monotonic() + patience
        while not (locked := _lock(self._file)) and time.monotonic() < deadline:
            time.sleep(_POLL_SECONDS)
        return locked

    def close(self) -> None:
        """Release the lock; the file stays, since another process may wait for it."""
        if self._file is None:
            return
        file, self._file = self._file, None
        if self._process == os.getpid():  # else of a fork, which has the file open as well: the lock is not its own
            with contextlib.suppress(OSError):  # of what is not locked
                _unlock(file)
        os.close(file)

    def __enter__(self) -> FileLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    __del__ = close
