"""Commands that depend on each other, side by side, with one line that says what is under way. Standard library only.

Each that has ended stays as a line with its time. What the commands write goes to a log file; of one that fails the
last lines are shown.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

_LINES = 12
#: Seconds between two looks at the clock, and before time left is estimated.
_TICK, _EARLY = 0.5, 3.0
#: Part of a step from which on what it counts gives its speed.
_ESTIMATED = 0.15
#: Part of the time left that steps may have of which only `Step.seconds` is known.
_UNCOUNTED = 0.25
#: Seconds that a command has to end what it started.
_GRACE = 5.0
_COUNT = re.compile(r"(\d+) of (\d+)")


class StepFailed(Exception):
    """A command failed; the message is for the user."""


@dataclass
class Step:
    """One command.

    Attributes
    ----------
    name : what the others call it, and the log
    text : what is done, for people
    command : program and arguments
    seconds : that it takes on some machine: believed where it is little beside what others are seen to take
    after : names of the steps that come before it
    makes, of : the file that it makes, and what that depends on; the same again is not made again
    count : of a line that it writes what is to be said instead of `text`, and the part that is done; or None
    before : what is done before it starts
    measured : whether it first does something else than what it counts, such as starting a program
    title : what the line calls it that has its time; `text` without
    """

    name: str
    text: str
    command: Sequence[object]
    seconds: float
    after: tuple[str, ...] = ()
    makes: Path | None = None
    of: tuple[Path, ...] = ()
    count: Callable[[str], tuple[str, float] | None] = lambda line: None
    before: Callable[[], object] = lambda: None
    measured: bool = False
    title: str = ""
    #: What is known while it runs.
    process: subprocess.Popen[bytes] | None = None
    status: str = ""
    part: float = 0.0
    began: float = 0.0
    first: tuple[float, float] = (0.0, 0.0)  # the least part that was counted, and the last moment it was so
    latest: float = 0.0  # moment of the newest part
    tail: deque[str] = field(default_factory=lambda: deque(maxlen=_LINES))
    thread: threading.Thread | None = None
    stamp: str = ""  # digest of `of` at its start


def counted(line: str) -> tuple[str, float] | None:
    """Of a line with "3 of 12", the third being under way, the line itself and the part that is done."""
    found = _COUNT.search(line)
    return (line, (int(found[1]) - 1) / max(int(found[2]), 1)) if found else None


def run_steps(
    steps: Sequence[Step], log: Path, folder: Path, environment: dict[str, str], stream: IO[str] | None = None
) -> float:
    """Run all `steps`, each as soon as those before it are done; return the seconds it took.

    Parameters
    ----------
    log : file for what the commands write; begun again
    folder : where they run
    environment : of the commands, besides this process's
    stream : where the line is written; standard output without

    Raises
    ------
    StepFailed
        A command failed, and all others were ended.
    KeyboardInterrupt
        After all commands were ended.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "w", encoding="utf-8") as log_file:
        return _Run(steps, log, folder, environment, log_file, Line(stream or sys.stdout)).whole()


