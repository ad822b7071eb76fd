"""Blender as a child process that evaluates frames for ``drgs render`` (the other side is blender_job)."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import ERROR_CLASSES, DeviceError, DrgsError, EngineError, VersionError, WriteError
from ..core.frame import Frame
from ..core.version import __version__
from ..ipc import protocol
from ..ipc.codec import decode_frame
from ..ipc.protocol import Link, ProtocolError
from ..ipc.slots import HeldSlots
from .blender_job import READY
from .find_blender import Blender, extension_source

logger = logging.getLogger(__name__)

#: Blender says every ALIVE_SECONDS that it is alive; starting may take long on a cold network drive.
SILENT_SECONDS, START_SECONDS = 120.0, 300.0
_CHECK = "Run `drgs doctor`; -vv shows what Blender prints"


@dataclass(slots=True)
class Evaluated:
    """One evaluated view layer.

    Attributes
    ----------
    number : int
        Of the frame.
    layer : str
        Its view layer, "" when there is only one.
    frame : Frame
        Its description, without blur.
    warnings : list of str
        Of the export, those of `pictures` too when these have come.
    count : int
        Of pictures whose mean is the blurred one; 0 where nothing is blurred.
    pictures : callable
        Has these described, each with all passes and rays of the frame; may be called again.
    """

    number: int
    layer: str
    frame: Frame
    warnings: list[str]
    count: int
    pictures: Callable[[], Iterator[Frame]]


class BlenderProcess:
    """A running Blender; a context manager, at whose end it is gone with all it left.

    Parameters
    ----------
    blender : Blender
        Which Blender.
    job : dict
        Job description, JSON-able: ``scene``, ``frames``, ``scripts``, ``passes``; with ``report`` the attribute of
        that name has its ``files`` (as stored and as found) and ``notes`` before the first frame comes; with ``keep``
        it waits for `more` frames after these.
    key_of : callable
        Gives the engine's key of the asset at a path.
    timeout : float
        Seconds that the evaluation of one frame may take, the first with the loading of the file.
    """

    def __init__(
        self, blender: Blender, job: dict[str, Any], key_of: Callable[[Path], str], timeout: float = np.inf
    ) -> None:
        self._blender, self._job, self._key_of, self._timeout = blender, job, key_of, timeout
        self._folder = ""
        self._words: deque[str] = deque(maxlen=50)
        self._held = HeldSlots()
        self._ended = threading.Event()
        self._deadline: float | None = None  # set while this side waits
        self.report: dict[str, Any] = {}  # about the file, when the job asks for it
        self._latest = np.inf  # when the frame has to be there
        self._is_silent = self._is_late = False

    def __enter__(self) -> BlenderProcess:
        repository, temporary = self._make_folders()
        environment = os.environ | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(temporary))
        command = self._blender.command(Path(__file__).with_name("blender_job.py"))
        pipe = subprocess.PIPE
        try:
            self._process = subprocess.Popen(command, bufsize=0, stdin=pipe, stdout=pipe, stderr=pipe, env=environment)
        except OSError as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise DeviceError(f"Blender at {self._blender.program}", f"does not start ({error})") from error
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        self._link = Link(self._process.stdout, self._process.stdin, self._reset_deadline)  # type: ignore[arg-type]
        threading.Thread(target=self._watch, daemon=True).start()
        try:
            self._greet(self._job | {"repository": repository, "folder": self._folder})
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._process.kill()
        self._process.wait()
        self._listener.join(5)
        shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def running(self) -> bool:
        """Whether Blender is there."""
        return self._process.poll() is None

    def more(self, frames: Sequence[int]) -> Iterator[Evaluated]:
        """As `frames`, for a Blender that was kept and has finished those it was given before."""
        self._send(protocol.Render(0, {"frames": list(frames)}, {}))
        yield from self.frames()

    def frames(self) -> Iterator[Evaluated]:
        """Evaluated view layers in the order of the job; Blender goes on when the next one is asked for.

        Raises
        ------
        DrgsError
            What Blender's side reports; EngineError when it died.
        """
        while True:
            message, arrays = self._next()
            if isinstance(message, protocol.Shutdown):
                return
            if message.id == 0:  # no frame
                if not message.frame:
                    return  # it waits for more
                self.report = message.frame
            else:
                yield self._evaluated(message, arrays)
            self._send(protocol.Result(message.id, [], {}))

    def _next(self) -> tuple[Any, dict[str, np.ndarray]]:
        """What Blender sends next, assets being loaded for it: Render or Shutdown, and arrays."""
        self._latest = time.monotonic() + self._timeout
        while True:
            message, arrays = self._receive()
            if isinstance(message, (protocol.Render, protocol.Shutdown)):
                return message, arrays
            if not isinstance(message, protocol.LoadAsset):
                raise EngineError("Blender", f"sent {type(message).__name__}, which makes no sense here", "Try again")
            self._send(protocol.Loaded(message.id, self._key_of(Path(message.path)), 0, 0))

    def _pictures(self, count: int, warnings: list[str]) -> Iterator[Frame]:
        """The pictures of a blurred frame; behind them Blender announces the frame again and waits as before."""
        self._send(protocol.Render(0, {}, {}))
        for _ in range(count):
            message, arrays = self._next()
            frame = self._frame(message, arrays)
            warnings[:] = message.frame["warnings"]
            yield frame
            self._send(protocol.Result(message.id, [], {}))
        self._frame(*self._next())

    def _make_folders(self) -> tuple[str | None, Path]:
        """The extension's repository, and where Blender's temporary files go: it leaves some where it is killed."""
        try:
            self._folder = tempfile.mkdtemp(prefix="drgs-")
            source, temporary = extension_source(), Path(self._folder) / "temp"
            temporary.mkdir()
            return self._repository(source) if source else None, temporary
        except OSError as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            problem, remedy = f"cannot be written ({error.strerror or error})", "Make room, or set TMPDIR"
            raise WriteError("the folder of temporary files", problem, remedy) from error

    def _repository(self, source: Path) -> str:
        """A local extension repository that holds this package's own extension, so that both are one version."""
        target = Path(self._folder) / "repository" / "drgs"
        target.parent.mkdir()
        try:
            target.symlink_to(source, target_is_directory=True)
        except OSError as error:
            logger.debug("no symbolic links (%s): the extension is copied", error)
            target.mkdir()
            for part in ("__init__.py", "blender_manifest.toml"):
                shutil.copy2(source / part, target / part)
            for part in ("addon", "operators", "drgs_blender"):
                shutil.copytree(source / part, target / part, ignore=shutil.ignore_patterns("__pycache__"))
        return str(target.parent)

    def _greet(self, job: dict[str, Any]) -> None:
        stream = self._process.stdout
        assert stream is not None and self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # the end of stdout shows that it has ended
            self._process.stdin.write(json.dumps(job).encode() + b"\n")
        self._deadline = time.monotonic() + START_SECONDS
        while (line := stream.readline()) not in (READY, b""):
            self._note(line)
        received = self._link.receive() if line else None
        self._deadline = None
        if received is None:
            self._raise_timeout(START_SECONDS)
            raise DeviceError(f"Blender at {self._blender.program}", f"cannot do the job: {self._exit_text()}", _CHECK)
        message = received[0]
        if not isinstance(message, protocol.Hello) or not protocol.same_version(message):
            version = getattr(message, "version", "unknown")
            remedy = "Install the same version of both"
            raise VersionError("DR-GS extension", f"is version {version}, drgs is {__version__}", remedy)

    def _receive(self) -> tuple[Any, dict[str, np.ndarray]]:
        try:
            self._reset_deadline()
            received = self._link.receive()
            while received is not None and isinstance(received[0], protocol.Progress):
                received = self._link.receive()
        except (ProtocolError, OSError) as error:
            self._raise_timeout(SILENT_SECONDS)
            raise EngineError("Blender", f"stopped in the middle of a message ({error})", self._exit_text()) from error
        finally:
            self._deadline = None
        if received is None:
            self._raise_timeout(SILENT_SECONDS)
            raise EngineError(
                "Blender", f"ended before the job: {self._exit_text()}", "Try again; -vv shows its output"
            )
        message = received[0]
        if isinstance(message, protocol.Failed):
            raise ERROR_CLASSES.get(message.error, DrgsError)(message.subject, message.problem, message.remedy)
        return received

    def _send(self, message: Any) -> None:
        try:
            self._link.send(message)
        except OSError as error:  # it died while this side worked
            raise EngineError("Blender", f"ended before the job: {self._exit_text()}", "Try again") from error

    def _evaluated(self, message: protocol.Render, sent: dict[str, np.ndarray]) -> Evaluated:
        frame, about = self._frame(message, sent), message.frame
        count, warnings = about["pictures"], about["warnings"]
        pictures = partial(self._pictures, count, warnings)
        return Evaluated(about["number"], about["layer"], frame, warnings, count, pictures)

    def _frame(self, message: Any, sent: dict[str, np.ndarray]) -> Frame:
        if not isinstance(message, protocol.Render):
            raise EngineError("Blender", "did not finish a frame", "Try again")
        arrays, missing = self._held.update(message.slots, sent)
        if missing:
            raise EngineError("Blender", f"did not send {missing[0]}", "Try again")
        return decode_frame(message.frame["frame"], arrays)

    def _reset_deadline(self) -> None:
        """Something arrived, or waiting begins."""
        self._deadline = max(self._deadline or 0.0, time.monotonic() + SILENT_SECONDS)

    def _watch(self) -> None:
        """End a Blender from which nothing is heard for too long while this side waits."""
        while not self._ended.wait(0.5):
            deadline, now = self._deadline, time.monotonic()
            if deadline is not None and now > min(deadline, self._latest):
                self._is_silent, self._is_late = now > deadline, now > self._latest
                self._process.kill()
                return

    def _raise_timeout(self, seconds: float) -> None:
        if self._is_late:
            raise EngineError("Blender", f"evaluated one frame for more than {self._timeout:g} s", "Raise --timeout")
        if self._is_silent:
            raise EngineError("Blender", f"did not answer for {seconds:g} s and was ended", "Try again")

    def _listen(self) -> None:
        """Gather what Blender prints: shown with -vv, and its last line when it dies."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self._note(line)

    def _note(self, line: bytes) -> None:
        text = line.decode("utf-8", "replace").rstrip()
        if text:
            self._words.append(text)
            logger.debug("blender: %s", text)

    def _exit_text(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(5)
        self._listener.join(2)
        code = self._process.poll()
        end = "it closed its pipe" if code is None else f"exit code {code}"
        return f"{end}; last log line: {self._words[-1][:300] if self._words else 'none'}"
