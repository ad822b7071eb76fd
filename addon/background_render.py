"""Renders without a window (``blender -b SCENE -a``): frames that Blender writes are read back, failures get a code.

Blender says "Saved" of the empty files that a full disk leaves, and exits with 0 whatever failed.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import bpy
import imbuf

from ..drgs_blender.core.errors import EXIT_CANNOT_WRITE, EXIT_CLASSES
from ..drgs_blender.core.file_integrity import is_exr, is_whole
from ..drgs_blender.core.phases import is_preparing
from ..drgs_blender.core.switches import is_on
from . import engine_link, messages

#: Seconds between lines that say how many kernels are compiled.
_NEWS_SECONDS = 10.0

#: When the next one may be said.
_next_news = 0.0


def say_preparing(phase: str) -> None:
    """Without a window, print now and then how many kernels are compiled, which may take minutes."""
    global _next_news
    if bpy.app.background and is_preparing(phase) and time.monotonic() >= _next_news:
        _next_news = time.monotonic() + _NEWS_SECONDS
        sys.stdout.write(f"drgs: {phase}\n")
        sys.stdout.flush()


def fail(text: str, code: int) -> None:
    """On a farm (``DRGS_FARM=1``), end a Blender without a window with the code of a failure; else do nothing."""
    if not (bpy.app.background and is_on("DRGS_FARM", False)):
        return
    engine_link.stop()
    sys.stderr.write(f"drgs: {text}\n")
    sys.stdout.write(f"DRGS_EXIT class={EXIT_CLASSES[code]}\n")
    sys.stderr.flush()
    sys.stdout.flush()
    os._exit(code)  # Blender goes on after whatever is raised in a render


@bpy.app.handlers.persistent
def verify(scene: bpy.types.Scene, *_: object) -> None:
    """Remove the frame just written where it cannot be read back."""
    if scene.render.engine != "DRGS" or scene.render.is_movie_format:
        return
    path = Path(bpy.path.abspath(scene.render.frame_path()))
    if not path.is_file() or _readable(path):
        return
    path.unlink()
    text = f"{path}: was not written whole, and is removed. Look at the room on its disk."
    messages.note("ERROR", text)
    fail(text, EXIT_CANNOT_WRITE)


def _readable(path: Path) -> bool:
    """Whether a picture is whole, and Blender can decode it."""
    if not is_whole(path):  # looked at first: of a part of a file Blender makes a picture, or crashes
        return False
    if is_exr(path):  # every chunk of it is there; Blender's imbuf decodes none of several layers
        return True
    try:
        picture = imbuf.load(str(path))
    except (ValueError, OSError):
        return False
    return picture is not None and min(picture.size) > 0


def register() -> None:
    bpy.app.handlers.render_write.append(verify)


def unregister() -> None:
    bpy.app.handlers.render_write.remove(verify)
