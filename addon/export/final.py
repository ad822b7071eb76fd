"""Frames of final pictures: what has to be baked for them is waited for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy

from ...drgs_blender.core.frame import Camera, Frame
from ...drgs_blender.core.memory import give_back
from ..bakes.manager import manager
from ..bakes.requests import Wanted
from .frame import export_frame
from .motion_steps import FrameSet

#: Exports of a frame at most: what is baked for one may not be what the next wants, where scripts have their way.
_ATTEMPTS = 3


def export_baked(
    depsgraph: bpy.types.Depsgraph,
    key_of: Callable[[Path], str],
    warn: Callable[[str], None],
    progress: Callable[[str, float], None],
    *,
    camera: Camera | None = None,
    frame_set: FrameSet | None = None,
    passes: tuple[str, ...] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Frame:
    """`export_frame`, again when everything that it wants baked is there.

    Parameters
    ----------
    warn, camera, frame_set, passes, cancelled : as there
    progress : called with what is being baked, and the part that is done

    Raises
    ------
    DrgsError
        As `export_frame`; `Cancelled` while it waits, too.
    """
    owner = object()
    for attempt in range(_ATTEMPTS):
        wanted = Wanted.of(depsgraph.scene, warn)
        texts: list[str] = []
        frame = export_frame(
            depsgraph,
            key_of,
            texts.append,
            camera=camera,
            frame_set=frame_set,
            passes=passes,
            cancelled=cancelled,
            wanted=wanted,
        )
        if not wanted.requests or attempt == _ATTEMPTS - 1:
            break
        manager.wait(owner, wanted.requests, progress, cancelled or (lambda: False))
    for text in texts:
        warn(text)
    for request in wanted.requests:
        warn(f"{request.label} is another whenever it is looked at, and cannot be baked; it is approximated")
    if manager.store.trouble:
        warn(manager.store.trouble)
        manager.store.trouble = ""
    give_back()  # while the engine takes memory
    return frame
