"""What the extension shows in Blender's interface."""

from __future__ import annotations

import bpy

from . import adjustment, compositing, header, matter, object_data, rays, render, sidebar, submit, tour, view_layer

CLASSES = (
    *render.CLASSES,
    *submit.CLASSES,
    *view_layer.CLASSES,
    *object_data.CLASSES,
    *matter.CLASSES,
    *rays.CLASSES,
    *compositing.CLASSES,
    *tour.CLASSES,
    *sidebar.CLASSES,
    *adjustment.CLASSES,
)

_register, _unregister = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    _register()
    header.register()


def unregister() -> None:
    header.unregister()
    _unregister()
