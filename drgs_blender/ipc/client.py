"""The engine seen from the extension: start it, load assets, render frames, survive its death.

numpy and the standard library only. All waiting is done with a deadline, and while waiting the caller's `cancelled`
is asked at least every 50 ms and its `on_progress` is called, both on the calling thread.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import queue
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np

from ..core.errors import (
    ERROR_CLASSES,
    AssetError,
    Cancelled,
    DrgsError,
    EngineError,
    UsageError,
    VersionError,
)
from ..core.frame import Frame
from ..core.level_of_detail import MOST_SURFELS
from . import protocol
from .child_process import Child
from .codec import CodecError, encode_frame
from .handshake import greet
from .locate import engine_command, locate_engine
from .protocol import Passes, sendable
from .slots import SentSlots
from .watchdog import EngineLost, Watchdog

logger = logging.getLogger(__name__)

Array = np.ndarray
OnProgress = Callable[[str, float], None]
IsCancelled = Callable[[], bool]
T = TypeVar("T")

_POLL = 0.04
_CANCEL_WAIT = 0.3


class EngineClient:
    """A DR-GS engine in a process of its own.

    Requests may come from any thread; they are served one at a time. Nothing is started before the first request.

    Parameters
    ----------
    command : list of str
        Command line of the engine, see `locate_engine`.
    silence : float
        Timeout: seconds without a heartbeat after which the engine counts as dead.
    handshake : float
        Seconds a new process has to say something; importing Python on a busy machine takes some.
    stall : float
        Timeout: seconds its main thread may work on one step.
    restarts : int
        How often one request is repeated on a new engine after the old one died.
    shared : bool
        Exchange arrays through shared memory where the system has it.
    """

    def __init__(
        self,
        command: list[str],
        *,
        silence: float = 20.0,
        handshake: float = 45.0,
        stall: float = 900.0,
        restarts: int = 1,
        shared: bool = True,
    ) -> None:
        self.command = list(command)
        self.silence, self.handshake, self.stall = silence, handshake, stall
        self.restarts, self.shared = restarts, shared
        self._child: Child | None = None
        self._sent = SentSlots()
        self._assets: dict[str, str] = {}
        self._to_load: list[str] = []
        self._number = 0
        self._busy = threading.Lock()
        self._closing = False
        self._past_log = ""
        _clients.add(self)

    @property
    def pid(self) -> int:
        """Process id of the running engine, 0 when there is none."""
        return self._child.pid if self._child is not None and self._child.running else 0

    @property
    def log(self) -> str:
        """The latest lines of the engine's standard error, for an error report."""
        return self._child.log if self._child is not None else self._past_log

    @property
    def bulk_bytes(self) -> tuple[int, int]:
        """Bytes of arrays sent to and received from the running engine so far."""
        link = self._child.link if self._child is not None else None
        return (link.bulk_sent, link.bulk_received) if link is not None else (0, 0)

    def start(self, cancelled: IsCancelled | None = None) -> None:
        """Start the engine if it does not run, and shake hands.

        Raises
        ------
        DeviceError
            When the command cannot be run, ends at once, or does not speak as an engine does.
        VersionError
            When the engine is of another version.
        EngineError
            When it was killed while it started, and the next one as well.
        """
        with self._exclusive(cancelled):
            self._repeating(lambda: None, None, cancelled)

    def load_asset(self, path: str, on_progress: OnProgress | None = None, cancelled: IsCancelled | None = None) -> str:
        """Load the asset file at `path`, or look whether it changed; return its key for `ObjectState.asset`.

        Raises
        ------
        AssetError, EngineError, DeviceError, VersionError, Cancelled
        """
        with self._exclusive(cancelled):
            return self._repeating(lambda: self._load(str(path), on_progress, cancelled), on_progress, cancelled)

    def render(
        self, frame: Frame, on_progress: OnProgress | None = None, cancelled: IsCancelled | None = None
    ) -> Passes:
        """Render `frame`.

        Parameters
        ----------
        frame : Frame
        on_progress : callable, optional
            Called with the phase and the part done in [0, 1].
        cancelled : callable, optional
            Asked often; once it says True, `Cancelled` is raised within half a second.

        Returns
        -------
        Passes
            Pass name -> (h, w, c) float32 of the camera's window, with ``.warnings`` and ``.statistics``.

        Raises
        ------
        UsageError, AssetError
            When the frame cannot be rendered.
        EngineError
            When the engine died or fell silent, and once more when the frame was repeated.
        DeviceError, VersionError, Cancelled
        """
        description, ready = _encoded(frame)

        def work() -> Passes:
            return self._picture(
                ready, lambda number, slots: protocol.Render(number, description, slots), on_progress, cancelled
            )

        with self._exclusive(cancelled):
            return self._repeating(work, on_progress, cancelled)

    def view(
        self,
        name: str,
        frame: Frame,
        go_on: bool = False,
        on_progress: OnProgress | None = None,
        cancelled: IsCancelled | None = None,
        most: int = MOST_SURFELS,
    ) -> Passes:
        """The first picture of `frame` in the viewport `name`; with `go_on` the next one, of more samples.

        Until it has samples, it shows at most `most` surfels, or all with 0, see `Session.view`.

        ``statistics["view.fraction"]`` is the part of all samples that the picture has. A coarse picture has fewer
        pixels than the window of the frame's camera, which they cover evenly. A new engine that does not know the
        viewport begins it again.

        Raises
        ------
        As `render`; after `Cancelled` the viewport is as it was, or not known.
        """
        description, ready = _encoded(frame)

        def work() -> Passes:
            if go_on:
                answer, pictures = self._request(protocol.Refine(self._next(), name), {}, on_progress, cancelled)
                if isinstance(answer, protocol.Result):
                    return Passes(pictures, answer.warnings, answer.statistics)
            return self._picture(
                ready,
                lambda number, slots: protocol.View(number, name, description, slots, most),
                on_progress,
                cancelled,
            )

        with self._exclusive(cancelled):
            return self._repeating(work, on_progress, cancelled)

    def wake(self) -> None:
        """Have a request under way ask its `cancelled` at once. May be called from any thread, and never waits."""
        child = self._child
        if child is not None:
            child.inbox.put(None)

    def close(self) -> None:
        """End the engine; a request under way ends with `Cancelled`, a later one starts a new engine."""
        self._closing = True
        try:
            with self._busy:
                if self._child is not None:
                    self._abandon(grace=1.0)
        finally:
            self._closing = False

    def __enter__(self) -> EngineClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        child = getattr(self, "_child", None)
        if child is not None:
            child.kill()

    def _picture(
        self,
        ready: dict[str, Array],
        message: Callable[[int, dict[str, int]], Any],
        on_progress: OnProgress | None,
        cancelled: IsCancelled | None,
    ) -> Passes:
        """Send what changed of the arrays `ready` with a `message`, everything when the engine lacks something."""
        for _ in range(2):
            versions, changed = self._sent.changes(ready)
            answer, pictures = self._request(message(self._next(), versions), changed, on_progress, cancelled)
            if isinstance(answer, protocol.Result):
                return Passes(pictures, answer.warnings, answer.statistics)
            self._sent.forget()
        raise EngineLost("keeps asking for arrays it was sent")

    # --- one request -----------------------------------------------------------------------------------------------

    def _next(self) -> int:
        self._number += 1
        return self._number

    def _stopped(self, cancelled: IsCancelled | None) -> bool:
        return self._closing or (cancelled is not None and cancelled())

    @contextlib.contextmanager
    def _exclusive(self, cancelled: IsCancelled | None) -> Iterator[None]:
        while not self._busy.acquire(timeout=_POLL):
            if self._stopped(cancelled):
                raise Cancelled
        try:
            yield
        finally:
            self._busy.release()

    def _repeating(self, work: Callable[[], T], on_progress: OnProgress | None, cancelled: IsCancelled | None) -> T:
        """Do `work` on a running engine, again on a new one when the engine is lost."""
        for attempt in range(self.restarts + 1):
            try:
                self._ensure(on_progress, cancelled)
                return work()
            except EngineLost as loss:
                problem = str(loss)
                if self._child is not None and isinstance(loss.__cause__, EOFError):
                    problem = self._child.exit_message()
                self._abandon()
                if attempt == self.restarts:
                    remedy = "Try again; if it happens again, see the engine's log and look at the memory it has"
                    raise EngineError("engine", problem, remedy) from loss
                logger.warning("the engine %s; it is started again", problem)
            except EngineError:
                self._abandon()
                raise
        raise AssertionError("unreachable")

    def _abandon(self, grace: float = 0.0) -> None:
        """End the running engine, if any, and what is known of it."""
        if self._child is not None:
            self._child.close(grace)
            self._past_log = self._child.log
            self._child = None
        self._sent.forget()

    def _ensure(self, on_progress: OnProgress | None, cancelled: IsCancelled | None) -> None:
        """Have a running engine that knows all assets. Cancelled half way, the next call goes on from there."""
        if self._child is None or not self._child.running:
            self._abandon()
            self._child = Child(self.command, self.shared)
            self._to_load = list(self._assets)
        if not self._child.greeted:
            try:
                watchdog = Watchdog(self._child, self.handshake, self.stall)
                greet(self._child, self.command[0], watchdog, lambda: self._stopped(cancelled))
            except DrgsError:
                self._abandon()
                raise
        while self._to_load:
            path = self._to_load[0]
            try:
                self._load(path, on_progress, cancelled)
            # The frame may not use it any more; if it does, the engine says so.
            except (AssetError, VersionError) as error:
                logger.warning("asset not loaded again: %s", error)
                del self._assets[path]
            del self._to_load[0]

    def _load(self, path: str, on_progress: OnProgress | None, cancelled: IsCancelled | None) -> str:
        answer, _ = self._request(protocol.LoadAsset(self._next(), path), {}, on_progress, cancelled)
        if not isinstance(answer, protocol.Loaded):
            raise EngineLost(f"answered {type(answer).__name__} when asked to load an asset")
        self._assets[path] = answer.key
        return answer.key

    def _request(
        self,
        message: Any,
        arrays: dict[str, Array],
        on_progress: OnProgress | None,
        cancelled: IsCancelled | None,
    ) -> tuple[Any, dict[str, Array]]:
        """Send `message` and wait for its answer, which is returned unless it is an error."""
        child = self._child
        assert child is not None
        self._settle(child, on_progress, cancelled)
        child.request(message, arrays)
        watchdog = Watchdog(child, self.silence, self.stall)
        stop_at = None
        try:
            while True:
                item = self._next_reply(child, on_progress)
                if item is not None and item[0].id == message.id:
                    if isinstance(item[0], protocol.Stopped):
                        raise Cancelled
                    if isinstance(item[0], protocol.Failed):
                        raise _as_error(item[0])
                    return item
                watchdog.check()
                if stop_at is None and self._stopped(cancelled):
                    stop_at = time.monotonic() + (0.0 if self._closing else _CANCEL_WAIT)
                    child.cancel(message.id)
                if stop_at is not None and time.monotonic() > stop_at:
                    raise Cancelled
        finally:
            if stop_at is None and not child.idle.is_set():  # on_progress or cancelled raised
                child.cancel(message.id)

    def _settle(self, child: Child, on_progress: OnProgress | None, cancelled: IsCancelled | None) -> None:
        """Wait until the engine has answered a request that was cancelled before."""
        watchdog = Watchdog(child, self.silence, self.stall)
        while not child.idle.is_set():
            self._next_reply(child, on_progress)
            watchdog.check()
            if self._stopped(cancelled):
                raise Cancelled

    def _next_reply(self, child: Child, on_progress: OnProgress | None) -> tuple[Any, dict[str, Array]] | None:
        """The next answer, or None after a short wait; progress is passed on."""
        try:
            item = child.inbox.get(timeout=_POLL)
        except queue.Empty:
            if child.preparing and on_progress is not None:
                on_progress(*child.last_progress)
            return None
        if item is None:  # see `wake`
            return None
        if isinstance(item, CodecError):
            raise UsageError("frame", str(item), "Correct the setting or object it names") from item
        if isinstance(item, Exception):
            raise EngineLost(str(item) or type(item).__name__) from item
        if isinstance(item[0], protocol.Progress):
            child.last_progress = item[0].phase, item[0].fraction
            if on_progress is not None:
                on_progress(*child.last_progress)
            return None
        if isinstance(item[0], protocol.Failed) and item[0].id == 0:
            raise EngineLost(f"refused a message: {item[0].problem}")
        return item


def _encoded(frame: Frame) -> tuple[dict[str, Any], dict[str, Array]]:
    """Description and arrays of a frame; UsageError where it cannot be sent."""
    try:
        description, arrays = encode_frame(frame)
        return description, {slot: sendable(array) for slot, array in arrays.items()}
    except CodecError as error:
        raise UsageError("frame", str(error), "Correct the setting or object it names") from error


def _as_error(failure: protocol.Failed) -> DrgsError:
    kind = ERROR_CLASSES.get(failure.error, DrgsError)
    return kind(failure.subject, failure.problem, failure.remedy)


_clients: weakref.WeakSet[EngineClient] = weakref.WeakSet()


@atexit.register
def close_all() -> None:
    """End every engine of this process; registered to run when it exits."""
    for client in list(_clients):
        client.close()


__all__ = ["EngineClient", "Passes", "close_all", "engine_command", "locate_engine"]
