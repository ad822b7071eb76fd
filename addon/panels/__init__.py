"""Panels of the extension in Blender's editors."""

from __future__ import annotations

import bpy

from . import (
    adjustment,
    clean,
    compositing,
    header,
    object_data,
    panorama,
    physics,
    preferences,
    ray_visibility,
    render,
    sidebar,
    submit,
    view_layer,
    workflow,
)

CLASSES = (
    *preferences.CLASSES,
    *render.CLASSES,
    *submit.CLASSES,
    *view_layer.CLASSES,
    *object_data.CLASSES,
    *panorama.CLASSES,
    *physics.CLASSES,
    *ray_visibility.CLASSES,
    *compositing.CLASSES,
    *workflow.CLASSES,
    *sidebar.CLASSES,
    *adjustment.CLASSES,
    *clean.CLASSES,
)

_register, _unregister = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    _register()
    header.register()


def unregister() -> None:
    header.unregister()
    _unregister()
