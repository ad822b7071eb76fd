"""Runs inside Blender with a window: hands that click and type there, and eyes that know which button is where.

Blender must run with ``--enable-event-simulate``. What is done takes its time: a job is a generator that yields the
seconds to wait, `run` calls it from a timer, and every function here that is a generator is used by ``yield from``.
Buttons are found as a user finds them: the pointer moves over a region until it is above the one that has the wanted
operator or property.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Vector

FOLDER = Path(os.environ["DRGS_WINDOW_JOB"])
ASSET = os.environ["DRGS_WINDOW_ASSET"]
PACKAGE = "bl_ext.user_default.drgs"
#: Seconds to wait for a picture.
PATIENCE = 1200
found: dict[str, object] = {"blender": bpy.app.version_string}

Place = tuple[int, int]
Doing = Iterator[float]

#: Keys of what is no letter.
_DIGITS = ("ZERO", "ONE", "TWO", "THREE", "FOUR", "FIVE", "SIX", "SEVEN", "EIGHT", "NINE")
_KEYS = {".": "PERIOD", "-": "MINUS"} | {str(i): name for i, name in enumerate(_DIGITS)}
#: Where the last button was: the next is looked for near it.
_last = 0
#: Where buttons are looked for: pixels from row to row, and parts of a region's width.
_ROW, _COLUMNS = 9, (0.2, 0.5, 0.8, 0.93)


def part(name: str):
    """A module of the extension."""
    return importlib.import_module(f"{PACKAGE}.{name}")


def windows() -> list[bpy.types.Window]:
    return list(bpy.context.window_manager.windows)


def where(kind: str = "VIEW_3D", region: str = "WINDOW") -> tuple[bpy.types.Window, bpy.types.Area, bpy.types.Region]:
    """Window, area and region of an editor; of the newest window that has it."""
    for window in reversed(windows()):
        for area in window.screen.areas:
            if area.type == kind:
                return window, area, next(r for r in area.regions if r.type == region)
    raise LookupError(f"there is no {kind} on the screen")


def there(kind: str) -> bool:
    """Whether an editor is on the screen."""
    return any(area.type == kind for window in windows() for area in window.screen.areas)


def context_of(kind: str = "VIEW_3D", region: str = "WINDOW"):
    """Context of a region, as a click there has it."""
    window, area, found_region = where(kind, region)
    return bpy.context.temp_override(window=window, area=area, region=found_region)


def middle(kind: str = "VIEW_3D", region: str = "WINDOW") -> Place:
    """In the middle of a region, from the lower left corner of the window."""
    _, _, r = where(kind, region)
    return r.x + r.width // 2, r.y + r.height // 2


def following() -> str:
    """Key of the step that the sidebar marks."""
    workflow = part("addon.workflow")
    with context_of():
        return workflow.next_step(workflow.steps(bpy.context)).key


# The hands

_at: Place = (0, 0)


def move(place: Place, window: bpy.types.Window | None = None) -> Doing:
    """Move the pointer."""
    global _at
    _at = place
    (window or windows()[0]).event_simulate(type="MOUSEMOVE", value="NOTHING", x=place[0], y=place[1])
    yield 0.0


def click(place: Place, window: bpy.types.Window | None = None, times: int = 1) -> Doing:
    """Click with the left button."""
    window = window or windows()[0]
    yield from move(place, window)
    yield 0.1
    for _ in range(times):
        for value in ("PRESS", "RELEASE"):
            window.event_simulate(type="LEFTMOUSE", value=value, x=place[0], y=place[1])
            yield 0.02
    yield 0.2


def drag(start: Place, end: Place) -> Doing:
    """From one place to another with the left button held."""
    window, steps = windows()[0], 12
    yield from move(start)
    yield 0.1
    window.event_simulate(type="LEFTMOUSE", value="PRESS", x=start[0], y=start[1])
    for i in range(1, steps + 1):
        place = tuple(round(a + (b - a) * i / steps) for a, b in zip(start, end, strict=True))
        yield 0.03
        yield from move(place)
    window.event_simulate(type="LEFTMOUSE", value="RELEASE", x=end[0], y=end[1])
    yield 0.2


def key(name: str, window: bpy.types.Window | None = None, **held: bool) -> Doing:
    """Press a key where the pointer is."""
    window = window or windows()[0]
    for value in ("PRESS", "RELEASE"):
        window.event_simulate(type=name, value=value, x=_at[0], y=_at[1], **held)
        yield 0.02
    yield 0.2


def stop_job(runs: Callable[[], bool]) -> Doing:
    """Click the cross beside the progress in the status bar, which has no operator to be found by.

    It ends a job as Esc does, which Blender does not hear among simulated events.
    """
    width = windows()[0].width
    for x in range(round(0.5 * width), round(0.7 * width), 12):
        yield from click((x, 11))
        if not runs():
            return
    yield 1.0


def write(text: str, window: bpy.types.Window | None = None) -> Doing:
    """Type letters, then Return."""
    window = window or windows()[0]
    for letter in text:
        kind = _KEYS.get(letter) or (letter.upper() if letter.isascii() and letter.isalpha() else "SPACE")
        window.event_simulate(type=kind, value="PRESS", unicode=letter, x=_at[0], y=_at[1])
        window.event_simulate(type=kind, value="RELEASE", x=_at[0], y=_at[1])
        yield 0.01
    yield from key("RET", window)


# Which button is where


def beneath(kind: str, region: str) -> str:
    """Operator or property of the button under the pointer, "" where there is none."""
    with context_of(kind, region):
        for operator, given in ((bpy.ops.ui.copy_python_command_button, {}), (bpy.ops.ui.copy_data_path_button, {})):
            if operator.poll():
                with contextlib.suppress(RuntimeError):
                    operator(**given)
                    return bpy.context.window_manager.clipboard
    return ""


def find(
    wanted: str, kind: str = "VIEW_3D", region: str = "UI", column: int | None = None
) -> Generator[float, None, Place]:
    """Move the pointer over a region until the button that has `wanted` in its operator or property lies under it.

    `column` is one of `_COLUMNS`, where a property has several buttons side by side.
    """
    global _last
    window, _, r = where(kind, region)
    columns = _COLUMNS if column is None else (_COLUMNS[column],)
    rows = sorted(range(r.y + 4, r.y + r.height - 2, _ROW), key=lambda y: abs(y - _last))
    seen: set[str] = set()
    for pause in (0.03, 0.15):  # a busy Blender takes longer to notice where the pointer is
        for share in columns:
            for y in rows:
                place = r.x + int(share * r.width), y
                yield from move(place, window)
                yield pause
                seen.add(beneath(kind, region))
                if wanted in beneath(kind, region):
                    yield 0.3
                    if wanted in beneath(kind, region):
                        _last = y
                        return place
    yield from photograph("lost")
    raise LookupError(f"no button for {wanted} in {kind}, {region}, but for {sorted(seen)}")


def press(
    wanted: str, kind: str = "VIEW_3D", region: str = "UI", column: int | None = None, times: int = 1
) -> Generator[float, None, Place]:
    """Click the button that has `wanted`; return where it is."""
    place = yield from find(wanted, kind, region, column)
    yield from click(place, where(kind, region)[0], times)
    return place


def show_tab() -> Doing:
    """Open the sidebar with N and turn to the tab DR-GS with a click."""
    _, area, _ = where()
    yield from move(middle())
    yield from key("N")
    yield from until(lambda: where(region="UI")[2].width > 1, "the sidebar")
    _, area, r = where(region="UI")
    for y in range(r.y + r.height - 20, r.y, -_ROW):
        yield from click((r.x + r.width - 10, y))
        if r.active_panel_category == "DR-GS":
            return
    raise LookupError(f"the sidebar of {area.type} has no tab DR-GS")


# The eyes


def until(condition: Callable[[], bool], what: str, seconds: float = PATIENCE) -> Doing:
    """Wait for something."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {seconds:.0f} s for {what}")
        yield 0.1


