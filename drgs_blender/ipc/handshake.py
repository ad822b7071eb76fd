"""The handshake: the first messages between an engine's process and its client."""

from __future__ import annotations

import queue
from collections.abc import Callable

from ..core.errors import Cancelled, DeviceError, VersionError
from ..core.version import __version__
from . import protocol
from .child_process import Child
from .watchdog import EngineLost, Watchdog

_POLL = 0.04
_REMEDY = "Install DR-GS in that environment, or name another in the preferences or in DRGS_ENGINE"


def greet(child: Child, program: str, watchdog: Watchdog, stopped: Callable[[], bool]) -> None:
    """Wait until a new process has greeted as an engine of this version.

    Parameters
    ----------
    child : Child
        The process.
    program : str
        The started program, for errors.
    watchdog : Watchdog
        When its silence is too long.
    stopped : callable
        Whether to wait no longer; asked every 40 ms.

    Raises
    ------
    DeviceError
        When it was not started, ended, was silent or is no engine.
    VersionError
        When it is an engine of another version.
    Lost
        When it was killed.
    Cancelled
        When `stopped`.
    """
    while True:
        if stopped():
            raise Cancelled
        try:
            item = child.inbox.get(timeout=_POLL)
        except queue.Empty:
            try:
                watchdog.check()
            except EngineLost as silence:
                problem = f"does not greet as an engine does: it said nothing for {watchdog.silence:g} s"
                raise DeviceError(
                    program, problem, f"Try again where the machine was busy. Else: {_REMEDY}"
                ) from silence
            continue
        if isinstance(item, OSError) and child.pid == 0:
            raise DeviceError(program, f"cannot be started ({item})", _REMEDY) from item
        if isinstance(item, EOFError) and child.killed:
            raise EngineLost("was killed while it started") from item
        if isinstance(item, protocol.ProtocolError):
            raise DeviceError(program, f"does not speak as an engine does ({item})", _REMEDY) from item
        if isinstance(item, Exception):
            problem = f"did not start as an engine: it {child.exit_message()}"
            raise DeviceError(program, problem, _REMEDY) from item
        if item is None:
            continue
        greeting = item[0]
        if not isinstance(greeting, protocol.Hello):
            raise DeviceError(program, "does not greet as an engine does", _REMEDY)
        if not protocol.same_version(greeting):
            raise VersionError(
                "engine",
                f"is version {greeting.version} (protocol {greeting.protocol}), "
                f"the extension is version {__version__} (protocol {protocol.PROTOCOL})",
                "Install the same version of both",
            )
        child.welcome()
        return
