"""The one engine process of this Blender: started when first needed, shared by everything, closed at exit.

Render engines and viewports come and go with every frame; the process and what it holds live here. The client
serves one request at a time, from any thread, and starts the process again when it died.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import bpy

from ..drgs_blender.core.errors import DeviceError, EngineError, UsageError
from ..drgs_blender.core.frame import Frame
from ..drgs_blender.core.system import WINDOWS
from ..drgs_blender.ipc.child_process import clean_environment
from ..drgs_blender.ipc.client import EngineClient, Passes, locate_engine
from ..drgs_blender.ipc.locate import VARIABLE, bundled_command
from . import engine_bundle, engine_environment, messages, preferences

SET_UP = (
    f"Press Set Up Engine (sidebar > DR-GS), or set {VARIABLE} to a Python environment that has it, such as the folder "
    ".venv of a checkout"
)
#: Seconds that Blender waits for a short command.
PATIENCE = 60.0
UPDATE = "Press Set Up Engine in sidebar > DR-GS; nothing need be fetched for it"

#: Runs ``drgs`` and ends it together with Blender, however that ends: its standard input is closed then.
_MAIN = """
import sys, threading
from drgs_blender.core.system import claim_input, end_at_close
threading.Thread(target=end_at_close, args=(claim_input(),), daemon=True).start()
from drgs_blender.cli.main import main
sys.exit(main())
"""

OnProgress = Callable[[str, float], None]
IsCancelled = Callable[[], bool]

_lock = threading.Lock()
_client: EngineClient | None = None
#: Of the last final picture, name -> value; seconds.total, samples, surfels, ...
statistics: dict[str, float] = {}


def engine_folder(create: bool = False) -> Path:
    """The environment that Set Up Engine makes."""
    return Path(bpy.utils.extension_path_user(preferences.ROOT, path="engine", create=create))


def command_line() -> list[str]:
    """Command of the engine: see `origin`.

    Raises
    ------
    DeviceError
        There is none; says what to do.
    """
    source = origin()
    if source == "named":
        return locate_engine(bpy.path.abspath(preferences.read("engine_python", "")) or None)
    if source == "environment":
        return locate_engine(engine_environment.interpreter(engine_folder()))
    if source == "bundle":
        return bundled_command(sys.executable, engine_bundle.site_packages())
    found = engine_environment.state(engine_folder())
    if fault := engine_bundle.fault():
        raise DeviceError("", f"The packages that came with the extension {fault}", f"Or: {SET_UP}")
    if found == "old":
        raise DeviceError("", "The DR-GS engine belongs to another version of the extension", UPDATE)
    if found == "partial":
        raise DeviceError("", "The DR-GS engine is not completely set up", SET_UP)
    try:
        return locate_engine()
    except DeviceError as error:
        raise DeviceError("", "The DR-GS engine is not set up", SET_UP) from error


def origin() -> str:
    """Which engine is used; the first of these that there is.

    "named": what DRGS_ENGINE names, else the preferences, which may lead nowhere; "environment": the one that was set
    up here, where it is ready; "bundle": Blender's Python with the packages that came with the extension; "": none.
    """
    if os.environ.get(VARIABLE) or preferences.read("engine_python", ""):
        return "named"
    if engine_environment.state(engine_folder()) == "ready":
        return "environment"
    return "bundle" if engine_bundle.wheels() and not engine_bundle.fault() else ""


def described() -> str:
    """Which engine is used, in a sentence for the preferences; "" where there is none."""
    state = engine_environment.state(engine_folder())
    left = {"old": "is of another version of the extension", "partial": "is not finished"}.get(state)
    return {
        "named": f"Used: the engine that {VARIABLE if os.environ.get(VARIABLE) else 'Engine Python'} names",
        "environment": "Used: the environment that Set Up Engine made",
        "bundle": "Used: the engine that came with the extension, in Blender's own Python"
        + (f"; the environment of Set Up Engine {left}" if left else ""),
        "": "",
    }[origin()]


def drgs_command() -> list[str]:
    """Command that runs ``drgs`` in the engine's environment and ends it together with Blender.

    Its standard input must be a pipe that stays open: it ends when that is closed.

    Raises
    ------
    DeviceError
        See `command_line`.
    """
    command = command_line()
    return [*command[: command.index("-m")], "-c", _MAIN]


def ask_to_end(process: subprocess.Popen[bytes]) -> None:
    """Ask a program of `drgs_command` to end, which saves what it needs to go on."""
    if WINDOWS and process.stdin is not None:  # to terminate it there would be to kill it
        process.stdin.close()
    else:
        process.terminate()


def output_of(arguments: list[str]) -> str:
    """What ``drgs`` prints, of a command that takes a second or two; Blender waits.

    Raises
    ------
    UsageError
        It fails; with the reason that it gives.
    EngineError
        It cannot be started or does not answer.
    DeviceError
        See `command_line`; or DR-GS is not installed there.
    """
    command = drgs_command()
    reading, writing = os.pipe()  # its standard input, which stays open
    try:
        done = subprocess.run(
            [*command, *arguments], stdin=reading, capture_output=True, timeout=PATIENCE, env=clean_environment(),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),  # Windows alone has it
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        raise EngineError("Engine", f"{command[0]} does not answer ({error})", "See the preferences") from error
    finally:
        os.close(reading)
        os.close(writing)
    if done.returncode:
        last = (done.stderr.decode(errors="replace").strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        check_installed(command[0], last)
        raise UsageError("", last.removeprefix("drgs: ").rstrip("."), "")
    return done.stdout.decode().replace("\r\n", "\n")


def check_installed(python: str, last: str) -> None:
    """Raise DeviceError where the `last` line of a program that has failed says that its Python lacks a module."""
    found = re.search(r"No module named '?([\w.]+)", last)
    if found is None or last.startswith("drgs: "):  # which says itself what to do
        return
    what = "DR-GS" if found[1].partition(".")[0] == "drgs_blender" else f"{found[1]}, which DR-GS needs,"
    named = VARIABLE if os.environ.get(VARIABLE) else "preferences" * bool(preferences.read("engine_python", ""))
    remedy = f"Install it there, name another Python in {named}, or name none and press Set Up Engine (sidebar > DR-GS)"
    raise DeviceError(
        f"engine {python}{f' (named in {named})' if named else ''}",
        f"{what} is not installed in it ({found[0]})",
        remedy if named else SET_UP,
    )


def lacks_reconstruction() -> bool:
    """Whether the engine in use is known to be without what reconstruction needs. Starts nothing."""
    return _lacks(engine_environment.RECONSTRUCT)


def lacks_capture() -> bool:
    """Whether it is known to be without what finds cameras of photographs. Starts nothing."""
    return _lacks(engine_environment.CAPTURE)


def _lacks(group: engine_environment.Group) -> bool:
    if (source := origin()) == "environment":
        return engine_environment.needs_network(engine_folder(), group=group)
    return source == "bundle"


def problem() -> str:
    """Problem with the location of the engine, "" when it is there. Starts nothing."""
    try:
        command_line()
    except DeviceError as error:
        return f"{error.subject[:1].upper()}{error.subject[1:]} {error.problem}"
    return ""


def client() -> EngineClient:
    """The client of the engine, see `origin`; a change of that ends the old process.

    Raises
    ------
    DeviceError
        There is no engine at that place.
    """
    global _client
    with _lock:
        command = command_line()
        if _client is not None and _client.command != command:
            _client.close()
            _client = None
        if _client is None:
            messages.note("INFO", f"Engine: {command[0]}")
            # Nobody watches a Blender without a window: as often as `drgs render` it tries again.
            _client = EngineClient(command, restarts=2 if bpy.app.background else 1)
        return _client


def render(frame: Frame, on_progress: OnProgress | None = None, cancelled: IsCancelled | None = None) -> Passes:
    """Passes of a frame, name -> (h, w, c) float32, row 0 at the top; see EngineClient.render for the errors."""
    global statistics
    passes = client().render(frame, on_progress, cancelled)
    statistics = passes.statistics
    return passes


def load_asset(path: Path, cancelled: IsCancelled | None = None) -> str:
    """The engine's key of an asset; see EngineClient.load_asset for the errors."""
    return client().load_asset(os.fspath(path), cancelled=cancelled)


def is_running() -> bool:
    """Whether the process is there."""
    return _client is not None and _client.pid != 0


def stop() -> None:
    """End the process; the next request starts a new one."""
    global _client
    with _lock:
        if _client is not None:
            _client.close()
            _client = None


def register() -> None:
    """Nothing starts before it is needed; the client itself ends with Python's exit."""


def unregister() -> None:
    stop()
