"""``drgs simulate`` in a process of its own, which Blender only watches."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote

from ...drgs_blender.core.errors import (
    EXIT_CANNOT_WRITE,
    EXIT_TERMINATED,
    AssetError,
    EngineError,
    UsageError,
    WriteError,
)
from ...drgs_blender.ipc.child_process import clean_environment
from .. import engine_link
from . import scene_export

#: Seconds that Blender waits for a program that is ended, and seconds after which that is killed: saving what it needs
#: to go on takes some.
_WAIT, _PATIENCE = 0.2, 5.0
#: Prefix of the messages in the program's log.
_PREFIX = "drgs: "
_COUNTS = re.compile(r"(\d+) particles.*at least (\d+) time steps")
#: Who is meant, of several that are simulated together.
_BODY = re.compile(r'body "([^"]+)"')
#: A line while kernels are compiled.
_PREPARING = re.compile(r'DRGS_PROGRESS part=([\d.]+) phase="([^"]*)"')


#: Programs that were asked to end and have not yet, with the time until which they may take.
_ending: list[tuple[subprocess.Popen[bytes], float]] = []


def ending() -> bool:
    """Whether a program that was ended still saves what it needs to go on; kills one that takes too long."""
    for entry in list(_ending):
        process, until = entry
        if process.poll() is not None:
            _close_input(process)
            _ending.remove(entry)
        elif time.monotonic() > until:
            process.kill()
    return bool(_ending)


def _subject_of(line: str, subject: str) -> str:
    """Of several objects that are simulated, the one that a line is about."""
    named = set(_BODY.findall(line))
    return f'Object "{named.pop()}"' if len(named) == 1 else subject


def _close_input(process: subprocess.Popen[bytes]) -> None:
    assert process.stdin is not None, "it was made a pipe"
    process.stdin.close()


class SimulateProcess:
    """One run on what `scene_export` wrote.

    Parameters
    ----------
    inputs : folder of the capture
    folder : the cache; what it holds of other settings is removed
    threads : 0 for all cores
    device : "cpu" or "cuda"
    others : folders of the captures of the other bodies that are simulated with this one

    Attributes
    ----------
    name : in messages

    Raises
    ------
    DeviceError, UsageError
        There is no engine, or it cannot be started.
    """

    def __init__(
        self, inputs: Path, folder: Path, threads: int = 0, device: str = "cpu", others: Sequence[Path] = ()
    ) -> None:
        self._counts: tuple[int, int] | None = None
        self._captures, self._folder = [inputs, *others], folder
        self._stdout, self._log = inputs / scene_export.STDOUT, inputs / scene_export.LOG
        command = engine_link.drgs_command()
        self._python = command[0]
        self.name = f"drgs simulate of {command[0]}"
        arguments = [inputs / scene_export.BODY, "--settings", inputs / scene_export.SETTINGS, "--out", folder]
        arguments += ["--device", device]
        if others:
            arguments = ["--settings", inputs / scene_export.BODIES]
        arguments += ["--overwrite", "--threads", str(threads)]
        try:
            with open(self._stdout, "wb") as output, open(self._log, "wb") as log:
                self._process = subprocess.Popen(
                    [*command, "--no-progress", "simulate", *map(str, arguments)],
                    stdin=subprocess.PIPE,
                    stdout=output,
                    stderr=log,
                    env=clean_environment() | {"DRGS_PROGRESS": "1"},
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),  # Windows alone has it
                )
        except OSError as error:
            raise UsageError("Engine", f"{command[0]} cannot be started ({error})", "See the preferences") from error

    @property
    def alive(self) -> bool:
        """Whether it still works."""
        return self._process.poll() is None

    @property
    def counts(self) -> tuple[int, int] | None:
        """Particles, and time steps a frame at least; None until the body is filled."""
        if self._counts is None:
            with suppress(OSError):
                found = _COUNTS.search(self._stdout.read_text(encoding="utf-8", errors="replace"))
                self._counts = (int(found[1]), int(found[2])) if found else None
        return self._counts

    @property
    def preparation(self) -> tuple[float, str]:
        """The part that is done of what comes before the body is filled, and words for it; (0, "") before any."""
        with suppress(OSError):
            found = _PREPARING.findall(self._stdout.read_text(encoding="utf-8", errors="replace"))
            if found:
                return float(found[-1][0]), found[-1][1]
        return 0.0, ""

    def end(self, save: bool = True) -> None:
        """End it if it runs; while it saves what it needs to go on, `ending` is true. Without, it is killed."""
        if any(process is self._process for process, _ in _ending):
            return
        if self.alive:
            if save:
                engine_link.ask_to_end(self._process)
            else:
                self._process.kill()
            try:
                self._process.wait(_WAIT)
            except subprocess.TimeoutExpired:
                # Its input stays open: to close it would be to ask a second time, in the middle of what it saves.
                _ending.append((self._process, time.monotonic() + _PATIENCE))
                return
        _close_input(self._process)

    def result(self, subject: str, held: str = "") -> list[str]:
        """Warnings of the program, after it has ended by itself.

        Parameters
        ----------
        subject : name of the object in messages
        held : a sentence about what there is all the same

        Raises
        ------
        AssetError, WriteError, EngineError, DeviceError
            It could not do its work.
        """
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        code = self._process.wait()
        _close_input(self._process)
        if code == 0:
            told = (self._in_words(line.removeprefix(_PREFIX)) for line in lines)
            return [f"{_subject_of(line, subject)}: {line}" for line in told]
        reported = next((line for line in reversed(lines) if line.startswith(_PREFIX)), "")
        if reported and code != EXIT_TERMINATED:
            line = self._in_words(reported.removeprefix(_PREFIX)).rstrip(".")
            raise AssetError(_subject_of(line, subject), line, held)
        if code == EXIT_CANNOT_WRITE:  # nor could its log
            remedy = "Free some space or choose another folder, and bake again"
            raise WriteError(f"{subject}, {self._folder}", "cannot be written", f"{remedy}. {held}".rstrip(". "))
        last = lines[-1][:300] if lines else "it printed nothing"
        engine_link.check_installed(self._python, last)
        remedy = "Bake again: it goes on" + (f". {held}" if held else "")
        raise EngineError(subject, f"the engine's program ended ({code}): {last.rstrip('.')}", remedy)

    def _in_words(self, line: str) -> str:
        """A line of the engine's program without the files that `scene_export` wrote: the artist knows objects."""
        for inputs in self._captures:
            line = line.replace(f"{inputs / scene_export.BODY}: ", "").replace(f"{inputs}{os.sep}", "")
        return scene_export.COLLIDER_FILE.sub(lambda found: f'collider "{unquote(found[1])}"', line)
