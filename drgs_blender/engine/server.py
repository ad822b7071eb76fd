"""The engine's side of the link: one thread computes, one listens, one sends heartbeats.

The engine lives exactly as long as its parent: the end of its standard input, SIGTERM and (on Linux) the parent's
death end it at once. It holds nothing that would have to be cleaned up.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import queue
import signal
import socket
import sys
import threading
import time
from typing import Any

import numpy as np

from ..compute.folders import leave_temporary
from ..core import own_python
from ..core.errors import EXIT_INTERNAL, EXIT_OK, EXIT_VERSION, Cancelled, DeviceError, DrgsError
from ..core.loading import many_imports
from ..core.phases import PREPARING, STARTING, is_counted
from ..core.system import claim_input
from ..core.version import __version__
from ..ipc import protocol
from ..ipc.codec import CodecError, decode_frame
from ..ipc.protocol import PROTOCOL, Link, ProtocolError
from ..ipc.shared_memory import Region
from ..ipc.slots import HeldSlots
from .memory_limit import limit_memory, requested_limit

logger = logging.getLogger(__name__)

Array = np.ndarray

#: Seconds between two heartbeats, and between two progress messages of one phase.
ALIVE_SECONDS = 0.5
PROGRESS_SECONDS = 0.1


class Server:
    """Serves the requests of one client.

    Parameters
    ----------
    link : Link
        To the client.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.held = HeldSlots()
        self.session: Any = None
        self._requests: queue.SimpleQueue[tuple[Any, dict[str, Array]]] = queue.SimpleQueue()
        self._last_cancelled = 0
        self._current = 0
        self._steps = 0
        self._preparing = 0
        self._fraction = 0.0
        self._reported = ("", 0.0)

    # --- threads beside the main one -------------------------------------------------------------------------------

    def listen(self) -> None:
        """Take messages until the pipe ends; ends the process then, whatever the main thread does."""
        try:
            while (received := self.link.receive()) is not None:
                message, arrays = received
                if isinstance(message, protocol.Cancel):
                    self._last_cancelled = max(self._last_cancelled, message.id)
                elif isinstance(message, protocol.Shutdown):
                    break
                elif isinstance(message, (protocol.LoadAsset, protocol.Render, protocol.View, protocol.Refine)):
                    self._requests.put((message, arrays))
                else:
                    raise ProtocolError(f"{type(message).__name__} is not for the engine, or not now")
        except ProtocolError as error:
            _refuse(self.link, str(error))
        except BaseException:
            logger.exception("the listening thread failed")
            _exit(EXIT_INTERNAL)
        _exit(EXIT_OK)

    def send_heartbeats(self) -> None:
        """Send a heartbeat (`Alive`) at regular intervals, with the progress of the main thread."""
        while True:
            time.sleep(ALIVE_SECONDS)
            self._send(protocol.Alive(self._steps, self._prepares))

    # --- the main thread -------------------------------------------------------------------------------------------

    def serve(self) -> None:
        """Answer requests, one after the other, for ever."""
        for target in (self.listen, self.send_heartbeats):
            threading.Thread(target=target, name=f"drgs-{target.__name__}", daemon=True).start()
        self._note_preparing(1, STARTING)
        with many_imports():
            try:
                self._open_session()
            except Exception:
                logger.exception("the engine is incomplete")  # the first request meets it again and is answered with it
        self._note_preparing(-1)
        while True:
            message, arrays = self._requests.get()
            self._current, self._fraction, self._reported = message.id, 0.0, ("", 0.0)
            self._steps += 1
            try:
                self._handle(message, arrays)
            except Cancelled:
                self._send(protocol.Stopped(message.id))
            except DrgsError as error:
                logger.info("request %d: %s", message.id, error)
                self._fail(message.id, type(error).__name__, error.subject, error.problem, error.remedy)
            except MemoryError:
                logger.exception("request %d", message.id)
                remedy = "Close other programs, or choose a lower resolution or fewer sub-pixel samples"
                self._fail(message.id, "EngineError", "engine", "ran out of memory", remedy)
            except Exception as error:
                logger.exception("request %d", message.id)
                problem = f"met an unexpected {type(error).__name__}: {str(error)[:500]}"
                remedy = "Report it with the engine's log, which has the details"
                self._fail(message.id, "DrgsError", "engine", problem, remedy)

    def _handle(self, message: Any, arrays: dict[str, Array]) -> None:
        if isinstance(message, protocol.LoadAsset):
            session = self._open_session()
            key = session.load_asset(message.path)
            asset = session.asset(key)
            self._send(protocol.Loaded(message.id, key, len(asset.mesh.vertices), len(asset.surfels)))
            return
        if isinstance(message, protocol.Refine):
            self._send_passes(message, self._open_session().refine(message.view, self._progress, self._cancelled))
            return
        held, missing = self.held.update(message.slots, arrays)
        if missing:
            self._send(protocol.Need(message.id, missing))
            return
        try:
            frame = decode_frame(message.frame, held)
        except CodecError as error:
            raise DrgsError("frame", f"cannot be read: {error}", "Report it with the engine's log") from error
        session = self._open_session()
        if isinstance(message, protocol.View):
            self._send_passes(message, session.view(message.view, frame, self._progress, self._cancelled, message.most))
        else:
            self._send_passes(message, session.render(frame, self._progress, self._cancelled))

    def _send_passes(self, message: Any, passes: Any) -> None:
        """Send the passes of a picture as the result; Need where there is none."""
        if passes is None:
            self._send(protocol.Need(message.id, []))
        else:
            self._send(protocol.Result(message.id, passes.warnings, passes.statistics), passes)

    def _open_session(self) -> Any:
        if self.session is None:
            try:
                from ..render.integrator.brdf import layer_table
                from . import jit_events
                from .session import Session
            except ImportError as error:
                again = "Disable the extension, enable it again so that Blender unpacks it, or press Set Up Engine"
                remedy = again if own_python.bundled else "Install DR-GS again in this environment"
                raise DeviceError(sys.executable, f"lacks a part of the engine ({error})", remedy) from error
            jit_events.watch(self._note_preparing)
            self.session = Session()
            threading.Thread(target=layer_table, name="drgs-table", daemon=True).start()  # while the first asset loads
        return self.session

    def _cancelled(self) -> bool:
        self._steps += 1
        return self._current <= self._last_cancelled

    def _progress(self, phase: str, fraction: float) -> None:
        """Tell the client where the request stands, not more often than it can use."""
        self._steps += 1
        self._fraction = min(1.0, max(0.0, float(fraction)))
        now = time.monotonic()
        last_phase, last_time = self._reported
        if phase != last_phase or now - last_time >= PROGRESS_SECONDS:
            self._reported = phase, now
            self._send(protocol.Progress(self._current, phase, self._fraction))

    @property
    def _prepares(self) -> bool:
        """Whether it is no fault that a request takes long: imports, kernels that are compiled here or elsewhere."""
        return self._preparing > 0 or is_counted(self._reported[0])

    def _note_preparing(self, change: int, phase: str = PREPARING) -> None:
        """Count what cannot be interrupted: imports, kernels that are being compiled."""
        self._steps += 1
        self._preparing += change
        if change > 0:
            self._progress(phase, self._fraction)
        if self._preparing <= 1:
            self._send(protocol.Alive(self._steps, self._prepares))

    def _fail(self, request: int, error: str, subject: str, problem: str, remedy: str) -> None:
        self._send(protocol.Failed(request, error, subject, problem, remedy))

    def _send(self, message: Any, arrays: dict[str, Array] | None = None) -> None:
        try:
            self.link.send(message, arrays)
        except OSError:  # the client is gone
            _exit(EXIT_OK)


