"""A processor that is a device of Warp; what it fails at, and all that follows, is done here."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher
from ...core.asset.model import PosedSurfels
from ...core.errors import DeviceError
from ...core.frame import Camera
from ..backend import Processor, T
from ..denoise.demodulation import Signal
from ..denoise.svgf_temporal import Shot
from ..film.guides import Guides
from ..gbuffer.camera_hits import MeshHits, shade_mesh
from ..integrator.integrate import integrate
from ..points import Radiance
from ..scene.trace_scene import TraceScene
from ..surfels.raster import SurfelSamples
from ..surfels.raster import rasterise as rasterise_here
from ..surfels.splats import Splats
from ..surfels.surfel_bvh import SurfelBVH
from .attach import tie
from .camera_hits import HitsThere, shade, trace
from .denoise import denoise
from .integrate import DeviceKernel
from .raster import SamplesThere, rasterise
from .scene_mirror import Mirror
from .splats import SplatsThere, prepare

Array = np.ndarray


class OnDevice(Processor):
    """A device of Warp.

    Parameters
    ----------
    device : Warp's name of it: "cuda:0", "cpu"
    """

    def __init__(self, device: str) -> None:
        self.launcher: Launcher = Launcher(device)
        self.mirror = Mirror(self.launcher)
        self._samples: SamplesThere | None = None
        self._kernel = DeviceKernel(self.launcher, self.mirror)

    def integrate(self, *arguments: Any, surfels: SurfelBVH | None = None) -> Radiance:
        here = super().integrate
        if surfels is not None:
            return here(*arguments, surfels=surfels)
        return self.tried(lambda: integrate(*arguments, kernel=self._kernel), lambda: here(*arguments))

    def prepare(self, posed: PosedSurfels, camera: Camera, parameters: Array) -> Splats:
        here = functools.partial(super().prepare, posed, camera, parameters)
        if not len(posed):
            return here()
        return self.tried(lambda: prepare(self.launcher, posed, camera, parameters, functools.cache(here)), here)

    def trace(self, scene: TraceScene, *arguments: Any) -> MeshHits:
        here = functools.partial(super().trace, scene, *arguments)
        if not len(scene.faces):
            return here()
        return self.tried(lambda: trace(self.launcher, self.mirror, here, scene, *arguments), here)

    def shade(self, scene: TraceScene, hits: MeshHits, *arguments: Any) -> None:
        def here() -> None:
            shade_mesh(scene, hits.here() if isinstance(hits, HitsThere) else hits, *arguments)

        if not isinstance(hits, HitsThere):
            return here()
        return self.tried(lambda: shade(self.launcher, self.mirror, scene, hits, *arguments), here)

    def rasterise(self, splats: Splats, y0: int, y1: int) -> SurfelSamples:
        def here() -> SurfelSamples:
            own = splats.here() if isinstance(splats, SplatsThere) else splats
            return rasterise_here(own, y0, y1)

        if not len(splats):
            return here()

        def there() -> SurfelSamples:
            self._samples = rasterise(self.launcher, splats, y0, y1)
            return self._samples

        return self.tried(there, here)

    def tie(self, scene: TraceScene, *arguments: Any) -> None:
        here = functools.partial(super().tie, scene, *arguments)
        rules, view_of, samples, *more = arguments
        latest, self._samples = self._samples, None
        if latest is not None and samples[1] is latest.surface:
            samples = latest.there  # not to be copied again
        self.tried(lambda: tie(self.launcher, self.mirror, scene, rules, view_of, samples, *more), here)

    def denoise(
        self, components: Array, variance: Array, guides: Guides, split: bool, check: Callable[[], None]
    ) -> Array:  # fmt: skip
        here, shot = super().denoise, Shot(components, variance, guides)
        return self.tried(
            lambda: denoise(self.launcher, shot, None, split, False, check)[0],
            lambda: here(components, variance, guides, split, check),
        )

    def denoise_next(
        self, shot: Shot, history: Signal | None, split: bool, still: bool, check: Callable[[], None]
    ) -> tuple[Array, Signal]:
        here, given = super().denoise_next, (shot, history, split, still, check)
        return self.tried(lambda: denoise(self.launcher, *given), lambda: here(*given))

    def tried(self, there: Callable[[], T], here: Callable[[], T]) -> T:
        """Work done there, or here once that has failed."""
        if not self.failed:
            try:
                return there()
            except DeviceError as error:
                self.failed = str(error)
                self.failures += 1
        return here()
