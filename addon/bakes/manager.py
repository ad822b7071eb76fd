"""What is to be baked, by whom it is wanted, and the one thread that has a Blender of its own bake it.

The thread touches nothing of Blender. What an export wants replaces what the same scene wanted before: of a slider that
is dragged only the latest value is baked, after the one that is under way.
"""

from __future__ import annotations

import atexit
import logging
import shutil
import tempfile
import threading
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...drgs_blender.core.errors import Cancelled, DrgsError
from . import main_thread
from .blender_process import BlenderProcess
from .store import Baked, Store

log = logging.getLogger("drgs")

#: Seconds without a job after which the Blender that bakes is ended.
IDLE = 60.0
_POLL = 0.1
#: Reason of what the user stopped.
STOPPED = "it was cancelled"
_FILES = "the files for it cannot be written"

OnProgress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Request:
    """Something to be baked.

    Attributes
    ----------
    key : str
        Of the result; names all that it depends on.
    label : str
        What is baked, for messages.
    write : callable
        Writes what the job needs into a folder, on Blender's main thread; returns the job, JSON-able.
    """

    key: str
    label: str
    write: Callable[[Path], dict[str, Any]]


@dataclass(slots=True)
class _Job:
    request: Request
    folder: Path
    job: dict[str, Any]
    is_cancelled: bool = False


