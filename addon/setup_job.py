"""The one set-up of the engine under way, followed by a timer: Blender is never kept waiting."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy

from . import engine_link, messages, preferences
from .engine_environment import Group
from .engine_setup import EngineSetup

INTERVAL = 0.2

#: The last set-up of this session, finished or not.
job: EngineSetup | None = None


def running() -> bool:
    """Whether a set-up is under way."""
    return job is not None and not job.done


def start(python: Path, afresh: bool = False, extras: Sequence[Group] = (), index: str = "") -> EngineSetup:
    """Begin, or go on where the last one ended; the arguments are those of EngineSetup.

    Raises
    ------
    DeviceError
        The folder cannot be written, or has too little room.
    """
    global job
    engine_link.stop()  # Windows does not let go of files in use
    job = EngineSetup(engine_link.engine_folder(create=True), python, afresh=afresh, extras=extras, index=index)
    messages.note("INFO", f"Setting up the engine in {job.folder}")
    if not bpy.app.background and not bpy.app.timers.is_registered(follow):
        bpy.app.timers.register(follow, first_interval=INTERVAL, persistent=True)
    return job


def cancel() -> None:
    """End the set-up under way; what was fetched stays, and an engine that works is used."""
    if job is not None and not job.done:
        job.cancel()
        _forget_timer()
        if job.remark:
            _ready(job)
        else:
            messages.note("INFO", "Set-up of the engine cancelled; Set Up Engine goes on with it")


def follow() -> float | None:
    """Look how far it is; called by Blender until it has ended. Returns seconds to the next call."""
    if job is None:
        return None
    if job.poll():
        if job.error is not None:
            messages.note("ERROR", str(job.error))
        else:
            _ready(job)
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES"):
                area.tag_redraw()
    return None if job.done else INTERVAL


def _ready(job: EngineSetup) -> None:
    """The new engine shall be used."""
    preferences.write("engine_python", "")
    messages.note("INFO", f"The engine is set up in {job.folder}")
    if job.remark:
        messages.note("INFO", job.remark)


def _forget_timer() -> None:
    if bpy.app.timers.is_registered(follow):
        bpy.app.timers.unregister(follow)


def register() -> None:
    """Nothing begins without a click."""


def unregister() -> None:
    global job
    _forget_timer()
    if job is not None and not job.done:
        job.cancel()
    job = None
