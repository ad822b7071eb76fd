"""Progressive rendering: every step gives all pixels of a picture one more part of their samples.

For viewports. The parts are those of the whole picture (`pipeline.render`), drawn in another order: once all are there,
it is the same picture to the rounding of sums, and to the last bit where a noise threshold decides who gets them. No
step depends on the time that others took.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..compute.jit import njit
from ..compute.threads import interruptible, use_threads
from ..core.errors import Cancelled
from ..core.frame import Frame, RenderSettings
from .backend import CPU, RenderBackend
from .camera import camera_parameters
from .film.film import Film
from .film.light_group_film import LightGroupFilm
from .film.lobe_colours import put_lobe_colours
from .film.object_numbers import object_numbers
from .film.seen_world import SeenWorld
from .film.surface_film import SurfaceFilm
from .gbuffer.gbuffer import GBuffer
from .gbuffer.visible_lights import visible_lights
from .integrator.adaptive import Sampling, part_count
from .integrator.variance import variances
from .pipeline import Batches, VisibleSurfaces, check_frame, denoised, strip_height
from .prepared_scene import PreparedScene
from .shading_points import UNLIT, Radiance, ShadingPoints

Array = np.ndarray

#: Bytes of camera samples that a picture keeps between its steps; those of further strips are found again in each step.
KEPT_BYTES = 512 << 20
#: Parts of a sub-pixel sample at most, and samples of a part.
_MOST_PARTS, _FEWEST = 32, 4


def parts_of(settings: RenderSettings) -> list[tuple[int, tuple[int, int]]]:
    """The steps of a picture: (sub-pixel sample, (i, n) as of `integrate`), n times round all sub-pixel samples.

    With a noise threshold n is that of the whole picture, which decides after every part. Otherwise n is 1 for SVGF: it
    is guided by the variance, which is then that of the whole to the last bit.
    """
    n = part_count(settings)
    if n > 1:
        return [(sample, (i, n)) for i in range(n) for sample in range(settings.subpixel_count)]
    n = settings.sample_count // (settings.subpixel_count * _FEWEST)
    n = 1 if settings.denoise == "svgf" or n < 1 else min(1 << n.bit_length() - 1, _MOST_PARTS)
    return [(sample, (i, n)) for i in range(n) for sample in range(settings.subpixel_count)]


#: Width of the pixel filter of coarse pictures: with one sample a pixel, edges drawn from a wide one are ragged.
CENTRE = 0.02


def coarse(frame: Frame, size: int) -> Frame:
    """The frame with pixels of `size` by `size`, one sample each of every strategy, for a first picture.

    Its picture covers exactly the window of ``frame.camera``. Where the frame is to be denoised, or names a ``history``
    to continue, it is by SVGF.
    """
    camera = frame.camera
    x0, y0, x1, y1 = camera.window
    width, height = max(1, round((x1 - x0) / size)), max(1, round((y1 - y0) / size))
    sx, sy = width / (x1 - x0), height / (y1 - y0)
    view = replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * sx,
        fy=camera.fy * sy,
        cx=(camera.cx - x0) * sx,
        cy=(camera.cy - y0) * sy,
        region=None,
    )
    samples, by_strategy = min(3, frame.settings.samples), frame.settings.strategy_samples
    few = by_strategy and (min(1, by_strategy[0]), min(1, by_strategy[1]), min(1, by_strategy[2]))
    settings = replace(
        frame.settings,
        samples=samples,
        strategy_samples=few,
        subpixel_samples=1,
        noise_threshold=0.0,
        filter_width=CENTRE,
    )
    if settings.denoise != "none" or frame.history:
        settings.denoise = "svgf"
    return replace(frame, camera=view, settings=settings, previous=None, next=None)


@dataclass(slots=True)
class _Strip:
    """Rows of the picture: their camera samples while they are kept, and the light of their points so far.

    ``moments`` are sums over the parts drawn, ``latest`` those of the part that is being drawn.
    """

    rows: tuple[int, int]
    buffer: GBuffer | None = None
    light: Sampling | None = None
    moments: Array | None = None
    latest: Array | None = None

    def begin(self, points: int, settings: RenderSettings, parts: int) -> None:
        """Allocate memory for the light of the points."""
        self.light = Sampling(points, settings.sample_count, parts, settings.noise_threshold)
        self.moments, self.latest = np.zeros((points, 5), np.float32), np.zeros((points, 5), np.float32)

    def add(self, chosen: Array, found: Radiance) -> None:
        """Take the light of one part of the points `chosen`."""
        assert self.light is not None and self.moments is not None and self.latest is not None
        self.light.add(chosen, found)
        self.moments[chosen] += found.moments
        self.latest[chosen] = found.moments

    def end(self, points: ShadingPoints) -> None:
        """All points have had the part."""
        assert self.light is not None and self.latest is not None
        going = self.light.going
        self.light.decide(points.pixel, points.weight, variances(points.pixel[going], self.latest[going]))

    def radiance(self, points: ShadingPoints, exact: bool) -> Radiance:
        """The light as far as it is known; points that have none yet get that of their pixel.

        With `exact` the variance is that which the noise threshold decides by, which is known at the end of a part;
        else it is that of all samples taken together.
        """
        assert self.light is not None and self.moments is not None
        found, drawn = self.light.radiance(), self.light.drawn
        if exact:
            return found
        scale = 1.0 / np.maximum(drawn, 1).astype(np.float32)
        once = np.ones_like(scale)
        moments = self.moments * np.stack([once, scale, scale**2, scale, scale**2], axis=1)
        found.variance = variances(points.pixel, moments)
        if not drawn.all():
            unshadowed = np.zeros(len(scale), np.float32) if found.unshadowed is None else found.unshadowed
            _spread(points.pixel, points.flags, points.weight, drawn, found.components, found.variance, unshadowed)
        return found


class Progressive:
    """One picture in steps.

    Parameters
    ----------
    frame : Frame
    backend : RenderBackend
        As of `pipeline.render`.
    """

    def __init__(self, frame: Frame, backend: RenderBackend = CPU) -> None:
        check_frame(frame)
        self.frame, self._backend = frame, backend
        self._parts = parts_of(frame.settings)
        self._adaptive = part_count(frame.settings) > 1
        self._next = 0
        self._parameters = camera_parameters(frame.camera, frame.settings, frame.noise_index)
        left, top, right, bottom = frame.camera.window
        height = backend.strip_factor * strip_height(right - left, frame.settings.subpixel_count)
        self._strips = [_Strip((y, min(y + height, bottom))) for y in range(top, bottom, height)]
        self._visible: VisibleSurfaces | None = None
        self._left = KEPT_BYTES
        self._seen_world: SeenWorld | None = None

    @property
    def fraction(self) -> float:
        """Part of the samples that the picture has, in [0, 1]; 1 too where no pixel needs the others."""
        return self._next / len(self._parts)

    def advance(
        self,
        prepared: PreparedScene,
        seconds: float = 0.0,
        cancelled: Callable[[], bool] | None = None,
    ) -> dict[str, Array]:
        """Draw parts until `seconds` have passed, at least one; return the passes as `pipeline.render` does.

        The scene and its light must be those of the first call. Cancelled half way, nothing of the part is kept.

        Raises
        ------
        Cancelled, UsageError
        """

        def check() -> None:
            if cancelled is not None and cancelled():
                raise Cancelled

        use_threads(self.frame.settings.threads)
        check()
        if self._visible is None:
            with interruptible(check):
                self._visible = VisibleSurfaces(prepared, self.frame, self._parameters, self._backend)
        batches = Batches(prepared, self.frame, check, self._backend)
        began = time.perf_counter()
        while self._next < len(self._parts):
            self._draw(batches, check)
            if time.perf_counter() - began >= seconds:
                break
        with interruptible(check):
            return self._develop(prepared, check)

    def _draw(self, batches: Batches, check: Callable[[], None]) -> None:
        sample, part = self._parts[self._next]
        last = sample == self.frame.settings.subpixel_count - 1
        found = []
        for strip in self._strips:
            if strip.light is not None and not len(strip.light.going):
                continue
            with interruptible(check):
                points = self._samples(strip).points
            check()
            assert strip.light is not None
            chosen = strip.light.going[points.sample[strip.light.going] == sample]
            with interruptible(check):
                radiance = batches.trace(points[chosen], part)
            found.append((strip, points, chosen, radiance))
        for strip, points, chosen, radiance in found:
            strip.add(chosen, radiance)
            if last:
                strip.end(points)
        self._next += 1
        if not any(len(strip.light.going) for strip in self._strips if strip.light is not None):
            self._next = len(self._parts)

    def _samples(self, strip: _Strip) -> GBuffer:
        """The strip's camera samples, kept while there is room."""
        if strip.buffer is not None:
            return strip.buffer
        assert self._visible is not None
        buffer = self._visible.rows(*strip.rows)
        if strip.light is None:
            strip.begin(len(buffer.points), self.frame.settings, self._parts[-1][1][1])
        size = _bytes_of(buffer)
        if size <= self._left:
            strip.buffer, self._left = buffer, self._left - size
        return buffer

    def _develop(self, prepared: PreparedScene, check: Callable[[], None]) -> dict[str, Array]:
        camera, lights = self.frame.camera, prepared.lights
        film = Film(camera, self.frame.settings, self._parameters, self._seen_world)
        numbers = object_numbers(prepared.scene)
        surfaces = SurfaceFilm(prepared.scene, self.frame, self._parameters, put_lobe_colours)
        groups = LightGroupFilm(prepared.scene, lights, self.frame, self._parameters)
        for strip in self._strips:
            buffer = self._samples(strip)
            check()
            exact = self._adaptive and self.fraction == 1.0
            radiance = strip.radiance(buffer.points, exact)
            if prepared.captured:  # points that have no light yet were given that of their pixel
                radiance.components[buffer.points.flags & UNLIT != 0] = 0.0
            film.add(buffer, radiance, numbers, prepared.seen)
            surfaces.add(buffer)
            groups.add(buffer, radiance)
            if lights is not None and lights.seen:
                rows = slice(strip.rows[0] - camera.window[1], strip.rows[1] - camera.window[1])
                film.pixels.emission[rows] += visible_lights(lights.tables, self._parameters, camera.window[0], buffer)
        self._seen_world = film.seen_world
        components = denoised(film, self.frame, check, self._backend)  # first: the world is seen through its catchers
        made = surfaces.passes() | groups.passes(film.seen_environment())
        names = tuple(name for name in self.frame.passes if name not in made)
        made |= film.passes(names, made, components)
        if "Env" in made:
            made["Env"] = made["Env"].copy()  # the next step goes on with it
        return {name: made[name] for name in self.frame.passes}


