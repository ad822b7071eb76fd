"""The Warp backend: kernels on a device; what it fails at, and all that follows in the frame, runs on the CPU."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher
from ...core.asset.model import PosedSurfels
from ...core.errors import DeviceError
from ...core.frame import Camera
from ..backend import RenderBackend, T, needs_paths
from ..denoise.demodulation import Signal
from ..denoise.svgf_temporal import NoisyPicture
from ..film.guides import Guides
from ..gbuffer.camera_hits import shade_mesh
from ..gbuffer.mesh_hits import MeshHits
from ..integrator.integrate import integrate
from ..scene.trace_scene import TraceScene
from ..shading_points import Radiance
from ..surfels.raster import SurfelSamples
from ..surfels.raster import rasterise as rasterise_on_cpu
from ..surfels.splats import Splats
from ..surfels.surfel_bvh import SurfelBVH
from .attach import tie
from .camera_hits import DeviceHits, shade, trace
from .denoise import denoise
from .integrate import DeviceShadingKernel
from .raster import DeviceSamples, rasterise
from .scene_mirror import Mirror
from .splats import DeviceSplats, prepare

Array = np.ndarray


class WarpRenderBackend(RenderBackend):
    """A device of Warp.

    Parameters
    ----------
    device : str
        Warp's name of it: "cuda:0", "cpu".
    """

    def __init__(self, device: str) -> None:
        self.launcher: Launcher = Launcher(device)
        self.strip_factor = 4 if self.launcher.apart else 1
        self.mirror = Mirror(self.launcher)
        self._samples: DeviceSamples | None = None
        self._kernel = DeviceShadingKernel(self.launcher, self.mirror)

    def integrate(self, *arguments: Any, surfels: SurfelBVH | None = None) -> Radiance:
        on_cpu = super().integrate
        others = any(getattr(given, "linked", None) or getattr(given, "grouped", None) for given in arguments)
        if surfels is not None or others or needs_paths(arguments[0], arguments[3]):
            return on_cpu(*arguments, surfels=surfels)
        return self.with_fallback(lambda: integrate(*arguments, kernel=self._kernel), lambda: on_cpu(*arguments))

    def prepare(self, posed: PosedSurfels, camera: Camera, parameters: Array) -> Splats:
        on_cpu = functools.partial(super().prepare, posed, camera, parameters)
        if not len(posed):
            return on_cpu()
        return self.with_fallback(
            lambda: prepare(self.launcher, posed, camera, parameters, functools.cache(on_cpu)), on_cpu
        )

    def trace(self, scene: TraceScene, *arguments: Any) -> MeshHits:
        on_cpu = functools.partial(super().trace, scene, *arguments)
        if not len(scene.faces):
            return on_cpu()
        return self.with_fallback(lambda: trace(self.launcher, self.mirror, on_cpu, scene, *arguments), on_cpu)

    def shade(self, scene: TraceScene, hits: MeshHits, *arguments: Any) -> None:
        def on_cpu() -> None:
            shade_mesh(scene, hits.to_cpu() if isinstance(hits, DeviceHits) else hits, *arguments)

        if not isinstance(hits, DeviceHits):
            return on_cpu()
        return self.with_fallback(lambda: shade(self.launcher, self.mirror, scene, hits, *arguments), on_cpu)

    def rasterise(self, splats: Splats, y0: int, y1: int) -> SurfelSamples:
        def on_cpu() -> SurfelSamples:
            own = splats.on_cpu() if isinstance(splats, DeviceSplats) else splats
            return rasterise_on_cpu(own, y0, y1)

        if not splats.number:
            return on_cpu()

        def on_device() -> SurfelSamples:
            self._samples = rasterise(self.launcher, splats, y0, y1)
            return self._samples

        return self.with_fallback(on_device, on_cpu)

    def tie(self, scene: TraceScene, *arguments: Any) -> None:
        on_cpu = functools.partial(super().tie, scene, *arguments)
        rules, view_of, samples, *more = arguments
        latest, self._samples = self._samples, None
        if latest is not None and samples[1] is latest.surface:
            samples = latest.on_device  # not to be copied again
        self.with_fallback(lambda: tie(self.launcher, self.mirror, scene, rules, view_of, samples, *more), on_cpu)

    def denoise(
        self, components: Array, variance: Array, guides: Guides, split: bool, check: Callable[[], None]
    ) -> Array:  # fmt: skip
        on_cpu, picture = super().denoise, NoisyPicture(components, variance, guides)
        return self.with_fallback(
            lambda: denoise(self.launcher, picture, None, split, False, check)[0],
            lambda: on_cpu(components, variance, guides, split, check),
        )

    def denoise_next(
        self, picture: NoisyPicture, history: Signal | None, split: bool, still: bool, check: Callable[[], None],
        turned: bool = False,
    ) -> tuple[Array, Signal]:  # fmt: skip
        # A card does all levels whatever moves: they take it little time.
        on_cpu, given = super().denoise_next, (picture, history, split, still, check)
        return self.with_fallback(lambda: denoise(self.launcher, *given), lambda: on_cpu(*given, turned))

    def with_fallback(self, on_device: Callable[[], T], on_cpu: Callable[[], T]) -> T:
        """The result of `on_device`, or that of `on_cpu` once the device has failed."""
        if not self.failed:
            try:
                return on_device()
            except DeviceError as error:
                self.failed = str(error)
                self.failures += 1
        return on_cpu()
