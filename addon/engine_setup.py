"""The engine's own environment: made by one command after another, none of which is waited for.

Standard library only. What was finished stays finished: after a cancellation, a lost connection or a crash the same
set-up goes on, and packages that pip has already fetched come from its cache. Blender's own Python is only asked to
make an environment somewhere else; nothing is ever installed into it.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from ..drgs_blender.core.errors import DeviceError
from ..drgs_blender.core.phases import PREPARING
from ..drgs_blender.core.system import WINDOWS, replace
from ..drgs_blender.ipc.child_process import clean_environment
from ..drgs_blender.ipc.locate import VARIABLE
from .engine_environment import (
    CAPTURE,
    ENGINE,
    GPU,
    PACKAGE,
    PYTHONS,
    RECONSTRUCT,
    SOURCE,
    Group,
    alive,
    digest,
    entry,
    interpreter,
    needs_network,
    pinned,
    read_stamp,
    requirements,
    site_packages,
    write_stamp,
)

log = logging.getLogger("drgs")

#: What is said of kernels that are not there.
_LATER = "What is missing is compiled when it is first used"

#: Apart from the user's own Python settings; lines arrive as they are written, in UTF-8.
_FLAGS = ("-I", "-u", "-X", "utf8")
#: Share of a step with packages after which they are there and are only unpacked.
_FETCHED = 0.75
#: Lines of venv, pip and `drgs doctor` that say why.
_REASON = re.compile(r"error|^missing|not created|no module", re.IGNORECASE)
#: Words of pip where an index does not answer; what it says last is that there is no such package.
_UNREACHED = re.compile(r"^Could not fetch URL (\S+?):? .*?\((?:Caused by )?(\w+)|after connection broken by '(\w+)")
#: How many kernels are compiled, of how many.
_COUNT = re.compile(re.escape(PREPARING) + r", (\d+) of (\d+)")
#: Name and size of a package that pip begins with.
_PACKAGE = re.compile(r"(?:Downloading|Using cached|Processing) (?:\S*/)?([A-Za-z0-9_.]+?)-\d\S*( \([\d.]+ \wB\))?")


@dataclass(slots=True)
class Step:
    """One command, and what is done when it has succeeded; the engine works without what is not `needed`."""

    text: str
    command: list[str]
    weight: float  # its part of the time
    then: Callable[[], None] = lambda: None
    download: float = 0.0  # bytes that it fetches, about
    before: Callable[[], None] = lambda: None
    needed: bool = True


class EngineSetup:
    """A set-up under way. Call `poll` now and then; it never waits.

    Parameters
    ----------
    folder : the environment to make or to go on with
    python : interpreter that makes it
    source : folder that holds pyproject.toml and drgs_blender
    afresh : take nothing of an earlier set-up
    extras : further groups of packages
    index : address of a package index that is asked besides those that pip knows

    Attributes
    ----------
    text : the present step, for people
    fraction : 0..1
    fetched : bytes of packages that came so far, of the step under way
    log_file : beside the folder; what the commands wrote
    error : why it ended, or None
    remark : parts that the ready engine lacks, and why; or ""
    done : whether nothing more will happen
    """

    def __init__(
        self,
        folder: Path,
        python: Path,
        source: Path = SOURCE,
        afresh: bool = False,
        extras: Sequence[Group] = (),
        index: str = "",
    ) -> None:
        self.folder, self.source = folder, source
        self.log_file = folder.with_name(f"{folder.name}-setup.log")
        self.text, self.fraction, self.fetched = "Starting", 0.0, 0.0
        self.error: DeviceError | None = None
        self.remark = ""
        self.done = False
        self._share = 0.0  # of the whole, of the step under way
        self._began = 0.0
        self._process: subprocess.Popen[bytes] | None = None
        self._lines: IO[bytes] | None = None
        self._tail: list[str] = []
        self._package, self._package_bytes = "", 0.0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            missing = [g for g in (ENGINE, *extras) if afresh or needs_network(folder, source, g)]
            free, needed = shutil.disk_usage(folder).free, sum(g.disk for g in missing)
            if free < needed:
                raise DeviceError(
                    str(folder),
                    f"has {free / 1e6:.0f} MB left, the engine needs {needed / 1e6:.0f}",
                    "Make room, or install the engine elsewhere and choose that environment",
                )
        except OSError as error:
            raise DeviceError(str(folder), f"cannot be made ({error})", "Check its permissions") from error
        self._steps = self._plan(python, afresh, missing, index)
        self._total_weight = sum(s.weight for s in self._steps)
        self._next()

    def poll(self) -> bool:
        """Take note of what happened; return `done`."""
        if self.done or self._process is None:
            return self.done
        code = self._process.poll()
        self._read()
        if code is None:
            return False
        step = self._steps.pop(0)
        self._close()
        try:
            if code:
                raise OSError(self._reason(code)[:300])
            step.then()
        except OSError as error:
            if not self._continues_without(step, error):
                return True
        self.fraction = self._began + self._share
        self._next()
        return self.done

    def _continues_without(self, step: Step, error: OSError) -> bool:
        """Whether the set-up goes on without what a step was for; else it has failed."""
        problem = f"{step.text} failed: {error}"
        if step.needed:
            self._fail(problem)
        else:
            self.remark = f"{problem.rstrip('. ')}. {_LATER}. {self.log_file} has the details"
            log.warning("%s", self.remark)
        return not step.needed

    def _reason(self, code: int) -> str:
        """Why a command failed, in its own words, as far as those are found in its output."""
        for line in self._tail:
            if unreached := _UNREACHED.search(line):
                kind = unreached[2] or unreached[3]
                return f"the package index does not answer ({kind})"
        reason = next((t for t in reversed(self._tail) if _REASON.search(t)), None)
        return reason or " ".join(self._tail[-2:]) or f"exit code {code}"

    def cancel(self) -> None:
        """End the command under way and all it started. What was finished stays."""
        if self._process is not None and self._process.poll() is None:
            if WINDOWS:
                self._process.terminate()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._close()
        if self._steps and self._steps[0].text == PREPARING:
            self.remark = _LATER
        self.done, self.text = True, "Cancelled"

    def _plan(self, python: Path, afresh: bool, missing: list[Group], index: str) -> list[Step]:
        """What is left to do. Extras and their kernels come last: without them the engine renders."""
        own = interpreter(self.folder)
        pip = [str(own), *_FLAGS, "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
        pip += ["--extra-index-url", index] if index else []

        def fetch(text: str, group: Group) -> Step:
            needed = list(requirements(self.source, group))
            command = [*pip, "--only-binary=:all:", "--progress-bar=raw", *needed]
            return Step(text, command, 0.8, lambda: write_stamp(self.folder, **{entry(group): needed}), group.download)

        steps = []
        if ENGINE in missing:
            clear = afresh or (own.is_symlink() and not own.exists()) or (own.is_file() and not alive(self.folder))
            make = [str(python), *_FLAGS, "-m", "venv", *(["--clear"] if clear else []), str(self.folder)]
            steps += [
                Step("Making an environment", make, 0.05),
                Step("Preparing pip", [*pip, "pip>=24.1"], 0.05),
                fetch("Installing packages", ENGINE),
            ]
        if (pins := list(pinned(self.source))) and (ENGINE in missing or read_stamp(self.folder).get("pinned") != pins):
            # First, so that the packages find them there; what pip cannot get leaves kernels to be compiled.
            exact = [*pip, "--only-binary=:all:", "--progress-bar=raw", *pins]
            keep = lambda: write_stamp(self.folder, pinned=pins)  # noqa: E731
            steps.insert(max(len(steps) - 1, 0), Step("Installing Numba", exact, 0.1, keep, needed=False))
        doctor = [str(own), *_FLAGS, "-m", f"{PACKAGE}.cli.main", "doctor"]
        ready = lambda: write_stamp(self.folder, sources=digest(self.source))  # noqa: E731
        steps.append(Step("Trying the engine", doctor, 0.1, ready, before=self._copy))
        names = {RECONSTRUCT: "PyTorch", CAPTURE: "COLMAP", GPU: "NVIDIA Warp"}
        steps += [fetch(f"Installing {names[group]}", group) for group in missing if group in names]
        kernels = [str(own), *_FLAGS, "-m", f"{PACKAGE}.compute.prepare", "--all"]
        return [*steps, Step(PREPARING, kernels, 0.3, needed=False)]

    def _next(self) -> None:
        """Start the next command, or end."""
        if not self._steps:
            self.done, self.text, self.fraction = True, "Ready", 1.0
            return
        step = self._steps[0]
        self.text, self._tail, self._began = step.text, [], self.fraction
        self._share = step.weight / self._total_weight
        self.fetched = self._package_bytes = 0.0
        try:
            step.before()
            with open(self.log_file, "ab") as out:
                self._lines = open(self.log_file, "rb")  # noqa: SIM115 - lives as long as the process
                self._lines.seek(0, os.SEEK_END)
                environment = clean_environment()
                environment.pop(VARIABLE, None)
                self._process = subprocess.Popen(
                    step.command,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=subprocess.STDOUT,
                    env=environment,
                    start_new_session=not WINDOWS,
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )
        except OSError as error:
            if self._continues_without(step, error):
                self._steps.pop(0)
                self._next()

    def _copy(self) -> None:
        """Put the engine's sources into the environment; the old ones go only when the new ones are there."""
        target = site_packages(self.folder) / PACKAGE
        fresh, old = target.with_name(f"{PACKAGE}.new"), target.with_name(f"{PACKAGE}.old")
        for stale in (fresh, old):
            shutil.rmtree(stale, ignore_errors=True)
        shutil.copytree(self.source / PACKAGE, fresh, ignore=shutil.ignore_patterns("__pycache__"))
        if target.exists():
            replace(target, old)
        replace(fresh, target)
        shutil.rmtree(old, ignore_errors=True)

    def _read(self) -> None:
        """Follow the output of the command."""
        for raw in self._lines.readlines() if self._lines is not None else ():
            line = raw.decode(errors="replace").strip()
            if progress := re.fullmatch(r"Progress (\d+) of (\d+)", line):
                self._package_bytes, size = float(progress[1]), float(progress[2])
                if size > 5e6:
                    self.text = f"Fetching {self._package}, {self._package_bytes / 1e6:.0f} of {size / 1e6:.0f} MB"
            elif line:
                self._tail = [*self._tail[-9:], line]
                self._follow(line)
        if expected := self._steps[0].download:
            part = min((self.fetched + self._package_bytes) / expected, 1.0) * _FETCHED
            self.fraction = max(self.fraction, self._began + part * self._share)

    def _follow(self, line: str) -> None:
        """What a line of pip says about how far it is."""
        if count := _COUNT.match(line):
            done = min(int(count[1]) / max(int(count[2]), 1), 1.0)
            self.text, self.fraction = line, max(self.fraction, self._began + done * self._share)
        elif package := _PACKAGE.match(line):
            self.fetched, self._package_bytes = self.fetched + self._package_bytes, 0.0
            self._package = package[1]
            self.text = f"Fetching {package[1]}{package[2] or ''}"
        elif line.startswith("Installing collected packages"):
            self.text, self.fraction = self._steps[0].text, self._began + _FETCHED * self._share

    def _fail(self, problem: str) -> None:
        self._close()
        self.done, self.text = True, "Failed"
        self.error = DeviceError(
            "Engine set-up",
            problem.rstrip(". "),
            f"Press Set Up Engine to go on; it needs a network and a Python of version {PYTHONS}. "
            f"{self.log_file} has the details",
        )
        log.error("%s", self.error)

    def _close(self) -> None:
        if self._lines is not None:
            self._lines.close()
            self._lines = None
        self._process = None
