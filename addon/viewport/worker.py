"""The thread between the viewports and the engine. It never touches Blender, and Blender never waits for it.

The newest frame of a viewport wins: one that was not begun yet is replaced, a picture that is being refined is
interrupted. A first picture is always finished, so that something is seen however quickly frames follow each other.
Of several viewports the one that waits longest for its first picture goes first, then the one with the fewest samples.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from ...drgs_blender.core.errors import Cancelled, DrgsError
from ...drgs_blender.core.frame import Frame
from ...drgs_blender.core.level_of_detail import MOST_SURFELS
from ...drgs_blender.core.phases import is_counted
from ...drgs_blender.ipc.blur import Mean
from ...drgs_blender.ipc.client import EngineClient, Passes

log = logging.getLogger("drgs")

#: Side of the pixels beyond which a picture is refined before it is blurred.
_SHARP_UNTIL = 4
#: Seconds after a move until all surfels are drawn, where a picture has fewer.
REST_SECONDS = 0.15
#: Moves that follow each other within these seconds are taken for one that goes on. Nothing is refined then for twice
#: the time between the last two: it would not be seen, takes processors from Blender, and delays the next picture.
PAUSE_SECONDS = 0.1


@dataclass(frozen=True, slots=True)
class Request:
    """A viewport's request: frame, client, assets.

    Attributes
    ----------
    assets : path of every asset in the frame, with the file's time and size, by which changes are found
    parts : frames of whose pictures the mean is the blurred one; the frame's own picture is sharp and comes first
    most : surfels of a picture until the view rests; 0: all
    """

    frame: Frame
    client: EngineClient
    assets: tuple[tuple[str, tuple[int, int]], ...] = ()
    parts: Sequence[Frame] = ()
    most: int = MOST_SURFELS


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture of a request; ``fraction`` of its samples are in it."""

    request: Request
    passes: Passes
    fraction: float
    seconds: float  # from the request to the picture

    @property
    def surfels(self) -> tuple[int, int]:
        """How many surfels it shows, and how many there are."""
        shown, whole = (int(self.passes.statistics.get(f"view.{name}", 0.0)) for name in ("surfels", "all"))
        return shown, whole


@dataclass(slots=True)
class _View:
    name: str
    request: Request
    submitted: float
    moved: float  # when the latest request came
    interval: float = 0.0  # seconds between the last two
    begun: bool = False
    fraction: float = 0.0
    picture: Picture | None = None
    error: str = ""
    phase: str = ""
    part: float = 0.0
    many: bool = False  # whether there are more surfels than pictures have before the view rests
    pixel: float = 0.0  # side of the pixels of the last picture, 0 before there is one
    mean: Mean | None = None  # of the parts of a blurred one


