"""Progressive rendering of one viewport: a coarse picture within a set time, then more and more samples."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..core.frame import Frame
from ..ipc.protocol import Passes
from ..render.backend import CPU, RenderBackend
from ..render.pipeline import Progress
from ..render.prepared_scene import PreparedScene
from ..render.progressive import Progressive, coarse
from .level_of_detail import Budget

IsCancelled = Callable[[], bool]
#: Makes a whole picture of a frame, and reports progress.
Draw = Callable[[Frame, PreparedScene, Progress], Passes]

#: Seconds that the pixels of a first picture may take, and as many surfels as they ask for: longer than that go to what
#: does not depend on them and to the way to the screen, where Blender may draw its window by the same processors.
FIRST_SECONDS = 0.0125
#: Factor on them within which the size of pixels stays, and numbers of pixels of which it is known.
_SLACK, _MOST_SIZES = 1.25, 8
#: Seconds between the pictures that follow.
STEP_SECONDS = 0.2
#: Sides of a coarse pixel.
SIZES = (1, 2, 3, 4, 6, 8)


class Pace:
    """Cost model of first pictures on this machine, fitted to those made so far: a fixed part and one per pixel."""

    def __init__(self) -> None:
        self._seconds = 5e-7
        self._sizes: dict[int, int] = {}
        # Sums over the pictures, older ones counting less: one, pixels, seconds, pixels^2, pixels * seconds.
        self._sums = np.zeros(5)
        for pixels in (0, 60_000):
            self._add(pixels, 0.02 + pixels * self._seconds)

    def size(self, pixels: int) -> int:
        """Side of the coarse pixels with which a picture of `pixels` pixels takes `FIRST_SECONDS` at most.

        It stays until another one clearly fits better, since a history of pictures ends where their size changes.
        """

        def seconds(n: int) -> float:
            return pixels / n**2 * self._seconds

        latest = self._sizes.pop(pixels, None)
        if latest is not None:
            finer = max((n for n in SIZES if n < latest), default=0)
            if seconds(latest) <= FIRST_SECONDS * _SLACK and (not finer or seconds(finer) * _SLACK > FIRST_SECONDS):
                self._sizes[pixels] = latest
                return latest
        self._sizes[pixels] = next((n for n in SIZES if seconds(n) <= FIRST_SECONDS), SIZES[-1])
        while len(self._sizes) > _MOST_SIZES:
            del self._sizes[next(iter(self._sizes))]
        return self._sizes[pixels]

    def note(self, pixels: int, seconds: float) -> None:
        """Learn from a picture; one that was slow because kernels were loaded counts little."""
        one, x, y, _, _ = self._sums
        expected = y / one + self._seconds * (pixels - x / one)
        self._add(pixels, min(seconds, 4 * max(expected, 0.01)))
        one, x, y, xx, xy = self._sums
        spread = one * xx - x * x
        if spread > (0.1 * x) ** 2:
            self._seconds = max((one * xy - x * y) / spread, 1e-8)
        else:  # all had the same size and say nothing of a single pixel; it may be cheaper than it was
            self._seconds *= 0.98

    def _add(self, pixels: float, seconds: float) -> None:
        self._sums = 0.9 * self._sums + (1.0, pixels, seconds, pixels * pixels, pixels * seconds)


@dataclass(frozen=True, slots=True)
class Rough:
    """How the coarse pictures of a view are made, which come before the one with all that it shows.

    Attributes
    ----------
    pixel : int
        Side of the pixels of the first, in those of the frame.
    by_mesh : bool
        Whether they show the meshes, which are as detailed as those pictures.
    most : int
        Surfels that they show at most; 0: all there are.
    sharp : bool
        Whether the last of them has all the pixels, since all the surfels take long.
    """

    pixel: int
    by_mesh: bool = False
    most: int = 0
    sharp: bool = False

    def seen(self, frame: Frame, pixel: int) -> Frame:
        """The frame as a picture with such pixels shows it."""
        if not self.by_mesh or pixel == 0 or (self.sharp and pixel == 1):
            return frame
        return replace(frame, settings=replace(frame.settings, camera_sees="mesh"))

    def budget(self, frame: Frame, pixel: int) -> Budget | None:
        """What a picture with such pixels can show; None for all there is."""
        return Budget(frame.camera, pixel, self.most) if pixel and self.most else None


class View:
    """Progressive state of one viewport's picture.

    Parameters
    ----------
    frame : Frame
        The frame, which must not be changed. Where it names a ``history``, coarse pictures are denoised with it.
    pace : Pace
        For how coarse the first picture of the next view is.
    number : int
        Another one for every view: in a history, the noise of one picture must differ from that of the next.
    rough : Rough
        How it begins.
    backend : RenderBackend
        Where the kernels run.

    Attributes
    ----------
    frame : Frame
        As given.
    pixel : int
        Side of the pixels of the last picture, in those of the frame.
    rough : Rough
        As given.
    backend : RenderBackend
        As given.
    """

    def __init__(self, frame: Frame, pace: Pace, number: int, rough: Rough, backend: RenderBackend = CPU) -> None:
        self.frame, self._pace, self._number, self.rough = frame, pace, number, rough
        self.backend = backend
        self.pixel = 0
        self._picture: Progressive | None = None

    @property
    def fraction(self) -> float:
        """Part of the samples in the last picture, in [0, 1]; 0 for a coarse one."""
        return 0.0 if self._picture is None else self._picture.fraction

    @property
    def coming(self) -> int:
        """Side of the pixels of the next picture; 0 where that has all that the view shows."""
        if self._picture is not None:
            return 0
        if self.pixel == 0:
            return self.rough.pixel
        if self.pixel > 4:
            return max(self.pixel // 4, 2)
        return 1 if self.rough.sharp and self.pixel > 1 else 0

    def advance(self, seen: Frame, prepared: PreparedScene, draw: Draw, cancelled: IsCancelled | None) -> Passes:
        """The next picture: finer pixels, then more samples of the frame as it is `seen`."""
        if self.coming:
            passes = self._coarse(prepared, draw, self.coming)
            self.pixel = self.coming
            return passes
        if self._picture is None:
            picture, seconds = Progressive(seen, self.backend), 0.0
        else:
            picture, seconds = self._picture, STEP_SECONDS
        pictures = picture.advance(prepared, seconds, cancelled)
        self._picture, self.pixel = picture, 1
        return Passes(pictures, [], {})

    def _coarse(self, prepared: PreparedScene, draw: Draw, size: int) -> Passes:
        frame = coarse(self.rough.seen(self.frame, size), size)
        if frame.history:
            frame.noise_index += self._number
        began, projected = time.perf_counter(), 0.0

        def watch(part: float, phase: str) -> None:
            nonlocal projected
            if phase == "Rendering" and not projected:
                projected = time.perf_counter()

        passes = draw(frame, prepared, watch)
        began = began if self.rough.most else projected  # else surfels are as many as pixels ask for
        self._pace.note(frame.camera.width * frame.camera.height, time.perf_counter() - began)
        return passes