def drawn() -> bool:
    """Whether the viewport shows every ray of what was asked for last."""
    views = part("addon.viewport.views")
    name = views.name_of(where()[2])
    shown, newest = views._viewports.get(name), views.worker.picture(name)
    if shown is None or newest is None or views.worker.busy():
        return False
    return shown.picture is newest and newest.fraction == 1


def settled() -> Doing:
    """Until the viewport shows every ray of what there is now; the first time kernels are compiled."""
    redraws, end = part("addon.viewport.views").redraws, time.monotonic() + PATIENCE
    quiet = 0
    while quiet < 3:  # redraws: the first asks for the picture of what has changed
        redraws.clear()
        where()[1].tag_redraw()
        yield from until(lambda: len(redraws) > 0, "a redraw of the viewport")
        yield 0.2
        quiet = quiet + 1 if drawn() else 0
        if time.monotonic() > end:
            raise TimeoutError(f"waited {PATIENCE} s for the picture")


def box_of(obj: bpy.types.Object) -> list[int]:
    """Left, top, right and bottom of an object in the window's picture, y downwards."""
    window, area, r = where()
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    corners = [evaluated.matrix_world @ Vector(c) for c in evaluated.bound_box]
    seen = [location_3d_to_region_2d(r, area.spaces.active.region_3d, c) for c in corners]
    xs, ys = [r.x + p.x for p in seen if p], [window.height - r.y - p.y for p in seen if p]
    return [round(v) for v in (min(xs), min(ys), max(xs), max(ys))]


def image_box() -> list[int]:
    """Left, top, right and bottom of the picture that an Image Editor shows, in the picture of the screen."""
    window, _, r = where("IMAGE_EDITOR")
    (x0, y0), (x1, y1) = (r.view2d.view_to_region(c, c, clip=False) for c in (0.0, 1.0))
    top = windows()[0].height - window.y - r.y  # windows count from the lower left corner of the screen
    return [window.x + r.x + x0, top - y1, window.x + r.x + x1, top - y0]


def photograph(name: str) -> Doing:
    """Have the window drawn and photographed."""
    for window in windows():
        for area in window.screen.areas:
            area.tag_redraw()
    yield 1.0
    request = FOLDER / f"{name}.photo"
    request.write_text("")
    while request.exists():
        yield 0.1


def colour_in(name: str, place: Sequence[int]) -> list[float]:
    """Red, green and blue in a photograph, y downwards; black where nobody takes photographs."""
    path = Path(__file__).parents[2] / "out" / "ui" / bpy.app.version_string.split()[0] / f"{name}.png"
    if not path.exists():
        return [0.0, 0.0, 0.0]
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    (width, height), (x, y) = image.size, place
    at = ((height - 1 - y) * width + x) * image.channels
    colour = list(image.pixels[at : at + 3])
    bpy.data.images.remove(image)
    return colour


def run(job: Iterator[float]) -> None:
    """Go through a job by a timer, write what was found, and end Blender."""

    def go() -> float | None:
        try:
            return next(job)
        except StopIteration:
            pass
        except Exception:
            found["error"] = traceback.format_exc()
        whole = FOLDER / "result.part"
        whole.write_text(json.dumps(found))
        whole.replace(FOLDER / "result.json")
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(go, first_interval=1.0, persistent=True)
