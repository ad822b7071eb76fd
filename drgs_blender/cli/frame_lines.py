"""The lines a farm's worker reads from ``drgs render``: Fra:, Saved:, Time:, skipping; one at least every 30 s."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from typing import IO

from ..core.errors import EXIT_CLASSES
from ..core.phases import is_preparing

HEARTBEAT_SECONDS = 30.0
#: Between two progress lines of one frame.
PROGRESS_SECONDS = 5.0


def emit(text: str, stream: IO[str] | None) -> None:
    """Write a text at once. A log that cannot be written, as its disk is full, costs words and no frames.

    Raises
    ------
    BrokenPipeError
        The reader is gone.
    """
    if stream is None:  # given up before
        return
    try:
        stream.write(text)
        stream.flush()
    except BrokenPipeError:
        raise
    except OSError:
        pass  # nobody reads it


def is_for_farms(arguments: Sequence[str]) -> bool:
    """Whether a command is one that farms run, whose log may be lost."""
    command = next((word for word in arguments if not word.startswith("-")), None)
    return command in ("render", "denoise") and not {"-h", "--help"} & set(arguments)


def emit_exit_class(arguments: Sequence[str], code: int) -> None:
    """The last line of the commands that farms run, which they read."""
    if is_for_farms(arguments):
        emit(f"DRGS_EXIT class={EXIT_CLASSES.get(code, 'internal')}\n", sys.stdout)


class FrameLines:
    """Prints to stdout; a context manager that keeps a heartbeat going.

    With `openjd`, the number of frames of the job, sessions of Open Job Description get its progress.
    The words "Error:", "Exception:" and "Warning" never occur in benign lines: strict workers fail a task on them.
    """

    def __init__(
        self, heartbeat: float = HEARTBEAT_SECONDS, interval: float = PROGRESS_SECONDS, openjd: int = 0
    ) -> None:
        self._heartbeat, self._interval = heartbeat, interval
        self._openjd, self._finished = openjd, 0
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._last = self._started = time.monotonic()
        self._doing = "Fra:- | Starting Blender"
        self._samples = 0

    def __enter__(self) -> FrameLines:
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def begin(self, frame: int, samples: int = 0, phase: str = "Rendering") -> None:
        """A frame's description arrived; it takes `samples` samples per pixel, which 0 leaves out of the lines."""
        self._started, self._samples = time.monotonic(), samples
        self._emit(self._line(frame, phase, 0.0), doing=True)

    def progress(self, frame: int, phase: str, fraction: float) -> None:
        """Report the progress of a picture; most calls print nothing."""
        fraction = 0.0 if is_preparing(phase) else min(max(fraction, 0.0), 1.0)  # nothing of the picture is done
        self._doing = self._line(frame, phase.capitalize(), fraction)
        if time.monotonic() - self._last >= self._interval:
            self._emit(self._doing)
            self._report_to_openjd(fraction, f"frame {frame}, {phase}")

    def _line(self, frame: int, phase: str, fraction: float) -> str:
        """The line of a frame, with the samples per pixel that are done, as Blender writes it."""
        samples = f" | Sample {round(fraction * self._samples)}/{self._samples}" if self._samples else ""
        return f"Fra:{frame} | {phase}{samples}"

    def finished(self, frames: int) -> None:
        """Note that `frames` frames of the job are there, made or found."""
        self._finished = frames
        self._report_to_openjd(0.0, f"{frames} of {self._openjd} frames")

    def saved(self, path: object) -> None:
        """A frame is on disk and verified."""
        minutes, seconds = divmod(time.monotonic() - self._started, 60)
        self._emit(f"Saved: '{path}'\n Time: {int(minutes):02d}:{seconds:05.2f}")

    def skipped(self, path: object) -> None:
        """A frame is there already, complete and of the same settings."""
        self._emit(f"skipping existing frame '{path}'")

    def note(self, text: str) -> None:
        """Print a warning that does not stop the job."""
        self._emit(f"Note: {text}")

    def _report_to_openjd(self, fraction: float, status: str) -> None:
        if self._openjd:
            done = 100 * (self._finished + min(max(fraction, 0.0), 1.0)) / self._openjd
            self._emit(f"openjd_progress: {min(done, 100.0):.1f}\nopenjd_status: {status}")

    def _emit(self, line: str, doing: bool = False) -> None:
        with self._lock:
            if doing:
                self._doing = line
            self._last = time.monotonic()
            emit(line + "\n", sys.stdout)

    def _beat(self) -> None:
        while not self._ended.wait(min(1.0, self._heartbeat / 4)):
            if time.monotonic() - self._last >= self._heartbeat:
                self._emit(self._doing)
