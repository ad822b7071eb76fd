"""Runs inside Blender with a window, for test_first_picture.py: from the start of Blender to a relit picture of a file.

Every click and key of the way is counted. What the hands need to find buttons is not in the seconds, only what Blender
and the engine need.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))

import hands
from hands import found, key, move, part, photograph, until, where

#: The user's file.
FILE = Path(os.environ["DRGS_WINDOW_FILE"])
done: list[str] = []
seconds: dict[str, float] = {}
found["done"], found["seconds"] = done, seconds


def work() -> Iterator[float]:
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"  # a window of its own lacks a window manager
    with hands.context_of():
        bpy.ops.wm.splash("INVOKE_DEFAULT")
    yield 1.0
    yield from start()
    yield from choose()
    begun = time.monotonic()
    yield from until(lambda: objects() or errors(), "the object", 120)
    seconds["object"] = time.monotonic() - begun
    yield from show()
    yield from photograph("first-picture")
    found["errors"], found["objects"] = errors(), [o.name for o in objects()]


def start() -> Iterator[float]:
    """The splash screen and the cube of the startup file go; the hint in the header opens the sidebar."""
    yield from move(hands.middle())
    for name, text in (("ESC", "Esc (the splash screen)"), ("X", "X"), ("RET", "Return (the cube)")):
        yield from key(name)
        done.append(text)
    yield 0.5
    yield from hands.press("drgs.show_sidebar", region="HEADER")
    done.append("*DR-GS is in the sidebar*")
    region = where(region="UI")[2]
    yield from until(lambda: region.active_panel_category == "DR-GS", "the tab", 30)
    found["cubes"] = [o.name for o in bpy.context.scene.objects if o.type == "MESH"]


def choose() -> Iterator[float]:
    """*Import*, and the file, in the folder where it lies."""
    yield from hands.press("browse=True")
    done.append("*Import*")
    yield from until(lambda: hands.there("FILE_BROWSER"), "the file browser", 30)
    yield 0.5
    window, area, region = where("FILE_BROWSER")
    area.spaces.active.params.directory = str(FILE.parent).encode()
    yield 1.0
    yield from photograph("first-picture-browser")
    for y in range(region.y + region.height - 4, region.y, -8):
        yield from hands.click((region.x + 60, y), window)
        if area.spaces.active.params.filename == FILE.name:
            break
    found["file"] = area.spaces.active.params.filename
    done.append("the file")
    yield from hands.press("file.execute", "FILE_BROWSER", "EXECUTE")
    done.append("*Import Object*")


def show() -> Iterator[float]:
    """*Show Rendered*: seconds to the first pixels, and to all samples."""
    button = yield from hands.find("drgs.show_rendered")
    views = part("addon.viewport.views")
    yield from hands.click(button)
    begun = time.monotonic()
    done.append("*Show Rendered*")
    name = views.name_of(where()[2])
    yield from until(lambda: views.worker.picture(name) is not None or errors(), "the first pixels", 300)
    seconds["first pixels"] = time.monotonic() - begun
    yield from until(lambda: hands.drawn() or errors(), "all samples", 300)
    seconds["all samples"] = time.monotonic() - begun


def objects() -> list[bpy.types.Object]:
    return [o for o in bpy.context.scene.objects if part("addon.assets").is_drgs(o)]


def errors() -> list[str]:
    return [m.text for m in part("addon.messages").history if m.level == "ERROR"]


hands.run(work())
