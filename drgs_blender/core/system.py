"""What Windows does otherwise than Linux and macOS: files that are open, standard input, signals.

Standard library only: programs use it before they load anything else.
"""

from __future__ import annotations

import os
import signal
import time

WINDOWS = os.name == "nt"
#: Seconds for which a file that others have open is tried again, and after which a process that has heard that it is to
#: end is ended.
_OPEN_SECONDS, _END_SECONDS = 2.0, 30.0
_POLL_SECONDS = 0.02
_TERMINATED = 143


def replace(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> None:
    """As `os.replace`; on Windows, what another program has open for a moment, such as a virus scanner, is waited for.

    Raises
    ------
    OSError
    """
    deadline = time.monotonic() + _OPEN_SECONDS
    while True:
        try:
            os.replace(source, target)
        except PermissionError:
            if not WINDOWS or time.monotonic() > deadline:
                raise
            time.sleep(_POLL_SECONDS)
        else:
            return


def claim_input() -> int:
    """A file descriptor of what standard input was; from now on that is the null device.

    To be called before a thread waits for a pipe at standard input: on Windows whoever only asks what standard input is
    would wait with it, as libraries do when they are loaded (the BLAS of NumPy and SciPy).
    """
    own = os.dup(0)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    return own


def end_at_close(pipe: int) -> None:
    """Wait until a pipe is closed, for a thread of its own, then have this process end as SIGTERM does."""
    while os.read(pipe, 1):
        pass
    terminate_self()


def terminate_self() -> None:
    """Send this process SIGTERM. Where there are no signals its handler is called, for which it has half a minute."""
    if not WINDOWS:
        os.kill(os.getpid(), signal.SIGTERM)
        return
    signal.raise_signal(signal.SIGTERM)  # os.kill would end it at once, and no handler would save anything
    time.sleep(_END_SECONDS)
    os._exit(_TERMINATED)