def _refuse(link: Link, problem: str) -> None:
    """Send why the link cannot be used, and end the process."""
    logger.error("the client does not speak the engine's protocol: %s", problem)
    with contextlib.suppress(OSError):  # nobody may be listening
        link.send(protocol.Failed(0, "EngineError", "engine link", problem, "Install the same version of both"))
    _exit(EXIT_INTERNAL)


def _exit(code: int) -> None:
    leave_temporary()
    logging.shutdown()
    os._exit(code)


def claim_pipes() -> Link:
    """Keep the pipes for messages: whatever else writes to standard output goes to standard error from now on."""
    reader = os.fdopen(claim_input(), "rb", buffering=0)
    writer = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    return Link(reader, writer)


def die_with_parent() -> None:
    """Ask Linux to kill this process when its parent dies; elsewhere the end of standard input has to do."""
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    pr_set_pdeathsig = 1
    if ctypes.CDLL(None, use_errno=True).prctl(pr_set_pdeathsig, signal.SIGKILL, 0, 0, 0) != 0:
        logger.warning("cannot tie the engine to its parent: errno %d", ctypes.get_errno())


def shake_hands(link: Link) -> None:
    """Greet the client and take over the shared regions; ends the process when the versions differ."""
    link.send(protocol.Hello(PROTOCOL, __version__, os.getpid()))
    try:
        received = link.receive()
    except ProtocolError as error:
        _refuse(link, str(error))
        raise AssertionError("unreachable") from error
    if received is None:
        _exit(EXIT_OK)
        raise AssertionError("unreachable")
    welcome = received[0]
    if not isinstance(welcome, protocol.Welcome):
        _refuse(link, f"expected Welcome, received {type(welcome).__name__}")
    if not protocol.same_version(welcome):
        logger.error("client %s, engine %s", welcome.version, __version__)
        problem = f"is version {welcome.version}, the engine is version {__version__}"
        with contextlib.suppress(OSError):  # the client may have left already
            link.send(protocol.Failed(0, "VersionError", "extension", problem, "Install the same version of both"))
        _exit(EXIT_VERSION)
    try:
        link.incoming = Region(welcome.to_engine) if welcome.to_engine > 2 else None
        link.outgoing = Region(welcome.to_client) if welcome.to_client > 2 else None
        link.files = socket.socket(fileno=welcome.files) if welcome.files > 2 else None
    except OSError as error:
        _refuse(link, f"the shared regions cannot be used ({error})")


def main() -> None:
    """Run the engine on this process's standard input and output until the client leaves."""
    link = claim_pipes()
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(name)s: %(message)s")
    faulthandler.enable(sys.stderr)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal is for the client, which ends us
    die_with_parent()
    if megabytes := requested_limit(sys.argv):
        limit_memory(megabytes)
    shake_hands(link)
    Server(link).serve()
