"""What must happen when Blender loads another file."""

from __future__ import annotations

import bpy

from . import assets, messages
from .export import images


@bpy.app.handlers.persistent
def forget_everything(*_: object) -> None:
    """Nothing of the last file may be seen in the next."""
    assets.forget()
    images.forget()
    messages.history.clear()


def register() -> None:
    bpy.app.handlers.load_post.append(forget_everything)


def unregister() -> None:
    bpy.app.handlers.load_post.remove(forget_everything)
    forget_everything()
