"""Runs inside Blender with a window, for test_by_hand.py: from the startup file to F12 by clicks and keys alone."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import hands
from hands import found, key, move, part, photograph, press, settled, where

boxes: dict[str, list[int]] = {}
found["boxes"] = boxes


def subject() -> bpy.types.Object:
    """The DR-GS object."""
    return next(o for o in bpy.context.scene.objects if part("addon.assets").is_drgs(o))


def seen(name: str) -> Iterator[float]:
    """A picture, and where the object is in it."""
    boxes[name] = hands.box_of(subject())
    yield from photograph(name)


def image() -> str:
    """Name of the image that lights the scene."""
    nodes = bpy.context.scene.world.node_tree.nodes
    return next((n.image.name for n in nodes if n.type == "TEX_ENVIRONMENT" and n.image), "")


def albedo() -> np.ndarray:
    return part("addon.mesh_arrays").read_channel(subject().data, "albedo").copy()


def work() -> Iterator[float]:
    yield from start()
    yield from bring_in()
    yield from light_it()
    yield from bend_it()
    yield from paint_it()
    yield from relight_it()
    yield from lay_over()
    yield from final()
    found["messages"] = [m.text for m in part("addon.messages").history if m.level == "ERROR"]


def start() -> Iterator[float]:
    """The cube of the startup file goes; the tab is opened."""
    yield from move(hands.middle())
    yield from key("X")
    yield from key("RET")
    found["cube"] = [o.name for o in bpy.context.scene.objects if o.type == "MESH"]
    yield from hands.show_tab()
    window, _, r = where()
    # Without the toolbar, the sidebar, the lines of text and the panel of the last operation.
    found["viewport"] = [60, 150, where(region="UI")[2].x - 5, window.height - r.y - 40]
    found["start"] = hands.following()
    yield from photograph("hand-1-start")


def bring_in() -> Iterator[float]:
    """Import with the file browser."""
    yield from press("browse=True")
    yield from hands.until(lambda: hands.there("FILE_BROWSER"), "the file browser", 30)
    yield 1.0
    yield from photograph("hand-2-browser")
    window = where("FILE_BROWSER")[0]
    yield from press("directory", "FILE_BROWSER", "UI", times=2)
    yield from key("A", window, ctrl=True)
    yield from hands.write(hands.ASSET, window)
    yield from move(hands.middle("FILE_BROWSER"), window)
    yield 1.0
    if hands.beneath("FILE_BROWSER", "UI"):  # later Blenders take a path first and end the writing with a second Return
        yield from key("RET", window)
    yield 1.0
    yield from press("file.execute", "FILE_BROWSER", "EXECUTE")
    yield from hands.until(lambda: not hands.there("FILE_BROWSER"), "the end of the import", 60)
    found["imported"] = hands.following()
    yield from move(hands.middle())
    yield from key("NUMPAD_PERIOD")
    yield 1.0
    yield from seen("hand-3-imported")


def light_it() -> Iterator[float]:
    """An image from the menu, and the rendered viewport."""
    x, y = yield from hands.find("drgs.show_rendered")
    rows = 110 if hands.following() == "view" else 49  # the menu has no operator to be found by
    yield from hands.click((x, y + rows))
    yield from photograph("hand-4-lights")
    yield from key("F")
    found["light"] = image()
    yield from press("drgs.show_rendered")
    found["shown"] = bpy.context.scene.render.engine, where()[1].spaces.active.shading.type
    yield from settled()
    yield from seen("hand-5-rendered")


def bend_it() -> Iterator[float]:
    """A lattice, taken back and made again; its upper points are moved."""
    yield from press("drgs.bind_to_lattice")
    counts = [len(bpy.data.lattices)]
    yield from move(hands.middle())
    yield from key("Z", ctrl=True)
    counts.append(len(bpy.data.lattices))
    yield from key("Z", ctrl=True, shift=True)
    counts.append(len(bpy.data.lattices))
    found["lattices"] = counts
    found["bound"] = hands.following()
    yield 0.5
    yield from press("drgs.pose")
    found["mode"] = bpy.context.mode
    yield from settled()
    yield from photograph("hand-6-posing")
    yield from move(hands.middle())
    yield from key("A", alt=True)
    _, top, _, bottom = boxes["hand-5-rendered"]
    height = where()[0].height
    yield from key("B")
    yield from hands.drag((60, height - 100), (where(region="UI")[2].x - 5, height - (top + bottom) // 2))
    yield from move(hands.middle())
    yield from key("G")
    yield from key("X")
    yield from hands.write("1.2")
    yield from settled()
    yield from photograph("hand-7-bent")
    yield from press("object.mode_set")
    found["back"] = bpy.context.mode
    yield from settled()
    yield from seen("hand-8-posed")


def paint_it() -> Iterator[float]:
    """A stroke of the brush."""
    left, top, right, bottom = boxes["hand-8-posed"]
    height = where()[0].height
    spot = (left + right) // 2, height - (top + bottom) // 2
    yield from hands.click(spot)
    found["chosen"] = bpy.context.view_layer.objects.active.name
    place = yield from hands.find("render.render")
    yield from hands.click((place[0], place[1] - 34))
    yield from move(place)
    for _ in range(12):
        yield from key("WHEELDOWNMOUSE")
    yield from photograph("hand-9-object")
    before = albedo()
    x, y = yield from hands.find("show_captured")
    yield from hands.click((x, y + 26))  # a menu has no operator to be found by
    yield from photograph("hand-10-channels")
    yield from key("A")
    found["painting"] = bpy.context.mode
    yield from brush()
    yield from settled()
    yield from photograph("hand-11-paint-mode")
    span = (right - left) // 6
    left, right, y = spot[0] - span, spot[0] + span, spot[1]
    boxes["stroke"] = [left, height - y, right, height - y]
    yield from hands.drag((left, y), (right, y))
    found["painted"] = int((np.abs(albedo() - before).max(axis=1) > 0.05).sum()), len(before)
    yield from settled()
    yield from seen("hand-12-painted")
    yield from move((where(region="UI")[2].x + 100, hands.middle()[1]))
    for _ in range(12):
        yield from key("WHEELUPMOUSE")
    yield from press("object.mode_set")
    yield from settled()
    yield from seen("hand-13-object-mode")


def brush() -> Iterator[float]:
    """Some Blenders come without the brushes of the essentials library; there one is made in the file."""
    tools = bpy.context.tool_settings
    if tools.vertex_paint.brush is None:
        bpy.data.brushes.new("Paint", mode="VERTEX_PAINT").asset_mark()
        with hands.context_of():
            bpy.ops.brush.asset_activate(asset_library_type="LOCAL", relative_asset_identifier="Brush/Paint")
    unified = getattr(tools.vertex_paint, "unified_paint_settings", None)  # of each mode from 5.0 on
    found["brush"] = (unified or tools.unified_paint_settings).size
    yield 0.5


def relight_it() -> Iterator[float]:
    """The light is turned by its field."""
    yield from press("default_value", times=2)
    yield from key("A", ctrl=True)
    yield from hands.write("120")
    yield from settled()
    yield from seen("hand-14-turned")
    found["turn"] = part("addon.world_setup").nodes_of(bpy.context.scene.world)[1].inputs["Rotation"].default_value[2]


def lay_over() -> Iterator[float]:
    """Solid shading, without and with the relit object in it."""
    yield from press("shading.type", region="HEADER")
    found["shading"] = where()[1].spaces.active.shading.type
    yield from seen("hand-15-solid")
    yield from press("overlay", column=2)
    found["overlay"] = bpy.context.scene.drgs.overlay
    yield from settled()
    yield from seen("hand-16-overlay")


def final() -> Iterator[float]:
    """F12, of a size whose window fits the screen."""
    where("PROPERTIES")[1].spaces.active.context = "OUTPUT"
    yield 1.0
    yield from press("resolution_percentage", "PROPERTIES", "WINDOW", column=2, times=2)
    yield from key("A", ctrl=True)
    yield from hands.write("40")
    found["percentage"] = bpy.context.scene.render.resolution_percentage
    yield from move(hands.middle())
    yield from key("F12")
    yield from hands.until(lambda: hands.there("IMAGE_EDITOR"), "the window of the picture", 60)
    yield from hands.until(lambda: not bpy.app.is_job_running("RENDER"), "the picture")
    yield 1.0
    boxes["hand-17-final"] = hands.image_box()
    yield from photograph("hand-17-final")
    path = hands.FOLDER / "final.png"
    bpy.data.images["Render Result"].save_render(str(path))
    found["rendered"] = str(path)


hands.run(work())
