"""The engine as a child process: private pipes, three threads that wait on them, a bounded log.

Threads instead of ``select`` because Windows has none for pipes; none of them ever calls back into the program. The
thread that reads is also the one that starts the process: on Linux the engine asks to be killed when its parent
*thread* ends, and a thread of Blender's may well end before the engine should.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import socket
import subprocess
import sys
import threading
from collections import deque
from typing import Any

import numpy as np

from ..core.phases import STARTING
from . import protocol
from .protocol import Link, ProtocolError
from .shared_memory import Region

logger = logging.getLogger(__name__)

Array = np.ndarray

#: Seconds after which an engine that was asked to stop is killed: later, and before its first picture. It asks every
#: second or more often also on a busy machine with millions of surfels; to start another one takes longer than to wait.
OBEY_SECONDS, OBEY_SECONDS_COLD = 5.0, 15.0

_LOG_LINES = 500
_LOG_LINE = 2000
_REPLIES = (protocol.Loaded, protocol.Result, protocol.Need, protocol.Stopped, protocol.Failed)


def clean_environment() -> dict[str, str]:
    """This process's environment without what would make the engine's Python behave like Blender's."""
    kept = {name: value for name, value in os.environ.items() if not name.upper().startswith("PYTHON")}
    return kept | {"OMP_WAIT_POLICY": "PASSIVE", "PYTHONNOUSERSITE": "1"}


def is_crash(code: int) -> bool:
    """Whether an exit code is that of a signal, or of an exception of Windows (an NTSTATUS that is an error)."""
    return code < 0 or code >= 0xC0000000


def ended_how(code: int) -> str:
    """How a process ended, in words.

    >>> ended_how(1), ended_how(-9), ended_how(0xC0000005)
    ('exited (1)', 'was killed by signal 9', 'crashed (0xC0000005)')
    """
    if not is_crash(code):
        return f"exited ({code})"
    return f"was killed by signal {-code}" if code < 0 else f"crashed (0x{code:X})"


