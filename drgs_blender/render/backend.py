"""The backend that executes the kernels of a frame on the CPU; `render.gpu` has another for a card."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from ..compute.warp.kernels import Launcher
from ..core.asset.model import PosedSurfels
from ..core.frame import Camera
from .denoise.demodulation import Signal
from .denoise.svgf_spatial import denoise
from .denoise.svgf_temporal import Shot, denoise_next
from .film.guides import Guides
from .gbuffer.camera_hits import MeshHits, shade_mesh, trace_camera
from .gbuffer.gbuffer import GBuffer
from .gbuffer.surfels import tie_to_mesh
from .integrator.integrate import integrate
from .points import Radiance
from .scene.trace_scene import TraceScene
from .surfels.raster import SurfelSamples, rasterise
from .surfels.splats import Splats, prepare
from .surfels.surfel_bvh import SurfelBVH

Array = np.ndarray
T = TypeVar("T")


class Processor:
    """This processor, by all threads.

    Attributes
    ----------
    failed : of another one, why it is of no use to this picture any more, in words; what it was to do is done here
    failures : how often that happened
    launcher : of another one, what starts its kernels
    """

    failed = ""
    failures = 0
    launcher: Launcher | None = None

    def tried(self, there: Callable[[], T], here: Callable[[], T]) -> T:
        """Work done there, on another processor, or here once that has failed."""
        return here()

    def integrate(self, *arguments: Any, surfels: SurfelBVH | None = None) -> Radiance:
        """`shade.integrate.integrate`."""
        return integrate(*arguments, surfels=surfels)

    def prepare(self, posed: PosedSurfels, camera: Camera, parameters: Array) -> Splats:
        """`surfels.splats.prepare`."""
        return prepare(posed, camera, parameters)

    def trace(self, scene: TraceScene, parameters: Array, x0: int, y0: int, shape: tuple[int, ...], mask: int) -> (
        MeshHits
    ):  # fmt: skip
        """`primary.camera_hits.trace_camera`."""
        return trace_camera(scene, parameters, x0, y0, shape, mask)

    def shade(self, scene: TraceScene, hits: MeshHits, parameters: Array, x0: int, buffer: GBuffer, layer: int) -> None:
        """`primary.camera_hits.shade_mesh`; of what this processor has traced."""
        shade_mesh(scene, hits, parameters, x0, buffer, layer)

    def rasterise(self, splats: Splats, y0: int, y1: int) -> SurfelSamples:
        """`surfels.raster.rasterise`; of what this processor has prepared."""
        return rasterise(splats, y0, y1)

    def tie(self, scene: TraceScene, *arguments: Any) -> None:
        """`primary.primary_surfels.tie_to_mesh`."""
        tie_to_mesh(scene, *arguments)

    def denoise(
        self, components: Array, variance: Array, guides: Guides, split: bool, check: Callable[[], None]
    ) -> Array:  # fmt: skip
        """`picture.denoise.denoise`."""
        return denoise(components, variance, guides, split, check)

    def denoise_next(
        self, shot: Shot, history: Signal | None, split: bool, still: bool, check: Callable[[], None]
    ) -> tuple[Array, Signal]:
        """`picture.temporal.denoise_next`."""
        return denoise_next(shot, history, split, still, check)


HERE = Processor()
