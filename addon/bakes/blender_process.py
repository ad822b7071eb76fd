"""A Blender without a window that bakes: started when there is a job, kept for the next, ended with its parent."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ...drgs_blender.core.errors import Cancelled, EngineError

#: Seconds of one job after which a Blender that has not answered is ended.
PATIENCE = 3600.0
_POLL = 0.05


def command() -> list[str]:
    """Command that runs the script of bakes in this Blender, or in this interpreter where Blender is a module."""
    script = str(Path(__file__).parent / "scripts" / "main.py")
    if getattr(bpy.app, "module", False) or not bpy.app.binary_path:
        return [sys.executable, "-P", script]
    options = ["--background", "--factory-startup", "-noaudio", "--python-exit-code", "70"]
    return [bpy.app.binary_path, *options, "--python", script]


class BlenderProcess:
    """One such Blender.

    Raises
    ------
    EngineError
        It does not start.
    """

    def __init__(self) -> None:
        handle, name = tempfile.mkstemp(prefix="drgs-bake-", suffix=".log")
        self._log = Path(name)
        self._answers: queue.Queue[bytes] = queue.Queue()
        try:
            self._process = subprocess.Popen(
                command(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=handle,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),  # Windows alone has it
            )
        except OSError as error:
            with contextlib.suppress(OSError):
                self._log.unlink()
            raise EngineError("", f"{command()[0]} cannot be started ({error})", "") from error
        finally:
            os.close(handle)
        threading.Thread(target=self._listen, name="drgs-bake-read", daemon=True).start()

    @property
    def alive(self) -> bool:
        """Whether it is there."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def do(self, job: dict[str, Any], cancelled: Callable[[], bool]) -> None:
        """Have it do a job, and wait.

        Raises
        ------
        Cancelled
            `cancelled` said so; the process is ended.
        EngineError
            The job failed, or the process ended.
        """
        assert self._process.stdin is not None, "it was made a pipe"
        try:
            self._process.stdin.write(json.dumps(job).encode() + b"\n")
            self._process.stdin.flush()
        except OSError as error:
            raise EngineError("", f"Blender ended before it baked ({self._last_words()})", "") from error
        until = time.monotonic() + PATIENCE
        while True:
            if cancelled():
                self.close()
                raise Cancelled
            with contextlib.suppress(queue.Empty):
                answer = self._answers.get(timeout=_POLL)
                if not answer:
                    code = self._process.wait()
                    raise EngineError("", f"Blender ended while it baked ({code}): {self._last_words()}", "")
                said = _parsed(answer)
                if said.get("key") == job["key"]:
                    if said.get("error"):
                        raise EngineError("", str(said["error"])[:300].replace("\n", " "), "")
                    return
            if time.monotonic() > until:
                self.close()
                raise EngineError("", f"Blender did not finish it in {PATIENCE:g} s", "")

    def close(self) -> None:
        """End it at once."""
        with contextlib.suppress(OSError):
            self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        with contextlib.suppress(OSError):
            self._log.unlink()

    def _listen(self) -> None:
        """Hand on its lines, and an empty one at the end."""
        assert self._process.stdout is not None, "it was made a pipe"
        with contextlib.suppress(OSError, ValueError):  # closed meanwhile
            for line in self._process.stdout:
                self._answers.put(line)
        self._answers.put(b"")

    def _last_words(self) -> str:
        """The last line that it printed."""
        try:
            lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:
            lines = []
        return lines[-1][:300].rstrip(".") if lines else "it printed nothing"


def _parsed(line: bytes) -> dict[str, Any]:
    """An answer; empty for other output."""
    try:
        said = json.loads(line)
    except ValueError:
        return {}
    return said if isinstance(said, dict) else {}
