"""The link of a chunk of frames to the engine of its session: files in a folder that only its owner may use.

| File | |
|---|---|
| ``lock`` | locked as long as the session's process lives, whatever ends it |
| ``request-N.json`` | command line and folder of a chunk; goes when it is answered |
| ``N.waits`` | locked as long as somebody waits for the answer |
| ``N.out``, ``N.err``, ``N.code`` | what the command printed so far, and at its end the exit code |
| ``stop`` | asks the process to end |
"""

from __future__ import annotations

import argparse
import codecs
import contextlib
import json
import logging
import os
import re
import secrets
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from ..core.asset.archive import replace_file
from ..core.errors import EngineError, UsageError, WriteError
from ..core.file_lock import FileLock
from ..core.system import WINDOWS
from .frame_lines import HEARTBEAT_SECONDS, emit

logger = logging.getLogger(__name__)

POLL_SECONDS = 0.05
#: Names of the files above, and of those that are being written.
_FILES = re.compile(r"lock|log|pid|stop|\.?(request-)?[0-9a-f]{8}\.(json|waits|out|err|code)(\.[0-9a-f]{8}\.tmp)?")
#: A process that works says something at least every `HEARTBEAT_SECONDS`.
SILENT_SECONDS = 4 * HEARTBEAT_SECONDS
#: How long a process that was asked to end may take.
END_SECONDS = 4.0


def claim_folder(folder: Path) -> None:
    """Make `folder`; refuse one in which others may write, as what lies there is executed, or that holds other files.

    Raises
    ------
    UsageError, WriteError
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about, names = folder.stat(), os.listdir(folder)
    except OSError as error:
        problem = f"cannot be made ({error.strerror or error})"
        raise WriteError(f"session {folder}", problem, "Choose another folder") from error
    if foreign := next((name for name in names if not _FILES.fullmatch(name)), None):
        problem = f"is a folder with other files ({foreign!r}), and sessions empty theirs"
        raise UsageError(f"session {folder}", problem, "Choose a new folder")
    if not WINDOWS and (about.st_uid != os.getuid() or about.st_mode & 0o022):
        raise UsageError(f"session {folder}", "is a folder in which others may write", "Choose a folder of your own")


def acquire(lock: FileLock, folder: Path, patience: float = 0.0) -> bool:
    """Acquire a lock in a session's `folder`, unless another process has it for `patience` seconds.

    Raises
    ------
    WriteError
        Files cannot be locked there.
    """
    try:
        return lock.acquire(patience)
    except OSError as error:
        problem = f"is on a drive that cannot lock files ({error.strerror or error})"
        raise WriteError(f"session {folder}", problem, "Choose a folder on a local disk") from error


def is_running(folder: Path) -> bool:
    """Whether a session's process lives."""
    if not os.path.isfile(folder / "lock"):  # unlike a Path's, False for any name that cannot be
        return False
    with FileLock(folder / "lock") as lock:
        try:
            return not lock.acquire()
        except OSError:  # a drive that loses its locks does not end what runs
            return True


def end(folder: Path) -> None:
    """End the session's process: ask it, after `END_SECONDS` kill it; nothing when there is none."""
    if not is_running(folder):
        return
    (folder / "stop").touch()
    if not _wait_until_ended(folder, END_SECONDS):
        with contextlib.suppress(OSError, ValueError):  # it ended just now
            os.kill(int((folder / "pid").read_text()), signal.SIGTERM if WINDOWS else signal.SIGKILL)
        _wait_until_ended(folder, END_SECONDS)


def _wait_until_ended(folder: Path, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while running := is_running(folder):
        if time.monotonic() > deadline:
            break
        time.sleep(POLL_SECONDS)
    return not running


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of commands that a session can run."""
    parser.add_argument(
        "--session", type=Path, metavar="FOLDER", help="run in the process that `drgs session start` keeps running"
    )
    parser.add_argument("--openjd", action="store_true", help="report progress to an Open Job Description session")


def delegate(folder: Path, words: Sequence[str]) -> int | None:
    """Have the session's process run the command `words`, and print what it prints.

    Returns
    -------
    int or None
        Its exit code; None when there is no such process.

    Raises
    ------
    EngineError
        The process died of it, or says nothing any more.
    """
    folder = folder.absolute()
    if not is_running(folder):
        logger.info("session %s: is not there, this process does the work", folder)
        return None
    claim_folder(folder)
    name = secrets.token_hex(4)
    request = folder / f"request-{name}.json"
    files = {kind: folder / f"{name}.{kind}" for kind in ("out", "err", "code", "waits")}
    waits = FileLock(files["waits"])
    acquire(waits, folder)
    replace_file(request, [json.dumps({"name": name, "words": list(words), "cwd": os.getcwd()}).encode()])
    try:
        tails = [_tail(files["out"], sys.stdout), _tail(files["err"], sys.stderr)]
        last_output = time.monotonic()
        while True:
            # Looked at in this order: the code is there before the request goes, and before the process ends.
            gone = not request.exists() or not is_running(folder)
            ended = files["code"].exists()
            printed = [next(tail) for tail in tails]
            if ended:
                return int(files["code"].read_text())
            if gone:
                raise EngineError(f"session {folder}", "its process died", "Try again")
            if any(printed) or (not files["out"].exists() and _other_requests(folder, request)):
                last_output = time.monotonic()
            if time.monotonic() - last_output > SILENT_SECONDS:
                end(folder)
                problem = f"said nothing for {SILENT_SECONDS:g} s and was ended"
                raise EngineError(f"session {folder}", problem, "Try again")
            time.sleep(POLL_SECONDS)
    except BaseException as error:
        if not isinstance(error, EngineError):
            end(folder)  # this side was asked to end, and what it asked for with it
        raise
    finally:
        waits.close()
        for path in (request, *files.values()):
            with contextlib.suppress(PermissionError):  # Windows, while the session looks at it: it sweeps
                path.unlink(missing_ok=True)


def _other_requests(folder: Path, request: Path) -> bool:
    """Whether another chunk may be the one that is worked at."""
    return any(other != request for other in folder.glob("request-*.json"))


def _tail(path: Path, stream: IO[str]) -> Iterator[bool]:
    """Each step prints what was added to a file, and says whether there was anything."""
    while not path.exists():
        yield False
    decoder = codecs.getincrementaldecoder("utf-8")("replace")
    with open(path, "rb") as source:
        while True:
            if text := decoder.decode(source.read()):
                emit(text, stream)
            yield bool(text)
