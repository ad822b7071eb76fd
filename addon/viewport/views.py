"""The viewports: the latest request of each, and its newest picture.

Everything here runs on Blender's own thread and returns at once; the `worker` waits for the engine. A timer looks
whether there is news and has the regions drawn again.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import bpy

from ...drgs_blender.core.errors import DrgsError
from ...drgs_blender.core.frame import Camera, Frame
from ...drgs_blender.core.phases import STARTING, is_counted, is_preparing
from .. import bakes, engine_link, messages, preferences
from ..export.camera import check_lens
from ..export.view import view_camera
from ..level_of_detail import most_surfels
from . import blurred, draw, scenes
from .worker import Picture, Request, Worker

#: Seconds between two looks for news, while something is rendered and while nothing is.
_BUSY, _IDLE = 0.01, 0.1
#: Pixels that one redraw brings to the graphics card: some milliseconds.
STRIP_PIXELS = 1 << 20

worker = Worker()
_viewports: dict[str, ViewportState] = {}
_last_news = 0
_last_bakes = (0, "")
#: Seconds that redraws took, and those that Blender's thread worked in them, for `bench/bench_viewport.py`.
redraws: deque[tuple[float, float]] = deque(maxlen=10_000)


@dataclass(slots=True)
class ViewportState:
    """One viewport.

    Attributes
    ----------
    requested : exported scene, camera and settings of the latest request
    picture, strips : the picture on the screen
    arriving, arrived : the next picture, and its strips that are on the graphics card
    since : time at which the first picture of this request was drawn
    warned : warnings of the engine, of its latest pictures
    blur : how the picture is blurred, since the scene changed or the settings of that
    """

    requested: tuple[object, ...] = ()
    picture: Picture | None = None
    strips: list[draw.Strip] = field(default_factory=list)
    arriving: Picture | None = None
    arrived: list[draw.Strip] = field(default_factory=list)
    since: float = 0.0
    warned: list[str] = field(default_factory=list)
    blur: blurred.Blur = field(default_factory=blurred.Blur)


def name_of(region: bpy.types.Region) -> str:
    """Name of a viewport for the engine."""
    return f"viewport {region.as_pointer():x}"


def update(
    context: bpy.types.Context,
    depsgraph: bpy.types.Depsgraph,
    name: str,
    composited: bool = False,
    depthless: bool = False,
) -> str:
    """Ask for the picture of a viewport as it is now; return an error or "".

    Parameters
    ----------
    composited : of the DR-GS objects alone, lit by everything, to be drawn among the others
    depthless : the depth of the others is not known when it is drawn: what they hide is left out of the picture
    """
    region, space, rv3d = context.region, context.space_data, context.region_data
    exported = _export(depsgraph, space)
    if exported.frame is None:
        return exported.error
    through = space.camera if rv3d.view_perspective == "CAMERA" and not composited else None
    if through is not None and through.type == "CAMERA":  # what others draw without such a lens, the overlay does, too
        try:
            check_lens(through)
        except DrgsError as error:
            return str(error)
    try:
        camera = view_camera(region, space, rv3d, depsgraph.scene, curved=not composited)
    except DrgsError as error:
        return str(error)
    if camera is None:
        return ""
    viewport = _viewports.setdefault(name, ViewportState())
    options = _options(depsgraph.scene, name, composited)
    if composited:
        viewport.blur.withdraw()
        viewport.blur = blurred.Blur()
    else:
        viewport.blur = blurred.of(context, depsgraph, through, viewport.blur, _local(space))
    most = most_surfels(depsgraph.scene)
    requested = exported, _values(camera), (options, depthless, viewport.blur.key, most)
    if viewport.requested and viewport.requested[0] is exported and viewport.requested[1:] == requested[1:]:
        return ""
    try:
        client = engine_link.client()
    except DrgsError as error:
        return str(error)
    viewport.requested = requested
    frame = replace(exported.frame, camera=camera, **options)
    if composited:
        frame = _alone(frame, depthless)
    worker.submit(name, Request(frame, client, exported.assets, viewport.blur.parts(frame), most))
    _start()
    return ""


def newest(name: str) -> ViewportState | None:
    """The newest picture of a viewport that is on the graphics card, None before there is one.

    Another one is brought there, as much of it as a redraw has time for.
    """
    viewport = _viewports.get(name)
    if viewport is None:
        return None
    picture = worker.picture(name)
    if viewport.arriving is None and picture is not viewport.picture:  # what is half there is finished first
        viewport.arriving = picture
    if viewport.arriving is not None:
        _upload(viewport, viewport.arriving)
    return viewport if viewport.picture is not None else None


def _upload(viewport: ViewportState, picture: Picture) -> None:
    """The next rows of the picture that is arriving; show it when it is whole."""
    passes = {n: picture.passes[n] for n in draw.KINDS if n in picture.passes}
    height, width = picture.passes["Combined"].shape[:2]
    rows = rows_of_strip(height, width)
    top = rows * len(viewport.arrived)
    viewport.arrived.append(draw.strip(passes, top, min(top + rows, height)))
    if top + rows < height:
        return
    if viewport.picture is None or viewport.picture.request is not picture.request:
        viewport.since = time.perf_counter()
    viewport.picture, viewport.strips = picture, viewport.arrived
    viewport.arriving, viewport.arrived = None, []
    earlier = [] if picture.fraction > 0.0 else viewport.warned  # a coarse one knows less
    viewport.warned = list(dict.fromkeys([*earlier, *picture.passes.warnings]))
    messages.own(id(viewport), viewport.warned)


def rows_of_strip(height: int, width: int) -> int:
    """Rows of a picture that one redraw brings to the graphics card: equal parts of at most `STRIP_PIXELS`."""
    strips = -(-height * width // STRIP_PIXELS)
    return -(-height // strips)


def show(name: str) -> None:
    """Draw the newest picture of a rendered viewport into its region."""
    viewport = newest(name)
    if viewport is not None and viewport.picture is not None:
        draw.picture(viewport.strips, rect_of(viewport.picture))


def status(name: str) -> tuple[str, str]:
    """Status of a viewport: (progress text, error or "")."""
    viewport = _viewports.get(name)
    error = worker.state(name)[1]
    if viewport is None or error:
        return "", error
    baking = bakes.manager.status()[0]
    text = _status(viewport, name)
    return f"{text}  |  {baking}" if baking else text, ""


def _status(viewport: ViewportState, name: str) -> str:
    """Progress text of a viewport without bakes."""
    phase, part = worker.progress(name)
    if is_counted(phase):
        return f"{phase}  {part:.0%}"
    if viewport.picture is None or is_preparing(phase):
        return phase or STARTING
    samples = viewport.picture.request.frame.settings.sample_count
    text = f"Sample {round(viewport.picture.fraction * samples)}/{samples}"
    fewer = reduction(name)
    return f"{text}  |  {fewer}" if fewer else text


def reduction(name: str) -> str:
    """What the picture of a viewport shows in place of all surfels, in words; "" where it shows them."""
    picture = worker.picture(name)
    if picture is None:
        return ""
    shown, whole = picture.surfels
    if shown >= whole:
        return ""
    return f"{shown:,} of {whole:,} surfels" if shown else f"Mesh in place of {whole:,} surfels"


def preparation() -> tuple[str, float]:
    """Progress text while kernels are compiled for a viewport, and the part that is done; ("", 0) otherwise."""
    found = (worker.progress(name) for name in worker.names())
    return next((each for each in found if is_preparing(each[0])), ("", 0.0))


def not_blurred() -> list[str]:
    """What viewports show sharp that F12 blurs, in words."""
    return sorted({text for viewport in _viewports.values() for text in viewport.blur.told})


def forget() -> None:
    """Drop all viewport states, so that nothing of the last file is shown in the next."""
    for name, viewport in list(_viewports.items()):
        worker.drop(name)
        messages.own(id(viewport), ())
    _viewports.clear()
    scenes.forget()


def stop() -> None:
    """Forget everything and end what runs."""
    forget()
    if bpy.app.timers.is_registered(_poll):
        bpy.app.timers.unregister(_poll)
    worker.stop()


def _export(depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D) -> scenes.Exported:
    if space.local_view is None:
        return scenes.exported(depsgraph)

    def is_visible(obj: bpy.types.Object) -> bool:
        return obj.type == "LIGHT" or obj.original.local_view_get(space)  # lights shine in every view

    return scenes.exported(depsgraph, _local(space), is_visible)


def _local(space: bpy.types.SpaceView3D) -> str:
    """Name of a viewport's local view, "" without one."""
    return "" if space.local_view is None else f"{space.as_pointer():x}"


