"""Keep Blender, with its scene, and an engine from one chunk of frames to the next.

For farms that run many tasks on a node one after the other.

`start` begins a process in the background, `drgs render --session FOLDER` has it render, `stop` ends it. It ends by
itself when the folder or the program that started it (Linux) is gone, and when nothing was asked of it for long.
`serve` is that process in the foreground.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core import own_python
from ..core.asset.archive import replace_file
from ..core.errors import EXIT_INTERRUPTED, EXIT_TERMINATED, EngineError, UsageError
from ..core.file_lock import FileLock
from ..core.system import WINDOWS, terminate_self
from . import sampling
from .session_link import POLL_SECONDS, acquire, claim_folder, end, is_running

if TYPE_CHECKING:
    from .machine import Machine

logger = logging.getLogger(__name__)

START_SECONDS = 60.0
#: After so long the command that started the session has ended, and who lives of its ancestors is the farm's worker.
_SETTLED_SECONDS = 5.0

EXAMPLES = """examples:
  drgs session start /tmp/warm
  drgs render shot.blend --frames 1-8 --out 'frames/####.exr' --session /tmp/warm
  drgs render shot.blend --frames 9-16 --out 'frames/####.exr' --session /tmp/warm
  drgs session stop /tmp/warm
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs session``."""
    parser.add_argument("action", choices=("start", "stop", "serve"))
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of the session, for its owner alone")
    parser.add_argument(
        "--idle", type=sampling.int_range(1, 1 << 20), default=1800, metavar="S", help="ends unused after; default 1800"
    )


def run(args: argparse.Namespace) -> int:
    """Start, stop or be the session's process."""
    folder = args.folder.absolute()
    if args.action == "stop":
        end(folder)
        return 0
    claim_folder(folder)
    return start(folder, args.idle) if args.action == "start" else serve(folder, args.idle)


def start(folder: Path, idle: int) -> int:
    """Begin the process, and wait until it is there."""
    with FileLock(folder / "lock") as lock:
        if not acquire(lock, folder):
            raise UsageError(f"session {folder}", "is running", "Stop it, or choose another folder")
    module = "drgs_blender.cli.main"
    command = [*own_python.command(), "-m", module, "session", "serve", str(folder), f"--idle={idle}"]
    # It inherits no stream: the caller of this command would wait for its end.
    log = folder / "log"
    apart = {"creationflags": 0x08000200} if WINDOWS else {"start_new_session": True}  # no window, in a group
    with open(log, "wb") as out:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, **apart)
    deadline = time.monotonic() + START_SECONDS
    while not is_running(folder):
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            words = log.read_text("utf-8", "replace").strip().splitlines() or ["no words"]
            raise EngineError(f"session {folder}", f"does not start: {words[-1]}", "Run `drgs doctor`")
        time.sleep(POLL_SECONDS)
    print(f"session {folder}: process {process.pid}")
    return 0


def serve(folder: Path, idle: int) -> int:
    """Render what is asked for, until the session ends."""
    from .machine import Machine

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_TERMINATED))
    with Machine(keep_blender=True) as machine:
        machine.engine().start()
        watch = _IdleWatch(folder, idle, _claim(folder))
        while True:
            for request in folder.glob("request-*.json"):
                about = json.loads(request.read_text())
                with watch.at_work(folder / f"{about['name']}.waits"):
                    code = _run_request(folder, about, machine)
                replace_file(folder / f"{about['name']}.code", [str(code).encode()])
                request.unlink(missing_ok=True)
                if code in (EXIT_INTERRUPTED, EXIT_TERMINATED):  # it was asked to end while it worked
                    return 0
            time.sleep(POLL_SECONDS)


def _claim(folder: Path) -> FileLock:
    """Make `folder` that of this process: the lock on it."""
    lock = FileLock(folder / "lock")
    # What a killed session left. It is listed before the lock is taken: from then on chunks may come.
    old = [path for path in folder.iterdir() if path.name not in ("lock", "log")]
    if not acquire(lock, folder, 1.0):
        raise UsageError(f"session {folder}", "is running", "Stop it, or choose another folder")
    for path in old:
        path.unlink(missing_ok=True)
    (folder / "pid").write_text(str(os.getpid()))
    return lock


def _run_request(folder: Path, about: dict[str, Any], machine: Machine) -> int:
    """Run one command line; its exit code."""
    from .denoise import denoise
    from .main import run_command, set_up_logging
    from .render import render

    work: dict[str, Callable[[argparse.Namespace], int]]
    work = {"render": lambda args: render(args, machine), "denoise": denoise}
    name = about["name"]
    with contextlib.suppress(OSError):  # relative paths do not exist either where the folder is gone
        os.chdir(about["cwd"])
    with (
        open(folder / f"{name}.out", "w", encoding="utf-8", errors="backslashreplace", buffering=1) as out,
        open(folder / f"{name}.err", "w", encoding="utf-8", errors="backslashreplace", buffering=1) as err,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        code = run_command(about["words"], lambda args: work[args.command](args))
    set_up_logging(0, False)  # it wrote to the file just closed
    return code


class _IdleWatch:
    """Ends this process when it is idle for too long, or when its parents have ended."""

    def __init__(self, folder: Path, idle: int, lock: FileLock) -> None:
        self._folder, self._idle = folder, idle
        self._lock = lock  # which goes with this process
        self._waits: Path | None = None
        self._since = self._born = time.monotonic()
        self._ancestors = _ancestors()
        threading.Thread(target=self._watch, daemon=True).start()

    @contextlib.contextmanager
    def at_work(self, waits: Path) -> Iterator[None]:
        """While a chunk is worked at, somebody has to wait for it, who locks that file."""
        self._waits = waits
        try:
            yield
        finally:
            self._waits, self._since = None, time.monotonic()

    def _watch(self) -> None:
        worker: tuple[int, str] | None = None
        while True:
            time.sleep(0.5)
            if worker is None and time.monotonic() - self._born > _SETTLED_SECONDS:
                worker = next((each for each in self._ancestors if _alive(each)), None)
            if (reason := self._reason(worker)) is not None:
                logger.info("session %s: ends, %s", self._folder, reason)
                terminate_self()
                return

    def _reason(self, worker: tuple[int, str] | None) -> str | None:
        if not self._folder.is_dir():
            return "its folder is gone"
        if (self._folder / "stop").exists():
            return "it was asked to"
        if worker is not None and not _alive(worker):
            return "who started it is gone"
        waits = self._waits
        if waits is None:
            return "nothing was asked of it" if time.monotonic() - self._since > self._idle else None
        with contextlib.suppress(OSError):  # the folder went just now
            with FileLock(waits) as lock:
                free = lock.acquire()
            if free and self._waits is waits:  # else it has just been answered
                return "nobody waits for its frames"
        return None


def _ancestors() -> list[tuple[int, str]]:
    """(process id, time of its start) of parent, grandparent and so on, without the system's first; Linux only."""
    found: list[tuple[int, str]] = []
    pid = os.getppid()
    while pid > 1 and (fields := _stat(pid)):
        found.append((pid, fields[19]))
        pid = int(fields[1])
    return found


def _alive(process: tuple[int, str]) -> bool:
    fields = _stat(process[0])
    return bool(fields) and fields[19] == process[1] and fields[0] != "Z"


def _stat(pid: int) -> list[str]:
    """Fields of /proc/PID/stat from the state on."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return []
