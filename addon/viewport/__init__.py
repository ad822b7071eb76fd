"""The 3D viewport: rendered shading, and DR-GS objects in the pictures of other engines."""

from __future__ import annotations

import bpy

from . import draw, overlay, scenes, surfels, views


@bpy.app.handlers.persistent
def _changed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Called after every evaluation of a scene, a new frame's included; for final renders on another thread."""
    if depsgraph is not None and depsgraph.mode == "VIEWPORT":
        scenes.changed(depsgraph)
        surfels.cache.note(depsgraph)


@bpy.app.handlers.persistent
def _forget(*_: object) -> None:
    views.forget()
    surfels.forget()


@bpy.app.handlers.persistent
def _undone(*_: object) -> None:
    scenes.forget()
    surfels.forget()


#: Name of the handler list -> what is called. After undo, nothing is where it was in memory.
_HANDLERS = {
    "depsgraph_update_post": _changed,
    "frame_change_post": _changed,
    "load_pre": _forget,
    "undo_post": _undone,
    "redo_post": _undone,
}


def register() -> None:
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    overlay.register()


def unregister() -> None:
    overlay.unregister()
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    _forget()
    views.stop()
    draw.forget()
