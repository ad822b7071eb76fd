"""Viewport display of DR-GS objects in any shading: lit by the engine, or as plain discs without it.

Both are drawn after Blender's own objects and tested against their depth: nearer ones hide those, farther ones stay
behind them. The meshes that carry the surfels would hide them too, so they are shown as boxes meanwhile. Where Blender
has no depth, as in EEVEE without overlays, the engine's picture has holes where other meshes are nearer.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy
import gpu
import numpy as np

from .. import messages
from ..export.view import setback
from . import draw, surfels, view_transform, views

#: Of Blender's tables of display colours, those that were needed: as arrays, and as textures once they were drawn.
_tables: dict[view_transform.Key, gpu.types.GPUTexture] = {}
_failed: set[view_transform.Key] = set()
_handle: object | None = None


def _lit(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> str:
    """Draw the picture of the engine; return an error or ""."""
    scene, name = context.scene, views.name_of(context.region)
    key = view_transform.key_of(scene)
    if key not in _tables:
        if not bpy.app.timers.is_registered(_make_table) and key not in _failed:
            bpy.app.timers.register(_make_table, first_interval=0.0)
        return ""
    error = views.update(context, depsgraph, name, composited=True, depthless=_lacks_depth(context.space_data))
    shown = views.newest(name)
    if shown is not None and shown.picture is not None and "Depth" in shown.picture.passes:
        view = scene.view_settings
        draw.composite(
            shown.strips,
            _tables[key],
            views.rect_of(shown.picture),
            _from_behind(context.region_data),
            (2.0**view.exposure, 1.0 / max(view.gamma, 1e-3)),
        )
    return error or views.status(name)[1]


def _lacks_depth(space: bpy.types.SpaceView3D) -> bool:
    """Whether Blender leaves no depth behind: renderers write it for overlays alone."""
    return space.shading.type in ("MATERIAL", "RENDERED") and not space.overlay.show_overlays


def _from_behind(rv3d: bpy.types.RegionView3D) -> np.ndarray:
    """The viewport's projection for distances from where the engine's camera stands."""
    moved = np.eye(4)
    moved[2, 3] = setback(rv3d)
    return np.array(rv3d.window_matrix) @ moved


def _discs(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> str:
    """Draw the surfels without light; return an error or ""."""
    surfels.show(context, depsgraph)
    return ""


#: Choice of the user -> what draws it.
DRAWN: dict[str, Callable[[bpy.types.Context, bpy.types.Depsgraph], str]] = {"LIT": _lit, "SURFELS": _discs}


def _draw() -> None:
    """Called by Blender for every 3D viewport, after its objects."""
    context = bpy.context
    draws = DRAWN.get(context.scene.drgs.overlay)
    if draws is None or views.is_rendered(context.space_data, context.scene):
        return
    try:
        with views.timed():
            if _lacks_depth(context.space_data):
                gpu.state.active_framebuffer_get().clear(depth=1.0)
            error = draws(context, context.view_layer.depsgraph)
    except Exception as failure:  # else it would be printed with every redraw, and be in no message
        messages.log.exception("overlay failed")
        error = f"DR-GS failed ({type(failure).__name__}: {failure}); the console has the details"
    if error:
        messages.note("ERROR", error)


def _make_table() -> None:
    """Make the table that the scene of the window needs, outside of any drawing."""
    for window in bpy.context.window_manager.windows:
        key = view_transform.key_of(window.scene)
        if window.scene.drgs.overlay != "LIT" or key in _tables or key in _failed:
            continue
        try:
            _tables[key] = draw.texture(view_transform.table(key))
        except (RuntimeError, OSError, TypeError) as error:
            _failed.add(key)
            problem = f"The view transform {key[1]} cannot be read ({error}), and Lit needs it"
            messages.note("ERROR", f"{problem}. Choose another in Render > Color Management")
        for area in window.screen.areas:
            area.tag_redraw()


def register() -> None:
    global _handle
    _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
    if bpy.app.timers.is_registered(_make_table):
        bpy.app.timers.unregister(_make_table)
    _tables.clear()
    _failed.clear()
