"""What the extension shows in Blender's interface."""

from __future__ import annotations

import bpy

from . import adjustment, compositing, matter, object_data, rays, render, sidebar, submit, tour, view_layer

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

register, unregister = bpy.utils.register_classes_factory(CLASSES)
