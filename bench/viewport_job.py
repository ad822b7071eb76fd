"""Runs inside Blender with a window, for bench_viewport.py: changes things and notes when the picture follows.

The file that DRGS_VIEWPORT_JOB names says what to do; the result is written beside it.
"""

from __future__ import annotations

import importlib
import json
import os
import time
import traceback
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import bpy
from mathutils import Euler

JOB = Path(os.environ["DRGS_VIEWPORT_JOB"])
PACKAGE = "bl_ext.user_default.drgs"


def area() -> bpy.types.Area:
    return next(a for w in bpy.context.window_manager.windows for a in w.screen.areas if a.type == "VIEW_3D")


class Run:
    """The measurement: `steps` is called from a timer and yields the seconds to wait."""

    def __init__(self, job: dict) -> None:
        self.job = job
        self.views = importlib.import_module(f"{PACKAGE}.addon.viewport.views")
        self.result: dict[str, object] = {"blender": bpy.app.version_string, "latencies": {}, "engine": {}}
        self.bringing: set[int] = set()  # redraws that bring a new picture, by their place in `redraws`
        bring = self.views.draw.strip

        def noted(*arguments: object) -> object:
            self.bringing.add(len(self.views.redraws))
            return bring(*arguments)

        self.views.draw.strip = noted

    def steps(self) -> Iterator[float]:
        self.build()
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0], area=area()):
            bpy.ops.screen.screen_full_area(use_hide_panels=True)
        yield 1.0
        region = next(r for r in area().regions if r.type == "WINDOW")
        self.name = self.views.name_of(region)
        self.result["size"] = region.width, region.height
        area().spaces.active.shading.type = "RENDERED"
        yield from self.until(self.finished)
        changes = self.turn, self.move, self.light, self.bend
        for change in changes:  # kernels of every kind of change are loaded
            yield from self.changed(change, self.job["repeats"] + 1)
            yield from self.until(self.finished)
        self.begin_redraws()
        for change in changes:
            found: list[float] = []
            engine: list[dict[str, float]] = []
            for i in range(1, self.job["repeats"] + 1):
                began = yield from self.changed(change, i)
                found.append(self.shown().since - began)
                shown = self.shown().picture
                engine.append({"seconds.worker": shown.seconds, **shown.passes.statistics})
                yield 0.25  # in the middle of its refinement
            self.result["latencies"][change.__name__] = found
            self.result["engine"][change.__name__] = engine
            yield from self.until(self.finished)
        self.result["redraws while changing"] = self.redraws()
        self.begin_redraws()
        yield from self.turn_on("rendered")
        began = time.perf_counter()
        self.turn(1)
        yield from self.until(self.finished)
        self.result["seconds to the last sample"] = time.perf_counter() - began
        bpy.context.scene.drgs.overlay = "LIT"
        area().spaces.active.shading.type = "SOLID"
        yield from self.until(lambda: self.shown().picture is not None and "Depth" in self.shown().picture.passes)
        yield from self.until(self.finished)
        yield from self.turn_on("composited")

    def turn_on(self, name: str) -> Iterator[float]:
        """Turn the view without a pause."""
        self.begin_redraws()
        pictures, last, end, i = 0, None, time.perf_counter() + self.job["seconds"], 0
        while time.perf_counter() < end:
            self.turn(i := i + 1)
            yield 1 / 60
            pictures += self.shown().picture is not last
            last = self.shown().picture
        self.result[f"redraws while turning, {name}"] = self.redraws()
        self.result[f"pictures a second, {name}"] = pictures / self.job["seconds"]

    def build(self) -> None:
        for obj in list(bpy.data.objects):
            if obj.type == "MESH":
                bpy.data.objects.remove(obj)
        bpy.ops.import_scene.drgs(filepath=self.job["asset"])
        self.object = bpy.context.object
        self.object.scale = [2.2 / max(self.object.dimensions)] * 3
        self.object.shape_key_add(name="Basis")
        bent = self.object.shape_key_add(name="Bent")
        for i in range(0, len(bent.data), 10):
            bent.data[i].co.x += 0.02
        bpy.ops.mesh.primitive_plane_add(size=8, location=(0, 0, 0))
        scene = bpy.context.scene
        scene.render.engine = "DRGS"
        bpy.ops.object.select_all(action="DESELECT")
        space = area().spaces.active
        space.overlay.show_overlays = False
        space.region_3d.view_distance = 5.0
        space.region_3d.view_location = 0, 0, 1
        self.turn(0)

    def begin_redraws(self) -> None:
        """Forget the redraws so far."""
        self.views.redraws.clear()
        self.bringing.clear()

    def redraws(self) -> list[tuple[float, float, bool]]:
        """Wall seconds, those of Blender's thread, and whether a new picture was brought, per redraw."""
        return [(*each, i in self.bringing) for i, each in enumerate(self.views.redraws)]

    # Changes

    def turn(self, i: int) -> None:
        area().spaces.active.region_3d.view_rotation = Euler((1.2, 0, 0.03 * i)).to_quaternion()

    def move(self, i: int) -> None:
        self.object.location.x = 0.01 * i

    def light(self, i: int) -> None:
        bpy.data.worlds[0].color = [0.05 + 0.01 * i] * 3
        tree = bpy.data.worlds[0].node_tree
        if tree is not None:
            next(n for n in tree.nodes if n.type == "BACKGROUND").inputs["Strength"].default_value = 1 + 0.1 * i

    def bend(self, i: int) -> None:
        self.object.data.shape_keys.key_blocks["Bent"].value = 0.02 * i

    # Waiting

    def changed(self, change: Callable[[int], None], i: int) -> Generator[float, None, float]:
        """Make a change and wait for its first picture; when it was made."""
        began = time.perf_counter()
        change(i)
        yield from self.until(lambda: self.shown().since > began)
        return began

    def shown(self):
        return self.views._viewports.get(self.name) or self.views.ViewportState()

    def finished(self) -> bool:
        picture = self.shown().picture
        return picture is not None and picture.fraction == 1.0 and not self.views.worker.busy()

    def until(self, condition: Callable[[], bool]) -> Iterator[float]:
        end = time.monotonic() + self.job["patience"]
        while not condition():
            error = self.views.worker.state(self.name)[1]
            if error or time.monotonic() > end:
                raise RuntimeError(error or "the picture does not come")
            yield 0.002


def main() -> None:
    run = Run(json.loads(JOB.read_text()))
    steps = run.steps()

    def tick() -> float | None:
        try:
            return next(steps)
        except StopIteration:
            pass
        except Exception:
            run.result["error"] = traceback.format_exc()
        JOB.with_suffix(".partial").write_text(json.dumps(run.result))
        JOB.with_suffix(".partial").replace(JOB.with_suffix(".result"))
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(tick, first_interval=1.0)


main()
