"""Runs inside Blender with a window, for test_soak.py: the same few things again and again while pictures are made."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))

import hands
from hands import found, part, settled, where

UNDOS, RELOADS, SWITCHES = (int(n) for n in os.environ["DRGS_SOAK"].split())


def children() -> list[str]:
    """Command lines of the processes that this one started and that run."""
    lines = []
    for task in Path("/proc/self/task").iterdir():
        for pid in (task / "children").read_text().split():
            try:
                line = Path(f"/proc/{pid}/cmdline").read_bytes()
            except OSError:  # ended just now
                continue
            if line:  # a zombie has none
                lines.append(line.replace(b"\0", b" ").decode())
    return lines


def subject() -> bpy.types.Object:
    return next(o for o in bpy.context.scene.objects if part("addon.assets").is_drgs(o))


def move(x: float) -> None:
    """Put the object somewhere, with an undo step as a user makes it."""
    subject().location.x = x
    bpy.ops.ed.undo_push(message="Move")


def work() -> Iterator[float]:
    with hands.context_of():
        for obj in list(bpy.data.objects):
            bpy.data.objects.remove(obj)
        bpy.ops.import_scene.drgs(filepath=hands.ASSET)
        bpy.ops.view3d.view_selected()
        bpy.ops.object.select_all(action="DESELECT")
        lights = {s.name: s.path for s in bpy.context.preferences.studio_lights if s.type == "WORLD"}
        bpy.ops.drgs.choose_light(filepath=lights["city.exr"])
        bpy.ops.drgs.show_rendered()
    space = where()[1].spaces.active
    space.overlay.show_overlays, space.show_gizmo = False, False
    window, _, r = where()
    low, high = window.height - r.y, window.height - r.y - r.height + 120  # without header and lines of text
    found["viewport"] = [r.x, high, r.x + r.width, low]
    yield from settled()
    move(0.0)
    yield from settled()
    yield from hands.photograph("soak-1-before")
    move(1.0)
    yield from settled()
    yield from hands.photograph("soak-2-moved")
    yield from undo_and_redo()
    yield from settled()
    yield from hands.photograph("soak-3-undone")
    yield from reload()
    yield from settled()
    yield from hands.photograph("soak-4-loaded")
    yield from switch()
    yield from settled()
    yield from hands.photograph("soak-5-switched")
    yield from render()
    found["errors"] = [m.text for m in part("addon.messages").history if m.level == "ERROR"]


def undo_and_redo() -> Iterator[float]:
    """Ends where it was before the object was moved."""
    places = set()
    for i in range(UNDOS):
        with hands.context_of():
            (bpy.ops.ed.redo if i % 2 else bpy.ops.ed.undo)()
        places.add((i % 2, subject().location.x))
        yield 0.02 * (i % 8)  # at other moments of the picture each time
    with hands.context_of():
        if UNDOS % 2 == 0:
            bpy.ops.ed.undo()
    found["places"] = sorted(places)


def reload() -> Iterator[float]:
    path = str(hands.FOLDER / "soak.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    most = 0
    for i in range(RELOADS):
        with hands.context_of():
            bpy.ops.wm.open_mainfile(filepath=path)
        where()[1].spaces.active.shading.type = "RENDERED"  # Blender opens every file in Solid shading
        yield 0.1 + 0.05 * (i % 8)
        most = max(most, len(children()))
    found["engines"] = most


def switch() -> Iterator[float]:
    """The add-on off and on; without it nothing of it runs."""
    left = []
    for i in range(SWITCHES):
        with hands.context_of():
            bpy.ops.preferences.addon_disable(module=hands.PACKAGE)
        yield 0.5
        if children():
            yield 3.0  # the time an engine is given to end by itself
        left += children()
        with hands.context_of():
            bpy.ops.preferences.addon_enable(module=hands.PACKAGE)
        yield 0.3 + 0.2 * (i % 8)
    found["left"] = left


def render() -> Iterator[float]:
    """The same picture by F12 twice; during the second the object is moved and deleted."""
    scene, rendering = bpy.context.scene, lambda: bpy.app.is_job_running("RENDER")
    with hands.context_of():
        bpy.ops.drgs.add_camera()
        bpy.ops.ed.undo_push(message="Camera")
    bpy.context.preferences.view.render_display_type = "NONE"
    scene.render.resolution_x, scene.render.resolution_y = 480, 270
    scene.drgs.use_strategy_samples, scene.drgs.samples, scene.drgs.use_animated_seed = False, 256, False
    for name in ("alone", "disturbed"):
        with hands.context_of():
            bpy.ops.render.render("INVOKE_DEFAULT")
        yield from hands.until(rendering, "F12", 60)
        if name == "disturbed":
            yield 0.1
            move(1.0)
            with hands.context_of():
                subject().select_set(True)
                bpy.ops.object.delete("EXEC_DEFAULT", True)
            found["deleted while it renders"] = rendering()
        yield from hands.until(lambda: not rendering(), "the end of F12", 300)
        yield 0.5
        found[name] = str(hands.FOLDER / f"{name}.png")
        bpy.data.images["Render Result"].save_render(found[name])
    for _ in range(2):  # not before: undo ends a picture of any engine
        with hands.context_of():
            bpy.ops.ed.undo()
    found["brought back"] = subject().location.x


hands.run(work())