def _options(scene: bpy.types.Scene, name: str, composited: bool) -> dict[str, Any]:
    """What of a frame a viewport chooses itself.

    Settings are those of the scene itself: Blender evaluates no copy of them when they are changed by hand.
    """
    options = scene.drgs
    settings = options.to_settings(composited or scene.render.film_transparent, preferences.read("threads", 0))
    return {
        "noise_index": scene.frame_current if options.use_animated_seed else 0,
        "settings": settings,
        "passes": ("Combined", "Depth") if composited else ("Combined",),
        "history": name if options.use_viewport_denoise else "",
    }


def _alone(frame: Frame, holes: bool = False) -> Frame:
    """The frame in which the camera sees DR-GS objects only, with `holes` where others stand before them.

    Everything else still gives light and shadow.
    """
    change = {"holdout": True} if holes else {"camera": False}
    return replace(
        frame,
        meshes=[replace(mesh, visibility=replace(mesh.visibility, **change)) for mesh in frame.meshes],
        lights=[replace(light, camera=False) for light in frame.lights],
    )


def _values(camera: Camera) -> tuple[object, ...]:
    """Everything about a camera, comparable."""
    return tuple(
        value.tobytes() if name == "matrix_world" else value
        for name, value in ((n, getattr(camera, n)) for n in camera.__slots__)
    )