class Child:
    """One running engine.

    Attributes
    ----------
    inbox : queue.Queue
        (message, arrays) as they arrive; at the end one exception that says why there will be no more. None only wakes
        a waiting thread.
    reads : int
        Grows with every byte that arrives.
    steps : int
        Of the last `protocol.Alive`, as `preparing`.
    preparing : bool
    last_progress : tuple of (str, float)
        Phase and fraction of the last `protocol.Progress` that was taken out of `inbox`.
    idle : threading.Event
        Set while no request is unanswered.
    greeted : bool
        Whether the handshake is done.
    warm : bool
        Whether it has finished a picture: everything is imported, kernels are loaded.
    """

    def __init__(self, command: list[str], shared: bool) -> None:
        self.command = command
        self.inbox: queue.Queue[tuple[Any, dict[str, Array]] | Exception | None] = queue.Queue()
        self.reads = 0
        self.steps = 0
        self.preparing = False
        self.last_progress = (STARTING, 0.0)
        self.greeted = False
        self.warm = False
        self.idle = threading.Event()
        self.idle.set()
        self._asked = 0  # the latest request
        self.link: Link | None = None
        self._outbox: queue.SimpleQueue[tuple[Any, dict[str, Array]] | None] = queue.SimpleQueue()
        self._log: deque[str] = deque(maxlen=_LOG_LINES)
        self._log_thread: threading.Thread | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._to_engine = Region.create() if shared else None
        self._to_client = Region.create() if shared and self._to_engine is not None else None
        pair = socket.socketpair() if self._to_client is not None else None
        self._files = pair[0] if pair is not None else None
        self._files_of_engine = pair[1] if pair is not None else None
        self._inherited_socket = pair[1].fileno() if pair is not None else -1
        self._started = threading.Event()
        self._threads = [threading.Thread(target=self._run, name="drgs-read", daemon=True)]
        self._threads[0].start()
        self._started.wait()

    @property
    def pid(self) -> int:
        """Process id, 0 when the process could not be started."""
        return self._process.pid if self._process is not None else 0

    @property
    def running(self) -> bool:
        """Whether the process still runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def killed(self) -> bool:
        """Whether a signal ended the process, on Windows an exception."""
        try:
            return self._process is not None and is_crash(self._process.wait(1.0))
        except subprocess.TimeoutExpired:
            return False

    @property
    def log(self) -> str:
        """The last lines the engine wrote to its standard error."""
        return "\n".join(self._log)

    def welcome(self) -> None:
        """Answer the engine's Hello, handing it the shared regions."""
        to_engine, to_client = (r.fd if r is not None else -1 for r in (self._to_engine, self._to_client))
        inherited = to_engine, to_client, self._inherited_socket
        self.send(protocol.Welcome(protocol.PROTOCOL, protocol.__version__, *inherited))
        if self.link is not None:
            self.link.outgoing, self.link.incoming = self._to_engine, self._to_client
            self.link.files = self._files
        self.greeted = True

    def send(self, message: Any, arrays: dict[str, Array] | None = None) -> None:
        """Hand a message to the writing thread; what goes wrong there arrives in `inbox`."""
        self._outbox.put((message, arrays or {}))

    def request(self, message: Any, arrays: dict[str, Array] | None = None) -> None:
        """Send a message that will be answered."""
        self._asked = message.id
        self.idle.clear()
        self.send(message, arrays)

    def cancel(self, request: int) -> None:
        """Ask the engine to stop; kill it when it has not within `OBEY_SECONDS`.

        Compiling kernels does not count, and the first picture may take longer: both happen once, cannot be
        interrupted, and would otherwise never be done by a viewport that cancels with every movement of the mouse.
        """
        self.send(protocol.Cancel(request))
        patience = OBEY_SECONDS if self.warm else OBEY_SECONDS_COLD
        threading.Thread(target=self._enforce, args=(request, patience), name="drgs-cancel", daemon=True).start()

    def kill(self) -> None:
        """End the process at once."""
        if self._process is not None:
            with contextlib.suppress(OSError):  # it ended by itself just now
                self._process.kill()

    def close(self, grace: float = 1.0) -> None:
        """End the process, politely for `grace` seconds, and wait for its threads."""
        process = self._process
        if process is not None and process.poll() is None and grace > 0:
            self.send(protocol.Shutdown())
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(grace)
        self.kill()
        self._outbox.put(None)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(2.0)

    def exit_message(self) -> str:
        """Description of how the process ended, for an error message."""
        try:
            code = self._process.wait(1.0) if self._process is not None else None
        except subprocess.TimeoutExpired:
            code = None
        if self._log_thread is not None:
            self._log_thread.join(0.5)
        how = "stopped answering" if code is None else ended_how(code)
        last = next((line for line in reversed(self._log) if line.strip()), "")
        return f"{how}; last log line: {last[:300]}" if last else how

    # --- threads ---------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        regions = [region for region in (self._to_engine, self._to_client) if region is not None]
        inherited = [region.fd for region in regions] + [self._inherited_socket] * (self._files is not None)
        options: dict[str, Any] = {"pass_fds": inherited} if inherited else {}
        if sys.platform == "win32":
            options["creationflags"] = subprocess.CREATE_NO_WINDOW
        pipe = subprocess.PIPE
        try:
            self._process = process = subprocess.Popen(
                self.command, bufsize=0, stdin=pipe, stdout=pipe, stderr=pipe, env=clean_environment(), **options
            )
        except OSError as error:
            self.inbox.put(error)
            self._started.set()
            return
        finally:
            if self._files_of_engine is not None:
                self._files_of_engine.close()
        self.link = link = Link(process.stdout, process.stdin, self._note)  # type: ignore[arg-type]
        self._log_thread = threading.Thread(target=self._gather, name="drgs-log", daemon=True)
        writing = threading.Thread(target=self._send_all, name="drgs-write", daemon=True)
        self._threads += [self._log_thread, writing]
        self._log_thread.start()
        writing.start()
        self._started.set()
        end: Exception
        try:
            while (received := link.receive()) is not None:
                self._dispatch(*received)
            end = EOFError("the engine closed its pipe")
        except (ProtocolError, OSError, MemoryError) as error:
            end = error
            process.kill()
        self.idle.set()
        self.inbox.put(end)
        self._outbox.put(None)
        process.wait()
        process.stdout.close()  # type: ignore[union-attr]
        for region in regions:
            region.close()
        if self._files is not None:
            self._files.close()

    def _note(self) -> None:
        self.reads += 1

    def _dispatch(self, message: Any, arrays: dict[str, Array]) -> None:
        if isinstance(message, protocol.Alive):
            self.steps, self.preparing = message.steps, message.preparing
            return
        if isinstance(message, _REPLIES):
            self.warm |= isinstance(message, protocol.Result)
            self.idle.set()
        self.inbox.put((message, arrays))

    def _send_all(self) -> None:
        assert self._process is not None and self._process.stdin is not None and self.link is not None
        while (item := self._outbox.get()) is not None:
            try:
                self.link.send(*item)
            except OSError as error:  # the reading thread reports the end
                level = logging.DEBUG if isinstance(error, BrokenPipeError) else logging.WARNING
                logger.log(level, "the engine cannot be written to any more: %s", error)
                break
            except ValueError as error:
                self.idle.set()
                self.inbox.put(error)
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def _gather(self) -> None:
        assert self._process is not None and self._process.stderr is not None
        with self._process.stderr as stream:
            rest = b""
            while chunk := stream.read(1 << 16):
                *lines, rest = (rest + chunk).split(b"\n")
                self._log.extend(line[:_LOG_LINE].decode("utf-8", "replace").rstrip() for line in lines)
                rest = rest[-_LOG_LINE:]
            if rest:
                self._log.append(rest.decode("utf-8", "replace"))

    def _enforce(self, request: int, patience: float) -> None:
        tick = 0.05
        while not self.idle.wait(tick) and self._asked == request:  # a later one was not cancelled
            patience -= 0.0 if self.preparing else tick
            if patience <= 0:
                logger.warning("the engine did not stop when it was asked to; it is ended")
                self.kill()
                return
