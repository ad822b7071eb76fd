"""Final renders (F12, ``blender -b``, animations) and rendered viewports."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import bpy
import numpy as np

from ...drgs_blender.core import cryptomatte
from ...drgs_blender.core.errors import EXIT_INTERNAL, Cancelled, DrgsError
from ...drgs_blender.core.frame import Frame
from ...drgs_blender.core.phases import is_preparing
from ...drgs_blender.ipc.blur import averaged, sample_frame, sharp_frame
from ...drgs_blender.ipc.protocol import Passes
from .. import background_render, engine_link, messages
from ..export import blur_steps, export_baked
from ..export.instances import uncancelled
from ..view_layer_passes import blender_name, enabled
from ..viewport import views
from . import blur

#: What Blender does with a picture when `DrgsRenderEngine.render` has come back takes no longer.
_AFTERWARDS = 0.5

#: Threads that render a final picture.
_rendering: set[int] = set()
#: Set while the extension is switched off.
_ending = threading.Event()


def end_renders(seconds: float = 10.0) -> None:
    """Have final pictures cancelled and wait for their threads: Blender crashes where a class goes that renders."""
    _ending.set()
    deadline, others = time.monotonic() + seconds, _rendering - {threading.get_ident()}
    while others & _rendering and time.monotonic() < deadline:
        time.sleep(0.02)
    if others:
        time.sleep(_AFTERWARDS)
    _ending.clear()


class DrgsRenderEngine(bpy.types.RenderEngine):
    """Renders DR-GS objects. Holds nothing: Blender makes and drops instances as it likes."""

    bl_idname = "DRGS"
    bl_label = "DR-GS"
    bl_use_preview = False
    bl_use_eevee_viewport = True

    def update_render_passes(self, scene: bpy.types.Scene, renderlayer: bpy.types.ViewLayer) -> None:
        """Register the passes that a view layer has, for the compositor."""
        for p in enabled(scene, renderlayer):
            self.register_pass(scene, renderlayer, blender_name(p), len(p.channels), p.channels, p.kind)

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Render one view layer. Whatever fails is reported, which also stops an animation and writes no file."""
        if _ending.is_set():  # the next frame of an animation
            self.report({"ERROR"}, "DR-GS is switched off")
            return
        _rendering.add(threading.get_ident())
        views.worker.hold()
        try:
            self._render(depsgraph)
        except Cancelled:
            self.update_stats("", "Cancelled")
        except DrgsError as error:
            self._fail(str(error), error.exit_code)
        except Exception as error:
            messages.log.exception("render failed")
            self._fail(
                f"DR-GS failed ({type(error).__name__}: {error}). The console has the details; please report it.",
                EXIT_INTERNAL,
            )
        finally:
            views.worker.release()
            _rendering.discard(threading.get_ident())

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """The scene changed."""
        self._show_view(context, depsgraph, False)

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw the viewport; it may have moved since the last time."""
        with views.timed():
            self._show_view(context, depsgraph, True)

    def _show_view(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph, draw: bool) -> None:
        name = views.name_of(context.region)
        try:
            error = views.update(context, depsgraph, name)
            info = ""
            if draw:
                views.show(name)
                info, late = views.status(name)
                error = error or late
        except Exception as failure:  # an exception here would come with every redraw
            messages.log.exception("viewport failed")
            info, error = "", f"DR-GS failed ({type(failure).__name__}: {failure}); the console has the details"
        if error:
            messages.note("ERROR", error)
        self.update_stats("", error or info)

    def _fail(self, text: str, code: int) -> None:
        """Report an error. `error_set` would let Blender write a black picture and go on."""
        messages.note("ERROR", text, logged=False)
        self.report({"ERROR"}, text)
        background_render.fail(text, code)

    def _render(self, depsgraph: bpy.types.Depsgraph) -> None:
        # Without a window Blender prints what is reported; a log would say it a second time.
        report = self._warn if bpy.app.background else None
        warn = messages.Warnings(messages.warned, report)
        self.update_stats("", "Exporting the scene")

        def export(moments: bool) -> Frame:
            return export_baked(
                depsgraph,
                lambda path: engine_link.load_asset(path, self._stopped),
                warn,
                self._progress,
                frame_set=self._frame_set if moments else None,
                cancelled=self._stopped,
            )

        frame = export(True)
        scene = depsgraph.scene_eval
        steps = blur_steps.steps(scene, depsgraph.view_layer_eval, scene.camera.evaluated_get(depsgraph), warn)
        if steps:
            passes = self._blurred(frame, steps, depsgraph, lambda: export(False))
        else:
            passes = engine_link.render(frame, self._progress, self._stopped)
        for text in passes.warnings:
            warn(text)
        messages.end_picture()
        if report is None:
            for text in warn.texts:
                self._warn(text)
        self._show(depsgraph, frame, passes)
        self.update_stats("", summary(frame, passes.statistics))

    def _warn(self, text: str) -> None:
        self.report({"WARNING"}, text)

    def _stopped(self) -> bool:
        """Whether Esc was pressed, or the extension goes."""
        return self.test_break() or _ending.is_set()

    def _blurred(
        self, frame: Frame, steps: list[blur_steps.Step], depsgraph: bpy.types.Depsgraph, export: Callable[[], Frame]
    ) -> Passes:
        """The mean of the pictures of `steps`, in place of that of `frame`."""
        done = 0

        def report(phase: str, fraction: float) -> None:
            if is_preparing(phase):
                self._progress(phase, fraction)
                return
            self._progress(f"Blur {done}/{len(steps)}: {phase}", min(1.0, (done + fraction) / (len(steps) + 1)))

        def parts() -> Iterator[Passes]:
            nonlocal done
            if (still := sharp_frame(frame)) is not None:
                yield engine_link.render(still, report, self._stopped)
            for step in blur.pictures(frame, steps, depsgraph, export, self._frame_set):
                yield engine_link.render(sample_frame(step, len(steps), done), report, self._stopped)
                done += 1

        passes = averaged(parts(), frame.passes)
        engine_link.statistics = passes.statistics
        return passes

    def _frame_set(self, frame: int, subframe: float) -> None:
        self.frame_set(frame, subframe=subframe)

    def _progress(self, phase: str, fraction: float) -> None:
        self.update_stats("", phase)
        self.update_progress(fraction)
        background_render.say_preparing(phase)

    def _show(self, depsgraph: bpy.types.Depsgraph, frame: Frame, passes: dict[str, np.ndarray]) -> None:
        """Hand the passes to Blender, whose rows run upwards."""
        x0, y0, x1, y1 = frame.camera.window
        view_layer = depsgraph.view_layer
        table = enabled(depsgraph.scene, view_layer)
        for p in table:
            if p.name != "Combined":
                self.add_pass(blender_name(p), len(p.channels), p.channels, layer=view_layer.name)
        result = self.begin_result(0, 0, x1 - x0, y1 - y0, layer=view_layer.name)
        stopped = True
        try:
            layer = result.layers[0]
            for p in uncancelled(table, self._stopped):
                layer.passes[blender_name(p)].rect.foreach_set(np.ascontiguousarray(passes[p.name][::-1]).ravel())
            stopped = False
        finally:
            self.end_result(result, cancel=stopped)
        for key, text in cryptomatte.metadata(frame, f"{view_layer.name}.").items():
            self.get_result().stamp_data_add_field(key, text)


def summary(frame: Frame, statistics: dict[str, float]) -> str:
    """Statistics of a picture, for the line above it."""
    parts = [f"{frame.settings.sample_count} samples"]
    parts += [f"{int(statistics[name]):,} {name}" for name in ("surfels", "triangles") if statistics.get(name)]
    seconds = statistics.get("seconds.total")
    if seconds:
        parts.append(
            f"{seconds:.2f} s in the engine, {statistics.get('samples', 0) / 1e6 / seconds:.1f} million samples/s"
        )
    return " | ".join(parts)