class Line:
    """The line that says what is under way: rewritten on a terminal, otherwise one for each change."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream, self._terminal = stream, stream.isatty()
        self._last, self._width = "", 0

    def show(self, text: str, left: str) -> None:
        """Say `text`, followed by the time `left`; that alone is no change."""
        if self._terminal:
            room = max(shutil.get_terminal_size().columns - 1, 20)
            whole = f"{text}; {left}" if left else text
            if len(whole) > room:
                end = f"...; {left}" if left else "..."
                whole = text[: max(room - len(end), 0)] + end
            self._write("\r" + whole.ljust(self._width))
            self._width = len(whole)
        elif text != self._last:
            self._write(f"{text}; {left}\n" if left else f"{text}\n")
        self._last = text

    def keep(self, text: str) -> None:
        """Say a line that stays."""
        self.clear()
        self._write(f"{text}\n")

    def clear(self) -> None:
        """Leave an empty line on a terminal."""
        if self._terminal:
            self._write("\r" + " " * self._width + "\r")

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


class _Run:
    def __init__(
        self, steps: Sequence[Step], log: Path, folder: Path, environment: dict[str, str], log_file: IO[str], line: Line
    ) -> None:
        self._steps, self._log, self._folder = list(steps), log, folder
        # Unbuffered: what a Python prints stands in the log when it is printed, and before the error that ends it.
        self._environment = os.environ | {"PYTHONUNBUFFERED": "1"} | environment
        self._log_file, self._line = log_file, line
        self._lock = threading.Lock()
        self._done: set[str] = set()
        self._changed = threading.Event()
        self._began = time.monotonic()

    def whole(self) -> float:
        """All of it."""
        try:
            self._start()
            while len(self._done) < len(self._steps):
                self._show()
                self._changed.wait(_TICK)
                self._changed.clear()
                self._collect()
                self._start()
        finally:
            self._end()
            self._line.clear()
        return time.monotonic() - self._began

    def _start(self) -> None:
        """Start what can be; a step that has nothing to do lets others start."""
        while True:
            ready = [s for s in self._steps if s.name not in self._done and s.process is None]
            ready = [s for s in ready if self._done.issuperset(s.after)]
            idle = [s for s in ready if not self._begin(s)]
            if not idle:
                return

    def _begin(self, step: Step) -> bool:
        """Start a step; whether there was something to do."""
        command = [str(part) for part in step.command]
        if step.makes is not None:
            step.stamp = digest(step.of, command)
            if step.makes.is_file() and _stamp(step.makes) == step.stamp:
                self._write(step, f"{step.makes} is up to date")
                self._line.keep(f"{step.title or step.text}: nothing has changed")
                self._done.add(step.name)
                return False
            _stamp_file(step.makes).unlink(missing_ok=True)
        step.before()
        self._write(step, "$ " + " ".join(command))
        step.status, step.began = step.text, time.monotonic()
        try:
            step.process = subprocess.Popen(
                command,
                cwd=self._folder,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=os.name != "nt",
            )
        except OSError as error:
            raise StepFailed(f"{step.text} failed: {command[0]} cannot be started ({error})") from error
        step.thread = threading.Thread(target=self._follow, args=(step,), daemon=True)
        step.thread.start()
        return True

    def _follow(self, step: Step) -> None:
        assert step.process is not None and step.process.stdout is not None
        with step.process.stdout as stream:
            for raw in stream:
                line = raw.decode("utf-8", "replace").rstrip()
                self._write(step, line)
                if line:
                    step.tail.append(line)
                if found := step.count(line):
                    self._count(step, *found)
                    self._changed.set()
        step.process.wait()
        self._changed.set()

    @staticmethod
    def _count(step: Step, status: str, part: float) -> None:
        step.status, step.latest = status, time.monotonic()
        if not step.first[1] or part <= step.first[0]:
            step.first = (part, step.latest)
        step.part = part

    def _write(self, step: Step, line: str) -> None:
        with self._lock:
            self._log_file.write(f"{time.monotonic() - self._began:7.1f} {step.name}: {line}\n")
            self._log_file.flush()

    def _collect(self) -> None:
        """Take note of what has ended."""
        for step in self._steps:
            if step.process is None or step.name in self._done or step.process.poll() is None:
                continue
            if step.thread is not None:
                step.thread.join(5.0)
            if step.process.returncode:
                self._line.clear()
                command = " ".join(str(part) for part in step.command)
                status = "\n".join(f"    {line}" for line in step.tail)
                failed = f"{step.title or step.text} failed ({step.process.returncode})"
                raise StepFailed(f"{failed}: {command}\n{status}\nAll of it: {self._log}")
            if step.makes is not None:
                _stamp_file(step.makes).write_text(json.dumps({"of": step.stamp}), encoding="utf-8")
            self._done.add(step.name)
            if name := step.title or step.text:
                self._line.keep(f"{name}: {time.monotonic() - step.began:.1f} s")

    def _show(self) -> None:
        running = [s for s in self._steps if s.process is not None and s.name not in self._done]
        text = f"{len(self._done)} of {len(self._steps)} done. {', '.join(s.status for s in running)}"
        self._line.show(text.rstrip(), self._left())

    def _left(self) -> str:
        """The time until the last step, of those that wait for each other, is done; "" where too little tells it."""
        now = time.monotonic()
        if now - self._began < _EARLY:
            return ""
        remaining = [step for step in self._steps if step.name not in self._done]
        remains: dict[str, float] = {}
        guessed = 0.0
        for step in remaining:
            counted = self._by_count(step, now)
            if counted is None:
                spent = now - step.began if step.process is not None else 0.0
                if spent > step.seconds:
                    return ""
                guessed += step.seconds
            remains[step.name] = step.seconds if counted is None else counted
        ends: dict[str, float] = {}

        def until_end(step: Step) -> float:
            if step.name not in ends:
                later = (until_end(other) for other in remaining if step.name in other.after)
                ends[step.name] = remains[step.name] + max(later, default=0.0)
            return ends[step.name]

        left = max(map(until_end, remaining), default=0.0)
        return f"about {clock(left)} left" if guessed <= _UNCOUNTED * left else ""

    @staticmethod
    def _by_count(step: Step, now: float) -> float | None:
        """Seconds that a step still takes, by what it has counted; None where that does not tell."""
        if step.process is None:
            return None
        if step.measured:
            if step.part <= step.first[0]:
                return None
            rate = (step.latest - step.first[1]) / (step.part - step.first[0])
            return max(rate * (1.0 - step.part) - (now - step.latest), 0.0)
        return (now - step.began) * max(1.0 - step.part, 0.0) / step.part if step.part > _ESTIMATED else None

    def _end(self) -> None:
        """End what still runs, with all that it started."""
        for step in self._steps:
            process = step.process
            if process is None or process.poll() is not None:
                continue
            if os.name == "nt":
                subprocess.run(["taskkill", "/F", "/T", "/PID", str(process.pid)], capture_output=True)
            else:
                with contextlib.suppress(OSError):  # it ended by itself just now
                    os.killpg(process.pid, signal.SIGTERM)
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(_GRACE)
                    os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def clock(seconds: float) -> str:
    """A duration in words, roughly."""
    if seconds >= 90:
        return f"{round(seconds / 60)} min"
    return f"{max(5, 5 * round(seconds / 5))} s"


#: Folders of what is made of sources.
_PRODUCTS = {"__pycache__", "kernels"}


def digest(files: Iterable[Path], command: Sequence[str]) -> str:
    """Digest of `files`, of all files in those that are folders, and of the command."""
    found = hashlib.sha256("\0".join(command).encode())
    for top in files:
        for path in sorted(p for p in top.rglob("*") if not _PRODUCTS.intersection(p.parts)) if top.is_dir() else [top]:
            if path.is_file():
                found.update(f"{path}\0".encode())
                found.update(path.read_bytes())
    return found.hexdigest()


def _stamp_file(made: Path) -> Path:
    return made.with_name(f".{made.name}.made")


def _stamp(made: Path) -> str:
    try:
        found = json.loads(_stamp_file(made).read_text(encoding="utf-8"))
        return str(found["of"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


__all__ = ["Line", "Step", "StepFailed", "clock", "counted", "digest", "run_steps"]
