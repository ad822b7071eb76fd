"""Operators whose work the command ``drgs`` does, in a process of its own: Blender goes on, Esc ends it."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import bpy

from ..addon import assets, engine_link, messages, output_check, running
from ..drgs_blender.core.errors import AssetError, EngineError, UsageError
from ..drgs_blender.ipc.child_process import clean_environment
from .base import DrgsOperator

_INTERVAL = 0.25
#: Of the lines of ``drgs`` that are warnings or, where it fails, its error.
_PREFIX = "drgs: "
#: Seconds between two lines in the terminal of a Blender without a window.
_REPORT_EVERY = 10.0


class CommandOperator(DrgsOperator):
    """Base of operators that give `start` the arguments of ``drgs`` and go on in `done` when it has done its work.

    They lack REGISTER: to adjust or repeat an operator that goes on beside the window ends Blender (seen in 5.2).
    """

    _process: subprocess.Popen[bytes] | None = None
    _log: Path | None = None
    _timer: bpy.types.Timer | None = None
    _subject, _failure, _program, _python = "", "", "", ""
    _expected = output_check.ExpectedFiles()
    _folder: Path | None = None
    #: All output of the program, as it was last read.
    _output = ""
    #: What the program has warned of so far, in the order of its lines.
    _warned: tuple[str, ...] = ()
    #: Whether the panel Workflow shows it while it runs.
    shows_progress = True
    _running: running.Running | None = None

    def done(self, context: bpy.types.Context) -> set[str]:
        """Called after the program has succeeded; returns what execute returns."""
        return {"FINISHED"}

    def state(self, output: str) -> str:
        """Progress for the status bar, from all output of the program so far."""
        return ""

    def follow(self, context: bpy.types.Context, output: str) -> None:
        """Called now and then while the program works beside a window, with all its output."""

    def stopped(self, event: bpy.types.Event) -> bool:
        """Whether the work is to end before its time."""
        return event.type == "ESC"

    @contextlib.contextmanager
    def folder(self, prefix: str) -> Iterator[Path]:
        """A temporary folder for what the program reads and writes; it goes with the work, and when this fails."""
        self._folder = Path(tempfile.mkdtemp(prefix=prefix))
        try:
            yield self._folder
        except BaseException:
            self.clear()
            raise

    @property
    def work_folder(self) -> Path:
        """The folder that `folder` has made."""
        assert self._folder is not None, "only within `folder`"
        return self._folder

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The program, once it is started."""
        assert self._process is not None, "only after `start`"
        return self._process

    def clear(self) -> None:
        """Remove what was made for the program alone; called however it ends."""
        assets.renounce(self._expected.paths)
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def start(
        self,
        context: bpy.types.Context,
        arguments: list[str],
        subject: str,
        status: str,
        failure: str,
        files: Iterable[Path],
    ) -> set[str]:
        """Run ``drgs`` with `arguments`; in the background, wait for it.

        Parameters
        ----------
        subject : name of the object in messages
        status : text of the status bar meanwhile
        failure : predicate of the message where the program fails: "could not be ..."
        files : files that it writes
        """
        self._subject, self._failure, self._warned = subject, failure, ()
        self._expected = output_check.ExpectedFiles(files)
        assets.announce(self._expected.paths)
        try:
            self._spawn(arguments)
            if bpy.app.background or context.window is None:
                self._wait()
                return self._finish(context)
        except BaseException:
            self.clear()
            raise
        self._running = running.begin(status) if self.shows_progress else None
        self._timer = context.window_manager.event_timer_add(_INTERVAL, window=context.window)
        context.window_manager.modal_handler_add(self)
        context.workspace.status_text_set(f"{status}: Esc cancels")
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.stopped(event) or (self._running is not None and self._running.cancelled):
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self.process.poll() is None:
            output = self._read_output()
            self._tell_warnings(output)
            self.follow(context, output)
            if self._running is not None:
                self._running.follow(output)
                redraw_sidebars(context)
            return {"PASS_THROUGH"}
        self._release(context)
        return self.guard(self._finish, context)

    def cancel(self, context: bpy.types.Context) -> None:
        """End the process; called by Esc and when Blender closes."""
        if self._process is not None:
            engine_link.ask_to_end(self._process)
            try:
                self._process.wait(2)  # a kernel that is under way hears of it late; Blender's window waits
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._read_output(last=True)
            self._release(context)
            self.clear()

    def _spawn(self, arguments: list[str]) -> None:
        command = engine_link.drgs_command()
        self._python = command[0]
        self._program = f"drgs {arguments[0]} of {command[0]}"
        handle, name = tempfile.mkstemp(prefix="drgs-", suffix=".log")
        self._log = Path(name)
        try:
            self._process = subprocess.Popen(
                [*command, "--no-progress", *arguments],
                stdin=subprocess.PIPE,
                stdout=handle,
                stderr=handle,
                env=clean_environment() | {"DRGS_PROGRESS": "1"},
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),  # Windows alone has it
            )
        except OSError as error:
            self._log.unlink()
            raise UsageError("Engine", f"{command[0]} cannot be started ({error})", "See the preferences") from error
        finally:
            os.close(handle)

    def _wait(self) -> None:
        """Wait for the program, where no status bar shows how far it is: standard output does."""
        shown = ""
        while True:
            try:
                self.process.wait(_REPORT_EVERY)
                return
            except subprocess.TimeoutExpired:
                output = self._read_output()
                self._tell_warnings(output)
                state = self.state(output)
            if state != shown:
                print_line(shown := state)

    def _read_output(self, last: bool = False) -> str:
        """All output of the program so far; `last` removes the log, after the program has ended."""
        assert self._log is not None, "only after `start`"
        output = self._log.read_text(encoding="utf-8", errors="replace")
        if last:
            assert self.process.stdin is not None, "it was made a pipe"
            self.process.stdin.close()
            with contextlib.suppress(OSError):  # Windows lets go of it late
                self._log.unlink()
        self._output = output
        return output

    def _tell_warnings(self, output: str, ended: bool = False) -> None:
        """Report the program's warnings that are new, each once.

        Its error is such a line, too, the last one: while it works, a line is told when another one has followed.
        """
        lines = output.splitlines()
        for line in lines if ended else lines[:-1]:
            text = line.removeprefix(_PREFIX)
            if text != line and text not in self._warned:
                self._warned += (text,)
                self.warn(text)

    def _finish(self, context: bpy.types.Context) -> set[str]:
        """Report the output of the ended program, then go on, or raise its error."""
        output = self._read_output(last=True).strip()
        lines = [line for line in output.splitlines() if not line.startswith("DRGS_")]
        try:
            if self.process.returncode:
                engine_link.check_installed(self._python, lines[-1] if lines else "")
                errors = [line for line in lines if line.startswith(_PREFIX)] or lines
                reason = errors[-1].removeprefix(_PREFIX) if errors else f"exit code {self.process.returncode}"
                self._tell_warnings("\n".join(errors[:-1]), ended=True)
                raise AssetError(self._subject, f"{self._failure}: {reason.rstrip('.')}", "")
            self._tell_warnings(output, ended=True)
            for line in map(self._without_work_file, lines):
                if line.startswith(_PREFIX):
                    continue
                messages.note("INFO", line)
                if bpy.app.background:
                    print_line(line)
            if missing := self._expected.missing():
                problem = f"{self._failure}: {output_check.complaint(self._program, missing)}"
                raise EngineError(self._subject, problem, output_check.REMEDY)
            return self.done(context)
        finally:
            self.clear()

    def _without_work_file(self, line: str) -> str:
        """A line without the file that it is of, where that goes with the work."""
        if self._folder is None or not line.startswith(str(self._folder)):
            return line
        return line.partition(": ")[2] or line

    def _release(self, context: bpy.types.Context) -> None:
        running.end(self._running)
        redraw_sidebars(context)
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            context.workspace.status_text_set(None)
            self._timer = None


def redraw_sidebars(context: bpy.types.Context) -> None:
    """Draw the sidebars again."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def print_line(text: str) -> None:
    """Print a line, for a Blender without a window."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
