"""Final renders: F12, ``blender -b``, animations."""

from __future__ import annotations

import bpy
import numpy as np

from ...drgs_blender.errors import Cancelled, DrgsError
from ...drgs_blender.frame import Frame
from .. import engine_link, messages
from ..export import export_frame
from ..passes import blender_name, enabled


class DrgsRenderEngine(bpy.types.RenderEngine):
    """Renders DR-GS objects. Holds nothing: Blender makes and drops instances as it likes."""

    bl_idname = "DRGS"
    bl_label = "DR-GS"
    bl_use_preview = False
    bl_use_eevee_viewport = True

    def update_render_passes(self, scene: bpy.types.Scene, renderlayer: bpy.types.ViewLayer) -> None:
        """Tell the compositor which passes a view layer has."""
        for p in enabled(renderlayer):
            self.register_pass(scene, renderlayer, blender_name(p), len(p.channels), p.channels, p.kind)

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Render one view layer. Whatever fails is reported, which also stops an animation and writes no file."""
        try:
            self._render(depsgraph)
        except Cancelled:
            self.update_stats("", "Cancelled")
        except DrgsError as error:
            self._fail(str(error))
        except Exception as error:
            messages.log.exception("render failed")
            self._fail(
                f"DR-GS failed ({type(error).__name__}: {error}). The console has the details; please report it."
            )

    def _fail(self, text: str) -> None:
        """Report an error. `error_set` would let Blender write a black picture and go on."""
        messages.note("ERROR", text)
        self.report({"ERROR"}, text)

    def _render(self, depsgraph: bpy.types.Depsgraph) -> None:
        warn = messages.Warnings()
        self.update_stats("", "Exporting the scene")
        frame = export_frame(depsgraph, lambda path: engine_link.load_asset(path, self.test_break), warn)
        passes = engine_link.render(frame, self._progress, self.test_break)
        for text in passes.warnings:
            warn(text)
        for text in warn.texts:
            self.report({"WARNING"}, text)
        self._show(depsgraph.view_layer, frame, passes)
        self.update_stats("", f"{frame.settings.rays} rays")

    def _progress(self, phase: str, fraction: float) -> None:
        self.update_stats("", phase)
        self.update_progress(fraction)

    def _show(self, view_layer: bpy.types.ViewLayer, frame: Frame, passes: dict[str, np.ndarray]) -> None:
        """Hand the passes to Blender, whose rows run upwards."""
        x0, y0, x1, y1 = frame.camera.window
        table = enabled(view_layer)
        for p in table:
            if p.name != "Combined":
                self.add_pass(blender_name(p), len(p.channels), p.channels, layer=view_layer.name)
        result = self.begin_result(0, 0, x1 - x0, y1 - y0, layer=view_layer.name)
        try:
            layer = result.layers[0]
            for p in table:
                layer.passes[blender_name(p)].rect.foreach_set(np.ascontiguousarray(passes[p.name][::-1]).ravel())
        finally:
            self.end_result(result)
