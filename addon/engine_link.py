"""The one engine process of this Blender: started when first needed, shared by everything, closed at exit.

Render engines and viewports come and go with every frame; the process and what it holds live here. The client
serves one request at a time, from any thread, and starts the process again when it died.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

import bpy

from ..drgs_blender.engine.client import EngineClient, Passes, locate_engine
from ..drgs_blender.frame import Frame
from . import messages, preferences

OnProgress = Callable[[str, float], None]
IsCancelled = Callable[[], bool]

_lock = threading.Lock()
_client: EngineClient | None = None


def command_line() -> list[str]:
    """Command of the engine that DRGS_ENGINE or the preferences name; see locate_engine for the errors."""
    return locate_engine(bpy.path.abspath(preferences.read("engine_python", "")) or None)


def client() -> EngineClient:
    """The client of the engine that DRGS_ENGINE or the preferences name; a change of them ends the old process.

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
            _client = EngineClient(command)
        return _client


def render(frame: Frame, on_progress: OnProgress | None = None, cancelled: IsCancelled | None = None) -> Passes:
    """Passes of a frame, name -> (h, w, c) float32, row 0 at the top; see EngineClient.render for the errors."""
    return client().render(frame, on_progress, cancelled)


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
