"""The backend that executes the kernels of a frame on the CPU; `render.gpu` has another for a card."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..compute.warp.kernels import Launcher
from ..core.asset.model import PosedSurfels
from ..core.frame import Camera, RenderSettings
from .denoise.demodulation import Signal
from .denoise.svgf_spatial import denoise
from .denoise.svgf_temporal import NoisyPicture, denoise_next
from .film.guides import Guides
from .gbuffer.camera_hits import shade_mesh, trace_camera
from .gbuffer.gbuffer import GBuffer
from .gbuffer.mesh_hits import MeshHits
from .gbuffer.surfels import tie_to_mesh
from .integrator.integrate import integrate
from .integrator.paths import PathKernel
from .lights.environment import EnvironmentLight
from .lights.light_sampler import Lights
from .scene.trace_scene import TraceScene
from .shading_points import Radiance, ShadingPoints
from .surfels.raster import SurfelSamples, rasterise
from .surfels.splats import Splats, prepare
from .surfels.surfel_bvh import SurfelBVH

Array = np.ndarray
Arrays = tuple[Array, ...]
T = TypeVar("T")


def needs_paths(scene: TraceScene, settings: RenderSettings) -> bool:
    """Whether surfaces have more lobes than two, so that light is solved by `integrator.paths`."""
    return scene.mesh_materials.table.rows is not None and settings.shading_model == "principled"


class RenderBackend:
    """The kernels of a frame, run on the CPU by all threads; other backends override what they can do.

    Attributes
    ----------
    failed : str
        Error message of a backend that failed for this frame; its work falls back to the CPU. "" without a failure.
    failures : int
        How many frames it failed for.
    launcher : Launcher, optional
        Of a device: what launches its kernels.
    strip_factor : int
        How many strips of a picture, as `pipeline.strip_height` has them, are made at once: a card needs many samples.
    """

    failed = ""
    failures = 0
    launcher: Launcher | None = None
    strip_factor = 1

    def with_fallback(self, on_device: Callable[[], T], on_cpu: Callable[[], T]) -> T:
        """The result of `on_device`, or that of `on_cpu` where there is no device or it has failed."""
        return on_cpu()

    def integrate(
        self, scene: TraceScene, environment: EnvironmentLight, points: ShadingPoints, settings: RenderSettings,
        noise_index: int, lights: Lights | None = None, part: tuple[int, int] = (0, 1), *,
        surfels: SurfelBVH | None = None,
    ) -> Radiance:  # fmt: skip
        """`integrator.integrate.integrate`, with the kernel that the scene's materials need."""
        rows = scene.mesh_materials.table.rows
        kernel = PathKernel(rows) if rows is not None and needs_paths(scene, settings) else None
        return integrate(
            scene, environment, points, settings, noise_index, lights, part, surfels=surfels, kernel=kernel
        )

    def prepare(self, posed: PosedSurfels, camera: Camera, parameters: Array) -> Splats:
        """`surfels.splats.prepare`."""
        return prepare(posed, camera, parameters)

    def trace(self, scene: TraceScene, parameters: Array, x0: int, y0: int, shape: tuple[int, ...], mask: int) -> (
        MeshHits
    ):  # fmt: skip
        """`gbuffer.camera_hits.trace_camera`."""
        return trace_camera(scene, parameters, x0, y0, shape, mask)

    def shade(self, scene: TraceScene, hits: MeshHits, parameters: Array, x0: int, buffer: GBuffer, layer: int) -> None:
        """`gbuffer.camera_hits.shade_mesh`, of what this backend has traced."""
        shade_mesh(scene, hits, parameters, x0, buffer, layer)

    def rasterise(self, splats: Splats, y0: int, y1: int) -> SurfelSamples:
        """`surfels.raster.rasterise`; of what this backend has prepared."""
        return rasterise(splats, y0, y1)

    def tie(
        self, scene: TraceScene, rules: tuple[bool, bool], view_of: tuple[Array, Array, int, int], samples: Arrays,
        keys: Arrays, frames: Arrays, materials: Arrays, seen: Arrays,
    ) -> None:  # fmt: skip
        """`gbuffer.surfels.tie_to_mesh`.

        Parameters
        ----------
        scene : TraceScene
        rules : tuple of bool
            Whether points are tied at all, and whether there is a mesh.
        view_of : tuple
            `camera.camera_parameters`, snap windows (m), and the first column and row of the samples.
        samples : tuple of array
            Depth, surface and object, see `SurfelSamples`.
        keys : tuple of array
            Pixel, sample and flags of the points.
        frames, materials : tuple of array
            Written: origin, normal, geometric normal and view of the points; albedo, roughness and metallic.
        seen : tuple of array
            Written: position, depth, object, face, instance and barycentric coordinates, see `GBuffer`.
        """
        tie_to_mesh(scene, rules, view_of, samples, keys, frames, materials, seen)

    def denoise(
        self, components: Array, variance: Array, guides: Guides, split: bool, check: Callable[[], None]
    ) -> Array:  # fmt: skip
        """`denoise.svgf_spatial.denoise`."""
        return denoise(components, variance, guides, split, check)

    def denoise_next(
        self, picture: NoisyPicture, history: Signal | None, split: bool, still: bool, check: Callable[[], None],
        turned: bool = False,
    ) -> tuple[Array, Signal]:  # fmt: skip
        """`denoise.svgf_temporal.denoise_next`."""
        return denoise_next(picture, history, split, still, check, turned)


CPU = RenderBackend()
