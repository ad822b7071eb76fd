"""One frame, from posed surfels and a traced scene to passes.

The picture is made in strips of rows, the light of a strip in batches of points. Both sizes only bound memory and the
time until a cancel is seen: no sample depends on them, so the passes are the same to the last bit whatever they are.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ..asset.model import PosedSurfels
from ..errors import Cancelled, UsageError
from ..frame import Frame
from ..jit import use_threads
from ..passes import BY_NAME
from .camera import camera_parameters
from .lights.lamps import Lamps
from .lights.light import EnvironmentLight
from .picture.denoise import denoise
from .picture.film import COMPONENTS, Film
from .picture.oidn import denoise_oidn, require
from .points import Radiance, ShadingPoints
from .primary.gbuffer import GBuffer
from .primary.primary_mesh import primary_mesh
from .primary.primary_surfels import primary_surfels, snap_windows
from .primary.seen_lamps import seen_lamps
from .shade.adaptive import part_count, sample_adaptively
from .shade.integrate import integrate
from .surfels.splats import prepare
from .trace.scene import TraceScene

Array = np.ndarray
Progress = Callable[[float, str], None]
Check = Callable[[], None]

#: Memory a strip may take, and what a sub-pixel sample takes of it at most (samples, points, light).
STRIP_BYTES, SAMPLE_BYTES = 64 << 20, 310
#: Seconds a batch of points should take, how many samples (points times rays) the first one has, fewest points of any.
BATCH_SECONDS, FIRST_SAMPLES, FEWEST_POINTS = 0.1, 1 << 17, 16


def render(
    scene: TraceScene,
    light: EnvironmentLight,
    posed: PosedSurfels,
    frame: Frame,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    lamps: Lamps | None = None,
) -> dict[str, Array]:
    """Render the passes of a frame.

    Parameters
    ----------
    scene : what rays meet, updated for this frame; its objects in the order of ``frame.objects``
    light : the frame's world
    posed : surfels of all objects, world space; not used when ``frame.settings.primary`` is "mesh"
    progress : called with the part done in [0, 1] and the name of the phase
    cancelled : asked several times a second
    lamps : the frame's lights

    Returns
    -------
    pass name -> (h, w, channels) float32 of the camera's window, row 0 at the top; those of ``frame.passes``

    Raises
    ------
    UsageError: a camera through which nothing can be seen, an unknown pass or setting.
    Cancelled: `cancelled` said so.
    """
    settings, camera = frame.settings, frame.camera
    _check(frame)
    use_threads(settings.threads)
    parameters = camera_parameters(camera, settings, frame.number)

    def check() -> None:
        if cancelled is not None and cancelled():
            raise Cancelled

    def tell(part: float, phase: str) -> None:
        check()
        if progress is not None:
            progress(part, phase)

    tell(0.0, "Projecting")
    surfels = settings.primary == "surfels"
    if surfels:
        splats = prepare(posed, camera, parameters)
        windows = snap_windows(scene, len(frame.objects))
    film = Film(camera, settings, parameters)
    _, top, _, bottom = camera.window
    end = 1.0 if settings.denoise == "none" else 0.9
    batches = _Batches(scene, light, lamps, frame, check)
    height = strip_height(camera.window[2] - camera.window[0], settings.aa)
    for y0 in range(top, bottom, height):
        tell(end * (y0 - top) / (bottom - top), "Rendering")
        y1 = min(y0 + height, bottom)
        if surfels:
            buffer = primary_surfels(splats, scene, windows, camera, y0, y1)
        else:
            buffer = primary_mesh(scene, camera, parameters, y0, y1)
        check()
        radiance = batches.light(buffer)
        film.add(buffer, radiance, scene.pass_index, light)
        if lamps is not None and lamps.seen:
            film.emission[y0 - top : y1 - top] += seen_lamps(lamps, parameters, camera.window[0], buffer)
    components = None
    if settings.denoise != "none":
        tell(end, "Denoising")
        split = any(name in frame.passes for name in COMPONENTS)
        if settings.denoise == "oidn":
            components = denoise_oidn(film.components, film.guides(), split, check)
        else:
            components = denoise(film.components, film.variance, film.guides(), split, check)
    tell(1.0, "Done")
    return film.passes(frame.passes, components)


def strip_height(width: int, aa: int) -> int:
    """Rows of a strip that fit in `STRIP_BYTES`."""
    return max(1, STRIP_BYTES // (SAMPLE_BYTES * width * aa))


class _Batches:
    """Integrates points in batches as long as `BATCH_SECONDS`, learning how many points these are."""

    def __init__(
        self, scene: TraceScene, light: EnvironmentLight, lamps: Lamps | None, frame: Frame, check: Check
    ) -> None:
        self._scene, self._light, self._lamps, self._frame, self._check = scene, light, lamps, frame, check
        self._parts = part_count(frame.settings)
        self._size = max(FEWEST_POINTS, FIRST_SAMPLES * self._parts // max(1, frame.settings.rays))

    def light(self, buffer: GBuffer) -> Radiance:
        """Light of all points of `buffer`."""
        if self._parts == 1:
            return self._trace(buffer.points, (0, 1))
        threshold = self._frame.settings.noise_threshold
        return sample_adaptively(buffer.points, self._frame.settings.rays, self._parts, threshold, self._trace)

    def _trace(self, points: ShadingPoints, part: tuple[int, int]) -> Radiance:
        n = len(points)
        out = Radiance(np.empty((n, 4, 3), np.float32), np.empty((n, 2), np.float32))
        first = 0
        while first < n:
            last = min(first + self._size, n)
            began = time.perf_counter()
            found = integrate(
                self._scene,
                self._light,
                points[first:last],
                self._frame.settings,
                self._frame.number,
                self._lamps,
                part,
            )
            out.components[first:last], out.variance[first:last] = found.components, found.variance
            if found.unshadowed is not None:
                out.unshadowed = np.zeros(n, np.float32) if out.unshadowed is None else out.unshadowed
                out.unshadowed[first:last] = found.unshadowed
            if last - first == self._size:
                pace = BATCH_SECONDS / max(time.perf_counter() - began, 1e-6)
                self._size = int(min(max(self._size * min(max(pace, 0.25), 4.0), FEWEST_POINTS), 1 << 20))
            first = last
            self._check()
        return out


def _check(frame: Frame) -> None:
    """Raise UsageError on what the stages below would misunderstand."""
    settings = frame.settings
    for name in frame.passes:
        if name not in BY_NAME:
            raise UsageError(f"pass {name!r}", "does not exist", f"Choose from {', '.join(BY_NAME)}")
    if settings.primary not in ("surfels", "mesh"):
        raise UsageError("primary visibility", f"is {settings.primary!r}", "Choose surfels or mesh")
    if settings.denoise not in ("none", "svgf", "oidn"):
        raise UsageError("denoiser", f"is {settings.denoise!r}", "Choose none, svgf or oidn")
    if settings.denoise == "oidn":
        require()  # before the work, not after it