class Worker:
    """Keeps the pictures of all viewports growing. Its methods may be called from any thread and return at once."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._views: dict[str, _View] = {}
        self._loaded: tuple[object, dict[str, object]] = None, {}
        self._thread: threading.Thread | None = None
        self._held = 0
        self._ending = False
        self.news = 0

    def submit(self, name: str, request: Request) -> None:
        """Show something else in the viewport `name`."""
        with self._changed:
            view = self._views.get(name)
            if view is None:
                view = self._views[name] = _View(name, request, time.perf_counter(), 0.0)
            elif view.begun:
                view.submitted = time.perf_counter()
            now = time.perf_counter()
            view.moved, view.interval = now, now - view.moved
            view.request, view.begun, view.fraction, view.error = request, False, 0.0, ""
            view.pixel, view.mean = 0.0, None
            if self._thread is None:
                self._ending = False
                self._thread = threading.Thread(target=self._run, name="drgs-viewport", daemon=True)
                self._thread.start()
            self._changed.notify()
        request.client.wake()

    def drop(self, name: str) -> None:
        """The viewport is gone."""
        with self._changed:
            view = self._views.pop(name, None)
        if view is not None:
            view.request.client.wake()

    def names(self) -> list[str]:
        """The viewports that were not dropped."""
        with self._changed:
            return list(self._views)

    def picture(self, name: str) -> Picture | None:
        """The newest picture of a viewport."""
        view = self._views.get(name)
        return None if view is None else view.picture

    def state(self, name: str) -> tuple[str, str]:
        """Status of a viewport: (what is being done, an error or "")."""
        view = self._views.get(name)
        return ("", "") if view is None else (view.phase, view.error)

    def progress(self, name: str) -> tuple[str, float]:
        """Phase of the next picture of a viewport, and the part of it that is done."""
        view = self._views.get(name)
        return ("", 0.0) if view is None else (view.phase, view.part)

    def busy(self) -> bool:
        """Whether there is something to do."""
        with self._changed:
            return not self._held and any(_unfinished(view) for view in self._views.values())

    def hold(self) -> None:
        """Leave the engine to somebody else until `release`."""
        with self._changed:
            self._held += 1
            clients = {view.request.client for view in self._views.values()}
        for client in clients:
            client.wake()

    def release(self) -> None:
        """Undo one `hold`."""
        with self._changed:
            self._held -= 1
            self._changed.notify()

    def stop(self) -> None:
        """Drop everything and end the thread."""
        with self._changed:
            thread, self._thread = self._thread, None
            views, self._views = self._views, {}
            self._ending = True
            self._changed.notify()
        for view in views.values():
            view.request.client.wake()
        if thread is not None:
            thread.join(2.0)

    # --- the thread ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._changed:
                while (view := self._next()) is None and not self._ending:
                    self._changed.wait(None if self._held or not self._unrested() else PAUSE_SECONDS / 8)
                if self._ending or view is None:
                    return
                request, first, submitted = view.request, not view.begun, view.submitted
                view.begun = True
            try:
                self._load(view, request)
                stop = self._stop_begin(view) if first else self._stop_refining(view, request)
                passes = self._next_picture(view, request, first, stop)
            except Cancelled:
                with self._changed:
                    view.begun = view.begun and not first
                continue
            except DrgsError as error:
                self._fail(view, request, str(error))
                continue
            except Exception as error:  # nobody else would hear of it, and the viewport would stand still
                log.exception("viewport %s", view.name)
                self._fail(view, request, f"DR-GS failed ({type(error).__name__}: {error})")
                continue
            now = time.perf_counter()
            fraction = passes.statistics.get("view.fraction", 1.0)
            with self._changed:
                view.picture, view.phase, view.part = Picture(request, passes, fraction, now - submitted), "", 0.0
                view.many = view.picture.surfels[0] <= request.most < view.picture.surfels[1]
                if view.request is request:
                    view.fraction = fraction
            self.news += 1

    def _next_picture(self, view: _View, request: Request, first: bool, stop: Callable[[], bool]) -> Passes:
        """The first picture of a request, or one with finer pixels, more samples or more of its parts."""
        note = partial(self._note_phase, view)
        if first or not request.parts or view.pixel > _SHARP_UNTIL:
            passes = request.client.view(view.name, request.frame, not first, note, stop, request.most)
            with self._changed:
                if view.request is request:
                    view.pixel = passes.statistics.get("view.pixel", 1.0)
            if request.parts:
                passes.statistics["view.fraction"] = 0.0
            return passes
        mean = view.mean or Mean()  # `submit` takes that of another request away
        mean.add(request.client.render(request.parts[mean.count], note, stop))
        with self._changed:
            if view.request is request:
                view.mean = mean
        passes = mean.passes(request.frame.passes)
        passes.statistics["view.fraction"] = mean.count / len(request.parts)
        return passes

    def _next(self) -> _View | None:
        """The view to work on; called with the lock held."""
        if self._held:
            return None
        waiting = [view for view in self._views.values() if not view.begun]
        if waiting:
            return min(waiting, key=lambda view: view.submitted)
        resting = self._unrested()
        growing = [view for view in self._views.values() if _unfinished(view) and view not in resting]
        return min(growing, key=lambda view: view.fraction, default=None)

    def _unrested(self) -> list[_View]:
        """Views that have just moved, longer ago where they show fewer surfels than there are; with the lock held.

        What they show next would not be drawn before the next move, and to end half way takes a while, too.
        """
        now = time.perf_counter()

        def rest(view: _View) -> float:
            pause = 2.0 * view.interval if view.interval < PAUSE_SECONDS else 0.0
            return max(REST_SECONDS, pause) if view.many and view.fraction == 0.0 else pause

        return [v for v in self._views.values() if v.begun and _unfinished(v) and v.moved > now - rest(v)]

    def _stop_begin(self, view: _View) -> Callable[[], bool]:
        return lambda: self._ending or self._held > 0 or self._views.get(view.name) is not view

    def _stop_refining(self, view: _View, request: Request) -> Callable[[], bool]:
        begin = self._stop_begin(view)

        def stop() -> bool:
            return begin() or view.request is not request or any(not v.begun for v in list(self._views.values()))

        return stop

    def _load(self, view: _View, request: Request) -> None:
        """Have the engine map the assets that it has not, or not as they are now."""
        client, loaded = self._loaded
        if client is not request.client:
            loaded = {}
            self._loaded = request.client, loaded
        for path, stamp in request.assets:
            if loaded.get(path) != stamp:
                request.client.load_asset(
                    path,
                    lambda phase, part: self._note_phase(view, phase, part),
                    lambda: self._ending or self._held > 0,
                )
                loaded[path] = stamp

    def _note_phase(self, view: _View, phase: str, part: float) -> None:
        """Take a phase in; there is news where the viewport says something else, see `views.status`."""
        changed = phase != view.phase or (is_counted(phase) and f"{part:.0%}" != f"{view.part:.0%}")
        view.phase, view.part = phase, part
        self.news += changed

    def _fail(self, view: _View, request: Request, text: str) -> None:
        with self._changed:
            if view.request is request:
                view.error, view.fraction = text, 1.0
        self.news += 1


def _unfinished(view: _View) -> bool:
    return not view.begun or view.fraction < 1.0
