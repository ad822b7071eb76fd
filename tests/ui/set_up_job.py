"""Runs inside Blender with a window, for test_set_up.py: makes the engine's environment by clicks, cancelled once."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))

import hands
from hands import found, key, part, photograph, press, until


def fraction() -> float:
    return part("addon.setup_job").job.fraction


def running() -> bool:
    return part("addon.setup_job").running()


def state() -> str:
    return part("addon.engine_environment").state(part("addon.engine_link").engine_folder())


def work() -> Iterator[float]:
    os.environ.pop("DRGS_ENGINE")
    found["before"] = state()
    yield from hands.show_tab()
    x, y = yield from hands.find("drgs.engine_setup")
    yield from hands.click((x, y + 29))  # Allow Online Access: preferences have no path to be found by
    found["online"] = bpy.app.online_access
    yield from begin("1-dialog")
    yield from until(lambda: fraction() > 0.2 or not running(), "the first packages")
    yield from photograph("set-up-2-fetching")
    yield from press("drgs.engine_setup_cancel")
    found["cancelled"] = state(), running()
    yield from photograph("set-up-3-cancelled")
    yield from begin("4-dialog-again")
    texts = found["texts"] = []
    while running():
        texts += [part("addon.setup_job").job.text]
        yield 0.2
    found["texts"] = sorted(set(texts))
    found["after"] = state()
    yield from photograph("set-up-5-ready")
    if state() == "ready":
        yield from click_engine()
    found["messages"] = [m.text for m in part("addon.messages").history]


def begin(name: str) -> Iterator[float]:
    """Press the button, look at the dialog, and agree."""
    yield from press("drgs.engine_setup")
    yield from photograph(f"set-up-{name}")
    yield from key("RET")
    yield from until(running, "the set-up")


def click_engine() -> Iterator[float]:
    """The new engine answers; From Photographs offers what it lacks."""
    bpy.ops.drgs.engine_test()
    found["pid"] = part("addon.engine_link").client().pid
    yield from press("drgs.reconstruct")
    yield from photograph("set-up-6-photographs")
    yield from key("ESC")
    found["photographs"] = hands.there("FILE_BROWSER")


hands.run(work())
