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


def register() -> None:
    bpy.app.handlers.load_post.append(forget_everything)
    bpy.app.handlers.render_init.append(begin_render)


def unregister() -> None:
    bpy.app.handlers.load_post.remove(forget_everything)
    bpy.app.handlers.render_init.remove(begin_render)
    forget_everything()
