"""What must happen when Blender loads another file or begins to render."""

from __future__ import annotations

import bpy

from . import assets, messages
from .export import images


@bpy.app.handlers.persistent
def forget_everything(*_: object) -> None:
    """Drop the state of the last file, so that nothing of it is seen in the next."""
    assets.forget()
    images.forget()
    messages.clear()


@bpy.app.handlers.persistent
def begin_render(*_: object) -> None:
    """A picture or an animation begins."""
    messages.begin_render()


@bpy.app.handlers.persistent
def data_imported(*_: object) -> None:
    """Something was appended or linked."""
    assets.remove_instanced_anchors()


@bpy.app.handlers.persistent
def depsgraph_updated(*_: object) -> None:
    """What Blenders before 4.3 say of imported data: that something has changed. Objects may not be removed now."""
    global _objects
    if (count := len(bpy.data.objects)) != _objects:
        _objects = count
        if not bpy.app.timers.is_registered(assets.remove_instanced_anchors):
            bpy.app.timers.register(assets.remove_instanced_anchors)


#: How many objects there were at the last update.
_objects = -1
#: List of handlers of Blender -> its member here.
_HANDLERS = {
    "load_post": forget_everything,
    "render_init": begin_render,
    **(
        {"blend_import_post": data_imported}
        if hasattr(bpy.app.handlers, "blend_import_post")
        else {"depsgraph_update_post": depsgraph_updated}
    ),
}


def register() -> None:
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    if bpy.app.timers.is_registered(assets.remove_instanced_anchors):
        bpy.app.timers.unregister(assets.remove_instanced_anchors)
    forget_everything()
