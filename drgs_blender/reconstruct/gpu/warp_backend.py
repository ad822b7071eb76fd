"""The Warp backend of learning: a device of Warp and of torch."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ...compute.warp.kernels import WarpKernel
from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...core.frame import Camera
from ...render.scene.triangle_bvh import TriangleBVH
from ..backend import LearningBackend
from ..capture.training_views import Target
from ..losses.patches import Pair
from ..model.raster import GradientStatistics, Maps
from ..optim.adam import step_rows
from . import appearance, losses
from .gather import DeviceGatherer
from .launch import TensorLauncher
from .raster import rasterise


def descend_rows(thread, stride, scratch, gradient, rate, out):  # type: ignore[no-untyped-def]
    """`adam.descend`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`.
    gradient, rate : array
        As of `adam.step_rows`.
    out : tuple of array
        Value, first and second moment, (n, width) float32; changed.
    """
    value, first, second = out
    for i in range(thread, len(value), stride):
        step_rows(i, i + 1, value, gradient, first, second, rate)


DESCEND = WarpKernel(descend_rows, (), {})


class WarpLearningBackend(LearningBackend):
    """A device of Warp, on which torch has its tensors.

    What fails there is a DeviceError of Warp's work, a RuntimeError of torch's.

    Parameters
    ----------
    device : str
        Warp's name of it: "cuda:0", "cpu".
    """

    def __init__(self, device: str) -> None:
        self.launcher = TensorLauncher(device)
        self.device = self.launcher.place

    def bring(self, target: Target) -> Target:
        names = ("mask", "background", "normals", "unknown")
        there = {name: one.to(self.device) for name in names if (one := getattr(target, name)) is not None}
        return replace(target, photograph=target.colour.to(self.device), **there)

    def attributes(
        self, parameters: dict[str, Tensor], centre: Tensor, eye: Array, bands: int, reflections: bool
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return appearance.attributes(self.launcher, parameters, centre, eye, bands, reflections)

    def rasterise(
        self, centre: Tensor, tangent_u: Tensor, tangent_v: Tensor, opacity: Tensor, features: Tensor, camera: Camera,
        statistics: GradientStatistics | None = None,
    ) -> Maps:  # fmt: skip
        return rasterise(self.launcher, centre, tangent_u, tangent_v, opacity, features, camera, statistics)

    def mirrored(self, features: Tensor, alpha: Tensor, rays: Tensor, texels: Tensor) -> Tensor:
        return appearance.mirrored(self.launcher, features, alpha, rays, texels)

    def difference(self, picture: Tensor, photograph: Tensor) -> Tensor:
        return losses.difference(self.launcher, picture, photograph)

    def shape_loss(
        self, alpha: Tensor, depth: Tensor, distortion: Tensor, normal: Tensor, mask: Tensor | None, rays: Tensor,
        counts: Tensor, weights: tuple[float, float, float],
    ) -> Tensor:  # fmt: skip
        return losses.shape_loss(self.launcher, alpha, depth, distortion, normal, mask, rays, counts, weights)

    def patch_loss(
        self, depth: Tensor, normal: Tensor, counts: Tensor, rays: Tensor, greys: tuple[Tensor, Tensor],
        behind: Tensor, pair: Pair, spread: float,
    ) -> Tensor:  # fmt: skip
        return losses.patch_loss(depth, normal, counts, rays, greys, behind, pair, spread)

    def descend(self, value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: Array) -> None:
        there = torch.from_numpy(rate).to(self.device)
        self.launcher.launch(DESCEND, len(value), (gradient, there), (value, first, second))

    def gatherer(
        self, mesh: Mesh, tree: TriangleBVH, cache: Array | None, counts: tuple[int, int, int], normals: bool
    ) -> DeviceGatherer:
        return DeviceGatherer(self.launcher, mesh, tree, cache, counts, normals)
