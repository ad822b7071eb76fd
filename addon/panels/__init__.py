"""What the extension shows in Blender's interface."""

from __future__ import annotations

import bpy

from . import object_data, rays, render, sidebar, view_layer

CLASSES = (*render.CLASSES, *view_layer.CLASSES, *object_data.CLASSES, *rays.CLASSES, *sidebar.CLASSES)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
