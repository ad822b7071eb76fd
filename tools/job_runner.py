"""Programs that run side by side: `Runner` runs `Job`s, shows what each printed, ends what takes too long.

Standard library only.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

#: A job that takes longer hangs.
SECONDS = 2400
#: How often a run without a terminal says how far it is.
PROGRESS_SECONDS = 30
#: pytest's exit code where no test fits what was asked for.
NO_TESTS = 5


@dataclass
class Job:
    """A program of a run.

    Attributes
    ----------
    title : str
        For people.
    commands : list of list of str
        Run one after another, all of them.
    log : Path
        What they print.
    report : Path or None
        The JUnit file that pytest writes.
    seconds : float
        Longest time of one command.
    environment : dict of str
        Variables besides.
    after : str
        Title of a job that has to end before.
    alone : bool
        Whether nothing else may run.
    may_be_empty : bool
        Whether it passes where no test fits.
    """

    title: str
    commands: list[list[str]]
    log: Path
    report: Path | None = None
    seconds: float = SECONDS
    environment: dict[str, str] = field(default_factory=dict)
    after: str = ""
    alone: bool = False
    may_be_empty: bool = False

    def exit_code(self, code: int) -> int:
        """Exit code of a command, 0 if it is as good as that."""
        return 0 if code == NO_TESTS and self.may_be_empty else code


class Runner:
    """Runs jobs side by side; what each prints is shown when it has ended.

    Parameters
    ----------
    root : Path
        Folder that programs start in.
    environment : mapping of str to str
        Their variables.
    workers : int
        Jobs at a time.
    """

    def __init__(self, root: Path, environment: Mapping[str, str], workers: int) -> None:
        self.root, self.environment, self.workers = root, dict(environment), workers
        #: Title -> exit codes of its commands.
        self.codes: dict[str, list[int]] = {}
        self._processes: list[subprocess.Popen] = []
        self._last_report = time.monotonic()
        self._line = 0

    def run(self, all_jobs: Sequence[Job]) -> None:
        """Run all; on an interrupt end all with their children."""
        if len(all_jobs) == 1:
            with self._ending():
                self._alone_at_a_terminal(all_jobs[0])
            return
        waiting, running = list(all_jobs), list[_Running]()
        titles = {job.title for job in all_jobs}
        with self._ending():
            while waiting or running:
                for job in list(waiting):
                    ready = not (job.after in titles and job.after not in self.codes)
                    room = not running if job.alone else len(running) < self.workers
                    if any(other.job.alone for other in running) or not (ready and room):
                        continue
                    if job.alone and any(not other.alone for other in waiting):
                        continue
                    waiting.remove(job)
                    running.append(_Running(job, self._start))
                time.sleep(0.1)
                for item in [item for item in running if item.ended()]:
                    running.remove(item)
                    self.codes[item.job.title] = item.codes
                    self._show(item)
                self._progress(running)

    def _alone_at_a_terminal(self, job: Job) -> None:
        """A single job prints as it goes, so that a debugger can be used."""
        codes = self.codes.setdefault(job.title, [])
        for command in job.commands:
            process = self._start(job, command, None)
            try:
                codes.append(job.exit_code(process.wait(job.seconds)))
            except subprocess.TimeoutExpired:
                print(f"{job.title}: ended after {job.seconds:.0f} s", flush=True)
                end(process)
                codes.append(124)

    def _start(self, job: Job, command: Sequence[str], log: IO[bytes] | None) -> subprocess.Popen:
        process = subprocess.Popen(
            list(command), cwd=self.root, env=self.environment | job.environment, stdout=log,
            stderr=subprocess.STDOUT if log else None, stdin=subprocess.DEVNULL if log else None,
            start_new_session=os.name != "nt",
        )  # fmt: skip
        self._processes.append(process)
        return process

    @contextlib.contextmanager
    def _ending(self) -> Iterator[None]:
        """End everything that still runs, also where this program is asked to end."""
        before = signal.signal(signal.SIGTERM, interrupt)
        try:
            yield
        finally:
            signal.signal(signal.SIGTERM, before)
            self._erase()
            for process in self._processes:
                end(process)

    def _show(self, item: _Running) -> None:
        self._erase()
        text = item.job.log.read_text(encoding="utf-8", errors="replace")
        bad = any(item.codes)
        print(f"== {item.job.title}: {'FAILED' if bad else 'done'} after {item.seconds:.0f} s", flush=True)
        if bad:
            print(text.rstrip(), flush=True)
            if item.late:
                print(f"{item.job.title}: ended after {item.job.seconds:.0f} s; where it was is said above", flush=True)
        elif item.job.report is not None:
            # why tests were skipped, and how many passed
            at = text.rfind("= short test summary info =")
            lines = text[at:].splitlines()[1:] if at >= 0 else text.splitlines()[-1:]
            print("\n".join(lines), flush=True)

    def _progress(self, running: Sequence[_Running]) -> None:
        terminal, now = sys.stdout.isatty(), time.monotonic()
        if not running or now - self._last_report < (1 if terminal else PROGRESS_SECONDS):
            return
        self._last_report = now
        line = "   ".join(f"{item.job.title} {item.progress()}" for item in running)
        if terminal:
            line = line[: shutil.get_terminal_size().columns - 1]
            print("\r" + line.ljust(self._line), end="", flush=True)
            self._line = len(line)
        else:
            print(f"   ... {line}", flush=True)

    def _erase(self) -> None:
        if self._line:
            print("\r" + " " * self._line + "\r", end="", flush=True)
            self._line = 0


class _Running:
    """A job under way."""

    def __init__(self, job: Job, start: Callable[[Job, Sequence[str], IO[bytes]], subprocess.Popen]) -> None:
        self.job, self._start = job, start
        self.codes: list[int] = []
        self.late = False
        self.began = time.monotonic()
        job.log.parent.mkdir(parents=True, exist_ok=True)
        self._log = job.log.open("wb")
        self._next()

    def _next(self) -> None:
        self._since = time.monotonic()
        self._process = self._start(self.job, self.job.commands[len(self.codes)], self._log)

    def ended(self) -> bool:
        """Whether all its commands have ended; starts the next, and ends one that takes too long."""
        code = self._process.poll()
        if code is None and time.monotonic() - self._since > self.job.seconds:
            end(self._process)
            self.late, code = True, 124
        if code is None:
            return False
        self.codes.append(self.job.exit_code(code))
        if len(self.codes) < len(self.job.commands):
            self._next()
            return False
        self._log.close()
        self.seconds = time.monotonic() - self.began
        return True

    def progress(self) -> str:
        """Progress as pytest reports it, else the time it has been running."""
        with contextlib.suppress(OSError), self.job.log.open("rb") as log:
            log.seek(max(0, self.job.log.stat().st_size - 4000))
            if found := re.findall(rb"\[ *(\d+%)\]", log.read()):
                return found[-1].decode()
        return f"{time.monotonic() - self.began:.0f} s"


def interrupt(*_: object) -> None:
    """Handler of a signal that ends a program as Ctrl+C does."""
    raise KeyboardInterrupt


def end(process: subprocess.Popen, patience: float = 5.0) -> None:
    """End a program of its own group with all its children: asked first, so that it tidies up."""
    if process.poll() is not None:
        return
    if os.name == "nt":
        subprocess.run(["taskkill", "/F", "/T", "/PID", str(process.pid)], capture_output=True)
        process.wait()
        return
    os.killpg(process.pid, signal.SIGINT)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(patience)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
