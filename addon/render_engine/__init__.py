"""DR-GS as a render engine of Blender: final renders (F12), motion blur and depth of field."""

from __future__ import annotations

import bpy

from .engine import DrgsRenderEngine, end_renders
from .panels import share_panels, withdraw_panels


def register() -> None:
    bpy.utils.register_class(DrgsRenderEngine)
    share_panels()


def unregister() -> None:
    end_renders()
    withdraw_panels()
    bpy.utils.unregister_class(DrgsRenderEngine)