class Manager:
    """The bakes of this Blender.

    Attributes
    ----------
    store : Store
    failed : dict of str to str
        Why something could not be baked, by its key. It is tried again with the next render, or when it changes.
    told : dict of str to set of str
        Warnings of that, by the label of the request.
    news : int
        Grows with everything that was baked or has failed.
    """

    def __init__(self) -> None:
        self.store = Store()
        self.failed: dict[str, str] = {}
        self.told: dict[str, set[str]] = {}
        self.news = 0
        self._wanted: dict[Hashable, list[str]] = {}
        self._waiting: dict[str, _Job] = {}
        self._running: _Job | None = None
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._done = 0
        self._ends = False

    def find(self, key: str) -> Baked | None:
        """The result of `key`, where it is there."""
        return self.store.find(key)

    def want(self, owner: Hashable, requests: list[Request]) -> None:
        """Have `requests` baked; they replace those that `owner` made before. On Blender's main thread only."""
        self._want(owner, requests, lambda request, folder: request.write(folder))

    def wait(
        self, owner: Hashable, requests: list[Request], progress: OnProgress, cancelled: Callable[[], bool]
    ) -> None:
        """Have `requests` baked, and wait until each is there or has failed. On any thread.

        Raises
        ------
        Cancelled
            `cancelled` said so.
        """

        def write(request: Request, folder: Path) -> dict[str, Any]:
            return main_thread.call(lambda: request.write(folder), cancelled)

        try:
            self._want(owner, requests, write)
            keys = [request.key for request in requests]
            while True:
                if cancelled():
                    raise Cancelled
                with self._changed:
                    left = [key for key in keys if self._is_open(key)]
                    if not left:
                        return
                    text, part = self._status()
                    self._changed.wait(_POLL)
                progress(text, part)
        finally:
            self.drop(owner, at_once=True)

    def drop(self, owner: Hashable, at_once: bool = False) -> None:
        """`owner` wants nothing any more; with `at_once`, what is baked for nobody else is ended."""
        with self._changed:
            self._wanted.pop(owner, None)
            self._sort_out(at_once)

    def status(self) -> tuple[str, float]:
        """What is being baked, as "Baking 1 of 3: World "Sky"", and the part that is done; ("", 0) without any."""
        with self._changed:
            return self._status()

    def cancel(self) -> None:
        """Stop all bakes; what they were of counts as failed."""
        with self._changed:
            for job in [*self._waiting.values(), *([self._running] if self._running else [])]:
                self._fail(job, STOPPED)
            self._wanted.clear()
            self._sort_out(at_once=True)

    def retry(self) -> None:
        """What has failed may be tried again."""
        with self._changed:
            self.failed.clear()

    def stop(self) -> None:
        """End everything, and wait for the thread."""
        with self._changed:
            self._wanted.clear()
            self._sort_out(at_once=True)
            self._ends = True
            self._changed.notify_all()
            thread = self._thread
        if thread is not None:
            thread.join(5.0)
        with self._changed:
            self._ends = False
            self.failed.clear()
            self.told.clear()
            self.store.forget()

    # --- with the lock held -----------------------------------------------------------------------------------------

    def _is_open(self, key: str) -> bool:
        return key in self._waiting or (self._running is not None and self._running.request.key == key)

    def _status(self) -> tuple[str, float]:
        job = self._running or next(iter(self._waiting.values()), None)
        if job is None:
            return "", 0.0
        count = self._done + len(self._waiting) + (self._running is not None)
        return f"Baking {self._done + 1} of {count}: {job.request.label}", self._done / count

    def _fail(self, job: _Job, reason: str) -> None:
        self.failed[job.request.key] = reason
        self.news += 1

    def _sort_out(self, at_once: bool) -> None:
        """Forget the jobs that nobody wants."""
        wanted = {key for keys in self._wanted.values() for key in keys}
        for key in [key for key in self._waiting if key not in wanted]:
            _clear(self._waiting.pop(key).folder)
        if at_once and self._running is not None and self._running.request.key not in wanted:
            self._running.is_cancelled = True
        self._changed.notify_all()

    # --- without it -------------------------------------------------------------------------------------------------

    def _want(self, owner: Hashable, requests: list[Request], write: Callable[[Request, Path], dict[str, Any]]) -> None:
        with self._changed:
            self._wanted[owner] = [request.key for request in requests]
            if not requests:
                del self._wanted[owner]
            self._sort_out(at_once=False)
            new = [r for r in requests if not self._is_open(r.key) and r.key not in self.failed]
        for request in {request.key: request for request in new}.values():
            folder: Path | None = None
            try:
                folder = Path(tempfile.mkdtemp(prefix="drgs-bake-"))
                job = write(request, folder) | {"key": request.key, "folder": str(folder)}
            except (OSError, RuntimeError, DrgsError) as error:
                _clear(folder)
                with self._changed:
                    self.failed[request.key] = f"{_FILES} ({str(error).strip()})"
                    self.news += 1
                continue
            except BaseException:
                _clear(folder)
                raise
            with self._changed:
                self._waiting[request.key] = _Job(request, folder, job)
                if self._thread is None:
                    self._thread = threading.Thread(target=self._run, name="drgs-bake", daemon=True)
                    self._thread.start()
                self._changed.notify_all()

    def _run(self) -> None:
        """The thread: one job after the other."""
        blender: BlenderProcess | None = None
        try:
            while (job := self._next()) is not None:
                reason = ""
                try:
                    if blender is None or not blender.alive:
                        if blender is not None:
                            blender.close()
                        blender = BlenderProcess()
                    blender.do(job.job, lambda job=job: job.is_cancelled)  # type: ignore[misc]
                    self.store.add(job.request.key, job.folder / "result.npz")
                except Cancelled:
                    reason = STOPPED
                except DrgsError as error:
                    reason = error.problem
                except Exception as error:  # whatever a damaged result does, the others are baked
                    log.exception("bake of %s", job.request.label)
                    reason = f"{type(error).__name__}: {error}"
                finally:
                    _clear(job.folder)
                with self._changed:
                    self._running = None
                    self._done += 1
                    if not reason:
                        self.news += 1
                    elif not job.is_cancelled:
                        self._fail(job, reason)
                    if not self._waiting:
                        self._done = 0
                    self._changed.notify_all()
        finally:
            if blender is not None:
                blender.close()

    def _next(self) -> _Job | None:
        """The next job; None where there was none for a while: then the thread has ended."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ends, IDLE)
            if self._ends or not self._waiting:
                self._thread = None
                return None
            key = next(iter(self._waiting))
            self._running = self._waiting.pop(key)
            return self._running


def _clear(folder: Path | None) -> None:
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


manager = Manager()


def _end() -> None:
    with suppress(Exception):  # Python is ending
        manager.stop()


atexit.register(_end)
