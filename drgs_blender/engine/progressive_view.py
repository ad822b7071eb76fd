"""Progressive rendering of one viewport: a coarse picture within a set time, then more and more samples."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ..core.frame import Frame
from ..ipc.protocol import Passes
from ..render.backend import CPU, RenderBackend
from ..render.pipeline import Progress
from ..render.prepared_scene import PreparedScene
from ..render.progressive import Progressive, coarse, thinned_scene

IsCancelled = Callable[[], bool]
#: Makes a whole picture of a frame, and reports progress.
Draw = Callable[[Frame, PreparedScene, Progress], Passes]

#: Seconds that the pixels of a first picture may take (projecting the surfels comes on top, whatever its size).
FIRST_SECONDS = 0.045
#: Seconds between the pictures that follow.
STEP_SECONDS = 0.2
#: Sides of a coarse pixel.
SIZES = (1, 2, 4, 8)


class Pace:
    """Cost model of first pictures on this machine, fitted to those made so far: a fixed part and one per pixel."""

    def __init__(self) -> None:
        self._seconds = 5e-7
        # Sums over the pictures, older ones counting less: one, pixels, seconds, pixels^2, pixels * seconds.
        self._sums = np.zeros(5)
        for pixels in (0, 60_000):
            self._add(pixels, 0.02 + pixels * self._seconds)

    def size(self, pixels: int) -> int:
        """Side of the coarse pixels with which a picture of `pixels` pixels takes `FIRST_SECONDS` at most."""
        return next((n for n in SIZES if pixels / n**2 * self._seconds <= FIRST_SECONDS), SIZES[-1])

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


class View:
    """Progressive state of one viewport's picture.

    Parameters
    ----------
    frame : Frame
        The frame, which must not be changed. Where it names a ``history``, coarse pictures are denoised with it.
    pace : Pace
        For how coarse the first picture is.
    number : int
        Another one for every view: in a history, the noise of one picture must differ from that of the next.
    by_mesh : bool
        Whether coarse pictures show the meshes, which are as detailed as those pictures.
    backend : RenderBackend
        Where the kernels run.

    Attributes
    ----------
    pixel : int
        Side of the pixels of the last picture, in those of the frame.
    backend : RenderBackend
        As given.
    """

    def __init__(self, frame: Frame, pace: Pace, number: int, by_mesh: bool, backend: RenderBackend = CPU) -> None:
        self.frame, self._pace, self._number, self._by_mesh = frame, pace, number, by_mesh
        self.backend = backend
        self.pixel = 1
        self._picture: Progressive | None = None

    @property
    def fraction(self) -> float:
        """Part of the samples in the last picture, in [0, 1]; 0 for a coarse one."""
        return 0.0 if self._picture is None else self._picture.fraction

    def begin(self, prepared: PreparedScene, draw: Draw) -> Passes:
        """The first picture."""
        x0, y0, x1, y1 = self.frame.camera.window
        self.pixel = self._pace.size((x1 - x0) * (y1 - y0))
        return self._coarse(prepared, draw, self.pixel)

    def advance(self, seen: Frame, prepared: PreparedScene, draw: Draw, cancelled: IsCancelled | None) -> Passes:
        """The next picture: finer pixels, then more samples of the frame as it is `seen`."""
        if self._picture is None and self.pixel > 4:
            passes = self._coarse(prepared, draw, self.pixel // 4)
            self.pixel //= 4
            return passes
        if self._picture is None:
            picture, seconds = Progressive(seen, self.backend), 0.0
        else:
            picture, seconds = self._picture, STEP_SECONDS
        pictures = picture.advance(prepared, seconds, cancelled)
        self._picture, self.pixel = picture, 1
        return Passes(pictures, [], {})

    def _coarse(self, prepared: PreparedScene, draw: Draw, size: int) -> Passes:
        frame = coarse(self.frame, size, self._by_mesh)
        if frame.history:
            frame.noise_index += self._number
        projected = 0.0

        def watch(part: float, phase: str) -> None:
            nonlocal projected
            if phase == "Rendering" and not projected:
                projected = time.perf_counter()

        pixels = frame.camera.width * frame.camera.height
        passes = draw(frame, thinned_scene(prepared, pixels), watch)
        self._pace.note(pixels, time.perf_counter() - projected)
        return passes