def _bytes_of(buffer: GBuffer) -> int:
    """Bytes of a strip's samples."""
    values = [getattr(part, f.name) for part in (buffer, buffer.points) for f in fields(part)]
    return sum(value.nbytes for value in values if isinstance(value, np.ndarray))


@njit
def _spread(pixel: Any, flags: Any, weight: Any, drawn: Any, light: Any, variance: Any, unshadowed: Any) -> None:
    """Give points without light the mean of those of the same pixel and kind, else of the same pixel."""
    n = len(pixel)
    zero = np.float32(0.0)
    mean = np.empty(15, np.float32)
    first = 0
    while first < n:
        last = first + 1
        while last < n and pixel[last] == pixel[first]:
            last += 1
        for i in range(first, last):
            if drawn[i]:
                continue
            for alike in (True, False):
                mean[:] = zero
                total = zero
                for j in range(first, last):
                    if drawn[j] and (not alike or flags[j] == flags[i]):
                        w = weight[j]
                        total += w
                        for c in range(4):
                            for k in range(3):
                                mean[3 * c + k] += w * light[j, c, k]
                        mean[12] += w * variance[j, 0]
                        mean[13] += w * variance[j, 1]
                        mean[14] += w * unshadowed[j]
                if total > zero:
                    for c in range(4):
                        for k in range(3):
                            light[i, c, k] = mean[3 * c + k] / total
                    variance[i, 0], variance[i, 1] = mean[12] / total, mean[13] / total
                    unshadowed[i] = mean[14] / total
                    break
        # What is copied is no further sample: the pixel's variance is that of the points drawn.
        lit = 0
        for i in range(first, last):
            lit += 1 if drawn[i] else 0
        if 0 < lit < last - first:
            more = np.float32((last - first) / lit)
            for i in range(first, last):
                variance[i, 0] *= more
                variance[i, 1] *= more
        first = last
