"""Particles of previews, drawn into viewports over everything else that is there."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from .. import messages
from ..export.export_cache import uid

Array = np.ndarray

_COLOUR = (1.0, 0.55, 0.1, 1.0)
_SIZE = 3.0


@dataclass(slots=True)
class Fill:
    """A preview of one object.

    Attributes
    ----------
    points : (n, 3) float32, object space
    counts : particles, time steps a frame at least
    """

    points: Array
    counts: tuple[int, int]
    batch: gpu.types.GPUBatch | None = None


#: Previews by the `uid` of their object; none is stored in the .blend.
shown: dict[int, Fill] = {}
_handle: object | None = None


def show(obj: bpy.types.Object, points: Array, counts: tuple[int, int]) -> None:
    """Draw these points with the object from now on."""
    shown[uid(obj)] = Fill(np.ascontiguousarray(points, np.float32), counts)


def of(obj: bpy.types.Object) -> Fill | None:
    """The preview of an object."""
    return shown.get(uid(obj))


def hide(obj: bpy.types.Object) -> None:
    """Draw them no more."""
    shown.pop(uid(obj), None)


def _shader() -> gpu.types.GPUShader:
    try:
        return gpu.shader.from_builtin("POINT_UNIFORM_COLOR")  # newer Blenders have one of its own for points
    except ValueError:
        return gpu.shader.from_builtin("UNIFORM_COLOR")


def _draw() -> None:
    """Called by Blender for every 3D viewport, after its objects."""
    if not shown:
        return
    try:
        _draw_all()
    except Exception as failure:  # else it would be printed with every redraw, and be in no message
        messages.log.exception("preview failed")
        shown.clear()
        messages.note(
            "ERROR", f"Show Particles: cannot be drawn ({type(failure).__name__}: {failure}). Bakes do not need it"
        )


def _draw_all() -> None:
    shader = _shader()
    gpu.state.point_size_set(_SIZE)
    gpu.state.depth_test_set("NONE")
    for key, fill in list(shown.items()):
        obj = next((obj for obj in bpy.data.objects if obj.session_uid == key), None)
        if obj is None or not obj.visible_get():
            continue
        if fill.batch is None:
            fill.batch = batch_for_shader(shader, "POINTS", {"pos": fill.points})
        with gpu.matrix.push_pop():
            gpu.matrix.multiply_matrix(obj.matrix_world)
            shader.bind()
            shader.uniform_float("color", _COLOUR)
            fill.batch.draw(shader)
    gpu.state.point_size_set(1.0)


@bpy.app.handlers.persistent
def _forget(*_: object) -> None:
    shown.clear()


def register() -> None:
    global _handle
    bpy.app.handlers.load_pre.append(_forget)
    _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handle
    bpy.app.handlers.load_pre.remove(_forget)
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
    shown.clear()