def rect_of(picture: Picture) -> tuple[float, float, float, float]:
    """Part of the region that a picture covers, y upwards."""
    camera = picture.request.frame.camera
    x0, y0, x1, y1 = camera.window
    return x0 / camera.width, 1 - y1 / camera.height, x1 / camera.width, 1 - y0 / camera.height


# --- the timer ------------------------------------------------------------------------------------------------------


def _start() -> None:
    if not bpy.app.timers.is_registered(_poll):
        bpy.app.timers.register(_poll, first_interval=_BUSY)


def _poll() -> float | None:
    """Have the viewports drawn again that have news; end when there are none left."""
    global _last_news, _last_bakes
    live = dict(_live())
    for name in set(_viewports) - set(live):
        worker.drop(name)
        gone = _viewports.pop(name)
        gone.blur.withdraw()
        messages.own(id(gone), ())
    arriving = {name for name, viewport in _viewports.items() if viewport.arriving is not None}
    # Each is read once: they go on counting.
    news, baked = worker.news, (bakes.manager.news, bakes.manager.status()[0])
    if baked[0] != _last_bakes[0]:
        scenes.renew()
    for name, area in live.items():
        if news != _last_news or baked != _last_bakes or name in arriving:
            area.tag_redraw()
    _last_news, _last_bakes = news, baked
    if not _viewports:
        return None
    return _BUSY if worker.busy() or arriving else _IDLE


def is_rendered(space: bpy.types.SpaceView3D, scene: bpy.types.Scene) -> bool:
    """Whether DR-GS makes the whole picture of a viewport."""
    return scene.render.engine == "DRGS" and space.shading.type == "RENDERED"


def _live() -> Iterator[tuple[str, bpy.types.Area]]:
    """Viewports on the screen that show pictures of ours, by name."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type != "VIEW_3D":
                continue
            if is_rendered(area.spaces.active, window.scene) or window.scene.drgs.overlay == "LIT":
                yield from ((name_of(region), area) for region in area.regions if region.type == "WINDOW")


@contextlib.contextmanager
def timed() -> Iterator[None]:
    """Note how long a redraw takes Blender's thread."""
    began, worked = time.perf_counter(), time.thread_time()
    yield
    redraws.append((time.perf_counter() - began, time.thread_time() - worked))
