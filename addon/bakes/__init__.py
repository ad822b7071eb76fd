"""Bakes: what DR-GS does not read directly of node trees, made once by Cycles in a Blender in the background.

`node_trees` says what a tree depends on, `requests` makes of it a request with a key, `manager` has a
`blender_process` do it (by the files in `scripts`) and keeps results in a `store`. Nothing here waits for a bake but
`manager.wait`, for final pictures.
"""

from __future__ import annotations

import bpy

from . import main_thread
from .manager import manager


@bpy.app.handlers.persistent
def _forget(*_: object) -> None:
    """Another file is loaded."""
    manager.stop()


@bpy.app.handlers.persistent
def _retry(*_: object) -> None:
    """A picture or an animation begins: what has failed is tried again."""
    manager.retry()


#: Name of the handler list -> what is called.
_HANDLERS = {"load_pre": _forget, "render_init": _retry}


def register() -> None:
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    main_thread.register()


def unregister() -> None:
    main_thread.unregister()
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    manager.stop()
