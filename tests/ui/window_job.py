"""Runs inside Blender with a window, for test_window.py: goes the workflow, notes and photographs it."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))

import hands
from hands import ASSET, FOLDER, PATIENCE, context_of, following, found, part, where


def press(operator: str, **values: object) -> None:
    """Run an operator as a button does: with an undo step of its own."""
    group, name = operator.split(".")
    getattr(getattr(bpy.ops, group), name)("EXEC_DEFAULT", True, **values)


def show_tab(view: bpy.types.Area) -> bool:
    """Turn to the tab DR-GS; not possible before the sidebar has been drawn once."""
    try:
        next(r for r in view.regions if r.type == "UI").active_panel_category = "DR-GS"
    except AttributeError:
        return False
    return True


def photograph(name: str) -> Iterator[float]:
    """Photograph the window with the tab DR-GS."""
    view = where()[1]
    view.spaces.active.show_region_ui = True
    while not show_tab(view):
        yield 0.2
    yield from hands.photograph(name)


def modifiers() -> list[str]:
    return [m.name for o in bpy.context.scene.objects if o.type == "MESH" for m in o.modifiers]


def select(obj: bpy.types.Object) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj


def workflow() -> Iterator[float]:
    """From an empty file to the picture."""
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    bpy.context.scene.world = None
    where("PROPERTIES")[1].spaces.active.context = "RENDER"
    engine = os.environ.pop("DRGS_ENGINE")
    found["first"] = following()
    yield from photograph("1-engine")
    os.environ["DRGS_ENGINE"] = engine
    found["with engine"] = following()
    press("import_scene.drgs", filepath=ASSET)
    bpy.ops.view3d.view_selected()
    found["imported"] = following()
    lights = {s.name: s.path for s in bpy.context.preferences.studio_lights if s.type == "WORLD"}
    press("drgs.choose_light", filepath=lights["forest.exr"])
    found["lit"] = following()
    press("drgs.show_rendered")
    found["seen"] = following()
    press("drgs.add_camera")
    found["camera"] = following()
    yield from hands.settled()
    yield from photograph("2-rendered")
    mesh = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    select(mesh)
    press("drgs.bind_to_lattice")
    found["bound"] = modifiers()
    bpy.ops.ed.undo()
    found["undone"] = modifiers(), len(bpy.data.lattices)
    bpy.ops.ed.redo()
    found["redone"] = modifiers(), len(bpy.data.lattices)
    select(next(o for o in bpy.context.scene.objects if o.type == "MESH"))
    press("drgs.mark_assets")
    press("drgs.bind_to_cage", faces=200)
    where()[1].spaces.active.shading.type = "SOLID"
    select(next(o for o in bpy.context.scene.objects if o.asset_data is not None))
    press("drgs.pose")
    found["mode"] = bpy.context.mode
    yield from photograph("3-posing")
    bpy.ops.object.mode_set(mode="OBJECT")
    yield from export()
    bpy.ops.drgs.engine_setup("INVOKE_DEFAULT")
    yield from photograph("4-dialog")
    found["messages"] = [m.text for m in part("addon.messages").history if m.level == "ERROR"]


def export() -> Iterator[float]:
    """File > Export: its dialog, and a file that is written while the window lives."""
    bpy.ops.drgs.export("INVOKE_DEFAULT")
    yield from photograph("5-export")
    for window in bpy.context.window_manager.windows:
        for other in window.screen.areas:
            if other.type == "FILE_BROWSER":
                with bpy.context.temp_override(window=window, area=other):
                    bpy.ops.file.cancel()
    yield 0.5
    target, end = FOLDER / "window.spz", time.monotonic() + PATIENCE
    press("drgs.export", filepath=str(target), format="SPZ")
    while not target.exists() and time.monotonic() < end:
        yield 0.2
    found["exported"] = target.exists()


def in_viewport() -> Iterator[float]:
    """The workflow, with the context that a click in the viewport has."""
    steps = workflow()
    while True:
        with context_of():
            try:
                wait = next(steps)
            except StopIteration:
                return
        yield wait


hands.run(in_viewport())
